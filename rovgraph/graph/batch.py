"""Batch smoothing: Gauss-Newton over the whole dive, with a step control.

Each iteration linearises the IMU's factors in GTSAM and all measurements at once in
NumPy, eliminates in GTSAM, and takes the step, halved until the robust cost falls: the
direction is one of descent for that cost, so the solver cannot diverge. Robust losses
are applied by reweighting. When it has converged, measurements beyond their gate are
taken out, and it is solved again until the gates rest.
"""

import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import Belief
from rovgraph.config import Config
from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement
from rovgraph.engine.unknowns import Unknowns, unknowns
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.graph.factors import Start, drift, landmark_prior, motion, priors
from rovgraph.graph.keys import key_name
from rovgraph.graph.measurements import Block, loss_and_weight, make_block
from rovgraph.graph.rows import Rows
from rovgraph.graph.values import insert_calibration, insert_state, states_from
from rovgraph.instruments import Instrument
from rovgraph.state import State

Gates = dict[str, NDArray[np.bool_]]

MAX_ITERATIONS = 50
MAX_GATINGS = 8
SMALLEST_STEP = 2.0**-12
FARTHEST_STEP = 1e7  # beyond it QR has divided by rounding, where Cholesky found nothing to divide by
RELATIVE_DECREASE = 1e-7  # of the cost, at which the last round stops
COARSE_DECREASE = 1e-3  # and the rounds before the gates rest


@dataclass(frozen=True)
class Problem:
    """The whole dive's graph: native factors, and measurements as blocks.

    Attributes
    ----------
    native : priors and IMU factors
    blocks : sensor -> Block
    segment : ndarray of int, shape (count,), the segment of time that each keyframe lies in
    time : ndarray, shape (count,), of the keyframes [s]
    unknowns : the calibration variables
    """

    native: gtsam.NonlinearFactorGraph
    blocks: dict[str, Block]
    segment: NDArray[np.int64]
    time: Array
    unknowns: Unknowns

    @property
    def count(self) -> int:
        """Number of keyframes."""
        return len(self.segment)

    def walked(self, segment: int) -> float:
        """Time from the start to the first keyframe of a segment [s]."""
        return float(self.time[np.searchsorted(self.segment, segment)] - self.time[0])

    @cached_property
    def rows(self) -> list[Rows]:
        """Of the measurements; those of places touch a variable more."""
        kinds = ({s: b for s, b in self.blocks.items() if (s == "place") == seen} for seen in (False, True))
        return [Rows(kind) for kind in kinds if kind]

    def states(self, values: gtsam.Values) -> State:
        """State of every keyframe."""
        return states_from(values, self.segment, self.unknowns)

    def seen(self, values: gtsam.Values) -> list[tuple[str, Block, State]]:
        """Every sensor's block, with the state of each measurement's keyframe."""
        for known, seen in self._newest_seen:
            if known is values:
                return seen
        states = self.states(values)
        seen = [(s, block, block.with_places(states.at(block.keyframe), values)) for s, block in self.blocks.items()]
        self._newest_seen.append((values, seen))
        return seen

    @cached_property
    def _newest_seen(self) -> deque[tuple[gtsam.Values, list[tuple[str, Block, State]]]]:
        return deque(maxlen=2)  # reading GTSAM's values takes as long as a cost; a step is searched, then linearised

    def open_gates(self) -> Gates:
        return {sensor: np.ones(len(block), dtype=bool) for sensor, block in self.blocks.items()}

    def believed(self) -> Gates:
        """The gates to begin with: open, but for places that look like others."""
        return {sensor: block.believed for sensor, block in self.blocks.items()}

    def gates(self, values: gtsam.Values) -> Gates:
        """Which measurements lie within their gate at ``values``."""
        out = {}
        for sensor, block, state in self.seen(values):
            gate = block.instrument.gate_sd or np.inf
            out[sensor] = np.linalg.norm(block.normalised(state), axis=1) <= gate
        return out

    def weights(self, values: gtsam.Values, gates: Gates) -> dict[str, Array]:
        """Weight of every measurement, shape (n,) for each sensor."""
        out = {}
        for sensor, block, state in self.seen(values):
            r = block.normalised(state)
            out[sensor] = loss_and_weight(r, block.instrument.loss)[1] * gates[sensor]
        return out

    def cost(self, values: gtsam.Values, gates: Gates) -> float:
        """The robust cost that is minimised."""
        total = self.native.error(values)
        for sensor, block, state in self.seen(values):
            r = block.normalised(state)
            total += float(loss_and_weight(r, block.instrument.loss)[0] @ gates[sensor])
        return total

    def linearize(self, values: gtsam.Values, gates: Gates) -> gtsam.GaussianFactorGraph:
        """All factors linearised at ``values``, measurements weighted."""
        linear = self.native.linearize(values)
        weighted = {sensor: block.weighted(state, gates[sensor]) for sensor, block, state in self.seen(values)}
        for rows in self.rows:
            rows.push(linear, weighted)
        return linear

    def nonlinear(self) -> gtsam.NonlinearFactorGraph:
        """The same graph with one `gtsam.CustomFactor` per measurement."""
        graph = gtsam.NonlinearFactorGraph(self.native)
        for block in self.blocks.values():
            for k in range(len(block)):
                graph.add(block.custom_factor(k))
        return graph


@dataclass(frozen=True)
class Solution:
    """The optimum of a `Problem`.

    Attributes
    ----------
    values : gtsam.Values
    gates, weights : sensor -> which measurements were let in, and their weights
    cost : robust cost
    iterations : Gauss-Newton steps in all
    converged : the last cost no longer fell
    """

    values: gtsam.Values
    gates: Gates
    weights: dict[str, Array]
    cost: float
    iterations: int
    converged: bool


def make_problem(
    intervals: Sequence[KeyframeInterval],
    start: Start,
    config: Config,
    beliefs: Mapping[str, Belief],
    instruments: Mapping[str, Instrument],
) -> Problem:
    """Assemble the graph of a dive."""
    attached: dict[str, list[KeyframeMeasurement]] = {}
    for interval in intervals:
        for a in interval.measurements:
            attached.setdefault(a.sensor, []).append(a)
    wanted = unknowns(beliefs, attached)
    factors = priors(start, beliefs, wanted)
    for interval in intervals:
        factors += motion(interval, wanted)
    first = {interval.segment: interval.time for interval in reversed(intervals)}
    for segment in range(1, intervals[-1].segment + 1):
        factors += drift(wanted, segment, first[segment] - first[segment - 1])
    gravity = config.environment.gravity_mps2
    blocks = {s: make_block(rows, instruments[s], gravity, wanted) for s, rows in attached.items()}
    if "place" in blocks:
        factors += [landmark_prior(number) for number in np.unique(blocks["place"].place).tolist()]
    native = gtsam.NonlinearFactorGraph()
    for factor in factors:
        native.add(factor)
    segments, time = np.array([i.segment for i in intervals]), np.array([i.time for i in intervals])
    return Problem(native, blocks, segments, time, wanted)


def make_values(problem: Problem, states: State, calibration: Mapping[str, Array] | None = None) -> gtsam.Values:
    """GTSAM values of the keyframes' states, calibration at its means unless given; without places."""
    values = gtsam.Values()
    for i in range(problem.count):
        insert_state(values, i, states.at([i]))
    for segment in range(int(problem.segment[-1]) + 1):
        insert_calibration(values, calibration or problem.unknowns.fixed, problem.unknowns, segment)
    return values


def solve(problem: Problem, values: gtsam.Values) -> Solution:
    """Minimise the robust cost from ``values``, then gate and repeat.

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    gates, iterations = problem.believed(), 0
    first = problem.linearize(values, gates)
    # of the whole graph, as METIS crashes on a variable that the gates have cut off
    ordering = gtsam.Ordering.MetisGaussianFactorGraph(first)
    linear: gtsam.GaussianFactorGraph | None = first
    tolerance, gatings = COARSE_DECREASE, 0
    while True:
        values, cost, steps, converged = _minimise(problem, values, gates, tolerance, ordering, linear)
        linear = None
        iterations, renewed = iterations + steps, problem.gates(values)
        rest = gatings >= MAX_GATINGS or all(np.array_equal(renewed[s], gates[s]) for s in gates)
        if rest and tolerance == RELATIVE_DECREASE:
            break
        tolerance = RELATIVE_DECREASE if rest else COARSE_DECREASE
        gates, gatings = gates if rest else renewed, gatings + 1
    return Solution(values, gates, problem.weights(values, gates), cost, iterations, converged)


def solution_at(problem: Problem, values: gtsam.Values) -> Solution:
    """The optimum that another solver found, as a `Solution`."""
    gates = problem.gates(values)
    return Solution(values, gates, problem.weights(values, gates), problem.cost(values, gates), 0, True)


def _minimise(
    problem: Problem,
    values: gtsam.Values,
    gates: Gates,
    tolerance: float,
    ordering: gtsam.Ordering,
    linear: gtsam.GaussianFactorGraph | None,
) -> tuple[gtsam.Values, float, int, bool]:
    """Gauss-Newton with step halving for fixed gates; ``linear`` at ``values`` where it is at hand."""
    cost = problem.cost(values, gates)
    for iteration in range(1, MAX_ITERATIONS + 1):
        delta = _eliminate(problem.linearize(values, gates) if linear is None else linear, ordering)
        linear = None
        trial, trial_cost = _search(problem, values, gates, delta, cost, tolerance)
        decrease = cost - trial_cost
        values, cost = trial, trial_cost
        if decrease <= tolerance * (1.0 + cost):
            return values, cost, iteration, True
    return values, cost, MAX_ITERATIONS, False


def _search(
    problem: Problem, values: gtsam.Values, gates: Gates, delta: gtsam.VectorValues, cost: float, tolerance: float
) -> tuple[gtsam.Values, float]:
    """The best of the steps 1, 2, 4... along ``delta``, or the first of 1/2, 1/4... that lowers the cost.

    Reweighting takes steps that are too short where many measurements lie beyond their
    loss's bend; lengthening them saves most of the iterations.
    """

    def at(step: float) -> tuple[gtsam.Values, float]:
        moved = values.retract(delta if step == 1.0 else delta.scale(step))
        return moved, problem.cost(moved, gates)

    step, best = 1.0, at(1.0)
    if best[1] < cost:
        if cost - best[1] <= tolerance * (1.0 + cost):  # it was the last
            return best
        while (longer := at(2.0 * step))[1] < best[1]:
            step, best = 2.0 * step, longer
        return best
    while not best[1] < cost and step > SMALLEST_STEP:
        step *= 0.5
        best = at(step)
    return best if best[1] < cost else (values, cost)


def _eliminate(linear: gtsam.GaussianFactorGraph, ordering: gtsam.Ordering) -> gtsam.VectorValues:
    """The Gauss-Newton step: Cholesky, and QR where rounding makes that indefinite."""
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
