"""Quantities of foreign columns: inertial columns and angles, velocity and depth, altitude and fixes.

Gravity gives the unit of a specific force; gyro and heading, and velocity and depth, give each other's.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.geometry import Array
from rovgraph.log.units import UNITS
from rovgraph.readers.guessing import groups as physics
from rovgraph.readers.guessing.groups import (
    OTHER,
    PARTIAL,
    VECTORS,
    Candidate,
    ColumnGuess,
    ForeignSignal,
    Group,
    Guesses,
    UnitGuess,
    propose,
)

HEADINGS = {"ahrs": "ahrs_yaw", PARTIAL: "heading", OTHER: "heading", "dvl_heading": "dvl_heading"}
ANTICLOCKWISE = "counts anticlockwise by the gyro: state angles, enu where its zero is east, nwu where it is north"
UP = (180.0, 0.0, 0.0)  # mounting of an IMU whose z axis points up [deg]
POINTS_UP = "the IMU's z axis points up by gravity: x forward and y to port are assumed"
LEVEL = 0.7  # of gravity, that lies along an axis that is called vertical


def guess_imu(groups: Mapping[str, Group], time: Array, out: Guesses) -> None:
    """Acceleration by gravity; rate and angles by each other."""
    force = None
    if "acc" in groups:
        group = groups["acc"]
        raw = group.signal(time, VECTORS["acc"])
        unit = (
            physics.by_gravity(raw.values, group.stated)
            if len(raw.time)
            else UnitGuess("", "no row is whole", "unsure")
        )
        if unit.sureness != "unsure":
            force = replace(raw, values=raw.values * UNITS["acceleration"][unit.unit])
            _mounting(force, out)
        propose(out, group, unit)
    if "mag" in groups:
        stated = groups["mag"].stated
        propose(out, groups["mag"], UnitGuess(stated, "stated" if stated else "any unit will do", "sure"))
    _turning(groups, time, force, out)


def _mounting(force: ForeignSignal, out: Guesses) -> None:
    """Note the axis of gravity."""
    f = np.median(force.values, axis=0)
    if abs(f[2]) < LEVEL * np.linalg.norm(f):
        axis = "xyz"[int(np.abs(f).argmax())]
        out.notes.append(f"gravity lies along the IMU's {axis} axis: state imu.mount_rpy_deg (docs/mounting.md)")
    elif f[2] > 0.0:
        out.state("imu", "mount_rpy_deg", list(UP))
        out.notes.append(POINTS_UP)


def _turning(groups: Mapping[str, Group], time: Array, force: ForeignSignal | None, out: Guesses) -> None:
    """Units of the gyro and of angles, in which both turn alike."""
    gyro = _Gyro.of(groups.get("gyr"), time, force)
    for name, yaw in HEADINGS.items():
        if name in groups:
            gyro = _angles(groups[name], yaw, time, gyro, out)
    if "gyr" in groups:
        propose(out, groups["gyr"], gyro.unit)


@dataclass(frozen=True)
class _Gyro:
    """What is known of a gyro.

    Attributes
    ----------
    rate : its numbers; None = no rate
    turned : about the vertical, in its numbers; None = the vertical is not known
    stated : unit by its name, "" = none
    units : that are left
    why : there are fewer than before
    heading : whether one turns alike; None = none shows it
    """

    rate: ForeignSignal | None = None
    turned: ForeignSignal | None = None
    stated: str = ""
    units: tuple[str, ...] = ()
    why: str = ""
    heading: bool | None = None

    @staticmethod
    def of(group: Group | None, time: Array, force: ForeignSignal | None) -> "_Gyro":
        """By gravity, which turns in a vehicle that tilts."""
        if group is None or not len((rate := group.signal(time, VECTORS["gyr"])).time):
            return _Gyro()
        units = tuple(UNITS["rate"])
        if force is None:
            return _Gyro(rate, None, group.stated, (group.stated,) if group.stated else units)
        up = np.median(force.values, axis=0)
        turned = ForeignSignal(rate.time, rate.values @ (-up / np.linalg.norm(up))[:, None]).integrated()
        tilting = tuple(physics.rates_that_tilt(force, rate, units))
        why = "gravity tilts as fast" if len(tilting) < len(units) else ""
        if group.stated and group.stated in tilting:
            tilting = (group.stated,)
        return _Gyro(rate, turned, group.stated, tilting, why)

    @property
    def unit(self) -> UnitGuess:
        """The unit that fits best."""
        if self.rate is None:
            return UnitGuess(self.stated, "no row is whole", "unsure")
        if self.heading is False or (self.stated and self.stated not in self.units):
            what = "the heading turns" if self.heading is False else "gravity tilts"
            return UnitGuess(self.stated or self.units[0], f"{what} otherwise: state its unit", "unsure")
        if self.heading and len(self.units) == 1:
            return UnitGuess(self.units[0], "turns as the heading does", "sure")
        if self.stated:
            told = self.why or "stated, and nothing shows it"
            return UnitGuess(self.stated, told, "sure" if self.why else "likely")
        if len(self.units) == 1:
            return UnitGuess(self.units[0], self.why, "likely")
        sized = physics.rates_by_size(self.rate.values, self.units)
        if len(sized) == 1:
            return UnitGuess(sized[0], "by its size", "likely")
        told = f"may be in {' or '.join(sized or self.units)}: state it"
        return UnitGuess((sized or self.units)[0], told, "unsure")


def _angles(group: Group, yaw: str, time: Array, gyro: _Gyro, out: Guesses) -> _Gyro:
    """Propose angles; what is then known of the gyro."""
    known = [each.values[np.isfinite(each.values)] for each in group.columns.values()]
    units = physics.angles_by_range(known, group.stated)
    unit = _angle_by_range(known, units, group.stated)
    slope = correlation = 0.0
    if yaw in group.columns and gyro.turned is not None:
        heading = group.signal(time, (yaw,))
        turn = 2.0 * np.pi / UNITS["angle"][units[0]]
        unwrapped = replace(heading, values=np.unwrap(heading.values, axis=0, period=turn))
        slope, correlation = physics.ratio(unwrapped, gyro.turned)
    if abs(correlation) < physics.CORRELATION:
        propose(out, group, unit)
        return gyro
    pairs = physics.agreeing(slope, ("angle", units), ("rate", gyro.units))
    if not pairs:
        told = f"turns {abs(slope):.3g} times as much as the gyro's numbers, which their units do not explain"
        propose(out, group, replace(unit, why=told, sureness="unsure"))
        return replace(gyro, heading=False)
    left = tuple(dict.fromkeys(rate for _, rate in pairs))
    if len(pairs) > 1 and unit.sureness != "unsure":  # degrees with the gyro's, or radians with the gyro's
        pairs = [pair for pair in pairs if pair[0] == unit.unit] or pairs
    if len({angle for angle, _ in pairs}) == 1:
        unit = UnitGuess(pairs[0][0], "turns as the gyro does", "sure")
        left = tuple(dict.fromkeys(rate for _, rate in pairs))
    if correlation < 0.0:
        stated = group.columns[yaw].meaning.enu
        unit = replace(unit, why=f"{unit.why}; {ANTICLOCKWISE}", sureness=unit.sureness if stated else "unsure")
        if stated:
            out.state("angles", _named(group, yaw), "enu")
    propose(out, group, unit)
    return replace(gyro, units=left, heading=True)


def _named(group: Group, yaw: str) -> str:
    """What a configuration's ``angles`` calls it: with its roll and pitch, or the heading alone."""
    return next((key for key in ("ahrs", "attitude") if len(group.columns) > 1 and yaw in VECTORS[key]), yaw)


def _angle_by_range(values: Sequence[Array], units: Sequence[str], stated: str) -> UnitGuess:
    if stated:
        return UnitGuess(stated, "stated", "sure")
    if len(units) == 1:
        return UnitGuess(units[0], "goes beyond a turn in radians", "sure")
    if max(float(np.ptp(v)) for v in values) > physics.WIDE:
        return UnitGuess("rad", "stays within a turn in radians", "likely")
    return UnitGuess("rad", "may be radians, or a few degrees: state it", "unsure")


NOTHING = ForeignSignal(np.empty(0), np.empty((0, 3)))


def guess_doppler(groups: Mapping[str, Group], time: Array, out: Guesses) -> None:
    """Velocity and depth, by the descent in both."""
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
    sunk: ForeignSignal, way: ForeignSignal, lengths: Sequence[str], speeds: Sequence[str]
) -> list[tuple[str, str]] | None:
    """Units in which depth and DVL descend alike; None without evidence."""
    down = ForeignSignal(way.time, way.values[:, -1:])
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


def _depth(stated: str, sunk: ForeignSignal, units: Sequence[str], agrees: bool | None) -> UnitGuess:
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
    for group in _present(groups, "pressure"):
        if "depth" in groups:
            out.left |= {each.column: "a pressure beside a depth" for each in group.columns.values()}
            continue
        values = next(iter(group.columns.values())).values
        propose(out, group, physics.pressures_by_air(values, group.stated))
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
