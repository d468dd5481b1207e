"""Presets: instruments' data sheets as keys and values of the configuration.

The YAML files beside this module hold them, a file per maker. A number is written as its data sheet states it, with
its unit and its source; it is converted here. A value that no source states stays empty. May import what
`rovgraph.model` may. Begin with `Preset`.
"""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np
from pydantic_core import PydanticCustomError
from ruamel.yaml import YAML

_DEG = float(np.deg2rad(1.0))
_G = 9.80665  # standard gravity [m/s2]

# configuration key -> unit of a data sheet -> factor to the unit of the key
UNITS: dict[str, dict[str, float]] = {
    "imu.noise.gyr": {"deg/s/sqrt(Hz)": _DEG, "deg/sqrt(h)": _DEG / 60.0},
    "imu.noise.acc": {"ug/sqrt(Hz)": 1e-6 * _G, "mg/sqrt(Hz)": 1e-3 * _G, "m/s/sqrt(h)": 1.0 / 60.0},
    "imu.gyr_bias_sd_dps": {"deg/s": 1.0, "deg/h": 1.0 / 3600.0},
    "imu.acc_bias_sd_mps2": {"mg": 1e-3 * _G, "ug": 1e-6 * _G},
    "calibration.gyr_scale.sd": {"%": 1e-2, "ppm": 1e-6},
    "calibration.acc_scale.sd": {"%": 1e-2, "ppm": 1e-6},
    "dvl.velocity_sd_mps": {"cm/s": 1e-2, "mm/s": 1e-3},
    "calibration.dvl_scale.sd": {"%": 1e-2},
    "dvl.beams.angle_deg": {"deg": 1.0},
    "dvl.beams.azimuth_deg": {"deg": 1.0},
}
TRIPLES = ("dvl.velocity_sd_mps",)  # a data sheet has one number for all axes
LISTS = ("dvl.beams.azimuth_deg",)  # and of these some
WITHOUT_UNIT = ("dvl.beams.first_number", "dvl.beams.phased")
KINDS = ("imu", "dvl")


@dataclass(frozen=True)
class Fact:
    """One number of a data sheet.

    Attributes
    ----------
    key : of the configuration, dotted
    stated : number and unit as the data sheet has them, or what has no unit
    value : in the unit of the key; three equal numbers where the key has three, some where it has a list
    source : the document
    """

    key: str
    stated: str
    value: float | bool | tuple[float, ...]
    source: str


@dataclass(frozen=True)
class Preset:
    """Data sheet of an instrument.

    Attributes
    ----------
    name : as the configuration writes it
    kind : section of the configuration, "imu" or "dvl"
    instrument : maker and model
    facts : what it fills in; none where no source has a number
    notes : what its sources state besides, and what they do not state
    """

    name: str
    kind: str
    instrument: str
    facts: tuple[Fact, ...]
    notes: tuple[str, ...]


@cache
def presets() -> Mapping[str, Preset]:
    """All presets by name, inertial units first."""
    raw: dict[str, dict[str, Any]] = {}
    for file in files(__name__).iterdir():
        if file.name.endswith(".yaml"):
            raw |= YAML(typ="safe", pure=True).load(file.read_text(encoding="utf-8"))
    found = [_preset(name, raw) for name in sorted(raw)]
    return {p.name: p for p in sorted(found, key=lambda p: KINDS.index(p.kind))}


def _preset(name: str, raw: Mapping[str, Mapping[str, Any]]) -> Preset:
    entry = raw[name]
    base = raw[entry["like"]] if "like" in entry else entry
    facts = tuple(_fact(key, *row) for key, row in base["values"].items())
    return Preset(name, base["kind"], entry["instrument"], facts, (*base.get("notes", ()), *_own(entry, base)))


def _own(entry: Mapping[str, Any], base: Mapping[str, Any]) -> tuple[str, ...]:
    return () if entry is base else tuple(entry["notes"])


def _fact(key: str, stated: str | int | bool, source: str) -> Fact:
    if key in WITHOUT_UNIT:
        return Fact(key, str(stated).lower(), stated, source)  # type: ignore[arg-type]
    *numbers, unit = str(stated).split()
    values = tuple(float(f"{float(number) * UNITS[key][unit]:.4g}") for number in numbers)
    return Fact(key, str(stated), values if key in LISTS else 3 * values if key in TRIPLES else values[0], source)


def known_preset(kind: str, name: str) -> str:
    """The name of a preset, if there is one of that kind.

    Raises
    ------
    PydanticCustomError : no such preset; the nearest one is named
    """
    known = [p.name for p in presets().values() if p.kind == kind]
    if name not in known:
        near = difflib.get_close_matches(name.lower(), known, 1, cutoff=0.0)[0]
        text = "expected a preset, nearest is {near} (rovgraph config --presets lists all)"
        raise PydanticCustomError("preset", text, {"near": near})
    return name


def with_presets(data: dict[str, Any]) -> dict[str, Any]:
    """Keys and values of a configuration with those of its presets; what is stated takes precedence.

    Parameters
    ----------
    data : sections as a YAML file has them; a preset that is not known is left to the validation
    """
    for kind in KINDS:
        section = data.get(kind)
        preset = presets().get(section["preset"]) if isinstance(section, dict) and _named(section) else None
        for fact in preset.facts if preset is not None and preset.kind == kind else ():
            data = _with_default(data, fact.key.split("."), fact.value)
    return data


def without_presets(data: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Keys and values without what a preset filled in, where the changes name another preset or take it away.

    A key that holds the preset's own number counts as filled in.
    """
    for kind in KINDS:
        change = changes.get(kind, {})
        name = (data.get(kind) or {}).get("preset")
        if (
            isinstance(name, str)
            and name in presets()
            and (change is None or (isinstance(change, Mapping) and "preset" in change))
        ):
            for fact in presets()[name].facts:
                data = _without(data, fact.key.split("."), fact.value)
    return data


def _without(data: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    """A copy without the key at a path, if it has that value."""
    head, *rest = path
    if head not in data:
        return data
    if rest:
        return {**data, head: _without(data[head], rest, value)}
    return {key: entry for key, entry in data.items() if key != head or entry != value}


def _named(section: Mapping[str, Any]) -> bool:
    return isinstance(section.get("preset"), str)


def _with_default(data: dict[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    """A copy with a value at a path of keys, unless there is one; what is no section stays for the validation."""
    head, *rest = path
    if not rest:
        return {head: value, **data}
    inner = data.get(head, {})
    return {**data, head: _with_default(inner, rest, value)} if isinstance(inner, dict) else data
