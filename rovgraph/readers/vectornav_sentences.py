"""Captures of VectorNav's ASCII messages, ``$VNYMR,...*61``: inertial values, attitude, GNSS.

Values are m/s2, rad/s, gauss and degrees relative to NED (user manuals of VN-100 and VN-200). A status ``S0000`` and a
counter ``T0000543`` may follow them. Only ``$VNINS`` and ``$VNGPS`` have a time, so a sentence is stamped by, in this
order: a logger's time before it, a counter of microseconds, its place between sentences with a time, or its number
and the rate that the answer to ``$VNRRG,07`` states.
"""

import re
from array import array
from binascii import crc_hqx
from collections import Counter
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rovgraph.dates import WEEK_S, is_week, unix_of_gps
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.stamps import DAY_S, UNIX_S, unwrapped
from rovgraph.log.units import UNITS
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.inertial import SINCE_START, Account, InertialMeasurement, recording_of_inertial
from rovgraph.readers.recording import Clock, Recording
from rovgraph.readers.stamps import unix_of_text
from rovgraph.readers.vectornav import NORTH, attitude_of, gnss

SENTENCE = re.compile(rb"^([^$]*)\$(VN([A-Z]{3}),([^*$]*))\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})\W*$")
RATE = re.compile(rb"\$VN[RW]RG,0?7,0*([0-9]+)")
LONGEST = 1 << 12  # bytes of a line
EVERY = 4096  # lines between two calls of progress
FEW = 3  # whole sentences that make a file one of these
CELLS = {"IMU": 11, "YMR": 12, "QMR": 13, "MAR": 9, "ISL": 15, "INS": 15, "DTV": 7, "YPR": 3, "QTN": 4, "GPS": 15}
# first of the cells with acceleration, rate and field (-1 = none); the values of ISL are corrected
INERTIAL = {"IMU": (3, 6, 0), "YMR": (6, 9, 3), "QMR": (7, 10, 4), "MAR": (3, 6, 0), "ISL": (9, 12, -1)}
YAW_PITCH_ROLL = {"YMR": 0, "YPR": 0, "INS": 3, "ISL": 0}  # first cell
TRUE_NORTH = ("INS", "ISL")
QUATERNIONS = ("QMR", "QTN")
TIMED = ("INS", "GPS")  # time of week [s] and week come first
GPS_CELLS = (4, 5, 2, 10, 11)  # latitude, longitude, kind of fix, sd north and east
PLACE, LOGGED, COUNT, FIRST = range(4)  # columns before the cells
BROKEN, SHORT = "a wrong checksum, or no sentence", "cells that are missing or no numbers"
COMMANDS = ("RRG", "WRG", "ERR", "WNV", "RST", "RFS", "TAR", "ASY")
US, COUNT_WRAP = 1e-6, 2.0**32
LEAST_US = 500.0  # between two messages; a counter with smaller steps counts events
GPS_SD_S, LOGGER_SD_S = 0.02, 1.0


class VectorNavSentences:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "vectornav-ascii"
    title = "VectorNav ASCII messages"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        lines = [line for line in head.splitlines()[:60] if line.strip()]
        sentences = sum(_sentence(line) is not None for line in lines)
        return 0.9 if sentences >= min(FEW, len(lines)) and 3 * sentences >= len(lines) > 0 else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        account, capture = Account(), _Capture()
        capture.read(path, options.progress)
        account.left.update(capture.left)
        tables = {kind: np.frombuffer(rows).reshape(-1, FIRST + CELLS[kind]) for kind, rows in capture.rows.items()}
        if not tables.keys() & {*INERTIAL, *YAW_PITCH_ROLL, *QUATERNIONS, "DTV"}:
            others = ", ".join(sorted({name for name, _ in capture.left})) or "none"
            raise InputError(
                f"{path}: no message with inertial values or attitude (VNIMU, VNYMR, ...); it has: {others}"
            )
        clock = _stamp(path, tables, capture, account)
        found = [made for kind in CELLS if kind in tables for made in _measured(kind, tables[kind])]
        return recording_of_inertial(path, self.name, found, clock, account, options)


FORMAT = VectorNavSentences()


def _sentence(line: bytes) -> tuple[bytes, str, bytes] | None:
    """What is before a whole sentence, its kind, and its cells; None for other lines."""
    found = SENTENCE.match(line)
    if found is None:
        return None
    text, stated = found[2], found[5]
    checksum = reduce(xor, text) if len(stated) == 2 else crc_hqx(text, 0)
    return (found[1], found[3].decode(), found[4]) if int(stated, 16) == checksum else None


class _Capture:
    """The sentences of a file.

    Attributes
    ----------
    rows : kind -> place in the file, time that a logger wrote, counter, cells, of each whole sentence
    left : name and reason -> how many
    kinds : asynchronous messages -> their lines, broken ones included
    rate : as stated by the instrument [Hz]; 0 = not stated
    """

    def __init__(self) -> None:
        self.rows: dict[str, array[float]] = {}
        self.left: Counter[tuple[str, str]] = Counter()
        self.kinds: Counter[str] = Counter()
        self.rate = 0.0

    def read(self, path: Path, progress: Callable[[int, int], None]) -> None:
        size, number = path.stat().st_size, 0
        with path.open("rb") as file:
            while line := file.readline(LONGEST):
                number += 1
                if number % EVERY == 0:
                    progress(min(file.tell(), size), size)
                if line.strip():
                    self._take(line)
        progress(size, size)

    def _take(self, line: bytes) -> None:
        _, _, behind = line.partition(b"$VN")
        kind = behind[:3].decode("latin-1")
        if kind in CELLS:
            self.kinds[kind] += 1
        if (whole := _sentence(line)) is None:
            self.left["sentences", BROKEN] += 1
            return
        before, kind, cells = whole
        if stated := RATE.search(line):
            self.rate = min(float(stated[1]), 1e4)
        if kind not in CELLS:
            why = "answer to a command" if kind in COMMANDS else "no message that is read"
            self.left[f"VN{kind}", why] += 1
            return
        row = _numbers(cells, CELLS[kind])
        if row is None:
            self.left[f"VN{kind}", SHORT] += 1
        else:
            self.rows.setdefault(kind, array("d")).extend((self.kinds.total(), _logged(before), *row))


def _numbers(cells: bytes, count: int) -> list[float] | None:
    """The counter behind the cells, NaN = none, and the cells; None where they are not all numbers."""
    parts = cells.partition(b";")[0].split(b",")
    counter = np.nan
    while len(parts) > count and parts[-1][:1] in (b"S", b"T", b"V"):
        end = parts.pop()
        if end[:1] == b"T" and end[1:].isdigit():
            counter = float(end[1:])
    if len(parts) != count:
        return None
    try:
        return [counter, *map(float, parts)]
    except ValueError:
        return None


def _logged(before: bytes) -> float:
    """Seconds that a number, a date or a time of the day before a sentence states, NaN without one."""
    text = before.decode("latin-1").strip(" \t,;:[]|\"'>-")
    if not text:
        return np.nan
    try:
        number = float(text)
    except ValueError:
        return _calendar(text)
    for scale in (1.0, 1e-3, 1e-6, 1e-9):
        if UNIX_S[0] < scale * number < UNIX_S[1]:
            return scale * number
    return number


def _calendar(text: str) -> float:
    if found := re.fullmatch(r"(\d\d?):(\d\d):(\d\d(?:\.\d+)?)", text):
        return 3600.0 * float(found[1]) + 60.0 * float(found[2]) + float(found[3])
    try:
        return unix_of_text(text)
    except ValueError:
        return np.nan


def _stamp(path: Path, tables: dict[str, Array], capture: _Capture, account: Account) -> Clock:
    """Put times [s] into the column `PLACE` of every table, NaN where none is known.

    Raises
    ------
    InputError : the file has no time
    """
    rows = np.concatenate([table[:, : FIRST + 2] for table in tables.values()])
    kinds = np.repeat([kind in TIMED for kind in tables], [len(table) for table in tables.values()])
    order = np.argsort(rows[:, PLACE], kind="stable")
    time, clock = _times(path, rows[order], kinds[order], capture, account)
    by_place = dict(zip(rows[order, PLACE].tolist(), time.tolist(), strict=True))
    for kind, table in tables.items():
        stamped = table.copy()
        stamped[:, PLACE] = [by_place[place] for place in table[:, PLACE].tolist()]
        tables[kind] = stamped
    return clock


def _times(
    path: Path, rows: Array, timed: NDArray[np.bool_], capture: _Capture, account: Account
) -> tuple[Array, Clock]:
    """Times [s] of sentences in the order of the file, shape (n,), and their clock.

    Parameters
    ----------
    rows : ndarray, shape (n, 5), place, time of a logger, counter, and the first two cells
    timed : shape (n,), whether these are time of week and week
    """
    place, logged, count = rows[:, PLACE], rows[:, LOGGED], rows[:, COUNT]
    if np.isfinite(logged).mean() > 0.5:
        account.warnings.append("stamps are those that a logger wrote before the sentences, after the transport")
        if UNIX_S[0] < float(np.nanmedian(logged)) < UNIX_S[1]:
            return logged, Clock("the logger's time", 0.0, LOGGER_SD_S, "its stamps look like Unix time")
        if np.nanmax(logged) <= DAY_S:
            return unwrapped(logged, DAY_S), Clock("the logger's time", cycle=DAY_S)
        return logged, Clock("the logger's time")
    if np.isfinite(count).mean() > 0.5:
        since = US * unwrapped(count, COUNT_WRAP)
        steps = np.diff(since[np.isfinite(since)])
        if len(steps) and steps.min() >= 0.0 and np.median(steps[steps > 0.0], keepdims=True)[0] >= US * LEAST_US:
            account.notes.append("stamps are the counter behind the sentences, in microseconds")
            return since, Clock(SINCE_START)
        account.notes.append("the counter behind the sentences counts events, and is no time")
    if timed.sum() > 1:
        return _by_gps(place, rows[:, FIRST], rows[:, FIRST + 1], timed, account)
    if capture.rate > 0.0 and len(capture.kinds) == 1:
        account.warnings.append(
            f"stamps are the sentences' numbers at {capture.rate:g} Hz, which the instrument states: what was not "
            "recorded shifts them; record a time before each sentence"
        )
        return place / capture.rate, Clock(SINCE_START)
    raise InputError(
        f"{path}: its sentences have no time; record a time before each, VNINS beside them, or a CSV with TimeStartup"
    )


def _by_gps(place: Array, tow: Array, week: Array, timed: NDArray[np.bool_], account: Account) -> tuple[Array, Clock]:
    """Unix time where the receiver knew the week, else the instrument's time since its start."""
    known = timed & is_week(week)
    if 2 * known.sum() > timed.sum():
        at = known
        seconds = unix_of_gps(np.where(known, week, 0.0), tow)[at]
        clock = Clock("the instrument's GPS time", 0.0, GPS_SD_S, "GPS week and time of week")
    else:
        at = timed & ~known
        seconds, clock = unwrapped(tow[at], WEEK_S), Clock(SINCE_START)
        account.notes.append("the instrument's clock was not set: its time of week counts from its start")
    account.left["sentences", "a time from before or after the clock was set"] += int(timed.sum() - at.sum())
    account.warnings.append("sentences are stamped by their place between those with a time (VNINS, VNGPS)")
    time = np.interp(place, place[at], seconds, left=np.nan, right=np.nan)
    time[at] = seconds
    return time, clock


def _measured(kind: str, table: Array) -> list[InertialMeasurement]:
    """What the sentences of a kind hold."""
    time, cells, name, found = table[:, PLACE], table[:, FIRST:], f"VN{kind}", []
    gauss = UNITS["field"]["gauss"]
    if kind in INERTIAL:
        acc, gyr, mag = INERTIAL[kind]
        values = np.hstack([cells[:, acc : acc + 3], cells[:, gyr : gyr + 3]])
        corrected = f"{name}: values are corrected by the instrument's own filter; record VNIMU for a filter of ours"
        found.append(InertialMeasurement("imu", name, time, values, "" if kind == "IMU" else corrected))
        if mag >= 0:
            found.append(InertialMeasurement("mag", name, time, gauss * cells[:, mag : mag + 3]))
    if kind == "DTV":
        step = np.where(cells[:, :1] > 0.0, cells[:, :1], np.nan)
        values = np.hstack([cells[:, 4:7] / step, np.deg2rad(cells[:, 1:4]) / step])
        found.append(InertialMeasurement("imu", name, time, values))
    if kind in YAW_PITCH_ROLL:
        first, true = YAW_PITCH_ROLL[kind], kind in TRUE_NORTH
        angles = np.deg2rad(cells[:, first : first + 3])[:, ::-1]
        north = "its yaw is relative to true north" if true else NORTH
        found.append(InertialMeasurement("ahrs", name, time, angles, f"{name}: {north}", true_north=true))
    if kind in QUATERNIONS:
        found.append(attitude_of(name, time, cells[:, :4]))
    if kind == "GPS":
        found.append(gnss(name, time, *(cells[:, k] for k in GPS_CELLS)))
    return found
