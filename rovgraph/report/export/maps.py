"""Maps: GeoJSON, KML and KMZ, GPX, GeoPackage and shapefile.

GeoJSON (RFC 7946): the track as a line, points with their sds, 95 % ellipses and fixes; heights above sea level.

KML and KMZ for Google Earth and chart plotters: a track that moves with time, 95 % ellipses and fixes.

GPX 1.1 for chart plotters and phones: a track; elevation is above sea level.

GeoPackage and shapefile for a GIS: points with all their values, in any coordinates.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from rovgraph.errors import InputError, in_one_line
from rovgraph.geometry import Array
from rovgraph.model.grids import ELLIPSOID, convergence_and_scale, is_projected, projected, utm_zone, warn_outside
from rovgraph.report.export.formats import ExportFormat, ExportOptions
from rovgraph.report.export.track import SHOWN_HZ, Track, ellipse, point_table

if TYPE_CHECKING:
    import simplekml

GEOJSON_ELLIPSES = 100  # along a track
Feature = dict[str, Any]


def write_geojson(track: Track, path: Path, options: ExportOptions) -> None:
    """A feature collection; ``kind`` of each feature is track, point, ellipse, fix, ship or beacon."""
    points = track.at_rate(options.rate_or(SHOWN_HZ))
    features = [_line(track), *_points(points), *_ellipses(points), *_fixes(track), *_acoustics(track)]
    collection = {"type": "FeatureCollection", "name": track.name, "features": features}
    path.write_text(json.dumps(collection, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8")


def _line(track: Track) -> Feature:
    return _feature("LineString", _coordinates(track), kind="track", name=track.name, estimate=track.estimate)


def _points(track: Track) -> Iterator[Feature]:
    table = point_table(track)
    for where, row in zip(_coordinates(track), table.drop(columns=["lat", "lon"]).to_dict("records"), strict=True):
        known = {str(name): value for name, value in row.items() if value == value}
        yield _feature("Point", where, kind="point", **known)


def _ellipses(track: Track) -> Iterator[Feature]:
    t = track.trajectory
    for k in np.unique(np.linspace(0, len(t) - 1, GEOJSON_ELLIPSES).astype(int)):
        if np.isfinite(P := t.cov_p[k, :2, :2]).all():
            ring = _ring(track, t.p_n[k, :2] + ellipse(P))
            yield _feature("Polygon", [ring], kind="ellipse", time=round(float(t.time[k]), 4), probability=0.95)


def _fixes(track: Track) -> Iterator[Feature]:
    if track.fixes is None:
        return
    lat, lon = track.place(*track.fixes.position.T)
    places = zip(track.fixes.time, track.fixes.used, track.continuous(lon), lat, strict=True)
    for time, used, *where in places:
        place = [round(float(x), 9) for x in where]
        yield _feature("Point", place, kind="fix", time=round(float(time), 4), used=bool(used))


def _acoustics(track: Track) -> Iterator[Feature]:
    if track.acoustics is None:
        return
    if len(ship := track.acoustics.ship) > 1:
        yield _feature("LineString", _places(track, ship), kind="ship")
    for name, (north, east, north_sd, east_sd) in track.acoustics.beacons.items():
        sds = {"north_sd": round(north_sd, 4), "east_sd": round(east_sd, 4)}
        yield _feature("Point", _places(track, np.array([[north, east]]))[0], kind="beacon", name=name, **sds)


def _places(track: Track, places: Array) -> list[list[float]]:
    """Longitude and latitude of places, shape (n, 2)."""
    lat, lon = track.place(*places.T)
    found: list[list[float]] = np.column_stack([track.continuous(lon), lat]).round(9).tolist()
    return found


def _ring(track: Track, corners: Array) -> list[list[float]]:
    ring = _places(track, corners[:-1])
    return [*ring, ring[0]]


def _coordinates(track: Track) -> list[list[float]]:
    lat, lon = track.lat_lon
    where = np.column_stack([track.continuous(lon).round(9), lat.round(9), track.height.round(4)])
    coordinates: list[list[float]] = where[:, : 2 if np.isnan(where[:, 2]).any() else 3].tolist()
    return coordinates


def _feature(kind_of_geometry: str, coordinates: Any, **properties: Any) -> Feature:
    geometry = {"type": kind_of_geometry, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


_GEOJSON = (ExportFormat("geojson", "GeoJSON", ".geojson", write_geojson, needs_place=True),)


KML_ELLIPSES = 60  # along a track
LINE, USED, REJECTED, SHADE, SHIP = "ff00a5ff", "ff00c000", "ff0000ff", "4000a5ff", "ff808080"  # aabbggrr


def document(track: Track, options: ExportOptions) -> "simplekml.Kml":
    """The track; with time where that is known, as a plain line elsewhere."""
    import simplekml

    kml = simplekml.Kml(name=f"{track.name}, {track.estimate}")
    sampled = track.at_rate(options.rate_or(SHOWN_HZ))
    lat, lon = sampled.lat_lon
    lon = track.continuous(lon)
    height = np.nan_to_num(sampled.height)
    coordinates = np.column_stack([lon.round(9), lat.round(9), height.round(4)]).tolist()
    if track.has_utc:
        line = kml.newgxtrack(name=track.name, altitudemode="absolute")
        line.newwhen([stamp.strftime("%Y-%m-%dT%H:%M:%S.%fZ") for stamp in sampled.utc])
        line.newgxcoord(coordinates)
        line.newgxangle([(float(yaw), 0.0, 0.0) for yaw in np.rad2deg(sampled.trajectory.rpy[:, 2]).round(3) % 360.0])
    else:
        line = kml.newlinestring(name=track.name, altitudemode="absolute", coords=coordinates)
    line.style.linestyle.color, line.style.linestyle.width = LINE, 3
    _add_ellipses(kml, sampled)
    _add_fixes(kml, track)
    _add_acoustics(kml, track)
    return kml


def _add_ellipses(kml: "simplekml.Kml", track: Track) -> None:
    t, folder = track.trajectory, kml.newfolder(name="95 % ellipses")
    for k in np.unique(np.linspace(0, len(t) - 1, KML_ELLIPSES).astype(int)):
        if not np.isfinite(P := t.cov_p[k, :2, :2]).all():
            continue
        ring = _places(track, t.p_n[k, :2] + ellipse(P))
        polygon = folder.newpolygon(name=f"{t.time[k] - t.time[0]:.0f} s", outerboundaryis=ring)
        polygon.style.polystyle.color, polygon.style.linestyle.width = SHADE, 0


def _add_fixes(kml: "simplekml.Kml", track: Track) -> None:
    if track.fixes is None:
        return
    folder, start = kml.newfolder(name="fixes"), track.trajectory.time[0]
    lat, lon = track.place(*track.fixes.position.T)
    lon = track.continuous(lon)
    for k, (time, used) in enumerate(zip(track.fixes.time, track.fixes.used, strict=True)):
        point = folder.newpoint(coords=[(round(float(lon[k]), 9), round(float(lat[k]), 9))])
        point.description = f"{time - start:.1f} s, {'used' if used else 'rejected'}"
        point.style.iconstyle.color = USED if used else REJECTED
        point.style.iconstyle.scale = 0.4


def _add_acoustics(kml: "simplekml.Kml", track: Track) -> None:
    if track.acoustics is None:
        return
    if len(ship := track.acoustics.ship) > 1:
        line = kml.newlinestring(name="ship", coords=_places(track, ship))
        line.style.linestyle.color, line.style.linestyle.width = SHIP, 2
    for name, (north, east, north_sd, east_sd) in track.acoustics.beacons.items():
        point = kml.newpoint(name=name, coords=_places(track, np.array([[north, east]])))
        point.description = f"beacon, sd north {north_sd:.2g} m, east {east_sd:.2g} m"


def write_kml(track: Track, path: Path, options: ExportOptions) -> None:
    """Plain XML."""
    document(track, options).save(str(path), format=False)


def write_kmz(track: Track, path: Path, options: ExportOptions) -> None:
    """The same, compressed."""
    document(track, options).savekmz(str(path), format=False)


_KML = (
    ExportFormat("kml", "KML", ".kml", write_kml, "maps", needs_place=True),
    ExportFormat("kmz", "KMZ", ".kmz", write_kmz, "maps", needs_place=True),
)


def write_gpx(track: Track, path: Path, options: ExportOptions) -> None:
    """A track; with time where that is known."""
    import gpxpy.gpx

    sampled = track.at_rate(options.rate_or(SHOWN_HZ))
    gpx = gpxpy.gpx.GPX()
    gpx.creator = "rovgraph"
    line = gpxpy.gpx.GPXTrack(name=f"{track.name}, {track.estimate}")
    segment = gpxpy.gpx.GPXTrackSegment()
    times = sampled.utc.to_pydatetime() if sampled.has_utc else [None] * len(sampled.trajectory)
    for lat, lon, high, time in zip(*sampled.lat_lon, sampled.height, times, strict=True):
        height = None if high != high else round(float(high), 4)
        segment.points.append(gpxpy.gpx.GPXTrackPoint(round(float(lat), 9), round(float(lon), 9), height, time))
    line.segments.append(segment)
    gpx.tracks.append(line)
    path.write_text(gpx.to_xml("1.1"), encoding="utf-8")


_GPX = (ExportFormat("gpx", "GPX", ".gpx", write_gpx, "maps", needs_place=True),)


DRIVERS = {"gpkg": "GPKG", "shp": "ESRI Shapefile"}
LONGEST = 10  # characters of a shapefile's field name


def write_layer(track: Track, path: Path, options: ExportOptions, driver: str) -> None:
    """A layer of points with the height above sea level as z.

    Raises
    ------
    InputError : coordinates that are not known
    OSError : it cannot be written
    """
    import pyogrio.errors
    import pyogrio.raw
    import shapely

    sampled = track.at_rate(options.rate_or(SHOWN_HZ))
    table = point_table(sampled)
    x, y, crs = coordinates(table["lon"].to_numpy(), table["lat"].to_numpy(), options.crs)
    if options.crs is not None and is_projected(crs):  # headings are relative to true north
        north, scale = convergence_and_scale(crs, table["lat"].to_numpy(), table["lon"].to_numpy())
        table = table.assign(grid_north=north.round(5), grid_scale=scale.round(8))
    points = shapely.to_wkb(shapely.points(np.column_stack([x, y, np.nan_to_num(sampled.height)])))
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


def coordinates(lon: Array, lat: Array, crs: str | None) -> tuple[Array, Array, str]:
    """Places in the coordinates of an export, and what these are called.

    Parameters
    ----------
    lon, lat : ndarray, shape (n,) [deg], WGS 84
    crs : of `projected`; "utm" = the zone of the first point; None = degrees

    Raises
    ------
    InputError : coordinates that are not known, or that do not reach there
    """
    if not isinstance(crs, str | None):
        raise InputError(f"crs {crs!r}: expected text, such as EPSG:25832, or utm")
    if crs is None:
        return lon, lat, ELLIPSOID
    name = utm_zone(float(lat[0]), float(lon[0])) if crs.lower() == "utm" else crs
    warn_outside(float(lon[0]), float(lat[0]), name, "crs")
    return *projected(lon, lat, name), name


def write_gpkg(track: Track, path: Path, options: ExportOptions) -> None:
    """One file."""
    write_layer(track, path, options, DRIVERS["gpkg"])


def write_shp(track: Track, path: Path, options: ExportOptions) -> None:
    """A folder with the parts of a shapefile."""
    path.mkdir()
    write_layer(track, path / "track.shp", options, DRIVERS["shp"])


_GIS = (
    ExportFormat("gpkg", "GeoPackage", ".gpkg", write_gpkg, "gis", needs_place=True),
    ExportFormat("shp", "shapefile", "", write_shp, "gis", needs_place=True),
)

FORMATS = (*_GEOJSON, *_KML, *_GPX, *_GIS)
