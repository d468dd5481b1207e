"""A dive as GTSAM's graph, solved by Gauss-Newton: where loops are closed, and to hold the chain against.

Each iteration linearises GTSAM's own factors there, and all measurements of a sensor at once; GTSAM eliminates the
sum. Calibration that walks has a value at each keyframe, as in the chain.
"""

import re
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import Belief
from rovgraph.config import Config
from rovgraph.engine.constant_velocity import gravity
from rovgraph.engine.gauss_newton import Gates, Measured, Solution
from rovgraph.engine.initial_conditions import StatePrior
from rovgraph.engine.measurements import (
    Measurements,
    Seen,
    cost_at_gate,
    gates_of,
    measurement_cost,
    measurements_of,
    weights_of,
)
from rovgraph.engine.problem import Problem
from rovgraph.engine.stretches import resume
from rovgraph.engine.stretches import solve as solve_problem
from rovgraph.engine.unknowns import Unknowns, unknowns
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.graph.factors import drift, landmark_prior, priors
from rovgraph.graph.keys import key_name
from rovgraph.graph.measurement_factors import measurement_factor, with_places
from rovgraph.graph.motion_factors import motion_factor
from rovgraph.graph.rows import Rows
from rovgraph.graph.values import insert_calibration, insert_state, states_from
from rovgraph.instruments import Instrument
from rovgraph.state import State

FARTHEST_STEP = 1e7  # beyond it QR has divided by rounding, where Cholesky found nothing to divide by


@dataclass(frozen=True)
class GraphStep:
    """A step of all variables, and by how much the cost of the linear graph falls by it."""

    delta: gtsam.VectorValues
    promised: float


@dataclass(frozen=True)
class DiveGraph:
    """The whole dive's graph: native factors, and measurements as blocks.

    Attributes
    ----------
    native : priors and IMU factors
    blocks : sensor -> Measurements
    unknowns : the calibration variables
    index : ndarray of int, shape (n,), of the value that calibration which walks has at each keyframe, from 0
        and by steps of 0 or 1
    """

    native: gtsam.NonlinearFactorGraph
    blocks: dict[str, Measurements]
    unknowns: Unknowns
    index: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Number of keyframes."""
        return len(self.index)

    @cached_property
    def rows(self) -> list[Rows]:
        """Of the measurements; those of places touch a variable more."""
        kinds = ({s: b for s, b in self.blocks.items() if (s == "place") == seen} for seen in (False, True))
        return [Rows(kind, self.index) for kind in kinds if kind]

    def states(self, values: gtsam.Values) -> State:
        """State of every keyframe."""
        return states_from(values, self.index, self.unknowns)

    def seen(self, values: gtsam.Values) -> Seen:
        """Every sensor's block, with the state of each measurement's keyframe."""
        for known, seen in self._newest_seen:
            if known is values:
                return seen
        states = self.states(values)
        seen = [(s, block, with_places(block, states.at(block.keyframe), values)) for s, block in self.blocks.items()]
        self._newest_seen.append((values, seen))
        return seen

    @cached_property
    def _newest_seen(self) -> deque[tuple[gtsam.Values, Seen]]:
        return deque(maxlen=2)  # reading GTSAM's values takes as long as a cost; a step is searched, then linearised

    def measured(self) -> dict[str, Measured]:
        """Times, dimension and cost at the gate of every sensor's measurements."""
        return {s: Measured(b.time, b.z.shape[1], cost_at_gate(b.instrument)) for s, b in self.blocks.items()}

    def initial_gates(self) -> Gates:
        """Open, but for places that look like others."""
        return {sensor: block.believed.copy() for sensor, block in self.blocks.items()}

    def gates(self, point: gtsam.Values) -> Gates:
        """Which measurements lie within their gate."""
        return gates_of(self.seen(point))

    def weights(self, values: gtsam.Values, gates: Gates) -> dict[str, Array]:
        """Weight of every measurement, shape (n,) for each sensor."""
        return weights_of(self.seen(values), gates)

    def cost(self, point: gtsam.Values, gates: Gates) -> float:
        """The robust cost that is minimised."""
        return float(self.native.error(point)) + measurement_cost(self.seen(point), gates)

    def linearize(self, values: gtsam.Values, gates: Gates) -> gtsam.GaussianFactorGraph:
        """All factors linearised at ``values``, measurements weighted."""
        linear = self.native.linearize(values)
        weighted = {sensor: block.weighted(state, gates[sensor]) for sensor, block, state in self.seen(values)}
        for rows in self.rows:
            rows.push(linear, weighted)
        return linear

    def step(self, point: gtsam.Values, gates: Gates) -> GraphStep:
        """The Gauss-Newton step: Cholesky, and QR where rounding makes that indefinite."""
        if not self._ordering:  # of the whole graph, as METIS crashes on what the gates have cut off
            whole = self.linearize(point, self.initial_gates())
            self._ordering.append(gtsam.Ordering.MetisGaussianFactorGraph(whole))
        linear = self.linearize(point, gates)
        delta = eliminate_step(linear, self._ordering[0])
        return GraphStep(delta, linear.error(delta.scale(0.0)) - linear.error(delta))

    def promised(self, step: GraphStep) -> float:
        return step.promised

    @cached_property
    def _ordering(self) -> list[gtsam.Ordering]:
        return []

    def moved(self, point: gtsam.Values, step: GraphStep, share: float) -> gtsam.Values:
        """The values after a share of a step."""
        return point.retract(step.delta if share == 1.0 else step.delta.scale(share))

    def nonlinear(self) -> gtsam.NonlinearFactorGraph:
        """The same graph with one `gtsam.CustomFactor` per measurement."""
        whole = gtsam.NonlinearFactorGraph(self.native)
        for block in self.blocks.values():
            for k in range(len(block)):
                whole.add(measurement_factor(block.at(slice(k, k + 1)), int(self.index[block.keyframe[k]])))
        return whole


def make_graph(
    problem: Problem,
    prior: StatePrior,
    config: Config,
    beliefs: Mapping[str, Belief],
    instruments: Mapping[str, Instrument],
    wanted: Unknowns | None = None,
) -> DiveGraph:
    """Assemble the graph of a dive; calibration that walks has a value at each keyframe.

    What is estimated is ``wanted``, or else what is believed to be.
    """
    index = np.arange(len(problem))
    wanted = wanted or unknowns(beliefs, problem.used)
    factors = _others(problem, prior, beliefs, wanted, index)
    blocks = measurements_of(problem, instruments, instruments, gravity(config), wanted)
    if "place" in blocks:
        factors += [landmark_prior(number) for number in np.unique(blocks["place"].place).tolist()]
    native = gtsam.NonlinearFactorGraph()
    for factor in factors:
        native.add(factor)
    return DiveGraph(native, blocks, wanted, index)


def _others(
    problem: Problem,
    prior: StatePrior,
    beliefs: Mapping[str, Belief],
    wanted: Unknowns,
    index: NDArray[np.int64],
) -> list[gtsam.NonlinearFactor]:
    """Priors, motions and walks."""
    factors = priors(prior, beliefs, wanted)
    factors += [motion_factor(problem, k, wanted, int(index[k])) for k in range(1, len(problem))]
    begun = np.flatnonzero(np.diff(index, prepend=-1))
    for before, after in pairwise(begun.tolist()):
        factors += drift(wanted, int(index[after]), float(problem.time[after] - problem.time[before]))
    return factors


def make_values(graph: DiveGraph, states: State, calibration: Mapping[str, Array] | None = None) -> gtsam.Values:
    """GTSAM values of the keyframes' states, calibration at its means unless given; without places."""
    values = gtsam.Values()
    for i in range(graph.count):
        insert_state(values, i, states.at([i]))
    for own in range(int(graph.index[-1]) + 1) if any(graph.unknowns.walks.values()) else (0,):
        insert_calibration(values, calibration or graph.unknowns.fixed, graph.unknowns, own)
    return values


def solve(
    graph: DiveGraph, values: gtsam.Values, known: Solution[gtsam.Values] | None = None
) -> Solution[gtsam.Values]:
    """The cheapest optimum from ``values``; with ``known``, of a problem close by, that with the same stretches out.

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    return solve_problem(graph, values) if known is None else resume(graph, values, known)


def eliminate_step(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues:
    """The solution of a linear graph: Cholesky, and QR where rounding makes that indefinite.

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    try:
        return linear.optimize(ordering)
    except RuntimeError as error:
        first = error
    try:
        delta = linear.optimize(ordering, gtsam.EliminateQR)
    except RuntimeError as error:
        raise InputError(indeterminate(error)) from None
    if not delta.norm() < FARTHEST_STEP:
        raise InputError(indeterminate(first))
    return delta


def indeterminate(error: RuntimeError) -> str:
    """One line on a system that cannot be solved; never the graph that GTSAM prints."""
    found = re.search(r"variable\s+(\d+)", str(error)[:2000])
    what = key_name(int(found.group(1))) if found else "some variable"
    return (
        f"the data do not determine {what}: check the log (rovgraph check), "
        "tighten its prior sd, or hold it fixed in the configuration"
    )
