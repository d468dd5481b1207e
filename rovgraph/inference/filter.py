"""The error-state Kalman filter: `FilterEngine.step` takes one interval, offline and live.

The error has 15 components (attitude, position, velocity, biases) and those of the calibration that is estimated
(`ErrorLayout`). Considered variables receive no correction; their part of the error is carried with the estimate
(`Gaussian.B`), and in Jacobians their columns follow those of the error. Motion, measurement equations, noise, losses,
gates and prior are those of the smoother, with one difference: every measurement is linearised once, when it arrives.

Per interval, the measurements between two keyframes correct the earlier one, as they do in the smoother; the IMU
carries the state to the next keyframe; the measurements there correct it.

A poorly known attitude, as after a silence of all sensors, is first turned to where gravity and the compasses fit. A
heading that may be off by half a right angle cannot be corrected along a tangent: a magnetic field that turns by forty
degrees there grows by a fifth, which the filter would take for hard iron and tilt. The turn is not a measurement: the
covariance stays, and gravity and compasses correct the filter afterwards as usual. It is an iterated Kalman filter
(Bell and Cathey 1993), for the attitude alone, started where it can converge.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import (
    Array,
    exp_rotation,
    identity,
    level_from_force,
    matrix_from_rpy,
    rpy_from_matrix,
    skew,
    transpose,
)
from rovgraph.inference.filter_step import (
    FilterGates,
    FilterRun,
    FilterStep,
    Gaussian,
    Met,
    Transition,
    calibration_vector,
    state_vector,
)
from rovgraph.inference.remembered_places import (
    RememberedPlace,
    columns,
    common,
    extended,
    moved,
    nearest,
    seen_at,
    with_another,
    without_oldest,
)
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels import motion_row
from rovgraph.kernels.correction import GivenRows
from rovgraph.kernels.error_coordinates import ErrorColumns as Coordinates
from rovgraph.kernels.filter_state import FilterModel, FilterState, local_coordinates, move_estimate
from rovgraph.kernels.filtering import (
    Filtered,
    Interval,
    Intervals,
    Taken,
    attitude_variances_of,
    filter_intervals,
    take_interval,
)
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.measurement_row import MeasuredRows
from rovgraph.model.calibration import LAYOUT, TABLE, WATER_LAYER, calibration_size
from rovgraph.model.state import DIMENSION, PLACE, PLACE_DIM, Jacobians
from rovgraph.problem.calibration_roles import unknowns
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.layers import NewKnot, new_knots, window_changes
from rovgraph.problem.measurements import KeyframeRows, Measurements, compiled, sensor_table
from rovgraph.problem.problem import Index, Problem
from rovgraph.sensors import SENSORS, CompiledModel, SensorModel, WaterVelocity
from rovgraph.sensors.instruments import HEADING_STREAMS, Instrument

POORLY_KNOWN = np.deg2rad([4.0, 10.0]) ** 2  # variances of tilt and heading from which a tangent does harm [rad^2]
STEP, REACH_SD = np.deg2rad(3.0), 3.0  # of the headings that are tried
AT_REST = 0.2  # share of gravity by which a mean specific force may differ from it and still show where down is

Linearize = Callable[[Gaussian, Problem, Index], tuple[Array, Array]]


def poorly_known(known: Gaussian) -> bool:
    """Whether tilt or heading is hardly known."""
    tilt, heading = attitude_variances_of(known.x, known.P)
    return bool(tilt > POORLY_KNOWN[0] or heading > POORLY_KNOWN[1])


def aligned(
    known: Gaussian, problem: Problem, k: int, between: slice, linearize: Linearize, gravity: float
) -> Gaussian:
    """The keyframe before keyframe k, levelled and turned to its compasses where it is `poorly_known`.

    Parameters
    ----------
    known : its estimate
    problem, between : the dive, and its measurements between the two
    linearize : from an estimate and measurements to whitened innovations and Jacobians
    gravity : [m/s^2]
    """
    tilt, heading = attitude_variances_of(known.x, known.P)
    if tilt > POORLY_KNOWN[0]:
        known = with_attitude(known, _levelled(known, problem, k, gravity))
    which = [n for n, sensor in enumerate(problem.sensors) if sensor in HEADING_STREAMS]
    compasses = between.start + np.flatnonzero(np.isin(problem.which[between], which))
    if len(compasses) and heading > POORLY_KNOWN[1]:
        known = with_attitude(known, _towards(known, problem, compasses, linearize))
    return known


def with_attitude(known: Gaussian, R_nb: Array) -> Gaussian:
    """The same with another attitude, shape (3, 3); the covariance of attitude stays along the body's axes.

    A velocity that is better known along these axes turns with them.
    """
    x, columns = known.x.copy(), [0, 1, 2, 6, 7, 8]
    before, v_n, basis = known.state.R_nb[0], known.state.v_n[0], np.eye(len(known.P))
    basis[3:6, 3:6] = R_nb.T @ before  # position stays along n's
    along_body = np.concatenate([skew(v_n) @ before, np.eye(3)], axis=1)
    if np.trace(along_body @ known.P[np.ix_(columns, columns)] @ along_body.T) < np.trace(known.P[6:9, 6:9]):
        basis[6:9, 6:9] = turn = R_nb @ before.T
        x[12:15] = turn @ v_n
    x[:9] = R_nb.ravel()
    B = basis @ known.B if known.B.size else known.B
    return replace(known, x=x, P=basis @ known.P @ basis.T, B=B)


def _levelled(known: Gaussian, problem: Problem, k: int, gravity: float) -> Array:
    """The attitude whose down is that of the interval's mean specific force, where that can be gravity's."""
    R_nb: Array = known.state.R_nb[0]
    if problem.bridged[k]:
        return R_nb
    motion = problem.motions[k - 1]
    excess = known.state.bias[0, :3] - motion[motion_row.BIAS : motion_row.BIAS + 3]
    force_b = motion[motion_row.VELOCITY] / motion[motion_row.DURATION] - excess
    if abs(float(np.linalg.norm(force_b)) / gravity - 1.0) > AT_REST:
        return R_nb
    return matrix_from_rpy([*level_from_force(force_b), rpy_from_matrix(R_nb)[2]])


def _towards(known: Gaussian, problem: Problem, compasses: Index, linearize: Linearize) -> Array:
    """The attitude with the heading that compasses make likeliest.

    Headings all around the believed one are tried, calibration and tilt being as sure as they are.
    """
    R_nb = known.state.R_nb[0]
    size = len(known.P) - PLACE_DIM * len(known.places)
    P = known.P[:size, :size]
    by_heading = P[:, :3] @ R_nb[2]
    variance = float(R_nb[2] @ by_heading[:3])
    reach = min(REACH_SD * np.sqrt(variance), np.pi)
    angles = np.linspace(-reach, reach, 2 * int(np.ceil(reach / STEP)) + 1)
    turned = exp_rotation(np.column_stack([0.0 * angles, 0.0 * angles, angles])) @ R_nb
    rows = [linearize(replace(known, x=np.concatenate([R.ravel(), known.x[9:]])), problem, compasses) for R in turned]
    misfit, by = np.array([r for r, _ in rows]), np.array([H[:, :size] for _, H in rows])
    S = by @ (P - np.outer(by_heading, by_heading) / variance) @ transpose(by) + identity(misfit.shape[1])
    nis = (misfit * np.linalg.solve(S, misfit[..., None])[..., 0]).sum(axis=1)
    likeliest = (nis + np.linalg.slogdet(S)[1] + angles**2 / variance).argmin()
    return np.asarray(turned[likeliest])


# the variable that each instrument sees directly: its model is linear in it, and depends on none that follows
SEEN = {s.name: s.linear_in for s in SENSORS.values() if s.linear_in is not None}


def seen_model(model: SensorModel) -> CompiledModel:
    """The model that is linear in what its instrument sees: its own, but for a current, which shows in drag."""
    return WaterVelocity() if SEEN[model.sensor] == "current" else cast(CompiledModel, model)


class ErrorLayout:
    """Layout of the error of a state.

    Parameters
    ----------
    estimated, considered : names of calibration variables
    instruments : the sensors in use, by stream

    Attributes
    ----------
    columns : variable -> slice of the error, or of a Jacobian's columns
    size, width : length of the error, and columns of a Jacobian
    column : ndarray of int, shape (15 + C,), place of each component of state and calibration vector in the
        Jacobian, -1 where it has none
    coordinates : as kernels take them
    """

    def __init__(
        self, estimated: Sequence[str], considered: Sequence[str], instruments: Mapping[str, Instrument]
    ) -> None:
        sizes = DIMENSION | {name: TABLE[name].dim for name in (*estimated, *considered)}
        ends = np.cumsum(list(sizes.values())).tolist()
        self.columns = {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
        self.width: int = ends[-1]
        self.size: int = self.width - sum(TABLE[name].dim for name in considered)
        self.column: NDArray[np.int64] = np.full(MOTION + calibration_size(), -1)
        self.column[:MOTION] = np.arange(MOTION)
        for name, part in LAYOUT.items():
            if name in self.columns:
                target = self.columns[name]
                self.column[MOTION + part.start : MOTION + part.stop] = np.arange(target.start, target.stop)

        self.coordinates = self._coordinates(instruments)

    def _coordinates(self, instruments: Mapping[str, Instrument]) -> Coordinates:
        """Columns of a full Jacobian, instruments and what they see, their numbers, rows of a basis."""
        estimated = np.flatnonzero((self.column >= 0) & (self.column < self.size))
        columns = estimated[np.argsort(self.column[estimated])]
        names = {name for name, part in self.columns.items() if part.stop <= self.size}
        seen_models = {v: seen_model(instruments[s].model) for s, v in SEEN.items() if s in instruments and v in names}
        models = [(model, self.columns[variable]) for variable, model in seen_models.items()]
        seen = [(model.kind, model.dim, part.start) for model, part in models]
        params = np.zeros((len(models), max((model.packed.shape[1] for model, _ in models), default=0)))
        for row, (model, _) in zip(params, models, strict=True):
            row[: model.packed.shape[1]] = model.packed[0]
        rows = np.concatenate([np.arange(6), *(np.r_[part] for _, part in models)]).astype(np.int64)
        return Coordinates(columns, np.array(seen, np.int64).reshape(-1, 3), params, rows)

    def matrix(self, H: Jacobians) -> Array:
        """Jacobians by variable as one, shape (n, dim, width); what is neither estimated nor considered is left out."""
        out = np.zeros((*next(iter(H.values())).shape[:2], self.width))
        for name, jacobian in H.items():
            if name in self.columns:
                out[..., self.columns[name]] = jacobian
        return out


ORIGIN = np.zeros(PLACE_DIM)  # where a place is put to begin with
_EXACT = np.zeros((0, 6, 6))  # of an IMU without scale errors
_NO_MOTION, _NO_COVARIANCE = np.zeros(0), np.zeros((0, 0))
_NO_STATE = FilterState(_NO_MOTION, _NO_MOTION, *[np.zeros((0, 0))] * 3)  # where none is asked for


def _state(known: Gaussian) -> FilterState:
    """A copy for kernels, which write to it."""
    return FilterState(known.x.copy(), known.c.copy(), known.P.copy(), known.B.copy(), known.L)


def _room(known: Gaussian) -> FilterState:
    """Arrays for an estimate of the same size."""
    x, c, P, B = (np.empty(array.shape) for array in (known.x, known.c, known.P, known.B))
    return FilterState(x, c, P, B, known.L)


def _estimate(known: FilterState, places: tuple[RememberedPlace, ...] = ()) -> Gaussian:
    return Gaussian(known.x, known.c, known.P, places, known.B, known.L)


class FilterEngine:
    """Extended Kalman filter without a state of its own: the estimate is argument and result.

    Parameters
    ----------
    initial : sensors, configuration and prior
    considers : False takes what is considered as exact

    Attributes
    ----------
    beliefs, unknowns : priors of the calibration, and what of it is estimated and considered
    layout : of the error
    """

    def __init__(self, initial: InitialConditions, considers: bool = True) -> None:
        self.initial = initial
        self.beliefs = initial.beliefs
        self.unknowns = unknowns(self.beliefs, initial.instruments)
        if not considers:
            self.unknowns = replace(self.unknowns, considered=())
        self.layout = ErrorLayout(self.unknowns.estimated, self.unknowns.considered, initial.instruments)
        self._wide = self.unknowns.estimating(self.unknowns.considered)  # all that has a place in the error
        self._gravity = initial.gravity
        walk = np.zeros((3, self.layout.size))
        for name, sd in self.unknowns.walks.items():
            walk[0, self.layout.columns[name]] = sd**2
        for name, seconds in self.unknowns.time_constants.items():
            walk[1, self.layout.columns[name]] = 1.0 / seconds
            walk[2, self.layout.columns[name]] = self.unknowns.fixed[name]
        instruments = initial.instruments
        self._given = {  # linearised outside the kernels
            s for s, i in instruments.items() if not compiled(i) or s == PLACE
        }
        sensors = sensor_table(instruments, sorted(self._given))
        self._model = FilterModel(sensors, self.layout.column, self.layout.coordinates, walk, initial.gravity)
        self._no_rows = GivenRows(np.empty(0), np.empty((0, self.layout.width)))
        self._index = {sensor: k for k, sensor in enumerate(instruments)}
        self._outside = np.array([sensor in self._given for sensor in instruments])

    def start(self) -> Gaussian:
        """The prior: the smoother's."""
        prior, layout = self.initial.prior, self.layout
        sd = np.zeros(layout.width)
        for name in self._wide.estimated:
            sd[layout.columns[name]] = self.beliefs[name].first_sd
        P = np.diag(sd[: layout.size] ** 2)
        P[:15, :15] = prior.covariance()
        B, L = np.zeros((layout.size, layout.width - layout.size)), np.diag(sd[layout.size :])
        return Gaussian(state_vector(prior.state), calibration_vector(self.unknowns.fixed), P, (), B, L)

    def step(self, problem: Problem, k: int, before: Gaussian, gates: FilterGates, wholly: bool = False) -> FilterStep:
        """Take the interval that ends with keyframe k.

        Parameters
        ----------
        problem : the dive
        before : the keyframe before, or at the first `start`
        gates : renewed in place
        wholly : return the transition to the keyframe, too
        """
        assert len(before.L) == self.layout.width - self.layout.size  # kernels do not check where they write
        here, met = self._first_here(problem, k), Met.of(problem, k, len(before.c))
        if self._knows_all(problem, k, before):
            return self._step(problem, k, before, gates, here, met, wholly)
        departed = transition = None
        predicted = before
        if k > 0:
            departed = self._align(before, problem, k)
            departed = self.correct(departed, problem, slice(met.begin, here), gates, met)
            transition = self._predict_changed(problem, k, departed)
            predicted = transition.predicted
        filtered = self.correct(predicted, problem, slice(here, met.end), gates, met)
        return FilterStep(filtered, met, departed, transition)

    def _knows_all(self, problem: Problem, k: int, before: Gaussian) -> bool:
        """Whether kernels can take the whole interval that ends with keyframe k."""
        if k == 0 or before.places or poorly_known(before) or self._changes(problem, k) or self.new_knots(problem, k):
            return False
        return not self._outside[problem.which[slice(*problem.measured_in(k))]].any()

    def _step(
        self, problem: Problem, k: int, before: Gaussian, gates: FilterGates, here: int, met: Met, wholly: bool
    ) -> FilterStep:
        """`step` by one call of a kernel."""
        between, departed = here - met.begin, _room(before) if wholly else _NO_STATE
        predicted = _room(before) if wholly else _NO_STATE._replace(x=np.empty(21), c=np.empty(len(before.c)))
        interval = self._interval(problem, slice(met.begin, met.end), k, between)
        known, out = self._take_interval(before, interval, gates, departed, predicted)
        for some, of in ((slice(0, between), before), (slice(between, None), predicted)):
            met.x[some], met.c[some] = of.x, of.c
        met.nis[:], met.weight[:] = out.nis, out.weight
        way = (_estimate(departed), Transition(out.F, out.Q, _estimate(predicted))) if wholly else (None, None)
        return FilterStep(_estimate(known), met, *way)

    def _interval(self, problem: Problem, some: slice | Index, k: int = 0, between: int = 0) -> Interval:
        """Measurements, the first ones before the motion to keyframe k, if there is one, as kernels take them."""
        motion, covariance = (problem.motions[k - 1], problem.covariances[k - 1]) if k else (_NO_MOTION, _NO_COVARIANCE)
        scale = problem.scales[k - 1] if k and len(problem.scales) else _EXACT[:, 0]
        return Interval(motion, covariance, scale, problem.measured(some), between, *self._no_rows)

    def _take_interval(
        self,
        before: Gaussian,
        interval: Interval,
        gates: FilterGates | None,
        departed: FilterState = _NO_STATE,
        predicted: FilterState = _NO_STATE,
    ) -> tuple[FilterState, Taken]:
        """The estimate after what a kernel makes of an interval, gates renewed in place."""
        known, since, m, n = _state(before), self._since(gates or {}), len(interval.measured.which), len(before.P)
        of_motion = (n, n) if len(interval.motion) else (0, 0)
        places = np.zeros(n - self.layout.size)
        out = Taken(departed, predicted, np.empty(of_motion), np.empty(of_motion), np.empty(m), np.empty(m), places)
        take_interval(known, interval, self._model, since, gates is not None, out)
        if gates is not None:
            self._renew(gates, since)
        return known, out

    def _first_here(self, problem: Problem, k: int) -> int:
        """The first measurement at keyframe k of those of the interval that ends with it."""
        begin, end = problem.measured_in(k)
        return end - int(np.count_nonzero(problem.keyframe[begin:end] == k))

    def run(self, problem: Problem, begin: int, end: int, before: Gaussian, gates: FilterGates) -> FilterRun:
        """Take intervals of a dive as `step` does, as far as kernels can.

        Parameters
        ----------
        problem : the dive
        begin, end : the intervals, the first beyond 0
        before : the keyframe before them, without places
        gates : renewed in place
        """
        assert len(problem.covariances) == len(problem.motions)  # kernels do not check where they read
        known, since = _state(before), self._since(gates)
        rows = slice(int(problem.taken[begin - 1]), int(problem.taken[end - 1]))
        taken, first = problem.taken[begin:end] - rows.start, problem.first[begin:end] - rows.start
        k, m, C, size = end - begin, rows.stop - rows.start, len(before.c), self.layout.size
        shapes = (k, 21), (k, C), (k, 21), (k, C), (k, MOTION, MOTION), (k, size), (m,), (m,)
        out = Filtered._make(np.empty(shape) for shape in shapes)
        some = slice(begin - 1, end - 1)
        motions, covariances, scales = problem.motions[some], problem.covariances[some], problem.scales[some]
        intervals = Intervals(motions, covariances, scales, np.append(0, taken), first, POORLY_KNOWN)
        measured = problem.measured(rows)
        done = filter_intervals(known, intervals, measured, self._model, since, out, take_interval)
        self._renew(gates, since)
        m = int(taken[done - 1]) if done else 0
        found = Filtered._make([*(array[:done] for array in out[:-2]), out.nis[:m], out.weight[:m]])
        interval = np.arange(done).repeat(np.diff(taken[:done], prepend=0))
        return FilterRun(before, _estimate(known), found, interval, np.arange(m) < first[interval])

    def predict(self, problem: Problem, k: int, before: Gaussian) -> Transition:
        """Keyframe k from the one before, by the IMU alone; calibration walks."""
        known, out = self._take_interval(before, self._interval(problem, slice(0, 0), k), None)
        return Transition(out.F, out.Q, _estimate(known, before.places))

    def correct(
        self, before: Gaussian, problem: Problem, some: slice, gates: FilterGates | None, met: "Met | None" = None
    ) -> Gaussian:
        """The estimate corrected by measurements of its keyframe, places last; without gates all count.

        ``met`` receives how they were processed.
        """
        index = np.arange(some.start, some.stop)
        seen = problem.number[some] >= 0
        known = self._correct(before, problem, index[~seen], gates, met) if not seen.all() else before
        for row in index[seen].tolist():
            known = self._see(known, problem, row, met)
        return known

    def linearize(self, known: Gaussian, problem: Problem, index: Index) -> tuple[Array, Array]:
        """Whitened innovations, shape (m,), and Jacobians, shape (m, width), of measurements of no places."""
        r, H = [np.empty(0)], [np.empty((0, self.layout.width))]
        for row in index.tolist():
            if problem.sensors[problem.which[row]] in self._given:
                own_r, own_H = self._of_model(known, problem, row)
            else:
                own_r, own_H = self.rows(problem, np.array([row])).linearize(known.x, known.c)
            r.append(own_r)
            H.append(own_H)
        return np.concatenate(r), np.vstack(H)

    def considered_share(self, known: Gaussian, problem: Problem, row: int) -> Array:
        """Variance of an innovation from considered variables, in units of the rest of it; shape (dim,).

        Gates and gains depend on P alone, so innovations of a consistent filter vary by as much more.
        """
        if not len(known.L):
            return np.zeros(problem.dims[problem.which[row]])
        _, H = self.linearize(known, problem, np.array([row]))
        estimated, considered = H[:, : self.layout.size], H[:, self.layout.size : self.layout.width]
        B, P = known.B[: self.layout.size], known.P[: self.layout.size, : self.layout.size]
        by_considered = estimated @ B + considered @ known.L
        return np.asarray(np.sum(by_considered**2, axis=1) / (np.sum(estimated @ P * estimated, axis=1) + 1.0))

    def knows(self, sensor: str) -> bool:
        """Whether the kernels have a sensor's equation."""
        return sensor not in self._given

    def rows(self, problem: Problem, index: Index) -> KeyframeRows:
        """Measurements of one keyframe whose equations the kernels have."""
        layout, measured = self.layout, problem.measured(index)
        return KeyframeRows(measured, self._model.sensors, layout.column, layout.width, self._gravity)

    def measurements(self, problem: Problem, index: Index) -> Measurements:
        """Measurements of one sensor, with the filter's unknowns."""
        instrument = self.initial.instruments[problem.sensors[problem.which[index[0]]]]
        return Measurements(problem, index, instrument, self._gravity, self._wide)

    def retract(self, known: Gaussian, delta: Array, P: Array, B: Array | None = None) -> Gaussian:
        """The estimate that lies ``delta``, shape (d,), away; P, and B (None = its own), are about the old one."""
        state = _state(replace(known, P=P, B=known.B if B is None else B))
        move_estimate(state, delta, self.layout.coordinates)
        return _estimate(state, moved(known.places, delta[self.layout.size :]))

    def local(self, some: Gaussian, other: Gaussian) -> tuple[Array, Array]:
        """The error, shape (size,), that leads from one estimate to another, and the basis, shape (size, size).

        The basis takes an error about ``other`` over to ``some``.
        """
        size = self.layout.size
        delta, basis = np.empty(size), np.eye(size)
        local_coordinates(some.x, some.c, other.x, other.c, self.layout.coordinates, delta, basis)
        return delta, basis

    def considering(self, known: Gaussian, other: Gaussian) -> Gaussian:
        """An estimate with considered variables exact, with their effect taken from another estimate close by."""
        size, (_, basis) = self.layout.size, self.local(known, other)
        ours, theirs, _ = common(known.places, other.places)
        B = np.zeros((len(known.P), len(other.L)))
        B[columns(size, ours)] = extended(basis, size + PLACE_DIM * len(ours)) @ other.B[columns(size, theirs)]
        return replace(known, B=B, L=other.L)

    def next_window(self, problem: Problem, k: int) -> int:
        """The first keyframe from k on at which knots of the water's current are new, or how many keyframes there are.

        The kernels take the intervals before it.
        """
        if WATER_LAYER not in self.initial.instruments:
            return len(problem)
        changes = window_changes(problem)
        return int(np.append(changes, len(problem))[changes.searchsorted(k)])

    def changes_in(self, begin: float, end: float) -> list[str]:
        """Calibration variables whose value changes after one time and up to another [s]."""
        return [n for n in self.unknowns.estimated for time in self.beliefs[n].changes if begin < time <= end]

    def _changes(self, problem: Problem, k: int) -> list[str]:
        """Calibration variables whose value changes between keyframe k and the one before."""
        return self.changes_in(float(problem.time[k - 1]), float(problem.time[k]))

    def _changed(self, known: Gaussian, problem: Problem, k: int) -> Gaussian:
        """The keyframe before keyframe k, with the variance of variables whose value changes up to it."""
        names = self._changes(problem, k)
        if not names:
            return known
        P = known.P.copy()
        for name in names:
            index = np.arange(len(P))[self.layout.columns[name]]
            P[index, index] += self.beliefs[name].sd ** 2
        return replace(known, P=P)

    def new_knots(self, problem: Problem, k: int) -> list[NewKnot]:
        """Knots of the water's current that are new at keyframe k."""
        if WATER_LAYER not in self.initial.instruments:
            return []
        knots = new_knots(problem, k, self.initial.config.water)
        return [knot for knot in knots if knot.name in self.layout.columns]

    def _predict_changed(self, problem: Problem, k: int, departed: Gaussian) -> Transition:
        """`predict`, of variables whose value changes, and of knots that take the place of others."""
        known, knots = self._changed(departed, problem, k), self.new_knots(problem, k)
        if not knots:
            return self.predict(problem, k, known)
        n, mean = len(known.P), self.unknowns.fixed
        S, added, c = np.eye(n), np.zeros((n, n)), known.c.copy()
        for name, neighbour, kept, sd in knots:
            place, other = self.layout.columns[name], name if neighbour is None else neighbour
            by = self.layout.columns[other]
            c[LAYOUT[name]] = mean[name] + kept * (c[LAYOUT[other]] - mean[other])
            of_other = kept**2 * added[by, by]
            S[place], added[place], added[:, place] = kept * S[by], kept * added[by], kept * added[:, by]
            added[place, place] = of_other + sd**2 * np.eye(place.stop - place.start)
        moved = replace(known, c=c, P=S @ known.P @ S.T + added, B=S @ known.B if known.B.size else known.B)
        after = self.predict(problem, k, moved)
        return replace(after, F=after.F @ S, Q=after.Q + after.F @ added @ after.F.T)

    def _align(self, known: Gaussian, problem: Problem, k: int) -> Gaussian:
        """The keyframe before keyframe k; where its attitude is poorly known, with the one it is corrected to."""
        if not poorly_known(known):
            return known
        rows = slice(problem.measured_in(k)[0], self._first_here(problem, k))
        near = aligned(known, problem, k, rows, self.linearize, self._gravity)
        after = self.correct(near, problem, rows, None)
        return with_attitude(known, after.state.R_nb[0])

    def _correct(
        self, before: Gaussian, problem: Problem, index: Index, gates: FilterGates | None, met: "Met | None"
    ) -> Gaussian:
        """The estimate corrected by measurements of no places."""
        which = problem.which[index]
        given = [self._of_model(before, problem, row) for row in index[self._outside[which]].tolist()]
        interval = self._interval(problem, index)
        if given:
            interval = interval._replace(
                given_r=np.concatenate([r for r, _ in given]), given_H=np.vstack([H for _, H in given])
            )
        known, out = self._take_interval(before, interval, gates)
        if met is not None:
            met.put(index, before, out.nis, out.weight)
        return _estimate(known, moved(before.places, out.places) if len(out.places) else before.places)

    def _since(self, gates: FilterGates) -> Array:
        """Since when each sensor is left out, nan where it is not [s]."""
        return np.array([gates.get(sensor, np.nan) for sensor in self._index])

    def _renew(self, gates: FilterGates, since: Array) -> None:
        gates.clear()
        gates.update((s, t) for s, t in zip(self._index, since.tolist(), strict=True) if t == t)

    def _of_model(self, known: Gaussian, problem: Problem, row: int) -> tuple[Array, Array]:
        """The same of a sensor without a kernel."""
        state = known.state if problem.number[row] < 0 else known.state.seeing(ORIGIN)
        r, jacobians = self.measurements(problem, np.array([row])).linearize(state)
        return r[0], self.layout.matrix(jacobians)[0]

    def _see(self, before: Gaussian, problem: Problem, row: int, met: "Met | None") -> Gaussian:
        """The estimate corrected by a place that is seen again, or with one place more."""
        instrument, size = self.initial.instruments[PLACE], self.layout.size
        name, number = float(problem.names[row]), int(problem.number[row])
        time, sd = float(problem.rows[row, at.TIME]), problem.sd(np.array([row]), PLACE_DIM)[0]
        r, H = self._of_model(before, problem, row)
        H, H_y = H[:, :size], H[:, size:]
        match = nearest(before.P, r, H, sd, size, before.places, name)
        gate = instrument.gate_sd or np.inf
        if match is not None and match.nis <= gate**2:
            found = before.places[match.index]
            known, weight = self._correct_by(before, match.r, np.hstack([match.H, H_y]))
            if met is not None:
                met.see(row, before, match.nis, weight, found.position, found.number)
            return replace(known, places=seen_at(known.places, match.index, time))
        place = RememberedPlace(name, number, -sd * r, time)
        other, nis = (place, 0.0) if match is None else (before.places[match.index], match.nis)
        if met is not None:
            met.see(row, before, nis, 1.0 if match is None else 0.0, other.position, number)
        by = sd[:, None] * H, sd[:, None] * H_y @ before.L
        P, B, places = with_another(before.P, before.B, before.places, place, *by, sd)
        most = self.initial.config.place.remembered
        P, B, places = without_oldest(P, B, places, size, most)
        return Gaussian(before.x, before.c, P, places, B, before.L)

    def _correct_by(self, before: Gaussian, r: Array, H: Array) -> tuple[Gaussian, float]:
        """The estimate corrected by given whitened rows of a place, and the weight of the measurement."""
        which, window = np.array([self._index[PLACE]]), np.full(1, -1)
        rows = MeasuredRows(np.zeros((1, at.ROW)), which, _EXACT, window, np.zeros((0, 0, at.KNOT)))
        interval = Interval(_NO_MOTION, _NO_COVARIANCE, _EXACT[:, 0], rows, 0, r, H)
        known, out = self._take_interval(before, interval, None)
        return _estimate(known, moved(before.places, out.places)), float(out.weight[0])
