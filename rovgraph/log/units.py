"""Units of a file's columns, converted to SI on reading and to degrees for a person; hints for misspelled names.

A unit is declared for a column (``gyr_x: deg/s``) or for a group of columns (``gyr: deg/s``); everything becomes SI and
radians. A minus before the unit turns the sign (``depth: -m``). The axes of an attitude are declared in the same way
(``ahrs: enu``).
"""

import difflib
import math
import re
from collections.abc import Container, Iterable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from rovgraph.dates import EPOCHS, unix_of_epoch
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.streams import LAT_LON, OF_GRID, SHIP_LAT_LON, all_columns
from rovgraph.model.config_sections import FOOT_M
from rovgraph.sensors import SENSORS

_DEG = float(np.deg2rad(1.0))
_G = 9.80665  # standard gravity [m/s2]
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": FOOT_M}
_ANGLE = {"rad": 1.0, "deg": _DEG}

# kind of quantity -> unit -> factor to the unit used inside
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "duration": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "acceleration": {"m/s2": 1.0, "m/s^2": 1.0, "g": _G, "mg": 1e-3 * _G},
    "rate": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEG},
    "field": {"uT": 1.0, "nT": 1e-3, "mG": 0.1, "gauss": 100.0},
    "angle": _ANGLE,
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3, "ft/s": FOOT_M},
    "length": _LENGTH,
    "area": {f"{unit}2": factor**2 for unit, factor in _LENGTH.items()},
    "pressure": {
        "Pa": 1.0,
        "mbar": 1e2,
        "hPa": 1e2,
        "kPa": 1e3,
        "MPa": 1e6,
        "bar": 1e5,
        "dbar": 1e4,
        "psi": 6894.757293168,
    },
    "latitude": {"deg": 1.0, "degE7": 1e-7, "rad": 1.0 / _DEG},
}
# kind of quantity -> units that no factor converts
FORMS: dict[str, tuple[str, ...]] = {"latitude": ("ddmm",), "time": tuple(EPOCHS)}

# how a heading counts -> sense, and heading of its zero [rad]; "enu" and "nwu" are of axes forward, port, up
ANGLES = {"ned": (1.0, 0.0), "enu": (-1.0, 0.5 * np.pi), "nwu": (-1.0, 0.0), "east": (1.0, 0.5 * np.pi)}
# group -> roll, pitch, yaw; how far roll is turned by axes that point up: an IMU's stay as they are, a mounting follows
_ATTITUDES: dict[str, tuple[tuple[str, str, str], float]] = {
    "ahrs": (("ahrs_roll", "ahrs_pitch", "ahrs_yaw"), np.pi),
    "attitude": (("roll", "pitch", "heading"), 0.0),
    "dvl_heading": (("", "", "dvl_heading"), 0.0),
    "ship_heading": (("", "", "ship_heading"), 0.0),
}

_Values = TypeVar("_Values", float, Array)

_SPELLINGS = {  # as other programs write units, in small letters
    "m/s²": "m/s2", "m/s/s": "m/s2", "m/sec^2": "m/s2", "m/sec2": "m/s2", "m/sec/sec": "m/s2", "mps2": "m/s2",
    "ms2": "m/s2", "m/s/2": "m/s2", "mps": "m/s", "m/sec": "m/s",
    "rad/sec": "rad/s", "radians/s": "rad/s", "rads": "rad/s", "rps": "rad/s", "dps": "deg/s", "°/s": "deg/s",
    "deg/sec": "deg/s", "degrees/s": "deg/s", "degs": "deg/s", "radians": "rad", "degrees": "deg", "°": "deg",
    "e7": "dege7", "µt": "ut", "μt": "ut", "microtesla": "ut", "mgauss": "mg",
    "m²": "m2", "m^2": "m2", "meters": "m", "metres": "m", "meter": "m", "metre": "m",
    "feet": "ft", "foot": "ft", "ft/sec": "ft/s", "feet/s": "ft/s", "fps": "ft/s", "ft²": "ft2", "ft^2": "ft2",
    "sec": "s", "secs": "s", "seconds": "s", "msec": "ms", "usec": "us", "µs": "us", "μs": "us", "nsec": "ns",
}  # fmt: skip
_STATED = re.compile(r"^(.*?)\s*[\[(]([^\])]*)[\])]\s*$")


def name_and_bracket(written: str) -> tuple[str, str]:
    """A column's name, and the unit that it states in brackets, "" = none.

    >>> name_and_bracket("Gyro X [deg/s]"), name_and_bracket("depth")
    (('Gyro X', 'deg/s'), ('depth', ''))
    """
    stated = _STATED.match(written)
    return (stated[1], stated[2].strip()) if stated else (written, "")


def known_unit(quantity: str, written: str) -> str | None:
    """The unit of a quantity, both keys of `UNITS`, that a text means; None = none that is known.

    >>> known_unit("rate", "dps"), known_unit("field", "G"), known_unit("speed", "kn")
    ('deg/s', 'gauss', None)
    """
    known = {name.lower(): name for name in UNITS[quantity]}
    plain = written.lower()
    plain = plain if plain in known else _SPELLINGS.get(plain, "gauss" if plain == "g" else plain)
    return known.get(plain)


def groups() -> dict[str, tuple[str, ...]]:
    """The columns that share a unit, by the name that a configuration gives them."""
    out: dict[str, tuple[str, ...]] = {"time": ("time",)}
    for sensor in SENSORS.values():
        for column in sensor.columns:
            if column.quantity is not None:
                group = column.group or sensor.name
                out[group] = (*out.get(group, ()), column.name)
    out["fix"] += (*LAT_LON, *OF_GRID[LAT_LON])
    out["ship"] += (*SHIP_LAT_LON, *OF_GRID[SHIP_LAT_LON])
    return out


def quantities() -> dict[str, str]:
    """Column -> what it measures, a key of `UNITS`."""
    measured = [c for sensor in SENSORS.values() for c in sensor.columns if c.quantity is not None]
    angles = dict.fromkeys((*LAT_LON, *SHIP_LAT_LON), "latitude")
    of_grid = dict.fromkeys((*OF_GRID[LAT_LON], *OF_GRID[SHIP_LAT_LON]), "length")
    return {"time": "time", **{c.name: str(c.quantity) for c in measured}, **angles, **of_grid}


def nearest(name: str, known: Iterable[str]) -> str:
    """The known name most like ``name``, capitals and blanks aside; "" where nothing is known."""
    plain = {k.strip().lower(): k for k in known}
    near = difflib.get_close_matches(name.strip().lower(), plain, 1, cutoff=0.0)
    return plain[near[0]] if near else ""


@dataclass(frozen=True)
class Scale:
    """Conversion of a column's numbers to SI and radians: a factor, or a form of `FORMS`."""

    factor: float = 1.0
    form: str = ""

    def __call__(self, values: _Values) -> _Values:
        """The same, converted: a number, or ndarray of any shape."""
        if self.form == "ddmm":
            degrees = np.trunc(np.asarray(values) / 100.0)
            minutes = np.asarray(values) - 100.0 * degrees
            converted = np.where(np.abs(minutes) < 60.0, degrees + minutes / 60.0, np.nan)  # or it is a placeholder
        elif self.form:
            converted = unix_of_epoch(np.asarray(values), self.form)
        else:  # most are in SI: a copy would cost as much as they hold
            return values if self.factor == 1.0 else values * self.factor
        return float(converted) if isinstance(values, float) else converted


def scales(units: Mapping[str, str], source: str) -> dict[str, Scale]:
    """Conversions to SI and radians of each column that a unit was declared for.

    Parameters
    ----------
    units : column or group -> unit; a column goes before its group
    source : name of the log, for messages

    Raises
    ------
    InputError : unknown column, group or unit, with the nearest known one
    """
    out: dict[str, Scale] = {}
    by_group, kinds = groups(), quantities()
    for key, signed in sorted(units.items(), key=lambda item: item[0] in kinds and item[0] not in by_group):
        unit = signed.removeprefix("-")
        columns = by_group.get(key, (key,) if key in kinds else ())
        if not columns:
            near = nearest(key, [*by_group, *kinds])
            raise InputError(f"{source}: units: {key} is not a column or group with a unit, nearest is {near}")
        known = [unit for c in columns for unit in (*UNITS[kinds[c]], *FORMS.get(kinds[c], ()))]
        if unit != signed and key == "time":
            raise InputError(f"{source}: units: time: {signed!r} has a sign, and time does not run backwards")
        if unit not in known:
            raise InputError(
                f"{source}: units: {key}: unknown unit {signed!r}, nearest is {nearest(unit, known)!r}; "
                f"known are {', '.join(dict.fromkeys(known))}"
            )
        sign = 1.0 if unit == signed else -1.0
        for column in columns:
            own = f"{unit}2" if kinds[column] == "area" and unit in _LENGTH else unit  # of the lengths beside it
            if own in FORMS.get(kinds[column], ()):
                out[column] = Scale(form=own)
            elif own in UNITS[kinds[column]]:
                factor = UNITS[kinds[column]][own]
                unsigned = column.endswith("_sd") or kinds[column] == "area"
                out[column] = Scale(factor * (1.0 if unsigned else sign))
    return out


def turn_angles(cells: MutableMapping[str, _Values], angles: Mapping[str, str], source: str) -> None:
    """Make headings clockwise from north, with roll and pitch of axes forward, starboard, down, of others.

    An attitude R of axes forward, port, up in east, north, up is Rz(90 deg - yaw) Ry(-pitch) Rx(roll + 180 deg) of the
    same axes in north, east, down.

    Parameters
    ----------
    cells : column -> radians, a number or ndarray, shape (n,); changed in place
    angles : group or column of headings -> key of `ANGLES`; a column alone leaves roll and pitch as they are
    source : name of the log, for messages

    Raises
    ------
    InputError : an unknown column or group, with the nearest known one
    """
    yaws: dict[str, str] = {names[2]: group for group, (names, _) in _ATTITUDES.items()}
    for key, kind in angles.items():
        if key not in _ATTITUDES and key not in yaws:
            near = nearest(key, [*_ATTITUDES, *yaws])
            raise InputError(f"{source}: angles: {key} is not a heading or a group with one, nearest is {near}")
        (roll, pitch, yaw), upside_down = _ATTITUDES[key if key in _ATTITUDES else yaws[key]]
        sense, zero = ANGLES[kind]
        if yaw in cells:
            cells[yaw] = _wrapped(zero + sense * cells[yaw])
        if key in _ATTITUDES and sense < 0.0:
            if pitch in cells:
                cells[pitch] = -cells[pitch]
            if roll in cells and upside_down:
                cells[roll] = _wrapped(cells[roll] + upside_down)


def _wrapped(angle: _Values) -> _Values:
    turned = np.pi - np.mod(np.pi - angle, 2.0 * np.pi)
    return float(turned) if isinstance(angle, float) else turned


def near_miss(name: str, present: Container[str]) -> str | None:
    """The known column that an unknown one was probably meant to be.

    Parameters
    ----------
    name : unknown column
    present : columns that the log has; one that is there was not misspelled
    """
    near = difflib.get_close_matches(name.strip().lower(), all_columns(), 1, cutoff=0.79)
    return near[0] if near and near[0] not in present else None


def shown(unit: str) -> tuple[float, str]:
    """Factor from a unit inside the program to the one shown, and that one's name.

    >>> shown("m")
    (1.0, 'm')
    """
    if unit.startswith("rad"):
        return math.degrees(1.0), "deg" + unit[3:]
    return 1.0, unit


def behind(unit: str) -> str:
    """A unit that is shown, as it stands behind a number; nothing of a ratio.

    >>> behind("deg"), behind("1")
    (' deg', '')
    """
    return "" if unit in ("", "1") else f" {unit}"
