"""Records of a Water Linked Underwater GPS (UGPS G2), as loggers poll them from its HTTP interface: CSV or JSON.

An answer of ``position/acoustic/raw`` (or ``filtered``) has ``position_valid``, ``x``, ``y``, ``z`` [m], ``std``, and
of each receiver ``receiver_distance`` [m], ``receiver_valid``, ``receiver_nsd``, ``receiver_rssi``; one of
``position/master`` has ``lat``, ``lon``, ``orientation`` [deg] (-1 = unknown) and ``fix_quality`` (0 = no fix) of the
topside. x is forward, y starboard of the antenna, z the depth that the locator's own sensor measures. No answer has a
time: stamps are the logger's. Polled faster than the locator sends, an answer is given again. While a position is not
valid, its coordinates go on with numbers.

Source: https://docs.waterlinked.com/underwater-gps, and loggers' CSV of real dives: one column for each receiver,
``distance_r0`` or ``receiver_distance_0``, ``valid_r0``; names with ``acoustic_`` and ``master_`` before them.
"""

import csv
import json
import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.readers.acoustic_sentences import FARTHEST_M
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording, preferred_first
from rovgraph.readers.records import Refused
from rovgraph.readers.stamps import unix_of_text

RECEIVERS = 4
RECORDER = "recorder"
VALID = ("position_valid", "acoustic_valid", "acoustic_position_valid")
TIMES = ("timestamp", "time")
POSITIONS, DISTANCES = "x, y, z", "receiver_distance"  # sources of usbl and range
DEPTH_TWICE = "z is the locator's own depth: beside depth of the same sensor it is one measurement taken twice"


@dataclass(frozen=True)
class UgpsAnswer:
    """What a UGPS says at a time.

    Attributes
    ----------
    time : of the logger [s]; NaN = not stated
    valid : whether its position is; None = it says nothing of one
    xyz : forward, starboard, down of the antenna [m]
    distances : to each receiver, NaN where it did not hear the locator [m]
    topside : latitude, longitude [deg] and true heading [rad], NaN where they are not known
    said : everything that distinguishes this answer from the one before
    """

    time: float
    valid: bool | None
    xyz: tuple[float, float, float]
    distances: tuple[float, ...]
    topside: tuple[float, float, float]
    said: tuple[Any, ...]


def ugps_answer(row: Mapping[str, Any]) -> UgpsAnswer:
    """What a record says.

    Parameters
    ----------
    row : by the names of the interface, nested by its answers or flat; values as JSON or as text

    Raises
    ------
    Refused : a position without its coordinates, or farther than sound is heard
    """
    cells = _flat(row)
    valid = _truth(next((cells[name] for name in VALID if name in cells), None))
    x, y, z = (_number(_either(cells, f"acoustic_{axis}", axis)) for axis in "xyz")
    if valid and not math.isfinite(x + y + z):
        raise Refused("no position", "valid, but without a coordinate")
    if valid and math.hypot(x, y, z) > FARTHEST_M:
        raise Refused("no position", f"valid, but more than {FARTHEST_M / 1e3:.0f} km away")
    heard = [_truth(_of_receiver(cells, "valid", k)) for k in range(RECEIVERS)]
    distances = [_number(_of_receiver(cells, "distance", k)) for k in range(RECEIVERS)]
    known = tuple(d if ok and d > 0.0 else math.nan for d, ok in zip(distances, heard, strict=True))
    lat, lon, heading = (_number(cells.get(f"master_{name}")) for name in ("lat", "lon", "orientation"))
    on_earth = abs(lat) <= 90.0 and abs(lon) <= 180.0 and (lat, lon) != (0.0, 0.0)
    fixed = _number(cells.get("master_fix_quality", 1)) > 0.0 and on_earth
    lat, lon = (lat, lon) if fixed else (math.nan, math.nan)
    topside = lat, lon, math.radians(heading) if 0.0 <= heading <= 360.0 else math.nan
    said = tuple(str(value) for name, value in cells.items() if name not in TIMES and not name.startswith(_OTHERS))
    return UgpsAnswer(_time(cells), valid, (x, y, z), known, topside, said)


_OTHERS = ("master", "global", "gps_input", "mav", "nmea", "depth", "temp", "orientation")
_ANSWERS = ("acoustic", "master", "global")


def _flat(row: Mapping[str, Any]) -> dict[str, Any]:
    """Names with those of the answers that they stand in before them."""
    out: dict[str, Any] = {}
    for name, value in row.items():
        if value is None:
            continue
        if isinstance(value, dict):
            of = next((answer for answer in _ANSWERS if answer in name), name)
            out |= {f"{of}_{inner}": each for inner, each in value.items()}
        else:
            out[name.strip()] = value
    return out


def _either(cells: Mapping[str, Any], *names: str) -> Any:
    return next((cells[name] for name in names if name in cells), None)


def _of_receiver(cells: Mapping[str, Any], what: str, k: int) -> Any:
    """A value of one receiver, in a column of its own or in a list."""
    if (own := _either(cells, f"{what}_r{k}", f"receiver_{what}_{k}")) is not None:
        return own
    listed = _either(cells, f"receiver_{what}", f"acoustic_receiver_{what}")
    if isinstance(listed, str):
        try:
            listed = json.loads(listed.replace("True", "true").replace("False", "false"))
        except ValueError:
            return None
    return listed[k] if isinstance(listed, list) and k < len(listed) else None


def _number(value: Any) -> float:
    """A finite number, else NaN."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return math.nan
    return number if math.isfinite(number) else math.nan


def _truth(value: Any) -> bool | None:
    text = str(value).strip().lower()
    return {"true": True, "1": True, "1.0": True, "false": False, "0": False, "0.0": False}.get(text)


def _time(cells: Mapping[str, Any]) -> float:
    value = _either(cells, *TIMES)
    if math.isfinite(number := _number(value)):
        return number
    try:
        return unix_of_text(str(value))
    except ValueError:
        return math.nan


class Ugps:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "ugps"
    title = "Water Linked UGPS records (CSV, JSON)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        begin = head.lstrip(b"\xef\xbb\xbf \t\r\n")[:1]
        if begin in (b"{", b"["):
            return 0.9 if any(f'"{name}"'.encode() in head for name in VALID) else 0.0
        header = {name.strip() for name in head.partition(b"\n")[0].decode("utf-8-sig", "replace").split(",")}
        return 0.9 if header & {*VALID} and header & {*TIMES} else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        left: Counter[tuple[str, str]] = Counter()
        answers: list[UgpsAnswer] = []
        for row in _rows(path, left):
            try:
                answers.append(ugps_answer(row))
            except Refused as refused:
                left["records", refused.text] += 1
        return _recording(path, self.name, options, answers, left)


FORMAT = Ugps()


def _rows(path: Path, left: Counter[tuple[str, str]]) -> Iterator[Mapping[str, Any]]:
    text = path.read_text("utf-8-sig", "replace")
    if text.lstrip()[:1] not in ("{", "["):
        for row in csv.DictReader(text.replace("\0", " ").splitlines()):
            if None in row or None in row.values():
                left["lines", "more or fewer cells than the header"] += 1
            else:
                yield row
        return
    try:
        whole = json.loads(text)
    except (ValueError, RecursionError):
        whole = None
    if whole is not None:
        yield from (row for row in (whole if isinstance(whole, list) else [whole]) if isinstance(row, dict))
        return
    for line in text.splitlines():
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            left["lines", "no JSON object"] += bool(line.strip())
            continue
        if isinstance(row, dict):
            yield row


def _recording(
    path: Path, format_: str, options: ReadingOptions, answers: list[UgpsAnswer], left: Counter[tuple[str, str]]
) -> Recording:
    """The recording of all answers.

    Raises
    ------
    InputError : no time, no valid position
    """
    timed = [answer for answer in answers if math.isfinite(answer.time)]
    left["records", "without a time"] += len(answers) - len(timed)
    if not timed:
        raise InputError(f"{path}: no record has a time; log the time of each answer as timestamp, in s since 1970")
    fresh: list[UgpsAnswer] = []
    repeats = 0
    for answer in timed:
        if fresh and answer.said == fresh[-1].said:
            repeats += 1
        else:
            fresh.append(answer)
    located = [answer for answer in fresh if answer.valid is not None]
    valid = [answer for answer in located if answer.valid]
    if not valid:
        raise InputError(f"{path}: none of {len(timed)} records has a valid position of the locator")
    left["records", "the answer before, given again"] += repeats
    left["records", "not valid, although they have numbers"] += len(located) - len(valid)
    note = (
        f"{len(timed)} answers of a UGPS: {len(valid)} are used, {repeats} repeat the one before, "
        f"{len(located) - len(valid)} are not valid"
    )
    channels, settings, said = _replies(path, options, valid)
    channels += _topside(timed)
    clocks = {RECORDER: Clock(RECORDER, 0.0, 0.0, "its stamps are Unix time")}
    lost = tuple(Left(name, count, why) for (name, why), count in sorted(left.items()) if count)
    return Recording(str(path), format_, tuple(channels), clocks, lost, settings, (note,), tuple(said))


def _replies(
    path: Path, options: ReadingOptions, valid: list[UgpsAnswer]
) -> tuple[list[Channel], dict[str, Any], list[str]]:
    """Positions, or the distances that they were made of where those are chosen; settings; warnings."""
    of_both = {"stamp": "arrival", "one_way": True}
    time = np.array([answer.time for answer in valid])
    channels, settings = [], {}
    said = [f"{POSITIONS}: stamps are those of the logger's polling; state usbl.lever_arm_m, and the ship's place"]
    if "range" in options.choose:
        preferred_first(path, "range", [DISTANCES], options.choose)
        distance = np.array([answer.distances for answer in valid])
        row, k = np.nonzero(np.isfinite(distance))
        columns = {"time": time[row], "range": distance[row, k], "range_receiver": k.astype(float)}
        channels.append(Channel("range", columns, DISTANCES, "", RECORDER))
        settings["range"] = of_both
        said = [f"{DISTANCES}: state where the receivers are, ship.receivers: {{0: [x, y, z], ...}}"]
    if "range" not in options.choose or "usbl" in options.choose:
        preferred_first(path, "usbl", [POSITIONS], options.choose)
        xyz = np.array([answer.xyz for answer in valid]).T
        columns = {"time": time, **dict(zip(("usbl_x", "usbl_y", "usbl_z"), xyz, strict=True))}
        frame = "forward, starboard, down of the antenna made level"
        channels.append(Channel("usbl", columns, POSITIONS, frame, RECORDER))
        settings["usbl"] = {"frame": "ship", **of_both}
        said.append(DEPTH_TWICE)
    return channels, settings, said


def _topside(answers: list[UgpsAnswer]) -> list[Channel]:
    """Where the topside is, and how it lies, as far as it says so."""
    table = np.array([(answer.time, *answer.topside) for answer in answers])
    placed, headed = np.isfinite(table[:, 1:3]).all(axis=1), np.isfinite(table[:, 3])
    out = []
    if placed.any():
        columns = dict(zip(("time", "ship_lat", "ship_lon"), table[placed, :3].T, strict=True))
        out.append(Channel("ship", columns, "position/master: lat, lon", "", RECORDER))
    if headed.any():
        columns = {"time": table[headed, 0], "ship_heading": table[headed, 3]}
        frame = "the topside's, from true north"
        out.append(Channel("ship_heading", columns, "position/master: orientation", frame, RECORDER))
    return out
