"""Calibration that a dive does not show, held at its prior and still doubted.

Noise moves the estimate of what cannot be observed, by more than the data justify, and the
track with it. Such a variable is held at its prior's mean; the covariance of all else keeps its
prior's uncertainty: it is considered, not estimated (the Schmidt-Kalman filter). With K the derivative of
the optimum by what is held, P = P(held known) + K P(prior) K'.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import gtsam
import numpy as np

from rovgraph.calibration import Belief
from rovgraph.geometry import Array
from rovgraph.graph.batch import Problem, Solution, solve
from rovgraph.graph.information import sensitivity
from rovgraph.graph.keys import key
from rovgraph.graph.marginals import covariances, marginals


@dataclass(frozen=True)
class Marginals:
    """Covariances of an optimum.

    Attributes
    ----------
    problem, solution, tree : the optimum
    held : name -> ndarray, shape (dim,), prior sd of what is considered
    moves : key -> ndarray, shape (dim, k), derivative of the optimum by what is held
    """

    problem: Problem
    solution: Solution
    tree: gtsam.GaussianBayesTree
    held: dict[str, Array] = field(default_factory=dict)
    moves: dict[int, Array] = field(default_factory=dict)

    @staticmethod
    def of(problem: Problem, solution: Solution) -> "Marginals":
        """Those of an optimum that holds nothing."""
        return Marginals(problem, solution, marginals(problem, solution))

    def covariances(self, variable: str, count: int) -> Array:
        """Of a state variable at every keyframe, of calibration in every segment; shape (count, d, d)."""
        known = np.array([self._of_each[key(variable, i)] for i in range(count)])
        if not self.held:
            return known
        K = np.array([self.moves[key(variable, i)] for i in range(count)]) * np.concatenate(list(self.held.values()))
        return np.asarray(known + K @ np.swapaxes(K, 1, 2))

    @cached_property
    def _of_each(self) -> dict[int, Array]:
        return covariances(self.tree)

    def newest(self, name: str, walk: float) -> Array:
        """Covariance of an estimated calibration variable at the end, shape (dim, dim)."""
        segments = int(self.problem.segment[-1]) + 1 if walk else 1
        return np.asarray(self.covariances(name, segments)[-1])


def considered(problem: Problem, solution: Solution, without: Problem, beliefs: Mapping[str, Belief]) -> Marginals:
    """The optimum where some variables are held, their prior's uncertainty in its covariance.

    Parameters
    ----------
    problem, solution : of the dive, the variables estimated
    without : the same dive without them among its unknowns
    beliefs : all calibration variables
    """
    names = [name for name in problem.unknowns.estimated if name not in without.unknowns.estimated]
    values = gtsam.Values(solution.values)
    for name in names:
        values.erase(key(name))
    held = solve(without, values)
    there = gtsam.Values(held.values)
    for name in names:
        there.insert(key(name), np.array(beliefs[name].mean, dtype=float))
    moves = sensitivity(problem, there, held.gates, names)
    sd = {name: np.full(beliefs[name].variable.dim, beliefs[name].sd) for name in names}
    return Marginals(without, held, marginals(without, held), sd, moves)


def holding(beliefs: Mapping[str, Belief], names: list[str]) -> dict[str, Belief]:
    """Beliefs with some variables held at their means."""
    return {name: replace(b, estimate=b.estimate and name not in names) for name, b in beliefs.items()}
