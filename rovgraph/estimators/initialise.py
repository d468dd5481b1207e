"""Where a dive begins, and what the configuration leaves to the log.

Attitude comes from gravity (specific force averaged in the axes of the first sample)
and heading from whatever the log has; the gyro's bias from standing still, where it
stands still. An explicit ``start`` goes before all of it.
"""

from collections.abc import Collection

import numpy as np

from rovgraph.config import Config, beliefs, with_priors_stated
from rovgraph.engine.constant_velocity import has_constant_velocity
from rovgraph.engine.initial_conditions import InitialConditions, StatePrior
from rovgraph.engine.preintegration import scatter
from rovgraph.errors import InputError
from rovgraph.estimators.first_seconds import Level, first_heading, first_position, level
from rovgraph.estimators.unchecked import nothing_checks, unchecked, unchecked_compass
from rovgraph.estimators.without_imu import TILT, first_tilt, no_bias, with_motion_model
from rovgraph.geometry import Array, earth_rate_n, level_from_force, matrix_from_rpy, rpy_from_matrix
from rovgraph.instruments import Instrument, heading_sources, instruments
from rovgraph.kernels.assembly import NOISIER
from rovgraph.log import Log
from rovgraph.sensors import SENSORS
from rovgraph.state import State

STILL_GYR_SD = 3e-3  # a vehicle that looks still may turn this much [rad/s]
MOVING_TILT_SD = np.deg2rad(5.0)
UNKNOWN_HEADING_SD = np.deg2rad(20.0)  # the samples themselves enter as factors
START_VELOCITY_SD = 1.0
ENOUGH_SAMPLES = 100


def refusal(log: Log, config: Config) -> str:
    """Why no estimate can begin, one line; empty where one can.

    Parameters
    ----------
    log, config : of `initialise`
    """
    try:
        initialise(log, config)
    except InputError as error:
        return str(error).removeprefix(f"{log.source}: ")
    return ""


def initialise(log: Log, config: Config, expected: Collection[str] = ()) -> InitialConditions:
    """Resolve everything that the configuration leaves to the log.

    Parameters
    ----------
    log, config : the dive, or its first seconds
    expected : streams that may still come, beside those of the log

    Raises
    ------
    InputError : neither an IMU nor roll and pitch; neither DVL nor fixes; no heading and no ``start.heading_deg``
    """
    assumptions: list[str] = []
    log, config = with_motion_model(log, config, assumptions)
    if "dvl" not in log and "fix" not in log:
        raise InputError(
            f"{log.source}: neither DVL (dvl_vx, dvl_vy, dvl_vz) nor position fixes, one of them is needed"
        )
    config = _resolve_environment(log, config, assumptions)
    config = _resolve_noise(log, config, assumptions)
    sources, present = heading_sources(config, log.sensors), log.sensors | set(expected)
    compass = unchecked_compass(config, heading_sources(config, present), log.sensors)
    config = with_priors_stated(config, compass)
    sensors = instruments(config, config.imu.lever_arm_m)
    elsewhere = {"thruster"} if has_constant_velocity(config) else {"thruster", TILT}
    own = [s for s in sensors if s in present - elsewhere and SENSORS[s].heading_source is None]
    used = own + heading_sources(config, present) + _thrusters(log, config, expected)
    sensors = {s: sensors[s] for s in used}
    assumptions.append("heading from " + (", ".join(sources) or "start.heading_deg alone: it will drift"))
    resting = unchecked(config, sources, log.sensors, expected)
    if compass:
        assumptions.insert(0, nothing_checks(resting.pop(0), turns_show=not has_constant_velocity(config)))
    assumptions += resting

    first = level(log, config)
    bias, bias_sd = no_bias() if has_constant_velocity(config) else _bias(config, first, assumptions)
    R_nb, rpy_sd = _attitude(log, config, sensors, sources, first, bias[3:], assumptions)
    if first.shows_bias and config.environment.earth_rotation:  # a gyro that stands still shows the Earth's rate, too
        bias[3:] -= R_nb.T @ earth_rate_n(np.deg2rad(config.environment.latitude_deg or 0.0))
    p_n, p_sd = first_position(log, config, R_nb, assumptions)
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
    prior = StatePrior(state, rpy_sd, p_sd, np.full(3, START_VELOCITY_SD), bias_sd)
    return InitialConditions(config, sensors, prior, assumptions)


def _thrusters(log: Log, config: Config, expected: Collection[str]) -> list[str]:
    """The stream of thruster signals, where hydrodynamics are asked for and it does not come later."""
    if not config.graph.hydrodynamics or ("thruster" in expected and "thruster" not in log):
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
            changes["dip_deg"] = float(np.rad2deg(np.arcsin(np.clip(np.nanmedian(sine), -1.0, 1.0))))
            assumptions.append(f"environment.dip_deg {changes['dip_deg']:.1f}, from the log")
            if not beliefs(config)["field_dip"].estimate:
                hint = "give it, or estimate calibration.field_dip"
                assumptions[-1] += f", and held, with the error of the levelling in it: {hint}"
    if env.latitude_deg is None and log.origin is not None:
        changes["latitude_deg"] = log.origin[0]
    if env.earth_rotation and env.latitude_deg is None and log.origin is None:
        raise InputError(
            "environment.earth_rotation needs environment.latitude_deg or origin_lat_deg, as the log has no fix_lat"
        )
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
    if len(imu) < ENOUGH_SAMPLES or has_constant_velocity(config):
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


def _attitude(
    log: Log,
    config: Config,
    sensors: dict[str, Instrument],
    sources: list[str],
    first: Level,
    gyro_bias: Array,
    assumptions: list[str],
) -> tuple[Array, Array]:
    """R_nb of the first epoch and the sd of roll, pitch, yaw."""
    start = config.start
    stated = start.roll_deg, start.pitch_deg
    moving = not first.quiet and not has_constant_velocity(config)
    from_log = first_tilt(log) if has_constant_velocity(config) else level_from_force(first.force_b).tolist()
    roll, pitch = (own if said is None else float(np.deg2rad(said)) for said, own in zip(stated, from_log, strict=True))
    tilt_sd = np.deg2rad(start.tilt_sd_deg)
    if moving and (start.roll_deg is None or start.pitch_deg is None):
        tilt_sd = max(tilt_sd, MOVING_TILT_SD)
        assumptions.append(
            "the log begins in motion: roll and pitch at the start are rough until the estimate refines them"
        )
    yaw_sd = np.deg2rad(start.heading_sd_deg)
    if start.heading_deg is None:
        levelled = matrix_from_rpy([roll, pitch, 0.0])
        yaw, source = first_heading(log, config, sensors, sources, levelled, gyro_bias)
        yaw_sd = max(yaw_sd, UNKNOWN_HEADING_SD)
        assumptions.append(f"start.heading_deg {np.rad2deg(yaw) % 360.0:.1f}, from {source}")
    else:
        yaw = np.deg2rad(start.heading_deg)
    return matrix_from_rpy([roll, pitch, yaw]), np.array([tilt_sd, tilt_sd, yaw_sd])


def _bias(config: Config, first: Level, assumptions: list[str]) -> tuple[Array, Array]:
    """Bias of the first keyframe and its sd, shapes (6,)."""
    gyr_sd = np.deg2rad(config.imu.gyr_bias_sd_dps)
    bias, sd = np.zeros(6), np.repeat([config.imu.acc_bias_sd_mps2, gyr_sd], 3)
    if first.shows_bias:
        bias[3:] = first.rate_b
        sd[3:] = min(gyr_sd, float(np.hypot(config.imu.noise.gyr / np.sqrt(first.seconds), STILL_GYR_SD)))
        assumptions.append(
            f"gyro bias from the first {first.seconds:.0f} s, in which the vehicle is assumed to be at rest"
        )
    return bias, sd
