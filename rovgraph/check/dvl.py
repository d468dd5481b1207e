"""The DVL against the IMU by their accelerations: axes, mounting, clock, and jumps of a clock.

Nothing else is needed: no heading, no depth, no change of depth.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rovgraph.check.acceleration import ORIENTATIONS, Comparison, Fit, Search
from rovgraph.check.agreement import dives_with_depth
from rovgraph.check.findings import Finding, since, valid_pings
from rovgraph.check.inertial import inertial_motion
from rovgraph.check.values import GRAVITY_ANGLE, tilt
from rovgraph.config import Config, beliefs, mount_matrix
from rovgraph.geometry import Array, log_rotation
from rovgraph.log import Log, Stream
from rovgraph.sensors.dvl import axes_remedy

ENOUGH_PINGS = 50
FOLLOWS = 0.65  # likeness of accelerations that are of one motion
BETTER = 2.0  # times smaller an error than as configured, which chance does not make
ALIKE = 1.1  # times the least error, that tells two orientations apart no more
SIMPLER = 1.3  # times larger an error that a simpler explanation may leave
LAG_WARNING = 0.05  # [s]
APART = 0.15  # that search and fit may be apart [s]
SURE = 5.0  # standard deviations of a lag
EVIDENCE = 30.0  # in chi-square that a lag explains
TURNED = np.deg2rad(30.0)  # a mounting that is no small error; steady circles confuse smaller ones with a lag
JUMP_REACH = 10.0  # largest jump that is looked for where there is no gap [s]
LARGEST_JUMP = 120.0  # [s]
PIECE = 30.0  # shortest part of a dive that shows a lag [s]
GAPS = 2  # the largest, of IMU and DVL each, at which a clock may have been set
GAP = 0.5  # [s]


def dvl_and_imu(log: Log, config: Config) -> Iterator[Finding]:
    """Axes, mounting and clock of the DVL, by the IMU's accelerations."""
    if not {"dvl", "imu"} <= log.sensors or tilt(log, config) > GRAVITY_ANGLE:
        return
    pings, motion = valid_pings(log["dvl"]), inertial_motion(log, config)
    if motion is None or len(pings) < ENOUGH_PINGS:
        return
    compared = Comparison(motion, pings, config)
    found = compared.search()
    if np.isfinite(found.error).sum() == 0:
        return
    jump = _jump(log, compared, found)
    if jump is not None:
        yield jump
        return
    k, m = _explanation(found)
    if found.likeness[k, m] < FOLLOWS:
        yield Finding("dvl", "ok", "too little acceleration to compare its axes and clock with the IMU")
        return
    if k:
        k = _upright(log, config, found, m)
    fit = compared.refine(float(found.lags[m]), ORIENTATIONS[k])
    if fit is None:
        return
    better = found.error[0, found.now] / found.error[k, m]
    yield _mounting(config, k, fit, f"so its acceleration agrees {better:.1f} times better with the IMU's")
    yield _clock(config, compared, ORIENTATIONS[k], fit, float(found.lags[m]))


def _explanation(found: Search) -> tuple[int, int]:
    """Orientation and lag, by their indices: as configured unless another is far better, and one of the two if it does.

    A dive's legs are alike, so shifted or turned they may agree almost as well as when they are right.
    """
    both = np.unravel_index(int(np.argmin(found.error)), found.error.shape)
    axes, lag = int(np.argmin(found.error[:, found.now])), int(np.argmin(found.error[0]))
    least = found.error[both]
    if found.error[0, found.now] < BETTER * least or found.likeness[both] < FOLLOWS:
        near = np.abs(found.lags) <= 1.0  # small lags do not make errors twice as large
        return 0, int(np.flatnonzero(near)[np.argmin(found.error[0, near])])
    if found.error[0, lag] < SIMPLER * least:
        return 0, lag
    if found.error[axes, found.now] < SIMPLER * least:
        return axes, found.now
    return int(both[0]), int(both[1])


def _upright(log: Log, config: Config, found: Search, m: int) -> int:
    """Of orientations that agree alike, as the two senses of the vertical do on a level dive, the one to believe.

    Depth decides; where it shows nothing, an instrument is rather mounted in another way than left-handed.
    """
    error = found.error[:, m]
    alike = np.flatnonzero(error < ALIKE * error.min())
    R_bs = mount_matrix(config.dvl.mount_rpy_deg)
    by_depth = [dives_with_depth(log, config, R_bs @ ORIENTATIONS[k]) for k in alike]
    if max(by_depth) > FOLLOWS:
        return int(alike[int(np.argmax(by_depth))])
    handed = np.linalg.det(ORIENTATIONS[alike]) > 0.0
    chosen = alike[handed] if handed.any() else alike
    return int(chosen[int(np.argmin(error[chosen]))])


def _mounting(config: Config, k: int, fit: Fit, better: str) -> Finding:
    """Whether the mounting of a fit is that of the configuration."""
    R_bs = mount_matrix(config.dvl.mount_rpy_deg)
    turn = log_rotation((fit.R_bs @ (R_bs @ ORIENTATIONS[k]).T)[None])[0]
    yaw = beliefs(config)["dvl_yaw"]
    believed = np.array([0.0, 0.0, yaw.sd if yaw.estimate else 0.0])
    turned = bool((np.abs(turn) > np.maximum(TURNED, SURE * np.hypot(fit.turn_sd, believed))).any())
    if k == 0 and not turned:
        return Finding("dvl", "ok", f"accelerates as the IMU does, axes as mounted (likeness {fit.likeness:.2f})")
    if turned and np.linalg.det(fit.R_bs) > 0.0:
        cause, remedy = axes_remedy(np.eye(3), fit.R_bs)
        better = "by its acceleration" if k == 0 else better
    else:
        cause, remedy = axes_remedy(ORIENTATIONS[k], R_bs)
    return Finding("dvl", "warning", f"{cause}, {better} (likeness {fit.likeness:.2f}); {remedy}")


def _clock(config: Config, compared: Comparison, H: Array, fit: Fit, coarse: float) -> Finding:
    """Whether the stamps are late, by the fit and by the search, whose errors are others."""
    offset = beliefs(config)["dvl_time_offset"]
    mean = float(offset.mean[0])
    late = fit.lag - mean
    sense = "late" if late >= 0.0 else "early"
    text = f"its stamps are {abs(late):.3f} s {sense} against the IMU's (sd {fit.lag_sd:.3f} s)"
    allowed = max(LAG_WARNING, SURE * fit.lag_sd, 3.0 * offset.sd if offset.estimate else 0.0)
    if abs(late) < allowed:
        return Finding("dvl", "ok", text)
    if abs(fit.lag - coarse) > max(APART, SURE * fit.lag_sd) or abs(coarse - mean) < 0.5 * abs(late):
        return Finding("dvl", "ok", f"{text}, which the dive does not show well")
    as_stamped = compared.refine(mean, H, held=True)
    if as_stamped is not None and 3.0 * fit.count * (as_stamped.error / fit.error - 1.0) < EVIDENCE:
        return Finding("dvl", "ok", f"{text}, which the dive does not show well")
    entry = f"{{estimate: true, mean: {fit.lag:.3f}, sd: {max(0.02, 3.0 * fit.lag_sd):.2f}}}"
    return Finding("dvl", "warning", f"{text}: correct its clock, or state calibration.dvl_time_offset: {entry}", "lag")


@dataclass(frozen=True)
class _Split:
    """A time at which a clock may have jumped: a gap of one sensor, or the middle of the dive."""

    sensor: str
    before: float
    after: float


def _jump(log: Log, compared: Comparison, found: Search) -> Finding | None:
    """A lag that is another before and after some time."""
    time = compared.motion.time
    middle = float(0.5 * (time[0] + time[-1]))
    splits = [*_gaps(compared.pings), *_gaps(log["imu"]), _Split("", middle, middle)]
    for split in sorted(splits, key=lambda s: s.before - s.after):
        reach = min(1.5 * (split.after - split.before) + JUMP_REACH, LARGEST_JUMP)
        if split.before - time[0] < PIECE or time[-1] - split.after < PIECE:
            continue
        sides = [compared.search(reach, span) for span in ((time[0], split.before), (split.after, time[-1]))]
        best = [int(np.argmin(side.error[0])) for side in sides]
        lags = [float(side.lags[k]) for side, k in zip(sides, best, strict=True)]
        sure = all(side.likeness[0, k] > FOLLOWS for side, k in zip(sides, best, strict=True))
        worse = [
            side.error[0, _index(side, lag)] / side.error[0, k]
            for side, k, lag in zip(sides, best, lags[::-1], strict=True)
        ]
        if sure and min(worse) > BETTER:
            return _said_of_jump(log, split, lags)
    return None


def _index(side: Search, lag: float) -> int:
    return int(np.argmin(np.abs(side.lags - lag)))


def _gaps(stream: Stream) -> list[_Split]:
    """The largest gaps of a stream, after which its clock may be another."""
    periods = np.diff(stream.time)
    widest = np.argsort(periods)[-GAPS:]
    wide = widest[periods[widest] > max(GAP, 2.5 * float(np.median(periods)))]
    return [_Split(stream.sensor, float(stream.time[k]), float(stream.time[k + 1])) for k in wide]


def _said_of_jump(log: Log, split: _Split, lags: list[float]) -> Finding:
    by = lags[1] - lags[0]
    told = (
        f"the DVL's stamps are {lags[0]:.1f} s late against the IMU's before {since(log, split.before)} "
        f"and {lags[1]:.1f} s after {since(log, split.after)}"
    )
    if not split.sensor:
        return Finding("log", "warning", f"{told}: a clock drifts or jumps; put both on one clock", "jump")
    name, by = ("DVL", by) if split.sensor == "dvl" else ("IMU", -by)
    return Finding(split.sensor, "warning", f"{told}: the {name}'s clock jumps by {by:+.1f} s in the gap between; "
                   f"correct its stamps from there on, or split the log", "jump")  # fmt: skip
