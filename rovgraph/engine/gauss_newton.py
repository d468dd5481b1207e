"""Gauss-Newton with a step control and gates, over any solver of the linear problem.

A Gauss-Newton step of a reweighted problem is a direction of descent of the robust cost. It is halved until the cost
falls, so the iteration cannot diverge, and doubled as long as that helps, since reweighted steps fall short where
many measurements lie beyond their loss's bend. When it has converged, measurements beyond their gate are taken
out, those back within it let in, and it is solved again until the gates rest.
"""

from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Gates = dict[str, NDArray[np.bool_]]  # sensor -> which of its measurements are let in

MAX_ITERATIONS = 50
MAX_GATINGS = 8
SMALLEST_STEP = 2.0**-12
RELATIVE_DECREASE = 1e-7  # of the cost, at which the last round stops
COARSE_DECREASE = 1e-3  # and the rounds before the gates rest

Point = TypeVar("Point")
Step = TypeVar("Step")


class Linearizable(Protocol[Point, Step]):
    """A robust least-squares problem whose linear form can be solved."""

    def initial_gates(self) -> Gates:
        """Which measurements are let in to begin with."""
        ...

    def gates(self, point: Point) -> Gates:
        """Which measurements lie within their gate."""
        ...

    def cost(self, point: Point, gates: Gates) -> float:
        """The robust cost that is minimised."""
        ...

    def step(self, point: Point, gates: Gates) -> Step:
        """The Gauss-Newton step.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        ...

    def moved(self, point: Point, step: Step, share: float) -> Point:
        """The point after a share of a step."""
        ...


@dataclass(frozen=True)
class Solution(Generic[Point]):
    """The optimum of a problem.

    Attributes
    ----------
    point : where it lies
    gates : sensor -> which measurements were let in
    cost : robust cost
    iterations : Gauss-Newton steps in all
    converged : the last cost no longer fell
    """

    point: Point
    gates: Gates
    cost: float
    iterations: int
    converged: bool


def minimise(problem: Linearizable[Point, Step], point: Point) -> Solution[Point]:
    """Minimise the robust cost from ``point``, then gate and repeat.

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    gates, iterations, gatings = problem.initial_gates(), 0, 0
    tolerance = COARSE_DECREASE
    while True:
        point, cost, steps, converged = _descend(problem, point, gates, tolerance)
        iterations, within = iterations + steps, problem.gates(point)
        rest = gatings >= MAX_GATINGS or all(np.array_equal(within[s], gates[s]) for s in gates)
        if rest and tolerance == RELATIVE_DECREASE:
            return Solution(point, gates, cost, iterations, converged)
        tolerance = RELATIVE_DECREASE if rest else COARSE_DECREASE
        gates, gatings = gates if rest else within, gatings + 1


def _descend(
    problem: Linearizable[Point, Step], point: Point, gates: Gates, tolerance: float
) -> tuple[Point, float, int, bool]:
    """Gauss-Newton for fixed gates: the point, its cost, the steps taken, and whether the cost has come to rest."""
    cost = problem.cost(point, gates)
    for iteration in range(1, MAX_ITERATIONS + 1):
        trial, trial_cost = _search(problem, point, gates, cost, tolerance)
        decrease = cost - trial_cost
        point, cost = trial, trial_cost
        if decrease <= tolerance * (1.0 + cost):
            return point, cost, iteration, True
    return point, cost, MAX_ITERATIONS, False


def _search(
    problem: Linearizable[Point, Step], point: Point, gates: Gates, cost: float, tolerance: float
) -> tuple[Point, float]:
    """The best of 1, 2, 4... times the step, or the first of 1/2, 1/4... that lowers the cost."""
    step = problem.step(point, gates)

    def at(share: float) -> tuple[Point, float]:
        moved = problem.moved(point, step, share)
        return moved, problem.cost(moved, gates)

    share, best = 1.0, at(1.0)
    if best[1] < cost:
        if cost - best[1] <= tolerance * (1.0 + cost):  # it was the last
            return best
        while (longer := at(2.0 * share))[1] < best[1]:
            share, best = 2.0 * share, longer
        return best
    while not best[1] < cost and share > SMALLEST_STEP:
        share *= 0.5
        best = at(share)
    return best if best[1] < cost else (point, cost)
