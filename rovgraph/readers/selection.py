"""Joins the pieces of one source, and selects the channel that feeds each sensor of a log, where several could.

Two files are pieces of one source where format, sensors and columns agree, and their spans overlap by less than a tenth
of the shorter: split bags, hourly files, logs that are cut at midnight. They become one recording in the order of time,
whatever the order in which they were given; an overlap is taken once, and time missing between them is a gap.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.stamps import JUMP, counter_range
from rovgraph.log.streams import is_optional
from rovgraph.readers.recording import Channel, Clock, Left, Piece, Recording, in_files

# along whose axes, or about whose place, another sensor's values are: both have to be of one instrument
INSTRUMENT = {"mag": "imu", "ahrs": "imu", "dvl_heading": "dvl", "dvl_altitude": "dvl", "dvl_water": "dvl"}
INSTRUMENT |= {"dvl_sound": "dvl", "dvl_beams": "dvl"}

SHARED = 0.1  # of the shorter of two spans, that pieces may have in common
UNIX = "Unix time"
SAME_S = 0.5  # between offsets of one clock that were found in two files

Key = tuple[str, frozenset[str], str]  # sensor, columns that it needs, source


@dataclass(frozen=True)
class Selected:
    """A channel that feeds a sensor.

    Attributes
    ----------
    file : index of its recording
    channel : Channel
    """

    file: int
    channel: Channel


@dataclass(frozen=True)
class Unused:
    """A channel that feeds nothing, and why."""

    file: int
    channel: Channel
    reason: str


def select(recordings: Sequence[Recording], choose: Mapping[str, str]) -> tuple[list[Selected], list[Unused]]:
    """One channel for each sensor: the one that is chosen, else the first of the first file that has one.

    Parameters
    ----------
    choose : sensor -> name of a file, or part of the channel's source

    Raises
    ------
    InputError : a sensor or a choice that is not there
    """
    every: dict[str, list[Selected]] = {}
    for k, recording in enumerate(recordings):
        for channel in recording.channels:
            every.setdefault(channel.sensor, []).append(Selected(k, channel))
    if unknown := choose.keys() - every.keys():
        raise InputError(f"choose {min(unknown)}: no file has this sensor; there are {', '.join(sorted(every))}")
    picked = {s: _chosen(recordings, found, s, choose[s]) if s in choose else found[0] for s, found in every.items()}
    unused = []
    for sensor, instrument in INSTRUMENT.items():
        if sensor in choose or not {sensor, instrument} <= picked.keys():
            continue
        other = picked[instrument].file
        fitting = [
            found for found in every[sensor] if found.file == other or not _has(recordings[found.file], instrument)
        ]
        if fitting:
            picked[sensor] = fitting[0]
            continue
        reason = f"its axes are those of another {instrument} than the chosen one"
        unused += [Unused(found.file, found.channel, reason) for found in every[sensor]]
        del picked[sensor]
    for sensor, selected in picked.items():
        reason = f"{sensor} comes from {file_names(recordings)[selected.file]}, {selected.channel.source}"
        unused += [Unused(f.file, f.channel, reason) for f in every[sensor] if f.channel is not selected.channel]
    return list(picked.values()), unused


def require_used(
    recordings: Sequence[Recording], selected: Sequence[Selected], unused: Sequence[Unused], choose: Mapping[str, str]
) -> list[str]:
    """Warnings where two files have a sensor at the same time.

    Raises
    ------
    InputError : nothing of a file is used although nothing else has its sensors then
    """
    names, said = file_names(recordings), []
    feeds = {each.channel.sensor: each for each in selected}
    for each in unused:
        used = feeds.get(each.channel.sensor)
        if used is None or used.file == each.file or each.channel.sensor in choose:
            continue
        span, other = (_span(recordings[x.file], x.channel) for x in (each, used))
        if span is None or other is None or span[2] != other[2]:
            continue
        alone = max(other[0] - span[0], 0.0) + max(span[1] - other[1], 0.0)
        name, sensor = names[each.file], each.channel.sensor
        if alone > SHARED * (span[1] - span[0]) and not any(s.file == each.file for s in selected):
            files = _File(recordings[used.file], 0.0), _File(recordings[each.file], 0.0)
            before, after = sorted(files, key=_begin)
            why = why_apart(before, before, after)
            raise InputError(
                f"{name}: nothing of it is used, although nothing else has {sensor} for {alone:.1f} s of its time; "
                f"it is no piece of the same recording as {names[used.file]}{': ' if why else ''}{why}; "
                "cut off what they share, or leave out one of them"
            )
        if span[0] < other[1] and other[0] < span[1]:
            again = f"; if it continues {names[used.file]}, state --shift {name}=SECONDS" if span[2] != UNIX else ""
            said.append(
                f"{names[used.file]} and {name} have {sensor} at the same time: that of {names[used.file]} is used; "
                f"--choose {sensor}={name} takes the other{again}"
            )
    return list(dict.fromkeys(said))


def _span(recording: Recording, channel: Channel) -> tuple[float, float, str] | None:
    """First and last stamp, and by which time: `UNIX`, or that of an unknown clock [s]."""
    offset, time = recording.unix_offset(channel.clock), channel.columns["time"]
    if not len(time):
        return None
    clock = f"{recording.format} {channel.clock}" if offset is None else UNIX
    return float(time[0]) + (offset or 0.0), float(time[-1]) + (offset or 0.0), clock


def file_names(recordings: Sequence[Recording]) -> list[str]:
    """Names of files for messages, with their folders where they would be the same."""
    short = [Path(recording.path).name for recording in recordings]
    return [name if short.count(name) == 1 else r.path for name, r in zip(short, recordings, strict=True)]


def _has(recording: Recording, sensor: str) -> bool:
    return any(channel.sensor == sensor for channel in recording.channels)


def _chosen(recordings: Sequence[Recording], found: Sequence[Selected], sensor: str, choice: str) -> Selected:
    """The channel that a choice names, by file, by a word of its source, or by a part of it."""
    word = re.compile(rf"(?<!\w){re.escape(choice)}(?!\w)", re.IGNORECASE)
    names = file_names(recordings)
    files = [{names[f.file], *recordings[f.file].names} for f in found]
    by_file = [f for f, called in zip(found, files, strict=True) if choice in called]
    by_word = [f for f in found if word.search(f.channel.source)]
    by_part = [f for f in found if choice.lower() in f.channel.source.lower()]
    if matching := by_file or by_word or by_part:
        return matching[0]
    told = "; ".join(f"{names[f.file]}: {f.channel.source}" for f in found)
    raise InputError(f"choose {sensor}={choice}: no such source of {sensor}; there are: {told}")


@dataclass(frozen=True)
class _File:
    """A recording, and what is added to its stamps before it is compared with others [s]."""

    recording: Recording
    shift: float

    def added(self, clock: str, first: "_File") -> float | None:
        """Offset of a clock against the same clock in another file [s]; None = they are not to be compared.

        Offsets from Unix time that differ little were found twice of one clock, whose stamps are more exact.
        """
        if clock not in first.recording.clocks or clock not in self.recording.clocks:
            return None
        offset, other = self.recording.unix_offset(clock), first.recording.unix_offset(clock)
        if (offset is None) != (other is None):
            return None
        apart = 0.0 if offset is None or other is None else offset - other
        return (apart if abs(apart) > SAME_S else 0.0) + self.shift - first.shift


def join_pieces(
    recordings: Sequence[Recording], shift: Mapping[str, float]
) -> tuple[list[Recording], dict[str, float], list[str]]:
    """Recordings of which those that are pieces of one source are joined.

    Parameters
    ----------
    recordings : their channels in the order of time
    shift : sensor or file -> what is added to its stamps [s]

    Returns
    -------
    recordings : each group of pieces in the place of the one that was given first
    shift : without what has been added to the stamps of pieces
    said : warnings
    """
    recordings, said = _once(recordings)
    files = [_File(each, next((s for name, s in shift.items() if name in each.names), 0.0)) for each in recordings]
    groups: list[list[int]] = []
    for k in sorted(range(len(files)), key=lambda k: _begin(files[k])):
        group = next((g for g in groups if not why_apart(files[g[0]], files[g[-1]], files[k])), None)
        if group is None:
            groups.append([k])
        else:
            group.append(k)
    left = dict(shift)
    out = {}
    for group in groups:
        members = [files[k] for k in group]
        if len(members) == 1:
            out[group[0]] = members[0].recording
            continue
        members = _round_the_clock(members)
        joined = _joined(members)
        out[min(group)] = joined
        later = set().union(*(m.recording.names for m in members[1:])) - members[0].recording.names
        left = {name: seconds for name, seconds in left.items() if name not in later}
        spans = "; ".join(f"{p.path}: {p.first:.1f} to {p.last:.1f} s" for p in joined.pieces)
        again = sum(piece.again for piece in joined.pieces)
        shared = f"; {again} rows that two of them have are taken once" if again else ""
        said.append(f"{len(members)} files are read as pieces of one recording: {spans}{shared}")
    return [out[k] for k in sorted(out)], left, said


def why_apart(first: _File, last: _File, later: _File) -> str:
    """Why a file is not the next piece of a source; "" where it is.

    Parameters
    ----------
    first, last : pieces so far
    later : one that begins later
    """
    if first.recording.format != later.recording.format:
        return "their formats differ"
    ours, theirs = _keyed(last.recording), _keyed(later.recording)
    common = ours.keys() & theirs.keys()
    if not common:
        return "their sensors or columns differ"
    for key in sorted(common, key=str):
        one, other = ours[key], theirs[key]
        added = last.added(one.clock, first), later.added(other.clock, first)
        if one.clock != other.clock or added[0] is None or added[1] is None:
            return "their clocks differ"
        (begin, end), (begins, ends) = (
            (c.columns["time"][0] + a, c.columns["time"][-1] + a) for c, a in ((one, added[0]), (other, added[1]))
        )
        shared = end - begins
        if shared > SHARED * min(end - begin, ends - begins) and shared > 0.0:
            return f"they share {shared:.1f} s, more than a tenth of the shorter"
        if -shared > JUMP:
            return f"{-shared / 3600.0:.0f} h lie between them"
    return ""


def _once(recordings: Sequence[Recording]) -> tuple[list[Recording], list[str]]:
    """Recordings without those that repeat another one, and warnings of these."""
    kept: list[Recording] = []
    said = []
    for each in recordings:
        again = next((other for other in kept if _same(other, each)), None)
        if again is None:
            kept.append(each)
        else:
            said.append(f"{each.path}: holds the same as {again.path}, and is taken once")
    return kept, said


def _same(one: Recording, other: Recording) -> bool:
    if one.format != other.format or len(one.channels) != len(other.channels) or not one.channels:
        return False
    return all(
        a.sensor == b.sensor
        and a.columns.keys() == b.columns.keys()
        and all(np.array_equal(a.columns[name], b.columns[name], equal_nan=True) for name in a.columns)
        for a, b in zip(one.channels, other.channels, strict=True)
    )


def _begin(file: _File) -> float:
    """By which files of one clock are in the order of time [s]."""
    first = [c.columns["time"][0] + (file.recording.unix_offset(c.clock) or 0.0) for c in file.recording.channels]
    return float(min(first, default=0.0)) + file.shift


def _end(file: _File) -> float:
    last = [c.columns["time"][-1] + (file.recording.unix_offset(c.clock) or 0.0) for c in file.recording.channels]
    return float(max(last)) + file.shift


def _round_the_clock(members: list[_File]) -> list[_File]:
    """Pieces whose clock starts again from zero, at midnight or when its counter is full, from before that on."""
    cycles = {clock.cycle for member in members for clock in member.recording.clocks.values()}
    cycle = cycles.pop() if len(cycles) == 1 else 0.0
    cycle = cycle or counter_range(_end(members[-1]), _begin(members[0]))
    if not cycle:
        return members
    gaps = [_begin(after) - _end(before) for before, after in pairwise(members)]
    widest = int(np.argmax(gaps))
    if gaps[widest] <= _begin(members[0]) + cycle - _end(members[-1]):
        return members
    return [*members[widest + 1 :], *(replace(m, shift=m.shift + cycle) for m in members[: widest + 1])]


def _keyed(recording: Recording) -> dict[Key, Channel]:
    """Channels by what has to agree; the source matters only where a file has several of one kind."""
    kinds = Counter((c.sensor, _needed(c)) for c in recording.channels)
    return {(c.sensor, _needed(c), c.source if kinds[c.sensor, _needed(c)] > 1 else ""): c for c in recording.channels}


def _needed(channel: Channel) -> frozenset[str]:
    return frozenset(name for name in channel.columns if not is_optional(name))


def _joined(members: Sequence[_File]) -> Recording:
    """One recording of pieces in the order of time."""
    first = members[0]
    found: dict[Key, list[Channel]] = {}
    tables: dict[str, list[Mapping[str, Array]]] = {}
    counts = []
    clocks: dict[str, Clock] = {}
    for member in members:
        again = rows = 0
        span = [np.inf, -np.inf]
        clocks = {**member.recording.clocks, **clocks}
        for key, channel in _keyed(member.recording).items():
            time = channel.columns["time"] + (member.added(channel.clock, first) or 0.0)
            before = found.setdefault(key, [])
            fresh = slice(np.searchsorted(time, before[-1].columns["time"][-1], "right") if before else 0, None)
            columns = {name: values[fresh] for name, values in channel.columns.items()} | {"time": time[fresh]}
            received = None if channel.received is None else channel.received[fresh]
            if len(columns["time"]):
                before.append(replace(channel, columns=columns, received=received))
            rows, again = rows + len(time), again + len(time) - len(columns["time"])
            span = [min(span[0], float(time[0])), max(span[1], float(time[-1]))]
        counts.append(Piece(member.recording.path, span[0], span[1], rows, again))
        added = _of_tables(member, first)
        for name, table in member.recording.tables.items():
            parts, time = tables.setdefault(name, []), np.asarray(table["time"], dtype=float) + added
            late = time > (parts[-1]["time"][-1] if parts else -np.inf)
            if late.any():
                parts.append({n: np.asarray(v)[late] for n, v in table.items()} | {"time": time[late]})
    parts_of = [member.recording for member in members]
    left = Counter[tuple[str, str]]()
    for each in parts_of:
        left.update({(one.name, one.reason): one.count for one in each.left})
    known: dict[str, Any] = {}
    for each in parts_of:
        known = _completed(known, {key: value for key, value in each.settings.items() if key not in each.assumed})
    settings = known
    for each in parts_of:
        settings = {**each.settings, **settings}
    assumed = {key: text for each in reversed(parts_of) for key, text in each.assumed.items() if key not in known}
    untold = {text for each in parts_of for text in each.assumed.values()} - set(assumed.values())
    channels = [_one(parts) for parts in found.values()]
    warnings = dict.fromkeys(text for each in parts_of for text in each.warnings if text not in untold)
    return replace(
        first.recording,
        channels=tuple(in_files(channel) for channel in channels),
        clocks=clocks,
        left=tuple(Left(name, count, reason) for (name, reason), count in left.items()),
        settings=settings,
        notes=tuple(dict.fromkeys(note for each in parts_of for note in each.notes)),
        warnings=tuple(warnings),
        assumed=assumed,
        tables={name: _stacked(parts) for name, parts in tables.items()},
        pieces=tuple(counts),
    )


def _of_tables(member: _File, first: _File) -> float:
    """What is added to the times of a file's other tables, which are by the clock of its DVL [s]."""
    stamping = sorted(member.recording.channels, key=lambda channel: not channel.sensor.startswith("dvl"))
    return (member.added(stamping[0].clock, first) or 0.0) if stamping else 0.0


def _one(parts: Sequence[Channel]) -> Channel:
    received = None if any(p.received is None for p in parts) else np.concatenate([p.received for p in parts])
    return replace(parts[0], columns=_stacked([part.columns for part in parts]), received=received)


def _stacked(parts: Sequence[Mapping[str, Array]]) -> dict[str, Array]:
    """Columns of all, with NaN where one lacks them."""
    names = dict.fromkeys(name for part in parts for name in part)
    return {
        name: np.concatenate([part[name] if name in part else np.full(len(part["time"]), np.nan) for part in parts])
        for name in names
    }


def _completed(known: Mapping[str, Any], more: Mapping[str, Any]) -> dict[str, Any]:
    """Nested settings, and what others add to them."""
    out = dict(known)
    for key, value in more.items():
        if isinstance(value, Mapping) and isinstance(out.get(key), Mapping):
            out[key] = _completed(out[key], value)
        else:
            out.setdefault(key, value)
    return out
