"""Dead reckoning: gyro levelled by gravity and turned by a compass, DVL integrated.

A pilot without an estimator has this, and it is the smoother's initial guess. The attitude is that of
`rovgraph.kernels.dead_reckoning`, whose gains follow the configured noise. Calibration is held at its means, and every
ping that `graph` admits is used, at its own time. Between pings velocity is linear in body axes; in a longer gap it is
the velocity through the water, if that is measured, plus the current of the pings around.
"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, cross, earth_rate_n, exp_rotation, identity, rotate, transpose
from rovgraph.inference.initialise import by_accuracy, solve_turn, turn_noise
from rovgraph.kernels import motion_row as at
from rovgraph.kernels.dead_reckoning import Aiding, LevelStart, Motions, Surroundings, reckon_attitude
from rovgraph.kernels.earth import latitude_at
from rovgraph.kernels.measurement_row import ASSUMED, DP, DR, DT, DV, RATE, RATE_SD, TIME
from rovgraph.kernels.motion import BRIDGE_ACC, BRIDGE_GYR
from rovgraph.model.config import Config, beliefs
from rovgraph.model.origin import scale_at
from rovgraph.model.state import State
from rovgraph.problem.beams import SolvedPings, solved_pings
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.problem import Problem
from rovgraph.sensors import dvl_mounting
from rovgraph.sensors.instruments import HEADING_STREAMS

KEEPS_HEADING_S = 20.0  # for so long what is fixed in the body is fixed in n
PING_VALID_S = 2.0  # for so long a ping's velocity is used
HELD_SD = 0.3  # of the velocity that is held after that [m/s]
CURRENT_S = 30.0  # of pings that determine the current


@dataclass(frozen=True)
class _Epochs:
    """Keyframes, and what is measured at them and between them, m in the order of time.

    Attributes
    ----------
    time : ndarray, shape (m,) [s]
    dt, dR, dv : ndarray, shape (m,), (m, 3, 3), (m, 3), motion since the epoch before
    assumed : ndarray, shape (m, 6), bias that the motion is for
    bridged, outage : ndarray of bool, shape (m,), samples of the IMU are missing; for so long that it is an outage
    keyframe : ndarray of int, shape (n,), epochs of the keyframes
    problem : the dive
    measured, epoch : ndarray of int, measurements in the order of time, and the epoch of each
    by_beams : pings that were taken by their beams, each an epoch by one of these
    """

    time: Array
    dt: Array
    dR: Array
    dv: Array
    assumed: Array
    bridged: NDArray[np.bool_]
    outage: NDArray[np.bool_]
    keyframe: NDArray[np.intp]
    problem: Problem
    measured: NDArray[np.int64]
    epoch: NDArray[np.intp]
    by_beams: SolvedPings

    def of(self, sensor: str | None) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Epochs and measurements of a sensor."""
        of_sensor = np.isin(self.measured, self.problem.of_sensor(sensor))
        return self.epoch[of_sensor], self.measured[of_sensor]


@dataclass(frozen=True)
class _Pings:
    """Velocity of the IMU by n pings, over ground or through the water.

    Attributes
    ----------
    epoch : ndarray of int, shape (n,)
    velocity_b : ndarray, shape (n, 3), but for what the gyro's bias does over the lever arm [m/s]
    variance : ndarray, shape (n,), of a horizontal component
    arm : ndarray, shape (3,), lever arm of the DVL from the IMU [m]
    """

    epoch: NDArray[np.intp]
    velocity_b: Array
    variance: Array
    arm: Array

    def corrected(self, bias: Array) -> Array:
        """Velocity of the IMU, body axes, shape (n, 3), with the bias of all epochs, shape (m, 6)."""
        return self.velocity_b + cross(bias[self.epoch, 3:], self.arm)


def dead_reckon(problem: Problem, initial: InitialConditions, calibration: Mapping[str, Array]) -> State:
    """The state at every keyframe, at the IMU.

    Parameters
    ----------
    problem : n keyframes
    initial : the resolved start
    calibration : all calibration variables, at their means

    Returns
    -------
    State of n epochs
    """
    sources: list[str] = [s for s in HEADING_STREAMS if s in initial.instruments]
    compass = next(iter(by_accuracy(initial.config, sources)), None)
    epochs = _gather(problem, {"dvl", "dvl_water", compass})
    bottom, water = (_pings(epochs, sensor, initial, calibration) for sensor in ("dvl", "dvl_water"))
    R_nb, bias = _attitudes(epochs, bottom, compass, initial, calibration)
    v_n = _velocities(epochs, R_nb, bias, bottom, water, calibration["current"])
    step = 0.5 * (v_n[1:] + v_n[:-1]) * np.diff(epochs.time)[:, None]
    k = epochs.keyframe
    began, latitude = initial.prior.state.p_n[0], initial.config.environment.earth_latitude
    p_n = began + np.vstack([np.zeros(3), np.cumsum(step, axis=0)])
    for _ in range(2):  # the scales are those of where it is
        metres = scale_at(latitude, 0.5 * (p_n[1:] + p_n[:-1]))
        p_n = began + np.vstack([np.zeros(3), np.cumsum(metres * step, axis=0)])
    p_n = p_n[k]
    p_n[:, 2] = _depths(problem, p_n[:, 2], R_nb[k], initial, calibration)
    return State(R_nb[k], p_n, v_n[k], bias[k], dict(calibration))


def _motions(problem: Problem) -> tuple[Array, Array, Array, Array]:
    """Duration of n intervals, their rotations and velocities, and the biases that they are for; zero where none."""
    rows = np.zeros((len(problem), at.NOISE))
    rows[1:] = problem.motions[:, : at.NOISE]
    tangent = rows[:, at.TANGENT : at.BIAS]
    return rows[:, at.DURATION], exp_rotation(tangent[:, :3]), tangent[:, 6:], rows[:, at.BIAS :]


def _gather(problem: Problem, sensors: Collection[str | None]) -> _Epochs:
    """The epochs of all keyframes and of some sensors."""
    n, by_beams = len(problem), solved_pings(problem)
    wanted = np.isin(problem.which, [k for k, sensor in enumerate(problem.sensors) if sensor in sensors])
    wanted[by_beams.row] = True
    measured = np.flatnonzero(wanted)
    interval, rows = problem.interval[measured], problem.rows[measured]
    here = problem.keyframe[measured] == interval
    # in an interval first what lies between the keyframes, then its own, then what is measured there
    order = np.argsort(np.concatenate([3 * np.arange(n) + 1, 3 * interval + 2 * here]), kind="stable")
    place = np.empty(len(order), np.intp)
    place[order] = np.arange(len(order))
    keyframe, k, of = place[:n], place[n:], np.concatenate([np.arange(n), interval])[order]
    m, dR_of = len(order), rows[:, DR:DV].reshape(-1, 3, 3)
    time, dt, dR, dv, assumed = np.empty(m), np.empty(m), np.empty((m, 3, 3)), np.empty((m, 3)), np.empty((m, 6))
    time[keyframe] = problem.time
    dt[keyframe], dR[keyframe], dv[keyframe], assumed[keyframe] = _motions(problem)
    time[k], dt[k], dR[k], dv[k] = rows[:, TIME], rows[:, DT], dR_of, rows[:, DV:DP]
    assumed[k] = rows[:, ASSUMED : ASSUMED + 6]
    begin, begin_R, begin_v = np.roll(dt, 1), np.roll(dR, 1, axis=0), np.roll(dv, 1, axis=0)
    first = (keyframe + 1) % m
    begin[first], begin_R[first], begin_v[first] = 0.0, identity(3), 0.0
    return _Epochs(
        time,
        dt - begin,
        transpose(begin_R) @ dR,
        rotate(transpose(begin_R), dv - begin_v),
        assumed,
        problem.bridged[of],
        problem.coasted[of],
        keyframe,
        problem,
        measured,
        k,
        by_beams,
    )


def _pings(epochs: _Epochs, sensor: str, initial: InitialConditions, calibration: Mapping[str, Array]) -> _Pings:
    k, pings = epochs.of(sensor)
    velocity_s, var = epochs.problem.z(pings, 3), epochs.problem.sd(pings, 3) ** 2
    if sensor == "dvl" and len(solved := epochs.by_beams.row):
        k = np.concatenate([k, epochs.epoch[np.isin(epochs.measured, solved)]])
        order = np.argsort(k)
        k, pings = k[order], np.concatenate([pings, solved])[order]
        velocity_s = np.vstack([velocity_s, epochs.by_beams.velocity])[order]
        var = np.vstack([var, epochs.by_beams.variance])[order]
    if not len(k):
        return _Pings(k, np.zeros((0, 3)), np.zeros(0), np.zeros(3))
    still = np.zeros((1, 3))
    R_bs = dvl_mounting(State(np.eye(3)[None], still, still, np.zeros((1, 6)), calibration))[0]
    config = initial.config
    arm = np.array(config.dvl.lever_arm_m) - np.array(config.imu.lever_arm_m) + calibration["dvl_lever_arm"]
    rows = epochs.problem.rows[pings]
    rate_b, rate_sd = rows[:, RATE : RATE + 3], rows[:, RATE_SD]
    velocity_b = velocity_s @ R_bs.T / (1.0 + calibration["dvl_scale"]) - cross(rate_b, arm)
    horizontal_var = 0.5 * (np.sum(var, axis=1) - np.min(var, axis=1))  # the smallest is that of the vertical
    return _Pings(k, velocity_b, horizontal_var + np.dot(arm, arm) * rate_sd**2, arm)


def _attitudes(
    epochs: _Epochs, bottom: _Pings, compass: str | None, initial: InitialConditions, calibration: Mapping[str, Array]
) -> tuple[Array, Array]:
    """Attitude and bias at all epochs, shapes (m, 3, 3), (m, 6).

    Tilt hardly depends on heading: it is found first, and with it the compass's heading.
    """
    start, config, m = initial.prior, initial.config, len(epochs.time)
    bias, gyr_sd, env = start.state.bias[0], start.bias_sd[3:].max(), config.environment
    dvl, turns = np.tile([0.0, 0.0, 0.0, math.inf], (m, 1)), np.tile([0.0, math.inf, 0.0], (m, 1))
    dvl[bottom.epoch] = np.column_stack([bottom.velocity_b, bottom.variance])
    P = np.zeros((2, 3, 3))
    P[0] = np.diag([start.v_sd.max(), start.rpy_sd[:2].max(), gyr_sd]) ** 2
    P[1] = np.diag([0.0, start.rpy_sd[2], gyr_sd]) ** 2
    held, arm = 2.0 * KEEPS_HEADING_S * HELD_SD**2, np.require(bottom.arm, float, ("C", "W"))
    latitude = latitude_at(env.earth_latitude, start.state.p_n[0, 0])
    around = Surroundings(env.gravity, PING_VALID_S, held, 0.0, _earth_rate(config), float(latitude), arm)
    dv = epochs.dv - epochs.dt[:, None] * (bias[:3] - epochs.assumed[:, :3])
    assumed, densities = epochs.assumed[:, 3:].copy(), _densities(epochs, config)
    motions = Motions(epochs.outage, epochs.dt, epochs.dR, dv, assumed, densities)
    R_nb, gyr, aiding = np.empty((m, 3, 3)), np.empty((m, 3)), Aiding(dvl, turns, np.zeros((m, 3, 3)))
    began = LevelStart(start.state.R_nb[0].copy(), bias[3:].copy(), P)
    reckon_attitude(motions, aiding, began, around, R_nb, gyr)
    k, headings = epochs.of(compass)
    if compass is not None and len(k):
        instrument = initial.instruments[compass]
        z = epochs.problem.z(headings, instrument.model.dim)
        turn = solve_turn(instrument, z, R_nb[k], calibration)
        noise = turn_noise(instrument, R_nb[k], turn, calibration, beliefs(config))
        turns[k], aiding.reference[:] = np.column_stack([turn, noise.variance, noise.by_tilt]), R_nb
        P[1, 0, 0] = noise.deviation_var
        around = around._replace(deviation_var=float(noise.deviation_var))
        reckon_attitude(motions, aiding, began, around, R_nb, gyr)
    return R_nb, np.hstack([np.tile(bias[:3], (m, 1)), gyr])


def _densities(epochs: _Epochs, config: Config) -> Array:
    """Squared densities of the noise of specific force, of rate, and of the gyro's walk, shape (m, 3).

    The accelerometer's bias is fixed in the body, which turns: noise that lasts for `KEEPS_HEADING_S`.
    """
    noise = config.imu.noise
    acc = noise.acc**2 + 2.0 * KEEPS_HEADING_S * config.imu.acc_bias_sd_mps2**2
    of_imu, bridged = [acc, noise.gyr**2, noise.gyr_walk**2], [BRIDGE_ACC**2, BRIDGE_GYR**2, noise.gyr_walk**2]
    return np.where(epochs.bridged[:, None], bridged, of_imu)


def _earth_rate(config: Config) -> Array:
    env = config.environment
    return earth_rate_n(np.deg2rad(env.latitude_deg or 0.0)) if env.earth_rotation else np.zeros(3)


def _velocities(epochs: _Epochs, R_nb: Array, bias: Array, bottom: _Pings, water: _Pings, current: Array) -> Array:
    """Velocity of the IMU in n at all epochs, shape (m, 3): linear between pings in body axes, held beyond them."""
    k, v_b = bottom.epoch, bottom.corrected(bias)
    if len(water.epoch):
        lost, drifting_b = _through_water(epochs.time, R_nb, bias, bottom, water, current)
        k, v_b = np.concatenate([k, lost]), np.concatenate([v_b, drifting_b])
        order = np.argsort(k)
        k, v_b = k[order], v_b[order]
    if not len(k):
        return np.zeros((len(R_nb), 3))
    return rotate(R_nb, np.column_stack([np.interp(epochs.time, epochs.time[k], column) for column in v_b.T]))


def _through_water(
    time: Array, R_nb: Array, bias: Array, bottom: _Pings, water: _Pings, current: Array
) -> tuple[NDArray[np.intp], Array]:
    """Epochs of water pings while the bottom is lost, and velocity over ground there, body axes, shape (n, 3).

    The current is what the velocities over ground and through the water differ by, a mean over `CURRENT_S`, and
    linear where the bottom is lost; without any ping on it, it is the one that is believed.
    """
    k, w_n = water.epoch, rotate(R_nb[water.epoch], water.corrected(bias))
    c_n, lost = np.append(current, 0.0), np.full(len(k), True)
    if len(bottom.epoch):
        known = time[bottom.epoch]
        through = np.column_stack([np.interp(known, time[k], column) for column in w_n.T])
        sums = np.vstack([np.zeros(3), np.cumsum(rotate(R_nb[bottom.epoch], bottom.corrected(bias)) - through, axis=0)])
        first, last = known.searchsorted([known - 0.5 * CURRENT_S, known + 0.5 * CURRENT_S])
        means = (sums[last] - sums[first]) / (last - first)[:, None]
        c_n = np.column_stack([np.interp(time[k], known, column) for column in means.T])
        before, behind = known.searchsorted(time[k], "right"), known.searchsorted(time[k], "left")
        bounds = np.concatenate([[-math.inf], known, [math.inf]])
        lost = (before == behind) & (bounds[before + 1] - bounds[before] > PING_VALID_S)
    return k[lost], rotate(transpose(R_nb[k]), w_n + c_n)[lost]


def _depths(
    problem: Problem,
    integrated: Array,
    R_nb: Array,
    initial: InitialConditions,
    calibration: Mapping[str, Array],
) -> Array:
    """Depth of the IMU from the pressure sensor, where there is one."""
    index = problem.of_sensor("depth")
    if not len(index):
        return integrated
    arm = initial.instruments["depth"].model.lever_arm_b  # type: ignore[attr-defined]
    depth = np.interp(problem.time, problem.rows[index, TIME], problem.z(index, 1)[:, 0]) - calibration["depth_offset"]
    depth /= 1.0 + calibration["depth_scale"]
    return np.asarray(depth - rotate(R_nb, arm)[:, 2])
