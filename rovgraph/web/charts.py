"""Background charts: GeoTIFF, GeoJSON and folders of tiles, placed on the estimate's map.

A chart is in degrees, the map in metres north and east of an origin that may become known only with the first fix; so a
chart is read before the dive and placed when a page requests it.
"""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Route

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.chart import geotiff
from rovgraph.live.solution import Solution
from rovgraph.model.origin import north_east

LARGEST_PIXELS = 2048  # of a side, as it is shown
MOST_VERTICES = 200_000
LARGEST_FILE = 500 << 20  # [bytes]
DEPTHS = {"Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3}
Place = Callable[[Array, Array], tuple[Array, Array]]  # latitude, longitude [deg] -> north, east [m]


class Chart(ABC):
    """A chart by its name."""

    kind: str

    def __init__(self, name: str) -> None:
        self.name = name

    @abstractmethod
    def placed(self, place: Place) -> dict[str, Any]:
        """Data for a page to draw it."""


class ImageChart(Chart):
    """An image and the degrees of its corners."""

    kind = "image"

    def __init__(self, name: str, png: bytes, corners: Array) -> None:
        super().__init__(name)
        self.png = png
        self._corners = corners  # shape (3, 2): latitude, longitude of top left, top right, bottom left

    def placed(self, place: Place) -> dict[str, Any]:
        north, east = place(self._corners[:, 0], self._corners[:, 1])
        return {"corners": np.column_stack([north, east]).round(3).tolist()}


class OutlineChart(Chart):
    """Points, lines and outlines of areas."""

    kind = "outline"

    def __init__(self, name: str, shapes: list[tuple[str, str, Array]]) -> None:
        super().__init__(name)
        self._shapes = shapes  # of each: its form, its name, and its vertices (n, 2): latitude, longitude

    def placed(self, place: Place) -> dict[str, Any]:
        shapes = []
        for form, name, vertices in self._shapes:
            north, east = place(vertices[:, 0], vertices[:, 1])
            points = np.column_stack([north, east]).round(3).tolist()
            shapes.append({"form": form, "name": name, "points": points})
        return {"shapes": shapes}


class TileChart(Chart):
    """A folder ``{z}/{x}/{y}.png`` in the scheme of web maps; the deepest level is shown."""

    kind = "tiles"

    def __init__(self, name: str, folder: Path, tiles: dict[tuple[int, int, int], Path]) -> None:
        super().__init__(name)
        self.folder = folder
        self.tiles = tiles

    def placed(self, place: Place) -> dict[str, Any]:
        keys = np.array(list(self.tiles))
        corners = [place(*_mercator(keys[:, 0], keys[:, 1] + x, keys[:, 2] + y)) for x, y in ((0, 0), (1, 0), (0, 1))]
        places = np.array(corners).transpose(2, 0, 1).round(3)
        return {"tiles": [{"tile": k, "corners": c} for k, c in zip(keys.tolist(), places.tolist(), strict=True)]}


@dataclass(frozen=True)
class Charts:
    """All charts of a page, the first at the bottom."""

    all: tuple[Chart, ...]

    def routes(self, newest: Callable[[], Solution | None]) -> list[BaseRoute]:
        """``/api/charts`` and the images."""

        async def listed(request: Request) -> Response:
            origin = None if (solution := newest()) is None else solution.origin
            place = None if origin is None else partial(north_east, origin=origin)
            charts = [{"number": k, "name": c.name, "kind": c.kind} for k, c in enumerate(self.all)]
            if place is not None:
                charts = [{**entry, **c.placed(place)} for entry, c in zip(charts, self.all, strict=True)]
            missing = bool(self.all) and place is None
            reason = "the chart waits for an origin: a first fix, or environment.origin_lat_deg" if missing else ""
            return JSONResponse({"charts": charts, "missing": reason})

        async def image(request: Request) -> Response:
            chart = self._get(request.path_params["number"])
            return Response(chart.png, media_type="image/png") if isinstance(chart, ImageChart) else _nothing()

        async def tile(request: Request) -> Response:
            chart = self._get(request.path_params["number"])
            key = tuple(request.path_params[name] for name in ("z", "x", "y"))
            path = chart.tiles.get(key) if isinstance(chart, TileChart) else None
            return _nothing() if path is None else Response(path.read_bytes(), media_type="image/png")

        return [
            Route("/api/charts", listed),
            Route("/api/charts/{number:number}.png", image),
            Route("/api/charts/{number:number}/{z:number}/{x:number}/{y:number}.png", tile),
        ]

    def _get(self, number: int) -> Chart | None:
        return self.all[number] if 0 <= number < len(self.all) else None


def read_charts(paths: Sequence[Path]) -> Charts:
    """Read files and folders.

    Raises
    ------
    InputError : one that cannot be read, with what is wrong with it
    """
    return Charts(tuple(_read(path) for path in paths))


def _read(path: Path) -> Chart:
    if path.is_dir():
        return _tiles(path)
    if not path.is_file():
        raise InputError(f"--chart {path}: there is no such file or folder")
    if path.stat().st_size > LARGEST_FILE:
        raise InputError(f"--chart {path}: larger than {LARGEST_FILE >> 20} MB; cut out the part that you need")
    if path.suffix.lower() in (".tif", ".tiff"):
        return _geotiff(path)
    if path.suffix.lower() in (".geojson", ".json"):
        return _geojson(path)
    raise InputError(f"--chart {path}: expected a GeoTIFF (.tif), GeoJSON (.geojson) or a folder of tiles")


def _geotiff(path: Path) -> ImageChart:
    with geotiff(path, f"--chart {path}") as source:
        from rasterio.enums import Resampling

        if any(np.issubdtype(kind, np.complexfloating) for kind in source.dtypes):
            raise InputError(f"--chart {path}: has complex values; expected real ones, such as gdal_calc.py makes")
        size = max(source.width, source.height)
        shape = [max(1, round(n * min(1.0, LARGEST_PIXELS / size))) for n in (source.height, source.width)]
        bands = source.read(out_shape=(source.count, *shape), resampling=Resampling.average, masked=True)
        x, y = source.xy([0, 0, source.height], [0, source.width, 0], offset="ul")
        corners = _corners(path, source.crs, x, y)
    return ImageChart(path.name, _png(bands), corners)


def _corners(path: Path, crs: Any, x: Sequence[float], y: Sequence[float]) -> Array:
    """Latitude and longitude [deg] of places in a coordinate system, shape (n, 2)."""
    from rasterio.warp import transform

    try:
        longitude, latitude = transform(crs, "EPSG:4326", x, y)
    except Exception as error:  # of GDAL, which has no public class for them
        why = " ".join(str(error).split())[:100]
        raise InputError(
            f"--chart {path}: its corners cannot be converted to WGS 84 ({why}); "
            "assign the coordinate system that it was made in, as gdal_translate -a_srs does"
        ) from None
    corners = np.column_stack([latitude, longitude])
    if not np.isfinite(corners).all() or (np.abs(corners) > (90.0, 360.0)).any():
        raise InputError(
            f"--chart {path}: its corners lie outside its coordinate system; "
            "assign the coordinate system that it was made in, as gdal_translate -a_srs does"
        )
    return corners


def _png(bands: "np.ma.MaskedArray[Any, Any]") -> bytes:
    """Three bands as colours, one as shades; what is masked is transparent."""
    from rasterio.io import MemoryFile

    bands = np.ma.masked_invalid(bands)
    shown: Any = bands[:3] if len(bands) >= 3 else bands[[0, 0, 0]]
    if shown.dtype != np.uint8:
        low, high = np.percentile(shown.compressed(), (1, 99)) if shown.count() else (0.0, 1.0)
        shown = np.ma.clip((shown.astype(float) - low) * 255.0 / max(high - low, 1e-12), 0.0, 255.0)
        shown = shown.filled(0.0).astype(np.uint8)
    alpha = np.where(np.ma.getmaskarray(bands[:1]), 0, 255).astype(np.uint8)
    if len(bands) == 4 and bands.dtype == np.uint8:
        alpha = np.minimum(alpha, bands[3:4].filled(0))
    colours = np.concatenate([np.ma.filled(shown, 0), alpha])
    with MemoryFile() as file:
        with file.open(driver="PNG", height=colours.shape[1], width=colours.shape[2], count=4, dtype="uint8") as png:
            png.write(colours)
        return bytes(BytesIO(file.read()).getvalue())


def _geojson(path: Path) -> OutlineChart:
    try:
        shapes = list(_shapes(json.loads(path.read_text(encoding="utf-8-sig")), ""))
        count = sum(len(vertices) for _, _, vertices in shapes)
        valid = all(np.isfinite(v).all() and (np.abs(v) <= (90.0, 360.0)).all() for _, _, v in shapes)
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, RecursionError, OSError) as error:
        raise InputError(f"--chart {path}: is no GeoJSON that can be read ({str(error)[:100]})") from None
    if not valid:
        raise InputError(f"--chart {path}: expected longitude and latitude in degrees (WGS 84), as GeoJSON has them")
    if not shapes or count > MOST_VERTICES:
        raise InputError(f"--chart {path}: {count} vertices, expected 1 to {MOST_VERTICES}; simplify it")
    return OutlineChart(path.name, shapes)


def _shapes(thing: dict[str, Any], name: str) -> Iterator[tuple[str, str, Array]]:
    """Form, name and vertices of every line, ring and point of a GeoJSON object."""
    kind = thing["type"]
    if kind == "FeatureCollection":
        for feature in thing["features"]:
            yield from _shapes(feature, name)
    elif kind == "Feature":
        if thing.get("geometry"):
            yield from _shapes(thing["geometry"], str((thing.get("properties") or {}).get("name", ""))[:80])
    elif kind == "GeometryCollection":
        for geometry in thing["geometries"]:
            yield from _shapes(geometry, name)
    else:
        depth = {"Point": 0, "MultiPoint": 1, "LineString": 1, "MultiLineString": 2, "Polygon": 2, "MultiPolygon": 3}[
            kind
        ]
        form = "point" if "Point" in kind else "area" if "Polygon" in kind else "line"
        whole = 0 if form == "point" else 1  # levels of lists that make one shape
        for vertices in _flattened(thing["coordinates"], depth - whole):
            pairs = np.array([v[:2] for v in (vertices if whole else [vertices])], dtype=float)
            yield form, name, pairs[:, ::-1]


def _flattened(lists: Any, levels: int) -> Iterator[Any]:
    if levels == 0:
        yield lists
    else:
        for inner in lists:
            yield from _flattened(inner, levels - 1)


def _tiles(folder: Path) -> TileChart:
    """Tiles of the deepest level; links that lead out of the folder are left out."""
    root, found = folder.resolve(), {}
    for path in folder.glob("*/*/*.png"):
        parts = [path.parent.parent.name, path.parent.name, path.stem]
        if all(part.isascii() and part.isdigit() for part in parts) and path.resolve().is_relative_to(root):
            found[tuple(map(int, parts))] = path
    if not found:
        raise InputError(f"--chart {folder}: no tiles in it; expected a folder with files such as 18/137021/76304.png")
    deepest = max(z for z, _, _ in found)
    chosen = {(z, x, y): path for (z, x, y), path in found.items() if z == deepest}
    return TileChart(folder.name, root, dict(list(chosen.items())[:2000]))


def _mercator(z: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Latitude and longitude [deg] of the top left corner of tiles (Web Mercator, EPSG:3857)."""
    n = 2.0**z
    return np.rad2deg(np.arctan(np.sinh(math.pi * (1.0 - 2.0 * y / n)))), x / n * 360.0 - 180.0


def _nothing() -> Response:
    return JSONResponse({"error": "there is no such image"}, 404)
