"""Velocity and depth, which give each other's unit; altitude and fixes."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from rovgraph.geometry import Array
from rovgraph.interchange.guessing import physics
from rovgraph.interchange.guessing.groups import VECTORS, Group, Guesses, propose
from rovgraph.interchange.guessing.physics import Signal, UnitGuess


def guess_doppler(groups: Mapping[str, Group], time: Array, out: Guesses) -> None:
    """Velocity and depth, by what both say of the descent."""
    lengths = speeds = None
    depth = groups.get("depth")
    sunk = None if depth is None else depth.signal(time, ("depth",))
    if depth is not None and sunk is not None:
        lengths = physics.depths_by_size(sunk.values, depth.stated) if len(sunk.time) else ["m"]
    moving = groups.get("dvl")
    way = None if moving is None else moving.signal(time, VECTORS["dvl"][:3])
    if moving is not None and way is not None:
        speeds = physics.speeds_by_size(way.values, moving.stated) if len(way.time) else []
    agrees = False
    if sunk is not None and way is not None and lengths and speeds:
        slope, correlation = physics.ratio(sunk, Signal(way.time, way.values[:, 2:]).integrated())
        if abs(correlation) > physics.ALIKE:
            pairs = physics.agreeing(slope, ("length", lengths), ("speed", speeds))
            agrees = bool(pairs)
            lengths, speeds = (
                list(dict.fromkeys(p[k] for p in pairs)) or full for k, full in ((0, lengths), (1, speeds))
            )
    if depth is not None and sunk is not None:
        _propose_depth(depth, sunk, lengths or ["m"], agrees, out)
    if moving is not None:
        propose(out, moving, _speed(moving.stated, speeds or [], agrees))
    if "dvl_water" in groups:
        group = groups["dvl_water"]
        own = group.signal(time, VECTORS["dvl_water"])
        propose(
            out,
            group,
            _speed(group.stated, physics.speeds_by_size(own.values, group.stated) if len(own.time) else [], False),
        )


def _speed(stated: str, units: Sequence[str], agrees: bool) -> UnitGuess:
    if stated:
        return UnitGuess(stated, "stated", "sure")
    if len(units) != 1:
        text = f"may be in {' or '.join(units)}: state it" if units else "is no vehicle's speed in any unit"
        return UnitGuess(units[0] if units else "m/s", text, "unsure")
    return UnitGuess(
        units[0], "descends as the depth does" if agrees else "by its size", "sure" if agrees else "likely"
    )


def _propose_depth(group: Group, sunk: Signal, units: Sequence[str], agrees: bool, out: Guesses) -> None:
    if not len(sunk.time):
        propose(out, group, UnitGuess("m", "no row with a time", "unsure"))
        return
    middle = float(np.median(sunk.values))
    if group.stated:
        unit = UnitGuess(group.stated, "stated", "sure")
    elif len(units) == 1:
        unit = UnitGuess(units[0], "sinks as the DVL does" if agrees else "by its size", "sure" if agrees else "likely")
    elif abs(middle) <= physics.SHALLOW:
        unit = UnitGuess("m", "metres are assumed", "likely")
    else:
        unit = UnitGuess(units[0], f"may be in {' or '.join(units)}: state it", "unsure")
    if middle < 0.0:
        unit = replace(unit, unit=f"-{unit.unit}", why=f"{unit.why}, negative below the surface")
    propose(out, group, unit)


def guess_others(groups: Mapping[str, Group], time: Array, out: Guesses) -> None:
    """Lengths and fixes, each by itself."""
    for name in ("dvl_altitude", "north", "fix_sd"):
        for group in _present(groups, name):
            values = next(iter(group.columns.values())).values
            if name == "dvl_altitude" and np.nanmedian(values) < 0.0:
                out.left |= {c.column: "negative, as no altitude above the bottom is" for c in group.columns.values()}
                continue
            unit = UnitGuess(group.stated or "m", "stated" if group.stated else "metres are assumed",
                             "sure" if group.stated else "likely")  # fmt: skip
            propose(out, group, unit)
    for group in _present(groups, "latitude"):
        fixes = group.signal(time, VECTORS["latitude"])
        unit = UnitGuess("deg", "no row is whole", "unsure")
        if len(fixes.time):
            unit = physics.latitudes_by_range(fixes.values[:, 0], fixes.values[:, 1], group.stated)
        propose(out, group, unit)


def _present(groups: Mapping[str, Group], name: str) -> Iterator[Group]:
    if name in groups:
        yield groups[name]
