"""Clocks of a log: which sensors it has, when they measured, and clocks that jump or have different epochs.

`presence`, `overlap` and `regularity` list sensors and the times of their measurements.

`find_jump` finds clocks that jump within a dive, where the DVL's lag against the IMU differs before and after a gap of
one of them. A clock that is set leaves a gap in the stamps of its instrument. Where the lag before and after is known,
and the gap shows whose clock it is, `bridge_jumps` corrects the later stamps by the difference.

`shift_of_epoch` finds the shift between recordings whose clocks have no common epoch, by the motion that both show. The
stream is first put where its start meets that of the IMU; the remainder, up to minutes, is searched as between clocks
of one epoch. So clocks may be any time apart, if the recordings are of one dive.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.diagnosis.check.acceleration import BETTER, DvlAgainstImu, Search
from rovgraph.diagnosis.check.agreement import heading_lag
from rovgraph.diagnosis.check.findings import Finding, Timing, since, told, valid_pings
from rovgraph.diagnosis.check.inertial import GAP, GAP_OF_PERIODS, inertial_motion
from rovgraph.diagnosis.check.lags import ORIENTATIONS
from rovgraph.diagnosis.check.values import GRAVITY_ANGLE, tilt
from rovgraph.errors import warn
from rovgraph.geometry import Array
from rovgraph.inference.gyrocompassing import why_not, without_turns
from rovgraph.log import Log, Stream
from rovgraph.log.frozen import FrozenStretch, Runs, false_values, repeats, without
from rovgraph.log.stamps import HOUR_S, ZONES_S, few_digits
from rovgraph.log.streams import GAP_PERIODS
from rovgraph.model.calibration import ACOUSTICS
from rovgraph.model.config import Config
from rovgraph.problem.motion import motion_model
from rovgraph.rules import ACCELERATION, EPOCH_SD_S, SILENT_S
from rovgraph.sensors import SENSORS, Level
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.instruments import heading_sources
from rovgraph.sensors.water_layer import CELLS

ENOUGH_PINGS = 50
JUMP_REACH = 10.0  # largest jump that is looked for where there is no gap [s]
LARGEST_JUMP = 120.0  # [s]
PIECE = 30.0  # shortest part of a dive that shows a lag [s]
GAPS = 2  # the largest, of IMU and DVL each, at which a clock may have been set
MOST_JUMPS = 5  # of one dive, that are bridged
TOPSIDE = (*ACOUSTICS, "ship", "ship_heading", "ship_tilt")  # whose motion is not compared with the IMU's
IN_ZONE = 0.8  # of the stamps, that a difference of time zones has to bring into the IMU's time
SURE_S = 0.1  # sd of a jump that is bridged [s]
SURE = 3.0  # standard deviations
SMALL_S = 0.05  # difference of gap and jump up to which no samples are missing [s]
CLOCKED = {  # by one clock
    "imu": ("imu", "mag", "ahrs"),
    "dvl": ("dvl", "dvl_water", "dvl_heading", "dvl_altitude", "dvl_sound", BEAMS, CELLS),
}
NAMES = {"imu": "IMU", "dvl": "DVL"}


@dataclass(frozen=True)
class Jump:
    """A clock that is set between two times.

    Attributes
    ----------
    sensor : whose clock it is, "imu" or "dvl"; "" where no gap shows it
    before, after : stamps around it, equal without a gap [s]
    period : of the sensor [s]
    lags : how late the DVL's stamps are against the IMU's before and after [s]
    sd : of the difference of both [s]
    """

    sensor: str
    before: float
    after: float
    period: float = 0.0
    lags: tuple[float, float] = (np.nan, np.nan)
    sd: float = np.inf

    @property
    def by(self) -> float:
        """How far the clock is set forward [s]: the gap less a period, where nothing need be missing in it."""
        by = self.lags[1] - self.lags[0]
        by, gap = -by if self.sensor == "imu" else by, self.after - self.before - self.period
        return gap if np.isfinite(self.sd) and abs(by - gap) < max(SURE * self.sd, SMALL_S) else by

    @property
    def bridgeable(self) -> bool:
        """Whose clock it is and by how much it is set is known, and stamps that are put back stay in order."""
        return bool(self.sensor) and self.sd < SURE_S and 0.0 < self.by < self.after - self.before

    def finding(self, log: Log) -> Finding:
        """Its description."""
        first, second = (round(lag, 1) + 0.0 for lag in self.lags)  # no minus before a zero
        told = (
            f"the DVL's stamps are {first:.1f} s late relative to the IMU's before {since(log, self.before)} "
            f"and {second:.1f} s after {since(log, self.after)}"
        )
        if not self.sensor:
            return Finding(
                "log", "warning", f"{told}: a clock drifts or jumps; put both instruments on one clock", "jump"
            )
        text = (
            f"{told}: the {NAMES[self.sensor]}'s clock jumps by {self.by:+.1f} s in the gap between; correct its stamps"
        )
        return Finding(self.sensor, "warning", f"{text} from there on, or split the log", "jump")


@dataclass(frozen=True)
class Examined:
    """The DVL beside the IMU, and the jump of one of their clocks, where there is one."""

    compared: DvlAgainstImu
    jump: Jump | None


def compare(log: Log, config: Config) -> DvlAgainstImu | None:
    """The DVL beside the IMU; None where there is too little of them, or gravity is not where it should be."""
    if not {"dvl", "imu"} <= log.sensors or tilt(log, config) > GRAVITY_ANGLE:
        return None
    pings = valid_pings(without(log["dvl"], false_values(log, config)))
    motion = inertial_motion(log, config)
    return None if motion is None or len(pings) < ENOUGH_PINGS else DvlAgainstImu(motion, pings, config)


def find_jump(log: Log, compared: DvlAgainstImu) -> Jump | None:
    """A lag that is another before and after some time."""
    time = compared.motion.time
    middle = float(0.5 * (time[0] + time[-1]))
    splits = [*_jumps_at_gaps(compared.pings), *_jumps_at_gaps(log["imu"]), Jump("", middle, middle)]
    for split in sorted(splits, key=lambda s: s.before - s.after):
        reach = min(1.5 * (split.after - split.before) + JUMP_REACH, LARGEST_JUMP)
        if split.before - time[0] < PIECE or time[-1] - split.after < PIECE:
            continue
        spans = (time[0], split.before), (split.after, time[-1])
        sides = [compared.search(reach, span) for span in spans]
        best = [int(np.argmin(side.error[0])) for side in sides]
        lags = [float(side.lags[k]) for side, k in zip(sides, best, strict=True)]
        if not all(side.agreement[0, k] > ACCELERATION.follows for side, k in zip(sides, best, strict=True)):
            continue
        worse = [
            side.error[0, _index(side, lag)] / side.error[0, k]
            for side, k, lag in zip(sides, best, lags[::-1], strict=True)
        ]
        if min(worse) > BETTER:
            return _refined(compared, split, lags)
    return None


def _refined(compared: DvlAgainstImu, split: Jump, lags: list[float]) -> Jump:
    """The lags by least squares, where that settles on both sides."""
    spans = (-np.inf, split.before), (split.after, np.inf)
    # a ping belongs to the side that its stamp is on, by the clock that is not set
    moved = lags if split.sensor == "imu" else (0.0, 0.0)
    fits = [
        compared.refine(lag, ORIENTATIONS[0], (begin + by, end + by))
        for lag, (begin, end), by in zip(lags, spans, moved, strict=True)
    ]
    if fits[0] is None or fits[1] is None:
        return replace(split, lags=(lags[0], lags[1]))
    return replace(split, lags=(fits[0].lag, fits[1].lag), sd=float(np.hypot(fits[0].lag_sd, fits[1].lag_sd)))


def bridge_jumps(log: Log, config: Config) -> tuple[Log, Examined | None]:
    """A log with continuous clocks: where a gap shows whose clock was set, its later stamps are put back by as much.

    Returns
    -------
    Log : the log, or one that is bridged
    Examined : of that log, as far as it is known by now, so that a check need not look again

    Warns
    -----
    DataWarning : a jump that is bridged, with both times
    """
    for _ in range(MOST_JUMPS):
        compared = compare(log, config)
        if compared is None:
            return log, None
        jump = find_jump(log, compared)
        if jump is None or not jump.bridgeable:
            return log, Examined(compared, jump)
        streams = {name: _put_back(stream, jump) for name, stream in log.streams.items()}
        shifted = [name for name, stream in streams.items() if stream is not log[name]]
        warn(
            f"{log.source}: the {NAMES[jump.sensor]}'s clock jumps by {jump.by:+.2f} s (sd {jump.sd:.2f} s) between "
            f"{since(log, jump.before)} and {since(log, jump.after)}: bridged; the later stamps of "
            f"{', '.join(shifted)} are moved back by as much"
        )
        log = replace(log, streams=streams)
    return log, None


def _put_back(stream: Stream, jump: Jump) -> Stream:
    """A stream with its stamps after a jump put back, where it is of that clock: it has the gap, too."""
    if stream.sensor not in CLOCKED[jump.sensor] or len(stream) < 2:
        return stream
    middle = 0.5 * (jump.before + jump.after)
    k = int(np.searchsorted(stream.time, middle))
    if not 0 < k < len(stream) or stream.time[k] - stream.time[k - 1] < jump.by:
        return stream
    return replace(stream, time=np.where(stream.time >= middle, stream.time - jump.by, stream.time))


def _index(side: Search, lag: float) -> int:
    return int(np.argmin(np.abs(side.lags - lag)))


def _jumps_at_gaps(stream: Stream) -> list[Jump]:
    """The largest gaps of a stream, after which its clock may be another."""
    periods = np.diff(stream.time)
    widest = np.argsort(periods)[-GAPS:]
    period = float(np.median(periods))
    wide = widest[periods[widest] > max(GAP, GAP_OF_PERIODS * period)]
    return [Jump(stream.sensor, float(stream.time[k]), float(stream.time[k + 1]), period) for k in wide]


def shift_of_epoch(log: Log, config: Config, sensor: str) -> tuple[float, float] | None:
    """How much later the stamps of a sensor are than the IMU's, and its sd [s]; None where the motion does not show it.

    Parameters
    ----------
    sensor : "dvl" by its acceleration, or a compass by its turning
    """
    apart = float(log[sensor].time[0] - log["imu"].time[0])
    moved = replace(log[sensor], time=log[sensor].time - apart)
    beside = replace(log, streams={"imu": log["imu"], sensor: moved})
    lag = _dvl_lag(beside, config) if sensor == "dvl" else heading_lag(beside, config, sensor)
    if lag is None or not lag[1] < EPOCH_SD_S:
        return None
    return apart + lag[0], lag[1]


def _dvl_lag(log: Log, config: Config) -> tuple[float, float] | None:
    """Lag of a DVL and its sd [s], axes as configured."""
    compared = compare(log, config)
    if compared is None:
        return None
    found = compared.search()
    k = int(np.argmin(found.error[0]))
    if found.agreement[0, k] < ACCELERATION.follows:
        return None
    fit = compared.refine(float(found.lags[k]), ORIENTATIONS[0])
    return None if fit is None else (fit.lag, fit.lag_sd)


BURST = 0.3  # of the mean period, below which most periods lie within bursts
WITHIN = 0.1  # of the time, that bursts last at most of sensors other than the IMU, which may measure now and then only
ENOUGH_PERIODS = 20
BATCHED = 0.5  # share of measurements that have the stamp of another, beyond which they come in batches
REPEATED = 0.2  # share of repeated samples that a sensor does not produce by itself


def _without_cells(stream: Stream) -> Stream:
    """Of profiles of the water the first cell of each, which are of one time."""
    return stream.take(np.diff(stream.time, prepend=-np.inf) > 0.0) if stream.sensor == CELLS else stream


def timing(stream: Stream) -> Timing:
    """When the measurements of one sensor came."""
    stream = _without_cells(stream)
    periods = np.diff(stream.time)
    data = told(stream)
    again = int((repeats(data) & ~np.isnan(data).all(axis=1)).sum())
    if not len(periods):
        time = float(stream.time[0])
        return Timing(stream.sensor, 1, np.nan, time, time, np.nan, np.nan, np.nan, again)
    widest = int(np.argmax(periods))
    low, high = np.percentile(periods, [5, 95])
    return Timing(
        stream.sensor,
        len(stream),
        float(1.0 / np.median(periods)),
        float(stream.time[0]),
        float(stream.time[-1]),
        float(periods[widest]),
        float(stream.time[widest]),
        float(high - low) / 2.0,
        again,
    )


def presence(log: Log, config: Config) -> Iterator[Finding]:
    """Sensors that are missing, and what that means."""
    for sensor in SENSORS.values():
        if sensor.name == "imu" and motion_model(config, log.sensors) == "constant_velocity":
            used = "no IMU is used: velocity and attitude are nearly constant between measurements (motion.model)"
            yield Finding(sensor.name, "ok", used)
        elif sensor.name == "fix" and log.sensors & set(ACOUSTICS):
            continue
        elif sensor.if_missing is not None and sensor.name not in log:
            yield Finding(sensor.name, *sensor.if_missing, "missing")
    if not heading_sources(config, log.sensors):
        level: Level = "warning"
        if config.start.heading_deg is not None:
            known = "heading starts at start.heading_deg and drifts with the gyro"
        elif why := why_not(config, log.origin) if "imu" in log else "no IMU is used":
            known = "give mag, ahrs_yaw, heading or dvl_heading, or at least start.heading_deg; "
            known += f"the gyro does not show it: {why}"
        else:
            level, known = "ok", f"the gyro shows it by the Earth's rate, {without_turns(config, log.origin)}"
        yield Finding("log", level, f"no heading source in use: {known}", "missing")


def _time_zone(time: Array, first: float, last: float) -> float:
    """The one difference of time zones that stamps are ahead of a span; 0 = none, or several would do [s]."""
    fits = [zone for zone in ZONES_S if np.mean((time - zone >= first) & (time - zone <= last)) > IN_ZONE]
    return fits[0] if len(fits) == 1 else 0.0


def overlap(log: Log, config: Config) -> Iterator[Finding]:
    """Sensors that share no time with the IMU."""
    if "imu" not in log:
        return
    first, last = log["imu"].time[[0, -1]]
    for sensor, stream in log.streams.items():
        inside = np.mean((stream.time >= first) & (stream.time <= last))
        if inside == 0.0:
            text = "no time in common with the IMU: put both on one clock"
            shift = shift_of_epoch(log, config, sensor)
            if shift is not None:
                delay = config.delay_s.get(sensor, 0.0) + shift[0]
                text += f"; its motion matches the IMU's if moved {shift[0]:.3f} s earlier (sd {shift[1]:.2g} s): "
                text += f"state delay_s: {{{sensor}: {delay:.3f}}}"
            elif sensor in TOPSIDE and (zone := _time_zone(stream.time, first, last)):
                text += f"; its stamps fit {zone / HOUR_S:+g} h, as those of local time: state delay_s: "
                text += f"{{{sensor}: {config.delay_s.get(sensor, 0.0) + zone:g}}}"
            yield Finding(sensor, "error", text, "epoch")
        elif inside < 0.8:
            yield Finding(
                sensor,
                "warning",
                f"{1.0 - inside:.0%} of its measurements lie before or after the IMU's and are ignored",
                "missing",
            )


def regularity(log: Log, config: Config, frozen: Sequence[FrozenStretch] = ()) -> Iterator[Finding]:
    """Rates, gaps, jitter and repeated samples; ``frozen`` are measurements that another check names."""
    for sensor, every in log.streams.items():
        stream = _without_cells(every)
        t = timing(stream)
        if np.isnan(t.rate):
            yield Finding(sensor, "warning", "only one measurement")
            continue
        low, high = SENSORS[sensor].usual_rates
        period = _burst_period(stream)
        if period is not None:
            mean = (t.count - 1) / (t.last - t.first)
            bursts = f"{mean:.3g} Hz, but in bursts, most {1.0 / t.rate:.2g} s apart and then none for {period:.2g} s"
            text = f"{bursts}: they may be times of arrival; log times of measurement"
            yield Finding(sensor, "warning", text, "bursts")
        elif not low <= t.rate <= high:
            yield Finding(
                sensor,
                "warning",
                f"{t.rate:.4g} Hz, expected {low:g} to {high:g}; "
                "if time is not in seconds, state its unit, such as units: {time: ms}",
                "rate",
            )
        if stream.same_time > BATCHED * (t.count + stream.same_time):
            text = (
                f"{stream.same_time} of {t.count + stream.same_time} measurements have the stamp of another, so that "
            )
            text += "only the first of each batch is used: "
            text += (
                "stamps were written with too few digits; write them with six decimals (%.6f)"
                if few_digits(stream.time)
                else "they may be times of arrival; log times of measurement"
            )
            yield Finding(sensor, "warning", text, "bursts")
        yield from _gaps(log, config, t, period or 1.0 / t.rate)
        if sensor == "imu" and period is None and t.jitter * t.rate > 0.5:
            yield Finding(
                sensor,
                "warning",
                f"times jitter by {t.jitter:.3g} s around a period of {1 / t.rate:.3g} s: "
                "they may be times of arrival; log times of measurement",
                "jitter",
            )
        again = _repeated_for_a_moment(without(stream, frozen)) / t.count if sensor in ("imu", "mag", "dvl") else 0.0
        if again > REPEATED and _moves(stream):
            yield Finding(
                sensor,
                "warning",
                f"{again:.0%} of the measurements repeat the previous one exactly: "
                "the log is written faster than the sensor measures; log each measurement once",
                "repeats",
            )


def _burst_period(stream: Stream) -> float | None:
    """Time between bursts of a sensor that samples all the time [s]; None where its measurements come one by one."""
    periods = np.diff(stream.time)
    between = periods > periods.mean() if len(periods) else np.zeros(0, bool)
    if SENSORS[stream.sensor].occasional or np.count_nonzero(between) < ENOUGH_PERIODS:
        return None
    usual = float(np.percentile(periods[between], 90))
    if np.median(periods) > BURST * periods.mean() or usual > SILENT_S:
        return None
    return usual if stream.sensor == "imu" or periods[~between].sum() < WITHIN * periods.sum() else None


def _repeated_for_a_moment(stream: Stream) -> int:
    """Measurements that repeat the one before, but for zeros, and times in which the sensor may be frozen."""
    values = told(stream)
    runs = Runs.of(stream.time, values)
    known = runs.take(~np.isnan(runs.values).all(axis=1) & (runs.values[:, :3] != 0.0).any(axis=1))
    return int((known.count - 1)[~known.are_long()].sum())


def _moves(stream: Stream) -> bool:
    values = told(stream)[:, :3]
    return bool((np.nanstd(values, axis=0) > 0).any()) if np.isfinite(values).any() else False


def _gaps(log: Log, config: Config, t: Timing, period: float) -> Iterator[Finding]:
    """Silences of sensors that sample all the time, with a period [s], or a burst each."""
    if SENSORS[t.sensor].occasional or t.count < 3:
        return
    limit = GAP_PERIODS * period
    periods = np.diff(log[t.sensor].time)
    longer = int((periods > limit).sum())
    if not longer:
        return
    gaps = "1 gap" if longer == 1 else f"{longer} gaps"
    text = f"{gaps} longer than {limit:.3g} s, the longest {t.gap:.1f} s from {since(log, t.gap_at)} on"
    if t.sensor == "imu" and t.gap > config.imu.max_gap_s:
        text += f"; longer than imu.max_gap_s = {config.imu.max_gap_s:g}: split the log there or raise that key"
        yield Finding(t.sensor, "error", text, "gap")
    else:
        yield Finding(t.sensor, "warning", text, "gap")
