"""Units that a file may use, and names that may be misspelled.

A unit is declared for a column (``gyr_x: deg/s``) or for a group of columns
(``gyr: deg/s``); everything becomes SI and radians. A minus before the unit turns the sign (``depth: -m``).
"""

import difflib
import re
from collections.abc import Container, Iterable, Mapping

import numpy as np

from rovgraph.errors import InputError
from rovgraph.log.streams import LAT_LON, all_columns
from rovgraph.sensors import SENSORS

_DEG = float(np.deg2rad(1.0))
_G = 9.80665  # standard gravity [m/s2]
_LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
_ANGLE = {"rad": 1.0, "deg": _DEG}

# kind of quantity -> unit -> factor to the unit used inside
UNITS: dict[str, dict[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9},
    "acceleration": {"m/s2": 1.0, "m/s^2": 1.0, "g": _G, "mg": 1e-3 * _G},
    "rate": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": _DEG},
    "field": {"uT": 1.0, "nT": 1e-3, "mG": 0.1, "gauss": 100.0},
    "angle": _ANGLE,
    "speed": {"m/s": 1.0, "cm/s": 1e-2, "mm/s": 1e-3},
    "length": _LENGTH,
    "latitude": {"deg": 1.0, "degE7": 1e-7, "rad": 1.0 / _DEG},
}

_SPELLINGS = {  # as other programs write units, in small letters
    "m/s²": "m/s2", "m/s/s": "m/s2", "m/sec^2": "m/s2", "m/sec2": "m/s2", "m/sec/sec": "m/s2", "mps2": "m/s2",
    "ms2": "m/s2", "m/s/2": "m/s2", "mps": "m/s", "m/sec": "m/s",
    "rad/sec": "rad/s", "radians/s": "rad/s", "rads": "rad/s", "rps": "rad/s", "dps": "deg/s", "°/s": "deg/s",
    "deg/sec": "deg/s", "degrees/s": "deg/s", "degs": "deg/s", "radians": "rad", "degrees": "deg", "°": "deg",
    "e7": "dege7", "µt": "ut", "μt": "ut", "microtesla": "ut", "mgauss": "mg",
    "meters": "m", "metres": "m", "meter": "m", "metre": "m",
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
    out["fix"] += LAT_LON
    return out


def quantities() -> dict[str, str]:
    """Column -> what it measures, a key of `UNITS`."""
    measured = [c for sensor in SENSORS.values() for c in sensor.columns if c.quantity is not None]
    return {"time": "time", **{c.name: str(c.quantity) for c in measured}, **dict.fromkeys(LAT_LON, "latitude")}


def nearest(name: str, known: Iterable[str]) -> str:
    """The known name most like ``name``, capitals and blanks aside; "" where nothing is known."""
    plain = {k.strip().lower(): k for k in known}
    near = difflib.get_close_matches(name.strip().lower(), plain, 1, cutoff=0.0)
    return plain[near[0]] if near else ""


def factors(units: Mapping[str, str], source: str) -> dict[str, float]:
    """Factor to SI and radians of each column that a unit was declared for.

    Parameters
    ----------
    units : column or group -> unit; a column goes before its group
    source : name of the log, for messages

    Raises
    ------
    InputError : unknown column, group or unit, with the nearest known one
    """
    out: dict[str, float] = {}
    by_group, kinds = groups(), quantities()
    for key, signed in sorted(units.items(), key=lambda item: item[0] in kinds and item[0] not in by_group):
        unit = signed.removeprefix("-")
        columns = by_group.get(key, (key,) if key in kinds else ())
        if not columns:
            near = nearest(key, [*by_group, *kinds])
            raise InputError(f"{source}: units: {key} is not a column or group with a unit, nearest is {near}")
        known = [unit for c in columns for unit in UNITS[kinds[c]]]
        if unit != signed and key == "time":
            raise InputError(f"{source}: units: time: {signed!r} has a sign, and time does not run backwards")
        if unit not in known:
            raise InputError(
                f"{source}: units: {key}: unknown unit {signed!r}, nearest is {nearest(unit, known)!r}; "
                f"known are {', '.join(dict.fromkeys(known))}"
            )
        sign = 1.0 if unit == signed else -1.0
        for column in (c for c in columns if unit in UNITS[kinds[c]]):
            out[column] = UNITS[kinds[column]][unit] * (1.0 if column.endswith("_sd") else sign)  # an sd has no sign
    return out


def near_miss(name: str, present: Container[str]) -> str | None:
    """The known column that an unknown one was probably meant to be.

    Parameters
    ----------
    name : unknown column
    present : columns that the log has; one that is there was not misspelled
    """
    near = difflib.get_close_matches(name.strip().lower(), all_columns(), 1, cutoff=0.79)
    return near[0] if near and near[0] not in present else None
