"""Map grids, such as UTM: places of them on the ellipsoid, and where their north points.

The convergence is where grid north points, clockwise from true north; with it a heading relative to the grid becomes a
true one: true = grid + convergence. Computed by PROJ, which the extra ``gis`` brings.
"""

from functools import cache
from typing import Any

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array

ELLIPSOID = "EPSG:4326"
MARGIN_DEG = 6.0  # beyond the area that a grid is made for


@cache
def _system(grid: str) -> tuple[Any, Any]:
    """The grid, and what takes its places to the ellipsoid."""
    try:
        import pyproj
    except ImportError:
        text = f"environment.grid {grid}: needs pyproj; install it with: pip install 'rovgraph[gis]'"
        raise InputError(text) from None
    try:
        system = pyproj.CRS.from_user_input(grid)
    except pyproj.exceptions.CRSError:
        raise InputError(f"environment.grid {grid!r}: is not known; give one such as EPSG:32632, UTM zone 32") from None
    if not system.is_projected:
        raise InputError(f"environment.grid {grid!r}: is in degrees, no grid; give one such as EPSG:32632, UTM zone 32")
    return system, pyproj.Transformer.from_crs(system, ELLIPSOID, always_xy=True)


def lat_lon_of_grid(grid: str, easting: Array, northing: Array) -> tuple[Array, Array]:
    """Latitude and longitude on WGS 84 [deg] of places of a grid [m], shape (n,) each; NaN stays.

    Raises
    ------
    InputError : no such grid; places that it does not have
    """
    system, transformer = _system(grid)
    known = np.isfinite(easting) & np.isfinite(northing)
    lon, lat = (np.full(len(easting), np.nan) for _ in range(2))
    lon[known], lat[known] = transformer.transform(easting[known], northing[known])
    area = system.area_of_use
    if area is not None and known.any():
        here = float(np.median(lat[known])), float(np.median(lon[known]))
        wide = area.west > area.east  # over the date line
        inside = area.west - MARGIN_DEG <= here[1] <= area.east + MARGIN_DEG
        if not area.south - MARGIN_DEG <= here[0] <= area.north + MARGIN_DEG or not (wide or inside):
            raise InputError(
                f"environment.grid {grid}: {system.name} has no place with easting {np.median(easting[known]):.0f}, "
                f"northing {np.median(northing[known]):.0f}; state the grid of that place, and check which is which"
            )
    return lat, lon


def convergence_and_scale(grid: str, lat: Array, lon: Array) -> tuple[Array, Array]:
    """Where grid north points, clockwise from true north [deg], and metres of the grid for one of the ground.

    Parameters
    ----------
    lat, lon : on WGS 84 [deg], shape (n,) or numbers, which gives such

    Raises
    ------
    InputError : no such grid; it does not reach there
    """
    system, _ = _system(grid)
    import pyproj

    try:
        factors = pyproj.Proj(system).get_factors(lon, lat, errcheck=True)
    except pyproj.exceptions.ProjError:
        somewhere = f"{np.ravel(lat)[0]:.3f}, {np.ravel(lon)[0]:.3f}"
        raise InputError(f"environment.grid {grid}: does not reach to {somewhere}") from None
    return np.asarray(factors.meridian_convergence), np.asarray(factors.meridional_scale)


def utm_zone(lat: float, lon: float) -> str:
    """The zone of UTM that a place [deg] is in, such as "EPSG:32632"."""
    return f"EPSG:{326 if lat >= 0 else 327}{int((lon + 180.0) // 6.0) % 60 + 1:02d}"
