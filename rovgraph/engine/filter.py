"""The error-state Kalman filter: `FilterEngine.step` takes one interval, and is the only loop body there is.

The error has 15 components (attitude, position, velocity, biases) and those of the calibration that is estimated. What
is considered moves nothing; its part of the error goes along with the estimate (`Gaussian.B`).
Motion, measurement equations, noise, losses, gates and prior are the smoother's own. What differs: every measurement
is linearised once, where it comes.

Per interval, the measurements between two keyframes correct the earlier one, as they do in the smoother; the state
goes on to the next keyframe with the IMU; what was measured there corrects it.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.engine.alignment import POORLY_KNOWN, aligned, poorly_known, with_attitude
from rovgraph.engine.dive_rows import DiveRows
from rovgraph.engine.error_layout import ErrorLayout
from rovgraph.engine.filter_step import (
    FilterRun,
    FilterStep,
    Gates,
    Gaussian,
    ProcessedMeasurement,
    Transition,
    calibration_vector,
    state_vector,
)
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement
from rovgraph.engine.measurement_table import MeasurementTable
from rovgraph.engine.measurements import Block, make_block
from rovgraph.engine.remembered_places import (
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
from rovgraph.engine.sensor_rows import KeyframeRows, compiled, sensor_table
from rovgraph.engine.unknowns import unknowns
from rovgraph.geometry import Array
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.correction import GivenRows
from rovgraph.kernels.filter_state import FilterModel, FilterState
from rovgraph.kernels.filtering import Filtered, Interval, Intervals, Taken, filter_intervals, take_interval
from rovgraph.kernels.measurement_row import MeasuredRows
from rovgraph.kernels.moves import difference, move_estimate
from rovgraph.state import PLACE, PLACE_DIM

ORIGIN = np.zeros(PLACE_DIM)  # where a place is put to begin with
_EXACT = np.zeros((0, 6, 6))  # of an IMU without scale errors
_NO_MOTION = np.zeros(0)
_NO_STATE = FilterState(_NO_MOTION, _NO_MOTION, *[np.zeros((0, 0))] * 3)  # where none is asked for


def _state(known: Gaussian) -> FilterState:
    """A copy for kernels, which write to it."""
    return FilterState(known.x.copy(), known.c.copy(), known.P.copy(), known.B.copy(), known.L)


def _room(known: Gaussian) -> FilterState:
    """Arrays for an estimate of the same size."""
    own = np.empty_like(known.x), np.empty_like(known.c), np.empty_like(known.P), np.empty_like(known.B)
    return FilterState(*own, known.L)


def _estimate(known: FilterState, places: tuple[RememberedPlace, ...] = ()) -> Gaussian:
    return Gaussian(known.x, known.c, known.P, places, known.B, known.L)


class FilterEngine:
    """Extended Kalman filter that keeps nothing: the estimate goes in and comes out.

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
            s for s, i in instruments.items() if not compiled(i, i.time_offset in self.unknowns.walks) or s == PLACE
        }
        sensors = sensor_table(instruments, sorted(self._given))
        self._model = FilterModel(sensors, self.layout.column, self.layout.coordinates, walk, initial.gravity)
        self._no_rows = GivenRows(np.empty(0), np.empty((0, self.layout.width)))
        self._index = {sensor: k for k, sensor in enumerate(instruments)}

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

    def step(self, interval: KeyframeInterval, before: Gaussian, gates: Gates) -> FilterStep:
        """Take one interval.

        Parameters
        ----------
        interval : the next one
        before : the keyframe before, or at the first `start`
        gates : renewed in place
        """
        assert len(before.L) == self.layout.width - self.layout.size  # kernels do not check where they write
        if (taken := self._take(interval, before, gates)) is not None:
            return taken
        processed: list[ProcessedMeasurement] = []
        departed = transition = None
        predicted = before
        if interval.motion is not None:
            departed = self._align(before, interval)
            departed = self.correct(departed, interval.between, gates, processed)
            transition = self.predict(interval, self._changed(departed, interval))
            predicted = transition.predicted
        filtered = self.correct(predicted, interval.here, gates, processed)
        return FilterStep(departed, transition, filtered, processed)

    def _take(self, interval: KeyframeInterval, before: Gaussian, gates: Gates) -> FilterStep | None:
        """`step` by one call of a kernel, where kernels know all of it."""
        if interval.motion is None or before.places or self._changes(interval) or poorly_known(before):
            return None
        measurements = [*interval.measurements]  # each is made when it is asked for
        if any(m.sensor in self._given for m in measurements):
            return None
        between = [m for m in measurements if m.keyframe < interval.index]
        here = [m for m in measurements if m.keyframe == interval.index]
        departed, predicted = _room(before), _room(before)
        own = self._interval(between + here, interval, len(between))
        known, out = self._take_interval(before, own, gates, departed, predicted)
        after = _estimate(predicted)
        of = [before] * len(between) + [after] * len(here)
        met = zip(between + here, of, out.nis.tolist(), out.weight.tolist(), strict=True)
        processed = [ProcessedMeasurement(m, k.x, k.c, nis, weight) for m, k, nis, weight in met]
        return FilterStep(_estimate(departed), Transition(out.F, out.Q, after), _estimate(known), processed)

    def _interval(
        self, measurements: Sequence[KeyframeMeasurement], moved: KeyframeInterval | None = None, between: int = 0
    ) -> Interval:
        """Measurements, the first ones of a keyframe before a motion, as kernels take them."""
        motion, scale = _NO_MOTION, _EXACT[:, 0]
        if moved is not None and moved.motion is not None:
            motion, scale = moved.motion.row, scale if moved.scale_to_bias is None else moved.scale_to_bias
        return Interval(motion, scale, *self._rows(measurements), between, *self._no_rows)

    def _take_interval(
        self,
        before: Gaussian,
        interval: Interval,
        gates: Gates | None,
        departed: FilterState = _NO_STATE,
        predicted: FilterState = _NO_STATE,
    ) -> tuple[FilterState, Taken]:
        """The estimate after what a kernel makes of an interval, gates renewed in place."""
        known, since, m, n = _state(before), self._since(gates or {}), len(interval.which), len(before.P)
        of_motion = (n, n) if len(interval.motion) else (0, 0)
        places = np.zeros(n - self.layout.size)
        out = Taken(departed, predicted, np.empty(of_motion), np.empty(of_motion), np.empty(m), np.empty(m), places)
        take_interval(known, interval, self._model, since, gates is not None, out)
        if gates is not None:
            self._renew(gates, since)
        return known, out

    def _rows(self, measurements: Sequence[KeyframeMeasurement]) -> MeasuredRows:
        """Measurements as kernels take them."""
        if not measurements:
            return MeasuredRows(np.empty((0, at.ROW)), np.empty(0, np.int64), _EXACT)
        scaled = measurements[0].scale_to_bias is not None
        scale = np.array([m.scale_to_bias for m in measurements]) if scaled else _EXACT
        rows = np.array([m.row[: at.ROW] for m in measurements])
        return MeasuredRows(rows, np.array([self._index[m.sensor] for m in measurements]), scale)

    def run(self, rows: DiveRows, begin: int, end: int, before: Gaussian, gates: Gates) -> FilterRun:
        """Take intervals of a dive as `step` does, as far as kernels know how.

        Parameters
        ----------
        rows : the dive, its sensors those of the configuration
        begin, end : the intervals, the first beyond 0
        before : the keyframe before them, without places
        gates : renewed in place
        """
        known, some, since = _state(before), rows.between(begin, end), self._since(gates)
        k, m, C, size = end - begin, len(some.rows), len(before.c), self.layout.size
        shapes = (k, 21), (k, C), (k, 21), (k, C), (k, 6, 6), (k, 3, 3), (k, size), (m,), (m,)
        out = Filtered._make(np.empty(shape) for shape in shapes)
        intervals = Intervals(some.motions, some.scales, np.append(0, some.taken), some.first[:k], POORLY_KNOWN)
        measured = MeasuredRows(some.rows, some.which, some.row_scales)
        taken = filter_intervals(known, intervals, measured, self._model, since, out, take_interval)
        self._renew(gates, since)
        m = int(some.taken[taken - 1]) if taken else 0
        interval = np.arange(taken).repeat(np.diff(some.taken[:taken], prepend=0))
        own = Filtered._make(a[: m if a.ndim == 1 else taken] for a in out)
        met = rows.sensors, some.which[:m], interval, np.arange(m) < some.first[interval]
        return FilterRun(before, _estimate(known), own, *met)

    def predict(self, interval: KeyframeInterval, before: Gaussian) -> Transition:
        """The next keyframe, from the IMU alone; calibration walks."""
        known, out = self._take_interval(before, self._interval((), interval), None)
        return Transition(out.F, out.Q, _estimate(known, before.places))

    def correct(
        self,
        before: Gaussian,
        measurements: Sequence[KeyframeMeasurement],
        gates: Gates | None,
        processed: list[ProcessedMeasurement],
    ) -> Gaussian:
        """The estimate corrected by measurements that belong to its keyframe, places last; without gates all count."""
        landmarks = [m for m in measurements if m.landmark is not None]
        others = [m for m in measurements if m.landmark is None] if landmarks else measurements
        known = self._correct(before, others, gates, processed) if others else before
        for m in landmarks:
            known = self._see(known, m, processed)
        return known

    def linearize(self, known: Gaussian, measurements: Sequence[KeyframeMeasurement]) -> tuple[Array, Array]:
        """Whitened innovations, shape (m,), and Jacobians, shape (m, width), of measurements of no places."""
        r, H = [], []
        for m in measurements:
            if m.sensor in self._given:
                own_r, own_H = self._of_block(known, m)
            else:
                own_r, own_H = self.rows([m]).linearize(known.x, known.c)
            r.append(own_r)
            H.append(own_H)
        return np.concatenate(r), np.vstack(H)

    def considered_share(self, known: Gaussian, measurement: KeyframeMeasurement) -> Array:
        """Variance that what is considered adds to an innovation, in units of the rest of it; shape (dim,).

        Gates and gains depend on P alone, so innovations of a consistent filter vary by as much more.
        """
        if not len(known.L):
            return np.zeros(self.initial.instruments[measurement.sensor].model.dim)
        _, H = self.linearize(known, [measurement])
        own, considered = H[:, : self.layout.size], H[:, self.layout.size : self.layout.width]
        B, P = known.B[: self.layout.size], known.P[: self.layout.size, : self.layout.size]
        by_considered = own @ B + considered @ known.L
        return np.asarray(np.sum(by_considered**2, axis=1) / (np.sum(own @ P * own, axis=1) + 1.0))

    def knows(self, sensor: str) -> bool:
        """Whether the kernels know a sensor's equation."""
        return sensor not in self._given

    def rows(self, measurements: Sequence[KeyframeMeasurement]) -> KeyframeRows:
        """Measurements of one keyframe that the kernels know."""
        layout, (rows, which, scale) = self.layout, self._rows(measurements)
        return KeyframeRows(rows, which, self._model.sensors, layout.column, layout.width, scale, self._gravity)

    def block(self, measured: MeasurementTable | Sequence[KeyframeMeasurement]) -> Block:
        """Measurements of one sensor, with the filter's unknowns."""
        table = measured if isinstance(measured, MeasurementTable) else MeasurementTable.of(measured)
        instrument = self.initial.instruments[table.sensors[int(table.which[0])]]
        return make_block(table, instrument, self._gravity, self._wide)

    def retract(self, known: Gaussian, delta: Array, P: Array, B: Array | None = None) -> Gaussian:
        """The estimate that lies ``delta``, shape (d,), away; P, and B (None = its own), are about the old one."""
        there = _state(replace(known, P=P, B=known.B if B is None else B))
        move_estimate(there, delta, self.layout.coordinates)
        return _estimate(there, moved(known.places, delta[self.layout.size :]))

    def local(self, some: Gaussian, other: Gaussian) -> tuple[Array, Array]:
        """The error, shape (size,), that leads from one estimate to another, and the basis, shape (size, size).

        The basis takes an error about ``other`` over to ``some``.
        """
        size = self.layout.size
        delta, basis = np.empty(size), np.eye(size)
        difference(some.x, some.c, other.x, other.c, self.layout.coordinates, delta, basis)
        return delta, basis

    def considering(self, known: Gaussian, other: Gaussian) -> Gaussian:
        """An estimate in which all is exact that is considered, with the part that this has in another close by."""
        size, (_, basis) = self.layout.size, self.local(known, other)
        ours, theirs, _ = common(known.places, other.places)
        B = np.zeros((len(known.P), len(other.L)))
        B[columns(size, ours)] = extended(basis, size + PLACE_DIM * len(ours)) @ other.B[columns(size, theirs)]
        return replace(known, B=B, L=other.L)

    def changes_in(self, begin: float, end: float) -> list[str]:
        """What of the calibration takes another value after one time and up to another [s]."""
        return [n for n in self.unknowns.estimated for time in self.beliefs[n].changes if begin < time <= end]

    def _changes(self, interval: KeyframeInterval) -> list[str]:
        """What of the calibration takes another value in an interval with motion."""
        assert interval.motion is not None
        return self.changes_in(interval.time - interval.motion.duration, interval.time)

    def _changed(self, known: Gaussian, interval: KeyframeInterval) -> Gaussian:
        """The keyframe before an interval, with the variance of what takes another value in it."""
        names = self._changes(interval)
        if not names:
            return known
        P = known.P.copy()
        for name in names:
            own = np.arange(len(P))[self.layout.columns[name]]
            P[own, own] += self.beliefs[name].sd ** 2
        return replace(known, P=P)

    def _align(self, known: Gaussian, interval: KeyframeInterval) -> Gaussian:
        """The keyframe before an interval; where its attitude is poorly known, with the one it is corrected to."""
        if not poorly_known(known):
            return known
        near = aligned(known, interval, self.linearize, self._gravity)
        after = self.correct(near, interval.between, None, [])
        return with_attitude(known, after.state.R_nb[0])

    def _correct(
        self,
        before: Gaussian,
        measurements: Sequence[KeyframeMeasurement],
        gates: Gates | None,
        processed: list[ProcessedMeasurement],
    ) -> Gaussian:
        """The estimate corrected by measurements of no places."""
        own, given = (
            self._interval(measurements),
            [self._of_block(before, m) for m in measurements if m.sensor in self._given],
        )
        if given:
            own = own._replace(given_r=np.concatenate([r for r, _ in given]), given_H=np.vstack([H for _, H in given]))
        known, out = self._take_interval(before, own, gates)
        met = zip(measurements, out.nis.tolist(), out.weight.tolist(), strict=True)
        processed += [ProcessedMeasurement(m, before.x, before.c, nis, weight) for m, nis, weight in met]
        return _estimate(known, moved(before.places, out.places) if len(out.places) else before.places)

    def _since(self, gates: Gates) -> Array:
        """Since when each sensor is left out, nan where it is not [s]."""
        return np.array([gates.get(sensor, np.nan) for sensor in self._index])

    def _renew(self, gates: Gates, since: Array) -> None:
        gates.clear()
        gates.update((s, t) for s, t in zip(self._index, since.tolist(), strict=True) if t == t)

    def _of_block(self, known: Gaussian, m: KeyframeMeasurement) -> tuple[Array, Array]:
        """The same of a sensor whose equation the kernels do not know."""
        state = known.state if m.landmark is None else known.state.seeing(ORIGIN)
        r, jacobians = self.block([m]).linearize(state)
        return r[0], self.layout.matrix(jacobians)[0]

    def _see(self, before: Gaussian, m: KeyframeMeasurement, processed: list[ProcessedMeasurement]) -> Gaussian:
        """The estimate corrected by a place that is seen again, or with one place more."""
        assert m.landmark is not None
        instrument, size = self.initial.instruments[m.sensor], self.layout.size
        r, H = self._of_block(before, m)
        H, H_y = H[:, :size], H[:, size:]
        match = nearest(before.P, r, H, m.sd, size, before.places, m.landmark.name)
        gate = instrument.gate_sd or np.inf
        if match is not None and match.nis <= gate**2:
            found = before.places[match.index]
            known, weight = self._correct_by(before, m, match.r, np.hstack([match.H, H_y]))
            seen = replace(m, landmark=m.landmark._replace(number=found.number))
            processed.append(ProcessedMeasurement(seen, before.x, before.c, match.nis, weight, found.position))
            return replace(known, places=seen_at(known.places, match.index, m.time))
        place = RememberedPlace(m.landmark.name, m.landmark.number, -m.sd * r, m.time)
        other, nis = (place, 0.0) if match is None else (before.places[match.index], match.nis)
        processed.append(
            ProcessedMeasurement(m, before.x, before.c, nis, 1.0 if match is None else 0.0, other.position)
        )
        by = m.sd[:, None] * H, m.sd[:, None] * H_y @ before.L
        P, B, places = with_another(before.P, before.B, before.places, place, *by, m.sd)
        most = self.initial.config.place.remembered
        P, B, places = without_oldest(P, B, places, size, most)
        return Gaussian(before.x, before.c, P, places, B, before.L)

    def _correct_by(self, before: Gaussian, m: KeyframeMeasurement, r: Array, H: Array) -> tuple[Gaussian, float]:
        """The estimate corrected by whitened rows that are at hand, and the weight of the measurement."""
        measured = np.zeros((1, at.ROW)), np.array([self._index[m.sensor]]), _EXACT
        known, out = self._take_interval(before, Interval(_NO_MOTION, _EXACT[:, 0], *measured, 0, r, H), None)
        return _estimate(known, moved(before.places, out.places)), float(out.weight[0])
