"""Merges recordings of one dive into one log: sensors selected, clocks joined, rows in the order of time.

`account` lists the contents of each file, the origin of every column, and how clocks were joined.
"""

import warnings as python_warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log import Log
from rovgraph.log.disk_columns import in_pieces, median_step
from rovgraph.log.rows import STAMP_DIGITS, Part, Rows, frame_of, in_order, whole
from rovgraph.log.streams import LAT_LON, SHIP_LAT_LON
from rovgraph.model.config import Config, leaves
from rovgraph.readers.clocks import BASES, JoinedClock, join_clocks
from rovgraph.readers.lag_search import MotionSignals
from rovgraph.readers.lag_search import motion_of as motion_of_log
from rovgraph.readers.recording import Channel, Recording
from rovgraph.readers.selection import Selected, Unused, file_names, join_pieces, require_used, select
from rovgraph.readers.stamps import by_arrival, put_in_order

OF_INSTRUMENT = (
    "imu",
    "ahrs",
    "dvl",
    "depth",
    "fix",
    "usbl",
    "range",
)  # sections of settings that belong to the channel of this sensor
UNSURE_S = 0.002  # sd of a joined clock from which the sensors' time offset is estimated [s]
ARRIVAL, EVERY = "arrival", ""  # whose times are taken, and of what: a sensor, a file, or every one
ANY_SURFACE = Config().changed(depth={"surface_hpa": 0.0})  # motion of pressures needs none
OFFSETS = ("dvl", "ahrs", "mag", "depth", "fix", "usbl", "range")  # sensors with a calibration variable for it


@dataclass(frozen=True)
class Merged:
    """One log of several recordings.

    Attributes
    ----------
    parts : of the log, in SI, one for each channel that feeds it
    recordings : as read
    selected, unused : what feeds the log, and what does not
    clocks : how the stamps were put on the log's clock
    unix : that is Unix time
    settings : from the files, dotted key -> (value, file)
    warnings : what looks wrong, a sentence each
    tables : other tables of the files (name -> column -> ndarray, shape (n,)), their ``time`` by the log's clock [s].
        Those of file k have ``_k`` behind their names, but for the file that feeds the log's DVL, or else the first
    """

    parts: Sequence[Part]
    recordings: Sequence[Recording]
    selected: Sequence[Selected]
    unused: Sequence[Unused]
    clocks: Sequence[JoinedClock]
    unix: bool
    settings: Mapping[str, tuple[Any, str]]
    warnings: Sequence[str]
    tables: Mapping[str, Mapping[str, Array]]

    @property
    def frame(self) -> pd.DataFrame:
        """Columns of a log, in SI, one row per measurement, in the order of time."""
        return frame_of(self.rows)

    @property
    def first_fix(self) -> tuple[float, float] | None:
        """Latitude and longitude [deg] of the first fix that is somewhere on Earth, else of the ship at first."""
        for names, part in ((names, part) for names in (LAT_LON, SHIP_LAT_LON) for part in self.parts):
            if all(name in part.columns for name in names):
                lat, lon = (part.columns[name] for name in names)
                known = np.flatnonzero(np.isfinite(lat) & np.isfinite(lon) & ((lat != 0.0) | (lon != 0.0)))
                if known.size:
                    return float(lat[known[0]]), float(lon[known[0]])
        return None

    @property
    def rows(self) -> list[Rows]:
        """Those of the log."""
        return whole(self.parts)

    @property
    def names(self) -> list[str]:
        """Of the files."""
        return file_names(self.recordings)

    @property
    def source(self) -> str:
        """What the log is called in messages."""
        return " + ".join(
            f"{name} to {Path(recording.pieces[-1].path).name}" if recording.pieces else name
            for recording, name in zip(self.recordings, self.names, strict=True)
        )

    def nested_settings(self) -> dict[str, Any]:
        """Settings from the files, nested as in YAML."""
        out: dict[str, Any] = {}
        for key, (value, _) in self.settings.items():
            *above, last = key.split(".")
            section = out
            for name in above:
                section = section.setdefault(name, {})
            section[last] = value
        return out


def merge(
    recordings: Sequence[Recording],
    choose: Mapping[str, str],
    shift: Mapping[str, float],
    times: Mapping[str, str] = MappingProxyType({}),
) -> Merged:
    """One log of some recordings of a dive.

    Parameters
    ----------
    choose : sensor -> file, instance, message or topic that feeds it
    shift : sensor or file -> what is added to its stamps [s]
    times : sensor or file, or `EVERY` -> `ARRIVAL`, where the recorder's stamps are used

    Raises
    ------
    InputError : clocks that cannot be joined; a sensor, file or source that is not there; no measurement; a file of
        which nothing is used although nothing else covers its time
    """
    recordings = _stamped(recordings, times)
    recordings, said = _in_order(recordings)
    if not any(recording.channels for recording in recordings):
        raise InputError(f"{', '.join(file_names(recordings))}: no measurement of any sensor in it")
    recordings, shift, told = join_pieces(recordings, shift)
    said = [*(text for recording in recordings for text in recording.warnings), *said, *told]
    selected, unused = select(recordings, choose)
    said += require_used(recordings, selected, unused, choose)
    clocks, beside, unix, notes = join_clocks(recordings, selected, shift, _motion)
    by_name = {(clock.file, clock.name): clock for clock in clocks}
    parts = []
    for each in selected:
        clock, added = by_name[each.file, each.channel.clock], beside.get(each.channel.sensor, 0.0)
        parts.append(Part(each.channel.columns, _stamps(clock, added)))
    settings = _settings(recordings, selected, clocks)
    tables = _tables(recordings, selected, by_name, beside.get("dvl", 0.0))
    return Merged(parts, recordings, selected, unused, clocks, unix, settings, (*said, *notes), tables)


def _stamps(clock: JoinedClock, added: float) -> Callable[[Array], Array]:
    return lambda time: clock(time) + added


def _tables(
    recordings: Sequence[Recording],
    selected: Sequence[Selected],
    clocks: Mapping[tuple[int, str], JoinedClock],
    shift: float,
) -> dict[str, dict[str, Array]]:
    """Other tables of the files by the log's clock; those whose clock stamps nothing of the log are left out.

    Parameters
    ----------
    clocks : file and clock -> JoinedClock
    shift : that is stated of the DVL alone [s]
    """
    of_dvl = (each.file for each in selected if each.channel.sensor == "dvl")
    feeds = next(of_dvl, next((k for k, recording in enumerate(recordings) if recording.tables), None))
    out: dict[str, dict[str, Array]] = {}
    for k, recording in enumerate(recordings):
        stamping = sorted(recording.channels, key=lambda channel: not channel.sensor.startswith("dvl"))
        clock = clocks.get((k, stamping[0].clock)) if stamping else None
        if clock is None:
            continue
        for name, table in recording.tables.items():
            time = clock(np.asarray(table["time"], dtype=float)) + (shift if k == feeds else 0.0)
            stamped = np.isfinite(time)
            rows = {column: np.asarray(values)[stamped] for column, values in table.items()}
            rows["time"] = np.round(time[stamped], STAMP_DIGITS)
            if stamped.any():
                out[name if k == feeds else f"{name}_{k + 1}"] = rows
    return out


def _stamped(recordings: Sequence[Recording], times: Mapping[str, str]) -> list[Recording]:
    """Recordings of which some channels are stamped by their receiver."""
    out, known, taken = [], {EVERY}, False
    for recording, name in zip(recordings, file_names(recordings), strict=True):
        of_file = times.keys() & {EVERY, name, *recording.names}
        known |= {name, *recording.names, *(channel.sensor for channel in recording.channels)}
        channels = []
        for channel in recording.channels:
            wanted = of_file or channel.sensor in times
            recorded = channel.received is not None
            if wanted and not recorded and times.keys() != {EVERY}:
                raise InputError(f"times: {name}: {channel.source}: no arrivals are recorded; leave it out of --times")
            channels.append(by_arrival(channel) if wanted and recorded else channel)
            taken = taken or channels[-1] is not channel
        tables = recording.tables
        if moved := [(a, b) for a, b in zip(recording.channels, channels, strict=True) if a is not b]:
            before, after = next((pair for pair in moved if pair[0].sensor.startswith("dvl")), moved[0])
            tables = {n: {**t, "time": _moved_as(np.asarray(t["time"]), before, after)} for n, t in tables.items()}
        out.append(replace(recording, channels=tuple(channels), tables=tables))
    if times and (unknown := times.keys() - known):
        raise InputError(f"times {min(unknown)}: is neither a sensor nor a file; known are {', '.join(sorted(known))}")
    if times and not taken:
        raise InputError(f"times: no arrivals are recorded in {', '.join(file_names(recordings))}; leave out --times")
    return out


def _moved_as(time: Array, before: Channel, after: Channel) -> Array:
    """Times of a table, shape (n,) [s], moved as the stamps of a channel were."""
    old, new = np.asarray(before.columns["time"], dtype=float), np.asarray(after.columns["time"], dtype=float)
    place = {stamp: k for k, stamp in enumerate(old.tolist())}
    rows = [place.get(stamp, -1) for stamp in time.tolist()]
    return np.array([new[k] if k >= 0 else np.nan for k in rows])


def _in_order(recordings: Sequence[Recording]) -> tuple[list[Recording], list[str]]:
    """Recordings whose stamps are in order, and all warnings."""
    out: list[Recording] = []
    said: list[str] = []
    for recording, name in zip(recordings, file_names(recordings), strict=True):
        channels = []
        for channel in recording.channels:
            ordered, text = put_in_order(channel, name)
            channels.append(ordered)
            said += text
        out.append(replace(recording, channels=tuple(channels)))
    return out, said


def _motion(channels: Sequence[Channel]) -> MotionSignals:
    """What channels on one clock show; of several of one sensor, the first."""
    first = {channel.sensor: channel for channel in reversed(channels)}
    with python_warnings.catch_warnings():
        python_warnings.simplefilter("ignore")  # the log that is made of them is read again
        try:
            log = Log.from_rows(in_order([channel.columns for channel in first.values()]), ANY_SURFACE)
        except InputError:
            return MotionSignals((), None)
    return motion_of_log(log)


def _settings(
    recordings: Sequence[Recording], selected: Sequence[Selected], clocks: Sequence[JoinedClock]
) -> dict[str, tuple[Any, str]]:
    """Settings from the files for the selected instruments, and how certain the clocks are."""
    feeds = {each.channel.sensor: each.file for each in selected}
    out: dict[str, tuple[Any, str]] = {}
    for k, (recording, name) in enumerate(zip(recordings, file_names(recordings), strict=True)):
        for path, value in leaves(recording.settings):
            instrument = path[1].partition("_")[0] if path[0] == "heading" else path[0]  # heading.ahrs_reference
            if instrument not in OF_INSTRUMENT or feeds.get(instrument) == k:
                out.setdefault(".".join(path), (value, name))
    stamps = {
        each.channel.sensor: next(c for c in clocks if (c.file, c.name) == (each.file, each.channel.clock))
        for each in selected
    }
    reference = next((stamps[sensor] for sensor in BASES if sensor in stamps), stamps[selected[0].channel.sensor])
    for each in selected:
        clock = stamps[each.channel.sensor]  # an estimate sees only its lateness against the reference
        if each.channel.sensor in OFFSETS and clock is not reference and clock.sd > UNSURE_S:
            key = f"calibration.{each.channel.sensor}_time_offset"
            origin = f"clock {clock.name}: {clock.how}"
            out.setdefault(f"{key}.estimate", (True, origin))
            out.setdefault(f"{key}.sd", (round(clock.sd, 3), origin))
    return out


def account(merged: Merged) -> dict[str, Any]:
    """For JSON, in seconds, hertz and SI; unknown values are None."""
    names = merged.names
    selected = {id(each.channel) for each in merged.selected}
    reasons = {id(each.channel): each.reason for each in merged.unused}
    files = []
    for recording, name in zip(merged.recordings, names, strict=True):
        channels = [
            {
                "sensor": channel.sensor,
                "columns": [column for column in channel.columns if column != "time"],
                "source": channel.source,
                "frame": channel.frame,
                "clock": channel.clock,
                **timing(channel),
                "used": id(channel) in selected,
                "reason": reasons.get(id(channel), ""),
            }
            for channel in recording.channels
        ]
        left = [{"name": each.name, "count": each.count, "reason": each.reason} for each in recording.left]
        file = {"file": name, "path": recording.path, "format": recording.format, "channels": channels, "left": left}
        if recording.pieces:
            file["pieces"] = [
                {"file": p.path, "first_s": p.first, "last_s": p.last, "rows": p.rows, "rows_again": p.again}
                for p in recording.pieces
            ]
        files.append({**file, "notes": list(recording.notes), "warnings": list(recording.warnings)})
    clocks = [
        {
            "file": names[clock.file],
            "clock": clock.name,
            "offset_s": _added(merged, clock),
            "drift": clock.drift,
            "sd_s": clock.sd,
            "drift_sd": clock.drift_sd,
            "how": clock.how,
        }
        for clock in merged.clocks
    ]
    return {
        "files": files,
        "columns": columns(merged),
        "clocks": clocks,
        "time": "Unix time" if merged.unix else "the clock of the first sensor's file",
        "settings": {key: {"value": value, "source": source} for key, (value, source) in merged.settings.items()},
        "warnings": list(merged.warnings),
    }


def _added(merged: Merged, clock: JoinedClock) -> float:
    """What is added to the first stamp of a clock [s]."""
    channels = merged.recordings[clock.file].channels
    first = np.array([min(float(c.columns["time"][0]) for c in channels if c.clock == clock.name)])
    return float((clock(first) - first)[0])


def columns(merged: Merged) -> dict[str, str]:
    """Column of the log -> the file and the channel that it came from."""
    names = merged.names
    return {
        column: f"{names[each.file]}: {each.channel.source}"
        for each in merged.selected
        for column in each.channel.columns
        if column != "time"
    }


def timing(channel: Channel) -> dict[str, Any]:
    """Count, rate and largest gap of a channel, by its own clock."""
    time = channel.columns["time"]
    gaps = [float(np.diff(piece).max(initial=0.0)) for (piece,) in in_pieces(time, beyond=1)]
    usual = median_step(time) if len(time) > 1 else 0.0
    return {
        "count": len(time),
        "rate_hz": 1.0 / usual if usual > 0.0 else None,
        "first_s": float(time[0]),
        "last_s": float(time[-1]),
        "gap_s": max(gaps) if len(time) > 1 else None,
    }


def notes(merged: Merged) -> list[str]:
    """Remarks for a reader of the log, a sentence each."""
    names, said = merged.names, []
    for each in merged.selected:
        frame = f", {each.channel.frame}" if each.channel.frame else ""
        said.append(f"{each.channel.sensor} from {names[each.file]}: {each.channel.source}{frame}")
    said += [f"{names[u.file]}: {u.channel.source} is not used: {u.reason}" for u in merged.unused]
    said += [text for recording in merged.recordings for text in recording.notes]
    if len(merged.clocks) > 1:
        said += [
            f"{names[clock.file]}: clock {clock.name} joined by {clock.how}"
            + (f", sd {clock.sd:.3f} s" if clock.sd else "")
            for clock in merged.clocks
        ]
    return said
