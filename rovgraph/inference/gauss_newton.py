"""Gauss-Newton with a step control and gates, over any solver of the linear problem.

A Gauss-Newton step of a reweighted problem is a direction of descent of the robust cost. It is halved until the cost
falls, so the iteration cannot diverge. Where the cost falls by more than the linear problem promises it is doubled as
long as that helps: reweighted steps fall short where many measurements lie beyond their loss's bend. When it has
converged, measurements beyond their gate are excluded, those back within it admitted, and it is solved again until the
gates stay the same. An excluded measurement costs as much as one at its gate: the robust cost is a truncated loss, by
which optima with different gates compare.

It has converged when the remaining decrease is small. A whole step that lowers the cost by g, where the linear problem
predicted p, differs from the prediction by b = g / p - 1 of it: because weights change, or because the problem is not
linear. Along a parabola of another curvature, steps leave p b^2 / (1 - b). Steps that converge by a factor leave a
geometric series of decreases, so two of them also give the rest. A decrease of e is a move of sqrt(2 e) sd in the
direction that the data determine least.
"""

import math
from dataclasses import dataclass, replace
from typing import Generic, Protocol, TypeVar

import numpy as np

from rovgraph.geometry import Array
from rovgraph.problem.measurements import Gates as Gates

MAX_ITERATIONS = 50
MAX_GATINGS = 8
SMALLEST_STEP = 2.0**-12
FINE = 1e-3  # decrease of the cost that is left when the last round stops: 0.045 sd
FINAL_TOLERANCE = 5e-3  # the same where one more step is taken, of the elimination that covariances come of
COARSE = 1e-2  # the same as a part of the cost, of the rounds before the gates rest

# a parabola with the slope that is promised and the decrease that is found is lower at twice the step from here on
FALLS_SHORT = 4.0 / 3.0
LEAST_LEFT = 0.1  # of a step's decrease: after steps that were still far away the next may converge less well
MOST_BEND = 0.9  # for which a step is made longer
LEAST_OF_BEND = 0.1  # of g - p, that is left at least: not all of a step bends alike

Point = TypeVar("Point")
Step = TypeVar("Step")


@dataclass(frozen=True)
class GatedMeasurements:
    """The n measurements of a sensor, as far as gates are concerned.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    dim : components of each
    cost_at_gate : robust cost of one at its gate, infinite without a gate
    """

    time: Array
    dim: int
    cost_at_gate: float


class Linearizable(Protocol[Point, Step]):
    """A robust least-squares problem whose linear form can be solved."""

    def measured(self) -> dict[str, GatedMeasurements]:
        """Sensor -> its measurements, in the order of its gates."""
        ...

    def initial_gates(self) -> Gates:
        """Which measurements are admitted to begin with."""
        ...

    def gates(self, point: Point) -> Gates:
        """Which measurements lie within their gate."""
        ...

    def cost(self, point: Point, gates: Gates) -> float:
        """The robust cost of admitted measurements, priors and motions."""
        ...

    def step(self, point: Point, gates: Gates) -> Step:
        """The Gauss-Newton step from a point, with the weights that its residuals have there.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        ...

    def promised(self, step: Step) -> float:
        """By how much the cost would fall by a step, were the problem linear, with weights that stay."""
        ...

    def moved(self, point: Point, step: Step, share: float) -> Point:
        """The point after a share of a step."""
        ...


@dataclass(frozen=True)
class FaultyInterval:
    """A time in which a sensor is wrong, both ends included [s]."""

    sensor: str
    begin: float
    end: float


@dataclass(frozen=True)
class GaussNewtonResult(Generic[Point]):
    """The optimum of a problem.

    Attributes
    ----------
    point : where it lies
    gates : sensor -> which measurements were admitted
    cost : robust cost, with that of the rejected measurements
    iterations : Gauss-Newton steps in all
    converged : the last cost no longer fell
    stretches : intervals excluded as a whole, of `rovgraph.inference.faulty_intervals`
    runner_up : how much more the next best of the optima costs that were compared, infinite where there was one
    """

    point: Point
    gates: Gates
    cost: float
    iterations: int
    converged: bool
    stretches: tuple[FaultyInterval, ...] = ()
    runner_up: float = math.inf


def minimise(
    problem: Linearizable[Point, Step],
    point: Point,
    gates: Gates | None = None,
    barred: Gates | None = None,
    tolerance: float | None = None,
) -> GaussNewtonResult[Point]:
    """Minimise the robust cost from ``point``, then gate and repeat.

    Parameters
    ----------
    gates : to begin with; None = the problem's own
    barred : sensor -> measurements that stay out, and cost nothing
    tolerance : decrease of the cost that may be left; None = `FINE`

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    barred, tolerance = barred or {}, FINE if tolerance is None else tolerance
    gates, iterations, gatings = _without(gates or problem.initial_gates(), barred), 0, 0
    descent, fine = _Descent(point, problem.cost(point, gates)), False
    while True:
        descent = _descend(problem, descent, gates, tolerance, fine)
        iterations, within = iterations + descent.steps, _without(problem.gates(descent.point), barred)
        rest = gatings >= MAX_GATINGS or _same(gates, within)
        if rest and (fine or descent.left <= tolerance):
            cost = descent.cost + _cost_of_rejected(problem, gates, barred)
            return GaussNewtonResult(descent.point, gates, cost, iterations, descent.steps < MAX_ITERATIONS)
        fine, gatings = rest, gatings + 1
        if not rest:
            gates = within
            descent = _Descent(descent.point, problem.cost(descent.point, gates))


def standing(
    problem: Linearizable[Point, Step], point: Point, gates: Gates, barred: Gates
) -> GaussNewtonResult[Point] | None:
    """A point as it stands, with gates that do not change there; None = they do. Parameters as of `minimise`."""
    if not _same(gates, _without(problem.gates(point), barred)):
        return None
    cost = problem.cost(point, gates) + _cost_of_rejected(problem, gates, barred)
    return GaussNewtonResult(point, gates, cost, 0, True)


def rejects(gates: Gates, share: float) -> bool:
    """Whether more than a share of some sensor's measurements is rejected."""
    return any(gate.mean() < 1.0 - share for gate in gates.values() if len(gate))


def _same(gates: Gates, others: Gates) -> bool:
    return all(np.array_equal(others[sensor], gates[sensor]) for sensor in gates)


def _without(gates: Gates, barred: Gates) -> Gates:
    return {s: gate & ~barred[s] if s in barred else gate for s, gate in gates.items()}


def _cost_of_rejected(problem: Linearizable[Point, Step], gates: Gates, barred: Gates) -> float:
    """What measurements cost that are out by their gates."""
    measured, total = problem.measured(), 0.0
    for sensor, gate in gates.items():
        count = int(np.sum(~gate & ~barred.get(sensor, np.zeros(len(gate), bool))))
        if count and math.isfinite(measured[sensor].cost_at_gate):
            total += count * measured[sensor].cost_at_gate
    return total


@dataclass(frozen=True)
class _Descent(Generic[Point]):
    """Where an iteration with fixed gates stands.

    Attributes
    ----------
    point, cost : the best so far
    decrease : of the last step's cost; infinite before the first
    left : what further steps may still take off the cost
    steps : since the gates changed, or were found at rest
    """

    point: Point
    cost: float
    decrease: float = math.inf
    left: float = math.inf
    steps: int = 0


def _descend(
    problem: Linearizable[Point, Step], begin: _Descent[Point], gates: Gates, least: float, fine: bool
) -> _Descent[Point]:
    """Gauss-Newton for fixed gates, until little is left or `MAX_ITERATIONS` steps are taken."""
    now = replace(begin, steps=0)
    for step in range(1, MAX_ITERATIONS + 1):
        tolerance = least if fine else max(least, COARSE * now.cost)
        point, cost, promised = _search(problem, now.point, gates, now.cost, tolerance)
        decrease = now.cost - cost
        left = min(_left(decrease, now.decrease), left_after(promised, decrease))
        now = _Descent(point, cost, decrease, left, step)
        if now.left <= (least if fine else max(least, COARSE * cost)):
            return now
    return now


def left_after(promised: float, decrease: float) -> float:
    """Remaining decrease of the cost after a whole step, from its predicted and its actual decrease."""
    if not 0.0 < promised < math.inf:
        return 0.0 if promised == 0.0 else math.inf
    bend = decrease / promised - 1.0
    if bend >= 1.0:
        return math.inf
    return max(LEAST_OF_BEND * abs(decrease - promised), promised * bend**2 / (1.0 - bend))


def whole_share(promised: float, decrease: float) -> float:
    """Factor of a step that falls short to the least cost, along a parabola of another curvature."""
    bend = decrease / promised - 1.0 if 0.0 < promised < math.inf else 0.0
    return 1.0 / (1.0 - min(max(bend, 0.0), MOST_BEND))


def _left(decrease: float, before: float) -> float:
    """What steps will still take off the cost, from the decreases by the last step and the one before it."""
    if decrease >= before:
        return math.inf if decrease > 0.0 else 0.0
    return decrease * (1.0 if before == math.inf else max(decrease / (before - decrease), LEAST_LEFT))


def _search(
    problem: Linearizable[Point, Step], point: Point, gates: Gates, cost: float, tolerance: float
) -> tuple[Point, float, float]:
    """The best of 1, 2, 4... times the step, or the first of 1/2, 1/4... that lowers the cost.

    Returns
    -------
    Point, float : where it leads, and the cost there
    float : by how much the cost should have fallen; infinite where it is not the step itself
    """
    step = problem.step(point, gates)
    promised = problem.promised(step)

    def at(share: float) -> tuple[Point, float]:
        moved = problem.moved(point, step, share)
        return moved, problem.cost(moved, gates)

    share, best = 1.0, at(1.0)
    if best[1] < cost:
        if cost - best[1] <= tolerance or cost - best[1] < FALLS_SHORT * promised:  # the former was the last
            return *best, promised
        while (longer := at(2.0 * share))[1] < best[1]:
            share, best = 2.0 * share, longer
        return *best, promised if share == 1.0 else math.inf
    while not best[1] < cost and share > SMALLEST_STEP:
        share *= 0.5
        best = at(share)
    return *(best if best[1] < cost else (point, cost)), math.inf
