"""Teledyne PD0 files (.pd0, .000, .ENR, .adc): bottom track, water track, attitude and depth of each ensemble.

Bottom track is the velocity of the bottom against the instrument; a log has the instrument's over the bottom. Axes are
forward (beam 3, or the ship's bow), starboard, down, whatever the file's are (`rovgraph.interchange.trdi_axes`).
"""

import mmap
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.interchange.formats import Options
from rovgraph.interchange.pd0_ensembles import (
    BOTTOM,
    FIXED,
    NAVIGATION,
    OTHERS,
    SYNC,
    VARIABLE,
    Ensembles,
    ensemble_end,
    find_ensembles,
)
from rovgraph.interchange.recording import Clock, Left, Recording
from rovgraph.interchange.stamps import unix_of_calendar
from rovgraph.interchange.trdi_axes import BEAM, EARTH, Attitude, forward_starboard_down
from rovgraph.interchange.trdi_recording import CLOCK, Pings, recording

ZONE_SD_S = 6 * 3600.0  # of a clock whose time zone nobody states
BAD = -32768
ANGLES = 15.0, 20.0, 30.0, 25.0  # of beams, by the system's configuration [deg]
LEVEL_SENSORS = 0b1100  # pitch and roll come from sensors of its own
SEMICIRCLE = 180.0 / 2**31  # [deg]


class PD0:
    """The format; see `rovgraph.interchange.formats.Format`."""

    name = "pd0"
    title = "Teledyne PD0 file (.pd0, .000, .ENR, .adc)"
    extra = ""

    def recognise(self, path: Path, head: bytes) -> float:
        if len(find_ensembles(head)):
            return 0.95
        cut = head.startswith(SYNC) and len(head) > 6 and ensemble_end(head, 0) is None
        return 0.6 if cut else 0.0

    def read(self, path: Path, options: Options) -> Recording:
        with path.open("rb") as file:
            content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        found = find_ensembles(content, lambda done: options.progress(done, len(content)))
        if not len(found):
            raise InputError(
                f"{path}: holds no whole PD0 ensemble ({found.failed} with a wrong checksum); copy it again"
            )
        pings = decoded(content, found)
        clock = Clock(CLOCK, 0.0, ZONE_SD_S, "its calendar, taken for UTC")
        return recording(path, self.name, pings, clock, tuple(_left(found)), tuple(_warnings(found)))


FORMAT = PD0()


def decoded(content: bytes | mmap.mmap, found: Ensembles) -> Pings:
    """What the ensembles of a file, or of a part of one, say."""
    fixed, _ = found.records(content, FIXED)
    variable, _ = found.records(content, VARIABLE)
    bottom, tracked = found.records(content, BOTTOM)
    navigation, navigated = found.records(content, NAVIGATION)
    rpy = np.deg2rad(0.01 * np.column_stack([variable[name].astype(float) for name in ("roll", "pitch", "heading")]))
    system = (fixed["coordinates"] >> 3) & 3
    attitude = _attitude(fixed, system, rpy)
    values, water = _velocities(bottom, "velocity"), _velocities(bottom, "water")
    silent = ~np.any(bottom["correlation"], axis=1) & ~np.any(bottom["range"], axis=1)
    values[silent | ~tracked] = np.nan
    water[~tracked | ~np.any(np.nan_to_num(water), axis=1)] = np.nan  # zeros throughout: it tracks no water
    velocity, error = forward_starboard_down(values, system, attitude)
    through, _ = forward_starboard_down(water, system, attitude)
    ranges = 0.01 * (bottom["range"] + 65536.0 * bottom["range_high"])
    position = SEMICIRCLE * np.column_stack([navigation["lat"], navigation["lon"]])
    nowhere = ~navigated | (np.abs(position[:, 0]) > 90.0) | ~np.any(position, axis=1)
    position[nowhere] = np.nan
    return Pings(
        time=_time(variable["date"], variable["century"]),
        system=system,
        velocity=-velocity,
        water=-through,
        error=error,
        rpy=rpy,
        bias=np.deg2rad(0.01 * fixed["bias"]),
        alignment=np.deg2rad(0.01 * fixed["alignment"]),
        tilted=attitude.tilted,
        depth=0.1 * variable["depth"],
        range=np.where(ranges > 0.0, ranges, np.nan),
        beams=np.where((system == BEAM)[:, None], values, np.nan),
        quality={name: bottom[name].astype(float) for name in ("correlation", "amplitude", "percent_good")},
        position=position,
        tracked=tracked,
    )


def _attitude(fixed: NDArray[np.void], system: NDArray[np.integer], rpy: Array) -> Attitude:
    """How the velocities of ensembles came to their axes.

    Roll and pitch in ship axes that no sensor of its own measures were written in by the vehicle afterwards, as a REMUS
    does, and are not in the velocities: the depth in its files changes as its pitch says, not as its vertical velocity.
    """
    own = (fixed["source"] & LEVEL_SENSORS) == LEVEL_SENSORS
    angle = np.where(fixed["beam_angle"] <= 45, fixed["beam_angle"], 0).astype(float)
    angle = np.where(angle > 0.0, angle, np.array(ANGLES)[(fixed["system"] >> 8) & 3])
    gimballed = rpy.copy()
    gimballed[:, 1] = np.where(own, np.arctan(np.tan(rpy[:, 1]) * np.cos(rpy[:, 0])), rpy[:, 1])
    return Attitude(
        rpy=gimballed,
        tilted=(own | (system == EARTH)) & (fixed["coordinates"] & 0b100 != 0),
        upward=fixed["system"] & 0x80 != 0,
        beam_angle=np.deg2rad(angle),
        convex=fixed["system"] & 0x08 != 0,
    )


def _velocities(bottom: NDArray[np.void], name: str) -> Array:
    raw = bottom[name]
    return np.where(raw == BAD, np.nan, 0.001 * raw)


def _time(date: NDArray[np.uint8], century: NDArray[np.uint8]) -> Array:
    """Seconds since 1970 of calendar dates, of which years may have two digits; NaN for what is none."""
    year, month, day, hour, minute, second, hundredths = date.astype(np.int64).T
    full = np.where((century == 19) | (century == 20), 100 * century.astype(np.int64), 2000) + year
    whole = unix_of_calendar(full, month, day, hour, minute, second)
    return np.where((year < 100) & (hundredths < 100), whole + 0.01 * hundredths, np.nan)


def _left(found: Ensembles) -> Iterator[Left]:
    for kind, count in sorted(found.others.items()):
        yield Left(OTHERS.get(kind, f"record {kind:#06x}"), count, "no measurement of a sensor")
    if found.failed:
        yield Left("ensemble", found.failed, "a wrong checksum")


def _warnings(found: Ensembles) -> Iterator[str]:
    if found.failed:
        yield f"{found.failed} ensembles with a wrong checksum are left out"
    if found.skipped:
        yield f"{found.skipped} bytes belong to no whole ensemble"
