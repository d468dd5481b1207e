"""Where a dive begins, and what the configuration leaves to the log.

Attitude comes from gravity (specific force averaged in the axes of the first sample)
and heading from whatever the log has; the gyro's bias from standing still, where it
stands still. An explicit ``start`` goes before all of it.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.errors import InputError
from rovgraph.geometry import Array, exp_rotation, matrix_from_rpy, rotate, rpy_from_matrix
from rovgraph.graph.factors import Start
from rovgraph.graph.noise_floor import NOISIER
from rovgraph.graph.preintegration import scatter
from rovgraph.instruments import Instrument, heading_sources, instruments
from rovgraph.log import Log
from rovgraph.sensors import innovation
from rovgraph.state import POSE, State

WINDOW_S = 5.0  # of the log's beginning, over which it is levelled
QUIET_ACC, QUIET_GYR = 0.15, 0.03  # scatter above the sensor's own noise that counts as quiet [SI]
STILL_GYR_SD = 3e-3  # a vehicle that looks still may turn this much [rad/s]
MOVING_TILT_SD = np.deg2rad(5.0)
UNKNOWN_HEADING_SD = np.deg2rad(20.0)  # the samples themselves enter as factors
START_VELOCITY_SD = 1.0
FIRST_FIX_SD = 5.0  # the fix enters by itself, too, and the vehicle may have moved before it [m]
HEADING_WITHIN_S = 30.0
ENOUGH_SAMPLES = 100


@dataclass(frozen=True)
class Beginning:
    """The resolved start of a dive.

    Attributes
    ----------
    config : effective configuration: what was null is filled in
    instruments : the sensors in use, lever arms relative to the IMU
    start : prior of the first keyframe, at the IMU
    assumptions : what was assumed, one line each
    """

    config: Config
    instruments: dict[str, Instrument]
    start: Start
    assumptions: list[str]

    def state(self) -> dict[str, Any]:
        """What `restored` makes it of again, as plain values and arrays."""
        start = self.start
        return {
            "config": self.config.model_dump(mode="json"),
            "sensors": list(self.instruments),
            "start": {name: getattr(start, name) for name in ("rpy_sd", "p_sd", "v_sd", "bias_sd")},
            "at": {name: getattr(start.state, name) for name in ("R_nb", "p_n", "v_n", "bias")},
            "assumptions": self.assumptions,
        }


def restored(state: Mapping[str, Any]) -> Beginning:
    """A beginning from its `Beginning.state`."""
    config = Config.model_validate(state["config"])
    sensors = instruments(config, config.imu.lever_arm_m)
    start = Start(State(**state["at"]), **state["start"])
    return Beginning(config, {s: sensors[s] for s in state["sensors"]}, start, list(state["assumptions"]))


def initialise(log: Log, config: Config, expected: Collection[str] = ()) -> Beginning:
    """Resolve everything that the configuration leaves to the log.

    Parameters
    ----------
    log, config : the dive, or its first seconds
    expected : streams that may still come, beside those of the log

    Raises
    ------
    InputError : no IMU; neither DVL nor fixes; no heading and no ``start.heading_deg``
    """
    if "imu" not in log:
        raise InputError(f"{log.source}: no IMU, columns acc_x..acc_z and gyr_x..gyr_z are needed")
    if "dvl" not in log and "fix" not in log:
        raise InputError(
            f"{log.source}: neither DVL (dvl_vx, dvl_vy, dvl_vz) nor position fixes, one of them is needed"
        )
    assumptions: list[str] = []
    config = _resolve_environment(log, config, assumptions)
    config = _resolve_noise(log, config, assumptions)
    sensors = instruments(config, config.imu.lever_arm_m)
    sources = heading_sources(config, log.sensors)
    present = log.sensors | set(expected)
    used = [s for s in ("dvl", "dvl_water", "depth", "fix", "place") if s in present] + heading_sources(config, present)
    used += _thrusters(log, config)
    sensors = {s: sensors[s] for s in used}
    assumptions.append("heading from " + (", ".join(sources) or "start.heading_deg alone: it will drift"))

    f_b, gyr_mean, quiet, seconds = _first_seconds(log, config)
    R_nb, rpy_sd = _attitude(log, config, sensors, sources, f_b, quiet, assumptions)
    bias, bias_sd = _bias(config, gyr_mean, quiet, seconds, assumptions)
    p_n, p_sd = _position(log, config, R_nb, assumptions)
    rpy, start = np.rad2deg(rpy_from_matrix(R_nb)), config.start
    filled = start.model_copy(
        update={
            "roll_deg": float(rpy[0]),
            "pitch_deg": float(rpy[1]),
            "heading_deg": float(rpy[2] % 360.0),
            "north_m": float(p_n[0]),
            "east_m": float(p_n[1]),
            "down_m": float(p_n[2]),
            "position_sd_m": float(p_sd[0]),
            "down_sd_m": float(p_sd[2]),
            "tilt_sd_deg": float(np.rad2deg(rpy_sd[0])),
            "heading_sd_deg": float(np.rad2deg(rpy_sd[2])),
        }
    )
    config = config.model_copy(update={"start": filled})
    at_imu = p_n + R_nb @ np.asarray(config.imu.lever_arm_m)
    state = State(R_nb[None], at_imu[None], np.zeros((1, 3)), bias[None])
    prior = Start(state, rpy_sd, p_sd, np.full(3, START_VELOCITY_SD), bias_sd)
    return Beginning(config, sensors, prior, assumptions)


def _thrusters(log: Log, config: Config) -> list[str]:
    """The stream of thruster signals, where hydrodynamics are asked for."""
    if not config.graph.hydrodynamics:
        return []
    wanted = len(config.vehicle.thrusters)
    if "thruster" not in log:
        raise InputError(
            f"{log.source}: graph.hydrodynamics needs thruster signals, columns thruster_1, thruster_2, ..."
        )
    if len(log["thruster"].columns) != wanted:
        raise InputError(
            f"{log.source}: {len(log['thruster'].columns)} thruster columns, vehicle.thrusters has {wanted}; "
            "describe every thruster in the configuration"
        )
    return ["thruster"]


def _resolve_environment(log: Log, config: Config, assumptions: list[str]) -> Config:
    """Fill in the field's magnitude and dip, and the latitude."""
    env, changes = config.environment, {}
    if "mag" in log and "mag" in heading_sources(config, log.sensors):
        mag = log["mag"].data
        norm = np.linalg.norm(mag, axis=1)
        if env.field_norm is None:
            changes["field_norm"] = float(np.median(norm))
            assumptions.append(f"environment.field_norm {changes['field_norm']:.4g}, the median of the log")
        if env.dip_deg is None:
            imu = log["imu"]
            f = np.column_stack([np.interp(log["mag"].time, imu.time, a) for a in imu.data[:, :3].T])
            sine = -np.sum(f * mag, axis=1) / (np.linalg.norm(f, axis=1) * norm)
            changes["dip_deg"] = float(np.rad2deg(np.arcsin(np.clip(np.median(sine), -1.0, 1.0))))
            assumptions.append(f"environment.dip_deg {changes['dip_deg']:.1f}, from the log")
            if not beliefs(config)["field_dip"].estimate:
                hint = "give it, or estimate calibration.field_dip"
                assumptions[-1] += f", and held although it errs as the levelling does: {hint}"
    if env.latitude_deg is None and log.origin is not None:
        changes["latitude_deg"] = log.origin[0]
    if env.earth_rotation and env.latitude_deg is None and log.origin is None:
        raise InputError("environment.earth_rotation needs environment.latitude_deg, as the log has no fix_lat")
    return config.model_copy(update={"environment": env.model_copy(update=changes)}) if changes else config


def sample_density(time: Array, samples: Array) -> float:
    """Noise density that samples show by themselves, blind to knocks [unit/rtHz].

    Parameters
    ----------
    time : ndarray, shape (n,)
    samples : ndarray, shape (n, 3)
    """
    return float(np.mean(1.4826 * np.median(np.abs(scatter(time, samples)), axis=0)))


def _resolve_noise(log: Log, config: Config, assumptions: list[str]) -> Config:
    """Raise the IMU's noise densities to what its samples scatter in this dive."""
    imu, noise, changes = log["imu"], config.imu.noise, {}
    if len(imu) < ENOUGH_SAMPLES:
        return config
    for name, columns in (("acc", slice(0, 3)), ("gyr", slice(3, 6))):
        seen, believed = sample_density(imu.time, imu.data[:, columns]), getattr(noise, name)
        if seen > NOISIER * believed:
            changes[name] = seen
            assumptions.append(f"imu.noise.{name} {seen:.2g} instead of {believed:.2g}: the samples scatter that much")
    if not changes:
        return config
    imu_section = config.imu.model_copy(update={"noise": noise.model_copy(update=changes)})
    return config.model_copy(update={"imu": imu_section})


def _first_seconds(log: Log, config: Config) -> tuple[Array, Array, bool, float]:
    """Mean specific force in the first sample's axes, mean rate, whether quiet, length [s]."""
    imu, R_bs = log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    first = imu.time <= imu.time[0] + WINDOW_S
    time, acc, gyr = imu.time[first], imu.data[first, :3] @ R_bs.T, imu.data[first, 3:] @ R_bs.T
    seconds = float(time[-1] - time[0])
    if len(time) < 3:
        return acc.mean(axis=0), gyr.mean(axis=0), False, seconds
    rate = (len(time) - 1) / seconds
    noise = config.imu.noise
    quiet = bool(
        (acc.std(axis=0) < QUIET_ACC + 2.0 * noise.acc * np.sqrt(rate)).all()
        and (gyr.std(axis=0) < QUIET_GYR + 2.0 * noise.gyr * np.sqrt(rate)).all()
        and np.linalg.norm(gyr.mean(axis=0)) < 3.0 * np.deg2rad(config.imu.gyr_bias_sd_dps)
    )
    if quiet:
        return acc.mean(axis=0), gyr.mean(axis=0), True, seconds
    turned, forces = np.eye(3), [acc[0]]
    for k in range(1, len(time)):
        turned = turned @ exp_rotation(0.5 * (gyr[k] + gyr[k - 1]) * (time[k] - time[k - 1]))
        forces.append(turned @ acc[k])
    return np.mean(forces, axis=0), gyr.mean(axis=0), False, seconds


def _attitude(
    log: Log,
    config: Config,
    sensors: dict[str, Instrument],
    sources: list[str],
    f_b: Array,
    quiet: bool,
    assumptions: list[str],
) -> tuple[Array, Array]:
    """R_nb of the first epoch and the sd of roll, pitch, yaw."""
    start = config.start
    roll = np.arctan2(-f_b[1], -f_b[2]) if start.roll_deg is None else np.deg2rad(start.roll_deg)
    pitch = np.arctan2(f_b[0], np.hypot(f_b[1], f_b[2])) if start.pitch_deg is None else np.deg2rad(start.pitch_deg)
    tilt_sd = np.deg2rad(start.tilt_sd_deg)
    if not quiet and (start.roll_deg is None or start.pitch_deg is None):
        tilt_sd = max(tilt_sd, MOVING_TILT_SD)
        assumptions.append("the log begins in motion: levelled roughly, roll and pitch settle in the graph")
    yaw_sd = np.deg2rad(start.heading_sd_deg)
    if start.heading_deg is None:
        level = matrix_from_rpy([roll, pitch, 0.0])
        yaw, source = _first_heading(log, config, sensors, sources, level)
        yaw_sd = max(yaw_sd, UNKNOWN_HEADING_SD)
        assumptions.append(f"start.heading_deg {np.rad2deg(yaw) % 360.0:.1f}, from {source}")
    else:
        yaw = np.deg2rad(start.heading_deg)
    return matrix_from_rpy([roll, pitch, yaw]), np.array([tilt_sd, tilt_sd, yaw_sd])


def trusted_first(config: Config, sources: list[str]) -> list[str]:
    """Heading sources with those first whose offset is held fixed, or known best."""
    priors = beliefs(config)
    offset = {"mag": "mag_offset", "ahrs": "ahrs_offset", "dvl_heading": "dvl_compass_offset"}
    return sorted(sources, key=lambda s: priors[offset[s]].sd if priors[offset[s]].estimate else 0.0)


def _first_heading(
    log: Log, config: Config, sensors: dict[str, Instrument], sources: list[str], level: Array
) -> tuple[float, str]:
    begin = log["imu"].time[0]
    for source in trusted_first(config, sources):
        stream = log[source]
        first = int(np.searchsorted(stream.time, begin))
        if first < len(stream) and stream.time[first] <= begin + HEADING_WITHIN_S:
            means = {name: b.mean for name, b in beliefs(config).items()}
            z = stream.data[first, : sensors[source].model.dim]
            return solve_yaw(sensors[source], z, level, means), source
    raise InputError(
        f"{log.source}: no heading in the first {HEADING_WITHIN_S:.0f} s (mag_x.., ahrs_yaw or dvl_heading) and no "
        "start.heading_deg; give start.heading_deg in the configuration"
    )


def yaw_correction(instrument: Instrument, z: Array, state: State) -> Array:
    """Rotation about down that best explains heading measurements, shape (n,) [rad].

    One Gauss-Newton step of the instrument's own model, so it serves every source alike.

    Parameters
    ----------
    instrument : a heading source
    z : ndarray, shape (n, dim)
    state : State of n epochs
    """
    predicted, H = instrument.model.predict(state, np.zeros((len(state), 3)))
    # a turn about down is R_bn e_z in body axes
    slope = np.einsum("nij,nj->ni", H[POSE][..., :3], state.R_nb[:, 2, :])
    r = innovation(instrument.model, z, predicted)
    return np.asarray(np.sum(slope * r, axis=1) / np.maximum(np.sum(slope**2, axis=1), 1e-12))


def solve_yaw(instrument: Instrument, z: Array, level: Array, calibration: dict[str, Array]) -> float:
    """Yaw at which a levelled attitude predicts a heading measurement [rad]."""
    zero = np.zeros((4, 3))
    yaw = np.arange(4) * 0.5 * np.pi
    tilt = rpy_from_matrix(level)[:2]
    for _ in range(10):
        R = matrix_from_rpy(np.column_stack([np.tile(tilt, (4, 1)), yaw]))
        state = State(R, zero, zero, np.zeros((4, 6)), calibration)
        yaw = yaw + np.clip(yaw_correction(instrument, np.tile(z, (4, 1)), state), -0.5, 0.5)
    R = matrix_from_rpy(np.column_stack([np.tile(tilt, (4, 1)), yaw]))
    state = State(R, zero, zero, np.zeros((4, 6)), calibration)
    misfit = innovation(instrument.model, z, instrument.model.predict(state, zero)[0])
    return float(yaw[np.argmin(np.linalg.norm(misfit, axis=1))])


def _bias(config: Config, gyr_mean: Array, quiet: bool, seconds: float, assumptions: list[str]) -> tuple[Array, Array]:
    """Bias of the first keyframe and its sd, shapes (6,)."""
    gyr_sd = np.deg2rad(config.imu.gyr_bias_sd_dps)
    bias, sd = np.zeros(6), np.repeat([config.imu.acc_bias_sd_mps2, gyr_sd], 3)
    if quiet and seconds >= 1.0:
        bias[3:] = gyr_mean
        sd[3:] = min(gyr_sd, float(np.hypot(config.imu.noise.gyr / np.sqrt(seconds), STILL_GYR_SD)))
        assumptions.append(f"gyro bias from the first {seconds:.0f} s, taken as standing still")
    return bias, sd


def _position(log: Log, config: Config, R_nb: Array, assumptions: list[str]) -> tuple[Array, Array]:
    """Position of the body's origin at the first epoch, and its sd, shapes (3,)."""
    start = config.start
    sd = np.array([start.position_sd_m, start.position_sd_m, start.down_sd_m or start.position_sd_m])
    p_n = np.array([start.north_m, start.east_m, 0.0 if start.down_m is None else start.down_m])
    given = start.model_fields_set & {"north_m", "east_m"}
    if "fix" in log and not given:
        fix, begin = log["fix"], log["imu"].time[0]
        first = int(np.searchsorted(fix.time, begin))
        if first < len(fix) and fix.time[first] <= begin + HEADING_WITHIN_S:
            own = fix["fix_sd"][first]
            p_n[:2] = fix.data[first, :2]
            p_n[:2] -= rotate(R_nb, np.asarray(config.fix.lever_arm_m))[:2]
            sd[:2] = np.maximum(sd[:2], max(float(own) if np.isfinite(own) else config.fix.sd_m, FIRST_FIX_SD))
            assumptions.append(f"start position from the first fix, north {p_n[0]:.1f} m, east {p_n[1]:.1f} m")
    if start.down_m is None and "depth" in log:
        p_n[2] = log["depth"].data[0, 0] - float(rotate(R_nb, np.asarray(config.depth.lever_arm_m))[2])
    return p_n, sd
