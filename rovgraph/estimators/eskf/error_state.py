"""Error-state Kalman filter driven by the IMU, over a whole dive, and its smoother.

`rovgraph.engine.filter` is the filter; here its steps are kept. Only the newest keyframe is corrected as measurements
come. The smoother goes back over the filter's steps (Rauch, Tung and Striebel 1965) without linearising again.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rovgraph.engine.assembly import Assembler, KeyframeInterval
from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import (
    FilterStep,
    Gates,
    Gaussian,
    ProcessedMeasurement,
    Transition,
    stack_states,
    states_of,
)
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.measurements import Block
from rovgraph.engine.remembered_places import columns, common, extended
from rovgraph.estimators.eskf.reinitialisation import reinitialised
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.results import (
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    residual_frame,
)
from rovgraph.geometry import Array
from rovgraph.log import Measurement
from rovgraph.state import BIAS, POSE, VELOCITY, State

# since the start, for `ErrorStateFilter.reinitialise_at`: while heading, mounting and compasses are known to
# several degrees only, what was linearised once misstates what it knows by the square of that
REINITIALISE_AT_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
PROGRESS_EVERY = 50  # keyframes


class History:
    """What is known of keyframes, as far as results need it.

    Parameters
    ----------
    engine : the filter's, for the places of variables in the error
    """

    def __init__(self, engine: FilterEngine) -> None:
        self._engine = engine
        self._rows: list[tuple[Array, Array, Array, Array, Array]] = []

    def __len__(self) -> int:
        return len(self._rows)

    def append(self, known: Gaussian) -> None:
        """Take the next keyframe."""
        size, columns = self._engine.layout.size, self._engine.layout.columns
        pose, velocity = (known.P[columns[v], columns[v]].copy() for v in (POSE, VELOCITY))
        self._rows.append((known.x, known.c, pose, velocity, np.sqrt(np.diagonal(known.P)[:size])))

    def replace_last(self, known: Gaussian) -> None:
        """Take another estimate of the newest keyframe."""
        self._rows.pop()
        self.append(known)

    @property
    def states(self) -> State:
        """Of n keyframes; calibration has shape (n, dim)."""
        return states_of(np.array([row[0] for row in self._rows]), np.array([row[1] for row in self._rows]))

    @property
    def covariances(self) -> tuple[Array, Array]:
        """Of pose and velocity, shapes (n, 6, 6) and (n, 3, 3)."""
        return np.array([row[2] for row in self._rows]), np.array([row[3] for row in self._rows])

    @property
    def sd(self) -> Array:
        """Of the whole error, shape (n, size)."""
        return np.array([row[4] for row in self._rows])


@dataclass
class ErrorStateFilter:
    """Extended Kalman filter, fed measurement by measurement.

    Attributes
    ----------
    beginning : of `rovgraph.estimators.initialise.initialise`
    reinitialise_at : times since the start at which the dive so far is smoothed, and the filter goes on from there [s]
    learn_noise : of the IMU, from its newest samples
    known : Gaussian of the newest keyframe, or what is believed before the first
    history : of each keyframe so far, from all data up to it
    departed, transitions : for the smoother, of a filter that is not reinitialised: each keyframe but the newest with
        what was measured before the next, too, and the way from there
    gates : sensors that are left out
    """

    beginning: InitialConditions
    reinitialise_at: tuple[float, ...] = ()
    learn_noise: bool = False

    def __post_init__(self) -> None:
        b = self.beginning
        self.assembler = Assembler(b.config, b.instruments, b.prior.state.bias[0], learn_noise=self.learn_noise)
        self.intervals: list[KeyframeInterval] = []
        self.engine = FilterEngine(b)
        self.known = self.engine.start()
        self.history = History(self.engine)
        self.departed: list[Gaussian] = []
        self.transitions: list[Transition] = []
        self.gates: Gates = {}
        self._due = list(self.reinitialise_at)
        self._processed: dict[str, list[ProcessedMeasurement]] = {}

    def add(self, measurement: Measurement) -> list[KeyframeInterval]:
        """Take a measurement; times must not decrease."""
        return self._take(self.assembler.add(measurement))

    def finish(self) -> list[KeyframeInterval]:
        """Close the last interval."""
        return self._take(self.assembler.finish())

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self.known.state

    def step(self, interval: KeyframeInterval) -> FilterStep:
        """Take one interval: correct, predict, correct; from time to time go on from the smoothed dive so far."""
        done = self.engine.step(interval, self.known, self.gates)
        if done.departed is not None and done.transition is not None and not self.reinitialise_at:
            self.departed.append(done.departed)
            self.transitions.append(done.transition)
        self.known = done.filtered
        self.history.append(self.known)
        for processed in done.processed:
            self._processed.setdefault(processed.measurement.sensor, []).append(processed)
        self.intervals.append(interval)
        if self._due and interval.time - self.intervals[0].time >= self._due[0]:
            self._due.pop(0)
            self.known = reinitialised(self.engine, self.intervals, self.history.states)
            self.history.replace_last(self.known)
        self.assembler.time_offsets.assume(self.latest().calibration)
        return done

    def solve(self) -> Estimate:
        """The filter's estimate of every keyframe so far."""
        return self._estimate("filtered" if self.reinitialise_at else "ekf", self.history)

    def smoothed(self) -> Estimate:
        """The smoother's estimate of every keyframe so far; not of a filter that was reinitialised."""
        history = History(self.engine)
        for known in self.backward():
            history.append(known)
        return self._estimate("rts", history)

    def backward(self) -> list[Gaussian]:
        """Every keyframe so far, from all data, before it and after.

        e_s = e_f + G (e_s,next - e_predicted,next), G = P_f F' P_predicted^-1, with the differences taken along
        the coordinates of `rovgraph.kernels.error_coordinates`.
        """
        known = [self.known]
        for departed, transition in zip(reversed(self.departed), reversed(self.transitions), strict=True):
            known.append(_back(self.engine, departed, transition, known[-1]))
        return known[::-1]

    def _take(self, intervals: list[KeyframeInterval]) -> list[KeyframeInterval]:
        for interval in intervals:
            self.step(interval)
        return intervals

    def _estimate(self, kind: str, history: History) -> Estimate:
        """What is known of every keyframe, as an estimate."""
        b, columns, unknowns = self.beginning, self.engine.layout.columns, self.engine.unknowns
        states, sd = history.states, history.sd
        trajectory = body_trajectory(self.intervals, states, b.config.imu.lever_arm_m, *history.covariances)
        histories = bias_histories(trajectory.time, states.bias, sd[:, columns[BIAS]])
        for name in unknowns.estimated:
            histories[name] = calibration_history(name, trajectory.time, states.calibration[name], sd[:, columns[name]])
        final = {name: np.diag(sd[-1, columns[name]] ** 2) for name in unknowns.estimated}
        sensors = [s for s in b.instruments if s in self._processed]
        last = {name: value[-1] for name, value in states.calibration.items()}
        calibration = calibration_estimates(self.engine.beliefs, sensors, last, final)
        residuals = residual_frame(*self._residuals(states if kind == "rts" else None))
        return Estimate(kind, trajectory, calibration, histories, residuals, self._summary())

    def _residuals(
        self, smoothed: State | None
    ) -> tuple[Mapping[str, Block], Mapping[str, State], Mapping[str, Array]]:
        """Measurements, the states they are compared with, and their weights.

        Without ``smoothed`` these are the predictions before the measurements entered.
        """
        blocks, here, weights = {}, {}, {}
        for sensor, rows in self._processed.items():
            blocks[sensor] = block = self.engine.block([one.measurement for one in rows])
            here[sensor] = stack_states(rows) if smoothed is None else smoothed.at(block.keyframe)
            places = [one.place for one in rows if one.place is not None]
            if places:
                here[sensor] = here[sensor].seeing(np.array(places))
            weights[sensor] = np.array([one.weight for one in rows])
        return blocks, here, weights

    def _summary(self) -> dict[str, Any]:
        """Count of keyframes, and of every sensor its mean NIS, which is its dimension where noise is as believed."""
        instruments = self.beginning.instruments
        nis = {}
        for sensor, rows in self._processed.items():
            admitted = [one.nis for one in rows if one.weight > 0.0]
            nis[sensor] = {
                "mean": float(np.mean(admitted)) if admitted else None,
                "dim": instruments[sensor].model.dim,
                "count": len(admitted),
                "rejected": len(rows) - len(admitted),
            }
        return {
            "keyframes": len(self.intervals),
            "nis": nis,
            "bridged_intervals": sum(i.bridged for i in self.intervals),
        }


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
    return engine.retract(departed, G @ delta, P)


def replay(
    intervals: Sequence[KeyframeInterval],
    beginning: InitialConditions,
    reinitialise_at: tuple[float, ...] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> ErrorStateFilter:
    """A filter that has taken the intervals of a dive; ``progress`` is told 0 to 1 now and then."""
    estimator = ErrorStateFilter(beginning, reinitialise_at)
    for index, interval in enumerate(intervals):
        estimator.step(interval)
        if index % PROGRESS_EVERY == 0:
            progress(index / len(intervals))
    return estimator
