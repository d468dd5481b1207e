"""Text exports of MicroStrain's inertial units (GX3 to CV7): of MIP Monitor, and of SensorConnect.

MIP Monitor writes a field's descriptor behind each name, ``X Accel [x8004]``; SensorConnect writes names of MSCL behind
the device's, ``inertial-6253.76535:scaledAccelX``. Both follow ``DATA_START``, if blocks on file and device come first.
Descriptors and names state units: g, rad/s, gauss, rad in NED (MIP SDK, `data_sensor.h`, `data_filter.h`).
"""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.gps_time import WEEK_S, WEEKS, unix_of_gps, unwrapped_week
from rovgraph.interchange.formats import HEAD, Options
from rovgraph.interchange.inertial_columns import (
    UNUSED,
    Account,
    Choice,
    Found,
    Names,
    index_of,
    inertial_recording,
    stem_and_unit,
    take,
)
from rovgraph.interchange.recording import Clock, Recording
from rovgraph.interchange.text_table import Columns, Layout, cells_of, read_columns

START = "DATA_START"
DESCRIPTOR = re.compile(r"^(.*?)\s*\[x([0-9A-F]{4})\]$", re.IGNORECASE)
FILTERED = "are corrected by the instrument's own filter; record the scaled ones for a filter of ours"


def _of_field(field: str, *names: str) -> tuple[str, ...]:
    return tuple(f"{name} {field}" for name in names)


def _xyz(name: str) -> tuple[str, ...]:
    return tuple(f"{name}{axis}" for axis in "xyz")


CHOICES = {
    "acc": (
        Choice(_of_field("x8004", "x accel", "y accel", "z accel"), "acceleration", "g"),
        Choice(_xyz("scaledaccel"), "acceleration", "g"),
        Choice(_of_field("x8008", "delta vel x", "delta vel y", "delta vel z"), "acceleration", "g", summed=True),
        Choice(_xyz("deltavel"), "acceleration", "g", summed=True),
        Choice(_xyz("estcompensatedaccel"), "acceleration", "m/s2", f"estCompensatedAccel: values {FILTERED}"),
    ),
    "gyr": (
        Choice(_of_field("x8005", "x gyro", "y gyro", "z gyro"), "rate", "rad/s"),
        Choice(_xyz("scaledgyro"), "rate", "rad/s"),
        Choice(_of_field("x8007", "delta theta x", "delta theta y", "delta theta z"), "rate", "rad/s", summed=True),
        Choice(_xyz("deltatheta"), "rate", "rad/s", summed=True),
        Choice(_xyz("estangularrate"), "rate", "rad/s", f"estAngularRate: values {FILTERED}"),
    ),
    "mag": (
        Choice(_of_field("x8006", "x mag", "y mag", "z mag"), "field", "gauss"),
        Choice(_xyz("scaledmag"), "field", "gauss"),
    ),
    "rpy": (
        Choice(_of_field("x800C", "roll", "pitch", "yaw"), "angle", "rad"),
        Choice(("roll", "pitch", "yaw"), "angle", "rad"),
        Choice(_of_field("x8205", "roll", "pitch", "yaw"), "angle", "rad"),
        Choice(("estroll", "estpitch", "estyaw"), "angle", "rad"),
    ),
}
KNOWN = {name for choices in CHOICES.values() for choice in choices for name in choice.names}
GPS = (  # flags, week, time of week
    ("gps tflags", "gps week", "gps tow"),
    ("gpscorreltimestampflags", "gpscorreltimestampweeknum", "gpscorreltimestamptow"),
)
SET = 0x4  # flag of a clock that was set, since the instrument started
GPS_SD_S = 0.01
FIX = _of_field("x8103", "lat", "long", "horz acc", "flags"), ("latitude", "longitude", "horizontalaccuracy")
FIX_VALID = 0x1
REFERENCE, COMPUTER = "referencetime", "time"  # ns since the start; of the computer that recorded
DATES = ("ISO8601", "%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %I:%M:%S.%f %p")
ZONE_SD_S = 6 * 3600.0  # of a computer's clock whose time zone nobody states
COMPUTER_SD_S = 1.0
NANOSECONDS = 1e17  # Unix times in nanoseconds are larger, those in seconds smaller
UNIX_S = (9.5e8, 4.2e9)
FEW = 3  # names that nothing else has
SEPARATORS = {"comma": ",", "semicolon": ";", "tab": "\t"}
DECIMALS = {"period": ".", "point": ".", "comma": ","}
LEFT = {
    "x800D": "temperature of the IMU",
    "x8010": "stabilised by the instrument's own filter",
    "x8011": "stabilised by the instrument's own filter",
    "x8017": "pressure of the housing",
    "est": "computed by the instrument's own filter",
    "scaledambientpressure": "pressure of the housing",
}


class MicroStrain:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "microstrain"
    title = "MicroStrain CSV (MIP Monitor, SensorConnect)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        layout = _layout(head)
        own = 0 if layout is None else sum(map(_is_own, set(layout.names)))
        return 0.9 if own >= FEW else 0.0

    def read(self, path: Path, options: Options) -> Recording:
        with path.open("rb") as file:
            layout = _layout(file.read(HEAD))
        if layout is None:
            raise InputError(f"{path}: no line names columns of MicroStrain; export it again as CSV")
        names = [_plain(name) for name in layout.names]
        wanted = {
            k for k, (name, _) in enumerate(names) if name in KNOWN or _is_time(name) or name in (*FIX[0], *FIX[1])
        }
        texts = {k for k, (name, _) in enumerate(names) if name == COMPUTER}
        columns = read_columns(path, layout, wanted - texts, texts, options.progress)
        values = columns.numbers
        say = Account()
        found = {part: take(path, names, values, choices, say) for part, choices in CHOICES.items()}
        found["fix"] = _fix(names, values, say)
        stamps = _stamps(path, names, columns, found, say)
        say.unused(names, columns, _why_left)
        return inertial_recording(path, self.name, stamps.clock, stamps.time, found, stamps.step, say)


FORMAT = MicroStrain()


def _layout(head: bytes) -> Layout | None:
    """The line that names the columns: the one behind ``DATA_START``, else the first that is not blank."""
    separator, decimal, at, behind = ",", ".", 0, START.encode() not in head
    for line in head.splitlines(keepends=True):
        at += len(line)
        text = line.decode("utf-8-sig", "replace").strip()
        key, _, value = text.partition("=")
        if not behind:
            separator = SEPARATORS.get(value.lower(), separator) if key == "ListSeparator" else separator
            decimal = DECIMALS.get(value.lower(), decimal) if key == "DecimalSeparator" else decimal
            behind = text.strip('",;') == START
        elif text:
            names = tuple(cells_of(text, separator))
            return Layout(names, at, separator, decimal) if len(names) > 1 and decimal != separator else None
    return None


def _plain(name: str) -> tuple[str, str]:
    """A name in small letters with its descriptor but without its device; and a unit that it states."""
    name = name.rpartition(":")[2] if ":" in name and not name.lower().endswith(":valid") else name
    if found := DESCRIPTOR.match(name.strip()):
        return f"{found[1].lower()} x{found[2].upper()}", ""
    return stem_and_unit(name)


def _is_own(name: str) -> bool:
    """Whether no other program names a column so: with a descriptor, or as MSCL does, which begins in small letters."""
    plain = _plain(name)[0]
    if DESCRIPTOR.match(name) or plain in GPS[0]:
        return plain in KNOWN or plain in GPS[0]
    return plain in KNOWN - {"roll", "pitch", "yaw"} and name.rpartition(":")[2][:1].islower()


def _is_time(name: str) -> bool:
    return any(name in group for group in GPS) or REFERENCE in name


def _why_left(name: str) -> str:
    known = (why for key, why in LEFT.items() if name.startswith(key) or name.endswith(f" {key}"))
    return next(known, UNUSED)


def _fix(names: Names, values: dict[int, Array], say: Account) -> Found | None:
    """Latitude and longitude of the instrument's GNSS, where it says that they are valid."""
    for wanted in FIX:
        at = [index_of(names, name) for name in wanted]
        if -1 in at:
            continue
        lat, lon, sd = (values[k] for k in at[:3])
        if wanted == FIX[0]:
            flags = np.nan_to_num(values[at[3]]).clip(0.0, 2.0**31).astype(np.int64)
            lat = np.where(flags & FIX_VALID, lat, np.nan)
        say.used.update(at)
        return Found(np.column_stack([lat, lon, sd]), ", ".join(wanted[:3]), Choice(wanted, "latitude", "deg"))
    return None


@dataclass(frozen=True)
class Stamps:
    """Times of rows, shape (n,), NaN = none [s]; the clock that they are of; and the usual step of the IMU's [s]."""

    time: Array
    clock: Clock
    step: float


def _stamps(path: Path, names: Names, columns: Columns, found: dict[str, Found | None], say: Account) -> Stamps:
    inertial = [each.data for part in ("acc", "gyr", "rpy") if (each := found[part]) is not None]
    if not inertial:
        told = ", ".join(name for name, _ in names)[:200]
        raise InputError(f"{path}: has no value of acceleration, rate or attitude; its columns are: {told}")
    rows = np.asarray(np.isfinite(inertial[0]).all(axis=1))
    made = _by_gps(names, columns.numbers, rows, say) or _by_reference(names, columns.numbers, say)
    made = made or _by_computer(path, names, columns, say)
    if made is None:
        raise InputError(f"{path}: no column of time; export it with GPS time, reference time or Time")
    time, clock = made
    steps = np.diff(time[rows & np.isfinite(time)])
    steps = steps[steps > 0.0]
    return Stamps(time, clock, float(np.median(steps)) if len(steps) else np.nan)


def _by_gps(names: Names, values: dict[int, Array], rows: np.ndarray, say: Account) -> tuple[Array, Clock] | None:
    """Week and time of week; Unix time where the instrument says that its clock was set."""
    for group in GPS:
        at = [index_of(names, name) for name in group]
        if -1 in at[1:] or not np.isfinite(values[at[2]]).any():
            continue
        say.used.update(k for k in at if k >= 0)
        week, tow = values[at[1]], values[at[2]]
        set_ = (week >= WEEKS[0]) & (week <= WEEKS[1])
        if at[0] >= 0:
            flags = np.nan_to_num(values[at[0]]).clip(0.0, 2.0**31).astype(np.int64)
            set_ &= (flags & SET > 0) | ~rows  # rows of its GNSS have other flags
        stamped = rows & np.isfinite(tow)
        if set_[stamped].mean(dtype=float) > 0.5 if stamped.any() else bool(set_.any()):
            say.left["rows", "from before the instrument's clock was set"] = int((stamped & ~set_).sum())
            time = np.where(set_, unix_of_gps(np.where(set_, week, 0.0) * WEEK_S + np.nan_to_num(tow)), np.nan)
            time = np.where(np.isfinite(tow), time, np.nan)
            return time, Clock("the instrument's GPS time", 0.0, GPS_SD_S, "GPS week and time of week")
        say.left["rows", "from after the instrument's clock was set"] = int((stamped & set_).sum())
        say.notes.append("the instrument's clock was not set: its GPS time counts from its start")
        return unwrapped_week(np.where(set_, np.nan, tow)), Clock("the instrument's time since its start")
    return None


def _by_reference(names: Names, values: dict[int, Array], say: Account) -> tuple[Array, Clock] | None:
    for k, (name, _) in enumerate(names):
        if REFERENCE in name and k in values and np.isfinite(values[k]).any():
            say.used.add(k)
            say.notes.append(f"{name} is taken in nanoseconds since the instrument's start")
            return 1e-9 * values[k], Clock("the instrument's time since its start")
    return None


def _by_computer(path: Path, names: Names, columns: Columns, say: Account) -> tuple[Array, Clock] | None:
    k = index_of(names, COMPUTER)
    if k < 0 or not any(columns.texts[k]):
        return None
    say.used.add(k)
    texts = pd.Series(columns.texts[k])
    say.warnings.append("stamps are those of the computer, after the transport; record the instrument's own time")
    numbers = pd.to_numeric(texts, errors="coerce").to_numpy(dtype=float)
    if np.isfinite(numbers).any():
        usual = float(np.nanmedian(numbers))
        scale = 1e-9 if usual > NANOSECONDS else 1.0
        if UNIX_S[0] < scale * usual < UNIX_S[1]:
            return np.asarray(scale * numbers, dtype=float), Clock(
                "the computer's time", 0.0, COMPUTER_SD_S, "its stamps look like Unix time"
            )
        return np.asarray(numbers, dtype=float), Clock("the computer's time")
    for form in DATES:
        dates = pd.to_datetime(texts, format=form, errors="coerce", utc=True)
        if dates.notna().any():
            unix = (dates - pd.Timestamp(0, tz="UTC")) / pd.Timedelta(seconds=1)
            clock = Clock("the computer's time", 0.0, ZONE_SD_S, "its calendar, taken for UTC")
            return np.asarray(unix, dtype=float), clock
    example = next(text for text in columns.texts[k] if text)
    raise InputError(
        f"{path}: Time is {example[:40]!r}, expected 2024-05-31 12:00:00.5, 5/31/2024 12:00:00.5 or seconds"
    )
