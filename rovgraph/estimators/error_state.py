"""Error-state Kalman filter driven by the IMU, and its smoother.

The error has 15 components (attitude, position, velocity, biases) and those of the
calibration that is estimated. Motion, measurement models, noise, losses, gates and start
are the graph's own. What differs: every measurement is linearised once, where it comes, and
only the newest keyframe is kept. The smoother goes back over the filter's steps (Rauch, Tung
and Striebel 1965) without linearising anew.

Per interval, the measurements between two keyframes update the earlier one, as they do in
the graph; the state goes on to the next keyframe with the IMU; what was measured there
updates it.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from rovgraph.config import beliefs
from rovgraph.estimators.error_vector import ErrorVector
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.incremental import READMIT_AFTER
from rovgraph.estimators.initialise import Beginning
from rovgraph.estimators.results import (
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    residual_frame,
)
from rovgraph.estimators.robust_update import normalised_squared, robust_update
from rovgraph.geometry import Array, transpose
from rovgraph.graph.assembly import Assembler, Attached, Interval
from rovgraph.graph.batch import make_problem, make_values, newest_covariance, solve
from rovgraph.graph.factors import predict
from rovgraph.graph.keys import unknowns
from rovgraph.graph.measurements import Block, make_block
from rovgraph.graph.transition import transition
from rovgraph.log import Measurement
from rovgraph.state import BIAS, POSE, VELOCITY, State, stack_states

# since the start, for `ErrorStateFilter.renew_at`: while heading, mounting and compasses are known to
# several degrees only, what was linearised once misstates what it knows by the square of that
RENEW_AT_S = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0, 320.0, 640.0, 1280.0)
PROGRESS_EVERY = 50  # keyframes


@dataclass(frozen=True)
class Gaussian:
    """A state with the covariance of its error, in the order of `ErrorVector`.

    Attributes
    ----------
    state : State of one epoch
    P : ndarray, shape (size, size)
    """

    state: State
    P: Array


@dataclass(frozen=True)
class Step:
    """What the smoother needs of a keyframe.

    Attributes
    ----------
    F, Q : ndarray, shape (size, size), transition from the keyframe before, and its noise
    predicted : before anything that was measured at the keyframe
    """

    F: Array
    Q: Array
    predicted: Gaussian


@dataclass
class Tally:
    """Gating of one sensor.

    Attributes
    ----------
    nis : normalised innovations squared, of what was let in
    rejected : count of what was not
    running : rejections since the last that was consistent
    """

    nis: list[float] = field(default_factory=list)
    rejected: int = 0
    running: int = 0


@dataclass
class ErrorStateFilter:
    """Extended Kalman filter, fed measurement by measurement.

    Attributes
    ----------
    beginning : of `rovgraph.estimators.initialise.initialise`
    renew_at : times since the start at which the dive so far is solved as a graph, and the filter
        goes on from there [s]
    filtered : Gaussian of each keyframe so far, from all data up to it
    """

    beginning: Beginning
    renew_at: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        b = self.beginning
        self.assembler = Assembler(b.config, b.instruments, b.start.state.bias[0])
        self.intervals: list[Interval] = []
        self.beliefs = beliefs(b.config)
        self.unknowns = unknowns(self.beliefs, b.instruments)
        self.error = ErrorVector(self.unknowns.estimated, b.instruments)
        self.filtered: list[Gaussian] = []
        self._renewals = list(self.renew_at)
        self._departed: list[Gaussian] = []  # with what was measured before the next keyframe, too
        self._steps: list[Step] = []
        self._used: dict[str, list[tuple[Attached, State, float]]] = {}
        self._tally: dict[str, Tally] = {}

    def add(self, measurement: Measurement) -> list[Interval]:
        """Take a measurement; times must not decrease."""
        return self._take(self.assembler.add(measurement))

    def finish(self) -> list[Interval]:
        """Close the last interval."""
        return self._take(self.assembler.finish())

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self.filtered[-1].state

    def step(self, interval: Interval) -> None:
        """Take one interval: update, predict, update."""
        if interval.pim is None:
            predicted = self._start()
        else:
            before = [a for a in interval.attached if a.keyframe < interval.index]
            self._departed.append(self._update(self.filtered[-1], before))
            predicted = self._predict(interval, self._departed[-1])
        here = [a for a in interval.attached if a.keyframe == interval.index]
        self.filtered.append(self._update(predicted, here))
        self.intervals.append(interval)
        if self._renewals and interval.time - self.intervals[0].time >= self._renewals[0]:
            self._renewals.pop(0)
            self.filtered[-1] = self._renewed()

    def solve(self) -> Estimate:
        """The filter's estimate of every keyframe so far."""
        return self._estimate("filtered" if self.renew_at else "ekf", self.filtered)

    def smoothed(self) -> Estimate:
        """The smoother's estimate of every keyframe so far; not of a filter that was renewed."""
        return self._estimate("rts", self.backward())

    def backward(self) -> list[Gaussian]:
        """Every keyframe so far, from all data, before it and after.

        e_s = e_f + G (e_s,next - e_predicted,next), G = P_f F' P_predicted^-1, with the
        differences taken along `ErrorVector`'s coordinates.
        """
        known = [self.filtered[-1]]
        for departed, step in zip(reversed(self._departed), reversed(self._steps), strict=True):
            known.append(self._back(departed, step, known[-1]))
        return known[::-1]

    def _take(self, intervals: list[Interval]) -> list[Interval]:
        for interval in intervals:
            self.step(interval)
        return intervals

    def _start(self) -> Gaussian:
        """The prior: the graph's."""
        start = self.beginning.start
        R_nb = start.state.R_nb[0]
        sd = [start.rpy_sd, start.p_sd, start.v_sd, start.bias_sd]
        sd += [np.full(self.beliefs[name].variable.dim, self.beliefs[name].sd) for name in self.unknowns.estimated]
        P = np.diag(np.concatenate(sd) ** 2)
        P[:3, :3], P[3:6, 3:6] = (transpose(R_nb) @ P[i : i + 3, i : i + 3] @ R_nb for i in (0, 3))
        return Gaussian(replace(start.state, calibration=self.unknowns.fixed), P)

    def _renewed(self) -> Gaussian:
        """The newest keyframe as the graph of the dive so far has it, every factor linearised at the optimum."""
        b, before = self.beginning, self.filtered[-1]
        problem = make_problem(self.intervals, b.start, b.config, self.beliefs, b.instruments)
        states = stack_states([known.state for known in self.filtered])
        solution = solve(problem, make_values(problem, states, before.state.calibration))
        newest = problem.states(solution.values).at([problem.count - 1])
        calibration = {name: value.reshape(-1) for name, value in newest.calibration.items()}
        known = [np.arange(15)] + [np.r_[self.error.columns[name]] for name in problem.unknowns.estimated]
        P = self._start().P  # of what no sensor has shown yet
        P[np.ix_(np.concatenate(known), np.concatenate(known))] = newest_covariance(problem, solution)
        return Gaussian(replace(newest, calibration=calibration), P)

    def _predict(self, interval: Interval, before: Gaussian) -> Gaussian:
        """The next keyframe, from the IMU alone; calibration walks."""
        state = predict(interval, before.state)
        F, Q = np.eye(self.error.size), np.zeros_like(before.P)
        F[:15, :15], Q[:15, :15] = transition(interval, before.state, state)
        seconds = interval.time - self.intervals[-1].time
        for name, walk in self.unknowns.walks.items():
            columns = self.error.columns[name]
            Q[columns, columns] = np.eye(self.beliefs[name].variable.dim) * walk**2 * seconds
        P = F @ before.P @ F.T + Q
        predicted = Gaussian(state, 0.5 * (P + P.T))
        self._steps.append(Step(F, Q, predicted))
        return predicted

    def _update(self, before: Gaussian, attached: Sequence[Attached]) -> Gaussian:
        """The state corrected by measurements that belong to its keyframe."""
        r, H, losses, admitted = [], [], [], []
        for a in attached:
            block = self._block([a])
            own_r, jacobians = block.linearize(before.state)
            own_H = self.error.matrix(jacobians)
            if self._admit(block, before.P, own_r[0], own_H[0]):
                r.append(own_r[0])
                H.append(own_H[0])
                losses.append(block.instrument.loss)
                admitted.append(a)
            else:
                self._use(a, before.state, 0.0)
        if not admitted:
            return before
        delta, P, weights = robust_update(before.P, r, H, losses)
        for a, weight in zip(admitted, weights, strict=True):
            self._use(a, before.state, weight)
        state, basis = self.error.retract(before.state, delta)
        return Gaussian(state, basis @ P @ basis.T)

    def _admit(self, block: Block, P: Array, r: Array, H: Array) -> bool:
        """Whether a measurement's normalised innovation lies within its gate."""
        tally = self._tally.setdefault(block.instrument.model.sensor, Tally())
        nis, gate = normalised_squared(P, r, H), block.instrument.gate_sd
        consistent = gate is None or nis <= gate**2
        tally.running = 0 if consistent else tally.running + 1
        if consistent or tally.running > READMIT_AFTER:
            tally.nis.append(nis)
            return True
        tally.rejected += 1
        return False

    def _use(self, attached: Attached, state: State, weight: float) -> None:
        self._used.setdefault(attached.sensor, []).append((attached, state, weight))

    def _block(self, attached: Sequence[Attached]) -> Block:
        b = self.beginning
        instrument, gravity = b.instruments[attached[0].sensor], b.config.environment.gravity_mps2
        return make_block(attached, instrument, gravity, self.unknowns)

    def _back(self, departed: Gaussian, step: Step, following: Gaussian) -> Gaussian:
        """The smoothed state of a keyframe, given that of the one after it."""
        delta, basis = self.error.local(step.predicted.state, following.state)
        sd = np.sqrt(np.diag(step.predicted.P))  # metres beside rad/s: solved with unit variances
        G = np.linalg.solve(step.predicted.P / np.outer(sd, sd), step.F @ departed.P / sd[:, None]).T / sd
        kept = np.eye(self.error.size) - G @ step.F
        P = kept @ departed.P @ kept.T + G @ (basis @ following.P @ basis.T + step.Q) @ G.T
        state, basis = self.error.retract(departed.state, G @ delta)
        return Gaussian(state, basis @ P @ basis.T)

    def _estimate(self, kind: str, known: Sequence[Gaussian]) -> Estimate:
        b, columns = self.beginning, self.error.columns
        states, P = stack_states([k.state for k in known]), np.array([k.P for k in known])
        sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
        pose, velocity = (P[:, columns[v], columns[v]] for v in (POSE, VELOCITY))
        trajectory = body_trajectory(self.intervals, states, b.config.imu.lever_arm_m, pose, velocity)
        history = bias_histories(trajectory.time, states.bias, sd[:, columns[BIAS]])
        for name in self.unknowns.estimated:
            history[name] = calibration_history(name, trajectory.time, states.calibration[name], sd[:, columns[name]])
        final = {name: P[-1, columns[name], columns[name]] for name in self.unknowns.estimated}
        sensors = [s for s in b.instruments if s in self._used]
        calibration = calibration_estimates(self.beliefs, sensors, known[-1].state.calibration, final)
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
            blocks[sensor] = block = self._block([attached for attached, _, _ in rows])
            here[sensor] = smoothed.at(block.keyframe) if smoothed else stack_states([state for _, state, _ in rows])
            weights[sensor] = np.array([weight for _, _, weight in rows])
        return blocks, here, weights

    def _summary(self) -> dict[str, Any]:
        """Count of keyframes, and of every sensor its mean NIS, which is its dimension where noise is as believed."""
        instruments = self.beginning.instruments
        nis = {
            sensor: {
                "mean": float(np.mean(tally.nis)) if tally.nis else None,
                "dim": instruments[sensor].model.dim,
                "count": len(tally.nis),
                "rejected": tally.rejected,
            }
            for sensor, tally in self._tally.items()
        }
        return {
            "keyframes": len(self.intervals),
            "nis": nis,
            "bridged_intervals": sum(i.bridged for i in self.intervals),
        }


def replay(
    intervals: Sequence[Interval],
    beginning: Beginning,
    renew_at: tuple[float, ...] = (),
    progress: Callable[[float], None] = lambda done: None,
) -> ErrorStateFilter:
    """A filter that has taken the intervals of a dive; ``progress`` is told 0 to 1 now and then."""
    estimator = ErrorStateFilter(beginning, renew_at)
    for interval in intervals:
        estimator.step(interval)
        if interval.index % PROGRESS_EVERY == 0:
            progress(interval.index / len(intervals))
    return estimator
