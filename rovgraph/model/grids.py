"""Map grids, such as UTM: places of them on the ellipsoid, and where their north points.

The convergence is where grid north points, clockwise from true north; with it a heading relative to the grid becomes a
true one: true = grid + convergence. Computed by PROJ, which the extra ``gis`` brings.
"""

from functools import cache
from typing import Any

import numpy as np

from rovgraph.errors import InputError, warn
from rovgraph.geometry import Array
from rovgraph.model.origin import Origin, lat_lon

KEY = "environment.grid"
ELLIPSOID = "EPSG:4326"
MARGIN_DEG = 6.0  # beyond the area that a grid is made for


@cache
def _system(name: str, key: str) -> Any:
    """A coordinate system by its name, which was stated as ``key``."""
    try:
        import pyproj
    except ImportError:
        raise InputError(f"{key} {name}: needs pyproj; install it with: pip install 'rovgraph[gis]'") from None
    try:
        return pyproj.CRS.from_user_input(name)
    except pyproj.exceptions.CRSError:
        raise InputError(f"{key} {name!r}: is not known; give one such as EPSG:32632, UTM zone 32") from None


def _grid(name: str) -> Any:
    """The system of ``environment.grid``."""
    system = _system(name, KEY)
    if not system.is_projected:
        what = "is in degrees, no grid" if system.is_geographic else f"{system.name} is no grid"
        raise InputError(f"{KEY} {name!r}: {what}; give one such as EPSG:32632, UTM zone 32")
    return system


def lat_lon_of_grid(grid: str, easting: Array, northing: Array) -> tuple[Array, Array]:
    """Latitude and longitude on WGS 84 [deg] of places of a grid [m], shape (n,) each; NaN stays.

    Raises
    ------
    InputError : no such grid; places that it does not have
    """
    system, transformer = _grid(grid), _transformer(grid, ELLIPSOID)
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


@cache
def _transformer(source: str, target: str) -> Any:
    import pyproj

    return pyproj.Transformer.from_crs(source, target, always_xy=True)


def projected(lon: Array, lat: Array, crs: str, key: str = "crs") -> tuple[Array, Array]:
    """Easting and northing in a coordinate system, shape (n,) each; longitude and latitude in one of degrees.

    Parameters
    ----------
    lon, lat : ndarray, shape (n,) [deg], WGS 84
    crs : what pyproj understands, such as "EPSG:25832"
    key : what it was stated as

    Raises
    ------
    InputError : coordinates that are not known, or that do not reach there
    """
    system = _system(crs, key)
    if not (system.is_projected or system.is_geographic):
        raise InputError(f"{key} {crs!r}: {system.name} is no map's coordinates; give one such as EPSG:25832, or utm")
    x, y = _transformer(ELLIPSOID, crs).transform(lon, lat)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"{key} {crs!r}: does not reach to {lat[0]:.3f}, {lon[0]:.3f}; choose one for that place")
    return np.asarray(x), np.asarray(y)


def warn_outside(lon: float, lat: float, crs: str, key: str = KEY) -> None:
    """Warn of a coordinate system, stated as ``key``, that is not made for a place [deg].

    Raises
    ------
    InputError : coordinates that are not known
    """
    system = _system(crs, key)
    if system.area_of_use is not None and not _within(lon, lat, *system.area_of_use.bounds):
        warn(f"{key} {crs!r}: {system.name} is not made for {lat:.3f}, {lon:.3f}; choose one for that place")


def _within(lon: float, lat: float, west: float, south: float, east: float, north: float) -> bool:
    """Whether an area, which may lie across the date line, holds a place; all in degrees."""
    return south <= lat <= north and (lon - west) % 360.0 <= ((east - west) % 360.0 or 360.0)


def is_projected(crs: str) -> bool:
    """Whether a coordinate system that is known is a grid, and not in degrees."""
    return bool(_system(crs, "crs").is_projected)


PLACE_DECIMALS = {"lat": 9, "lon": 9, "easting": 4, "northing": 4, "grid_north": 5, "grid_scale": 8}


def place_columns(north: Array, east: Array, origin: Origin | None, grid: str | None = None) -> dict[str, Array]:
    """Where places are on Earth, for tables, to be written with `PLACE_DECIMALS`: a tenth of a millimetre.

    Parameters
    ----------
    north, east : ndarray, shape (n,) [m]
    origin : latitude and longitude [deg] of north = east = 0; None = not known
    grid : for the columns of `grid_columns` too; None = without

    Returns
    -------
    dict : ``lat``, ``lon`` [deg] and those of the grid, ndarray, shape (n,); empty without an origin

    Raises
    ------
    InputError : no such grid; it does not reach there
    """
    if origin is None:
        return {}
    lat, lon = lat_lon(north, east, origin)
    return {"lat": lat, "lon": lon} | ({} if grid is None else grid_columns(grid, lat, lon))


def grid_columns(grid: str, lat: Array, lon: Array) -> dict[str, Array]:
    """Places of a grid, for tables: ``easting``, ``northing`` [m], ``grid_north`` [deg] and ``grid_scale``.

    The latter two are those of `convergence_and_scale`; all are ndarray, shape (n,).

    Raises
    ------
    InputError : no such grid; it does not reach there
    """
    easting, northing = projected(lon, lat, grid, KEY)
    north, scale = convergence_and_scale(grid, lat, lon)
    return {"easting": easting, "northing": northing, "grid_north": north, "grid_scale": scale}


def convergence_and_scale(grid: str, lat: Array, lon: Array) -> tuple[Array, Array]:
    """Where grid north points, clockwise from true north [deg], and metres of the grid for one of the ground.

    Parameters
    ----------
    lat, lon : on WGS 84 [deg], shape (n,) or numbers, which gives such

    Raises
    ------
    InputError : no such grid; it does not reach there
    """
    system = _grid(grid)
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
