"""GeoJSON (RFC 7946): the track as a line, points with their sds, 95 % ellipses and fixes; heights above sea level."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.export.formats import ExportFormat, Options
from rovgraph.export.points import SHOWN_HZ, point_table
from rovgraph.export.track import Track, ellipse
from rovgraph.geometry import Array

ELLIPSES = 100  # along a track
Feature = dict[str, Any]


def write(track: Track, path: Path, options: Options) -> None:
    """A feature collection; ``kind`` of each feature is track, point, ellipse or fix."""
    points = track.at_rate(options.rate_or(SHOWN_HZ))
    features = [_line(track), *_points(points), *_ellipses(points), *_fixes(track)]
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
    for k in np.unique(np.linspace(0, len(t) - 1, ELLIPSES).astype(int)):
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


def _ring(track: Track, corners: Array) -> list[list[float]]:
    lat, lon = track.place(*corners[:-1].T)
    ring = np.column_stack([track.continuous(lon), lat]).round(9).tolist()
    return [*ring, ring[0]]


def _coordinates(track: Track) -> list[list[float]]:
    lat, lon = track.lat_lon
    where = np.column_stack([track.continuous(lon).round(9), lat.round(9), track.height.round(4)])
    coordinates: list[list[float]] = where[:, : 2 if np.isnan(where[:, 2]).any() else 3].tolist()
    return coordinates


def _feature(kind_of_geometry: str, coordinates: Any, **properties: Any) -> Feature:
    geometry = {"type": kind_of_geometry, "coordinates": coordinates}
    return {"type": "Feature", "geometry": geometry, "properties": properties}


FORMATS = (ExportFormat("geojson", "GeoJSON", ".geojson", write, needs_place=True),)
