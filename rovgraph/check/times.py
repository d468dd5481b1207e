"""Which sensors there are, and when their measurements came."""

from collections.abc import Iterator, Sequence

import numpy as np

from rovgraph.check.epochs import shift_of_epoch
from rovgraph.check.findings import Finding, Timing, since, told
from rovgraph.config import Config
from rovgraph.engine.constant_velocity import motion_model
from rovgraph.instruments import heading_sources
from rovgraph.log import Log, Stream
from rovgraph.log.frozen import FrozenStretch, Runs, repeats, without
from rovgraph.log.streams import GAP_PERIODS
from rovgraph.rules import SILENT_S
from rovgraph.sensors import SENSORS
from rovgraph.stamps import few_digits

BURST = 0.3  # of the mean period, below which most periods lie within bursts
WITHIN = 0.1  # of the time, that bursts last at most of sensors other than the IMU, which may measure now and then only
ENOUGH_PERIODS = 20
BATCHED = 0.5  # share of measurements that have the stamp of another, beyond which they come in batches
REPEATED = 0.2  # share of repeated samples that a sensor does not produce by itself


def timing(stream: Stream) -> Timing:
    """When the measurements of one sensor came."""
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
        elif sensor.if_missing is not None and sensor.name not in log:
            yield Finding(sensor.name, *sensor.if_missing, "missing")
    if not heading_sources(config, log.sensors):
        known = (
            "heading starts at start.heading_deg and drifts with the gyro"
            if config.start.heading_deg is not None
            else "give mag, ahrs_yaw, heading or dvl_heading, or at least start.heading_deg"
        )
        yield Finding("log", "warning", f"no heading source in use: {known}", "missing")


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
    for sensor, stream in log.streams.items():
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
