"""Error-state Kalman filter driven by the IMU, over a whole dive, and its smoother.

`rovgraph.estimators.error_recursion` is the filter; here its steps are kept. Only the newest
keyframe is corrected as measurements come. The smoother goes back over the filter's steps
(Rauch, Tung and Striebel 1965) without linearising anew.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rovgraph.engine.assembly import Assembler
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.estimators.error_recursion import ErrorStateRecursion
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.filter_step import FilterStep, Gates, Gaussian, ProcessedMeasurement, Step
from rovgraph.estimators.initialise import InitialConditions
from rovgraph.estimators.reinitialisation import renewed
from rovgraph.estimators.remembered_places import columns, common, extended
from rovgraph.estimators.results import (
    bias_histories,
    calibration_estimates,
    calibration_history,
    residual_frame,
)
from rovgraph.geometry import Array, transpose
from rovgraph.graph.measurements import Block
from rovgraph.log import Measurement
from rovgraph.state import BIAS, PLACE, State, stack_states

# since the start, for `ErrorStateFilter.reinitialise_at`: while heading, mounting and compasses are known to
# several degrees only, what was linearised once misstates what it knows by the square of that
REINITIALISE_AT_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
PROGRESS_EVERY = 50  # keyframes


@dataclass
class ErrorStateFilter:
    """Extended Kalman filter, fed measurement by measurement.

    Attributes
    ----------
    beginning : of `rovgraph.estimators.initialise.initialise`
    reinitialise_at : times since the start at which the dive so far is solved as a graph, and the filter
        goes on from there [s]
    learn_noise : of the IMU, from its newest samples
    filtered : Gaussian of each keyframe so far, from all data up to it
    departed, steps : for the smoother, of a filter that is not renewed: each keyframe but the newest with what was
        measured before the next, too, and the way from there
    gates : sensors that are being kept out
    """

    beginning: InitialConditions
    reinitialise_at: tuple[float, ...] = ()
    learn_noise: bool = False

    def __post_init__(self) -> None:
        b = self.beginning
        self.assembler = Assembler(b.config, b.instruments, b.start.state.bias[0], learn_noise=self.learn_noise)
        self.intervals: list[KeyframeInterval] = []
        self.recursion = ErrorStateRecursion(b)
        self.error = self.recursion.error
        self.filtered: list[Gaussian] = []
        self.departed: list[Gaussian] = []
        self.steps: list[Step] = []
        self.gates: Gates = {}
        self._renewals = list(self.reinitialise_at)
        self._used: dict[str, list[ProcessedMeasurement]] = {}

    def add(self, measurement: Measurement) -> list[KeyframeInterval]:
        """Take a measurement; times must not decrease."""
        return self._take(self.assembler.add(measurement))

    def finish(self) -> list[KeyframeInterval]:
        """Close the last interval."""
        return self._take(self.assembler.finish())

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self.filtered[-1].state

    def step(self, interval: KeyframeInterval) -> list[ProcessedMeasurement]:
        """Take one interval: update, predict, update; the measurements that entered, or did not."""
        return step_together([self], [interval])[0]

    def passed(self, interval: KeyframeInterval, filter_step: FilterStep) -> None:
        """Keep what came of an interval."""
        if filter_step.departed is not None and filter_step.step is not None and not self.reinitialise_at:
            self.departed.append(filter_step.departed)
            self.steps.append(filter_step.step)
        self.filtered.append(filter_step.filtered)
        for used in filter_step.used:
            self._used.setdefault(used.measurement.sensor, []).append(used)
        self.intervals.append(interval)
        if self._renewals and interval.time - self.intervals[0].time >= self._renewals[0]:
            self._renewals.pop(0)
            states = stack_states([known.state for known in self.filtered])
            self.filtered[-1] = renewed(self.recursion, self.intervals, states)
        self.assembler.time_offsets.assume(self.latest().calibration)

    @property
    def known(self) -> Gaussian:
        """The newest keyframe, or what is believed before the first."""
        return self.filtered[-1] if self.filtered else self.recursion.start()

    def solve(self) -> Estimate:
        """The filter's estimate of every keyframe so far."""
        return self.estimate("filtered" if self.reinitialise_at else "ekf", self.filtered)

    def smoothed(self) -> Estimate:
        """The smoother's estimate of every keyframe so far; not of a filter that was renewed."""
        return smoothed_together([self])[0]

    def backward(self) -> list[Gaussian]:
        """Every keyframe so far, from all data, before it and after.

        e_s = e_f + G (e_s,next - e_predicted,next), G = P_f F' P_predicted^-1, with the
        differences taken along `ErrorVector`'s coordinates.
        """
        return backward_together([self])[0]

    def _take(self, intervals: list[KeyframeInterval]) -> list[KeyframeInterval]:
        for interval in intervals:
            self.step(interval)
        return intervals

    def estimate(self, kind: str, known: Sequence[Gaussian]) -> Estimate:
        """What is known of every keyframe, as an estimate."""
        b, columns = self.beginning, self.error.columns
        states, P = stack_states([k.state for k in known]), self.recursion.covariances(known)
        sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        trajectory = self.recursion.trajectory(self.intervals, known)
        history = bias_histories(trajectory.time, states.bias, sd[:, columns[BIAS]])
        for name in self.recursion.unknowns.estimated:
            history[name] = calibration_history(name, trajectory.time, states.calibration[name], sd[:, columns[name]])
        final = {name: P[-1, columns[name], columns[name]] for name in self.recursion.unknowns.estimated}
        sensors = [s for s in b.instruments if s in self._used]
        calibration = calibration_estimates(self.recursion.beliefs, sensors, known[-1].state.calibration, final)
        residuals = residual_frame(*self._residuals(states if kind == "rts" else None))
        return Estimate(kind, trajectory, calibration, history, residuals, self._summary())

    def _residuals(
        self, smoothed: State | None
    ) -> tuple[Mapping[str, Block], Mapping[str, State], Mapping[str, Array]]:
        """Measurements, the states they are compared with, and their weights.

        Without ``smoothed`` these are the predictions before the measurements entered.
        """
        blocks, here, weights = {}, {}, {}
        for sensor, rows in self._used.items():
            blocks[sensor] = block = self.recursion.measurements.block([used.measurement for used in rows])
            here[sensor] = stack_states([used.state for used in rows])
            if smoothed is not None:
                places = here[sensor].calibration.get(PLACE)
                here[sensor] = smoothed.at(block.keyframe)
                if places is not None:
                    here[sensor] = here[sensor].seeing(places)
            weights[sensor] = np.array([used.weight for used in rows])
        return blocks, here, weights

    def _summary(self) -> dict[str, Any]:
        """Count of keyframes, and of every sensor its mean NIS, which is its dimension where noise is as believed."""
        instruments = self.beginning.instruments
        nis = {}
        for sensor, rows in self._used.items():
            admitted = [used.nis for used in rows if used.weight > 0.0]
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


def backward_together(filters: Sequence[ErrorStateFilter]) -> list[list[Gaussian]]:
    """`ErrorStateFilter.backward` of filters that are `alike`."""
    known = [[one.filtered[-1]] for one in filters]
    for back in range(1, max(len(one.filtered) for one in filters)):
        left = [k for k, one in enumerate(filters) if back < len(one.filtered)]
        departed, steps = [filters[k].departed[-back] for k in left], [filters[k].steps[-back] for k in left]
        earlier = _back(filters[0].recursion, departed, steps, [known[k][-1] for k in left])
        for k, own in zip(left, earlier, strict=True):
            known[k].append(own)
    return [own[::-1] for own in known]


def smoothed_together(filters: Sequence[ErrorStateFilter]) -> list[Estimate]:
    """`ErrorStateFilter.smoothed` of filters that are `alike`."""
    return [one.estimate("rts", known) for one, known in zip(filters, backward_together(filters), strict=True)]


def _back(
    recursion: ErrorStateRecursion, departed: Sequence[Gaussian], steps: Sequence[Step], following: Sequence[Gaussian]
) -> list[Gaussian]:
    """The smoothed states of keyframes, given those of the ones after them."""
    predicted, size = [step.predicted for step in steps], recursion.error.size
    delta, basis = recursion.local(predicted, following)
    # of places, those that both know: one that was forgotten since moves with what it is correlated with
    ours, theirs, shift = common(predicted[0].places, following[0].places)
    here, there = columns(size, ours), columns(size, theirs)
    delta, basis = np.concatenate([delta, np.tile(shift, (len(delta), 1))], axis=1), extended(basis, len(here))
    F, Q = np.array([step.F[here] for step in steps]), np.array([step.Q[np.ix_(here, here)] for step in steps])
    P_predicted = np.array([one.P[np.ix_(here, here)] for one in predicted])
    P_following = np.array([one.P[np.ix_(there, there)] for one in following])
    P = np.array([one.P for one in departed])
    sd = np.sqrt(np.diagonal(P_predicted, axis1=1, axis2=2))[..., None]  # metres beside rad/s: solved with unit sds
    G = transpose(np.linalg.solve(P_predicted / (sd * transpose(sd)), F @ P / sd) / sd)
    kept = np.eye(P.shape[1]) - G @ F
    P = kept @ P @ transpose(kept) + G @ (basis @ P_following @ transpose(basis) + Q) @ transpose(G)
    return recursion.corrected(departed, (G @ delta[..., None])[..., 0], P)


def alike(some: InitialConditions, other: InitialConditions) -> bool:
    """Whether filters of two dives can go side by side: but for the start they know the same, and of no places."""
    config = other.config.model_copy(update={"start": some.config.start})
    sensors = list(some.instruments)
    return config == some.config and list(other.instruments) == sensors and "place" not in sensors


def replay(
    intervals: Sequence[KeyframeInterval],
    beginning: InitialConditions,
    reinitialise_at: tuple[float, ...] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> ErrorStateFilter:
    """A filter that has taken the intervals of a dive; ``progress`` is told 0 to 1 now and then."""
    estimator = ErrorStateFilter(beginning, reinitialise_at)
    replay_together([estimator], [intervals], progress)
    return estimator


def replay_together(
    filters: Sequence[ErrorStateFilter],
    dives: Sequence[Sequence[KeyframeInterval]],
    progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Let filters that are `alike` take the intervals of a dive each."""
    longest = max(len(intervals) for intervals in dives)
    for index in range(longest):
        left = [k for k, intervals in enumerate(dives) if index < len(intervals)]
        step_together([filters[k] for k in left], [dives[k][index] for k in left])
        if index % PROGRESS_EVERY == 0:
            progress(index / longest)


def step_together(
    filters: Sequence[ErrorStateFilter], intervals: Sequence[KeyframeInterval]
) -> list[list[ProcessedMeasurement]]:
    """`ErrorStateFilter.step` of filters that are `alike` and have taken equally many intervals."""
    known, gates = [one.known for one in filters], [one.gates for one in filters]
    filter_steps = filters[0].recursion.through_together(intervals, known, gates)
    for one, interval, filter_step in zip(filters, intervals, filter_steps, strict=True):
        one.passed(interval, filter_step)
    return [filter_step.used for filter_step in filter_steps]
