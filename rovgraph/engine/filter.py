"""The error-state Kalman filter: `FilterEngine.step` takes one interval, and is the only loop body there is.

The error has 15 components (attitude, position, velocity, biases) and those of the calibration that is estimated. What
is considered moves nothing; its part of the error goes along with the estimate (`Gaussian.B`).
Motion, measurement equations, noise, losses, gates and prior are the smoother's own. What differs: every measurement
is linearised once, where it comes.

Per interval, the measurements between two keyframes correct the earlier one, as they do in the smoother; the state
goes on to the next keyframe with the IMU; what was measured there corrects it.
"""

from dataclasses import replace

import numpy as np

from rovgraph.engine.alignment import POORLY_KNOWN, aligned, poorly_known, with_attitude
from rovgraph.engine.error_layout import ErrorLayout
from rovgraph.engine.filter_step import (
    FilterRun,
    FilterStep,
    Gates,
    Gaussian,
    Met,
    Transition,
    calibration_vector,
    state_vector,
)
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.measurements import KeyframeRows, Measurements, compiled, sensor_table
from rovgraph.engine.problem import Index, Problem
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

    def step(self, problem: Problem, k: int, before: Gaussian, gates: Gates, wholly: bool = False) -> FilterStep:
        """Take the interval that ends with keyframe k.

        Parameters
        ----------
        problem : the dive
        before : the keyframe before, or at the first `start`
        gates : renewed in place
        wholly : tell the way to the keyframe, too
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
            transition = self.predict(problem, k, self._changed(departed, problem, k))
            predicted = transition.predicted
        filtered = self.correct(predicted, problem, slice(here, met.end), gates, met)
        return FilterStep(filtered, met, departed, transition)

    def _knows_all(self, problem: Problem, k: int, before: Gaussian) -> bool:
        """Whether kernels know all of the interval that ends with keyframe k."""
        if k == 0 or before.places or poorly_known(before) or self._changes(problem, k):
            return False
        return not self._outside[problem.which[slice(*problem.measured_in(k))]].any()

    def _step(
        self, problem: Problem, k: int, before: Gaussian, gates: Gates, here: int, met: Met, wholly: bool
    ) -> FilterStep:
        """`step` by one call of a kernel."""
        between, departed = here - met.begin, _room(before) if wholly else _NO_STATE
        predicted = _room(before) if wholly else _NO_STATE._replace(x=np.empty(21), c=np.empty(len(before.c)))
        own = self._interval(problem, slice(met.begin, met.end), k, between)
        known, out = self._take_interval(before, own, gates, departed, predicted)
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
        gates: Gates | None,
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

    def run(self, problem: Problem, begin: int, end: int, before: Gaussian, gates: Gates) -> FilterRun:
        """Take intervals of a dive as `step` does, as far as kernels know how.

        Parameters
        ----------
        problem : the dive
        begin, end : the intervals, the first beyond 0
        before : the keyframe before them, without places
        gates : renewed in place
        """
        assert len(problem.covariances) == len(problem.motions)  # kernels do not check where they read
        known, since = _state(before), self._since(gates)
        own = slice(int(problem.taken[begin - 1]), int(problem.taken[end - 1]))
        taken, first = problem.taken[begin:end] - own.start, problem.first[begin:end] - own.start
        k, m, C, size = end - begin, own.stop - own.start, len(before.c), self.layout.size
        shapes = (k, 21), (k, C), (k, 21), (k, C), (k, 6, 6), (k, 3, 3), (k, size), (m,), (m,)
        out = Filtered._make(np.empty(shape) for shape in shapes)
        some = slice(begin - 1, end - 1)
        motions, covariances, scales = problem.motions[some], problem.covariances[some], problem.scales[some]
        intervals = Intervals(motions, covariances, scales, np.append(0, taken), first, POORLY_KNOWN)
        measured = problem.measured(own)
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
        self, before: Gaussian, problem: Problem, some: slice, gates: Gates | None, met: "Met | None" = None
    ) -> Gaussian:
        """The estimate corrected by measurements of its keyframe, places last; without gates all count.

        ``met`` is told how they were met.
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
        """Variance that what is considered adds to an innovation, in units of the rest of it; shape (dim,).

        Gates and gains depend on P alone, so innovations of a consistent filter vary by as much more.
        """
        if not len(known.L):
            return np.zeros(problem.dims[problem.which[row]])
        _, H = self.linearize(known, problem, np.array([row]))
        own, considered = H[:, : self.layout.size], H[:, self.layout.size : self.layout.width]
        B, P = known.B[: self.layout.size], known.P[: self.layout.size, : self.layout.size]
        by_considered = own @ B + considered @ known.L
        return np.asarray(np.sum(by_considered**2, axis=1) / (np.sum(own @ P * own, axis=1) + 1.0))

    def knows(self, sensor: str) -> bool:
        """Whether the kernels know a sensor's equation."""
        return sensor not in self._given

    def rows(self, problem: Problem, index: Index) -> KeyframeRows:
        """Measurements of one keyframe that the kernels know."""
        layout, measured = self.layout, problem.measured(index)
        return KeyframeRows(measured, self._model.sensors, layout.column, layout.width, self._gravity)

    def measurements(self, problem: Problem, index: Index) -> Measurements:
        """Measurements of one sensor, with the filter's unknowns."""
        instrument = self.initial.instruments[problem.sensors[problem.which[index[0]]]]
        return Measurements(problem, index, instrument, self._gravity, self._wide)

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

    def _changes(self, problem: Problem, k: int) -> list[str]:
        """What of the calibration takes another value between keyframe k and the one before."""
        return self.changes_in(float(problem.time[k - 1]), float(problem.time[k]))

    def _changed(self, known: Gaussian, problem: Problem, k: int) -> Gaussian:
        """The keyframe before keyframe k, with the variance of what takes another value up to it."""
        names = self._changes(problem, k)
        if not names:
            return known
        P = known.P.copy()
        for name in names:
            own = np.arange(len(P))[self.layout.columns[name]]
            P[own, own] += self.beliefs[name].sd ** 2
        return replace(known, P=P)

    def _align(self, known: Gaussian, problem: Problem, k: int) -> Gaussian:
        """The keyframe before keyframe k; where its attitude is poorly known, with the one it is corrected to."""
        if not poorly_known(known):
            return known
        own = slice(problem.measured_in(k)[0], self._first_here(problem, k))
        near = aligned(known, problem, k, own, self.linearize, self._gravity)
        after = self.correct(near, problem, own, None)
        return with_attitude(known, after.state.R_nb[0])

    def _correct(
        self, before: Gaussian, problem: Problem, index: Index, gates: Gates | None, met: "Met | None"
    ) -> Gaussian:
        """The estimate corrected by measurements of no places."""
        which = problem.which[index]
        given = [self._of_model(before, problem, row) for row in index[self._outside[which]].tolist()]
        own = self._interval(problem, index)
        if given:
            own = own._replace(given_r=np.concatenate([r for r, _ in given]), given_H=np.vstack([H for _, H in given]))
        known, out = self._take_interval(before, own, gates)
        if met is not None:
            met.put(index, before, out.nis, out.weight)
        return _estimate(known, moved(before.places, out.places) if len(out.places) else before.places)

    def _since(self, gates: Gates) -> Array:
        """Since when each sensor is left out, nan where it is not [s]."""
        return np.array([gates.get(sensor, np.nan) for sensor in self._index])

    def _renew(self, gates: Gates, since: Array) -> None:
        gates.clear()
        gates.update((s, t) for s, t in zip(self._index, since.tolist(), strict=True) if t == t)

    def _of_model(self, known: Gaussian, problem: Problem, row: int) -> tuple[Array, Array]:
        """The same of a sensor whose equation the kernels do not know."""
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
        """The estimate corrected by whitened rows of a place that are at hand, and the weight of the measurement."""
        which, window = np.array([self._index[PLACE]]), np.full(1, -1)
        own = MeasuredRows(np.zeros((1, at.ROW)), which, _EXACT, window, np.zeros((0, 0, at.KNOT)))
        interval = Interval(_NO_MOTION, _NO_COVARIANCE, _EXACT[:, 0], own, 0, r, H)
        known, out = self._take_interval(before, interval, None)
        return _estimate(known, moved(before.places, out.places)), float(out.weight[0])
