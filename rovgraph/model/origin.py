"""Where north = east = 0 lies, and what latitude and longitude are there in north and east.

An origin is a pair of latitude and longitude [deg]. A plain pair is that of a flat frame, the plane that touches the
ellipsoid there. An `EarthOrigin` is that of frame "earth" (`rovgraph.kernels.earth`), in which north and east are
latitude and longitude at the scale of the origin: along a meridian and a parallel they are metres near it, and both
ways are exact however far.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.geometry import Array
from rovgraph.kernels.earth import latitude_at, radii, scales


class EarthOrigin(NamedTuple):
    """Latitude and longitude [deg] of north = east = 0 in frame "earth"."""

    lat: float
    lon: float

    @property
    def metres_per_degree(self) -> tuple[float, float]:
        """Of latitude to the north, and of longitude to the east."""
        M, N = radii(np.deg2rad(self.lat))
        return float(np.deg2rad(M)), float(np.deg2rad(N * np.cos(np.deg2rad(self.lat))))


Origin = tuple[float, float] | EarthOrigin
Frame = Literal["flat", "earth"]
DRIFT, OF_DRIFT = 0.005, 0.1  # expected, of the way; share of it by which a plane may be wrong


def origin_in(frame: str, lat: float, lon: float) -> Origin:
    """An origin of a frame; of "auto" that of a flat one."""
    return EarthOrigin(lat, lon) if frame == "earth" else (lat, lon)


def frame_of(origin: Origin) -> Frame:
    """The frame whose origin it is."""
    return "earth" if isinstance(origin, EarthOrigin) else "flat"


def scale_at(latitude: float, p_n: Array) -> Array:
    """What a metre changes north, east and down by at some places.

    Parameters
    ----------
    latitude : of the origin of frame "earth" [rad]; NaN = n is flat
    p_n : ndarray, shape (k, 3) [m]

    Returns
    -------
    ndarray, shape (k, 3)
    """
    out = np.ones_like(p_n)
    if not np.isnan(latitude):
        out[:, :2] = np.column_stack(scales(latitude, latitude_at(latitude, p_n[:, 0]), p_n[:, 2]))
    return out


def flat_error(latitude: float, metres: float) -> float:
    """By how much a plane is wrong at a distance from the origin, whose latitude is in degrees [m]."""
    at = np.deg2rad(latitude)
    return float(metres**2 * abs(np.tan(at)) / (2.0 * radii(at)[1]))


def outgrows_plane(latitude: float, away: float, way: float) -> bool:
    """Whether a plane is wrong by a tenth of the drift of a way, somewhere along it or up to ``away`` [m]."""
    return flat_error(latitude, max(away, way)) > OF_DRIFT * DRIFT * max(away, way)


def north_east(lat: ArrayLike, lon: ArrayLike, origin: Origin) -> tuple[Array, Array]:
    """North and east [m] of latitudes and longitudes [deg], n of each."""
    if isinstance(origin, EarthOrigin):
        of_lat, of_lon = origin.metres_per_degree
        east = np.asarray(lon, float) - origin.lon
        return (np.asarray(lat, float) - origin.lat) * of_lat, (east - 360.0 * np.round(east / 360.0)) * of_lon
    from pymap3d import geodetic2ned  # only logs with latitudes need it

    north, east, _ = geodetic2ned(lat, lon, 0.0, *origin, 0.0)
    return north, east


def lat_lon(north: ArrayLike, east: ArrayLike, origin: Origin) -> tuple[Array, Array]:
    """Latitude, and longitude from -180 to 180 [deg], of n places [m]."""
    if isinstance(origin, EarthOrigin):
        of_lat, of_lon = origin.metres_per_degree
        lon = origin.lon + np.asarray(east, float) / of_lon
        return origin.lat + np.asarray(north, float) / of_lat, lon - 360.0 * np.round(lon / 360.0)
    from pymap3d import ned2geodetic

    lat, lon, _ = ned2geodetic(north, east, 0.0, *origin, 0.0)
    return lat, lon
