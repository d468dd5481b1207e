"""Teledyne PD0 files (.pd0, .000, .ENR, .adc): bottom track, water track, attitude and depth of each ensemble.

Bottom track is the velocity of the bottom against the instrument; a log has the instrument's over the bottom. Axes are
forward (beam 3, or the ship's bow), starboard, down, whatever the file's are (`rovgraph.interchange.trdi_axes`).
"""

import mmap
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
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
from rovgraph.interchange.recording import Channel, Clock, Left, Recording
from rovgraph.interchange.trdi_axes import EARTH, SHIP, SYSTEMS, Attitude, forward_starboard_down

CLOCK = "DVL's clock"
FRAME = "forward (beam 3, or the ship's bow), starboard, down"
ZONE_SD_S = 6 * 3600.0  # of a clock whose time zone nobody states
BAD = -32768
ANGLES = 15.0, 20.0, 30.0, 25.0  # of beams, by the system's configuration [deg]
LEVEL_SENSORS = 0b1100  # pitch and roll come from sensors of its own
NAMES = "dvl_vx", "dvl_vy", "dvl_vz"
WATER = "dvl_water_vx", "dvl_water_vy", "dvl_water_vz"
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
        return _recording(path, decoded(content, found), found)


FORMAT = PD0()


@dataclass(frozen=True)
class Pings:
    """What n ensembles say, in SI.

    Attributes
    ----------
    time : shape (n,), as if its calendar were UTC [s since 1970]; NaN where the date is none
    system : shape (n,), coordinates (`rovgraph.interchange.trdi_axes`)
    velocity, water : shape (n, 3), over the bottom and through the water, axes as `FRAME` says; NaN = none [m/s]
    error : shape (n,), error velocity of the bottom track [m/s]
    rpy : shape (n, 3), roll, pitch and heading as printed [rad]
    bias : shape (n,), what was added to the heading [rad]
    alignment : shape (n,), of beam 3 against the bow [rad]
    tilted : shape (n,), roll and pitch were used for ship or Earth axes
    depth : shape (n,) [m]
    range : shape (n, 4), to the bottom along the vertical; NaN = none [m]
    beams : shape (n, 4), values of the four beams in the file's own coordinates [m/s]
    quality : name -> shape (n, 4), of the beams
    position : shape (n, 2), latitude and longitude; NaN = none [deg]
    tracked : shape (n,), it looked for the bottom
    """

    time: Array
    system: NDArray[np.integer]
    velocity: Array
    water: Array
    error: Array
    rpy: Array
    bias: Array
    alignment: Array
    tilted: NDArray[np.bool_]
    depth: Array
    range: Array
    beams: Array
    quality: dict[str, Array]
    position: Array
    tracked: NDArray[np.bool_]


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
        beams=values,
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
    sound = (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31) & (year < 100)
    sound &= (hour < 24) & (minute < 60) & (second < 60) & (hundredths < 100)
    months = np.where(sound, 12 * (full - 1970) + month - 1, 0).astype("datetime64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + day - 1
    return np.where(sound, 86400.0 * days + 3600.0 * hour + 60.0 * minute + second + 0.01 * hundredths, np.nan)


def _recording(path: Path, pings: Pings, found: Ensembles) -> Recording:
    dated = np.isfinite(pings.time)
    if not dated.any():
        raise InputError(f"{path}: no ensemble has a date, in {len(dated)}; set the instrument's clock")
    channels = tuple(_channels(pings, dated))
    left = [
        Left(OTHERS.get(kind, f"record {kind:#06x}"), count, "no measurement of a sensor")
        for kind, count in sorted(found.others.items())
    ]
    if undated := int(np.count_nonzero(~dated)):
        left.append(Left("ensemble", undated, "its date is none"))
    if found.failed:
        left.append(Left("ensemble", found.failed, "a wrong checksum"))
    if np.isfinite(pings.position).any():
        left.append(Left("position", int(np.isfinite(pings.position[:, 0]).sum()), "reckoned by the vehicle"))
    clock = Clock(CLOCK, 0.0, ZONE_SD_S, "its calendar, taken for UTC")
    return Recording(
        str(path),
        FORMAT.name,
        channels,
        {CLOCK: clock},
        tuple(left),
        _settings(pings),
        tuple(_notes(pings)),
        tuple(_warnings(pings, found, channels)),
        _tables(pings, dated),
    )


def _channels(pings: Pings, dated: NDArray[np.bool_]) -> Iterator[Channel]:
    def channel(sensor: str, rows: NDArray[np.bool_], source: str, frame: str, **columns: Array) -> Iterator[Channel]:
        rows = rows & dated
        if rows.any():
            kept = {name: values[rows] for name, values in (("time", pings.time), *columns.items())}
            yield Channel(sensor, kept, f"{source}: {', '.join(columns)}", frame, CLOCK)

    valid = np.isfinite(pings.velocity).all(axis=1)
    velocity = dict(zip(NAMES, np.where(valid[:, None], pings.velocity, np.nan).T, strict=True))
    yield from channel("dvl", pings.tracked, "bottom track", FRAME, **velocity, dvl_valid=valid.astype(float))
    through = np.isfinite(pings.water).all(axis=1)
    yield from channel("dvl_water", through, "water layer", FRAME, **dict(zip(WATER, pings.water.T, strict=True)))
    seen = np.isfinite(pings.range)
    altitude = np.nansum(pings.range, axis=1) / np.maximum(seen.sum(axis=1), 1)
    yield from channel("dvl_altitude", seen.any(axis=1), "mean range of the beams", "", dvl_altitude=altitude)
    roll, pitch, heading = pings.rpy.T
    heading = wrap_angle(heading - pings.bias)
    ship = pings.system == SHIP
    if _varies(heading):
        yield from channel("vehicle_heading", ship, "heading", FRAME, heading=heading)
        yield from channel("dvl_heading", ~ship, "heading", FRAME, dvl_heading=heading)
    if _varies(roll) or _varies(pitch):
        yield from channel("vehicle_tilt", np.ones(len(roll), dtype=bool), "attitude", FRAME, roll=roll, pitch=pitch)
    if _varies(pings.depth):
        yield from channel("depth", np.ones(len(roll), dtype=bool), "depth of the transducer", "", depth=pings.depth)


def _varies(values: Array) -> bool:
    """Whether something was measured; what nothing measures is one number throughout."""
    return bool(np.ptp(values) > 0.0)


def _settings(pings: Pings) -> dict[str, Any]:
    out: dict[str, Any] = {}
    alignment, bias = np.unique(pings.alignment), np.unique(pings.bias)
    if len(alignment) == 1 and alignment[0] and np.all(pings.system < SHIP):
        out["dvl"] = {"mount_rpy_deg": [0.0, 0.0, round(float(np.rad2deg(alignment[0])), 2)]}
    if len(bias) == 1 and bias[0]:
        out["environment"] = {"declination_deg": round(float(np.rad2deg(bias[0])), 2)}
    located = np.flatnonzero(np.isfinite(pings.position[:, 0]))
    if len(located):
        lat, lon = (round(float(v), 7) for v in pings.position[located[0]])
        out["environment"] = out.get("environment", {}) | {"origin_lat_deg": lat, "origin_lon_deg": lon}
    return out


def _notes(pings: Pings) -> Iterator[str]:
    systems, counts = np.unique(pings.system, return_counts=True)
    said = ", ".join(f"{SYSTEMS[s]} {n}" for s, n in zip(systems, counts, strict=True))
    yield f"ensembles by their coordinates: {said}"
    if np.any(pings.system >= SHIP):
        used = int(np.count_nonzero(pings.tilted & (pings.system >= SHIP)))
        yield f"roll and pitch are taken out of the ship or earth velocities of {used} ensembles"
    error = np.abs(pings.error[np.isfinite(pings.error)])
    if len(error):
        yield f"error velocity {1.4826 * float(np.median(error)):.3f} m/s (from its median), the noise of a horizontal axis"
    if np.isfinite(pings.position).any():
        yield "the vehicle's own position is in the table position; its first one is the origin"


def _warnings(pings: Pings, found: Ensembles, channels: tuple[Channel, ...]) -> Iterator[str]:
    if found.failed:
        yield f"{found.failed} ensembles with a wrong checksum are left out"
    if found.skipped:
        yield f"{found.skipped} bytes belong to no whole ensemble"
    dvl = next((c for c in channels if c.sensor == "dvl"), None)
    if dvl is None or not np.any(dvl.columns["dvl_valid"]):
        yield "no bottom track: the instrument did not look for the bottom, or never saw it"
    if not _varies(pings.rpy[:, 2]):
        turned = "; velocities in earth axes are turned by it" if np.any(pings.system == EARTH) else ""
        yield f"the heading is {np.rad2deg(pings.rpy[0, 2]):.2f} deg throughout, so nothing measured it{turned}"
    if np.any(pings.alignment[pings.system != SHIP]):
        yield "beam 3 is not at the bow (EA): compare the heading and the mounting of the DVL with `rovgraph check`"


def _tables(pings: Pings, dated: NDArray[np.bool_]) -> dict[str, dict[str, Array]]:
    rows = dated & pings.tracked
    out: dict[str, dict[str, Array]] = {}
    if rows.any():
        by_beam = {"range": pings.range, "velocity": pings.beams, **pings.quality}
        columns = {f"{name}_{k + 1}": values[rows, k] for name, values in by_beam.items() for k in range(4)}
        out["dvl_beams"] = {"time": pings.time[rows], **columns, "error_velocity": pings.error[rows]}
    located = dated & np.isfinite(pings.position[:, 0])
    if located.any():
        lat, lon = pings.position[located].T
        out["position"] = {"time": pings.time[located], "lat": lat, "lon": lon}
    return out
