"""What the first seconds of a log say: how it is levelled, whether it stands still, its heading, where it is.

Nothing rests on a single sample: the first of a sensor is as often wrong as any other, and here
no gate would find out.
"""

from itertools import accumulate
from typing import NamedTuple

import numpy as np

from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.errors import InputError
from rovgraph.estimators.headings import solve_turn, trusted_first
from rovgraph.geometry import Array, exp_rotation, rotate, wrap_angle
from rovgraph.instruments import Instrument
from rovgraph.log import Log, Stream
from rovgraph.log.frozen import CLEAR_SPEED

WINDOW_S = 5.0  # over which a log is levelled, and a sensor's first value taken
WITHIN_S = 30.0  # from the log's start: first headings and fixes
QUIET_ACC, QUIET_GYR = 0.15, 0.03  # scatter above the sensor's own noise that counts as quiet [SI]
STILL_TURN = np.deg2rad(3.0)  # its heading at the window's ends, at most [rad]
HEADINGS = 50  # samples of a source that are looked at
UNKNOWN_DOWN_SD = 100.0  # of a start whose depth nothing shows [m]
FIRST_FIX_SD = 5.0  # the fix enters by itself, too [m]
AGREE_SD = 3.0  # of a fix with the line through those around it
MOST_MPS = 1.0  # that a vehicle moves before anything says where it is


class Level(NamedTuple):
    """The IMU's first seconds.

    Attributes
    ----------
    force_b, rate_b : ndarray, shape (3,), mean specific force in the axes of the first sample, mean rate
    quiet : whether it stands still
    seconds : that there are
    """

    force_b: Array
    rate_b: Array
    quiet: bool
    seconds: float

    @property
    def shows_bias(self) -> bool:
        """Whether the mean rate is the gyro's bias."""
        return self.quiet and self.seconds >= 1.0


def level(log: Log, config: Config) -> Level:
    """What the IMU says of the first seconds.

    Parameters
    ----------
    log : with an IMU
    config : its mounting and noise
    """
    imu, R_bs = log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    first = imu.time <= imu.time[0] + WINDOW_S
    time, acc, gyr = imu.time[first], imu.data[first, :3] @ R_bs.T, imu.data[first, 3:] @ R_bs.T
    seconds = float(time[-1] - time[0])
    if len(time) < 3:
        return Level(acc.mean(axis=0), gyr.mean(axis=0), False, seconds)
    rate = (len(time) - 1) / seconds
    noise = config.imu.noise
    quiet = bool(
        (acc.std(axis=0) < QUIET_ACC + 2.0 * noise.acc * np.sqrt(rate)).all()
        and (gyr.std(axis=0) < QUIET_GYR + 2.0 * noise.gyr * np.sqrt(rate)).all()
        and np.linalg.norm(gyr.mean(axis=0)) < 3.0 * np.deg2rad(config.imu.gyr_bias_sd_dps)
    )
    if quiet and not _moves(log):
        return Level(acc.mean(axis=0), gyr.mean(axis=0), True, seconds)
    return Level(rotate(_turned(time, gyr), acc).mean(axis=0), gyr.mean(axis=0), False, seconds)


def _moves(log: Log) -> bool:
    """Whether DVL or compass say so: a steady turn is as quiet as standing still."""
    if "dvl" in log:
        ping = _opening(log["dvl"], log["imu"].time[0], WINDOW_S)
        speed = np.linalg.norm(ping.data[ping["dvl_valid"] == 1.0, :3], axis=1)
        if len(speed) and np.median(speed) > CLEAR_SPEED:
            return True
    for source in ("ahrs", "dvl_heading"):
        if source in log:
            heading = np.unwrap(_opening(log[source], log["imu"].time[0], WINDOW_S).data[:, 0])
            third = len(heading) // 3
            if third and abs(np.median(heading[-third:]) - np.median(heading[:third])) > STILL_TURN:
                return True
    return False


def _opening(stream: Stream, begin: float, seconds: float) -> Stream:
    """Of a stream what lies within some seconds of a time."""
    return stream.take((stream.time >= begin) & (stream.time <= begin + seconds))


def first_heading(
    log: Log, config: Config, sensors: dict[str, Instrument], sources: list[str], levelled: Array, gyro_bias: Array
) -> tuple[float, str]:
    """Yaw of the first epoch [rad], and the source that shows it.

    Of what a source says in its first seconds, each sample brought back to the first epoch by the gyro, the
    one that the others are nearest to: the median on a circle.

    Parameters
    ----------
    log, config : the dive, and what is believed of it
    sensors : instruments by stream
    sources : heading sources of the log
    levelled : ndarray, shape (3, 3), R_nb of the first epoch but for its yaw
    gyro_bias : ndarray, shape (3,), as far as it is known [rad/s]

    Raises
    ------
    InputError : no source speaks early enough
    """
    begin, means = log["imu"].time[0], {name: b.mean for name, b in beliefs(config).items()}
    for source in trusted_first(config, sources):
        stream = _opening(log[source], begin, WITHIN_S)
        if not len(stream):
            continue
        stream = _opening(stream, stream.time[0], WINDOW_S)
        stream = stream.take(np.unique(np.linspace(0, len(stream) - 1, HEADINGS).astype(int)))
        imu = _opening(log["imu"], begin, stream.time[-1] - begin)
        turned = _turned(imu.time, imu.data[:, 3:] @ mount_matrix(config.imu.mount_rpy_deg).T - gyro_bias)
        there = levelled @ turned[imu.time.searchsorted(stream.time, "right") - 1]
        yaws = solve_turn(sensors[source], stream.data[:, : sensors[source].model.dim], there, means)
        apart = np.abs(wrap_angle(np.subtract.outer(yaws, yaws))).sum(axis=1)
        return float(yaws[int(np.argmin(apart))]), source
    raise InputError(
        f"{log.source}: no heading in the first {WITHIN_S:.0f} s (mag_x.., ahrs_yaw, heading or dvl_heading) and no "
        "start.heading_deg; give start.heading_deg in the configuration"
    )


def _turned(time: Array, rate_b: Array) -> Array:
    """Rotations from the body's axes at each sample of the gyro to those at the first, shape (n, 3, 3)."""
    steps = exp_rotation(0.5 * (rate_b[1:] + rate_b[:-1]) * np.diff(time)[:, None])
    return np.array(list(accumulate(steps, np.matmul, initial=np.eye(3))))


def first_position(log: Log, config: Config, R_nb: Array, assumptions: list[str]) -> tuple[Array, Array]:
    """Position of the body's origin at the first epoch, in n, and its sd, shapes (3,) [m].

    Parameters
    ----------
    log, config : the dive, and what is believed of it; a stated start goes before the log
    R_nb : ndarray, shape (3, 3), of the first epoch
    assumptions : to be added to, one line each
    """
    start, begin = config.start, log["imu"].time[0]
    p_n = np.array([start.north_m or 0.0, start.east_m or 0.0, start.down_m or 0.0])
    sd = np.array([start.position_sd_m, start.position_sd_m, start.down_sd_m or start.position_sd_m])
    if "fix" in log and not start.located:
        fixes = log["fix"]
        if len(fixes):
            fixes = _opening(fixes, fixes.time[0], WITHIN_S)  # however late they begin: the frame is theirs
            here, own_sd = _first_fix(fixes, config.fix.sd_m)
            p_n[:2] = here - rotate(R_nb, np.asarray(config.fix.lever_arm_m))[:2]
            sd[:2] = np.maximum(sd[:2], max(own_sd, FIRST_FIX_SD, MOST_MPS * (fixes.time[0] - begin)))
            assumptions.append(f"start position from the first fix, north {p_n[0]:.1f} m, east {p_n[1]:.1f} m")
    elif log.origin is not None and not start.located:
        where = f"latitude {log.origin[0]:.6f}, longitude {log.origin[1]:.6f}"
        assumptions.append(f"start at the origin, {where}, within {sd[0]:g} m, as the log has no fix")
    if start.down_m is None and "depth" in log:
        depth = log["depth"]
        first = _opening(depth, depth.time[0], WINDOW_S)
        p_n[2] = _robust_first(first.time, first.data[:, 0]) - rotate(R_nb, np.asarray(config.depth.lever_arm_m))[2]
        sd[2] = max(sd[2], MOST_MPS * (depth.time[0] - begin))
    elif start.down_m is None:
        sd[2] = start.down_sd_m or UNKNOWN_DOWN_SD
        assumptions.append(f"start.down_m 0.0 within {sd[2]:g} m, as the log has no depth")
    return p_n, sd


def _first_fix(fixes: Stream, sd: float) -> tuple[Array, float]:
    """The first fix, shape (2,), and its sd [m]; the line through the first ones instead of one that is far off it."""
    own = fixes["fix_sd"][0]
    sd = float(own) if own > 0.0 else sd
    line = np.array([_robust_first(fixes.time, fixes.data[:, k]) for k in (0, 1)])
    off = float(np.linalg.norm(fixes.data[0, :2] - line))
    return (line if off > AGREE_SD * (sd + FIRST_FIX_SD) else fixes.data[0, :2]), sd


def _robust_first(time: Array, values: Array) -> float:
    """The first of some values, by the line that half of them cannot turn; of two the first (Siegel 1982)."""
    if len(time) < 3:
        return float(values[0])
    apart = np.subtract.outer(time, time)
    rise = np.subtract.outer(values, values)
    slopes = np.divide(rise, apart, out=np.full_like(apart, np.nan), where=apart != 0.0)  # two may share a stamp
    slope = np.median(np.nanmedian(slopes, axis=1))
    return float(np.median(values - slope * time) + slope * time[0])
