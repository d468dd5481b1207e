"""Exports of inertial units as channels of a log: units of columns, axes, and the world of an attitude.

Where a file states no unit, that of the maker's documentation counts, unless gravity or an instrument's range rules it
out. Gravity also tells whether z points up, and whether an attitude is relative to NED or to ENU.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, rpy_from_matrix
from rovgraph.log.units import UNITS, known_unit, name_and_bracket
from rovgraph.readers.ardupilot import new_fixes
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.recording import Channel, Clock, Left, Recording, preferred_first, too_slow
from rovgraph.readers.text_table import TextTable

WORLDS = {  # to NED, of the coordinate systems that instruments have
    "ENU": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    "NWU": np.diag([1.0, -1.0, -1.0]),
    "NED": np.eye(3),
}
COLUMNS = {
    "imu": ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"),
    "mag": ("mag_x", "mag_y", "mag_z"),
    "ahrs": ("ahrs_roll", "ahrs_pitch", "ahrs_yaw"),
    "fix": ("fix_lat", "fix_lon", "fix_sd"),
}
AXES = "the IMU's"
SINCE_START = "the instrument's time since its start"
GRAVITY = 7.0, 13.0  # medians of a vehicle's acceleration [m/s^2]
MOST = {"rate": 40.0, "angle": 2.0 * np.pi + 0.01}  # no instrument gives more [rad/s], [rad]
OTHERS = {"acceleration": ("m/s2", "g", "mg"), "rate": ("deg/s",), "angle": ("deg",)}  # than the documented unit


@dataclass(frozen=True)
class Vector:
    """Columns of three axes.

    Attributes
    ----------
    names : plain names
    quantity : "acceleration", "rate", "field" or "angle"
    unit : that the maker documents
    summed : over the time between rows
    """

    names: tuple[str, ...]
    quantity: str
    unit: str
    summed: bool = False


@dataclass(frozen=True)
class InertialSource:
    """Columns that may feed a sensor.

    Attributes
    ----------
    sensor : "imu", "mag" or "ahrs"
    label : what a user chooses it by
    vectors : of an IMU acceleration and rate; one of the others
    warning : a sentence, where it is what the log is made of
    """

    sensor: str
    label: str
    vectors: tuple[Vector, ...]
    warning: str = ""


@dataclass(frozen=True)
class InertialMeasurement:
    """Measurements of a sensor.

    Attributes
    ----------
    sensor, label, warning : of a `InertialSource`
    time : ndarray, shape (n,) [s]
    values : ndarray, shape (n, k), columns as in `COLUMNS`, SI and radians, a field in microtesla
    world : of an attitude, a key of `WORLDS`; "" = found by gravity
    true_north : an attitude's yaw is relative to it, not to magnetic north
    """

    sensor: str
    label: str
    time: Array
    values: Array
    warning: str = ""
    world: str = ""
    true_north: bool = False

    def whole(self, account: "Account") -> "InertialMeasurement":
        """The rows that have a time and all values, but for the sd of a fix; rows that have some are counted."""
        values = np.where(np.isfinite(self.values), self.values, np.nan)
        there = np.isfinite(values[:, :2] if self.sensor == "fix" else values)
        keep = np.isfinite(self.time) & there.all(axis=1)
        account.left[self.label, "rows without a time"] += int((there.all(axis=1) & ~keep).sum())
        account.left[self.label, "rows that lack some of the values"] += int((there.any(axis=1) & ~there.all(1)).sum())
        return replace(self, time=self.time[keep], values=values[keep])


@dataclass
class Account:
    """Warnings and settings of a file.

    Attributes
    ----------
    notes, warnings : a sentence each
    left : name and reason -> how many
    """

    notes: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    left: Counter[tuple[str, str]] = field(default_factory=Counter)

    def count(self, table: TextTable) -> None:
        """Count the unread parts of a table: rows, and columns without a measurement of a log."""
        self.left.update({("rows", why): count for why, count in table.left.items()})
        self.left["columns", f"no measurement that a log has: {', '.join(table.others)[:120]}"] += len(table.others)


def xyz(name: str) -> tuple[str, ...]:
    """Plain names of the columns of three axes."""
    return tuple(f"{name}{axis}" for axis in "xyz")


def flags_of(values: Array) -> NDArray[np.int64]:
    """Bits that a column of numbers holds, shape (n,); none where there is no number."""
    return np.nan_to_num(values).clip(0.0, 2.0**31).astype(np.int64)


def name_and_unit(written: str) -> tuple[str, str]:
    """A column's name in small letters without blanks, and the unit that it states in brackets, "" = none."""
    name, unit = name_and_bracket(written)
    return re.sub(r"[\s_]", "", name).lower(), unit


def measured_of(
    path: Path, table: TextTable, sources: Sequence[InertialSource], time: Array, step: float | None, account: Account
) -> list[InertialMeasurement]:
    """Measured quantities in the columns of a table.

    Parameters
    ----------
    time : ndarray, shape (n,), of the rows [s]
    step : over which increments are summed [s]; None = the usual one between rows that have them

    Raises
    ------
    InputError : axes of one vector in several units, or in an unknown one
    """
    found = []
    for source in sources:
        if all(table.holds(*vector.names) for vector in source.vectors):
            values = [_vectors(path, table, vector, time, step, account) for vector in source.vectors]
            found.append(InertialMeasurement(source.sensor, source.label, time, np.hstack(values), source.warning))
    return found


def _vectors(path: Path, table: TextTable, vector: Vector, time: Array, step: float | None, account: Account) -> Array:
    values = np.column_stack([table[name] for name in vector.names])
    columns = [table.columns[name] for name in vector.names]
    if vector.summed:
        values = values / (_usual_step(time, values) if step is None else step)
    if len({column.unit for column in columns}) > 1:
        told = ", ".join(f"{column.name} in {column.unit or 'no stated unit'}" for column in columns)
        raise InputError(f"{path}: axes of one vector are in different units: {told}; export it again in one")
    unit, shown = columns[0].unit, ", ".join(column.name for column in columns)
    if vector.summed:  # the unit that is stated is that of the increment
        return values * UNITS[vector.quantity][vector.unit]
    if unit:
        return values * _factor(path, shown, vector.quantity, unit)
    return values * _documented(values, vector, shown, account)


def _usual_step(time: Array, values: Array) -> float:
    steps = np.diff(time[np.isfinite(values).all(axis=1)])
    return float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else np.nan


def _factor(path: Path, shown: str, quantity: str, unit: str) -> float:
    known = known_unit(quantity, unit)
    if known is None:
        raise InputError(f"{path}: {shown}: unknown unit {unit!r}; expected one of: {', '.join(UNITS[quantity])}")
    return UNITS[quantity][known]


def _documented(values: Array, vector: Vector, shown: str, account: Account) -> float:
    """Factor of the documented unit, or of another one where that is impossible."""
    factors = UNITS[vector.quantity]
    if vector.quantity not in OTHERS or not np.isfinite(values).any():
        return factors[vector.unit]
    with np.errstate(over="ignore", invalid="ignore"):
        if vector.quantity == "acceleration":
            size = float(np.nanmedian(np.linalg.norm(values, axis=1)))
            low, high = GRAVITY
        else:
            size = float(np.nanpercentile(np.abs(values), 99.0))
            low, high = 0.0, MOST[vector.quantity]
    fitting = [unit for unit in (vector.unit, *OTHERS[vector.quantity]) if low <= factors[unit] * size <= high]
    if not fitting:
        text = f"{shown}: {size * factors[vector.unit]:.3g} {next(iter(factors))} is usual, which is unlikely"
        account.warnings.append(f"{text}; check the units")
    elif fitting[0] != vector.unit:
        text = f"{shown}: taken in {fitting[0]}, as {size:.3g} is impossible in the documented {vector.unit}"
        account.warnings.append(f"{text}; check the export's units")
        return factors[fitting[0]]
    return factors[vector.unit]


def recording_of_inertial(
    path: Path,
    format_: str,
    found: Sequence[InertialMeasurement],
    clock: Clock,
    account: Account,
    options: ReadingOptions,
) -> Recording:
    """Channels of what was found, the preferred source of a sensor first.

    Parameters
    ----------
    clock : of all times

    Raises
    ------
    InputError : neither an IMU nor an attitude with a time
    SourceMissing : none of a sensor's sources is called as the user chose it
    """
    whole = [made for each in found if len((made := each.whole(account)).time)]
    first: dict[str, InertialMeasurement] = {}
    channels: list[Channel] = []
    for sensor in COLUMNS:
        of = {each.label: each for each in whole if each.sensor == sensor}
        for label in preferred_first(path, sensor, list(of), options.choose):
            first.setdefault(sensor, of[label])
            channel = _channel(of[label], first.get("imu"), clock, account)
            channels += [channel] if len(channel.columns["time"]) else []
    if not first.keys() & {"imu", "ahrs"}:
        raise InputError(f"{path}: holds no row with a time and acceleration, rate or attitude; export it with them")
    settings: dict[str, Any] = {}
    if (imu := first.get("imu")) is None:
        account.warnings.append("no acceleration with a rate of turn: the attitude alone is read")
    else:
        up = bool(np.nanmedian(imu.values[:, 2]) > 0.0)
        settings["imu"] = {"mount_rpy_deg": [180.0 if up else 0.0, 0.0, 0.0]}
        axes = "x forward, y left, z up" if up else "x forward, y right, z down"
        account.warnings.append(f"the IMU's axes are taken as {axes}, as gravity has it: check the mounting")
        account.warnings += too_slow(imu.time, imu.label, "export at 50 Hz or more")
    if "ahrs" in first and first["ahrs"].true_north:
        settings["heading"] = {"ahrs_reference": "true"}
    account.warnings += [each.warning for each in first.values() if each.warning]
    left = tuple(Left(name, count, why) for (name, why), count in sorted(account.left.items()) if count)
    said = tuple(dict.fromkeys(account.notes)), tuple(dict.fromkeys(account.warnings))
    return Recording(str(path), format_, tuple(channels), {clock.name: clock}, left, settings, *said)


def _channel(measured: InertialMeasurement, imu: InertialMeasurement | None, clock: Clock, account: Account) -> Channel:
    time, values, frame = measured.time, measured.values, AXES
    if measured.sensor == "fix":
        new = new_fixes(time, values[:, 0], values[:, 1])
        account.left[measured.label, "no fix, or the one before repeated"] += int((~new).sum())
        time, values, frame = time[new], values[new], ""
    if measured.sensor == "ahrs":
        values = _in_ned(measured, imu, account)
        frame = f"{AXES}, relative to {'true' if measured.true_north else 'magnetic'} north"
    columns = dict(zip(COLUMNS[measured.sensor], values.T, strict=True))
    return Channel(measured.sensor, {"time": time, **columns}, measured.label, frame, clock.name)


def _in_ned(measured: InertialMeasurement, imu: InertialMeasurement | None, account: Account) -> NDArray[np.float64]:
    """Roll, pitch and yaw of the IMU's axes relative to NED, shape (n, 3)."""
    world, R = measured.world, matrix_from_rpy(measured.values)
    if not world:
        force = np.array([0.0, 0.0, -1.0]) if imu is None else np.nanmedian(imu.values[:, :3], axis=0)
        world = "ENU" if imu is not None and np.nanmedian(R[:, 2, :] @ force) > 0.0 else "NED"
        if world == "ENU":
            text = f"{measured.label}: gravity says that z of its world points up, so it is taken relative to ENU"
            account.warnings.append(f"{text}; NED is documented")
    return measured.values if world == "NED" else rpy_from_matrix(WORLDS[world] @ R)
