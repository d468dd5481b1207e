"""CSV exports of VectorNav's inertial units (VN-100 to VN-310), with the column names of its SDK.

Units are those of the binary outputs: m/s2, rad/s, gauss, degrees relative to NED, nanoseconds. Increments of angle are
in degrees.
"""

from pathlib import Path

import numpy as np

from rovgraph.dates import WEEK_S, is_week, unix_of_gps
from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_quaternion, rpy_from_matrix
from rovgraph.log.units import UNITS
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
from rovgraph.readers.text_table import TextLayout, TextTable, cells_of, read_table

NORTH = "the yaw is taken relative to magnetic north, as a VN-100 has it; else state heading.ahrs_reference: true"


def _imu(label: str, acc: str, gyr: str) -> InertialSource:
    vectors = Vector(xyz(acc), "acceleration", "m/s2"), Vector(xyz(gyr), "rate", "rad/s")
    return InertialSource("imu", label, vectors)


SOURCES = (
    _imu("UncompAcc, UncompGyro", "uncompacc", "uncompgyro"),
    _imu("UncompAccel, UncompGyro", "uncompaccel", "uncompgyro"),
    _imu("Accel, Gyro", "accel", "gyro"),
    _imu("Accel, AngularRate", "accel", "angularrate"),
    _imu("Acc, Gyro", "acc", "gyro"),
    InertialSource(
        "imu",
        "DeltaVel, DeltaTheta",
        (
            Vector(xyz("deltavel"), "acceleration", "m/s2", summed=True),
            Vector(xyz("deltatheta"), "rate", "deg/s", summed=True),
        ),
    ),
    InertialSource("mag", "Mag", (Vector(xyz("mag"), "field", "gauss"),)),
    InertialSource("mag", "UncompMag", (Vector(xyz("uncompmag"), "field", "gauss"),)),
    InertialSource(
        "ahrs",
        "Roll, Pitch, Yaw",
        (Vector(("roll", "pitch", "yaw"), "angle", "deg"),),
        f"Roll, Pitch, Yaw: {NORTH}",
    ),
)
QUATERNION = ("quatx", "quaty", "quatz", "quats")
FIX = tuple(f"gnss1{name}" for name in ("lat", "lon", "fix", "posuncertaintyn", "posuncertaintye"))
STARTUP, GPS, TOW, WEEK, STATUS = "timestartup", "timegps", "timegpstow", "timegpsweek", "timestatus"
STATUS_VALID = 0x3  # time of week and date are known
INTERVAL = "deltatime"
VECTORS = {name for source in SOURCES for vector in source.vectors for name in vector.names}
KNOWN = VECTORS | {*QUATERNION, *FIX, STARTUP, GPS, TOW, WEEK, STATUS, INTERVAL}
MARKS = {  # names that no other maker's columns have, as far as is known
    STARTUP, TOW, WEEK, "timesyncin", "timegpspps", "syncincnt", "syncoutcnt", "senssat", "imustatus", "insstatus",
    *xyz("uncompacc"), *xyz("uncompaccel"), *xyz("uncompgyro"), *xyz("uncompmag"), *QUATERNION,
}  # fmt: skip
FEW = 2  # of these
NS, GPS_SD_S = 1e-9, 0.01


class VectorNav:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "vectornav"
    title = "VectorNav CSV"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        layout = _layout(head)
        names = set() if layout is None else {name_and_unit(name)[0] for name in layout.names}
        timed = names & {STARTUP, GPS, TOW}
        return 0.85 if timed and len(names & MARKS) >= FEW and names & (VECTORS | {*QUATERNION}) else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        with path.open("rb") as file:
            layout = _layout(file.read(HEAD))
        if layout is None:
            raise InputError(f"{path}: no line names columns of VectorNav; export it again as CSV")
        table, account = read_table(path, layout, name_and_unit, KNOWN, options.progress), Account()
        account.count(table)
        time, clock = _stamps(path, table)
        step = float(np.nanmedian(table[INTERVAL])) if table.holds(INTERVAL) else None
        found = measured_of(path, table, SOURCES, time, step, account)
        found += [*_quaternions(table, time), *_fixes(table, time)]
        return recording_of_inertial(path, self.name, found, clock, account, options)


FORMAT = VectorNav()


def _layout(head: bytes) -> TextLayout | None:
    """The first line that is not blank."""
    at = 0
    for line in head.splitlines(keepends=True):
        at += len(line)
        if line.strip():
            names = tuple(cells_of(line))
            return TextLayout(names, at) if len(names) > 1 else None
    return None


def _seconds(table: TextTable, name: str) -> Array:
    """A column of time, in nanoseconds unless its name states another unit [s]."""
    return table[name] * UNITS["time"].get(table.columns[name].unit.lower(), NS)


def _stamps(path: Path, table: TextTable) -> tuple[Array, Clock]:
    """Times of rows [s], NaN without one, and their clock: that since the start, and what it lacks of UTC."""
    unix = _unix(table)
    if table.holds(STARTUP):
        time = _seconds(table, STARTUP)
        both = np.empty(0) if unix is None else (unix - time)[np.isfinite(unix - time)]
        if not len(both):
            return time, Clock(SINCE_START)
        return time, Clock(SINCE_START, float(np.median(both)), GPS_SD_S, "GPS time of the same rows")
    if unix is None:
        raise InputError(f"{path}: has no time; export it with TimeStartup, TimeGps, or TimeGpsTow and TimeGpsWeek")
    return unix, Clock("the instrument's GPS time", 0.0, GPS_SD_S, "GPS time of the rows")


def _unix(table: TextTable) -> Array | None:
    """Unix time of each row, NaN while the instrument had none; None if it never had it."""
    if table.holds(GPS):
        week, seconds = np.divmod(_seconds(table, GPS), WEEK_S)
    elif table.holds(TOW, WEEK):
        week, seconds = table[WEEK], _seconds(table, TOW)
    else:
        return None
    known = is_week(week) & np.isfinite(seconds)
    if STATUS in table:
        known &= flags_of(table[STATUS]) & STATUS_VALID == STATUS_VALID
    unix = unix_of_gps(np.where(known, week, 0.0), np.where(known, seconds, 0.0))
    return np.where(known, unix, np.nan) if known.any() else None


def _quaternions(table: TextTable, time: Array) -> list[InertialMeasurement]:
    """Attitude as quaternions from the instrument's axes to NED, the scalar last."""
    if not table.holds(*QUATERNION):
        return []
    return [attitude_of("Quat", time, np.column_stack([table[name] for name in QUATERNION]))]


def attitude_of(label: str, time: Array, xyzw: Array) -> InertialMeasurement:
    """An attitude that is given by quaternions, shape (n, 4), scalar last; what is no rotation is left out."""
    return InertialMeasurement("ahrs", label, time, rpy_from_matrix(matrix_from_quaternion(xyzw)), f"{label}: {NORTH}")


def _fixes(table: TextTable, time: Array) -> list[InertialMeasurement]:
    """The GNSS receiver's positions, where it marks them as fixes of two or three dimensions."""
    if not table.holds(*FIX[:3]):
        return []
    sds = [table[name] if name in table else np.full(len(time), np.nan) for name in FIX[3:]]
    return [gnss("Gnss1Lat, Gnss1Lon", time, *(table[name] for name in FIX[:3]), *sds)]


def gnss(
    label: str, time: Array, lat: Array, lon: Array, kind: Array, north: Array, east: Array
) -> InertialMeasurement:
    """Fixes of a GNSS receiver [deg], with their kind and their sd to the north and to the east [m]."""
    values = np.column_stack([np.where(kind >= 2.0, lat, np.nan), lon, np.sqrt(0.5 * (north**2 + east**2))])
    return InertialMeasurement("fix", label, time, values)
