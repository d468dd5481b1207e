"""Inertial columns and angles: gravity gives the unit of a force, and gyro and heading give each other's."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.geometry import Array
from rovgraph.interchange.guessing import physics
from rovgraph.interchange.guessing.groups import OTHER, PARTIAL, VECTORS, Group, Guesses, propose
from rovgraph.interchange.guessing.physics import Signal, UnitGuess
from rovgraph.log.units import UNITS

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


def _mounting(force: Signal, out: Guesses) -> None:
    """Say where gravity lies."""
    f = np.median(force.values, axis=0)
    if abs(f[2]) < LEVEL * np.linalg.norm(f):
        axis = "xyz"[int(np.abs(f).argmax())]
        out.notes.append(f"gravity lies along the IMU's {axis} axis: state imu.mount_rpy_deg (docs/mounting.md)")
    elif f[2] > 0.0:
        out.state("imu", "mount_rpy_deg", list(UP))
        out.notes.append(POINTS_UP)


def _turning(groups: Mapping[str, Group], time: Array, force: Signal | None, out: Guesses) -> None:
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
    rate : its numbers; None = there are none
    turned : about the vertical, in its numbers; None = the vertical is not known
    stated : unit by its name, "" = none
    units : that are left
    why : there are fewer than before
    heading : whether one turns alike; None = none shows it
    """

    rate: Signal | None = None
    turned: Signal | None = None
    stated: str = ""
    units: tuple[str, ...] = ()
    why: str = ""
    heading: bool | None = None

    @staticmethod
    def of(group: Group | None, time: Array, force: Signal | None) -> "_Gyro":
        """By gravity, which turns in a vehicle that tilts."""
        if group is None or not len((rate := group.signal(time, VECTORS["gyr"])).time):
            return _Gyro()
        units = tuple(UNITS["rate"])
        if force is None:
            return _Gyro(rate, None, group.stated, (group.stated,) if group.stated else units)
        up = np.median(force.values, axis=0)
        turned = Signal(rate.time, rate.values @ (-up / np.linalg.norm(up))[:, None]).integrated()
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
        said = group.columns[yaw].meaning.enu
        unit = replace(unit, why=f"{unit.why}; {ANTICLOCKWISE}", sureness=unit.sureness if said else "unsure")
        if said:
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
