"""The Earth of WGS 84 under a vehicle: radii of curvature, normal gravity, and the turning of the axes of n.

    M = a (1 - e^2) / (1 - e^2 sin^2 lat)^(3/2)      radius of the meridian
    N = a / (1 - e^2 sin^2 lat)^(1/2)                radius across it
    g = 9.7803253359 (1 + 0.001931852652 sin^2 lat) / (1 - e^2 sin^2 lat)^(1/2)      (Somigliana)

(Groves 2013, 2.4). In frame "earth" the axes of n are those of the meridian where the vehicle is, and its north and
east are latitude and longitude, at the scale that they have at the origin:

    north = (lat - lat_0) M_0,    east = (lon - lon_0) N_0 cos lat_0

All functions take numbers in kernels, and arrays from Python.
"""

from typing import TypeVar

import numpy as np

from rovgraph.geometry import EARTH_RATE, Array
from rovgraph.kernels.compile import helper

Number = TypeVar("Number", float, Array)

SEMI_MAJOR = 6378137.0  # [m]
ECCENTRICITY_SQUARED = 6.69437999014e-3
GRAVITY_PER_DEPTH = 2.216e-6  # down in water: free air less the water above (gsw at 45 deg) [1/s^2]


@helper
def radii(latitude: Number) -> tuple[Number, Number]:
    """M and N at a latitude [rad], on the ellipsoid [m]."""
    rest = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    N = SEMI_MAJOR / np.sqrt(rest)
    return N * (1.0 - ECCENTRICITY_SQUARED) / rest, N


@helper
def normal_gravity(latitude: Number) -> Number:
    """Gravity on the ellipsoid at a latitude [rad], [m/s^2]."""
    square = np.sin(latitude) ** 2
    gravity: Number = 9.7803253359 * (1.0 + 0.001931852652 * square) / np.sqrt(1.0 - ECCENTRICITY_SQUARED * square)
    return gravity


@helper
def latitude_at(latitude_0: float, north: Number) -> Number:
    """Latitude [rad] at a north [m] from an origin of latitude ``latitude_0``."""
    return latitude_0 + north / radii(latitude_0)[0]


@helper
def turning(latitude: float, v_n: Array, rate_out: Array) -> None:
    """Rate of the axes of n [rad/s] at the surface: of the Earth, and by the way over it."""
    M, N = radii(latitude)
    rate_out[0] = EARTH_RATE * np.cos(latitude) + v_n[1] / N
    rate_out[1] = -v_n[0] / M
    rate_out[2] = -EARTH_RATE * np.sin(latitude) - v_n[1] * np.tan(latitude) / N


@helper
def scales(latitude_0: float, latitude: Number, down: Number) -> tuple[Number, Number]:
    """What a metre to the north and one to the east change north and east by, at a latitude [rad] and depth [m]."""
    M_0, N_0 = radii(latitude_0)
    M, N = radii(latitude)
    return M_0 / (M - down), N_0 * np.cos(latitude_0) / ((N - down) * np.cos(latitude))
