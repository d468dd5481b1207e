"""Measurements that are none: a sensor repeats or halves them, or writes zeros, although the vehicle moves.

Some instruments write zeros when they lose the bottom, others their last value when they hang, others the mean of a
ping and nothing. A sensor that measures shows its noise, so a value that returns exactly for seconds is none, unless
the sensor usually holds its values for so long. Where resolution may hide the noise (depth, heading), another sensor
has to show the motion.

Single ones are known by the company they keep (`false_values`): an exact zero is none where the measurements next to it
are further from zero than the vehicle can come and go meanwhile, so zeros of a vehicle at rest stay. That needs neither
another sensor nor its clock.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config, mount_matrix
from rovgraph.geometry import Array, rotate, wrap_angle
from rovgraph.log.log import Log
from rovgraph.log.streams import Stream

MIN_REPEATS = 5  # measurements, times as many as the sensor usually repeats
MIN_SECONDS = 3.0
NEVER_REPEATS = 1.05  # measurements that a value lasts, in the mean
ROUNDING = 1e-9  # relative, of numbers that are converted
NOISE_STEPS = 4.0  # of a sensor's resolution, that its second differences exceed if its noise hides it
ALIVE = 1e-6  # spread of an IMU's signals that are more than rounding [m/s^2, rad/s]
CLEAR_SPEED = 0.1  # that is no standstill [m/s]
AROUND_SECONDS, AROUND_PERIODS = 5.0, 6.0  # to measurements that tell of a zero between them, the longer of the two
STOPPING, BRAKING = (
    0.3,
    1.0,
)  # change of velocity that vehicles seldom have (a REMUS 1 ping in 500), and hardly any has [m/s^2]
VERTICALLY = 2.0  # fastest descent or climb [m/s]
TURNING = np.deg2rad(60.0)  # fastest turn [rad/s]
HALF, ABOUT = 0.5, 0.1  # of the speed of the pings around: half, and how far from it
FULL = 0.8  # part of the speed around that is the full one,
FULL_OF, FULL_RANK = 9, 3  # which is the third largest of nine
ALIKE = 0.5  # part of the speed by which the pings around may differ
OUTLIES, QUIET = 8.0, 0.25  # times the distance from the mean of both neighbours that a quarter of the pings keeps
FEWEST = 3  # that tell of a habit
ENOUGH_VALUES = 20  # that show whether there is noise
CHANCE = 10.0  # times as many repetitions of the last value as of the one before it are no chance
HELD_FIX, HELD_FIX_SECONDS = 5, 10.0  # of fixes that repeat
SURE = 5.0  # standard deviations
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
    """Measurements of a sensor that are none.

    Attributes
    ----------
    sensor : name of the stream
    kind : "zero", "half" (the speed of the pings around), "repeated" (the value before), "held" for seconds
    time : ndarray, shape (n,), when they were measured, increasing [s]
    why : what shows that they are none, as "it moves at 0.40 m/s just before"
    single : they lie between others that are right; else they are all of a time
    """

    sensor: str
    kind: Literal["zero", "half", "repeated", "held"]
    time: Array
    why: str
    single: bool = False

    @property
    def first(self) -> float:
        """Time of the first [s]."""
        return float(self.time[0])

    @property
    def last(self) -> float:
        """Time of the last [s]."""
        return float(self.time[-1])

    @property
    def reason(self) -> str:
        """Why they are left out, in a word or two."""
        return {"zero": "exactly zero", "half": "half the speed", "repeated": "repeated", "held": "frozen"}[self.kind]


@dataclass(frozen=True)
class Company:
    """What an exact zero is judged by.

    Attributes
    ----------
    columns : count of the first ones, which are zero together
    least : distance of its neighbours from zero that is clear
    seldom, never : rates at which vehicles seldom and never come closer to zero [1/s]
    told : the neighbours' distance in words
    scale : to the unit of these
    rests : a vehicle at rest measures zero
    angle : values are angles [rad]
    """

    columns: int
    least: float
    seldom: float
    never: float
    told: str
    scale: float = 1.0
    rests: bool = False
    angle: bool = False

    def between(self, one: Array, other: Array) -> Array:
        """The way from one value to another, shape (..., columns)."""
        return wrap_angle(other - one) if self.angle else other - one

    def size(self, values: Array) -> Array:
        """Distance from zero, shape (...)."""
        return np.asarray(np.linalg.norm(wrap_angle(values) if self.angle else values, axis=-1))

    def left(self, near: Array, further: Array, noise: float = 0.0) -> Array:
        """Distance from zero that is left once a change goes on.

        Parameters
        ----------
        near, further : ndarray, shape (..., columns), next to the zero, and the one beyond
        noise : change that is none
        """
        return self.size(near) - np.maximum(self.size(self.between(further, near)) - noise, 0.0)

    def cannot_stop(self, left: Array, seconds: Array) -> NDArray[np.bool_]:
        """Whether so much distance from zero is left that no vehicle comes to it in some time, shape (...)."""
        return np.asarray(left > np.maximum(self.least, self.never * seconds))

    def seldom_stops(self, left: Array, seconds: Array) -> NDArray[np.bool_]:
        """The same of most vehicles."""
        return np.asarray(left > np.maximum(self.least, self.seldom * seconds))


def companies(config: Config) -> Mapping[str, Company]:
    """Sensors whose exact zeros may be none, each with what tells."""
    speed = Company(3, CLEAR_SPEED, STOPPING, BRAKING, "it moves at {:.2f} m/s", rests=True)
    heading = Company(1, np.deg2rad(10.0), TURNING, TURNING, "it is at {:.0f} deg", np.rad2deg(1.0), angle=True)
    fastest = config.dvl.max_speed_mps
    return {
        "dvl": speed,
        "dvl_water": speed,
        "depth": Company(1, 0.5, VERTICALLY, VERTICALLY, "it is {:.1f} m deep"),
        "ahrs": heading,
        "dvl_heading": heading,
        "vehicle_heading": heading,
        "vehicle_tilt": replace(heading, columns=2),
        "fix": Company(2, max(FIX_DISTANCE, SURE * config.fix.sd_m), fastest, fastest, "it is {:.0f} m away"),
    }


def frozen_stretches(log: Log, config: Config) -> list[FrozenStretch]:
    """All measurements of a log that are none, in the order of time."""
    found = false_values(log, config)
    if "dvl" in log:
        found += _zeros_meanwhile(log, found)
    for sensor in ("dvl", "dvl_water", "mag"):
        found += _held(log, sensor)
    found += _held_depth(log, config)
    for sensor in ("ahrs", "dvl_heading"):
        found += _held_heading(log, config, sensor)
    for sensor in ("dvl", "vehicle_heading", "vehicle_tilt") if "imu" not in log else ():
        found += _held_in_motion(log, sensor)
    found += _held_fix(log, config)
    return sorted(found, key=lambda stretch: stretch.first)


def false_values(log: Log, config: Config) -> list[FrozenStretch]:
    """Measurements that are none by those of the same sensor next to them: zeros, half speeds, repetitions."""
    found: list[FrozenStretch] = []
    for sensor, company in companies(config).items():
        if sensor not in log:
            continue
        stream = _valid(log[sensor])
        found += _zeros(stream, company)
        if company.rests:
            told = np.isfinite(stream.data[:, :3]).all(axis=1) & stream.data[:, :3].any(axis=1)
            known = stream.take(np.asarray(told))
            halves = [*_halves(known, company)]
            found += [*halves, *_repeated(without(known, halves))]
    return found


def without(stream: Stream, found: Iterable[FrozenStretch]) -> Stream:
    """A stream without measurements that are none."""
    return stream.take(~are_in(stream, found))


def are_in(stream: Stream, found: Iterable[FrozenStretch]) -> NDArray[np.bool_]:
    """Which measurements of a stream are none, shape (n,)."""
    times = [stretch.time for stretch in found if stretch.sensor == stream.sensor]
    return np.isin(stream.time, np.concatenate(times)) if times else np.zeros(len(stream), bool)


def log_without(log: Log, found: Sequence[FrozenStretch]) -> Log:
    """A log without measurements that are none; itself where there are no such."""
    if not found:
        return log
    streams = {name: without(stream, found) for name, stream in log.streams.items()}
    return replace(log, streams={name: stream for name, stream in streams.items() if len(stream)})


def without_frozen(log: Log, config: Config) -> tuple[Log, list[FrozenStretch]]:
    """The log without measurements that are none, and these."""
    found = frozen_stretches(log, config)
    return log_without(log, found), found


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
    return [(int(a), int(b)) for a, b in runs[_is_long(stream.time, runs, runs[:, 1] - runs[:, 0] + 1)]]


def _is_long(time: Array, runs: NDArray[np.int64], counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    usual = float(np.median(counts)) if len(counts) else 1.0
    return (counts >= MIN_REPEATS * usual) & (time[runs[:, 1]] - time[runs[:, 0]] >= MIN_SECONDS)


def _zeros(stream: Stream, company: Company) -> Iterator[FrozenStretch]:
    """Exact zeros that the vehicle cannot have come to, or gone from.

    Where resolution hides the noise, zeros have to begin and end abruptly, as it may have been stopped by an obstacle.
    Where it does not, one side tells, and so do neighbours that move on both, if only a moment lies between. Where the
    noise shows at rest, too, or many zeros are false by now, less abruptness will do; and where it shows at rest and
    some are false, all are.
    """
    values, time = stream.data[:, : company.columns], stream.time
    zero = (values == 0.0).all(axis=1)
    known = np.flatnonzero(~zero & np.isfinite(values).all(axis=1))
    if not zero.any() or len(known) < 3:
        return
    runs = equal_runs(zero[:, None])
    first, last = runs[zero[runs[:, 0]]].T
    noise = _noise(values[known], time[known], company)
    reach = max(AROUND_SECONDS, AROUND_PERIODS * float(np.median(np.diff(time))))
    sides, after = [], np.searchsorted(known, first)
    for edge, near, further in ((first, after - 1, after - 2), (last, after, after + 1)):
        there = (np.minimum(near, further) >= 0) & (np.maximum(near, further) < len(known))
        near, further = (known[np.clip(k, 0, len(known) - 1)] for k in (near, further))
        there &= np.abs(time[further] - time[edge]) <= reach
        left = np.where(there, company.left(values[near], values[further], noise), -np.inf)
        sides.append((near, left, np.abs(time[near] - time[edge])))
    near, left, seconds = (np.array(part) for part in zip(*sides, strict=True))
    abrupt, moves, counts = company.cannot_stop(left, seconds), left > company.least, last - first + 1
    lasts = time[last] - time[first] >= MIN_SECONDS
    if noise:
        mean = _mean(values, time, near[0], first, near[1], company)
        false = abrupt.any(axis=0) | (moves.all(axis=0) & (company.size(mean) > company.least) & ~lasts)
        slow = (company.size(values[known]) < company.least).sum()
        if 2 * (slow + counts[false].sum()) >= counts[~false].sum():
            false |= company.seldom_stops(left, seconds).any(axis=0)
        guilty = company.rests and false.sum() >= FEWEST and 2 * slow >= counts[~false].sum()
    else:
        false, guilty = abrupt.all(axis=0) if company.rests else abrupt.any(axis=0), False
    size = company.scale * company.size(values[near])
    long = false & lasts & (counts >= MIN_REPEATS)
    for k in np.flatnonzero(long):
        side = int(np.argmax(left[:, k]))
        why = f"{company.told.format(size[side, k])} just {('before', 'after')[side]}"
        yield FrozenStretch(stream.sensor, "zero", time[first[k] : last[k] + 1], why)
    if (single := (false | guilty) & ~long).any():
        index = np.concatenate([np.arange(first[k], last[k] + 1) for k in np.flatnonzero(single)])
        why = company.told.format(np.median(size[moves]))
        yield FrozenStretch(stream.sensor, "zero", time[index], f"{why} next to them", True)


def _noise(values: Array, time: Array, company: Company) -> float:
    """Change from one measurement to the next that noise makes; 0 where resolution hides it."""
    if not _noise_shows(np.unwrap(values, axis=0) if company.angle else values):
        return 0.0
    return 2.0 * float(np.median(_from_neighbours(values, time, company)[0]))


def _from_neighbours(values: Array, time: Array, company: Company) -> tuple[Array, Array]:
    """Distance of all measurements but the first and the last from the mean of both neighbours, and this mean."""
    index = np.arange(len(values))
    mean = _mean(values, time, index[:-2], index[1:-1], index[2:], company)
    return company.size(company.between(mean, values[1:-1])), mean


def _mean(
    values: Array,
    time: Array,
    before: NDArray[np.int64],
    index: NDArray[np.int64],
    after: NDArray[np.int64],
    company: Company,
) -> Array:
    """What is expected of some measurements by others before and after them, shape (n, columns)."""
    part = (time[index] - time[before]) / np.maximum(time[after] - time[before], 1e-9)
    return np.asarray(values[before] + part[:, None] * company.between(values[before], values[after]))


def _noise_shows(values: Array) -> bool:
    """Whether any component of (n, k) shows noise wherever it changes."""
    changes = (column[np.append(True, np.diff(column) != 0.0)] for column in values.T)
    return any(shows_noise(column, np.ones(len(column))) for column in changes)


def _halves(pings: Stream, company: Company) -> Iterator[FrozenStretch]:
    """Pings at half the speed of those around them.

    A vehicle that slows down for a moment does so by any amount, and is as often faster for a moment.
    """
    v, time, index = pings.data[:, :3], pings.time, np.arange(len(pings))
    if len(v) < FULL_OF:
        return
    speed = np.linalg.norm(v, axis=1)
    around = np.lib.stride_tricks.sliding_window_view(np.pad(speed, FULL_OF // 2, mode="edge"), FULL_OF)
    full = speed >= FULL * np.partition(around, -FULL_RANK, axis=1)[:, -FULL_RANK]
    off, usual = _from_neighbours(v, time, company)
    clear = max(company.least, OUTLIES * float(np.quantile(off, QUIET)))
    before = np.maximum.accumulate(np.where(full, index, -1))
    after = np.minimum.accumulate(np.where(full, index, len(v))[::-1])[::-1]
    low = index[~full & (before >= 0) & (after < len(v))]
    before, after = before[low], after[low]
    mean = _mean(v, time, before, low, after, company)
    short = time[after] - time[before] < max(MIN_SECONDS, AROUND_PERIODS * float(np.median(np.diff(time))))
    dips = short & (np.linalg.norm(v[low] - mean, axis=1) > clear) & _alike(v[before], v[after], mean)
    half = dips & _is_part(v[low], mean, HALF)
    peaks = (off > clear) & _alike(v[:-2], v[2:], usual) & _is_part(v[1:-1], usual, 1.0 + HALF)
    if half.sum() >= FEWEST and half.sum() > max(dips.sum() - half.sum(), 2 * peaks.sum()):
        why = f"the pings next to them move at {np.median(np.linalg.norm(mean[half], axis=1)):.2f} m/s"
        yield FrozenStretch(pings.sensor, "half", time[low[half]], why, True)


def _alike(before: Array, after: Array, mean: Array) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(after - before, axis=1) < ALIKE * np.linalg.norm(mean, axis=1))


def _is_part(v: Array, mean: Array, part: float) -> NDArray[np.bool_]:
    return np.asarray(np.linalg.norm(v - part * mean, axis=1) < ABOUT * np.linalg.norm(mean, axis=1))


def _repeated(pings: Stream) -> Iterator[FrozenStretch]:
    """Pings that repeat the one before, now and then, and so often that resolution does not make them."""
    values = pings.data[:, :3]
    runs = equal_runs(values)
    counts = np.diff(runs, axis=1)[:, 0] + 1
    short = (counts > 1) & ~_is_long(pings.time, runs, counts)
    again = int((counts - 1)[short].sum())
    if again < MIN_REPEATS or np.median(counts) > 1.0 or not _noise_shows(values):
        return
    distinct = values[runs[:, 0]]
    if again > CHANCE * (distinct[2:] == distinct[:-2]).all(axis=1).sum():
        index = np.concatenate([np.arange(a + 1, b + 1) for a, b in runs[short]])
        yield FrozenStretch(pings.sensor, "repeated", pings.time[index], "values hardly ever return otherwise", True)


def is_false_zero(company: Company, at: float, time: Array, values: Array) -> bool:
    """Whether an exact zero is none by what was measured before it, all that is known while a dive goes on.

    Parameters
    ----------
    company : of the sensor
    at : time of the zero [s]
    time, values : ndarray, shape (n,) [s] and (n, columns), of the measurements before it that are not zero
    """
    if len(time) < 3 or abs(at - time[-2]) > max(AROUND_SECONDS, AROUND_PERIODS * float(np.median(np.diff(time)))):
        return False
    noise = _noise(values, time, company)
    if company.rests and noise == 0.0 and len(time) >= ENOUGH_VALUES:
        return False
    stops = company.seldom_stops if noise else company.cannot_stop  # at rest it would show its noise
    return bool(stops(company.left(values[-1], values[-2], noise), np.abs(at - time[-1])))


def _zeros_meanwhile(log: Log, found: Sequence[FrozenStretch]) -> Iterator[FrozenStretch]:
    """Zeros of the DVL for seconds, while other sensors show motion."""
    pings = without(_valid(log["dvl"]), found)
    for a, b in equal_runs(pings.data[:, :3]):
        first, last = float(pings.time[a]), float(pings.time[b])
        if pings.data[a, :3].any() or b - a + 1 < MIN_REPEATS or last - first < MIN_SECONDS:
            continue
        if why := _meanwhile(log, first, last):
            yield FrozenStretch("dvl", "zero", pings.time[a : b + 1], why)


def _held(log: Log, sensor: str) -> Iterator[FrozenStretch]:
    """Values of a sensor whose noise shows, all components held."""
    if sensor not in log:
        return
    stream = _valid(log[sensor])
    values = stream.data[:, :3]
    for a, b in _long(stream, values):
        first, last = float(stream.time[a]), float(stream.time[b])
        if values[a].any() and np.isfinite(values[a]).all() and _alive(log, first, last):
            yield FrozenStretch(sensor, "held", stream.time[a : b + 1], "the IMU shows motion")


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
        if speed > CLEAR_SPEED:
            why = f"it moves at {speed:.2f} m/s without any noise"
            yield FrozenStretch(sensor, "held", stream.time[a : b + 1], why)


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
            why = f"the DVL moves up or down by {dived:.1f} m"
            yield FrozenStretch("depth", "held", stream.time[a : b + 1], why)


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
            yield FrozenStretch(sensor, "held", stream.time[a : b + 1], why)


def _held_fix(log: Log, config: Config) -> Iterator[FrozenStretch]:
    """Fixes that repeat one exactly while the DVL moves; the first of them is right."""
    if not {"dvl", "fix"} <= log.sensors or len(log["fix"]) < HELD_FIX:
        return
    fix, pings = log["fix"], _valid(log["dvl"])
    runs = equal_runs(fix.data[:, :2])
    counts = runs[:, 1] - runs[:, 0] + 1
    usual = float(np.median(counts)) if len(counts) > 3 else 1.0
    for a, b in runs[counts >= max(HELD_FIX, 3.0 * usual)]:
        first, last = float(fix.time[a]), float(fix.time[b])
        during = (pings.time >= first) & (pings.time <= last)
        speed = float(np.median(np.linalg.norm(pings.data[during, :3], axis=1))) if during.any() else 0.0
        way = speed * (last - first)
        if last - first >= HELD_FIX_SECONDS and way > max(FIX_DISTANCE, SURE * config.fix.sd_m):
            yield FrozenStretch("fix", "held", fix.time[a + 1 : b + 1], f"the DVL moves by {way:.0f} m")


def _alive(log: Log, first: float, last: float) -> bool:
    """Whether the IMU's signals change between two times, as those of a real one always do."""
    samples = _between(log, "imu", first, last)
    return len(samples) > 2 and bool(np.ptp(samples, axis=0).max() > ALIVE)


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
