"""Captures of VectorNav's ASCII messages, ``$VNYMR,...*61``: those with inertial values, attitude, or GPS time.

Of them only ``$VNINS`` and ``$VNGPS`` have a time. A sentence is stamped by the number or date that a logger wrote
before it, else by its place between sentences that have a time. Values are degrees in NED, gauss, m/s2 and rad/s (user
manuals of VN-100, VN-200 and VN-300).
"""

import binascii
import re
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.gps_time import WEEK_S, WEEKS, unix_of_gps, unwrapped_week
from rovgraph.interchange.formats import Options
from rovgraph.interchange.inertial_columns import Account, Choice, Found, inertial_recording
from rovgraph.interchange.recording import Clock, Recording

SENTENCE = re.compile(rb"^([^$]*)\$(VN([A-Z0-9]{3}),([^*$]*))\*([0-9A-Fa-f]{4}|[0-9A-Fa-f]{2})\s*$")
LONGEST = 1 << 12  # bytes of a line
FEW = 3  # whole sentences that make a file one of these
CELLS = {"YMR": 12, "QMR": 13, "MAR": 9, "IMU": 11, "ISL": 15, "INS": 15, "YPR": 3, "GPS": 15}
# message -> first of its cells with acceleration, rate, field, and yaw, pitch, roll
INERTIAL = {"IMU": (3, 6, 0), "YMR": (6, 9, 3), "QMR": (7, 10, 4), "MAR": (3, 6, 0), "ISL": (9, 12, -1)}
ATTITUDE = {"YMR": 0, "ISL": 0, "INS": 3, "YPR": 0}
TIMED = ("INS", "GPS")  # time of week [s] and week come first
FIX_CELLS = (4, 5, 10, 11, 2)  # of GPS: latitude, longitude, sd north and east [m], kind of fix
GAUSS_UT = 100.0
GPS_SD_S, LOGGER_SD_S = 0.02, 1.0
UNIX_S = (9.5e8, 4.2e9)
BROKEN, SHORT = "a wrong checksum, or no sentence", "cells that are missing or no numbers"

Rows = dict[str, list[tuple[int, bytes]]]  # message -> place in the file, and its cells


class Sentences:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "vectornav-ascii"
    title = "VectorNav ASCII messages"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        lines = [line for line in head.splitlines()[:60] if line.strip()]
        whole = sum(_message(line) is not None for line in lines)
        return 0.9 if whole >= min(FEW, len(lines)) and 3 * whole >= len(lines) > 0 else 0.0

    def read(self, path: Path, options: Options) -> Recording:
        rows, prefixes, left = _sentences(path, options.progress)
        say = Account(left={("sentences", why): count for why, count in left.items()})
        tables = {kind: _numbers(found, CELLS[kind], say) for kind, found in rows.items()}
        tables = {kind: table for kind, table in tables.items() if len(table)}
        inertial = next((kind for kind in INERTIAL if kind in tables), None)
        attitude = next((kind for kind in ATTITUDE if kind in tables), None)
        if inertial is None and attitude is None:
            raise InputError(f"{path}: no message with inertial values or an attitude; record VNIMU, VNYMR or VNINS")
        place = np.unique(np.concatenate([table[:, 0] for table in tables.values()]))
        time, clock = _stamps(path, place, tables, prefixes, say)
        found = _found(place, tables, inertial, attitude)
        for kind in tables.keys() - {inertial, attitude, *TIMED}:
            say.left[f"VN{kind}", "another message is read"] = len(tables[kind])
        return inertial_recording(path, self.name, clock, time, found, np.nan, say)


FORMAT = Sentences()


def _message(line: bytes) -> tuple[bytes, str, bytes] | None:
    """What is before a whole sentence, its kind, and its cells; None where the line is none."""
    found = SENTENCE.match(line)
    if found is None:
        return None
    text, stated = found[2], found[5]
    sums = {2: lambda: int(np.bitwise_xor.reduce(np.frombuffer(text, np.uint8))), 4: lambda: binascii.crc_hqx(text, 0)}
    return (found[1], found[3].decode(), found[4]) if int(stated, 16) == sums[len(stated)]() else None


def _sentences(path: Path, progress: Callable[[int, int], None]) -> tuple[Rows, dict[int, str], Counter[str]]:
    """Sentences that are read, what a logger wrote before each, and why others are left."""
    rows: Rows = {}
    prefixes: dict[int, str] = {}
    left: Counter[str] = Counter()
    size = path.stat().st_size
    with path.open("rb") as file:
        place = 0
        while line := file.readline(LONGEST):
            place += 1
            if place % 4096 == 0:
                progress(min(file.tell(), size), size)
            message = _message(line)
            if message is None:
                left[BROKEN] += bool(line.strip())
                continue
            before, kind, cells = message
            if kind not in CELLS:
                left[f"VN{kind}: no message that is read"] += 1
                continue
            rows.setdefault(kind, []).append((place, cells))
            if before.strip():
                prefixes[place] = before.decode("latin-1").strip(" \t,;:[]|")
    progress(size, size)
    return rows, prefixes, left


def _numbers(rows: list[tuple[int, bytes]], count: int, say: Account) -> Array:
    """Place and cells of the sentences whose cells are all numbers, shape (n, 1 + count)."""
    split = [(place, cells.partition(b";")[0].split(b",")) for place, cells in rows]  # a status may follow
    whole = [(place, cells) for place, cells in split if len(cells) == count]
    texts = pd.Series([cell.decode("latin-1") for _, cells in whole for cell in cells], dtype=object)
    values = pd.to_numeric(texts, errors="coerce").to_numpy(dtype=float).reshape(-1, count)
    good = np.isfinite(values).all(axis=1)
    key = "sentences", SHORT
    say.left[key] = say.left.get(key, 0) + len(rows) - int(good.sum())
    return np.asarray(np.column_stack([np.array([place for place, _ in whole], dtype=float), values])[good])


def _stamps(
    path: Path, place: Array, tables: Mapping[str, Array], prefixes: Mapping[int, str], say: Account
) -> tuple[Array, Clock]:
    """Times at places in the file [s], NaN where none is known."""
    logged = _logged([prefixes.get(int(k), "") for k in place])
    if np.isfinite(logged).mean() > 0.5:
        unix = UNIX_S[0] < float(np.nanmedian(logged)) < UNIX_S[1]
        say.warnings.append("stamps are those that a logger wrote before the sentences, after the transport")
        clock = Clock("the logger's time", 0.0, LOGGER_SD_S, "its stamps look like Unix time")
        return logged, clock if unix else Clock("the logger's time")
    timed = np.concatenate([np.empty((0, 3)), *(tables[kind][:, :3] for kind in TIMED if kind in tables)])
    timed = timed[np.argsort(timed[:, 0])]
    known = (timed[:, 2] >= WEEKS[0]) & (timed[:, 2] <= WEEKS[1])
    unix = bool(known.mean() > 0.5) if len(known) else False
    timed = timed[known == unix]
    say.left["sentences", "a time from before or after the clock was set"] = int((known != unix).sum())
    if len(timed) < 2:
        raise InputError(
            f"{path}: its sentences have no time; record VNINS beside them, a time before each, or CSV with TimeStartup"
        )
    at = unix_of_gps(timed[:, 2] * WEEK_S + timed[:, 1]) if unix else unwrapped_week(timed[:, 1])
    time = np.interp(place, timed[:, 0], at, left=np.nan, right=np.nan)
    say.warnings.append("sentences are stamped by their place between those with a time (VNINS, VNGPS)")
    say.left["sentences", "before the first or after the last one with a time"] = int(np.isnan(time).sum())
    name = "the instrument's GPS time" if unix else "the instrument's time since its start"
    return time, Clock(name, 0.0, GPS_SD_S, "GPS week and time of week") if unix else Clock(name)


def _logged(prefixes: list[str]) -> Array:
    """Seconds that numbers or dates before sentences state, NaN where there are none."""
    texts = pd.Series(prefixes, dtype=object)
    numbers = pd.to_numeric(texts, errors="coerce").to_numpy(dtype=float)
    if np.isfinite(numbers).any():
        return np.where(np.isfinite(numbers), numbers, np.nan)
    dates = pd.to_datetime(texts, format="ISO8601", errors="coerce", utc=True)
    return np.asarray(((dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)).to_numpy(dtype=float))


def _found(
    place: Array, tables: Mapping[str, Array], inertial: str | None, attitude: str | None
) -> dict[str, Found | None]:
    """Values at places, NaN where a sentence has none."""

    def spread(kind: str, values: Array, quantity: str, unit: str, source: str) -> Found:
        made = np.full((len(place), values.shape[1]), np.nan)
        made[np.searchsorted(place, tables[kind][:, 0])] = values
        return Found(made, f"VN{kind}: {source} ({unit})", Choice((), quantity, unit))

    found: dict[str, Found | None] = {}
    if inertial is not None:
        cells = tables[inertial][:, 1:]
        acc, gyr, mag = INERTIAL[inertial]
        found["acc"] = spread(inertial, cells[:, acc : acc + 3], "acceleration", "m/s2", "acceleration")
        found["gyr"] = spread(inertial, cells[:, gyr : gyr + 3], "rate", "rad/s", "rate")
        if mag >= 0:
            found["mag"] = spread(inertial, GAUSS_UT * cells[:, mag : mag + 3], "field", "gauss", "field")
    if attitude is not None:
        first = ATTITUDE[attitude]
        yaw_pitch_roll = np.deg2rad(tables[attitude][:, 1 + first : 4 + first])
        found["rpy"] = spread(attitude, yaw_pitch_roll[:, ::-1], "angle", "deg", "roll, pitch, yaw")
    if "GPS" in tables:
        lat, lon, north, east, kind = (tables["GPS"][:, 1 + k] for k in FIX_CELLS)
        sd = np.sqrt(0.5 * (north**2 + east**2))
        fixes = np.column_stack([np.where(kind >= 2.0, lat, np.nan), lon, sd])
        found["fix"] = spread("GPS", fixes, "latitude", "deg", "latitude, longitude")
    return found
