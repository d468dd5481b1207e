"""The optimum of a graph, as `rovgraph.engine.optimum` asks of any solver."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np

from rovgraph.calibration import TABLE, Belief
from rovgraph.engine.gauss_newton import Solution
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.measurements import Measurements
from rovgraph.engine.optimum import Knowledge
from rovgraph.engine.problem import Problem
from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array, transpose
from rovgraph.graph.batch import DiveGraph, make_graph, solve
from rovgraph.graph.information import knowledge, noise_of_states, sensitivity
from rovgraph.graph.keys import calibration_key, key
from rovgraph.graph.marginals import covariances, marginals, newest_covariance, newest_keys
from rovgraph.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY, State


@dataclass(frozen=True)
class GraphOptimum:
    """A graph and where its robust cost is least."""

    problem: Problem
    initial: InitialConditions
    beliefs: Mapping[str, Belief]
    graph: DiveGraph
    solution: Solution[gtsam.Values]

    @property
    def unknowns(self) -> Unknowns:
        return self.graph.unknowns

    @property
    def blocks(self) -> Mapping[str, Measurements]:
        return self.graph.blocks

    @cached_property
    def state(self) -> State:
        return self.graph.states(self.solution.point)

    @cached_property
    def weights(self) -> Mapping[str, Array]:
        return self.graph.weights(self.solution.point, self.solution.gates)

    @cached_property
    def places(self) -> Mapping[int, Array]:
        block = self.graph.blocks.get("place")
        numbers = set() if block is None else set(block.place.tolist())
        return {number: self.solution.point.atVector(key(PLACE, number)) for number in numbers}

    @cached_property
    def _wide(self) -> tuple[DiveGraph, gtsam.Values]:
        """The graph in which what is considered is estimated, and where it is linearised."""
        names = self.unknowns.considered
        return self._graph(self.unknowns.estimating(names)), self._with_means(self.solution.point, names)

    @cached_property
    def _sensitivity(self) -> dict[int, Array]:
        """Derivatives of the optimum by what is considered times its prior sd, by key, shape (dim, h)."""
        moves = sensitivity(*self._wide, self.solution.gates, self.unknowns.considered)
        beliefs = [self.beliefs[name] for name in self.unknowns.considered]
        sd = np.concatenate([np.full(b.variable.dim, b.sd) for b in beliefs])
        return {one: K * sd for one, K in moves.items()}

    def covariances(self) -> dict[str, Array]:
        """As `rovgraph.engine.optimum.Optimum`."""
        known = covariances(marginals(self.graph, self.solution.point, self.solution.gates))
        out = {}
        for variable in (POSE, VELOCITY, BIAS, *self.unknowns.estimated):
            keys = self._keys(variable)
            P = np.array([known[own] for own in keys])
            if self.unknowns.considered:
                K = np.array([self._sensitivity[own] for own in keys])
                P += K @ transpose(K)
            out[variable] = P
        for variable in self.unknowns.considered:
            belief = self.beliefs[variable]
            own = np.eye(belief.variable.dim) * belief.sd**2
            out[variable] = np.broadcast_to(own, (self.graph.count, *own.shape))
        return out

    def newest_covariance(self, places: Sequence[int] = ()) -> Array:
        """As `rovgraph.engine.optimum.Optimum`."""
        known = newest_covariance(self.graph, self.solution.point, self.solution.gates, places)
        names = self.unknowns.considered
        if not names:
            return known
        K = np.vstack([self._sensitivity[one] for one in newest_keys(self.graph, places)])
        beliefs = [self.beliefs[name] for name in names]
        sd = np.concatenate([np.full(b.variable.dim, b.sd) for b in beliefs])
        own, end = K.shape[1], len(K) - PLACE_DIM * len(places)
        P, K = np.zeros((len(K) + own, len(K) + own)), np.insert(K, end, np.diag(sd), axis=0)
        others = np.r_[:end, end + own : len(P)]
        P[np.ix_(others, others)] = known
        return np.asarray(P + K @ K.T)

    def knowledge(self, keyframes: Sequence[int]) -> Knowledge:
        """As `rovgraph.engine.optimum.Optimum`."""
        return knowledge(self.graph, self.solution.point, self.solution.gates, keyframes)

    def noisier(self, keyframes: Sequence[int], seed: int = 1) -> tuple[Knowledge, Knowledge]:
        """As `rovgraph.engine.optimum.Optimum`."""
        noise = noise_of_states(self.graph, self.solution.point, self.solution.gates, seed)
        more, less = (self.solution.point.retract(noise.scale(sign)) for sign in (1.0, -1.0))
        return (
            knowledge(self.graph, more, self.solution.gates, keyframes),
            knowledge(self.graph, less, self.solution.gates, keyframes),
        )

    def considering(self, names: Sequence[str]) -> "GraphOptimum":
        """As `rovgraph.engine.optimum.Optimum`."""
        values = gtsam.Values(self.solution.point)
        for name in names:
            values.erase(key(name))
        return self._solved(self.unknowns.considering(names), values)

    def relative_sd(self) -> dict[str, Array]:
        """As `rovgraph.engine.optimum.Optimum`."""
        names, (wide, values) = self.unknowns.considered, self._wide
        tree = marginals(wide, values, self.solution.gates)
        P = covariances(tree)
        return {name: np.sqrt(np.diagonal(P[key(name)])) / self.beliefs[name].sd for name in names}

    def estimating(self, names: Sequence[str]) -> "GraphOptimum":
        """As `rovgraph.engine.optimum.Optimum`."""
        return self._solved(self.unknowns.estimating(names), self._with_means(self.solution.point, names))

    def _solved(self, unknowns: Unknowns, values: gtsam.Values) -> "GraphOptimum":
        """The optimum with other unknowns, close by."""
        graph = self._graph(unknowns)
        return GraphOptimum(self.problem, self.initial, self.beliefs, graph, solve(graph, values, self.solution))

    def _graph(self, unknowns: Unknowns) -> DiveGraph:
        initial = self.initial
        return make_graph(self.problem, initial.prior, initial.config, self.beliefs, initial.instruments, unknowns)

    def _with_means(self, values: gtsam.Values, names: Sequence[str]) -> gtsam.Values:
        """The values with those of some constants at their means."""
        more = gtsam.Values(values)
        for name in names:
            more.insert(key(name), np.array(self.beliefs[name].mean, dtype=float))
        return more

    def _keys(self, variable: str) -> list[int]:
        """Keys of a variable at every keyframe."""
        if variable in TABLE:
            return [calibration_key(self.unknowns, variable, k) for k in self.graph.index.tolist()]
        return [key(variable, k) for k in range(self.graph.count)]
