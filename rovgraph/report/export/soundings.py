"""The bottom under a track: soundings as XYZ, and gridded as GeoTIFF. Heights are above sea level, less the depth."""

from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.report.export.formats import ExportFormat, ExportOptions
from rovgraph.report.export.maps import coordinates
from rovgraph.report.export.track import Track

CELL_M = 1.0  # of a grid, by default
MOST_CELLS = 100_000_000


def _heights(track: Track) -> tuple[Array, Array, Array]:
    """North, east and height of the soundings that are no spikes [m], shape (n,) each.

    Raises
    ------
    InputError : the dive has none
    """
    if track.soundings is None or not (track.soundings["used"] == 1).any():
        raise InputError(
            f"{track.name}: there are no soundings of the {track.estimate} track; the log needs ranges of the DVL's "
            "beams and dvl.beams, or dvl_altitude, and results that were made again since"
        )
    used = track.soundings[track.soundings["used"] == 1]
    north, east, depth = used[["north", "east", "depth"]].to_numpy(float).T
    return north, east, track.surface - depth


def _mapped(track: Track, crs: str | None) -> tuple[Array, Array, Array, str]:
    """Easting, northing and height of the soundings, and the coordinate system's name."""
    north, east, height = _heights(track)
    lat, lon = track.place(north, east)
    x, y, name = coordinates(lon, lat, crs or "utm")
    return x, y, height, name


def write_xyz(track: Track, path: Path, options: ExportOptions) -> None:
    """A line for each sounding: easting, northing, height; metres from north = east = 0 without a coordinate system."""
    if options.crs is None:
        north, east, height = _heights(track)
        x, y, digits = east, north, 3
    else:
        x, y, height, _ = _mapped(track, options.crs)
        digits = 9 if np.abs(x).max() <= 360.0 and np.abs(y).max() <= 90.0 else 3  # degrees
    np.savetxt(path, np.column_stack([x, y, height]), fmt=[f"%.{digits}f", f"%.{digits}f", "%.3f"])


def write_geotiff(track: Track, path: Path, options: ExportOptions) -> None:
    """Cells north up, with the mean height of their soundings, the sd of these about it, and how many they are.

    Raises
    ------
    InputError : coordinates in degrees, a size of cells that makes no grid
    """
    import pyproj
    import rasterio
    from rasterio.transform import from_origin

    x, y, height, crs = _mapped(track, options.crs)
    cell = CELL_M if options.cell is None else options.cell
    if not pyproj.CRS.from_user_input(crs).is_projected:
        raise InputError(f"crs {crs!r}: is in degrees, a grid needs metres; give one such as EPSG:25832, or utm")
    west, top = (np.floor(x.min() / cell) * cell, np.ceil(y.max() / cell) * cell) if cell > 0.0 else (0.0, 0.0)
    if not 0.0 < cell < np.inf or (np.ptp(x) / cell + 1.0) * (np.ptp(y) / cell + 1.0) > MOST_CELLS:
        raise InputError(f"cell {cell:g}: makes no grid of {np.ptp(x):.0f} by {np.ptp(y):.0f} m; give its metres")
    column, row = ((x - west) / cell).astype(int), ((top - y) / cell).astype(int)
    shape = int(row.max()) + 1, int(column.max()) + 1
    place = row * shape[1] + column

    def summed(values: Array) -> Array:
        return np.asarray(np.bincount(place, values, shape[0] * shape[1]), float)

    count = summed(np.ones(len(x)))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = summed(height) / count
        sd = np.sqrt(summed((height - mean[place]) ** 2) / (count - 1.0))
    bands = {"height [m]": mean, "sd [m]": np.where(count > 1, sd, np.nan), "soundings": count}
    with rasterio.open(
        path, "w", driver="GTiff", height=shape[0], width=shape[1], count=len(bands), dtype="float32", crs=crs,
        transform=from_origin(west, top, cell, cell), nodata=np.nan, compress="deflate",
    ) as file:  # fmt: skip
        file.update_tags(name=track.name, estimate=track.estimate)
        for k, (name, values) in enumerate(bands.items(), 1):
            file.write(values.reshape(shape).astype("float32"), k)
            file.set_band_description(k, name)


FORMATS = (
    ExportFormat("xyz", "soundings, XYZ", ".xyz", write_xyz, "gis"),
    ExportFormat("geotiff", "soundings, gridded (GeoTIFF)", ".tif", write_geotiff, "gis", needs_place=True),
)
