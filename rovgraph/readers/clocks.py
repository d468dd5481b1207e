"""Joins several recordings on one clock: the IMU's, or Unix time where the IMU's clock is known in it.

Clocks of one file whose Unix time is known, or that share arrivals, form an axis. `join_clocks` joins axes by a shift
that the user states, by Unix time, or by the motion that both show; a shift that motion contradicts by more than
`AGREE_S` is corrected, with a warning.

`find_offset` finds the offset of two clocks by the motion that both recordings show. It searches all lags first
(`rovgraph.readers.lag_search`). The best lag is accepted where it explains the motion far better than any other, and
least squares then give the offset and the drift with their standard deviations, these by leaving out one part of the
dive after the other.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.check.lags import PARTS, normal_equations, spread
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.disk_columns import every
from rovgraph.log.stamps import known_offset
from rovgraph.readers.lag_search import MotionSignals, SignalPair, coarse_step, comparisons
from rovgraph.readers.recording import Channel, Recording
from rovgraph.readers.selection import Selected, file_names
from rovgraph.rules import EPOCH_SD_S

LEAST_OVERLAP = 30.0  # [s]
OVERLAP = 0.3  # of the shorter recording
FOLLOWS = 0.3  # part of the motion's square that has to be explained
EVIDENCE = 40.0  # in chi-square, that the best lag is better than any other
DRIFT_SD = 1e-4  # of crystals, their prior
ITERATIONS = 20
HELD = 3  # of them with the lag held, until mountings fit
HOLD = 1e18  # information
LARGEST_STEP = 0.25  # windows of lag at a time
RIVAL = 0.6  # of the best evidence, from which a lag is refined, too
MOST_RIVALS = 10
FAR = 0.02  # of the best evidence, that others fall short
SAME = 4.0  # standard deviations between lags that are one
TINY = 1e-9  # information, that no step is undetermined
SETTLED = 1e-5  # [s]
CLIPPED = 5.0  # differences larger than so many times the usual one do not count
DIFFERENCE = 0.05  # over which derivatives with respect to the lag are taken [s]


@dataclass(frozen=True)
class Offset:
    """How much later clock B is than clock A: ``t_b = t_a + seconds + drift (t_a - at)``.

    Attributes
    ----------
    seconds, sd : at the time ``at`` of clock A [s]
    drift, drift_sd : of B against A
    at : middle of the overlap, by clock A [s]
    overlap : time that both recordings cover [s]
    explained : part of the motion's square that the two share
    how : what was compared
    """

    seconds: float
    sd: float
    drift: float
    drift_sd: float
    at: float
    overlap: float
    explained: float
    how: str

    def reversed(self) -> "Offset":
        """How much later clock A is than B."""
        at, drift = self.at + self.seconds, -self.drift / (1.0 + self.drift)
        return Offset(-self.seconds, self.sd, drift, self.drift_sd, at, self.overlap, self.explained, self.how)


def find_offset(a: MotionSignals, b: MotionSignals) -> Offset | None:
    """The offset of two recordings' clocks, by all quantities that both show; None where these do not determine it.

    Candidates are the lags at which all together agree best; each is refined by every quantity. The best candidate
    counts if it explains the motion far better than any other, and the quantity with the least sd gives its offset.
    """
    searched = [_search(comparison, sign) for comparison, sign in comparisons(a, b) if _long_enough(comparison)]
    if not searched:
        return None
    step = min(coarse_step(each.comparison) for each in searched)
    lags = np.arange(min(each.lags[0] for each in searched), max(each.lags[-1] for each in searched), step)
    evidence = np.sum([np.interp(lags, each.lags, each.evidence, 0.0, 0.0) for each in searched], axis=0)
    peaks = _peaks(evidence)
    if not peaks.size:
        return None
    rivals = peaks[evidence[peaks] > RIVAL * evidence[peaks[0]]][:MOST_RIVALS]
    found = [(candidate, k) for k in rivals if (candidate := _candidate(searched, float(lags[k]))) is not None]
    found.sort(key=lambda each: -each[0][1])
    if not found:
        return None
    (offset, best), at = found[0]
    others = [total for (other, total), _ in found[1:] if _differ(other, offset)]
    unrefined = float(evidence[peaks[len(rivals)]]) if len(rivals) < len(peaks) else 0.0
    second = max([unrefined * best / float(evidence[at]), *others])  # refined, it may gain as much as the best one
    certain = offset.sd < EPOCH_SD_S and best - second > max(EVIDENCE, FAR * best)
    return offset if certain else None


@dataclass(frozen=True)
class _Searched:
    """One quantity, and how much better two recordings agree in it than by chance, in chi-square.

    Attributes
    ----------
    comparison : with the roles of both exchanged where sign is -1
    sign : of the comparison's lags
    lags, evidence : ndarray, shape (l,), lags as those of B against A, increasing [s]
    parameters : ndarray, shape (l, p)
    """

    comparison: SignalPair
    sign: float
    lags: Array
    evidence: Array
    parameters: Array

    def refined(self, lag: float) -> tuple[Offset, float] | None:
        """The offset near a lag, and its evidence."""
        near = np.abs(self.lags - lag) <= self.comparison.window
        k = int(np.argmax(np.where(near, self.evidence, -np.inf)))
        fit = _refined(self.comparison, self.sign * float(self.lags[k]), self.parameters[k])
        if fit is None or fit[0].explained < FOLLOWS:
            return None
        return (fit[0] if self.sign > 0.0 else fit[0].reversed()), fit[1]


def _long_enough(comparison: SignalPair) -> bool:
    return min(float(np.ptp(span)) for span in comparison.spans) >= LEAST_OVERLAP


def _search(comparison: SignalPair, sign: float) -> _Searched:
    sums = comparison.search(coarse_step(comparison))
    least = max(LEAST_OVERLAP, OVERLAP * min(float(np.ptp(span)) for span in comparison.spans))
    evidence = np.log(sums.total / sums.error) * sums.seconds / comparison.window
    evidence = np.where(sums.seconds >= least, evidence, 0.0)
    order = slice(None) if sign > 0.0 else slice(None, None, -1)
    return _Searched(comparison, sign, sign * sums.lags[order], evidence[order], sums.parameters[order])


def _candidate(searched: Sequence[_Searched], lag: float) -> tuple[Offset, float] | None:
    """The most certain offset near a lag, and the evidence of all quantities that show the same one."""
    fits = [fit for each in searched if (fit := each.refined(lag)) is not None]
    if not fits:
        return None
    best = min(fits, key=lambda fit: fit[0].sd)[0]
    return best, sum(evidence for offset, evidence in fits if not _differ(offset, best))


def _differ(one: Offset, other: Offset) -> bool:
    """Whether two offsets are not the same within their sd, at the middle of the first."""
    apart = one.seconds - other.seconds - other.drift * (one.at - other.at)
    return abs(apart) > SAME * float(np.hypot(one.sd, other.sd))


def _peaks(evidence: Array) -> NDArray[np.int64]:
    """Indices of the local maxima, the largest first."""
    padded = np.concatenate([[-np.inf], evidence, [-np.inf]])
    maxima = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]) & (evidence > 0.0))
    return np.asarray(maxima[np.argsort(-evidence[maxima])])


def _refined(comparison: SignalPair, lag: float, parameters: Array) -> tuple[Offset, float] | None:
    """Least squares from a lag, and its evidence; None where too little is known there."""
    (begin_a, end_a), (begin_b, end_b) = comparison.spans
    begin, end = max(begin_a, begin_b - lag), min(end_a, end_b - lag)
    step, at = coarse_step(comparison), 0.5 * (begin + end)
    times = np.arange(begin, end, step)
    observed = comparison.observed(times)
    seconds, drift, farthest = lag, 0.0, LARGEST_STEP * comparison.window
    fit = _step(comparison, times - at, times, observed, (seconds, drift), parameters, held=True)
    for k in range(ITERATIONS):
        if fit is None:
            return None
        seconds, drift = seconds + float(np.clip(fit.move[0], -farthest, farthest)), drift + float(fit.move[1])
        parameters = comparison.moved(parameters, fit.move[2:])
        settled = k > HELD and abs(fit.move[0]) < SETTLED
        fit = _step(comparison, times - at, times, observed, (seconds, drift), parameters, held=k < HELD)
        if settled:
            break
    if fit is None:
        return None
    overlap = fit.known * step
    sd, drift_sd = (float(value) for value in fit.sd)
    offset = Offset(seconds, sd, drift, drift_sd, at, overlap, fit.explained, comparison.name)
    return offset, -float(np.log(max(1.0 - fit.explained, 1e-9))) * overlap / comparison.window


@dataclass(frozen=True)
class _Fit:
    """One step of Gauss and Newton: of offset, drift and parameters, with the sd of the first two."""

    move: Array
    sd: Array
    explained: float
    known: int


def _step(
    comparison: SignalPair,
    since: Array,
    times: Array,
    shown: tuple[Array, Array],
    clock: tuple[float, float],
    parameters: Array,
    held: bool,
) -> _Fit | None:
    """Linearise and solve, with the clock held or not; None where too little is known."""
    others = times + clock[0] + clock[1] * since
    y, shown_too = shown
    X, earlier, later = (comparison.regressors(shown_too, others + h * DIFFERENCE) for h in (0.0, -0.5, 0.5))
    known = np.isfinite(y).all(axis=1) & np.isfinite(X + earlier + later).all(axis=(1, 2))
    if np.count_nonzero(known) < 4 * PARTS:
        return None
    left = y[known] - X[known] @ parameters
    by_lag = (later - earlier)[known] @ parameters / DIFFERENCE
    J = np.concatenate(
        [by_lag[..., None], (since[known, None] * by_lag)[..., None], X[known] @ comparison.tangent(parameters)], axis=2
    )
    size = np.sum(left**2, axis=1)
    usable = size <= CLIPPED**2 * max(float(np.median(size)), 1e-12)
    J, left, seen = J[usable], left[usable], y[known][usable]
    variance = max(float(np.mean(left**2)), 1e-18)
    H, g = normal_equations(J, left, variance)
    prior = TINY + np.concatenate([[0.0, 0.0], comparison.information])
    information = H.sum(axis=0) + np.diag(prior)
    without = np.linalg.solve(information - H, (g.sum(axis=0) - g)[..., None])[:, 0, 0]
    sd = np.hypot(spread(without), comparison.floor_s)
    wider = max(1.0, float(sd) / float(np.sqrt(np.linalg.inv(information)[0, 0]))) ** 2
    prior[1] += DRIFT_SD**-2
    prior[:2] += HOLD if held else 0.0
    information = H.sum(axis=0) / wider + np.diag(prior)
    towards = g.sum(axis=0) / wider
    towards[1] -= clock[1] * DRIFT_SD**-2
    move, covariance = np.linalg.solve(information, towards), np.linalg.inv(information)
    explained = 1.0 - float(np.sum(left**2)) / max(float(np.sum((seen - seen.mean(axis=0)) ** 2)), 1e-18)
    return _Fit(move, np.sqrt(np.diag(covariance)[:2]), explained, int(np.count_nonzero(known)))


UNKNOWN_ZONE_S = 1800.0  # sd of a clock that may show local time
AGREE_S = 0.5  # stamps that motion contradicts by less stay: a sensor may be late by as much
SYSTEMATIC_S = 0.06  # by motion 12 simulated dives of two minutes were 0.03 s off, rms, at an sd of 0.01 s
SURE = 3.0  # standard deviations of a contradiction
SINCE_2000 = 9.5e8  # Unix time before is that of a clock that was never set [s]
ARRIVAL_WINDOW_S = 60.0  # over which the least delay of a transport is taken
ARRIVAL_SD_S = 0.02  # of a transport's least delay
BASES = ("imu", "dvl")  # whose clock the others are put on

MotionOf = Callable[[Sequence[Channel]], MotionSignals]


@dataclass(frozen=True)
class ClockLine:
    """Times of one clock by another's stamps: ``t + offset + drift (t - at)``."""

    offset: float = 0.0
    drift: float = 0.0
    at: float = 0.0

    def __call__(self, time: Array) -> Array:
        moved = time + self.offset
        return moved + self.drift * (time - self.at) if self.drift else moved


@dataclass(frozen=True)
class JoinedClock:
    """How one clock came onto the log's.

    Attributes
    ----------
    file : index of the recording
    name : of the clock
    lines : that its stamps go through, one after the other
    sd, drift_sd : of the last one [s], 1
    how : in words
    """

    file: int
    name: str
    lines: tuple[ClockLine, ...]
    sd: float
    drift_sd: float
    how: str

    def __call__(self, time: Array) -> Array:
        """Times by the log's clock."""
        for line in self.lines:
            time = line(time)
        return time

    @property
    def drift(self) -> float:
        return sum(line.drift for line in self.lines)


@dataclass(frozen=True)
class _Axis:
    """Clocks of one file whose differences are known.

    Attributes
    ----------
    file : index of the recording
    unix : their common time is Unix time
    lines : clock -> from its stamps to the common time
    sources : clock -> how that is known, with its sd [s]
    cycle : of `Clock`, where it is not Unix time [s]
    """

    file: int
    unix: bool
    lines: Mapping[str, ClockLine]
    sources: Mapping[str, tuple[str, float]]
    cycle: float = 0.0

    @property
    def least_sd(self) -> float:
        """Of the clock that is known best, against Unix time [s]."""
        return min(sd for _, sd in self.sources.values())

    def channels(self, recording: Recording) -> list[Channel]:
        """Of all sensors, on the common time."""
        channels = [channel for channel in recording.channels if channel.clock in self.lines]
        return [_moved(channel, self.lines[channel.clock]) for channel in channels]


@dataclass(frozen=True)
class _Joined:
    """What is on the base's time already: its motion, and its first and last stamp [s]."""

    motion: MotionSignals
    span: tuple[float, float]


def _known(channels: Sequence[Channel], motion_of: MotionOf) -> _Joined:
    return _Joined(motion_of(channels), _span(channels))


def join_clocks(
    recordings: Sequence[Recording], selected: Sequence[Selected], shift: Mapping[str, float], motion_of: MotionOf
) -> tuple[list[JoinedClock], dict[str, float], bool, list[str]]:
    """Every clock that stamps a selected channel, on the log's.

    Parameters
    ----------
    shift : sensor or file -> what is added to its stamps [s]
    motion_of : what channels on one clock show

    Returns
    -------
    clocks : list of JoinedClock
    beside : sensor -> shift, of sensors that a shift names and the base's clock stamps [s]
    unix : the log's clock is Unix time
    said : warnings

    Raises
    ------
    InputError : clocks that cannot be joined, a shift of something that is not there
    """
    names, said = file_names(recordings), []
    needed = {(s.file, s.channel.clock) for s in selected}
    axes = []
    for k, recording in enumerate(recordings):
        made, unset = _axes(k, recording)
        axes += [axis for axis in made if any((k, name) in needed for name in axis.lines)]
        said += [f"{names[k]}: {text}" for text in unset]
    base = _base(axes, selected)
    stated, beside = _stated(axes, base, selected, recordings, shift)
    joined: list[tuple[_Axis, ClockLine, float, float, str]] = [(base, ClockLine(), 0.0, 0.0, "")]
    pool: list[_Joined] = []
    sought = any(axis is not base and id(axis) not in stated for axis in axes)  # by motion
    if sought:
        pool.append(_known(base.channels(recordings[base.file]), motion_of))
    waiting = [axis for axis in axes if axis is not base]
    while waiting:
        before = len(waiting)
        for axis in list(waiting):
            channels = axis.channels(recordings[axis.file])
            unix_sd = float(np.hypot(axis.least_sd, base.least_sd))
            result = _joined(axis, base, channels, pool, stated.get(id(axis)), motion_of, unix_sd)
            if result is None:
                continue
            line, sd, drift_sd, how, text = result  # sd: of the clock that is known best
            said += [f"{names[axis.file]}: {text}"] if text else []
            joined.append((axis, line, sd, drift_sd, how))
            if sought:
                pool.append(_known([_moved(channel, line) for channel in channels], motion_of))
            waiting.remove(axis)
        if len(waiting) == before:
            raise InputError(_not_joined(waiting[0], base, pool, recordings, names))
    out = []
    for axis, line, sd, drift_sd, how in joined:
        for name, to_axis in axis.lines.items():
            source, own_sd = axis.sources[name]
            told = ", ".join(text for text in (source if base.unix else "", how) if text) or "the log's clock"
            lines = (to_axis, line)
            shared = 0.0 if axis is base else axis.least_sd  # by all clocks of the file: that is in sd
            beyond = float(np.sqrt(max(own_sd**2 - shared**2, 0.0)))
            out.append(JoinedClock(axis.file, name, lines, float(np.hypot(beyond, sd)), drift_sd, told))
    return [clock for clock in out if (clock.file, clock.name) in needed], beside, base.unix, said


def _axes(file: int, recording: Recording) -> tuple[list[_Axis], list[str]]:
    """The axes of a file, and warnings of clocks that were never set."""
    known: dict[str, ClockLine] = {}
    sources: dict[str, tuple[str, float]] = {}
    said = []
    typical = {name: _typical_stamp(recording, name) for name in recording.clocks}
    for name, clock in recording.clocks.items():
        if clock.unix_offset is None:
            continue
        if typical[name] + clock.unix_offset < SINCE_2000:
            said.append(f"clock {name} reads {_date(typical[name] + clock.unix_offset)}: it was not set")
            continue
        known[name] = ClockLine(clock.unix_offset)
        sources[name] = clock.source or "Unix time", clock.offset_sd
    axes: list[_Axis] = []
    alone = [name for name in recording.clocks if name not in known]
    for name in list(alone):
        channel = next((c for c in recording.channels if c.clock == name and c.received is not None), None)
        if channel is not None and channel.receiver in known:
            line, sd = _by_arrival(channel)
            known[name] = ClockLine(line.offset + known[channel.receiver].offset, line.drift, line.at)
            sources[name] = f"arrivals by {channel.receiver}", sd
            alone.remove(name)
    if known:
        axes.append(_Axis(file, True, known, sources))
    axes += [_Axis(file, False, {name: ClockLine()}, {name: ("", 0.0)}, recording.clocks[name].cycle) for name in alone]
    return axes, said


def _by_arrival(channel: Channel) -> tuple[ClockLine, float]:
    """From stamps to times of arrival, by the least delays, and its sd [s]."""
    time, received = channel.columns["time"], np.asarray(channel.received)
    both = np.isfinite(time) & np.isfinite(received)
    time, delay = time[both], (received - time)[both]
    if not len(time):
        raise InputError(f"{channel.source}: no row has a time of arrival")
    windows = np.split(np.arange(len(time)), np.flatnonzero(np.diff((time - time[0]) // ARRIVAL_WINDOW_S)) + 1)
    least = np.array([window[np.argmin(delay[window])] for window in windows])
    at = float(time[least].mean())
    if len(least) < 3:
        return ClockLine(float(delay[least].min()), 0.0, at), ARRIVAL_SD_S
    drift, offset = np.polyfit(time[least] - at, delay[least], 1)
    scatter = float(np.std(delay[least] - offset - drift * (time[least] - at)))
    return ClockLine(float(offset), float(drift), at), float(np.hypot(scatter, ARRIVAL_SD_S))


def _base(axes: Sequence[_Axis], selected: Sequence[Selected]) -> _Axis:
    """The axis of the IMU, or of what comes next."""
    order = {sensor: k for k, sensor in enumerate(BASES)}
    first = min(selected, key=lambda s: order.get(s.channel.sensor, len(order)))
    return next(axis for axis in axes if axis.file == first.file and first.channel.clock in axis.lines)


def _stated(
    axes: Sequence[_Axis],
    base: _Axis,
    selected: Sequence[Selected],
    recordings: Sequence[Recording],
    shift: Mapping[str, float],
) -> tuple[dict[int, float], dict[str, float]]:
    """What is added to the stamps of each axis that a shift names (by ``id``), and of sensors on the base's [s]."""
    names = file_names(recordings)
    sensors = {s.channel.sensor for s in selected}
    out: dict[int, float] = {}
    beside: dict[str, float] = {}
    for key, seconds in shift.items():
        if not np.isfinite(seconds):
            raise InputError(f"shift {key}: {seconds:g} is no number of seconds")
        by_sensor = {(s.file, s.channel.clock) for s in selected if s.channel.sensor == key}
        files = {k for k, name in enumerate(names) if key in (name, Path(name).stem, recordings[k].path)}
        meant = [a for a in axes if a.file in files or any((a.file, name) in by_sensor for name in a.lines)]
        if not meant and not files:
            known = sorted(sensors | set(names))
            raise InputError(f"shift {key}: is neither a sensor nor a file; known are {', '.join(known)}")
        if any(axis is base for axis in meant):
            if key in sensors:
                beside[key] = float(seconds)
                continue
            raise InputError(f"shift {key}: its clock is that of the log; shift the other files")
        out |= {id(axis): float(seconds) for axis in meant}
    return out, beside


def _joined(
    axis: _Axis,
    base: _Axis,
    channels: Sequence[Channel],
    pool: Sequence[_Joined],
    stated: float | None,
    motion_of: MotionOf,
    unix_sd: float,
) -> tuple[ClockLine, float, float, str, str] | None:
    """Onto the base's time: the line, its sd and that of its drift, how it was found, and a warning; None = not yet."""
    if stated is not None:
        return ClockLine(stated), 0.0, 0.0, f"shifted by {stated:+g} s as stated", ""
    motion = motion_of(channels)
    found = [o for joined in pool if (o := find_offset(joined.motion, motion)) is not None]
    offset = min(found, key=lambda each: each.sd, default=None)
    line = None if offset is None else _line(offset)
    if (known := _usual(axis, base, _span(channels), pool)) is not None:
        by, usual, surely = known
        moved = offset is not None and abs(offset.seconds + by) < max(AGREE_S, SURE * offset.sd)
        if unix_sd < UNKNOWN_ZONE_S and (moved or (offset is None and surely)):
            how = f"{usual}{', as motion has it' if moved else ''}"
            return ClockLine(by), unix_sd, 0.0, how, f"{usual}: moved by {by:+.0f} s; --shift states another"
    agrees = offset is None or abs(offset.seconds) < max(AGREE_S, SURE * offset.sd)
    if axis.unix and base.unix and agrees and _overlap(_span(channels), pool):
        if offset is None and unix_sd < UNKNOWN_ZONE_S:
            return ClockLine(), unix_sd, 0.0, "Unix time", ""
        if offset is not None and unix_sd <= np.hypot(offset.sd, SYSTEMATIC_S):
            seen = f"; motion agrees to {offset.seconds:+.2f} s (sd {offset.sd:.2f} s)"
            return ClockLine(), unix_sd, 0.0, f"Unix time{seen}", ""
    if offset is None or line is None:
        return None
    how = f"{offset.how}, explained {offset.explained:.0%} over {offset.overlap:.0f} s"
    text = ""
    if axis.unix and base.unix and not agrees:
        text = (
            f"its Unix time is {offset.seconds:+.2f} s (sd {offset.sd:.2f} s) from that of the other files by {how}: "
            "corrected; --shift states another"
        )
    return line, float(np.hypot(offset.sd, SYSTEMATIC_S)), offset.drift_sd, how, text


def _usual(
    axis: _Axis, base: _Axis, span: tuple[float, float], pool: Sequence[_Joined]
) -> tuple[float, str, bool] | None:
    """What clocks are usually off by that makes an axis meet the base, as `rovgraph.log.stamps.known_offset` has it."""
    if not (axis.unix or axis.cycle) or not (base.unix or base.cycle):
        return None
    if axis.cycle:
        return known_offset(span, pool[0].span, axis.cycle)
    if base.cycle and (found := known_offset(pool[0].span, span, base.cycle)) is not None:
        return -found[0], found[1].replace("its stamps have", "the other files' stamps have"), found[2]
    return None if base.cycle or _overlap(span, pool) else known_offset(span, pool[0].span)


def _line(offset: Offset) -> ClockLine:
    """From clock B to clock A."""
    return ClockLine(-offset.seconds, 1.0 / (1.0 + offset.drift) - 1.0, offset.at + offset.seconds)


def _not_joined(
    axis: _Axis, base: _Axis, pool: Sequence[_Joined], recordings: Sequence[Recording], names: Sequence[str]
) -> str:
    """Why an axis cannot be joined, and what to do."""
    one, other = (_span(a.channels(recordings[a.file])) for a in (axis, base))
    if axis.unix and base.unix:
        spans = [f"{_date(begin)} to {_date(end)}" for begin, end in (one, other)]
        told = f"was recorded {spans[0]}, {names[base.file]} {spans[1]}"
    else:
        spans = [f"{begin:.1f} to {end:.1f} s" for begin, end in (one, other)]
        told = f"clock {next(iter(axis.lines))} reads {spans[0]}, {names[base.file]} {spans[1]}"
    sensors = sorted({channel.sensor for channel in axis.channels(recordings[axis.file])})
    told = f"{names[axis.file]}: {told}, and no common motion shows the offset of their clocks; are they of one dive? "
    if (known := _usual(axis, base, one, pool)) is not None:
        return f"{told}Perhaps {known[1]}: --shift {names[axis.file]}={known[0]:.0f} if that is so"
    return f"{told}If you know the offset, state what to add to its stamps: --shift {sensors[0]}=SECONDS"


def _typical_stamp(recording: Recording, clock: str) -> float:
    """Median of a clock's stamps, of a thousand of each channel; NaN where it stamps nothing."""
    series = [channel.columns["time"] for channel in recording.channels if channel.clock == clock]
    series += [c.received for c in recording.channels if c.receiver == clock and c.received is not None]
    stamps = np.concatenate([np.empty(0), *(every(times, max(len(times) // 1000, 1)) for times in series)])
    stamps = stamps[np.isfinite(stamps)]
    return float(np.median(stamps)) if len(stamps) else np.nan


def _span(channels: Sequence[Channel]) -> tuple[float, float]:
    times = [channel.columns["time"] for channel in channels]
    return min(float(t[0]) for t in times), max(float(t[-1]) for t in times)


def _overlap(span: tuple[float, float], pool: Sequence[_Joined]) -> bool:
    return any(span[0] < joined.span[1] and joined.span[0] < span[1] for joined in pool)


def _moved(channel: Channel, line: ClockLine) -> Channel:
    columns = {**channel.columns, "time": line(np.asarray(channel.columns["time"]))}
    return Channel(channel.sensor, columns, channel.source, channel.frame, channel.clock)


def _date(unix: float) -> str:
    try:
        return datetime.fromtimestamp(unix, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return f"{unix:.0f} s"
