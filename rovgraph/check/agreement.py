"""Whether sensors that see the same motion agree: sign, scale, and clock.

Each comparison takes what two sensors say of the change within windows of some seconds
and fits ``change_b = slope * change_a + const``, so biases and constant offsets drop out.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.check.correlation import Correlator
from rovgraph.check.findings import Finding, integral, valid_pings
from rovgraph.check.inertial import inertial_motion
from rovgraph.config import Config, mount_matrix
from rovgraph.geometry import Array, cross, rotate
from rovgraph.log import Log, Stream
from rovgraph.sensors import Level

ENOUGH_TURNING = 0.05  # sd of the turn within a window [rad]
ENOUGH_DIVING = 0.05  # sd of the change of depth within a window [m]
MIN_WINDOWS = 15
FOLLOWS = 0.7  # correlation of sensors that see the same motion
CLOSELY = 0.95  # correlation beyond which a slope is that of the scales
LAG_WARNING = 0.3  # [s]
LARGEST_LAG = 3.0  # that is searched for [s]
NOISE_MARGIN = 2.0  # of turning over a heading's noise, below which the two need not agree
FARTHEST_LAG = 300.0  # that is searched for coarsely [s]
FAR_BETTER = 4.0  # times smaller a part that two signals do not share
EVIDENCE = 2.0  # in chi-square, that a lag of a heading explains
WAVE_EVIDENCE = 12.0  # that a lag of a depth explains: waves are alike after a period
SURE = 3.0  # standard deviations of a lag that is no chance
PARTS = 10  # of the log, each left out once to see how much a lag depends on it
OVERLAP = 5  # windows that begin within one
NAMES = {"mag": "the field's direction", "ahrs": "ahrs_yaw", "dvl_heading": "dvl_heading"}


@dataclass(frozen=True)
class Signal:
    """An integrated quantity over time, such as a heading without jumps.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    value : ndarray, shape (n,)
    """

    time: Array
    value: Array

    def at(self, times: Array, longest: float) -> Array:
        """Values at times of any order, NaN in a gap; shape (len(times),)."""
        k = np.searchsorted(self.time, times).clip(1, len(self.time) - 1)
        in_gap = self.time[k] - self.time[k - 1] > longest
        inside = (times >= self.time[0]) & (times <= self.time[-1]) & ~in_gap
        return np.where(inside, np.interp(times, self.time, self.value), np.nan)

    def changes(self, edges: Array, longest: float) -> Array:
        """Change from each edge to the next, NaN next to a gap; shape (len(edges) - 1,)."""
        return np.diff(self.at(edges, longest))


@dataclass(frozen=True)
class Fit:
    """Straight line through the changes of two signals.

    Attributes
    ----------
    slope, correlation : of b's changes against a's
    sd_a, sd_b : of the changes
    windows : how many
    """

    slope: float
    correlation: float
    sd_a: float
    sd_b: float
    windows: int


@dataclass(frozen=True)
class Lag:
    """How much later one signal shows a motion than another.

    Attributes
    ----------
    seconds : NaN if they do not follow each other
    sd : NaN if it is not known
    evidence : how much better they agree than unshifted, in chi-square
    """

    seconds: float
    sd: float
    evidence: float = 0.0

    def significant(self, evidence: float) -> bool:
        """Whether it is more than noise makes of clocks that agree, and explains so much."""
        beyond = abs(self.seconds) > LAG_WARNING and abs(self.seconds) > SURE * self.sd
        return bool(beyond and self.evidence > evidence)


def fit(a: Signal, b: Signal, window: float) -> Fit:
    """Compare the changes of two signals."""
    first, last = max(a.time[0], b.time[0]) + LARGEST_LAG, min(a.time[-1], b.time[-1]) - LARGEST_LAG
    edges = np.arange(first, last, window)
    if len(edges) < 3:
        return Fit(np.nan, 0.0, 0.0, 0.0, 0)
    x, y = a.changes(edges, window), b.changes(edges, window)
    both = np.isfinite(x) & np.isfinite(y)
    x, y = x[both], y[both]
    if len(x) < 3 or x.std() == 0.0 or y.std() == 0.0:
        return Fit(np.nan, 0.0, 0.0, 0.0, len(x))
    correlation = float(np.corrcoef(x, y)[0, 1])
    return Fit(correlation * float(y.std() / x.std()), correlation, float(x.std()), float(y.std()), len(x))


def coarse_lag(a: Signal, b: Signal, window: float) -> float:
    """How much later b shows the same motion than a, to a step, where that is beyond what `lag` searches; else 0 [s].

    Legs of a dive are alike, so a shifted one has to agree far better than the one that is not shifted.
    """
    step = 0.5
    first, last = max(a.time[0], b.time[0]), min(a.time[-1], b.time[-1])
    times = np.arange(first, last, step)
    apart = max(1, round(window / step))
    if len(times) < 4 * MIN_WINDOWS * apart:
        return 0.0
    values = [signal.at(times, window) for signal in (a, b)]
    changes = [value[apart:] - value[:-apart] for value in values]
    known = [np.isfinite(change) for change in changes]
    x, y = (np.where(k, change - np.nanmean(change), 0.0) for k, change in zip(known, changes, strict=True))
    reach = int(min(FARTHEST_LAG / step, 0.4 * len(x)))
    correlate = Correlator(len(x), reach)
    left, right = (np.column_stack([k * 1.0, v, v * v]) for k, v in zip(known, (x, y), strict=True))
    both = correlate(left, right)
    sums = np.array([both[0, 0], both[1, 0], both[0, 1], both[2, 0], both[0, 2], both[1, 1]]).T
    lags = step * np.arange(-reach, reach + 1)
    correlation = np.where(sums[:, 0] > 0.5 * len(x), _correlation(sums), 0.0)
    near = np.abs(lags) <= LARGEST_LAG
    best = int(np.argmax(correlation))
    far_better = 1.0 - correlation[near].max() ** 2 > FAR_BETTER * (1.0 - correlation[best] ** 2)
    return float(lags[best]) if correlation[best] > FOLLOWS and far_better else 0.0


def lag(a: Signal, b: Signal, window: float) -> Lag:
    """How much later b shows the same motion than a; NaN if they do not follow each other.

    ``a``, the less noisy one, is moved along: b's noise is then the same at every lag, so that
    the correlation is a smooth function of it. The standard deviation comes from leaving out one
    part of the log after the other, which needs no model of what the two signals do not share.
    """
    step = 0.1
    lags = np.arange(-LARGEST_LAG, LARGEST_LAG + step / 2, step)
    first, last = max(a.time[0], b.time[0]) + LARGEST_LAG, min(a.time[-1], b.time[-1]) - LARGEST_LAG
    times = np.arange(first, last, window / OVERLAP)
    count = len(times) - OVERLAP
    if count < OVERLAP * MIN_WINDOWS:
        return Lag(np.nan, np.nan)

    def changes(signal: Signal, late: float) -> Array:
        value = signal.at(times - late, window)
        return value[OVERLAP:] - value[:-OVERLAP]

    centre = coarse_lag(a, b, window)
    b = Signal(b.time - centre, b.value)
    part, y = np.arange(count) * PARTS // count, changes(b, 0.0)
    sums = np.array([_moments(changes(a, float(x)), y, part) for x in lags])
    every = sums.sum(axis=-1)
    correlation = _correlation(every)
    seconds = _peak(lags, correlation)
    without = np.array([_peak(lags, _correlation(every - sums[..., k])) for k in range(PARTS)])
    unshifted = correlation[len(lags) // 2] if centre == 0.0 else 0.0
    better = np.log((1.0 - unshifted**2) / max(1.0 - float(correlation.max()) ** 2, 1e-9))
    return Lag(centre + seconds, float(np.sqrt((PARTS - 1) * np.var(without))), float(better * count / OVERLAP))


def _moments(x: Array, y: Array, part: NDArray[np.int64]) -> Array:
    """Sums over the windows of each part: how many, x, y, x squared, y squared, x times y; shape (6, PARTS)."""
    both = np.isfinite(x) & np.isfinite(y)
    x, y = np.where(both, x, 0.0), np.where(both, y, 0.0)
    return np.array([np.bincount(part, w, PARTS) for w in (both * 1.0, x, y, x * x, y * y, x * y)])


def _correlation(sums: Array) -> Array:
    """Absolute correlation of sums (m, 6) as `_moments` gives them; shape (m,), 0 where there is none."""
    n, x, y, xx, yy, xy = sums.T
    spread = (n * xx - x * x) * (n * yy - y * y)
    return np.asarray(np.abs(n * xy - x * y) / np.sqrt(np.where(spread > 0.0, spread, np.inf)))


def _peak(lags: Array, correlation: Array) -> float:
    """Lag at which a correlation is largest [s]; NaN if the signals do not follow each other there."""
    k = int(np.argmax(correlation))
    if not 0 < k < len(lags) - 1 or correlation[k] < FOLLOWS:
        return np.nan
    before, peak, after = correlation[k - 1 : k + 2]
    bend = before - 2.0 * peak + after
    return float(lags[k] + (0.5 * (lags[1] - lags[0]) * (before - after) / bend if bend < 0 else 0.0))


def headings(log: Log, config: Config) -> Iterator[Finding]:
    """Every heading turns as the gyro does: direction, unit and clock."""
    if "imu" not in log or len(log["imu"]) < 3:
        return
    gyro = _gyro_yaw(log["imu"], config)
    for sensor in ("mag", "ahrs", "dvl_heading"):
        if sensor not in log or len(log[sensor]) < MIN_WINDOWS:
            continue
        heading = _heading(log, config, sensor)
        period = float(np.median(np.diff(heading.time)))
        window = max(2.0, 3.0 * period)
        f = fit(gyro, heading, window)
        if abs(f.correlation) < FOLLOWS:
            shifted = Signal(heading.time - coarse_lag(gyro, heading, window), heading.value)
            f = fit(gyro, shifted, window)
        noise = _change_noise(heading, window)
        yield _turning(log, sensor, f, noise)
        if sensor != "mag" and abs(f.correlation) > FOLLOWS and max(f.sd_a, f.sd_b) > ENOUGH_TURNING:
            # short windows: in long ones a compass's deviation looks like a lag
            found = lag(gyro, heading, max(1.0, 1.5 * period))
            remedy = (
                f" If it is late, state delay_s: {{{sensor}: {config.delay_s.get(sensor, 0.0) + found.seconds:.2g}}}"
            )
            what = f"the turning that {NAMES[sensor]} shows"
            yield from _clock(sensor, what, "the gyro's", found, EVIDENCE, remedy)


def heading_lag(log: Log, config: Config, sensor: str) -> tuple[float, float] | None:
    """How much later a compass turns than the gyro, and its sd [s]; None where it does not follow the gyro."""
    if sensor not in NAMES or len(log[sensor]) < MIN_WINDOWS:
        return None
    heading = _heading(log, config, sensor)
    found = lag(_gyro_yaw(log["imu"], config), heading, max(1.0, 1.5 * float(np.median(np.diff(heading.time)))))
    return None if np.isnan(found.seconds) or np.isnan(found.sd) else (found.seconds, found.sd)


def _gyro_yaw(imu: Stream, config: Config) -> Signal:
    """Integrated rate about the body's z axis [rad]."""
    rate_b = rotate(mount_matrix(config.imu.mount_rpy_deg), imu.data[:, 3:])
    return Signal(imu.time, integral(imu, rate_b[:, 2]))


def _heading(log: Log, config: Config, sensor: str) -> Signal:
    """A heading without jumps, of whatever circle its numbers suggest."""
    stream = log[sensor]
    values = _magnetic_heading(log, config) if sensor == "mag" else stream.data[:, 0]
    return Signal(stream.time, np.unwrap(values, period=_circle(values)))


def _magnetic_heading(log: Log, config: Config) -> Array:
    """Heading of the field's horizontal part, shape (n,) [rad]."""
    stream, motion = log["mag"], inertial_motion(log, config)
    field_b = rotate(mount_matrix(config.imu.mount_rpy_deg), stream.data)
    if motion is None:
        return np.asarray(np.arctan2(-field_b[:, 1], field_b[:, 0]))
    down_b = np.column_stack([np.interp(stream.time, motion.time, column) for column in motion.down_b.T])
    starboard_b = cross(down_b, np.broadcast_to(np.eye(3)[0], down_b.shape))
    forward_b = cross(starboard_b, down_b)
    return np.asarray(np.arctan2(-np.sum(starboard_b * field_b, axis=1), np.sum(forward_b * field_b, axis=1)))


def _circle(values: Array) -> float:
    """The full circle that the numbers of a heading suggest: degrees, radians, or radians converted twice."""
    if _beyond_circle(values):
        return 360.0
    twice = np.deg2rad(2.0 * np.pi)
    return float(twice) if 0.96 * twice < np.ptp(values) < 1.01 * twice else 2.0 * np.pi


def _beyond_circle(values: Array) -> bool:
    return bool(np.abs(values).max() > 2.0 * np.pi + 0.01)


def _change_noise(heading: Signal, window: float) -> float:
    """Noise of a heading's changes, by the second differences at even times, which turns hardly reach [rad]."""
    values = heading.at(np.arange(heading.time[0], heading.time[-1], window), window)
    second = np.abs(np.diff(values, 2))
    second = second[np.isfinite(second)]
    return float(np.median(second)) / 0.6745 / np.sqrt(3.0) if len(second) else 0.0


def _turning(log: Log, sensor: str, f: Fit, noise: float) -> Finding:
    """What a comparison of a heading with the gyro means."""
    name, beyond = NAMES[sensor], sensor != "mag" and _beyond_circle(log[sensor].data[:, 0])
    if f.windows < MIN_WINDOWS or max(f.sd_a, f.sd_b) < ENOUGH_TURNING:
        if beyond:
            largest = np.abs(log[sensor].data[:, 0]).max()
            return Finding(sensor, "warning", f"{name} reaches {largest:.4g} rad; in degrees? {_say_degrees(sensor)}")
        return Finding(sensor, "ok", f"too little turning to compare {name} with the gyro")
    numbers = f"slope {f.slope:.3g}, correlation {f.correlation:.2f} over {f.windows} windows"
    if abs(f.correlation) < FOLLOWS and f.sd_a < NOISE_MARGIN * noise:
        return Finding(sensor, "ok", f"too little turning for its noise to compare {name} with the gyro ({numbers})")
    if abs(f.correlation) < FOLLOWS:
        hint = "hard iron, or a wrong mounting?" if sensor == "mag" else "wrong unit, mounting or clock?"
        return Finding(sensor, "warning", f"{name} does not follow the gyro ({numbers}); {hint}")
    if 40.0 < abs(f.slope) < 80.0 or 1 / 80.0 < abs(f.slope) < 1 / 40.0:
        return Finding(sensor, "error", f"{_factor_of_57(log, sensor, f.slope)} ({numbers})")
    if f.slope < 0.0:
        return Finding(
            sensor,
            "warning",
            f"{name} turns against the gyro ({numbers}): the heading counts anticlockwise, or the IMU's z axis points "
            "up (imu.mount_rpy_deg)",
        )
    level: Level = "ok" if 0.7 < f.slope < 1.4 else "warning"
    return Finding(sensor, level, f"{name} turns with the gyro ({numbers})")


def _factor_of_57(log: Log, sensor: str, slope: float) -> str:
    """Which of gyro and heading is in the wrong unit."""
    fast = float(np.percentile(np.abs(log["imu"].data[:, 3:]), 99))
    name = NAMES[sensor]
    if abs(slope) < 1.0:
        if sensor != "mag" and np.ptp(log[sensor].data[:, 0]) < 2 * np.pi / 50 and fast < 3.0:
            return f"{name} is 57 times too small; was it converted to radians twice, by units: too?"
        return "the gyro is 57 times too fast; in deg/s? Say units: {gyr: deg/s}"
    if sensor != "mag" and _beyond_circle(log[sensor].data[:, 0]):
        return f"{name} is 57 times too large; in degrees? {_say_degrees(sensor)}"
    return "the gyro is 57 times too slow; was it converted to rad/s twice, by units: too?"


def _say_degrees(sensor: str) -> str:
    return f"Say units: {{{sensor}: deg}}"


def _clock(sensor: str, what: str, against: str, found: Lag, evidence: float, remedy: str = "") -> Iterator[Finding]:
    """A lag, if there is one."""
    if np.isnan(found.seconds):
        return
    later = f"{abs(found.seconds):.2f} s {'later' if found.seconds > 0 else 'earlier'} than {against}"
    sd = f" (sd {found.sd:.2f} s)" if np.isfinite(found.sd) else ""
    if found.significant(evidence):
        text = f"{what} comes {later}{sd}: do the clocks disagree, or is it filtered slowly?{remedy}"
        yield Finding(sensor, "warning", text, "lag")
    else:
        yield Finding(sensor, "ok", f"{what} comes {later}{sd}")


def vertical(log: Log, config: Config) -> Iterator[Finding]:
    """The DVL's velocity downwards against the change of depth: sign and clock."""
    if not {"dvl", "depth", "imu"} <= log.sensors or len(log["depth"]) < MIN_WINDOWS:
        return
    pings = valid_pings(log["dvl"])
    if len(pings) < MIN_WINDOWS:
        return
    down = _downwards(log["imu"], config, pings.time)
    depth, dvl, window = _descents(log, pings, mount_matrix(config.dvl.mount_rpy_deg), down)
    f = fit(depth, dvl, window)
    if f.windows < MIN_WINDOWS or f.sd_a < ENOUGH_DIVING:
        yield Finding("dvl", "ok", "too little diving to compare its vertical velocity with depth")
        return
    numbers = f"slope {f.slope:.2g}, correlation {f.correlation:.2f} over {f.windows} windows"
    if abs(f.correlation) < FOLLOWS:
        if f.sd_a < 2.0 * np.sqrt(2.0) * _depth_noise(depth, config, window):
            yield Finding("dvl", "ok", "too little diving for the noise of depth to compare its vertical velocity with")
        elif f.sd_b < 2.0 * f.sd_a:  # noise of the DVL would be larger
            yield Finding("dvl", "warning", f"vertical velocity does not follow depth ({numbers}); mounting or clock?")
        return
    if f.slope < 0.0:
        yield Finding(
            "dvl",
            "warning",
            f"vertical velocity has the sign opposite to the change of depth ({numbers}): {_flip(config)}; "
            "or does depth count upwards?",
        )
    else:
        low, high = (0.7, 1.4) if abs(f.correlation) > CLOSELY else (0.4, 2.5)  # few pings a wave lower the slope
        level: Level = "ok" if low < f.slope < high else "warning"
        yield Finding("dvl", level, f"vertical velocity agrees with the change of depth ({numbers})")
    found = lag(dvl, depth, window)  # the integral is the less noisy one
    behind = Lag(-found.seconds, found.sd, found.evidence)
    yield from _clock("dvl", "vertical velocity", "the change of depth", behind, WAVE_EVIDENCE)


def _descents(log: Log, pings: Stream, R_bs: Array, down_b: Array) -> tuple[Signal, Signal, float]:
    """Depth, the way downwards by a DVL with a mounting, and the window over which the two are compared [s]."""
    way = integral(pings, np.sum(rotate(R_bs, pings.data[:, :3]) * down_b, axis=1))
    window = max(4.0, 4.0 * float(np.median(np.diff(pings.time))))
    return Signal(log["depth"].time, log["depth"]["depth"]), Signal(pings.time, way), window


def dives_with_depth(log: Log, config: Config, R_bs: Array) -> float:
    """Correlation of depth with the way downwards by a DVL with a mounting; 0 if nothing is to be seen."""
    if "depth" not in log or len(log["depth"]) < MIN_WINDOWS:
        return 0.0
    pings = valid_pings(log["dvl"])
    f = fit(*_descents(log, pings, R_bs, _downwards(log["imu"], config, pings.time)))
    return f.correlation if f.windows >= MIN_WINDOWS and f.sd_a > ENOUGH_DIVING else 0.0


def _depth_noise(depth: Signal, config: Config, window: float) -> float:
    """Noise of a depth [m]: the configuration's, or what second differences show where that is more."""
    if np.median(np.diff(depth.time)) > window / 4.0:  # they would show the diving
        return config.depth.sd_m
    shown = np.median(np.abs(np.diff(depth.value, 2))) / 0.6745 / np.sqrt(6.0)
    return float(max(config.depth.sd_m, shown))


def _flip(config: Config) -> str:
    """A hint at a DVL that is mounted the other way up."""
    roll, pitch, yaw = config.dvl.mount_rpy_deg
    turned, points = (180, "up") if abs(roll) < 90 else (0, "down")
    return f"does the DVL's z axis point {points}? Then dvl.mount_rpy_deg is [{turned}, {pitch:g}, {yaw:g}]"


def _downwards(imu: Stream, config: Config, time: Array, span: float = 2.0) -> Array:
    """Unit vector of gravity in body axes from the mean specific force around each time.

    Parameters
    ----------
    time : ndarray, shape (m,)
    span : averaged over so long [s]

    Returns
    -------
    ndarray, shape (m, 3)
    """
    R_bs = mount_matrix(config.imu.mount_rpy_deg)
    total = np.vstack([np.zeros(3), np.cumsum(imu.data[:, :3], axis=0)])
    low = np.searchsorted(imu.time, time - span / 2).clip(0, len(imu) - 1)
    high = np.maximum(np.searchsorted(imu.time, time + span / 2), low + 1)
    f_b = rotate(R_bs, (total[high] - total[low]) / (high - low)[:, None])
    out: Array = -f_b / np.maximum(np.linalg.norm(f_b, axis=1, keepdims=True), 1e-9)
    return out
