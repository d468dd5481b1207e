"""Velocity and depth, which give each other's unit; altitude and fixes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rovgraph.geometry import Array
from rovgraph.interchange.guessing import physics
from rovgraph.interchange.guessing.groups import VECTORS, Candidate, ColumnGuess, Group, Guesses, propose
from rovgraph.interchange.guessing.imu import UP
from rovgraph.interchange.guessing.physics import Signal, UnitGuess

NOTHING = Signal(np.empty(0), np.empty((0, 3)))


def guess_doppler(groups: Mapping[str, Group], time: Array, out: Guesses) -> None:
    """Velocity and depth, by what both say of the descent."""
    depth, moving = groups.get("depth"), groups.get("dvl")
    sunk = NOTHING if depth is None else depth.signal(time, ("depth",))
    way = NOTHING if moving is None else moving.signal(time, VECTORS["dvl"][:3])
    lengths = physics.depths_by_size(sunk.values, "" if depth is None else depth.stated)
    speeds = physics.speeds_by_size(way.values, "" if moving is None else moving.stated)
    pairs = _descending(sunk, way, lengths, speeds)
    agree = None if pairs is None else bool(pairs)
    if pairs:
        lengths, speeds = (list(dict.fromkeys(units)) for units in zip(*pairs, strict=True))
    if depth is not None:
        propose(out, depth, _depth(depth.stated, sunk, lengths, agree))
    if moving is not None:
        propose(out, moving, _speed(moving.stated, speeds, agree))
        _axes(moving, out)
    if (water := groups.get("dvl_water")) is not None:
        values = water.signal(time, VECTORS["dvl_water"]).values
        propose(out, water, _speed(water.stated, physics.speeds_by_size(values, water.stated), None))


def _axes(moving: Group, out: Guesses) -> None:
    """Axes to port and upwards by their names: a mounting where both are, else a sign."""
    back = {name for name, each in moving.columns.items() if each.meaning.backwards}
    if back >= {"dvl_vy", "dvl_vz"}:
        out.state("dvl", "mount_rpy_deg", list(UP))
        out.notes.append("the DVL's axes point forward, to port and up by their names")
        return
    for k, each in enumerate(out.columns):
        if each.field in back and each.unit:
            out.columns[k] = replace(each, unit=f"-{each.unit}", why=f"{each.why}, in the other direction by its name")


def _descending(
    sunk: Signal, way: Signal, lengths: Sequence[str], speeds: Sequence[str]
) -> list[tuple[str, str]] | None:
    """Units in which depth and DVL descend alike; None where nothing tells."""
    down = Signal(way.time, way.values[:, -1:])
    slope, correlation = physics.ratio(sunk, down.integrated())
    if abs(correlation) < physics.CORRELATION:
        return None
    return physics.agreeing(slope, ("length", lengths), ("speed", speeds))


def _speed(stated: str, units: Sequence[str], agrees: bool | None) -> UnitGuess:
    if agrees is False:
        return UnitGuess(stated or "m/s", "does not descend as the depth does: state its unit", "unsure")
    if agrees and len(units) == 1:
        return UnitGuess(units[0], "descends as the depth does", "sure")
    if stated:
        return UnitGuess(stated, "stated", "sure")
    if len(units) == 1:
        return UnitGuess(units[0], "by its size", "likely")
    text = f"may be in {' or '.join(units)}: state it" if units else "is no vehicle's speed in any unit"
    return UnitGuess(units[0] if units else "m/s", text, "unsure")


def _depth(stated: str, sunk: Signal, units: Sequence[str], agrees: bool | None) -> UnitGuess:
    if not len(sunk.time):
        return UnitGuess(stated or "m", "no row with a time", "unsure")
    middle = float(np.median(sunk.values))
    if agrees is False:
        unit = UnitGuess(stated or "m", "does not sink as the DVL does: state its unit", "unsure")
    elif agrees and len(units) == 1:
        unit = UnitGuess(units[0], "sinks as the DVL does", "sure")
    elif stated:
        unit = UnitGuess(stated, "stated", "sure")
    elif "m" in units and abs(middle) <= physics.SHALLOW:
        unit = UnitGuess("m", "metres are assumed", "likely")
    else:
        unit = UnitGuess(next(iter(units), "m"), f"may be in {' or '.join(units) or 'no unit'}: state it", "unsure")
    return replace(unit, unit=f"-{unit.unit}", why=f"{unit.why}, negative below the surface") if middle < 0.0 else unit


def guess_others(groups: Mapping[str, Group], time: Array, out: Guesses) -> None:
    """Lengths and fixes, each by itself."""
    for name in ("dvl_altitude", "north", "fix_sd"):
        for group in _present(groups, name):
            values = next(iter(group.columns.values())).values
            if name == "dvl_altitude" and np.nanmedian(values) < 0.0:
                _height(next(iter(group.columns.values())), "depth" in groups, out)
                continue
            unit = UnitGuess(group.stated, "stated", "sure")
            if not group.stated:
                unit = UnitGuess("m", "metres are assumed", "likely")
            propose(out, group, unit)
    for group in _present(groups, "latitude"):
        fixes = group.signal(time, VECTORS["latitude"])
        unit = UnitGuess("deg", "no row is whole", "unsure")
        if len(fixes.time):
            unit = physics.latitudes_by_range(fixes.values[:, 0], fixes.values[:, 1], group.stated)
        propose(out, group, unit)


def _height(each: Candidate, known: bool, out: Guesses) -> None:
    """A negative altitude: a depth below the surface where there is no other."""
    if known:
        out.left[each.column] = "negative, as no altitude above the bottom is"
        return
    unit = each.meaning.unit or "m"
    why = "negative, as a height above the surface is under water"
    out.columns.append(ColumnGuess(each.column, "depth", f"-{unit}", why, "likely"))


def _present(groups: Mapping[str, Group], name: str) -> Iterator[Group]:
    if name in groups:
        yield groups[name]
