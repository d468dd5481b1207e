"""Invalid measurements: a sensor repeats or halves its values, or writes zeros, although the vehicle moves.

Some instruments write zeros when they lose the bottom, others their last value when they hang, others the mean of a
ping and zero. Real measurements are noisy, so a value that repeats exactly for seconds is invalid, unless the sensor
usually holds its values for so long. Where resolution may hide the noise (depth, heading), another sensor has to show
the motion.

Single values are judged by their neighbours (`false_values`): an exact zero is invalid where the measurements next to
it are further from zero than the vehicle can come and go meanwhile, so zeros of a vehicle at rest stay. That needs
neither another sensor nor its clock.
"""

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, rotate, wrap_angle
from rovgraph.log.log import Log
from rovgraph.log.streams import Stream, integral, labels
from rovgraph.model.calibration import ACOUSTICS
from rovgraph.model.config import Config, mount_matrix
from rovgraph.sensors.dvl_beam import BEAMS

NEVER_REPEATS = 1.05  # measurements that a value lasts, in the mean
ROUNDING = 1e-9  # relative, of numbers that are converted
NOISE_STEPS = 4.0  # of a sensor's resolution, that its second differences exceed if its noise hides it
ALIVE = 1e-6  # spread of an IMU's signals that are more than rounding [m/s^2, rad/s]
CLEAR_SPEED = 0.1  # above a standstill's [m/s]
AROUND_SECONDS, AROUND_PERIODS = 5.0, 6.0  # to the neighbours by which a zero is judged, the longer of the two
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
FEWEST = 3  # that show that it is usual
ENOUGH_VALUES = 20  # that show whether there is noise
CHANCE = 10.0  # times as many repetitions of the last value as of the one before it are no chance
SURE = 5.0  # standard deviations, from which on an error is no chance
TURN_RATE = 0.05  # sd of the rate about any axis, above a standstill's [rad/s]
FIX_DISTANCE = 10.0  # between fixes, above a standstill's [m]
DRIVE_CHANGE = 0.5  # of a thruster, as part of its sd over the log
TURNED = np.deg2rad(17.0)  # by the gyro, while a heading stands still,
TURN_DRIFT = 0.03  # and more than its bias may cause [rad/s]
DIVED = 0.5  # by the DVL, while a depth stands still [m],
SLOPE = 0.1  # and more than this part of the way, which a tilted mounting may cause
DIVE_SECONDS = 20.0  # over which it is looked for
LEVEL_SECONDS = 2.0  # over which the specific force shows the vertical
LONGEST_STEP = 1.0  # between pings over which a velocity is integrated [s]


@dataclass(frozen=True)
class Hold:
    """When the values of a sensor that returns them exactly are held, and no measurements, if the vehicle moves.

    Attributes
    ----------
    columns : count of the first ones, which are held together
    repeats : measurements, times as many as the sensor usually repeats
    seconds : that they last
    few : runs of equal values, up to which a sensor is not taken to repeat its values usually
    right : measurements at the beginning that are right
    """

    columns: int = 3
    repeats: int = 5
    seconds: float = 3.0
    few: int = 0
    right: int = 0


HOLD, HEADING = Hold(), Hold(columns=1)
HOLDS: Mapping[str, Hold] = {
    "imu": Hold(columns=6, repeats=10, seconds=1.0, few=sys.maxsize),
    "dvl": HOLD,
    "dvl_water": HOLD,
    "mag": HOLD,
    "depth": HOLD,
    "ahrs": HEADING,
    "dvl_heading": HEADING,
    "vehicle_heading": HEADING,
    "vehicle_tilt": HOLD,
    "fix": Hold(columns=2, seconds=10.0, few=3, right=1),
}


class EqualRun(NamedTuple):
    """Equal measurements of a sensor, shape (k,), and the times of the first and last of them [s]."""

    values: Array
    first: float
    last: float


Shown = Callable[[EqualRun], str]  # what shows that the vehicle moved meanwhile; "" = nothing does


@dataclass(frozen=True)
class Runs:
    """m runs of equal measurements of a sensor, single ones too, in the order of time.

    Attributes
    ----------
    values : ndarray, shape (m, k)
    count : ndarray of int, shape (m,), measurements
    first, last : ndarray, shape (m,), times of these [s]
    """

    values: Array
    count: NDArray[np.int64]
    first: Array
    last: Array

    @staticmethod
    def of(time: Array, values: Array) -> "Runs":
        """Those of n measurements, shapes (n,) [s] and (n, k); NaN equal."""
        begin, end = equal_runs(values).T
        return Runs(values[begin], end - begin + 1, time[begin], time[end])

    def take(self, mask: NDArray[np.bool_]) -> "Runs":
        """Some of them."""
        return Runs(self.values[mask], self.count[mask], self.first[mask], self.last[mask])

    def are_long(self, hold: Hold = HOLD) -> NDArray[np.bool_]:
        """Which are longer than the sensor usually holds its values, shape (m,)."""
        usual = float(np.median(self.count)) if len(self.count) > hold.few else 1.0
        return (self.count >= hold.repeats * usual) & (self.last - self.first >= hold.seconds)

    def show_noise(self, long: NDArray[np.bool_]) -> bool:
        """Whether the values of all but the long ones, shape (m,), show noise."""
        others = ~np.isin(self.count, self.count[long])
        enough = int(np.count_nonzero(others)) >= ENOUGH_VALUES
        return enough and shows_noise(self.values[others, 0], self.count[others])


@dataclass(frozen=True)
class FrozenStretch:
    """Invalid measurements of a sensor.

    Attributes
    ----------
    sensor : name of the stream
    kind : "zero", "half" (the speed of the pings around), "repeated" (the value before), "held" for seconds
    time : ndarray, shape (n,), when they were measured, increasing [s]
    why : what shows that they are invalid, as "it moves at 0.40 m/s just before"
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
    """Neighbours by which an exact zero is judged.

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
        """Distance from zero that remains if a change continues.

        Parameters
        ----------
        near, further : ndarray, shape (..., columns), next to the zero, and the one beyond
        noise : change within the noise
        """
        return self.size(near) - np.maximum(self.size(self.between(further, near)) - noise, 0.0)

    def cannot_stop(self, left: Array, seconds: Array) -> NDArray[np.bool_]:
        """Whether so much distance from zero is left that no vehicle comes to it in some time, shape (...)."""
        return np.asarray(left > np.maximum(self.least, self.never * seconds))

    def seldom_stops(self, left: Array, seconds: Array) -> NDArray[np.bool_]:
        """The same of most vehicles."""
        return np.asarray(left > np.maximum(self.least, self.seldom * seconds))


def companies(config: Config) -> Mapping[str, Company]:
    """Sensors whose exact zeros may be invalid, each with the sensors that show it."""
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
    """All invalid measurements of a log, in the order of time."""
    found = false_values(log, config)
    if "dvl" in log:
        found += _zeros_meanwhile(log, found)
    for sensor, hold in HOLDS.items():
        if sensor not in log or sensor == "imu":
            continue
        stream = _valid(log[sensor])
        runs = Runs.of(stream.time, stream.data[:, : hold.columns])
        end = np.cumsum(runs.count)
        for k, why in held(sensor, runs, log, config):
            time = stream.time[end[k] - runs.count[k] + hold.right : end[k]]
            found.append(FrozenStretch(sensor, "held", time, why))
    return sorted(found, key=lambda stretch: stretch.first)


def false_values(log: Log, config: Config) -> list[FrozenStretch]:
    """Invalid measurements by those of the same sensor next to them: zeros, half speeds, repetitions."""
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
    for sensor in ACOUSTICS:
        if sensor in log:
            found += _answered_again(log[sensor])
    return found


def without(stream: Stream, found: Iterable[FrozenStretch]) -> Stream:
    """A stream without its invalid measurements."""
    return stream.take(~are_in(stream, found))


def are_in(stream: Stream, found: Iterable[FrozenStretch]) -> NDArray[np.bool_]:
    """Which measurements of a stream are invalid, shape (n,); the beams of an invalid ping are."""
    sensor = "dvl" if stream.sensor == BEAMS else stream.sensor
    times = [stretch.time for stretch in found if stretch.sensor == sensor]
    return np.isin(stream.time, np.concatenate(times)) if times else np.zeros(len(stream), bool)


def log_without(log: Log, found: Sequence[FrozenStretch]) -> Log:
    """A log without its invalid measurements; itself if it has none."""
    if not found:
        return log
    streams = {name: without(stream, found) for name, stream in log.streams.items()}
    return replace(log, streams={name: stream for name, stream in streams.items() if len(stream)})


def without_frozen(log: Log, config: Config) -> tuple[Log, list[FrozenStretch]]:
    """The log without its invalid measurements, and these."""
    found = frozen_stretches(log, config)
    return log_without(log, found), found


def repeats(values: Array) -> NDArray[np.bool_]:
    """Whether each row of (n, k) repeats the one before exactly, NaN included; shape (n,)."""
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    return np.concatenate([[False], same.all(axis=1)])[: len(values)]


def equal_runs(values: Array) -> NDArray[np.int64]:
    """First and last index of every run of identical rows of (n, k), single ones too, NaN equal; shape (m, 2)."""
    begin = np.flatnonzero(~repeats(values))
    return np.column_stack([begin, np.append(begin, len(values))[1:] - 1])


def _valid(stream: Stream) -> Stream:
    """Pings with bottom lock; of other sensors everything."""
    return stream.take(stream["dvl_valid"] == 1.0) if stream.sensor == "dvl" else stream


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
    lasts = time[last] - time[first] >= HOLD.seconds
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
    long = false & lasts & (counts >= HOLD.repeats)
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
    return any(shows_noise(column, np.ones(len(column), int)) for column in changes)


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
    short = time[after] - time[before] < max(HOLD.seconds, AROUND_PERIODS * float(np.median(np.diff(time))))
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
    runs = Runs.of(pings.time, values)
    short = (runs.count > 1) & ~runs.are_long()
    again = int((runs.count - 1)[short].sum())
    if again < HOLD.repeats or np.median(runs.count) > 1.0 or not _noise_shows(values):
        return
    if again > CHANCE * (runs.values[2:] == runs.values[:-2]).all(axis=1).sum():
        ends = np.cumsum(runs.count)[short]
        index = np.concatenate([np.arange(b - n + 1, b) for b, n in zip(ends, runs.count[short], strict=True)])
        yield FrozenStretch(pings.sensor, "repeated", pings.time[index], "values hardly ever return otherwise", True)


def _answered_again(stream: Stream) -> Iterator[FrozenStretch]:
    """Acoustic measurements that repeat the one before of that beacon, as a system has them that is asked too often.

    Those are taken to be new that come at the time of others that are.
    """
    names = [stream.columns.index(name) for name in stream.columns if name in labels()]
    of = np.unique(np.nan_to_num(stream.data[:, names], nan=-1.0), axis=0, return_inverse=True)[1].ravel()
    again = np.zeros(len(stream), bool)
    for k in range(of.max(initial=-1) + 1):
        values = stream.data[of == k]
        same, fresh = repeats(values), values[~repeats(values)]
        returns = int(repeats(fresh[::2]).sum() + repeats(fresh[1::2]).sum())
        if same.sum() >= HOLD.repeats and same.sum() > CHANCE * returns and _noise_shows(np.nan_to_num(fresh)):
            again[of == k] = same
    if (time := stream.time[again & ~np.isin(stream.time, stream.time[~again])]).size:
        yield FrozenStretch(stream.sensor, "repeated", time, "values hardly ever return otherwise", True)


def is_false_zero(company: Company, at: float, time: Array, values: Array) -> bool:
    """Whether an exact zero is invalid by the measurements before it, the only ones while a dive goes on.

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
        if pings.data[a, :3].any() or b - a + 1 < HOLD.repeats or last - first < HOLD.seconds:
            continue
        if why := _meanwhile(log, first, last):
            yield FrozenStretch("dvl", "zero", pings.time[a : b + 1], why)


def held(sensor: str, runs: Runs, log: Log, config: Config, turning: float | None = None) -> Iterator[tuple[int, str]]:
    """Runs in which a sensor held its values although the vehicle moved: the place of each, and what shows it.

    Parameters
    ----------
    sensor : key of `HOLDS`
    runs : of its valid measurements
    log : with the IMU, where there is one, and the DVL meanwhile
    config : for mountings and sds
    turning : rate of turn that the gyro shows at rest [rad/s]; None = the median of the log
    """
    long = runs.are_long(HOLDS[sensor])
    if not long.any() or (evidence := _motion_shown(sensor, runs, long, log, config, turning)) is None:
        return
    for k in np.flatnonzero(long).tolist():
        if why := evidence(EqualRun(runs.values[k], float(runs.first[k]), float(runs.last[k]))):
            yield k, why


def _motion_shown(
    sensor: str, runs: Runs, long: NDArray[np.bool_], log: Log, config: Config, turning: float | None
) -> Shown | None:
    """Whether the vehicle moved during a run so that the values of a sensor would have changed.

    Where its noise shows it has failed if anything moves; where resolution may hide it, only if what it measures does.
    """
    imu = "imu" in log and len(log["imu"]) > 1
    pings = _valid(log["dvl"]) if "dvl" in log else None
    if sensor == "fix":
        return _way_by_dvl(pings, config) if pings is not None else None
    if not imu:
        alone = sensor in ("dvl", "vehicle_heading", "vehicle_tilt") and runs.show_noise(long)
        return _speed_by_dvl(pings) if alone and pings is not None else None
    if sensor in ("ahrs", "dvl_heading", "vehicle_heading"):
        return _turn_by_gyro(log, config, turning)
    if sensor == "depth" and not runs.show_noise(long):
        return _dive_by_dvl(pings, log["imu"], config, runs) if pings is not None and len(pings) > 1 else None
    return partial(_alive, log) if sensor != "vehicle_tilt" else None


def _speed_by_dvl(pings: Stream) -> Shown:
    """That the DVL moves: all that a log without an IMU shows."""

    def shown(run: EqualRun) -> str:
        speeds = np.linalg.norm(_during(pings, run.first, run.last)[:, :3], axis=1)
        speed = float(np.median(speeds[np.isfinite(speeds)])) if np.isfinite(speeds).any() else 0.0
        return f"it moves at {speed:.2f} m/s without any noise" if speed > CLEAR_SPEED else ""

    return shown


def _way_by_dvl(pings: Stream, config: Config) -> Shown:
    """That the DVL goes further than fixes are off."""

    def shown(run: EqualRun) -> str:
        during = _during(pings, run.first, run.last)[:, :3]
        way = (run.last - run.first) * (float(np.median(np.linalg.norm(during, axis=1))) if len(during) else 0.0)
        return f"the DVL moves by {way:.0f} m" if way > max(FIX_DISTANCE, SURE * config.fix.sd_m) else ""

    return shown


def _turn_by_gyro(log: Log, config: Config, turning: float | None) -> Shown:
    """That the gyro turns."""
    imu = log["imu"]
    rate = rotate(mount_matrix(config.imu.mount_rpy_deg), imu.data[:, 3:])[:, 2]
    rate = rate - (np.median(rate) if turning is None else turning)
    turned = integral(imu.time, rate)

    def shown(run: EqualRun) -> str:
        during = turned[_slice(imu, run.first, run.last)]
        turn = float(np.ptp(during)) if len(during) else 0.0
        least = max(TURNED, TURN_DRIFT * (run.last - run.first))
        return f"the gyro turns by {np.rad2deg(turn):.0f} deg" if turn > least else ""

    return shown


def _dive_by_dvl(pings: Stream, imu: Stream, config: Config, runs: Runs) -> Shown:
    """That the DVL, levelled, shows a descent or climb beyond the resolution of the depths."""
    v_b = rotate(mount_matrix(config.dvl.mount_rpy_deg), pings.data[:, :3])
    descent = np.sum(v_b * downwards(imu, config, pings.time), axis=1)
    down, way = (integral(pings.time, v, LONGEST_STEP) for v in (descent, np.linalg.norm(v_b, axis=1)))
    levels = np.unique(runs.values[:, 0])
    resolution = float(np.diff(levels).min()) if len(levels) > 1 else 0.0
    least = max(DIVED, 10.0 * config.depth.sd_m, 2.0 * resolution)

    def shown(run: EqualRun) -> str:
        during = _slice(pings, run.first, run.last)
        if during.stop - during.start < 2:
            return ""
        dived = _most_dived(pings.time[during], down[during], way[during])
        return f"the DVL moves up or down by {dived:.1f} m" if dived > least else ""

    return shown


def shows_noise(values: Array, counts: NDArray[np.int64]) -> bool:
    """Whether n values, each measured ``counts`` times in a row, hardly ever repeat, and not for their resolution only.

    A coarse depth does not repeat in a dive either, but its second differences are within a few of its steps.
    """
    second = np.abs(np.diff(values, 2))
    steps = second[second > ROUNDING * np.abs(values).max(initial=0.0)]
    if not len(steps) or float(counts.mean()) >= NEVER_REPEATS:
        return False
    return bool(np.median(second) >= NOISE_STEPS * steps.min())


def _most_dived(time: Array, down: Array, way: Array) -> float:
    """The largest descent or climb within a time that is more than a tilted mounting would cause [m]."""
    parts = np.split(np.arange(len(time)), np.flatnonzero(np.diff((time - time[0]) // DIVE_SECONDS)) + 1)
    dived = [float(np.ptp(down[part])) for part in parts]
    return max(d if d > SLOPE * float(np.ptp(way[part])) else 0.0 for d, part in zip(dived, parts, strict=True))


def downwards(imu: Stream, config: Config, time: Array) -> Array:
    """Unit vectors downwards in body axes at some times, from the specific force around them, shape (n, 3)."""
    sums = np.vstack([np.zeros(3), np.cumsum(imu.data[:, :3], axis=0)])
    begin = np.searchsorted(imu.time, time - 0.5 * LEVEL_SECONDS)
    end = np.maximum(np.searchsorted(imu.time, time + 0.5 * LEVEL_SECONDS), begin + 1)
    end = np.minimum(end, len(imu))
    force = rotate(mount_matrix(config.imu.mount_rpy_deg), sums[end] - sums[np.minimum(begin, end - 1)])
    return np.asarray(-force / np.maximum(np.linalg.norm(force, axis=1), 1e-9)[:, None])


def _alive(log: Log, run: EqualRun) -> str:
    """That the IMU's signals change, as those of a real one always do, beside values that are not zero."""
    samples = _between(log, "imu", run.first, run.last)
    alive = len(samples) > 2 and np.ptp(samples, axis=0).max() > ALIVE
    return "the IMU shows motion" if alive and run.values.any() and np.isfinite(run.values).all() else ""


def _meanwhile(log: Log, first: float, last: float) -> str:
    """Motion between two times by other sensors, in words; "" without motion."""
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
    return _during(log[sensor], first, last) if sensor in log else np.empty((0, 6))


def _during(stream: Stream, first: float, last: float) -> Array:
    return stream.data[_slice(stream, first, last)]


def _slice(stream: Stream, first: float, last: float) -> slice:
    """Places of the measurements from one time to another, both included."""
    return slice(int(np.searchsorted(stream.time, first)), int(np.searchsorted(stream.time, last, side="right")))
