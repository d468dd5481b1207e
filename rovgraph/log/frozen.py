"""Measurements that a sensor repeats although the vehicle moves.

Some instruments write zeros when they lose the bottom, others their last value when they hang. A sensor that
measures shows its noise, so a value that returns exactly for seconds is none, unless the sensor usually holds its
values for so long. Where resolution may hide the noise (depth, heading), another sensor has to show the motion.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config, mount_matrix
from rovgraph.geometry import Array, rotate
from rovgraph.log.log import Log
from rovgraph.log.streams import Stream

MIN_REPEATS = 5  # measurements, times as many as the sensor usually repeats
MIN_SECONDS = 3.0
NEVER_REPEATS = 1.05  # measurements that a value lasts, in the mean
ROUNDING = 1e-9  # relative, of numbers that are converted
NOISE_STEPS = 4.0  # of a sensor's resolution, that its second differences exceed if its noise hides it
ALIVE = 1e-6  # spread of an IMU's signals that are more than rounding [m/s^2, rad/s]
ABRUPT_SPEED = 0.1  # of the pings just before or after zeros [m/s]
AROUND = 3  # that many pings
AROUND_SECONDS = 5.0  # not further away
TURN_RATE = 0.05  # sd of the rate about any axis that is no standstill [rad/s]
FIX_DISTANCE = 10.0  # between fixes that is no standstill [m]
DRIVE_CHANGE = 0.5  # of a thruster, as part of its sd over the log
TURNED = np.deg2rad(17.0)  # by the gyro, while a heading stands still,
TURN_DRIFT = 0.03  # and more than its bias may feign [rad/s]
DIVED = 0.5  # by the DVL, while a depth stands still [m],
SLOPE = 0.1  # and more than this part of the way, which a tilted mounting feigns
DIVE_SECONDS = 20.0  # over which it is looked for
LEVEL_SECONDS = 2.0  # over which the specific force shows the vertical
LONGEST_STEP = 1.0  # between pings over which a velocity is integrated [s]


@dataclass(frozen=True)
class FrozenStretch:
    """A time in which a sensor repeats itself.

    Attributes
    ----------
    sensor : name of the stream
    first, last : times of its first and last measurement, both included [s]
    count : of its measurements
    zero : all of them are exactly zero
    why : what shows that they are none, as "it moves at 0.40 m/s just before"
    """

    sensor: str
    first: float
    last: float
    count: int
    zero: bool
    why: str


def frozen_stretches(log: Log, config: Config) -> list[FrozenStretch]:
    """Every time in which a DVL, a magnetometer, a depth sensor or a compass repeats itself, in the order of time."""
    found = [*_zeros(log)]
    for sensor in ("dvl", "dvl_water", "mag"):
        found += _held(log, sensor)
    found += _held_depth(log, config)
    for sensor in ("ahrs", "dvl_heading"):
        found += _held_heading(log, config, sensor)
    for sensor in ("dvl", "vehicle_heading", "vehicle_tilt") if "imu" not in log else ():
        found += _held_in_motion(log, sensor)
    return sorted(found, key=lambda stretch: stretch.first)


def without_frozen(log: Log, config: Config) -> tuple[Log, list[FrozenStretch]]:
    """The log without frozen measurements, and when they were."""
    found = frozen_stretches(log, config)
    streams = dict(log.streams)
    for stretch in found:
        stream = streams[stretch.sensor]
        streams[stretch.sensor] = stream.take((stream.time < stretch.first) | (stream.time > stretch.last))
    return (replace(log, streams={s: stream for s, stream in streams.items() if len(stream)}) if found else log), found


def equal_runs(values: Array) -> NDArray[np.int64]:
    """First and last index of every run of identical rows of (n, k), single ones too, NaN equal; shape (m, 2)."""
    if not len(values):
        return np.empty((0, 2), dtype=np.int64)
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    ends = np.append(np.flatnonzero(~same.all(axis=1)), len(values) - 1)
    return np.column_stack([np.append(0, ends[:-1] + 1), ends])


def _valid(stream: Stream) -> Stream:
    """Pings with bottom lock; of other sensors everything."""
    return stream.take(stream["dvl_valid"] == 1.0) if stream.sensor == "dvl" else stream


def _long(stream: Stream, values: Array) -> list[tuple[int, int]]:
    """Runs of equal values that are longer than the sensor usually holds them."""
    runs = equal_runs(values)
    counts = runs[:, 1] - runs[:, 0] + 1
    usual = float(np.median(counts)) if len(counts) else 1.0
    seconds = stream.time[runs[:, 1]] - stream.time[runs[:, 0]]
    long = runs[(counts >= MIN_REPEATS * usual) & (seconds >= MIN_SECONDS)]
    return [(int(a), int(b)) for a, b in long]


def _zeros(log: Log) -> Iterator[FrozenStretch]:
    """Zeros of the DVL that are no standstill."""
    if "dvl" not in log:
        return
    pings = _valid(log["dvl"])
    for a, b in equal_runs(pings.data[:, :3]):
        first, last = float(pings.time[a]), float(pings.time[b])
        if pings.data[a, :3].any() or b - a + 1 < MIN_REPEATS or last - first < MIN_SECONDS:
            continue
        why = _around(pings, a, b) or _meanwhile(log, first, last)
        if why:
            yield FrozenStretch("dvl", first, last, int(b - a + 1), True, why)


def _held(log: Log, sensor: str) -> Iterator[FrozenStretch]:
    """Values of a sensor whose noise shows, all components held."""
    if sensor not in log:
        return
    stream = _valid(log[sensor])
    values = stream.data[:, :3]
    for a, b in _long(stream, values):
        first, last = float(stream.time[a]), float(stream.time[b])
        if values[a].any() and np.isfinite(values[a]).all() and _alive(log, first, last):
            yield FrozenStretch(sensor, first, last, b - a + 1, False, "the IMU shows motion")


def _held_in_motion(log: Log, sensor: str) -> Iterator[FrozenStretch]:
    """Values without the noise that they have otherwise, while the DVL moves: all that a log without an IMU shows."""
    if not {sensor, "dvl"} <= log.sensors:
        return
    stream = _valid(log[sensor])
    values = stream.data[:, :3]
    long = _long(stream, values)
    if not _shows_noise(values, long):
        return
    for a, b in long:
        first, last = float(stream.time[a]), float(stream.time[b])
        speeds = np.linalg.norm(_between(log, "dvl", first, last)[:, :3], axis=1)
        speed = float(np.median(speeds[np.isfinite(speeds)])) if np.isfinite(speeds).any() else 0.0
        if speed > ABRUPT_SPEED:
            yield FrozenStretch(sensor, first, last, b - a + 1, False, f"it moves at {speed:.2f} m/s without any noise")


def _held_depth(log: Log, config: Config) -> Iterator[FrozenStretch]:
    """A depth that stands still though it never does, or while the DVL, levelled, shows a descent or climb."""
    if not {"depth", "imu"} <= log.sensors:
        return
    stream = log["depth"]
    long = _long(stream, stream.data[:, :1])
    if not long:
        return
    if _shows_noise(stream.data[:, :1], long):
        yield from _held(log, "depth")
        return
    if "dvl" not in log or len(log["dvl"]) < 2:
        return
    pings = _valid(log["dvl"])
    v_b = rotate(mount_matrix(config.dvl.mount_rpy_deg), pings.data[:, :3])
    downwards = np.sum(v_b * _down(log["imu"], config, pings.time), axis=1)
    step = np.minimum(np.diff(pings.time), LONGEST_STEP)
    down, way = (
        np.append(0.0, np.cumsum(0.5 * (v[1:] + v[:-1]) * step)) for v in (downwards, np.linalg.norm(v_b, axis=1))
    )
    levels = np.unique(stream.data[:, 0])
    resolution = float(np.diff(levels).min()) if len(levels) > 1 else 0.0
    least = max(DIVED, 10.0 * config.depth.sd_m, 2.0 * resolution)
    for a, b in long:
        first, last = float(stream.time[a]), float(stream.time[b])
        during = slice(*np.searchsorted(pings.time, [first, last]))
        if during.stop - during.start < 2:
            continue
        dived = _most_dived(pings.time[during], down[during], way[during])
        if dived > least:
            yield FrozenStretch("depth", first, last, b - a + 1, False, f"the DVL moves up or down by {dived:.1f} m")


def _shows_noise(values: Array, long: list[tuple[int, int]]) -> bool:
    """Whether values show noise outside some runs."""
    runs = equal_runs(values)
    counts = np.diff(runs, axis=1)[:, 0] + 1
    others = ~np.isin(counts, [b - a + 1 for a, b in long])
    return shows_noise(values[runs[others, 0], 0], counts[others])


def shows_noise(values: Array, counts: Array) -> bool:
    """Whether n values, each measured ``counts`` times in a row, hardly ever repeat, and not for their resolution only.

    A coarse depth does not repeat in a dive either, but its second differences are within a few of its steps.
    """
    second = np.abs(np.diff(values, 2))
    steps = second[second > ROUNDING * np.abs(values).max(initial=0.0)]
    if not len(steps) or float(counts.mean()) >= NEVER_REPEATS:
        return False
    return bool(np.median(second) >= NOISE_STEPS * steps.min())


def _most_dived(time: Array, down: Array, way: Array) -> float:
    """The largest descent or climb within a time that is more than a tilted mounting would feign [m]."""
    parts = np.split(np.arange(len(time)), np.flatnonzero(np.diff((time - time[0]) // DIVE_SECONDS)) + 1)
    dived = [float(np.ptp(down[part])) for part in parts]
    return max(d if d > SLOPE * float(np.ptp(way[part])) else 0.0 for d, part in zip(dived, parts, strict=True))


def _down(imu: Stream, config: Config, time: Array) -> Array:
    """Downwards in body axes at some times, from the specific force around them, shape (n, 3)."""
    sums = np.vstack([np.zeros(3), np.cumsum(imu.data[:, :3], axis=0)])
    begin = np.searchsorted(imu.time, time - 0.5 * LEVEL_SECONDS)
    end = np.maximum(np.searchsorted(imu.time, time + 0.5 * LEVEL_SECONDS), begin + 1)
    end = np.minimum(end, len(imu))
    force = rotate(mount_matrix(config.imu.mount_rpy_deg), sums[end] - sums[np.minimum(begin, end - 1)])
    return np.asarray(-force / np.maximum(np.linalg.norm(force, axis=1), 1e-9)[:, None])


def _held_heading(log: Log, config: Config, sensor: str) -> Iterator[FrozenStretch]:
    """A heading that stands still while the gyro turns."""
    if sensor not in log or "imu" not in log or len(log["imu"]) < 2:
        return
    imu, stream = log["imu"], log[sensor]
    long = _long(stream, stream.data[:, :1])
    if not long:
        return
    rate = rotate(mount_matrix(config.imu.mount_rpy_deg), imu.data[:, 3:])[:, 2]
    rate = rate - np.median(rate)
    turned = np.append(0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(imu.time)))
    turned = np.interp(stream.time, imu.time, turned)
    for a, b in long:
        turn, seconds = float(np.ptp(turned[a : b + 1])), float(stream.time[b] - stream.time[a])
        if turn > max(TURNED, TURN_DRIFT * seconds):
            why = f"the gyro turns by {np.rad2deg(turn):.0f} deg"
            yield FrozenStretch(sensor, float(stream.time[a]), float(stream.time[b]), b - a + 1, False, why)


def _alive(log: Log, first: float, last: float) -> bool:
    """Whether the IMU's signals change between two times, as those of a real one always do."""
    samples = _between(log, "imu", first, last)
    return len(samples) > 2 and bool(np.ptp(samples, axis=0).max() > ALIVE)


def _around(pings: Stream, a: int, b: int) -> str:
    """Pings next to the zeros that move at speed; "" if they do not."""
    speed = np.linalg.norm(pings.data[:, :3], axis=1)
    sides = {"before": np.arange(max(a - AROUND, 0), a), "after": np.arange(b + 1, min(b + 1 + AROUND, len(pings)))}
    for side, index in sides.items():
        edge = pings.time[a if side == "before" else b]
        near = index[np.abs(pings.time[index] - edge) < AROUND_SECONDS]
        if near.size and np.median(speed[near]) > ABRUPT_SPEED:
            return f"it moves at {np.median(speed[near]):.2f} m/s just {side}"
    return ""


def _meanwhile(log: Log, first: float, last: float) -> str:
    """What other sensors say of the motion between two times; "" if they see none."""
    rates = _between(log, "imu", first, last)[:, 3:]
    if len(rates) > 10 and rates.std(axis=0).max() > TURN_RATE:
        return "the gyro turns"
    fixes = _between(log, "fix", first, last)[:, :2]
    if len(fixes) > 1 and np.linalg.norm(fixes[-1] - fixes[0]) > FIX_DISTANCE:
        return f"the fixes move by {np.linalg.norm(fixes[-1] - fixes[0]):.0f} m"
    drive = _between(log, "thruster", first, last)
    if len(drive) > 2 and (drive.std(axis=0) > DRIVE_CHANGE * np.maximum(log["thruster"].data.std(axis=0), 1e-9)).any():
        return "the thrusters work"
    return ""


def _between(log: Log, sensor: str, first: float, last: float) -> Array:
    if sensor not in log:
        return np.empty((0, 6))
    stream = log[sensor]
    return stream.data[np.searchsorted(stream.time, first) : np.searchsorted(stream.time, last, side="right")]
