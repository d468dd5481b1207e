"""Error-state Kalman filter driven by the IMU, over a whole dive, and its smoother.

`rovgraph.engine.filter` is the filter; here its steps are kept. Only the newest keyframe is corrected as measurements
come. The smoother goes back over the filter's steps (Rauch, Tung and Striebel 1965) without linearising again.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rovgraph.engine.assembly import assembly_of
from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import FilterStep, Gates, Gaussian, Transition
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.problem import Problem
from rovgraph.engine.remembered_places import columns, common, extended
from rovgraph.estimators.eskf.history import FilterHistory
from rovgraph.estimators.eskf.reinitialisation import reinitialised
from rovgraph.estimators.estimate import Estimate
from rovgraph.geometry import Array
from rovgraph.log import Log, Measurement
from rovgraph.state import PLACE, State

# since the start, for `ErrorStateFilter.reinitialise_at`: while heading, mounting and compasses are known to
# several degrees only, what was linearised once misstates what it knows by the square of that
REINITIALISE_AT_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
PROGRESS_EVERY = 500  # keyframes


@dataclass
class ErrorStateFilter:
    """Extended Kalman filter, fed measurement by measurement.

    Attributes
    ----------
    initial : of `rovgraph.estimators.initialise.initialise`
    reinitialise_at : times since the start at which the dive so far is smoothed, and the filter goes on from there [s]
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
        self.gates: Gates = {}
        self._due = list(self.reinitialise_at)
        self._smoothed: State | None = None  # of the keyframes up to the newest reinitialisation

    def take(self, log: Log, progress: Callable[[float], None] = lambda done: None) -> None:
        """Take a whole log, before anything else, and learn how late stamps are; ``progress`` is told 0 to 1."""
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
        """Take the next interval: correct, predict, correct; now and then go on from the smoothed dive so far."""
        smooths = not self.reinitialise_at
        done = self.engine.step(self.problem, len(self.history), self.known, self.gates, smooths)
        if smooths and done.departed is not None and done.transition is not None:
            self.departed.append(done.departed)
            self.transitions.append(done.transition)
        self.known = done.filtered
        self.history.append(self.known, done.met)
        self._reinitialise()
        self.assembly.time_offsets.assume(self.known.c)
        return done

    def run(self, problem: Problem, progress: Callable[[float], None]) -> None:
        """Take the keyframes of a dive, before anything else; ``progress`` is told 0 to 1 now and then."""
        self.problem, n = problem, len(problem)
        compiled = all(self.engine.knows(sensor) or sensor == PLACE for sensor in problem.sensors)
        while (k := len(self.history)) < n:
            progress(k / n)
            end = min(k + PROGRESS_EVERY, self._due_at(problem.time, k))
            if self.engine.changes_in(problem.time[max(k - 1, 0)], problem.time[end - 1]):
                end = k + 1
            # of a filter that is not reinitialised, the smoother needs every step
            alone = k > 0 and compiled and self.reinitialise_at and not self.known.places
            if alone and not self.engine.changes_in(problem.time[k - 1], problem.time[end - 1]):
                run = self.engine.run(problem, k, end, self.known, self.gates)
                self.known = run.known
                self.history.extend(run)
                k += len(run)
                self._reinitialise()
            if k < end:
                self.step()

    def _due_at(self, time: Array, k: int) -> int:
        """The number of intervals, more than k, after which the next reinitialisation is due, or all."""
        due = int(time.searchsorted(time[0] + self._due[0])) + 1 if self._due else len(time)
        return min(max(due, k + 1), len(time))

    def _reinitialise(self) -> None:
        """Go on from the smoothed dive so far, where that is due."""
        n = len(self.history)
        if self._due and self.problem.time[n - 1] - self.problem.time[0] >= self._due[0]:
            self._due.pop(0)
            self.known, best = reinitialised(self.engine, self.problem.upto(n), self.states())
            self._smoothed = best.state
            self.history.replace_last(self.known)

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
    # of places, those that both know: one that was forgotten since moves with what it is correlated with
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
