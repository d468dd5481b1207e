"""Dead reckoning: gyro levelled by gravity and turned by a compass, DVL integrated.

What a pilot has without an estimator, and the initial guess of one. Attitude is a
complementary filter with bias feedback (Mahony et al. 2008) at the keyframes' rate,
the mounting is the nominal one, and every ping is believed that `graph` lets in.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.estimators.first_seconds import trusted_first, yaw_correction
from rovgraph.geometry import Array, cross, exp_rotation, rotate, wrap_angle
from rovgraph.instruments import HEADING_STREAMS
from rovgraph.sensors import dvl_mounting
from rovgraph.state import State

LEVEL_S = 10.0  # time constant of levelling by gravity
COMPASS_S = 5.0  # and of following the compass
FIRST_DOWN = np.array([0.0, 0.0, 1.0])


def dead_reckon(
    intervals: Sequence[KeyframeInterval], beginning: InitialConditions, calibration: Mapping[str, Array]
) -> State:
    """The state at every keyframe, at the IMU.

    Parameters
    ----------
    intervals : of `rovgraph.engine.assembly.Assembler`, the first without motion
    beginning : the resolved start
    calibration : all calibration variables, at their means

    Returns
    -------
    State of ``len(intervals)`` epochs
    """
    start = beginning.prior.state
    R, bias = start.R_nb[0], start.bias[0].copy()
    attitudes, biases = [], []
    compass = _compass(beginning)
    for interval in intervals:
        if interval.motion is not None:
            R, bias = _turn(R, bias, interval, beginning, compass, calibration)
        attitudes.append(R)
        biases.append(bias.copy())
    R_nb = np.array(attitudes)
    v_n = _velocities(intervals, R_nb, np.array(biases), beginning, calibration)
    time = np.array([i.time for i in intervals])
    step = 0.5 * (v_n[1:] + v_n[:-1]) * np.diff(time)[:, None]
    p_n = start.p_n[0] + np.vstack([np.zeros(3), np.cumsum(step, axis=0)])
    p_n[:, 2] = _depths(intervals, p_n[:, 2], R_nb, beginning, float(calibration["depth_offset"][0]))
    return State(R_nb, p_n, v_n, np.array(biases), dict(calibration))


def _compass(beginning: InitialConditions) -> str | None:
    sources: list[str] = [s for s in HEADING_STREAMS if s in beginning.instruments]
    return next(iter(trusted_first(beginning.config, sources)), None)


def _turn(
    R: Array,
    bias: Array,
    interval: KeyframeInterval,
    beginning: InitialConditions,
    compass: str | None,
    calibration: Mapping[str, Array],
) -> tuple[Array, Array]:
    """Attitude and bias at the end of an interval."""
    motion = interval.motion
    assert motion is not None
    dt = motion.duration
    excess = bias - motion.bias
    turn = motion.dR @ exp_rotation(-dt * excess[3:])
    correction_n = np.zeros(3)
    for a in interval.measurements:
        if a.sensor == compass and a.keyframe == interval.index - 1:
            there = State((R @ a.motion.dR)[None], np.zeros((1, 3)), np.zeros((1, 3)), bias[None], calibration)
            error = yaw_correction(beginning.instruments[compass], a.z[None], there)[0]
            correction_n += FIRST_DOWN * wrap_angle(error) * min(dt / COMPASS_S, 1.0)
    up_measured = turn.T @ (motion.dv / dt)
    up_measured = up_measured / max(float(np.linalg.norm(up_measured)), 1e-9)
    R = R @ turn
    correction = cross(up_measured, -R[2]) * min(dt / LEVEL_S, 1.0) + R.T @ correction_n
    bias = bias.copy()
    bias[3:] -= correction / (4.0 * LEVEL_S)
    return R @ exp_rotation(correction), bias


def _velocities(
    intervals: Sequence[KeyframeInterval],
    R_nb: Array,
    biases: Array,
    beginning: InitialConditions,
    calibration: Mapping[str, Array],
) -> Array:
    """Velocity of the IMU in n from the pings at keyframes, held or interpolated between them."""
    pings = [(i.index, a) for i in intervals for a in i.measurements if a.sensor == "dvl" and a.keyframe == i.index]
    if not pings:
        return np.zeros((len(intervals), 3))
    index = np.array([k for k, _ in pings])
    here = State(R_nb[index], R_nb[index, 0], R_nb[index, 0], biases[index], dict(calibration))
    z = np.array([a.z for _, a in pings]) / (1.0 + calibration["dvl_scale"])
    rate_b = np.array([a.rate_b for _, a in pings]) - biases[index, 3:]
    arm = beginning.instruments["dvl"].model.lever_arm_b + calibration["dvl_lever_arm"]  # type: ignore[attr-defined]
    v_b = np.einsum("nij,nj->ni", dvl_mounting(here), z) - cross(rate_b, arm)
    v_n = np.einsum("nij,nj->ni", R_nb[index], v_b)
    time = np.array([i.time for i in intervals])
    return np.column_stack([np.interp(time, time[index], column) for column in v_n.T])


def _depths(
    intervals: Sequence[KeyframeInterval], integrated: Array, R_nb: Array, beginning: InitialConditions, offset: float
) -> Array:
    """Depth of the IMU from the pressure sensor, where there is one."""
    found = [(a.time, a.z[0]) for i in intervals for a in i.measurements if a.sensor == "depth"]
    if not found:
        return integrated
    time, depth = np.array(found).T
    arm = beginning.instruments["depth"].model.lever_arm_b  # type: ignore[attr-defined]
    own = np.interp([i.time for i in intervals], time, depth) - offset
    return np.asarray(own - rotate(R_nb, arm)[:, 2])
