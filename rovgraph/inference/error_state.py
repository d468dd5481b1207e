"""The error-state Kalman filter over a whole dive, its history, and its smoother.

`ErrorStateFilter` runs `rovgraph.inference.filter` over a dive and keeps the steps as a `FilterHistory`, from which the
estimate is made. Only the newest keyframe is corrected as measurements come. The smoother goes back over the filter's
steps (Rauch, Tung and Striebel 1965) without linearising again. `reinitialised` puts the smoother's newest keyframe of
the dive so far in place of the filter's.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.estimate import (
    Estimate,
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    current_frame,
    reply_frame,
    residual_frame,
    velocity_covariance,
)
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.filter_step import (
    FilterGates,
    FilterRun,
    FilterStep,
    Gaussian,
    Met,
    Transition,
    stack_states,
    states_of,
)
from rovgraph.inference.observability import without_what_noise_moves
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.remembered_places import RememberedPlace, columns, common, extended
from rovgraph.inference.smoother import optimum
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.measurement_row import TIME
from rovgraph.log import Log, Measurement
from rovgraph.model.calibration import ACOUSTICS, WATER_LAYER
from rovgraph.model.state import BIAS, PLACE, PLACE_DIM, State
from rovgraph.problem.assembly import assembly_of
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.measurements import Measurements
from rovgraph.problem.problem import Problem
from rovgraph.process import stage

# of some keyframes, their number first in every shape: state, calibration, covariances of the pose at the IMU and of
# the origin's velocity, sd of the error
Columns = tuple[Array, Array, Array, Array, Array]


class _Part(NamedTuple):
    """Measurements in a row, as the filter met them.

    Attributes
    ----------
    states : returns x and c of each, as of `Met`, shapes (n, 21), (n, C)
    nis, weight, place : as of it, of each; place is shape (0, 2) where no place is among them
    """

    states: Callable[[], tuple[Array, Array]]
    nis: Array
    weight: Array
    place: Array


class FilterHistory:
    """Keyframes as far as results need them, and the measurements as the filter met them.

    Parameters
    ----------
    engine : the filter's
    """

    def __init__(self, engine: FilterEngine) -> None:
        self._engine = engine
        self._pieces: list[Columns] = []
        self._met: list[_Part] = []
        self._count = 0

    def __len__(self) -> int:
        """Count of keyframes."""
        return self._count

    def append(self, known: Gaussian, met: Met, keyframes: Array) -> None:
        """Take the next keyframe, of those of the dive."""
        self._count += 1
        self._pieces.append(self._columns([known], keyframes[self._count - 1 : self._count]))
        if len(met):
            place = met.place if (met.number >= 0).any() else met.place[:0]
            self._met.append(_Part(met.states, met.nis, met.weight, place))

    def extend(self, run: FilterRun, keyframes: Array) -> None:
        """Take the intervals that a filter has run through, of the keyframes of the dive."""
        if not len(run):
            return
        filtered = run.filtered
        self._met.append(_Part(run.states, filtered.nis, filtered.weight, np.empty((0, 2))))
        own = keyframes[self._count : self._count + len(run)]
        self._count += len(run)
        self._pieces.append(self._reduced(filtered.x, filtered.c, filtered.covariance, filtered.sd, own))

    def replace_last(self, known: Gaussian, keyframes: Array) -> None:
        """Take another estimate of the newest keyframe, of those of the dive."""
        x, c, pose, velocity, sd = self._pieces.pop()
        newest = self._columns([known], keyframes[self._count - 1 : self._count])
        self._pieces += [(x[:-1], c[:-1], pose[:-1], velocity[:-1], sd[:-1]), newest]

    @property
    def states(self) -> State:
        """Of n keyframes; calibration has shape (n, dim)."""
        x, c = (np.concatenate([piece[column] for piece in self._pieces]) for column in range(2))
        return states_of(x, c)

    def estimate(self, problem: Problem, kind: str) -> Estimate:
        """The filtered estimate of every keyframe."""
        self._join()
        return self._estimate(problem, kind, self._pieces[0], None)

    @stage
    def _join(self) -> None:
        """Keep what was found in one piece; of a long dive it is not kept twice."""
        self._pieces = [_joined(self._pieces)]

    def smoothed(self, problem: Problem, kind: str, known: Sequence[Gaussian]) -> Estimate:
        """The estimate of every keyframe that a smoother has found."""
        return self._estimate(problem, kind, self._columns(known, problem.keyframes), stack_states(known))

    def _columns(self, known: Sequence[Gaussian], keyframes: Array) -> Columns:
        """Of as many keyframes."""
        size, P = self._engine.layout.size, [one.covariance for one in known]
        x, c = np.array([k.x for k in known]), np.array([k.c for k in known])
        sd = np.sqrt([np.diagonal(own)[:size] for own in P])
        return self._reduced(x, c, np.array([own[:MOTION, :MOTION] for own in P]), sd, keyframes)

    def _reduced(self, x: Array, c: Array, P: Array, sd: Array, keyframes: Array) -> Columns:
        """From the covariance of pose, velocity and bias, shape (n, 15, 15)."""
        return x, c, P[:, :6, :6].copy(), velocity_covariance(keyframes, states_of(x), self._engine.initial, P), sd

    def _estimate(self, problem: Problem, kind: str, found: Columns, smoothed: State | None) -> Estimate:
        """An estimate; residuals are those before the measurements entered where nothing was smoothed."""
        x, c, pose, velocity, sd = found
        engine, states = self._engine, states_of(x, c)
        columns, estimated = engine.layout.columns, engine.unknowns.estimated
        trajectory = body_trajectory(problem.keyframes, states, engine.initial, pose, velocity)
        history = bias_histories(trajectory.time, states.bias, sd[:, columns[BIAS]], engine.initial.streams)
        for name in estimated:
            history[name] = calibration_history(name, trajectory.time, states.calibration[name], sd[:, columns[name]])
        final = {name: np.diag(sd[-1, columns[name]] ** 2) for name in estimated}
        sensors = [s for s in engine.initial.streams if s in {*problem.used, "imu"}]
        last = {name: value[-1] for name, value in states.calibration.items()}
        calibration = calibration_estimates(engine.beliefs, sensors, last, final)
        residuals = residual_frame(self._measured(problem, smoothed))
        acoustic = [s for s in problem.used if s in ACOUSTICS]
        replies = reply_frame(
            ((s, engine.measurements(problem, problem.of_sensor(s))) for s in acoustic), engine.initial.config
        )
        layers = engine.measurements(problem, problem.of_sensor(WATER_LAYER)) if WATER_LAYER in problem.used else None
        current = current_frame(history, layers, engine.initial.config.water.knot_m)
        return Estimate(
            kind, trajectory, calibration, history, residuals, self._summary(problem), replies=replies, current=current
        )

    def _measured(self, problem: Problem, smoothed: State | None) -> Iterator[tuple[str, Measurements, State, Array]]:
        """Each sensor's measurements, the states they are compared with, and their weights."""
        weight = np.concatenate([np.empty(0), *(part.weight for part in self._met)])
        if problem.used and PLACE in problem.used:
            place = [part.place if len(part.place) else np.full((len(part.nis), 2), np.nan) for part in self._met]
        for sensor in problem.used:
            rows = problem.of_sensor(sensor)
            block = self._engine.measurements(problem, rows)
            here = smoothed.at(block.keyframe) if smoothed is not None else states_of(*self._states(rows))
            if sensor == PLACE:
                here = here.seeing(np.concatenate(place)[rows])
            yield sensor, block, here, weight[rows]

    def _states(self, index: NDArray[np.int64]) -> tuple[Array, Array]:
        """x and c of some measurements, in order, as the filter met them; of a long dive all of them are large."""
        found, begin = [], 0
        for part in self._met:
            end = begin + len(part.nis)
            in_part = index[slice(*index.searchsorted([begin, end]))] - begin
            if len(in_part):
                x, c = part.states()
                found.append((x[in_part], c[in_part]))
            begin = end
        x, c = (np.concatenate(column) for column in zip(*found, strict=True))
        return x, c

    def _summary(self, problem: Problem) -> dict[str, Any]:
        """Count of keyframes, and of every sensor its mean NIS, which is its dimension where noise is as stated."""
        every = np.concatenate([np.empty(0), *(part.nis for part in self._met)])
        weight, nis = np.concatenate([np.empty(0), *(part.weight for part in self._met)]), {}
        for sensor in problem.used:
            rows = problem.of_sensor(sensor)
            admitted = every[rows][weight[rows] > 0.0]
            nis[sensor] = {
                "mean": float(np.mean(admitted)) if len(admitted) else None,
                "dim": self._engine.initial.instruments[sensor].model.dim,
                "count": len(admitted),
                "rejected": len(rows) - len(admitted),
            }
        return {"keyframes": len(self), "nis": nis, "bridged_intervals": int(problem.bridged.sum())}


def _joined(pieces: Sequence[Columns]) -> Columns:
    """Of all keyframes."""
    x, c, pose, velocity, sd = (np.concatenate(column) for column in zip(*pieces, strict=True))
    return x, c, pose, velocity, sd


def reinitialised(engine: FilterEngine, problem: Problem, states: State) -> tuple[Gaussian, Optimum]:
    """The newest keyframe, with every factor of the dive linearised at the optimum.

    Parameters
    ----------
    engine : the filter's
    problem : the dive so far
    states : State of all its keyframes to begin with; its newest calibration is taken

    Returns
    -------
    Gaussian : of the newest keyframe
    Optimum : of the dive so far
    """
    calibration = {name: value if value.ndim == 1 else value[-1] for name, value in states.calibration.items()}
    best, _ = without_what_noise_moves(optimum(problem, engine.initial, states, calibration))
    return newest_known(engine, best), best


def newest_known(engine: FilterEngine, best: Optimum) -> Gaussian:
    """The newest keyframe of a smoothed dive, as the filter has it.

    Parameters
    ----------
    engine : the filter's
    best : the dive, smoothed
    """
    layout = engine.layout
    names, size = (*best.unknowns.estimated, *best.unknowns.considered), layout.size
    known = np.concatenate([np.arange(15)] + [np.r_[layout.columns[name]] for name in names])
    places = remembered(best, engine.initial.config.place.remembered)
    # the covariance of all, what is considered at the end: of what no sensor has shown yet, that of the start
    start, more = engine.start(), PLACE_DIM * len(places)
    joint = np.zeros((layout.width + more, layout.width + more))
    joint[:size, :size], joint[size + more :, size + more :] = start.P, start.L @ start.L.T
    known = np.concatenate([known + more * (known >= size), np.arange(size, size + more)])
    joint[np.ix_(known, known)] = best.newest_covariance([place.number for place in places])
    estimated = slice(0, size + more)
    L = np.asarray(np.linalg.cholesky(joint[size + more :, size + more :]), dtype=float)
    B = np.asarray(np.linalg.solve(L, joint[size + more :, estimated]).T, dtype=float)
    state = best.state.at([len(best.problem) - 1])
    calibration = {name: value.reshape(-1) for name, value in state.calibration.items()}
    newest = State(state.R_nb, state.p_n, state.v_n, state.bias, calibration)
    return replace(Gaussian.of(newest, joint[estimated, estimated] - B @ B.T, places), B=B, L=L)


def remembered(best: Optimum, most: int) -> tuple[RememberedPlace, ...]:
    """The places that were seen last, of those with a determined position."""
    seen: dict[int, RememberedPlace] = {}
    problem, believed = best.problem, best.problem.believed
    for row in problem.of_sensor(PLACE).tolist() if best.places else ():
        if believed[row]:
            number, name, time = int(problem.number[row]), float(problem.names[row]), float(problem.rows[row, TIME])
            seen[number] = RememberedPlace(name, number, best.places[number], time)
    return tuple(sorted(seen.values(), key=lambda place: place.time)[-most:])


# since the start, for `ErrorStateFilter.reinitialise_at`: while heading, mounting and compasses are known to
# several degrees only, a linearised covariance is wrong by the square of that
REINITIALISE_AT_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
PROGRESS_EVERY = 500  # keyframes


@dataclass
class ErrorStateFilter:
    """Extended Kalman filter, fed measurement by measurement.

    Attributes
    ----------
    initial : of `rovgraph.inference.initialise.initialise`
    reinitialise_at : times since the start at which the filter continues from the smoothed dive so far [s]
    learn_noise : of the IMU, from its newest samples
    problem : the dive, as far as it has been taken
    known : Gaussian of the newest keyframe, or what is believed before the first
    history : of each keyframe so far, from all data up to it
    departed, transitions : for the smoother, of a filter that is not reinitialised: each keyframe but the newest with
        what was measured before the next, too, and the way from there
    gates : sensors that are left out
    """

    initial: InitialConditions
    reinitialise_at: tuple[float, ...] = ()
    learn_noise: bool = False

    def __post_init__(self) -> None:
        self.engine = FilterEngine(self.initial)
        self.assembly = assembly_of(self.initial, learn_noise=self.learn_noise)
        self.problem = self.assembly.problem
        self.known = self.engine.start()
        self.history = FilterHistory(self.engine)
        self.departed: list[Gaussian] = []
        self.transitions: list[Transition] = []
        self.gates: FilterGates = {}
        self._due = list(self.reinitialise_at)
        self._smoothed: State | None = None  # of the keyframes up to the newest reinitialisation

    def take(self, log: Log, progress: Callable[[float], None] = lambda done: None) -> None:
        """Take a whole log, before anything else, and learn how late stamps are; ``progress`` receives 0 to 1."""
        self.assembly.take(log)
        begin, end = self.assembly.span
        while self._take(self.assembly.extend(one=True)):
            if len(self.history) % PROGRESS_EVERY == 0:
                progress((float(self.problem.time[-1]) - begin) / (end - begin))
        self.finish()

    def add(self, measurement: Measurement) -> int:
        """Take a measurement, whose time is not before that of others; how many keyframes it completes."""
        self.assembly.insert(measurement)
        return self._take(self.assembly.extend())

    def finish(self) -> int:
        """Close the last interval; how many keyframes that completes."""
        return self._take(self.assembly.extend(finish=True))

    def states(self) -> State:
        """Of every keyframe, as well as it is known: smoothed up to the newest reinitialisation, then filtered."""
        filtered, smoothed = self.history.states, self._smoothed
        if smoothed is None:
            return filtered
        rest = slice(len(smoothed), None)
        return State(
            np.concatenate([smoothed.R_nb, filtered.R_nb[rest]]),
            np.concatenate([smoothed.p_n, filtered.p_n[rest]]),
            np.concatenate([smoothed.v_n, filtered.v_n[rest]]),
            np.concatenate([smoothed.bias, filtered.bias[rest]]),
            filtered.calibration,
        )

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self.known.state

    def step(self) -> FilterStep:
        """Take the next interval: correct, predict, correct; now and then continue from the smoothed dive so far."""
        smooths = not self.reinitialise_at
        done = self.engine.step(self.problem, len(self.history), self.known, self.gates, smooths)
        if smooths and done.departed is not None and done.transition is not None:
            self.departed.append(done.departed)
            self.transitions.append(done.transition)
        self.known = done.filtered
        self.history.append(self.known, done.met, self.problem.keyframes)
        self._reinitialise()
        self.assembly.time_offsets.assume(self.known.c)
        return done

    def run(self, problem: Problem, progress: Callable[[float], None]) -> None:
        """Take the keyframes of a dive, before anything else; ``progress`` receives 0 to 1 now and then."""
        self.problem, n = problem, len(problem)
        compiled = all(self.engine.knows(sensor) or sensor == PLACE for sensor in problem.sensors)
        while (k := len(self.history)) < n:
            progress(k / n)
            window = self.engine.next_window(problem, k)
            end = min(k + PROGRESS_EVERY, self._due_at(problem.time, k), max(window, k + 1))
            if self.engine.changes_in(problem.time[max(k - 1, 0)], problem.time[end - 1]):
                end = k + 1
            # of a filter that is not reinitialised, the smoother needs every step
            alone = 0 < k < window and compiled and self.reinitialise_at and not self.known.places
            if alone and not self.engine.changes_in(problem.time[k - 1], problem.time[end - 1]):
                run = self.engine.run(problem, k, end, self.known, self.gates)
                self.known = run.known
                self.history.extend(run, self.problem.keyframes)
                k += len(run)
                self._reinitialise()
            if k < end:
                self.step()

    def _due_at(self, time: Array, k: int) -> int:
        """The number of intervals, more than k, after which the next reinitialisation is due, or all."""
        due = int(time.searchsorted(time[0] + self._due[0])) + 1 if self._due else len(time)
        return min(max(due, k + 1), len(time))

    def _reinitialise(self) -> None:
        """Continue from the smoothed dive so far, where that is due."""
        n = len(self.history)
        if self._due and self.problem.time[n - 1] - self.problem.time[0] >= self._due[0]:
            self._due.pop(0)
            self.known, best = reinitialised(self.engine, self.problem.upto(n), self.states())
            self._smoothed = best.state
            self.history.replace_last(self.known, self.problem.keyframes)

    def solve(self) -> Estimate:
        """The filter's estimate of every keyframe so far."""
        return self.history.estimate(self.problem, "filtered" if self.reinitialise_at else "ekf")

    def smoothed(self) -> Estimate:
        """The smoother's estimate of every keyframe so far; not of a filter that was reinitialised."""
        return self.history.smoothed(self.problem, "rts", self.backward())

    def backward(self) -> list[Gaussian]:
        """Every keyframe so far, from all data, before it and after.

        e_s = e_f + G (e_s,next - e_predicted,next), G = P_f F' P_predicted^-1, with the differences taken along
        the coordinates of `rovgraph.kernels.error_coordinates`.
        """
        known = [self.known]
        for departed, transition in zip(reversed(self.departed), reversed(self.transitions), strict=True):
            known.append(_back(self.engine, departed, transition, known[-1]))
        return known[::-1]

    def _take(self, count: int) -> int:
        """Filter the newest keyframes of the assembly."""
        self.problem = self.assembly.problem
        for _ in range(count):
            self.step()
        return count


def _back(engine: FilterEngine, departed: Gaussian, transition: Transition, following: Gaussian) -> Gaussian:
    """The smoothed state of a keyframe, given that of the one after it."""
    predicted, size = transition.predicted, engine.layout.size
    delta, basis = engine.local(predicted, following)
    # of places, those in both: one that was forgotten since moves with its correlated components
    ours, theirs, shift = common(predicted.places, following.places)
    here, there = columns(size, ours), columns(size, theirs)
    delta, basis = np.concatenate([delta, shift]), extended(basis, len(here))
    F, Q = transition.F[here], transition.Q[np.ix_(here, here)]
    P_predicted, P_following = predicted.P[np.ix_(here, here)], following.P[np.ix_(there, there)]
    P, sd = departed.P, np.sqrt(np.diag(P_predicted))[:, None]  # metres beside rad/s: solved with unit sds
    G = (np.linalg.solve(P_predicted / (sd * sd.T), F @ P / sd) / sd).T
    kept = np.eye(len(P)) - G @ F
    P = kept @ P @ kept.T + G @ (basis @ P_following @ basis.T + Q) @ G.T
    B = departed.B
    if B.size:  # all that is known of it moves as the estimate does
        B = B + G @ (basis @ following.B[there] - predicted.B[here])
    return engine.retract(departed, G @ delta, P, B)


def replay(
    problem: Problem,
    initial: InitialConditions,
    reinitialise_at: tuple[float, ...] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> ErrorStateFilter:
    """A filter that has taken the keyframes of a dive; ``progress`` as of `ErrorStateFilter.run`."""
    estimator = ErrorStateFilter(initial, reinitialise_at)
    estimator.run(problem, progress)
    return estimator
