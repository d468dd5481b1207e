"""The WGS-84 ellipsoid: radii, normal gravity, Earth rate, and geodetic to local coordinates.

Source: NIMA TR8350.2 (2000), tables 3.1 and 3.3; radii and frames as in P. Groves, Principles
of GNSS, Inertial, and Multisensor Integrated Navigation Systems (2013), chapter 2.
Latitude and longitude are radians, height is metres above the ellipsoid. n is the local
geographic frame: north, east, down.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SEMI_MAJOR = 6378137.0  # [m]
FLATTENING = 1.0 / 298.257223563
EARTH_RATE = 7.292115e-5  # [rad/s]
GM = 3.986004418e14  # [m^3/s^2]
GRAVITY_EQUATOR = 9.7803253359  # [m/s^2]
SOMIGLIANA = 1.931852652458e-3
ECCENTRICITY2 = FLATTENING * (2.0 - FLATTENING)


def radii(latitude: Array) -> tuple[Array, Array]:
    """Radii of curvature in the meridian and in the prime vertical [m]."""
    w2 = 1.0 - ECCENTRICITY2 * np.sin(latitude) ** 2
    transverse = SEMI_MAJOR / np.sqrt(w2)
    return transverse * (1.0 - ECCENTRICITY2) / w2, transverse


def gravity(latitude: Array, height: Array) -> Array:
    """Normal gravity, downwards: Somigliana's formula with its height expansion (TR8350.2 eq. 4-3) [m/s^2]."""
    s2 = np.sin(latitude) ** 2
    surface = GRAVITY_EQUATOR * (1.0 + SOMIGLIANA * s2) / np.sqrt(1.0 - ECCENTRICITY2 * s2)
    b = SEMI_MAJOR * (1.0 - FLATTENING)
    m = EARTH_RATE**2 * SEMI_MAJOR**2 * b / GM
    linear = 1.0 + FLATTENING + m - 2.0 * FLATTENING * s2
    return np.asarray(surface * (1.0 - 2.0 / SEMI_MAJOR * linear * height + 3.0 * (height / SEMI_MAJOR) ** 2))


def earth_rate(latitude: Array) -> Array:
    """Rate of the Earth in n, shape (..., 3) [rad/s]."""
    zero = np.zeros_like(latitude)
    return EARTH_RATE * np.stack([np.cos(latitude), zero, -np.sin(latitude)], axis=-1)


def transport_rate(latitude: Array, height: Array, v_n: Array) -> Array:
    """Rate of n over the ellipsoid, in n, shape (..., 3) [rad/s]; v_n of shape (..., 3)."""
    meridian, transverse = radii(latitude)
    north, east = v_n[..., 0], v_n[..., 1]
    eastwards = east / (transverse + height)
    return np.stack([eastwards, -north / (meridian + height), -eastwards * np.tan(latitude)], axis=-1)


def ecef(latitude: Array, longitude: Array, height: Array) -> Array:
    """Earth-centred coordinates, shape (..., 3) [m]."""
    _, transverse = radii(latitude)
    x = (transverse + height) * np.cos(latitude)
    z = ((1.0 - ECCENTRICITY2) * transverse + height) * np.sin(latitude)
    return np.stack([x * np.cos(longitude), x * np.sin(longitude), z], axis=-1)


def local(latitude: Array, longitude: Array, height: Array, origin: tuple[float, float]) -> Array:
    """North and east in the plane that touches the ellipsoid at ``origin``, and depth; shape (..., 3) [m].

    The third component is the depth below the ellipsoid, which is what a pressure sensor measures.
    """
    lat, lon = (np.asarray(angle) for angle in origin)
    offset = ecef(latitude, longitude, height) - ecef(lat, lon, np.asarray(0.0))
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    east = [-np.sin(lon), np.cos(lon), 0.0]
    return np.stack([offset @ np.asarray(north), offset @ np.asarray(east), -height], axis=-1)
