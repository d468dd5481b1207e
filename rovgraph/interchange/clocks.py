"""Several recordings on one clock, that of the IMU; or Unix time, where the IMU's clock is known in it.

Clocks of one file whose Unix time is known, or that share arrivals, form an axis. Axes are joined by what the user
knows (a shift), by Unix time, or by the motion that both show (`synchronise`); what motion contradicts by more than
`AGREE_S` is corrected, with a warning.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.interchange.motion import Motion
from rovgraph.interchange.recording import Channel, Recording
from rovgraph.interchange.selection import Selected, file_names
from rovgraph.interchange.synchronise import Offset, find_offset
from rovgraph.spilling import every
from rovgraph.stamps import known_offset

UNKNOWN_ZONE_S = 1800.0  # sd of a clock that may show local time
AGREE_S = 0.5  # stamps that motion contradicts by less stay: a sensor may be late by as much
SYSTEMATIC_S = 0.06  # by motion 12 simulated dives of two minutes were 0.03 s off, rms, where it claims 0.01 s
SURE = 3.0  # standard deviations of a contradiction
SINCE_2000 = 9.5e8  # Unix time before is that of a clock that was never set [s]
ARRIVAL_WINDOW_S = 60.0  # over which the least delay of a transport is taken
ARRIVAL_SD_S = 0.02  # of a transport's least delay
BASES = ("imu", "dvl")  # whose clock the others are put on

MotionOf = Callable[[Sequence[Channel]], Motion]


@dataclass(frozen=True)
class Line:
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
    lines: tuple[Line, ...]
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
    lines: Mapping[str, Line]
    sources: Mapping[str, tuple[str, float]]
    cycle: float = 0.0

    @property
    def least_sd(self) -> float:
        """Of the clock that is known best, against Unix time [s]."""
        return min(sd for _, sd in self.sources.values())

    def channels(self, recording: Recording) -> list[Channel]:
        """Of all sensors, on the common time."""
        own = [channel for channel in recording.channels if channel.clock in self.lines]
        return [_moved(channel, self.lines[channel.clock]) for channel in own]


@dataclass(frozen=True)
class _Joined:
    """What is on the base's time already: its motion, and its first and last stamp [s]."""

    motion: Motion
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
    joined: list[tuple[_Axis, Line, float, float, str]] = [(base, Line(), 0.0, 0.0, "")]
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
        for name, own in axis.lines.items():
            source, own_sd = axis.sources[name]
            told = ", ".join(text for text in (source if base.unix else "", how) if text) or "the log's clock"
            lines = (own, line)
            shared = 0.0 if axis is base else axis.least_sd  # by all clocks of the file: that is in sd
            beyond = float(np.sqrt(max(own_sd**2 - shared**2, 0.0)))
            out.append(JoinedClock(axis.file, name, lines, float(np.hypot(beyond, sd)), drift_sd, told))
    return [clock for clock in out if (clock.file, clock.name) in needed], beside, base.unix, said


def _axes(file: int, recording: Recording) -> tuple[list[_Axis], list[str]]:
    """The axes of a file, and what to say of clocks that were never set."""
    known: dict[str, Line] = {}
    sources: dict[str, tuple[str, float]] = {}
    said = []
    typical = {name: _typical_stamp(recording, name) for name in recording.clocks}
    for name, clock in recording.clocks.items():
        if clock.unix_offset is None:
            continue
        if typical[name] + clock.unix_offset < SINCE_2000:
            said.append(f"clock {name} reads {_date(typical[name] + clock.unix_offset)}: it was not set")
            continue
        known[name] = Line(clock.unix_offset)
        sources[name] = clock.source or "Unix time", clock.offset_sd
    axes: list[_Axis] = []
    alone = [name for name in recording.clocks if name not in known]
    for name in list(alone):
        channel = next((c for c in recording.channels if c.clock == name and c.received is not None), None)
        if channel is not None and channel.receiver in known:
            line, sd = _by_arrival(channel)
            known[name] = Line(line.offset + known[channel.receiver].offset, line.drift, line.at)
            sources[name] = f"arrivals by {channel.receiver}", sd
            alone.remove(name)
    if known:
        axes.append(_Axis(file, True, known, sources))
    axes += [_Axis(file, False, {name: Line()}, {name: ("", 0.0)}, recording.clocks[name].cycle) for name in alone]
    return axes, said


def _by_arrival(channel: Channel) -> tuple[Line, float]:
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
        return Line(float(delay[least].min()), 0.0, at), ARRIVAL_SD_S
    drift, offset = np.polyfit(time[least] - at, delay[least], 1)
    scatter = float(np.std(delay[least] - offset - drift * (time[least] - at)))
    return Line(float(offset), float(drift), at), float(np.hypot(scatter, ARRIVAL_SD_S))


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
) -> tuple[Line, float, float, str, str] | None:
    """Onto the base's time: the line, its sd and that of its drift, how it was found, and a warning; None = not yet."""
    if stated is not None:
        return Line(stated), 0.0, 0.0, f"shifted by {stated:+g} s as stated", ""
    own = motion_of(channels)
    found = [o for joined in pool if (o := find_offset(joined.motion, own)) is not None]
    offset = min(found, key=lambda each: each.sd, default=None)
    line = None if offset is None else _line(offset)
    if (known := _usual(axis, base, _span(channels), pool)) is not None:
        by, usual, surely = known
        moved = offset is not None and abs(offset.seconds + by) < max(AGREE_S, SURE * offset.sd)
        if unix_sd < UNKNOWN_ZONE_S and (moved or (offset is None and surely)):
            how = f"{usual}{', as motion has it' if moved else ''}"
            return Line(by), unix_sd, 0.0, how, f"{usual}: moved by {by:+.0f} s; --shift states another"
    agrees = offset is None or abs(offset.seconds) < max(AGREE_S, SURE * offset.sd)
    if axis.unix and base.unix and agrees and _overlap(_span(channels), pool):
        if offset is None and unix_sd < UNKNOWN_ZONE_S:
            return Line(), unix_sd, 0.0, "Unix time", ""
        if offset is not None and unix_sd <= np.hypot(offset.sd, SYSTEMATIC_S):
            seen = f"; motion agrees to {offset.seconds:+.2f} s (sd {offset.sd:.2f} s)"
            return Line(), unix_sd, 0.0, f"Unix time{seen}", ""
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
    """What clocks are usually off by that makes an axis meet the base, as `rovgraph.stamps.known_offset` has it."""
    if not (axis.unix or axis.cycle) or not (base.unix or base.cycle):
        return None
    if axis.cycle:
        return known_offset(span, pool[0].span, axis.cycle)
    if base.cycle and (found := known_offset(pool[0].span, span, base.cycle)) is not None:
        return -found[0], found[1].replace("its stamps have", "the other files' stamps have"), found[2]
    return None if base.cycle or _overlap(span, pool) else known_offset(span, pool[0].span)


def _line(offset: Offset) -> Line:
    """From clock B to clock A."""
    return Line(-offset.seconds, 1.0 / (1.0 + offset.drift) - 1.0, offset.at + offset.seconds)


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
    own = [channel.columns["time"] for channel in recording.channels if channel.clock == clock]
    own += [c.received for c in recording.channels if c.receiver == clock and c.received is not None]
    stamps = np.concatenate([np.empty(0), *(every(times, max(len(times) // 1000, 1)) for times in own)])
    stamps = stamps[np.isfinite(stamps)]
    return float(np.median(stamps)) if len(stamps) else np.nan


def _span(channels: Sequence[Channel]) -> tuple[float, float]:
    times = [channel.columns["time"] for channel in channels]
    return min(float(t[0]) for t in times), max(float(t[-1]) for t in times)


def _overlap(span: tuple[float, float], pool: Sequence[_Joined]) -> bool:
    return any(span[0] < joined.span[1] and joined.span[0] < span[1] for joined in pool)


def _moved(channel: Channel, line: Line) -> Channel:
    columns = {**channel.columns, "time": line(np.asarray(channel.columns["time"]))}
    return Channel(channel.sensor, columns, channel.source, channel.frame, channel.clock)


def _date(unix: float) -> str:
    try:
        return datetime.fromtimestamp(unix, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return f"{unix:.0f} s"
