"""VectorNav's CSV exports (VN-100 to VN-310): names of columns as its SDK and Sensor Explorer write them.

Units are those of the binary outputs: m/s2, rad/s, gauss, degrees in NED, nanoseconds. Times of week are nanoseconds
too, but seconds in exports of ASCII messages: what is larger than a week of seconds tells.
"""

from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.gps_time import WEEK_S, WEEKS, unix_of_gps
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
from rovgraph.interchange.text_table import Layout, cells_of, read_columns


def _xyz(name: str) -> tuple[str, ...]:
    return tuple(f"{name}{axis}" for axis in "xyz")


CHOICES = {
    "acc": (
        Choice(_xyz("uncompacc"), "acceleration", "m/s2"),
        Choice(_xyz("uncompaccel"), "acceleration", "m/s2"),
        Choice(_xyz("accel"), "acceleration", "m/s2"),
        Choice(_xyz("acc"), "acceleration", "m/s2"),
        Choice(_xyz("deltavel"), "acceleration", "m/s2", summed=True),
    ),
    "gyr": (
        Choice(_xyz("uncompgyro"), "rate", "rad/s"),
        Choice(_xyz("gyro"), "rate", "rad/s"),
        Choice(_xyz("angularrate"), "rate", "rad/s"),
        Choice(_xyz("deltatheta"), "rate", "deg/s", summed=True),
    ),
    "mag": (
        Choice(_xyz("uncompmag"), "field", "gauss"),
        Choice(_xyz("mag"), "field", "gauss"),
    ),
    "rpy": (Choice(("roll", "pitch", "yaw"), "angle", "deg"),),
}
KNOWN = {name for choices in CHOICES.values() for choice in choices for name in choice.names}
FIX = tuple(f"gnss1{name}" for name in ("lat", "lon", "posuncertaintyn", "posuncertaintye", "fix"))
STARTUP, GPS, TOWS, WEEK_NAMES = "timestartup", "timegps", ("timegpstow", "gpstow"), ("timegpsweek", "gpsweek")
STATUS, STATUS_VALID = "timestatus", 0x3  # time of week and date are known
INTERVAL = "deltatime"
TIMES = (STARTUP, GPS, *TOWS, *WEEK_NAMES, STATUS, INTERVAL)
MARKS = {STARTUP, GPS, *TOWS[:1], *WEEK_NAMES[:1], "insstatus", "imustatus", "syncincnt", "sensesat", "quats",
         *_xyz("uncompacc"), *_xyz("uncompgyro"), *_xyz("uncompmag"), "timesyncin", "timegpspps"}  # fmt: skip
FEW = 2  # of those, beside columns that are read
NS = 1e-9
GPS_SD_S = 0.01
LEFT = {
    "quat": "an attitude; Roll, Pitch, Yaw are read",
    "dcm": "an attitude; Roll, Pitch, Yaw are read",
    "pressure": "pressure of the housing",
    "temperature": "temperature of the IMU",
    "linaccel": "acceleration without gravity, by the instrument's own filter",
    "pos": "position, by the instrument's own filter",
    "vel": "velocity, by the instrument's own filter",
    "gnss2": "of the second GNSS receiver",
    "accel": "another acceleration is read",
    "gyro": "another rate is read",
    "mag": "another field is read",
}


class VectorNav:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "vectornav"
    title = "VectorNav CSV export"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        layout = _layout(head)
        names = set() if layout is None else {stem_and_unit(name)[0] for name in layout.names}
        marks = len(names & MARKS)
        return 0.85 if marks and len(names & (MARKS | KNOWN)) >= 3 and (marks >= FEW or names & set(TIMES)) else 0.0

    def read(self, path: Path, options: Options) -> Recording:
        with path.open("rb") as file:
            layout = _layout(file.read(HEAD))
        if layout is None:
            raise InputError(f"{path}: no line names columns of VectorNav; export it again as CSV")
        names = [stem_and_unit(name) for name in layout.names]
        wanted = [k for k, (name, _) in enumerate(names) if name in KNOWN or name in TIMES or name in FIX]
        columns = read_columns(path, layout, wanted, (), options.progress)
        say = Account()
        found = {part: take(path, names, columns.numbers, choices, say) for part, choices in CHOICES.items()}
        found["fix"] = _fix(names, columns.numbers, say)
        time, clock = _stamps(path, names, columns.numbers, say)
        step = _step(names, columns.numbers, time, found, say)
        say.unused(
            names, columns, lambda name: next((why for key, why in LEFT.items() if name.startswith(key)), UNUSED)
        )
        return inertial_recording(path, self.name, clock, time, found, step, say)


FORMAT = VectorNav()


def _layout(head: bytes) -> Layout | None:
    at = 0
    for line in head.splitlines(keepends=True):
        at += len(line)
        if line.strip():
            names = tuple(cells_of(line.decode("utf-8-sig", "replace")))
            return Layout(names, at) if len(names) > 1 else None
    return None


def _column(names: Names, values: dict[int, Array], *wanted: str) -> tuple[int, Array] | None:
    """The first of some columns that is there and holds something."""
    for name in wanted:
        k = index_of(names, name)
        if k >= 0 and np.isfinite(values[k]).any():
            return k, values[k]
    return None


def _stamps(path: Path, names: Names, values: dict[int, Array], say: Account) -> tuple[Array, Clock]:
    """Times of rows [s], NaN = none, and their clock: that since the start, and what it lacks of Unix time."""
    startup, unix = _column(names, values, STARTUP), _unix(names, values, say)
    if startup is None and unix is None:
        raise InputError(f"{path}: has no time; export it with TimeStartup, TimeGps, or TimeGpsTow with TimeGpsWeek")
    if startup is None:
        return np.asarray(unix), Clock("the instrument's GPS time", 0.0, GPS_SD_S, "GPS time of the rows")
    say.used.add(startup[0])
    time = NS * startup[1]
    name = "the instrument's time since its start"
    both = np.empty(0) if unix is None else (unix - time)[np.isfinite(unix - time)]
    if not len(both):
        return time, Clock(name)
    return time, Clock(name, float(np.median(both)), GPS_SD_S, "GPS time of the same rows")


def _unix(names: Names, values: dict[int, Array], say: Account) -> Array | None:
    """Unix time of each row, NaN where the instrument did not know it; None where it never did."""
    whole, tow, week = (_column(names, values, *each) for each in ((GPS,), TOWS, WEEK_NAMES))
    if whole is not None:
        say.used.add(whole[0])
        seconds = NS * whole[1]
    elif tow is not None and week is not None:
        say.used.update((tow[0], week[0]))
        in_ns = float(np.nanmax(tow[1])) > WEEK_S
        say.notes.append(f"{names[tow[0]][0]} is in {'nanoseconds' if in_ns else 'seconds'}, by its size")
        seconds = WEEK_S * week[1] + (NS if in_ns else 1.0) * tow[1]
    else:
        return None
    known = (seconds >= WEEKS[0] * WEEK_S) & (seconds <= WEEKS[1] * WEEK_S)
    if (status := _column(names, values, STATUS)) is not None:
        say.used.add(status[0])
        known &= np.nan_to_num(status[1]).clip(0.0, 2.0**31).astype(np.int64) & STATUS_VALID == STATUS_VALID
    return np.where(known, unix_of_gps(np.where(known, seconds, 0.0)), np.nan) if known.any() else None


def _step(names: Names, values: dict[int, Array], time: Array, found: dict[str, Found | None], say: Account) -> float:
    """Over which increments are summed [s]: as the file states it, else the usual step of the stamps."""
    if (stated := _column(names, values, INTERVAL)) is not None:
        say.used.add(stated[0])
        return float(np.nanmedian(stated[1]))
    steps = np.diff(time[np.isfinite(time)])
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else np.nan


def _fix(names: Names, values: dict[int, Array], say: Account) -> Found | None:
    """The GNSS receiver's positions, where it says that they are fixes of two or three dimensions."""
    at = [index_of(names, name) for name in FIX]
    if -1 in at:
        return None
    say.used.update(at)
    lat, lon, north, east, fix = (values[k] for k in at)
    sd = np.sqrt(0.5 * (north**2 + east**2))
    made = np.column_stack([np.where(fix >= 2.0, lat, np.nan), lon, sd])
    return Found(made, ", ".join(FIX[:2]), Choice(FIX, "latitude", "deg"))
