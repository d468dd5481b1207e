"""GeoPackage and shapefile for a GIS: points with everything that is known of them, in any coordinates."""

from pathlib import Path

import numpy as np
import pandas as pd

from rovgraph.errors import InputError, in_one_line, warn
from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.points import SHOWN_HZ, point_table
from rovgraph.export.track import Track
from rovgraph.geometry import Array

WGS84 = "EPSG:4326"
DRIVERS = {"gpkg": "GPKG", "shp": "ESRI Shapefile"}
LONGEST = 10  # characters of a shapefile's field name


def write_layer(track: Track, path: Path, options: Options, driver: str) -> None:
    """A layer of points with the height above sea level as z.

    Raises
    ------
    InputError : coordinates that are not known
    OSError : it cannot be written
    """
    import pyogrio.errors
    import pyogrio.raw
    import shapely

    shown = track.at_rate(options.rate_or(SHOWN_HZ))
    table = point_table(shown)
    x, y, crs = projected(table["lon"].to_numpy(), table["lat"].to_numpy(), options.crs)
    points = shapely.to_wkb(shapely.points(np.column_stack([x, y, np.nan_to_num(shown.height)])))
    fields = [name[:LONGEST] if driver == "ESRI Shapefile" else name for name in table.columns]
    try:
        pyogrio.raw.write(
            path,
            geometry=points,
            field_data=[_field(table[name]) for name in table.columns],
            fields=np.array(fields, dtype=object),
            geometry_type="Point Z",
            layer=path.stem if driver == "ESRI Shapefile" else "track",
            crs=crs,
            driver=driver,
        )
    except (pyogrio.errors.DataSourceError, pyogrio.errors.FeatureError) as error:  # as of a full disk
        raise OSError(in_one_line(error)) from error


def _field(column: pd.Series) -> Array:
    return column.to_numpy(object if not pd.api.types.is_numeric_dtype(column) else float)


def projected(lon: Array, lat: Array, crs: str | None) -> tuple[Array, Array, str]:
    """Easting and northing in a coordinate system, and its name.

    Parameters
    ----------
    lon, lat : ndarray, shape (n,) [deg], WGS 84
    crs : what pyproj understands, such as "EPSG:25832"; "utm" = the zone of the first point; None = degrees

    Raises
    ------
    InputError : coordinates that are not known
    """
    if not isinstance(crs, str | None):
        raise InputError(f"crs {crs!r}: expected text, such as EPSG:25832, or utm")
    if crs is None:
        return lon, lat, WGS84
    import pyproj

    if crs.lower() == "utm":
        crs = f"EPSG:{326 if lat[0] >= 0 else 327}{int((lon[0] + 180.0) // 6.0) % 60 + 1:02d}"
    try:
        system = pyproj.CRS.from_user_input(crs)
        transform = pyproj.Transformer.from_crs(WGS84, crs, always_xy=True)
    except pyproj.exceptions.CRSError:
        raise InputError(f"crs {crs!r}: is not known; give one such as EPSG:25832, or utm") from None
    if not (system.is_projected or system.is_geographic):
        raise InputError(f"crs {crs!r}: {system.name} is no map's coordinates; give one such as EPSG:25832, or utm")
    if system.area_of_use is not None and not _within(float(lon[0]), float(lat[0]), *system.area_of_use.bounds):
        warn(f"crs {crs!r}: {system.name} is not made for {lat[0]:.3f}, {lon[0]:.3f}; choose one for that place")
    x, y = transform.transform(lon, lat)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise InputError(f"crs {crs!r}: does not reach to {lat[0]:.3f}, {lon[0]:.3f}; choose one for that place")
    return np.asarray(x), np.asarray(y), crs


def _within(lon: float, lat: float, west: float, south: float, east: float, north: float) -> bool:
    """Whether an area, which may lie across the date line, holds a place; all in degrees."""
    return south <= lat <= north and (lon - west) % 360.0 <= ((east - west) % 360.0 or 360.0)


def write_gpkg(track: Track, path: Path, options: Options) -> None:
    """One file."""
    write_layer(track, path, options, DRIVERS["gpkg"])


def write_shp(track: Track, path: Path, options: Options) -> None:
    """A folder with the parts of a shapefile."""
    path.mkdir()
    write_layer(track, path / "track.shp", options, DRIVERS["shp"])


FORMATS = (
    ExportFormat("gpkg", "GeoPackage", ".gpkg", write_gpkg, "gis", needs_place=True),
    ExportFormat("shp", "shapefile", "", write_shp, "gis", needs_place=True),
)
