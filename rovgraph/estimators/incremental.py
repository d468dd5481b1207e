"""Incremental smoothing: iSAM2 over the whole dive, fed interval by interval.

A measurement is gated by its normalised innovation before it enters; a sensor that is
rejected many times running is let in again, so that none is locked out for ever.
"""

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from rovgraph.config import beliefs
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.initialise import Beginning
from rovgraph.estimators.results import (
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    residual_frame,
)
from rovgraph.geometry import Array
from rovgraph.graph.assembly import Assembler, Attached, Interval
from rovgraph.graph.factors import (
    Factor,
    drift,
    motion,
    predict,
    priors,
)
from rovgraph.graph.incremental import Incremental
from rovgraph.graph.keys import unknowns
from rovgraph.graph.measurements import Block, make_block
from rovgraph.graph.preintegration import whole
from rovgraph.graph.values import insert_calibration, state_values
from rovgraph.log import Measurement
from rovgraph.state import BIAS, DIMENSION, POSE, VELOCITY, Jacobians, State, propagate_with_jacobian, stack_states

CALIBRATION_EVERY = 5  # keyframes between new marginals of the calibration
READMIT_AFTER = 5  # rejections running, after which a sensor is believed until it is consistent again


@dataclass(frozen=True)
class _Known:
    """What is known of a keyframe before its measurements: State of one epoch, covariances where they are needed."""

    state: State
    covariances: Callable[[], Mapping[str, Array]]


@dataclass
class IncrementalEstimator:
    """iSAM2 over the whole dive, fed measurement by measurement.

    Attributes
    ----------
    beginning : of `rovgraph.estimators.initialise.initialise`
    """

    beginning: Beginning

    def __post_init__(self) -> None:
        b = self.beginning
        self.assembler = Assembler(b.config, b.instruments, b.start.state.bias[0])
        self.intervals: list[Interval] = []
        self.beliefs = beliefs(b.config)
        self.unknowns = unknowns(self.beliefs, b.instruments)
        self.engine = Incremental(self.unknowns)
        self._states: list[State] = []
        self._covariances: list[dict[str, Array]] = []
        self._used: dict[str, list[tuple[Attached, State, float]]] = {}
        self._rejected: Counter[str] = Counter()

    def add(self, measurement: Measurement) -> list[Interval]:
        """Take a measurement; times must not decrease."""
        return self._take(self.assembler.add(measurement))

    def finish(self) -> list[Interval]:
        """Close the last interval."""
        return self._take(self.assembler.finish())

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self._states[-1]

    def step(self, interval: Interval) -> None:
        """Add one interval to the graph and keep the newest keyframe's estimate."""
        b, index, segment = self.beginning, interval.index, interval.segment
        if interval.pim is None:
            state = replace(b.start.state, calibration=self.unknowns.fixed)
            factors = priors(b.start, self.beliefs, self.unknowns)
            known = {index: _Known(state, dict)}
        else:
            before = self.latest()
            state = predict(interval, before)
            factors = motion(interval, self.unknowns)
            P = self._covariances[-1]
            grown = partial(self._predicted_covariances, interval)
            known = {index - 1: _Known(before, lambda: P), index: _Known(state, grown)}
        values = state_values(index, state)
        if not self.intervals or segment > self.intervals[-1].segment:
            factors += drift(self.unknowns, segment, b.config.graph.segment_s)
            insert_calibration(values, state.calibration, self.unknowns, segment)
        for attached in interval.attached:
            factors += self._factor(attached, known[attached.keyframe])
        self.engine.update(factors, values)
        self.intervals.append(interval)
        self._states.append(self.engine.state(index, segment))
        self._covariances.append(self._newest_covariances(interval))

    def solve(self) -> Estimate:
        """The filtering estimate of every keyframe so far."""
        states = stack_states(self._states)
        P = {v: np.array([c[v] for c in self._covariances]) for v in (*DIMENSION, *self.unknowns.estimated)}
        sd = {v: np.sqrt(np.diagonal(p, axis1=1, axis2=2)) for v, p in P.items()}
        arm = self.beginning.config.imu.lever_arm_m
        trajectory = body_trajectory(self.intervals, states, arm, P[POSE], P[VELOCITY])
        history = bias_histories(trajectory.time, states.bias, sd[BIAS])
        for name in self.unknowns.estimated:
            history[name] = calibration_history(name, trajectory.time, states.calibration[name], sd[name])
        final = {name: P[name][-1] for name in self.unknowns.estimated}
        sensors = [s for s in self.beginning.instruments if s in self._used]
        calibration = calibration_estimates(self.beliefs, sensors, self.latest().calibration, final)
        return Estimate("filtered", trajectory, calibration, history, self._residuals())

    def _newest_covariances(self, interval: Interval) -> dict[str, Array]:
        """Marginals of the newest keyframe; those of the slow calibration only now and then."""
        names = self.unknowns.estimated
        if interval.index % CALIBRATION_EVERY == 0:
            return self.engine.covariances(interval.index, interval.segment, names)
        before = {name: self._covariances[-1][name] for name in names}
        return before | self.engine.covariances(interval.index, interval.segment, ())

    def _predicted_covariances(self, interval: Interval) -> dict[str, Array]:
        """Those of the newest keyframe carried to the end of an interval, where tilt has become velocity.

        Correlations between the variables are left out, and the IMU's noise, which is small beside them.
        """
        assert interval.pim is not None
        P = self._covariances[-1]
        _, F = propagate_with_jacobian(
            self.latest(), whole(interval.pim), self.beginning.config.environment.gravity_mps2
        )
        joint = F[0] @ block_diag(P[POSE], P[VELOCITY], P[BIAS]) @ F[0].T
        return {**P, POSE: joint[:6, :6], VELOCITY: joint[6:9, 6:9], BIAS: joint[9:, 9:]}

    def _take(self, intervals: list[Interval]) -> list[Interval]:
        for interval in intervals:
            self.step(interval)
        return intervals

    def _block(self, attached: list[Attached]) -> Block:
        b = self.beginning
        instrument, gravity = b.instruments[attached[0].sensor], b.config.environment.gravity_mps2
        return make_block(attached, instrument, gravity, self.unknowns)

    def _factor(self, attached: Attached, here: _Known) -> list[Factor]:
        """The factor of a measurement, or none where its gate keeps it out."""
        one = self._block([attached])
        r, H = one.linearize(here.state)
        admitted = self._admit(one, r, H, here)
        self._used.setdefault(attached.sensor, []).append((attached, here.state, float(admitted)))
        if not admitted:
            return []
        return [one.custom_factor()]

    def _admit(self, one: Block, r: Array, H: Jacobians, here: _Known) -> bool:
        """Whether a measurement's normalised innovation lies within its gate."""
        gate, sensor = one.instrument.gate_sd, one.instrument.model.sensor
        if gate is None or np.linalg.norm(r) <= gate or not (covariances := here.covariances()):
            self._rejected[sensor] = 0
            return True
        S = np.eye(r.shape[1])
        for variable, jacobian in H.items():
            S = S + jacobian[0] @ covariances[variable] @ jacobian[0].T
        consistent = float(r[0] @ np.linalg.solve(S, r[0])) <= gate**2
        self._rejected[sensor] = 0 if consistent else self._rejected[sensor] + 1
        return consistent or self._rejected[sensor] > READMIT_AFTER

    def _residuals(self) -> pd.DataFrame:
        """Innovations against the prediction, before the measurement entered."""
        blocks, here, weights = {}, {}, {}
        for sensor, rows in self._used.items():
            blocks[sensor] = self._block([attached for attached, _, _ in rows])
            here[sensor] = stack_states([state for _, state, _ in rows])
            weights[sensor] = np.array([weight for _, _, weight in rows])
        return residual_frame(blocks, here, weights)
