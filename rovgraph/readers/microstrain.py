"""CSV exports of MicroStrain's inertial units (3DM-GX3 to CV7): of MIP Monitor, and of SensorConnect.

MIP Monitor writes a field's descriptor behind each name, ``X Accel [x8004]``, below blocks on file and device that end
with ``DATA_START``. SensorConnect writes the names of MSCL behind the device's, ``inertial-6253.76535:scaledAccelX``.
Names state no units: those of the MIP protocol are g, rad/s, gauss, and radians relative to NED.
"""

import contextlib
import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from rovgraph.dates import WEEK_S, is_week, unix_of_gps
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.stamps import UNIX_S, unwrapped
from rovgraph.readers.formats import HEAD, ReadingOptions
from rovgraph.readers.inertial import (
    SINCE_START,
    Account,
    InertialMeasurement,
    InertialSource,
    Vector,
    flags_of,
    measured_of,
    name_and_unit,
    recording_of_inertial,
    xyz,
)
from rovgraph.readers.recording import Clock, Recording
from rovgraph.readers.stamps import unix_of_text
from rovgraph.readers.text_table import TextLayout, TextTable, cells_of, read_table

START = b"DATA_START"
DESCRIPTOR = re.compile(r"^(.*?)\s*\[x([0-9A-F]{4})\]$", re.IGNORECASE)
CORRECTED = "values are corrected by the instrument's own filter; record the scaled ones for a filter of ours"
NORTH = "the yaw is taken relative to magnetic north; if not, state heading.ahrs_reference: true"


def _field(descriptor: str, *names: str) -> tuple[str, ...]:
    return tuple(f"{name} x{descriptor}" for name in names)


def _imu(label: str, acc: tuple[str, ...], gyr: tuple[str, ...], summed: bool = False) -> InertialSource:
    vectors = Vector(acc, "acceleration", "g", summed), Vector(gyr, "rate", "rad/s", summed)
    return InertialSource("imu", label, vectors)


SOURCES = (
    _imu("Accel, Gyro", _field("8004", "xaccel", "yaccel", "zaccel"), _field("8005", "xgyro", "ygyro", "zgyro")),
    _imu("scaledAccel, scaledGyro", xyz("scaledaccel"), xyz("scaledgyro")),
    _imu(
        "Delta Vel, Delta Theta",
        _field("8008", "deltavelx", "deltavely", "deltavelz"),
        _field("8007", "deltathetax", "deltathetay", "deltathetaz"),
        summed=True,
    ),
    _imu("deltaVel, deltaTheta", xyz("deltavel"), xyz("deltatheta"), summed=True),
    InertialSource(
        "imu",
        "estCompensatedAccel, estAngularRate",
        (
            Vector(xyz("estcompensatedaccel"), "acceleration", "m/s2"),
            Vector(xyz("estangularrate"), "rate", "rad/s"),
        ),
        f"estCompensatedAccel, estAngularRate: {CORRECTED}",
    ),
    InertialSource("mag", "Mag", (Vector(_field("8006", "xmag", "ymag", "zmag"), "field", "gauss"),)),
    InertialSource("mag", "scaledMag", (Vector(xyz("scaledmag"), "field", "gauss"),)),
    *(
        InertialSource("ahrs", label, (Vector(names, "angle", "rad"),), f"{label}: {NORTH}")
        for label, names in (
            ("Roll, Pitch, Yaw [x800C]", _field("800c", "roll", "pitch", "yaw")),
            ("roll, pitch, yaw", ("roll", "pitch", "yaw")),
            ("Roll, Pitch, Yaw [x8205]", _field("8205", "roll", "pitch", "yaw")),
            ("estRoll, estPitch, estYaw", ("estroll", "estpitch", "estyaw")),
        )
    ),
)
FIXES = (  # latitude, longitude, sd, and flags, of which one marks them as valid
    (*_field("8103", "lat", "long", "horzacc"), "flags x8103"),
    ("latitude", "longitude", "horizontalaccuracy", ""),
)
GPS = (  # week, time of week, flags
    ("gpsweek", "gpstow", "gpstflags"),
    ("gpscorreltimestampweeknum", "gpscorreltimestamptow", "gpscorreltimestampflags"),
    ("timeinfoweeknumber", "timeinfotow", ""),
)
SET, VALID = 0x4, 0x1  # flags of a clock that was set since the start, and of a valid position
REFERENCE, COMPUTER = "timeinforeferencetime", "time"  # [ns]; of the computer that recorded
VECTORS = {name for source in SOURCES for vector in source.vectors for name in vector.names}
KNOWN = VECTORS | {name for group in (*FIXES, *GPS) for name in group if name} | {REFERENCE}
OWN = KNOWN - {"roll", "pitch", "yaw", "latitude", "longitude", "horizontalaccuracy", *xyz("deltavel")}
FEW = 3  # names that nothing else has
SEPARATORS = {b"comma": ",", b"semicolon": ";", b"tab": "\t"}
DECIMALS = {b"period": ".", b"point": ".", b"comma": ","}
DATES = ("%m/%d/%Y %H:%M:%S.%f", "%m/%d/%Y %H:%M:%S", "%m/%d/%Y %I:%M:%S.%f %p", "%m/%d/%Y %I:%M:%S %p")
GPS_SD_S, COMPUTER_SD_S = 0.01, 1.0
ZONE_SD_S = 6 * 3600.0  # of a computer's calendar without a stated time zone


class MicroStrain:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "microstrain"
    title = "MicroStrain CSV (MIP Monitor, SensorConnect)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        layout = _layout(head)
        fields = set() if layout is None else {_plain(name)[0] for name in layout.names} & OWN
        return 0.9 if len(fields) >= FEW and layout is not None and _is_theirs(layout.names) else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        with path.open("rb") as file:
            layout = _layout(file.read(HEAD))
        if layout is None:
            raise InputError(f"{path}: no line names columns of MicroStrain; export it again as CSV")
        account, naming = Account(), _of_one_device(layout.names)
        by_instrument = {naming(name)[0] for name in layout.names} & {REFERENCE, *(tow for _, tow, _ in GPS)}
        wanted = KNOWN if by_instrument else KNOWN | {COMPUTER}
        table = read_table(path, layout, naming, wanted, options.progress, {COMPUTER: _computer_time})
        account.count(table)
        time, clock = _stamps(path, table, account)
        found = measured_of(path, table, SOURCES, time, None, account)
        return recording_of_inertial(path, self.name, [*found, *_fixes(table, time)], clock, account, options)


FORMAT = MicroStrain()


def _layout(head: bytes) -> TextLayout | None:
    """The line that names the columns: the one behind ``DATA_START``, else the first that is not blank."""
    separator, decimal, at, behind = ",", ".", 0, START not in head
    for line in head.splitlines(keepends=True):
        at += len(line)
        key, _, value = line.strip().partition(b"=")
        if not behind:
            separator = SEPARATORS.get(value.lower(), separator) if key.endswith(b"ListSeparator") else separator
            decimal = DECIMALS.get(value.lower(), decimal) if key.endswith(b"DecimalSeparator") else decimal
            behind = line.strip(b'",;\t \r\n') == START
        elif line.strip():
            names = tuple(cells_of(line, separator))
            return TextLayout(names, at, separator, decimal) if len(names) > 1 and decimal != separator else None
    return None


def _plain(name: str) -> tuple[str, str]:
    """A name with its descriptor and without its device; and the unit that it states."""
    if found := DESCRIPTOR.match(name):
        return f"{name_and_unit(found[1])[0]} x{found[2].lower()}", ""
    return name_and_unit(name.rpartition(":")[2])


def _is_theirs(names: Sequence[str]) -> bool:
    """Whether names are written as only MicroStrain does: with a descriptor, or as MSCL does, ``scaledAccelX``."""
    return any(
        DESCRIPTOR.match(name) or (_plain(name)[0] in OWN and name.rpartition(":")[2][:1].islower()) for name in names
    )


def _of_one_device(names: Sequence[str]) -> Callable[[str], tuple[str, str]]:
    """Plain names of the first device that measures; those of others keep their prefix."""
    devices = [name.rpartition(":")[0] for name in names if _plain(name)[0] in VECTORS]
    first = devices[0] if devices else ""

    def naming(name: str) -> tuple[str, str]:
        device = name.rpartition(":")[0]
        return _plain(name) if device in ("", first) else (name, "")

    return naming


def _fixes(table: TextTable, time: Array) -> list[InertialMeasurement]:
    """Positions of the instrument's GNSS, where it marks them as valid."""
    for *names, flags in FIXES:
        if table.holds(*names[:2]):
            sd = table[names[2]] if names[2] in table else np.full(len(time), np.nan)
            lat, lon = (table[name] for name in names[:2])
            if flags in table:
                lat = np.where(flags_of(table[flags]) & VALID, lat, np.nan)
            return [InertialMeasurement("fix", "latitude, longitude", time, np.column_stack([lat, lon, sd]))]
    return []


def _stamps(path: Path, table: TextTable, account: Account) -> tuple[Array, Clock]:
    """Times of rows [s], NaN where there is none, and their clock."""
    for week, tow, flags in GPS:
        if table.holds(tow):
            return _by_gps(table, week, tow, flags, account)
    if table.holds(REFERENCE):
        return 1e-9 * table[REFERENCE], Clock(SINCE_START)
    if table.holds(COMPUTER):
        account.warnings.append("stamps are those of the computer, after the transport; export the instrument's time")
        time = table[COMPUTER]
        if not UNIX_S[0] < float(np.nanmedian(time)) < UNIX_S[1]:
            return time, Clock("the computer's time")
        account.notes.append("the computer's calendar is taken for UTC")
        return time, Clock("the computer's time", 0.0, ZONE_SD_S, "its calendar, taken for UTC")
    raise InputError(f"{path}: no column of time; export it with GPS time, reference time or Time")


def _by_gps(table: TextTable, week: str, tow: str, flags: str, account: Account) -> tuple[Array, Clock]:
    """Unix time where the instrument's clock was set, else the time since its start, which wraps after a week."""
    seconds = table[tow]
    weeks = table[week] if week in table else np.zeros(len(seconds))
    known = is_week(weeks) & np.isfinite(seconds)
    inertial = np.isfinite(np.column_stack([table[name] for name in table.columns if name in VECTORS])).any(axis=1)
    if flags in table:
        known &= ~inertial | (flags_of(table[flags]) & SET > 0)  # rows of its GNSS have other flags
    stamped = inertial & np.isfinite(seconds)
    if 2 * (known & stamped).sum() > stamped.sum():
        account.left["rows", "from before the instrument's clock was set"] += int((stamped & ~known).sum())
        time = np.where(known, unix_of_gps(np.where(known, weeks, 0.0), np.where(known, seconds, 0.0)), np.nan)
        return time, Clock("the instrument's GPS time", 0.0, GPS_SD_S, "GPS week and time of week")
    account.left["rows", "from after the instrument's clock was set"] += int((stamped & known).sum())
    account.notes.append("the instrument's clock was not set: its GPS time counts from its start")
    return unwrapped(np.where(known, np.nan, seconds), WEEK_S), Clock(SINCE_START)


def _computer_time(cell: str) -> float:
    """Seconds, of Unix time where the cell is a date or a number of that size.

    Raises
    ------
    ValueError : it is neither
    """
    try:
        number = float(cell)
    except ValueError:
        return _date(cell)
    return number * 1e-9 if number > 1e17 else number


def _date(cell: str) -> float:
    cell = re.sub(r"(\.\d{6})\d+", r"\1", cell)  # dates have six decimals
    for form in DATES:
        with contextlib.suppress(ValueError):
            return datetime.strptime(cell, form).replace(tzinfo=UTC).timestamp()
    return unix_of_text(cell)
