"""Named columns of an inertial unit as a recording: units as the names state them, axes as gravity shows them."""

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.interchange.fixes import new_fixes
from rovgraph.interchange.rates import too_slow
from rovgraph.interchange.recording import Channel, Clock, Left, Recording
from rovgraph.interchange.text_table import Columns
from rovgraph.log.units import UNITS

Names = Sequence[tuple[str, str]]  # of columns: in small letters, and the unit that the file states

AXES = ("x", "y", "z")
STATED = re.compile(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]$")
ALIASES = {"dps": "deg/s", "°/s": "deg/s", "m/s²": "m/s2", "G": "gauss", "Gauss": "gauss", "µT": "uT", "°": "deg"}
UNUSED = "no measurement that a log has"
MAGNETIC = "heading taken relative to magnetic north"


@dataclass(frozen=True)
class Choice:
    """Columns of one quantity.

    Attributes
    ----------
    names : of the columns, in small letters
    quantity : what they measure, a key of `UNITS`
    unit : that they are in where the file states none
    note : said where they are taken
    summed : they are increments: the unit holds once they are divided by their interval
    """

    names: tuple[str, ...]
    quantity: str
    unit: str
    note: str = ""
    summed: bool = False


@dataclass(frozen=True)
class Found:
    """Columns that were taken.

    Attributes
    ----------
    data : ndarray, shape (n, k), SI and radians
    source : their names and unit
    choice : what they are
    """

    data: Array
    source: str
    choice: Choice


@dataclass
class Account:
    """What is said of a file.

    Attributes
    ----------
    used : indices of columns that went into the log or its stamps
    left : name and reason -> how many
    """

    used: set[int] = field(default_factory=set)
    left: dict[tuple[str, str], int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def unused(self, names: Names, columns: Columns, why: Callable[[str], str]) -> None:
        """Count columns that were not used, and rows that are none; ``why`` gives the reason by a column's name."""
        for k, (name, _) in enumerate(names):
            if k not in self.used and name:
                key = name, why(name)
                self.left[key] = self.left.get(key, 0) + int(columns.filled[k])
        self.left |= {("rows", reason): count for reason, count in columns.left.items()}


def stem_and_unit(name: str) -> tuple[str, str]:
    """A column's name in small letters, and the unit in brackets behind it, "" without one."""
    found = STATED.match(name.strip())
    return (found[1].lower(), found[2]) if found else (name.strip().lower(), "")


def index_of(names: Names, name: str) -> int:
    """The first column of a name, -1 where there is none."""
    return next((k for k, (each, _) in enumerate(names) if each == name), -1)


def take(
    path: Path, names: Names, values: Mapping[int, Array], choices: Sequence[Choice], say: Account
) -> Found | None:
    """The first choice whose columns are all there and hold something.

    Parameters
    ----------
    names : name in small letters, and stated unit, of each column
    values : index of a column -> ndarray, shape (n,)

    Raises
    ------
    InputError : a stated unit that is none of the quantity
    """
    for choice in choices:
        at = [index_of(names, name) for name in choice.names]
        if -1 in at:
            continue
        data = np.column_stack([values[k] for k in at])
        if not np.isfinite(data).all(axis=1).any():
            continue
        units = [_unit(path, choice, *names[k]) for k in at]
        if len(set(units)) > 1:
            say.warnings.append(
                f"{', '.join(choice.names)} state different units ({', '.join(units)}): each is its own"
            )
        say.used.update(at)
        if choice.note:
            say.notes.append(choice.note)
        factor = np.array([UNITS[choice.quantity][unit] for unit in units])
        unit = ", ".join(dict.fromkeys(units)) if not choice.summed else f"increments of {units[0]} times s"
        return Found(data * factor, f"{', '.join(choice.names)} ({unit})", choice)
    return None


def _unit(path: Path, choice: Choice, name: str, stated: str) -> str:
    known = UNITS[choice.quantity]
    unit = ALIASES.get(stated, stated) if stated and not choice.summed else choice.unit
    if unit not in known:
        raise InputError(f"{path}: {name} states the unit {stated!r}, expected one of: {', '.join(known)}")
    return unit


def inertial_recording(
    path: Path, format_: str, clock: Clock, time: Array, found: Mapping[str, Found | None], step: float, say: Account
) -> Recording:
    """Channels of what was found, along the instrument's axes.

    Parameters
    ----------
    time : ndarray, shape (n,), of each row, NaN = none [s]
    found : "acc", "gyr", "mag" (n, 3); "rpy" in NED (n, 3); "fix" latitude, longitude [deg], sd [m] (n, 3)
    step : over which increments are summed, before the stamp [s]

    Raises
    ------
    InputError : neither an inertial unit nor an attitude at times
    """
    channels = [*_imu(clock, time, found, step)]
    settings: dict[str, Any] = {}
    if channels:
        imu = channels[0].columns
        up = bool(np.mean(imu["acc_z"]) > 0.0)
        settings["imu"] = {"mount_rpy_deg": [180.0 if up else 0.0, 0.0, 0.0]}
        axes = "x forward, y left, z up" if up else "x forward, y right, z down"
        say.warnings.append(f"the IMU's axes are taken as {axes}, as gravity has it: check the mounting")
        say.warnings += too_slow(imu["time"], channels[0].source, "record at 50 Hz or more")
    if (field_ := found.get("mag")) is not None:
        channels += _vectors("mag", clock, time, field_)
    if (angles := found.get("rpy")) is not None:
        rows = np.isfinite(time) & np.isfinite(angles.data).all(axis=1)
        roll, pitch, yaw = angles.data[rows].T
        columns = {"time": time[rows], "ahrs_roll": roll, "ahrs_pitch": pitch, "ahrs_yaw": wrap_angle(yaw)}
        channels += [Channel("ahrs", columns, f"{angles.source}, NED", "the IMU's", clock.name)] if rows.any() else []
        say.notes.append(f"{angles.source}: {MAGNETIC}")
    if (fixes := found.get("fix")) is not None:
        channels += _fixes(clock, time, fixes, say)
    if not any(channel.sensor in ("imu", "ahrs") for channel in channels):
        raise InputError(
            f"{path}: no row has acceleration with a rate of turn, or an attitude, at a time; record these with a time"
        )
    if channels[0].sensor != "imu":
        say.warnings.append("no acceleration with a rate of turn: attitude alone; record both for an IMU")
    left = tuple(Left(name, count, why) for (name, why), count in sorted(say.left.items()) if count)
    clocks = {clock.name: clock}
    return Recording(str(path), format_, tuple(channels), clocks, left, settings, tuple(say.notes), tuple(say.warnings))


def _imu(clock: Clock, time: Array, found: Mapping[str, Found | None], step: float) -> list[Channel]:
    acc, gyr = found.get("acc"), found.get("gyr")
    if acc is None or gyr is None:
        return []
    f, w = (each.data / step if each.choice.summed else each.data for each in (acc, gyr))
    rows = np.isfinite(time) & np.isfinite(f).all(axis=1) & np.isfinite(w).all(axis=1)
    if not rows.any():
        return []
    half = 0.5 * step if acc.choice.summed and gyr.choice.summed else 0.0  # a mean is of its interval's middle
    columns = {"time": time[rows] - half}
    columns |= {f"acc_{a}": f[rows, k] for k, a in enumerate(AXES)}
    columns |= {f"gyr_{a}": w[rows, k] for k, a in enumerate(AXES)}
    return [Channel("imu", columns, f"{acc.source}; {gyr.source}", "the IMU's", clock.name)]


def _vectors(sensor: str, clock: Clock, time: Array, found: Found) -> list[Channel]:
    rows = np.isfinite(time) & np.isfinite(found.data).all(axis=1)
    columns = {"time": time[rows]} | {f"{sensor}_{a}": found.data[rows, k] for k, a in enumerate(AXES)}
    return [Channel(sensor, columns, found.source, "the IMU's", clock.name)] if rows.any() else []


def _fixes(clock: Clock, time: Array, found: Found, say: Account) -> list[Channel]:
    lat, lon, sd = found.data.T
    rows = np.flatnonzero(np.isfinite(time) & np.isfinite(lat) & np.isfinite(lon))
    new = rows[new_fixes(time[rows], lat[rows], lon[rows])]
    say.left["fix", "nowhere on Earth, or the one before repeated"] = len(rows) - len(new)
    columns = {"time": time[new], "fix_lat": lat[new], "fix_lon": lon[new], "fix_sd": sd[new]}
    return [Channel("fix", columns, found.source, "", clock.name)] if len(new) else []
