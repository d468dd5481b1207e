"""The optimum of a graph, as `rovgraph.engine.optimum` asks of any solver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from rovgraph.calibration import TABLE, Belief
from rovgraph.engine.gauss_newton import Solution
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.measurements import Block
from rovgraph.engine.optimum import Knowledge
from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array
from rovgraph.graph.batch import Problem, make_problem, solve
from rovgraph.graph.information import knowledge, noise_of_states, sensitivity
from rovgraph.graph.keys import calibration_key, key
from rovgraph.graph.marginals import covariances, marginals, newest_covariance
from rovgraph.state import DIMENSION, PLACE, State


@dataclass(frozen=True)
class GraphOptimum:
    """A graph and where its robust cost is least."""

    intervals: list[KeyframeInterval]
    initial: InitialConditions
    beliefs: Mapping[str, Belief]
    problem: Problem
    solution: Solution[gtsam.Values]

    @property
    def unknowns(self) -> Unknowns:
        return self.problem.unknowns

    @property
    def blocks(self) -> Mapping[str, Block]:
        return self.problem.blocks

    @cached_property
    def state(self) -> State:
        return self.problem.states(self.solution.point)

    @cached_property
    def weights(self) -> Mapping[str, Array]:
        return self.problem.weights(self.solution.point, self.solution.gates)

    @cached_property
    def places(self) -> Mapping[int, Array]:
        block = self.problem.blocks.get("place")
        numbers = set() if block is None else set(block.place.tolist())
        return {number: self.solution.point.atVector(key(PLACE, number)) for number in numbers}

    @cached_property
    def _covariances(self) -> dict[int, Array]:
        return covariances(marginals(self.problem, self.solution.point, self.solution.gates))

    def covariances(self, variable: str) -> Array:
        """As `rovgraph.engine.optimum.Optimum`."""
        return np.array([self._covariances[own] for own in self._keys(variable)])

    def newest_covariance(self, places: Sequence[int] = ()) -> Array:
        """As `rovgraph.engine.optimum.Optimum`."""
        return newest_covariance(self.problem, self.solution.point, self.solution.gates, places)

    def knowledge(self, keyframes: Sequence[int]) -> Knowledge:
        """As `rovgraph.engine.optimum.Optimum`."""
        return knowledge(self.problem, self.solution.point, self.solution.gates, keyframes)

    def noisier(self, keyframes: Sequence[int], seed: int = 1) -> tuple[Knowledge, Knowledge]:
        """As `rovgraph.engine.optimum.Optimum`."""
        noise = noise_of_states(self.problem, self.solution.point, self.solution.gates, seed)
        more, less = (self.solution.point.retract(noise.scale(sign)) for sign in (1.0, -1.0))
        return (
            knowledge(self.problem, more, self.solution.gates, keyframes),
            knowledge(self.problem, less, self.solution.gates, keyframes),
        )

    def holding(self, names: Sequence[str]) -> tuple["GraphOptimum", Mapping[str, Array]]:
        """As `rovgraph.engine.optimum.Optimum`."""
        initial = self.initial
        beliefs = {n: _held(b) if n in names else b for n, b in self.beliefs.items()}
        without = make_problem(self.intervals, initial.prior, initial.config, beliefs, initial.instruments)
        values = gtsam.Values(self.solution.point)
        for name in names:
            values.erase(key(name))
        held = solve(without, values, self.solution)
        there = gtsam.Values(held.point)
        for name in names:
            there.insert(key(name), np.array(self.beliefs[name].mean, dtype=float))
        moves = sensitivity(self.problem, there, held.gates, names)
        variables = [*DIMENSION, *without.unknowns.estimated]
        by_variable = {v: np.array([moves[own] for own in self._keys(v)]) for v in variables}
        return GraphOptimum(self.intervals, initial, self.beliefs, without, held), by_variable

    def _keys(self, variable: str) -> list[int]:
        """Keys of a variable at every keyframe."""
        if variable in TABLE:
            return [calibration_key(self.unknowns, variable, k) for k in self.problem.index.tolist()]
        return [key(variable, k) for k in range(self.problem.count)]


def _held(belief: Belief) -> Belief:
    return Belief(belief.variable, belief.mean, belief.sd, False, belief.walk)
