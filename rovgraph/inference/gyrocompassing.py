"""Gyrocompassing: the attitude at the start by gravity and the Earth's rate, where no compass shows the heading.

In axes that stand still where those of n and b stood at the first epoch, gravity turns with the Earth. With R(t) of the
vehicle against its first axes, by the gyro, v_b of the DVL, f the specific force and w the Earth's rate in n,

    C (R v_b - int R f dt) - constant = int Exp(w t) g dt = t g + t^2/2 w x g + t^3/6 w x (w x g)

so C, the first attitude, takes one cloud of points to another. The constant holds the first velocity, so a dock may
move and the vehicle may be under way; without a DVL it is taken to stay about its place (Wu and Pan, IEEE Transactions
on Aerospace and Electronic Systems 49, 2013; the fit Kabsch 1976). Left out are the Coriolis acceleration and the turn
of n with the vehicle, together half a degree of heading at 2 m/s. That is a place to linearise at; the estimate finds
the heading from the same samples, so its prior has `OPEN_SD`. Much wider, a filter would wander before it knows better.

The first heading errs by the gyro's bias, as the estimate does: with s the heading's sd by the bias, a prior of sd p
about it says once more, with sd p, that the bias is none. `bias_factor` is what takes that from the bias's own prior,
so that both together are as wide as stated: 1 / (1 / (k s)^2 + 1 / p^2) = s^2.
"""

from collections.abc import Collection

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import EARTH_RATE, Array, cross, earth_rate_n, rotate, slerp, turned
from rovgraph.kernels.motion import LONGEST_BRIDGED_S
from rovgraph.log import Log
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.config_sections import SAME_LATITUDE_DEG
from rovgraph.problem.motion import has_constant_velocity
from rovgraph.sensors.instruments import HEADING_STREAMS

ALIGN_S = 120.0  # of the first samples
OPEN_SD = np.deg2rad(20.0)  # of the first heading [rad]
WORST_SD = np.deg2rad(12.0)  # of a heading by the gyro's bias, beyond which the gyro does not show it [rad]
WITHOUT_DVL_HZ = 5.0  # of the times at which a vehicle without a DVL is taken to rest
FAR_OFF = 5.0  # medians of the residual: pings beyond are left out


def heading_sd(config: Config, latitude_deg: float, seconds: float) -> float:
    """sd of the heading that a gyro shows in a time without turns, by its bias and its noise [rad].

    Parameters
    ----------
    config : with the gyro
    latitude_deg : of the place
    seconds : infinite for the part of the bias
    """
    rate_sd = np.hypot(np.deg2rad(config.imu.gyr_bias_sd_dps), config.imu.noise.gyr / np.sqrt(seconds))
    return float(rate_sd / max(earth_rate_n(np.deg2rad(latitude_deg))[0], 1e-9))


def bias_factor(config: Config, latitude_deg: float) -> float:
    """Factor of the sd of the gyro's horizontal bias beside a first heading that the gyro has shown."""
    return float((1.0 - (heading_sd(config, latitude_deg, np.inf) / OPEN_SD) ** 2) ** -0.5)


def why_not(config: Config, origin: tuple[float, float] | None) -> str:
    """Why the gyro cannot show the heading, one line; empty where it can.

    Parameters
    ----------
    config : as stated, or resolved
    origin : latitude and longitude of the log [deg], where they are known
    """
    imu, latitude = config.imu, _latitude(config, origin)
    if has_constant_velocity(config):
        return "no IMU is used"
    if config.environment.earth_rotation is False:
        return "environment.earth_rotation: false leaves out the rate that shows it"
    if origin is not None and abs((latitude or 0.0) - origin[0]) > SAME_LATITUDE_DEG:
        return f"environment.latitude_deg {latitude:g} contradicts the log's {origin[0]:.4f}"
    if np.deg2rad(imu.gyr_bias_sd_dps) > WORST_SD * EARTH_RATE:
        return f"its bias (imu.gyr_bias_sd_dps {imu.gyr_bias_sd_dps:g}) hides the Earth's rate, 0.0042 deg/s"
    if latitude is None:
        return "state environment.latitude_deg, and it may"
    sd = min(np.rad2deg(heading_sd(config, latitude, ALIGN_S)), 90.0)
    return "" if np.deg2rad(sd) < WORST_SD else f"it errs by {sd:.0f} deg at latitude {latitude:.4g}"


def relies_on_gyro(config: Config) -> bool:
    """Whether a dive of a configuration, whatever its log, has no heading but the gyro's."""
    none = config.heading.sources is not None and not config.heading.sources
    return none and config.start.heading_deg is None and not why_not(config, None)


def _latitude(config: Config, origin: tuple[float, float] | None) -> float | None:
    stated = config.environment.latitude
    return origin[0] if stated is None and origin is not None else stated


def without_turns(config: Config, origin: tuple[float, float] | None) -> str:
    """How well the gyro shows the heading of a vehicle that does not turn; arguments as of `why_not`."""
    latitude = _latitude(config, origin) or 0.0
    at_best = np.rad2deg(heading_sd(config, latitude, np.inf))
    unchecked = ", which nothing checks in minutes, its sign neither" if origin is None else ""
    return (
        f"to {at_best:.2g} deg at best at latitude {latitude:.4g}{unchecked}, by imu.gyr_bias_sd_dps, which nothing "
        "checks without turns; half a turn separates the gyro's bias from the heading, and leaves its noise"
    )


def with_earth_rate(log: Log, config: Config, sources: Collection[str]) -> Config:
    """The configuration of a dive whose heading the gyro is to show, with the Earth's rotation.

    Parameters
    ----------
    log, config : the dive, its latitude filled in
    sources : heading sources in use, which do not measure at the start

    Raises
    ------
    InputError : the gyro cannot show it, the log is too short, or the IMU has a gap at its beginning
    """
    unused = [s for s in HEADING_STREAMS if s in log and s not in sources]
    left_out = f"; heading.sources leaves out {', '.join(unused)}" if unused else ""
    without = f"{log.source}: no heading at the start (mag_x.., ahrs_yaw, heading or dvl_heading{left_out})"
    if why := why_not(config, log.origin):
        raise InputError(f"{without}; give start.heading_deg, as the gyro does not show it: {why}")
    time = log["imu"].time
    gap = np.flatnonzero(np.diff(time) > LONGEST_BRIDGED_S)
    seconds = float((time[gap[0]] if len(gap) else time[-1]) - time[0])
    if seconds < ALIGN_S:
        text = f"the gyro shows it in {ALIGN_S:.0f} s without a gap, and the IMU has {seconds:.0f} s"
        raise InputError(f"{without}; {text}")
    return config.with_values(environment={"earth_rotation": True})


def coarse_attitude(log: Log, config: Config) -> Array:
    """R_nb of the first epoch by gravity and the Earth's rate, shape (3, 3).

    Parameters
    ----------
    log : with an IMU; its DVL is used if it has one
    config : its mountings, latitude and gravity
    """
    begin = log["imu"].time[0]
    imu, R_bs = log["imu"].between(begin, begin + ALIGN_S), mount_matrix(config.imu.mount_rpy_deg)
    time, force, rate = imu.time, imu.data[:, :3] @ R_bs.T, imu.data[:, 3:] @ R_bs.T
    R = turned(time, rate)
    felt = rotate(R, force)
    gained = np.vstack([np.zeros(3), np.cumsum(0.5 * (felt[1:] + felt[:-1]) * np.diff(time)[:, None], axis=0)])
    at, v_b = _velocity(log, config, time, rate)
    moved = rotate(slerp(time, R, at), v_b) - np.column_stack([np.interp(at, time, axis) for axis in gained.T])
    t, g = (at - time[0])[:, None], np.array([0.0, 0.0, config.environment.gravity])
    w = earth_rate_n(np.deg2rad(config.environment.latitude or 0.0))
    turns = cross(w, g)
    fallen = t * g + t**2 / 2.0 * turns + t**3 / 6.0 * cross(w, turns)
    used = np.ones(len(at), bool)
    for _ in range(3):
        C, off = _fitted(moved[used], fallen[used], moved, fallen)
        used = off <= FAR_OFF * np.median(off)
    return C


def _velocity(log: Log, config: Config, time: Array, rate: Array) -> tuple[Array, Array]:
    """Times, shape (m,), and velocity of the IMU in body axes, shape (m, 3): by the DVL, else none."""
    if "dvl" in log:
        pings = log["dvl"].between(time[0], time[0] + ALIGN_S)
        slow = (np.abs(pings.data[:, :3]) <= config.dvl.max_speed_mps).all(axis=1)  # false where one is missing
        pings = pings.take(slow & (pings["dvl_valid"] == 1.0))
        if len(pings) > WITHOUT_DVL_HZ * 2:
            w = np.column_stack([np.interp(pings.time, time, axis) for axis in rate.T])
            arm = np.subtract(config.dvl.lever_arm_m, config.imu.lever_arm_m)
            return pings.time, pings.data[:, :3] @ mount_matrix(config.dvl.mount_rpy_deg).T - np.cross(w, arm)
    at = np.arange(time[0], time[-1], 1.0 / WITHOUT_DVL_HZ)
    return at, np.zeros((len(at), 3))


def _fitted(a: Array, b: Array, every_a: Array, every_b: Array) -> tuple[Array, Array]:
    """The rotation that takes points to others but for a shift, and how far off it leaves each of all points."""
    U, _, Vt = np.linalg.svd((a - a.mean(axis=0)).T @ (b - b.mean(axis=0)))
    C = Vt.T @ np.diag([1.0, 1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
    apart = every_b - b.mean(axis=0) - (every_a - a.mean(axis=0)) @ C.T
    return C, np.linalg.norm(apart, axis=1)
