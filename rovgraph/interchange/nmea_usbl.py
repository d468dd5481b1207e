"""Fixes of a vehicle from a ship's acoustic positioning: PSIMSSB beside the ship's own fixes and heading.

``$PSIMSSB,hhmmss.ss,transponder,status,error,coordinates,orientation,filter,x,y,depth,accuracy,...``: Cartesian
coordinates (C) [m] along starboard and bow (H), north and east (N) or east and north (E). Its clock is UTC or local
time, so that whole half hours of it do not count. Status A does not mean a reply: an error code does not (NRy: none),
and the position is then a zero or an extrapolated one, as it is where the filter says P for predicted. M is measured, F
filtered, which follows turns late. ``$PSIMSNS,hhmmss.ss,transponder,transceiver,transducer,roll,pitch,heave,heading,``
has the ship's attitude at a ping. Source: Kongsberg Simrad, HiPAP/HPR 400 NMEA 0183 sentences, 850-160045.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array
from rovgraph.interchange.lines import Refused
from rovgraph.interchange.nmea_sentences import number

KIND, SHIPS_ATTITUDE = "PSIMSSB", "PSIMSNS"
HEAD_UP, NORTH_UP, EAST_FIRST = range(3)
ORIENTATIONS = {"H": HEAD_UP, "N": NORTH_UP, "E": EAST_FIRST}
HALF_HOUR_S = 1800.0
FAR_S = 30.0  # between the ship's fixes; in a longer gap it is not known where she was


@dataclass(frozen=True)
class Ship:
    """Where a ship was, and which way she pointed.

    Attributes
    ----------
    time : of her fixes, increasing, shape (n,) [s]
    lat, lon : shape (n,) [deg]
    heading_time, heading : relative to true north, shape (m,), m may be 0 [s], [rad]
    """

    time: Array
    lat: Array
    lon: Array
    heading_time: Array
    heading: Array


def relative_position(text: str, last: float | None) -> tuple[str, tuple[float, ...]]:
    """Name of the transponder, and numbers of a position relative to the ship.

    They are seconds since the last sentence with a time, x, y [m], orientation, accuracy [m], and 1 where the system
    has filtered it, else 0.

    Parameters
    ----------
    text : of the sentence, whose checksum is right
    last : time of that sentence, None = there is none [s]

    Raises
    ------
    Refused : nothing that can be added to a ship's position
    """
    cells = [*text.partition("*")[0].split(",")[1:], *[""] * 14]
    clock, name, status, error, coordinates, orientation, filtered = cells[:7]
    if status != "A":
        raise Refused("no position", "the system marks it as not OK")
    if error.strip():
        raise Refused("no position", f"error {error.strip()}: not a reply")
    if filtered == "P":
        raise Refused("no position", "predicted, not measured")
    x, y, seconds = number(cells[7]), number(cells[8]), _seconds(clock)
    if coordinates != "C" or orientation not in ORIENTATIONS:
        raise Refused("no position", "not in Cartesian coordinates relative to a ship")
    if x is None or y is None or seconds is None or last is None:
        raise Refused("no position", "without a time or a coordinate")
    late = (seconds - last + 0.5 * HALF_HOUR_S) % HALF_HOUR_S - 0.5 * HALF_HOUR_S
    accuracy = number(cells[10])
    sd = accuracy if accuracy is not None and accuracy > 0.0 else np.nan
    return name, (late, x, y, float(ORIENTATIONS[orientation]), sd, float(filtered == "F"))


def ships_heading(text: str) -> float:
    """Heading of the ship in a PSIMSNS, relative to true north [rad].

    Raises
    ------
    Refused : it has none
    """
    cells = [*text.partition("*")[0].split(",")[1:], *[""] * 8]
    heading = number(cells[7])
    if heading is None or not 0.0 <= heading <= 360.0:
        raise Refused("no heading", "without the ship's heading")
    return float(np.deg2rad(heading))


def positions(ship: Ship, time: Array, x: Array, y: Array, orientation: Array) -> tuple[Array, Array]:
    """Latitude and longitude [deg] of a vehicle, shape (k,); NaN where the ship's position or heading is not known.

    Parameters
    ----------
    time : shape (k,) [s]
    x, y : as the sentence has them, shape (k,) [m]
    orientation : `HEAD_UP`, `NORTH_UP` or `EAST_FIRST`, shape (k,)
    """
    import pymap3d

    origin = float(np.median(ship.lat)), float(ship.lon[len(ship.lon) // 2]), 0.0
    ship_north, ship_east, _ = pymap3d.geodetic2ned(ship.lat, ship.lon, 0.0, *origin)
    heading = np.full(len(time), np.nan)
    if len(ship.heading_time):
        heading = np.interp(time, ship.heading_time, np.unwrap(ship.heading))
        heading[_away(time, ship.heading_time)] = np.nan
    sine, cosine = np.sin(heading), np.cos(heading)
    north = np.choose(orientation.astype(int), [y * cosine - x * sine, x, y])
    east = np.choose(orientation.astype(int), [y * sine + x * cosine, y, x])
    north, east = north + np.interp(time, ship.time, ship_north), east + np.interp(time, ship.time, ship_east)
    north[_away(time, ship.time)] = np.nan
    lat, lon, _ = pymap3d.ned2geodetic(north, east, 0.0, *origin)
    return np.asarray(lat), np.asarray(lon)


def _away(time: Array, known: Array) -> Array:
    """Which times have no known one within `FAR_S` on either side."""
    after = np.searchsorted(known, time).clip(1, max(len(known) - 1, 1))
    before = known[(after - 1).clip(0, len(known) - 1)]
    after_time = known[after.clip(0, len(known) - 1)]
    return np.asarray(np.maximum(np.abs(time - before), np.abs(time - after_time)) > FAR_S)


def _seconds(clock: str) -> float | None:
    """Seconds of the day of ``hhmmss.ss``."""
    if len(clock) < 6 or not clock[:6].isdigit() or number(clock) is None:
        return None
    return 3600.0 * int(clock[:2]) + 60.0 * int(clock[2:4]) + float(clock[4:])
