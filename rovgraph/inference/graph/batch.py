"""A dive as GTSAM's graph, solved by Gauss-Newton: for closed loops, and as a reference for the chain.

Priors, walks, the IMU's motion over each interval and all measurements become factors. Each iteration linearises
GTSAM's own factors there, and all measurements of a sensor at once, as Jacobian factors; GTSAM eliminates the sum.
There is one such factor for each keyframe, with the rows of all its sensors, and one for each place that it observes:
making a factor costs Python and GTSAM more than its numbers do, and eliminating many small ones more than few.
`custom_factor` gives the same measurements as GTSAM's nonlinear factors, whose callbacks linearise the `Measurements`
that the chain uses. Calibration that walks has a value at each keyframe, as in the chain.
"""

import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.faulty_intervals import resume
from rovgraph.inference.faulty_intervals import solve as solve_problem
from rovgraph.inference.gauss_newton import GatedMeasurements, Gates, GaussNewtonResult
from rovgraph.inference.graph.values import (
    calibration_key,
    insert_calibration,
    insert_state,
    key,
    key_name,
    state_at,
    states_from,
)
from rovgraph.kernels import motion_row as at
from rovgraph.kernels.motion_residual import motion_errors
from rovgraph.kernels.states import States
from rovgraph.model.calibration import TABLE, Belief
from rovgraph.model.config import Config
from rovgraph.model.config_sections import Water
from rovgraph.model.state import BIAS, DIMENSION, PLACE, PLACE_DIM, POSE, VELOCITY, Jacobians, State
from rovgraph.problem.calibration_roles import CalibrationRoles, unknowns
from rovgraph.problem.initial_conditions import StatePrior
from rovgraph.problem.layers import NewKnot, new_knots
from rovgraph.problem.measurements import (
    Measurements,
    Seen,
    cost_at_gate,
    gates_of,
    loss_threshold,
    measurement_cost,
    measurements_of,
    weights_of,
)
from rovgraph.problem.motion import COLUMNS, SCALES, biased, gravity
from rovgraph.problem.problem import Problem
from rovgraph.sensors.instruments import Instrument

Factor = gtsam.NonlinearFactor
ANYWHERE_M = 1e5  # sd of the prior of a place, about the origin


def priors(prior: StatePrior, beliefs: Mapping[str, Belief], unknowns: CalibrationRoles) -> list[Factor]:
    """Priors of the first keyframe and of the calibration variables."""
    state = prior.state
    R_nb, sigmas = state.R_nb[0], gtsam.noiseModel.Diagonal.Sigmas
    attitude = gtsam.noiseModel.Gaussian.Covariance(prior.covariance()[:3, :3])
    bias = gtsam.imuBias.ConstantBias(state.bias[0, :3], state.bias[0, 3:])
    return [
        gtsam.PoseRotationPrior3D(key(POSE, 0), gtsam.Rot3(R_nb), attitude),
        gtsam.PoseTranslationPrior3D(key(POSE, 0), state.p_n[0], sigmas(prior.p_sd)),
        gtsam.PriorFactorVector(key(VELOCITY, 0), state.v_n[0], sigmas(prior.v_sd)),
        gtsam.PriorFactorConstantBias(key(BIAS, 0), bias, sigmas(prior.bias_sd)),
        *(
            gtsam.PriorFactorVector(key(name), beliefs[name].mean, sigmas(np.full(b.variable.dim, b.sd)))
            for name, b in ((name, beliefs[name]) for name in unknowns.estimated)
        ),
    ]


def landmark_prior(number: int) -> Factor:
    """The prior of a place: so wide that it only determines a place all of whose sightings are rejected."""
    return gtsam.PriorFactorVector(
        key(PLACE, number), np.zeros(PLACE_DIM), gtsam.noiseModel.Isotropic.Sigma(PLACE_DIM, ANYWHERE_M)
    )


def drift(unknowns: CalibrationRoles, index: int, duration: float, knots: Sequence[NewKnot] = ()) -> list[Factor]:
    """The walk of calibration variables to a value from the one before, over ``duration`` [s], and ``knots`` there."""
    new = {knot.name: knot for knot in knots}
    begun = unknowns.begun_by(index) if index else ()
    return [_walk(unknowns, name, index, duration, new.get(name)) for name in begun]


def _walk(unknowns: CalibrationRoles, name: str, index: int, duration: float, knot: NewKnot | None) -> Factor:
    """Whitened, ``x' - mean = kept (x - mean)``; of a new knot, x is its neighbour."""
    mean, (kept, sd) = unknowns.fixed[name], unknowns.walked(name, duration)
    here, there = calibration_key(unknowns, name, index), calibration_key(unknowns, name, index - 1)
    if knot is not None and knot.neighbour is None:
        return gtsam.PriorFactorVector(here, mean, gtsam.noiseModel.Isotropic.Sigma(len(mean), knot.sd))
    if knot is not None and knot.neighbour == name:
        kept, sd = kept * knot.kept, np.hypot(kept * knot.sd, sd)
    elif knot is not None:
        kept, sd = np.array(knot.kept), np.array(knot.sd)
        there = calibration_key(unknowns, str(knot.neighbour), index)
    elif name not in unknowns.time_constants:
        return gtsam.BetweenFactorVector(there, here, 0.0 * mean, gtsam.noiseModel.Isotropic.Sigma(len(mean), sd))
    weight, origin = np.eye(len(mean)) / sd, gtsam.Values()
    origin.insert(here, np.zeros(len(mean)))
    origin.insert(there, np.zeros(len(mean)))
    off = (1.0 - kept) / sd * mean
    linear = gtsam.JacobianFactor(there, -kept * weight, here, weight, off, gtsam.noiseModel.Unit.Create(len(mean)))
    return gtsam.LinearContainerFactor(linear, origin)


def measurement_keys(block: Measurements, segment: NDArray[np.int64]) -> list[list[int]]:
    """Keys of every measurement, in the order of ``block.variables``.

    Parameters
    ----------
    block : n measurements
    segment : ndarray of int, shape (n,), index of the value that calibration which walks has at each
    """
    columns = [key(v) + (block.place if v == PLACE else block.keyframe) for v in block.instrument.model.state]
    columns += [key(v) + (segment if walk else 0 * segment) for v, walk in block.unknowns.walks.items()]
    rows: list[list[int]] = np.column_stack(columns).tolist()
    return rows


def measurement_factor(block: Measurements, segment: int) -> gtsam.CustomFactor:
    """A block of one measurement as a factor that calls back; ``segment`` as `measurement_keys` takes it."""
    index = int(block.keyframe[0])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: Any) -> Array:
        r, jacobians = block.linearize(with_places(block, state_at(values, index, segment, block.unknowns), values))
        if H is not None:
            for place, jacobian in enumerate(jacobians.values()):
                H[place] = jacobian[0]
        return np.asarray(-r[0])  # GTSAM's error is predicted minus measured

    return gtsam.CustomFactor(robust_noise(block.instrument), measurement_keys(block, np.array([segment]))[0], error)


def with_places(block: Measurements, state: State, values: gtsam.Values) -> State:
    """The state of each measurement's keyframe together with the place that is seen, where one is."""
    return block.with_places(state, {n: values.atVector(key(PLACE, n)) for n in set(block.place.tolist()) if n >= 0})


def robust_noise(instrument: Instrument) -> gtsam.noiseModel.Base:
    """The configuration's losses as GTSAM's noise models, for factors that are already whitened."""
    dim, loss = instrument.model.dim, instrument.loss
    unit, k = gtsam.noiseModel.Unit.Create(dim), loss_threshold(loss, dim)
    if loss == "none":
        return unit
    kinds = gtsam.noiseModel.mEstimator
    robust = kinds.Huber.Create(k) if loss == "huber" else kinds.Cauchy.Create(k)
    return gtsam.noiseModel.Robust.Create(robust, unit)


_ENDS = [6, 9, 15, 21, 24]  # of pose, velocity, bias of two keyframes side by side


def motion_factor(problem: Problem, k: int, unknowns: CalibrationRoles, index: int) -> gtsam.NonlinearFactor:
    """GTSAM's own factor of the motion to keyframe k, or one of an IMU whose scale may be off, or of coasting.

    ``index`` is that of the value which calibration that walks has there.
    """
    if problem.coasted[k] or not np.isnan(problem.motions[k - 1, at.LATITUDE]):
        keys = {name: calibration_key(unknowns, name, index) for name in SCALES if name in unknowns.walks}
        return custom_factor(problem, k, unknowns.fixed, {} if problem.coasted[k] or not len(problem.scales) else keys)
    if len(problem.scales):
        keys = {name: calibration_key(unknowns, name, index) for name in SCALES if name in unknowns.walks}
        return custom_factor(problem, k, unknowns.fixed, keys)
    pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j = _keys(k)
    motion = preintegrated(problem.motions[k - 1], problem.steps(k))
    return gtsam.CombinedImuFactor(pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j, motion)


def preintegrated(motion: Array, steps: Array) -> gtsam.PreintegratedCombinedMeasurements:
    """GTSAM's motion, integrated from the same steps."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedD(float(motion[at.GRAVITY]))
    acc, gyr, acc_walk, gyr_walk, integration = motion[at.NOISE : at.GRAVITY].tolist()
    params.setAccelerometerCovariance(np.eye(3) * acc**2)
    params.setGyroscopeCovariance(np.eye(3) * gyr**2)
    params.setBiasAccCovariance(np.eye(3) * acc_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * gyr_walk**2)
    params.setIntegrationCovariance(np.eye(3) * integration**2)
    if (earth_rate_n := motion[at.EARTH_RATE : at.LATITUDE]).any():
        params.setOmegaCoriolis(earth_rate_n)
    bias = motion[at.BIAS : at.NOISE]
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    for step in steps:
        pim.integrateMeasurement(step[2:5], step[5:8], step[1])
    return pim


def custom_factor(problem: Problem, k: int, fixed: Mapping[str, Array], keys: Mapping[str, int]) -> gtsam.CustomFactor:
    """The residual of `rovgraph.kernels.motion_residual` as a factor, with the IMU's scales.

    Parameters
    ----------
    problem, k : the motion to keyframe k
    fixed : name -> ndarray, shape (3,), values of the scales that are not estimated
    keys : of those that are
    """
    symbols, W, row = _keys(k), problem.weights[k - 1], problem.motions[k - 1 : k]
    S = problem.scales[k - 1] if len(problem.scales) else None

    def state(values: gtsam.Values, pose: int, velocity: int, bias: int) -> States:
        at_, v_n, b = values.atPose3(pose), values.atVector(velocity), values.atConstantBias(bias).vector()
        scales = {name: values.atVector(keys[name]) if name in keys else fixed[name] for name in SCALES}
        one = State(at_.rotation().matrix()[None], at_.translation()[None], v_n[None], b[None], scales)
        seen = one if S is None else biased(one, S[None])
        # copies: GTSAM's arrays may be read-only, which kernels do not take
        return States(*(np.array(a, order="C") for a in (seen.R_nb, seen.p_n, seen.v_n, seen.bias)))

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        r, A_i, A_j = np.empty((1, 15)), np.empty((1, 15, 15)), np.empty((1, 15, 15))
        ends = state(values, symbols[0], symbols[1], symbols[4]), state(values, symbols[2], symbols[3], symbols[5])
        motion_errors(row, *ends, r, A_i, A_j)
        if H is not None:
            J = W @ np.hstack([A_i[0], A_j[0]])
            pose_i, velocity_i, bias_i, pose_j, velocity_j, bias_j = np.split(J, _ENDS, axis=1)
            for place, part in enumerate((pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j)):
                H[place] = part
            for place, name in enumerate(keys, 6):  # they move both states as a bias would, and not the bias itself
                assert S is not None
                H[place] = W[:, :9] @ A_i[0, :9, 9:] @ S[:, COLUMNS[name]]
        return np.asarray(W @ r[0])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(15), [*symbols, *keys.values()], error)


def _keys(k: int) -> list[int]:
    """In the order of GTSAM's factor."""
    i = k - 1
    return [key(POSE, i), key(VELOCITY, i), key(POSE, k), key(VELOCITY, k), key(BIAS, i), key(BIAS, k)]


_unit = cache(gtsam.noiseModel.Unit.Create)


class RowPlaces:
    """Where each measurement's rows lie among those of all, sorted by keyframe and place.

    Parameters
    ----------
    blocks : sensor -> Measurements, at least one; either of places or of none
    value : index of the value that calibration which walks has at each keyframe
    """

    def __init__(self, blocks: Mapping[str, Measurements], value: NDArray[np.int64]) -> None:
        every, self._sensors = list(blocks.values()), list(blocks)
        walks = {name: walk for block in every for name, walk in block.unknowns.walks.items()}
        touched = {variable for block in every for variable in block.variables}
        sizes = DIMENSION | {PLACE: PLACE_DIM} | {name: TABLE[name].dim for name in walks}
        self._sizes = {variable: size for variable, size in sizes.items() if variable in touched}
        keyframe = np.concatenate([block.keyframe for block in every])
        place = np.concatenate([block.place for block in every])
        dims = np.concatenate([np.full(len(block), block.z.shape[1]) for block in every])
        order = np.lexsort((place, keyframe))
        first = np.empty_like(dims)
        first[order] = np.cumsum(dims[order]) - dims[order]
        self._count = int(dims.sum())
        first_rows = np.split(first, np.cumsum([len(block) for block in every])[:-1])
        self._rows = [f[:, None] + np.arange(block.z.shape[1]) for f, block in zip(first_rows, every, strict=True)]
        other = np.diff(keyframe[order], prepend=-1).astype(bool) | np.diff(place[order], prepend=-2).astype(bool)
        begun = order[np.flatnonzero(other)]  # the first measurement of each factor
        index = dict.fromkeys(DIMENSION, keyframe) | {PLACE: place}
        index |= {v: value[keyframe] if walk else 0 * keyframe for v, walk in walks.items()}
        self._keys: list[list[int]] = np.column_stack([key(v) + index[v][begun] for v in self._sizes]).tolist()
        self._of_factor = [slice(a, b) for a, b in pairwise([*first[begun].tolist(), self._count])]

    def push(self, graph: gtsam.GaussianFactorGraph, linear: Mapping[str, tuple[Array, Jacobians]]) -> None:
        """Add the factors of all keyframes that have measurements.

        Parameters
        ----------
        graph : to add to
        linear : sensor -> innovations and Jacobians of its block, as `Measurements.weighted` returns them
        """
        b = np.zeros(self._count)
        A = {v: np.zeros((self._count, size)) for v, size in self._sizes.items()}
        for rows, (r, H) in zip(self._rows, (linear[sensor] for sensor in self._sensors), strict=True):
            b[rows] = r
            for v, h in H.items():
                A[v][rows] = h
        for keys, of_factor in zip(self._keys, self._of_factor, strict=True):
            terms = [(k, a[of_factor]) for k, a in zip(keys, A.values(), strict=True)]
            # a conditional is a Jacobian factor, and the only one the bindings make of more than three keys
            graph.push_back(gtsam.GaussianConditional(terms, 1, b[of_factor], _unit(of_factor.stop - of_factor.start)))


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
    unknowns: CalibrationRoles
    index: NDArray[np.int64]

    @property
    def count(self) -> int:
        """Number of keyframes."""
        return len(self.index)

    @cached_property
    def rows(self) -> list[RowPlaces]:
        """Of the measurements; those of places touch a variable more."""
        kinds = ({s: b for s, b in self.blocks.items() if (s == "place") == seen} for seen in (False, True))
        return [RowPlaces(kind, self.index) for kind in kinds if kind]

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

    def measured(self) -> dict[str, GatedMeasurements]:
        """Times, dimension and cost at the gate of every sensor's measurements."""
        return {s: GatedMeasurements(b.time, b.z.shape[1], cost_at_gate(b.instrument)) for s, b in self.blocks.items()}

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
    wanted: CalibrationRoles | None = None,
) -> DiveGraph:
    """Assemble the graph of a dive; calibration that walks has a value at each keyframe.

    What is estimated is ``wanted``, or else what is believed to be.
    """
    index = np.arange(len(problem))
    wanted = wanted or unknowns(beliefs, problem.used)
    factors = _others(problem, prior, config.water, beliefs, wanted, index)
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
    water: Water,
    beliefs: Mapping[str, Belief],
    wanted: CalibrationRoles,
    index: NDArray[np.int64],
) -> list[gtsam.NonlinearFactor]:
    """Priors, motions and walks."""
    factors = priors(prior, beliefs, wanted)
    factors += [motion_factor(problem, k, wanted, int(index[k])) for k in range(1, len(problem))]
    begun = np.flatnonzero(np.diff(index, prepend=-1))
    for before, after in pairwise(begun.tolist()):
        knots = new_knots(problem, after, water)
        factors += drift(wanted, int(index[after]), float(problem.time[after] - problem.time[before]), knots)
    return factors


def make_values(graph: DiveGraph, states: State, calibration: Mapping[str, Array] | None = None) -> gtsam.Values:
    """GTSAM values of the keyframes' states, calibration at its means unless given; without places."""
    values = gtsam.Values()
    for i in range(graph.count):
        insert_state(values, i, states.at([i]))
    for segment in range(int(graph.index[-1]) + 1) if any(graph.unknowns.walks.values()) else (0,):
        insert_calibration(values, calibration or graph.unknowns.fixed, graph.unknowns, segment)
    return values


def solve(
    graph: DiveGraph, values: gtsam.Values, known: GaussNewtonResult[gtsam.Values] | None = None
) -> GaussNewtonResult[gtsam.Values]:
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
