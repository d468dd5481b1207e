"""Pings of Teledyne's Doppler instruments, from any of their formats and coordinate systems, as channels of a log.

A log has the velocity of the instrument, along axes forward (beam 3, or the ship's bow), starboard, down. In the
instrument's system X is from beam 1 to beam 2, Y from beam 4 to beam 3 and Z away from the bottom it looks at; in the
ship's X is to starboard, Y forward and Z up the mast; Earth has east, north, up. Source: Teledyne RD Instruments, ADCP
Coordinate Transformation, P/N 951-6079-00.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, wrap_angle
from rovgraph.readers.recording import Channel, Clock, Left, Recording, sound_of_dvl
from rovgraph.sensors.dvl_beam import BEAMS

BEAM, INSTRUMENT, SHIP, EARTH = range(4)
SYSTEMS = "beam", "instrument", "ship", "earth"
FORWARD = np.array([1, 0, 2])  # places of forward, starboard and the vertical in a triple
DOWN = np.array([1.0, 1.0, -1.0])  # the vertical turned downwards


@dataclass(frozen=True)
class Attitude:
    """How each of n velocities was measured.

    Attributes
    ----------
    rpy : ndarray, shape (n, 3), roll, pitch, heading that the instrument computed with [rad]
    tilted : ndarray of bool, shape (n,), roll and pitch were used for ship or Earth axes
    upward : ndarray of bool, shape (n,), the instrument looks up
    beam_angle : ndarray, shape (n,), of the beams against its axis [rad]
    convex : ndarray of bool, shape (n,), the beams diverge
    """

    rpy: Array
    tilted: NDArray[np.bool_]
    upward: NDArray[np.bool_]
    beam_angle: Array
    convex: NDArray[np.bool_]


def forward_starboard_down(values: Array, system: NDArray[np.integer], attitude: Attitude) -> tuple[Array, Array]:
    """Velocities along axes forward (Y), starboard (X) and down (-Z) of the instrument, upwards ones turned over.

    Parameters
    ----------
    values : ndarray, shape (n, 4), four beams, or three axes and the error velocity; NaN = not measured [m/s]
    system : ndarray, shape (n,), `BEAM`, `INSTRUMENT`, `SHIP` or `EARTH`

    Returns
    -------
    velocity, shape (n, 3), and error velocity, shape (n,) [m/s]
    """
    values = np.where((system == BEAM)[:, None], _of_beams(values, attitude), values)
    velocity = values[:, FORWARD] * DOWN
    of_instrument = (system == BEAM) | (system == INSTRUMENT)
    velocity[of_instrument & attitude.upward] *= [1.0, -1.0, -1.0]  # turned over about the forward axis
    angles = attitude.rpy * np.column_stack([attitude.tilted, attitude.tilted, system == EARTH])
    velocity[:] = np.where(of_instrument[:, None], velocity, (velocity[:, None] @ matrix_from_rpy(angles))[:, 0])
    return velocity, values[:, 3]


def _of_beams(beams: Array, attitude: Attitude) -> Array:
    """X, Y, Z and error velocity of beams, shape (n, 4); one beam that is missing is what gives no error."""
    missing = np.isnan(beams)
    signs = np.array([1.0, 1.0, -1.0, -1.0])
    rest = np.nansum(beams * signs, axis=1, keepdims=True)
    three = missing.sum(axis=1, keepdims=True) == 1
    beams = np.where(missing & three, -rest * signs, beams)
    b1, b2, b3, b4 = beams.T
    across = 1.0 / (2.0 * np.sin(attitude.beam_angle))
    sign = np.where(attitude.convex, 1.0, -1.0)
    error = np.where(three[:, 0], np.nan, across / np.sqrt(2.0) * (b1 + b2 - b3 - b4))
    vertical = (b1 + b2 + b3 + b4) / (4.0 * np.cos(attitude.beam_angle))
    return np.column_stack([sign * across * (b1 - b2), sign * across * (b4 - b3), vertical, error])


@dataclass(frozen=True)
class BeamHead:
    """Beams that look to port, starboard, forward and aft.

    Attributes
    ----------
    angle_deg : against its axis [deg]
    convex : they diverge
    """

    angle_deg: float
    convex: bool


CLOCK = "DVL's clock"
FRAME = "forward (beam 3, or the ship's bow), starboard, down"
NAMES = "dvl_vx", "dvl_vy", "dvl_vz"
AZIMUTHS_DEG = [270.0, 90.0, 0.0, 180.0]  # of beams 1 to 4, from beam 3
DEFAULT_PSU = 35.0  # salinity that nobody has set
SOLUTIONS = "percent_three_beam", "percent_rejected", "percent_beams_bad", "percent_four_beam"
WHOLE_PERCENT = 104.0  # of shares that are rounded each
WATER = "dvl_water_vx", "dvl_water_vy", "dvl_water_vz"


@dataclass(frozen=True)
class Pings:
    """The values of n ensembles, in SI.

    Attributes
    ----------
    time : shape (n,), as if its calendar were UTC [s since 1970]; NaN where the date is invalid
    system : shape (n,), coordinates
    velocity, water : shape (n, 3), over the bottom and through the water, axes as `FRAME` says; NaN = none [m/s]
    error : shape (n,), error velocity of the bottom track [m/s]
    rpy : shape (n, 3), roll, pitch and heading as printed [rad]
    bias : shape (n,), what was added to the heading [rad]
    alignment : shape (n,), of beam 3 against the bow [rad]
    tilted : shape (n,), roll and pitch were used for ship or Earth axes
    depth : shape (n,) [m]
    range : shape (n, 4), to the bottom along the instrument's axis; NaN = none [m]
    beams : shape (n, 4), velocity of the bottom towards each beam, so of the instrument along it; NaN = not written
        [m/s]
    quality : name -> shape (n, 4), of the beams
    percent_good : shape (n, 4), of the beams, or of kinds of solution (`_percent_good`)
    sound, temperature, salinity : shape (n,), speed of sound that it worked with [m/s], water at its head [deg C] and
        its salinity [psu], where it has no part in that speed; NaN = not known
    head : its beams, where all pings have the same
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
    percent_good: Array
    sound: Array
    temperature: Array
    salinity: Array
    head: BeamHead | None
    position: Array
    tracked: NDArray[np.bool_]


def recording(
    path: Path, name: str, pings: Pings, clock: Clock, left: tuple[Left, ...], warnings: tuple[str, ...]
) -> Recording:
    """A recording of all pings of a file.

    Parameters
    ----------
    name : of the file's format
    left, warnings : of its reader

    Raises
    ------
    InputError : none of them has a time
    """
    dated = np.isfinite(pings.time)
    if not dated.any():
        raise InputError(f"{path}: none of {len(dated)} ensembles has a valid time; set the instrument's clock")
    water, sound = sound_of_dvl(pings.time, pings.sound, pings.temperature, "speed of sound", clock.name)
    channels = (*channels_of(pings), *water)
    more = []
    if undated := int(np.count_nonzero(~dated)):
        more.append(Left("ensemble", undated, "no valid time"))
    if located := int(np.isfinite(pings.position[:, 0]).sum()):
        more.append(Left("position", located, "reckoned by the vehicle"))
    return Recording(
        str(path),
        name,
        channels,
        {clock.name: clock},
        (*left, *more),
        _settings(pings, sound, any("water_temperature" in channel.columns for channel in water)),
        tuple(_notes(pings)),
        (*warnings, *_warnings(pings, channels)),
        _tables(pings, dated),
    )


def channels_of(pings: Pings, constants: bool = False) -> Iterator[Channel]:
    """Channels of all pings that have a time.

    Parameters
    ----------
    constants : what is one number throughout is a measurement, as in a single ping; else nothing measured it
    """
    dated = np.isfinite(pings.time)

    def channel(sensor: str, rows: NDArray[np.bool_], source: str, frame: str, **columns: Array) -> Iterator[Channel]:
        rows = rows & dated
        if rows.any():
            kept = {name: values[rows] for name, values in (("time", pings.time), *columns.items())}
            yield Channel(sensor, kept, f"{source}: {', '.join(columns)}", frame, CLOCK)

    valid = np.asarray(np.isfinite(pings.velocity).all(axis=1))
    velocity = dict(zip(NAMES, np.where(valid[:, None], pings.velocity, np.nan).T, strict=True))
    yield from channel("dvl", pings.tracked, "bottom track", FRAME, **velocity, dvl_valid=valid.astype(float))
    through = np.asarray(np.isfinite(pings.water).all(axis=1))
    yield from channel("dvl_water", through, "water layer", FRAME, **dict(zip(WATER, pings.water.T, strict=True)))
    seen = np.isfinite(pings.range)
    altitude = np.nansum(pings.range, axis=1) / np.maximum(seen.sum(axis=1), 1)
    bounced = np.asarray(seen.any(axis=1))
    yield from channel("dvl_altitude", bounced, "mean range of the beams", "", dvl_altitude=altitude)
    roll, pitch, heading = pings.rpy.T
    heading = wrap_angle(heading - pings.bias)
    ship = pings.system == SHIP
    if _measured(heading, constants):
        yield from channel("vehicle_heading", ship, "heading", FRAME, heading=heading)
        yield from channel("dvl_heading", ~ship, "heading", FRAME, dvl_heading=heading)
    if _measured(roll, constants) or _measured(pitch, constants):
        yield from channel("vehicle_tilt", np.ones(len(roll), dtype=bool), "attitude", FRAME, roll=roll, pitch=pitch)
    if _measured(pings.depth, constants):
        yield from channel("depth", np.ones(len(roll), dtype=bool), "depth of the transducer", "", depth=pings.depth)


def _measured(values: Array, constants: bool = False) -> bool:
    """Whether there is a measurement; what nothing measures is one number throughout."""
    return bool(np.ptp(values) > 0.0) or (constants and bool(np.isfinite(values).any()))


def _settings(pings: Pings, sound: dict[str, Any], measured: bool) -> dict[str, Any]:
    out: dict[str, Any] = {}
    if sound:
        out["dvl"] = sound
    if pings.head is not None and np.isfinite(pings.beams).any():
        out["dvl"] = out.get("dvl", {}) | {"beams": beams_setting(pings.head)}
    salinity = np.unique(pings.salinity)
    if len(salinity) == 1 and np.isfinite(salinity[0]) and salinity[0] != DEFAULT_PSU and measured:
        out["sound"] = {"salinity_psu": float(salinity[0])}
    alignment, bias = np.unique(pings.alignment), np.unique(pings.bias)
    if len(alignment) == 1 and alignment[0] and np.all(pings.system < SHIP):
        out["dvl"] = out.get("dvl", {}) | {"mount_rpy_deg": [0.0, 0.0, round(float(np.rad2deg(alignment[0])), 2)]}
    if len(bias) == 1 and bias[0]:
        out["environment"] = {"declination_deg": round(float(np.rad2deg(bias[0])), 2)}
    located = np.flatnonzero(np.isfinite(pings.position[:, 0]))
    if len(located):
        lat, lon = (round(float(v), 7) for v in pings.position[located[0]])
        out["environment"] = out.get("environment", {}) | {"origin_lat_deg": lat, "origin_lon_deg": lon}
    return out


def beams_setting(head: BeamHead) -> dict[str, Any]:
    """A configuration's ``dvl.beams``."""
    stated: dict[str, Any] = {"angle_deg": head.angle_deg, "azimuth_deg": AZIMUTHS_DEG}
    return stated | ({} if head.convex else {"convex": False})


def _notes(pings: Pings) -> Iterator[str]:
    systems, counts = np.unique(pings.system, return_counts=True)
    said = ", ".join(f"{SYSTEMS[s]} {n}" for s, n in zip(systems, counts, strict=True))
    yield f"ensembles by their coordinates: {said}"
    if np.any(pings.system >= SHIP):
        used = int(np.count_nonzero(pings.tilted & (pings.system >= SHIP)))
        if used:
            yield f"roll and pitch are taken out of the ship or earth velocities of {used} ensembles"
    error = np.abs(pings.error[np.isfinite(pings.error)])
    if len(error):
        sd = 1.4826 * float(np.median(error))
        yield f"error velocity {sd:.3f} m/s (from its median), which is the noise of a horizontal axis"
    if np.isfinite(pings.position).any():
        yield "the vehicle's own position is in the table position; its first one is the origin"


def _warnings(pings: Pings, channels: tuple[Channel, ...]) -> Iterator[str]:
    dvl = next((c for c in channels if c.sensor == "dvl"), None)
    if dvl is None or not np.any(dvl.columns["dvl_valid"]):
        yield "no bottom track: the instrument did not look for the bottom, or never saw it"
    if np.isfinite(pings.rpy[:, 2]).any() and not _measured(pings.rpy[:, 2]):
        turned = "; velocities in earth axes are turned by it" if np.any(pings.system == EARTH) else ""
        yield f"the heading is {np.rad2deg(pings.rpy[0, 2]):.2f} deg throughout, so nothing measured it{turned}"
    if np.any(pings.alignment[pings.system != SHIP]):
        yield "beam 3 is not at the bow (EA): compare the heading and the mounting of the DVL with `rovgraph check`"


def _percent_good(pings: Pings) -> tuple[str, ...]:
    """What the four percentages are of: beams, or kinds of solution, which sum up to 100."""
    shares = pings.percent_good.sum(axis=1)
    if not shares.any():
        return ()
    return SOLUTIONS if shares.max() <= WHOLE_PERCENT else tuple(f"percent_good_{k + 1}" for k in range(4))


def _tables(pings: Pings, dated: NDArray[np.bool_]) -> dict[str, dict[str, Array]]:
    rows = dated & pings.tracked
    out: dict[str, dict[str, Array]] = {}
    if rows.any():
        by_beam = {"distance": pings.range, "velocity": pings.beams, **pings.quality}
        if not np.isfinite(pings.beams).any():
            del by_beam["velocity"]
        columns = {f"{name}_{k + 1}": values[rows, k] for name, values in by_beam.items() for k in range(4)}
        columns |= dict(zip(_percent_good(pings), pings.percent_good[rows].T, strict=False))
        out[BEAMS] = {"time": pings.time[rows], **columns, "error_velocity": pings.error[rows]}
    located = dated & np.isfinite(pings.position[:, 0])
    if located.any():
        lat, lon = pings.position[located].T
        out["position"] = {"time": pings.time[located], "lat": lat, "lon": lon}
    return out
