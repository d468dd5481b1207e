"""Latitude and longitude of one place near an origin, in plain numbers: arrays of one cost fifty times as much.

North and east lie in the plane that touches the ellipsoid at the origin. The latitude is that of Bowring (1976), exact
to a nanometre near the surface.
"""

import math

A = 6378137.0  # WGS 84 [m]
B = A * (1.0 - 1.0 / 298.257223563)
E2 = 1.0 - (B / A) ** 2  # eccentricity squared


def geodetic(north: float, east: float, origin: tuple[float, float]) -> tuple[float, float]:
    """Latitude and longitude [deg] of a place.

    Parameters
    ----------
    north, east : from the origin [m]
    origin : latitude and longitude [deg] of north = east = 0
    """
    lat, lon = math.radians(origin[0]), math.radians(origin[1])
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    radius = A / math.sqrt(1.0 - E2 * sin_lat**2)  # of curvature, east and west
    outwards = radius * cos_lat - sin_lat * north  # from the Earth's axis, in the origin's meridian
    x, y = outwards * cos_lon - sin_lon * east, outwards * sin_lon + cos_lon * east
    z = (1.0 - E2) * radius * sin_lat + cos_lat * north
    from_axis = math.hypot(x, y)
    reduced = math.atan2(A * z, B * from_axis)
    up, out = z + E2 * A**2 / B * math.sin(reduced) ** 3, from_axis - E2 * A * math.cos(reduced) ** 3
    return math.degrees(math.atan2(up, out)), math.degrees(math.atan2(y, x))
