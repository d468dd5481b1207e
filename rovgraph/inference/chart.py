"""A chart of the bottom: a GeoTIFF of depths or heights, as depths on cells north and east.

Depths of a chart count from its own datum, soundings from the surface: what lies between is not known and not needed.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.relief import SLOPE, Relief
from rovgraph.model.config_sections import FOOT_M, ChartSettings
from rovgraph.model.origin import Origin, lat_lon

MOST_CELLS = 100_000_000  # of a file
MOST_AROUND = 4_000_000  # about a track; where there are more, they are taken wider
SLOWLY_M = 15.0  # sd of the filter whose outcome varies slowly
FAR = 0.95  # share of cells without holes, about one by the relief's length, of a depth that is used
SEEN = 0.1  # share of a piece's soundings that a chart must have
OFF_M = 9.0  # depths that differ more in the mean are of another place or datum


@dataclass(frozen=True)
class ChartFile:
    """What a GeoTIFF has.

    Attributes
    ----------
    settings : of the configuration
    values : ndarray, shape (rows, columns), first band, NaN in holes [m]
    transform, crs : of rasterio
    """

    settings: ChartSettings
    values: Array
    transform: Any
    crs: Any

    def around(self, low: Array, high: Array, origin: Origin) -> "DepthChart":
        """The part between two places, shape (2,) each, north and east [m]."""
        from rasterio.warp import transform
        from scipy.ndimage import map_coordinates  # type: ignore[attr-defined]

        def cells_of(north: Array, east: Array) -> Array:
            lat, lon = lat_lon(north.ravel(), east.ravel(), origin)
            x, y = transform("EPSG:4326", self.crs, lon, lat)
            column, row = ~self.transform @ (np.array(x), np.array(y))
            return np.array([row, column]) - 0.5

        middle = 0.5 * (low + high)
        across = cells_of(middle[0] + np.array([0.0, 1.0, 0.0]), middle[1] + np.array([0.0, 0.0, 1.0]))
        step = 1.0 / np.linalg.norm(across[:, 1:] - across[:, :1], axis=0).max()  # metres of a cell
        step = max(step, float(np.sqrt(np.prod(high - low) / MOST_AROUND)))
        axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
        grid = np.meshgrid(*axes, indexing="ij")
        values = map_coordinates(self.values, cells_of(*grid), order=1, cval=np.nan).reshape(grid[0].shape)
        known = values[np.isfinite(values)]
        down = -1.0 if len(known) and np.median(known) < 0.0 else 1.0  # heights, as in most files
        return DepthChart(down * values, low, step, self.settings.sd_m)


@dataclass(frozen=True)
class DepthChart:
    """Depths on a grid.

    Attributes
    ----------
    depth : ndarray, shape (n, m), north and east, NaN in holes [m]
    corner : ndarray, shape (2,), north and east of the first [m]
    step : between them [m]
    sd : of each, beside an offset of all [m]
    """

    depth: Array
    corner: Array
    step: float
    sd: float

    @cached_property
    def empty(self) -> bool:
        return not np.isfinite(self.depth).any()

    def at(self, place: Array) -> Array:
        """Depths at places, shape (..., 2); NaN in holes and beyond."""
        from scipy.ndimage import map_coordinates  # type: ignore[attr-defined]

        cells = np.moveaxis((place - self.corner) / self.step, -1, 0)
        return np.asarray(map_coordinates(self.depth, cells, order=1, cval=np.nan))

    def smoothed(self, relief: Relief) -> "SmoothedChart":
        """The bottom as the chart shows it, by kriging: relief is normal about what varies slowly.

        The errors are those far from holes; what is near one is left out.
        """
        from scipy.ndimage import gaussian_filter  # type: ignore[attr-defined]

        shape = tuple(2 * n for n in self.depth.shape)
        away = np.hypot(*np.meshgrid(*(self.step * n * np.abs(np.fft.fftfreq(n)) for n in shape), indexing="ij"))
        S = np.fft.rfft2(relief.covariance(away)).real.clip(min=0.0)
        known = np.isfinite(self.depth)
        wide = SLOWLY_M / self.step
        share = gaussian_filter(known.astype(float), wide, mode="nearest")
        slow = gaussian_filter(np.where(known, self.depth, 0.0), wide, mode="nearest") / np.maximum(share, 1e-6)
        rest = np.where(known, self.depth - slow, 0.0)
        mirrored = np.concatenate([rest, rest[::-1]])
        mirrored = np.concatenate([mirrored, mirrored[:, ::-1]], axis=1)
        shown = np.fft.irfft2(np.fft.rfft2(mirrored) * S / (S + self.sd**2), shape)[: len(rest), : rest.shape[1]]
        error = np.fft.irfft2(S * self.sd**2 / (S + self.sd**2), shape)[0, : rest.shape[1]]
        far = gaussian_filter(known.astype(float), relief.length / self.step, mode="nearest") > FAR
        return SmoothedChart(np.where(known & far, slow + shown, np.nan), self.corner, self.step, self.sd, error)

    def refused(self, place: Array, depth: Array) -> str:
        """Why soundings, n places and depths, cannot be of this chart, or ""."""
        own = self.at(place)
        known = np.isfinite(own)
        if not known.any():
            return "it has no depths where the track is"
        sounded, charted = float(np.median(depth[known])), float(np.median(own[known]))
        if abs(charted * FOOT_M - sounded) < min(0.1 * sounded, abs(charted - sounded)):
            return f"it has {charted:.0f} where soundings have {sounded:.1f} m: its depths look like feet"
        if abs(charted - sounded) > OFF_M:
            return f"it has {charted:.0f} m where soundings have {sounded:.0f} m: another place or datum"
        return ""


@dataclass(frozen=True)
class SmoothedChart(DepthChart):
    """A chart whose errors are correlated.

    Attributes
    ----------
    error : ndarray, shape (m,), covariance of two depths 0, 1, ... steps apart [m^2]
    """

    error: Array

    def covariance(self, r: Array) -> Array:
        """Of the errors of depths some distances apart."""
        return np.interp(r, self.step * np.arange(len(self.error)), self.error)


class ChartField:
    """Log likelihood of the shift of a piece of a line on a chart, over that of a bottom that the chart does not show.

    Soundings in holes do not count.
    """

    def __init__(self, x: Array, z: Array, chart: SmoothedChart, relief: Relief) -> None:
        self._x, self._z, self._chart = x, z, chart
        r, away = np.linalg.norm(x[:, None] - x, axis=-1), x - x.mean(axis=0)
        own = relief.of_line(x)
        self._known, self._alone = own + chart.covariance(r), own + relief.covariance(r) + SLOPE**2 * away @ away.T

    def at(self, shifts: Array) -> Array:
        """The field at g shifts, shape (g,)."""
        off = self._z - self._chart.at(self._x + shifts[:, None])
        seen = np.isfinite(off)
        share = seen.mean(axis=1)
        whole, some = np.flatnonzero(share == 1.0), np.flatnonzero((share > SEEN) & (share < 1.0))
        out = np.zeros(len(shifts))
        for rows in (whole, *np.array_split(some, len(some) // 32 + 1)):
            use = seen[rows[:1]] if rows is whole else seen[rows]
            alone = _log_normal(self._alone, use * (self._z - self._z.mean()), use)
            out[rows] = _log_normal(self._known, np.where(seen[rows], off[rows], 0.0), use) - alone
        return out


def _log_normal(covariance: Array, off: Array, use: NDArray[np.bool_]) -> Array:
    """Log densities of residuals that are used, shape (g, n), without their constant."""
    L = np.linalg.cholesky(np.where(use[:, :, None] & use[:, None], covariance, np.eye(len(covariance))))
    white = (np.linalg.inv(L) @ off[..., None])[..., 0] if len(L) == 1 else np.linalg.solve(L, off[..., None])[..., 0]
    return np.asarray(-0.5 * (white**2).sum(axis=-1) - np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1))


def read_chart(settings: ChartSettings, origin: Origin | None) -> ChartFile | None:
    """The chart of a configuration; None without.

    Raises
    ------
    InputError : a file that cannot be read, or says no coordinate system; a log without latitude and longitude
    """
    if settings.file is None:
        return None
    path = Path(settings.file)
    where = f"chart.file {path}"
    if not path.is_file():
        raise InputError(f"{where}: there is no such file; paths count from where rovgraph runs")
    if origin is None:
        raise InputError(f"{where}: needs latitude and longitude of north = east = 0; state environment.origin_lat_deg")
    with geotiff(path, where) as source:
        if source.width * source.height > MOST_CELLS:
            raise InputError(f"{where}: more than {MOST_CELLS:.0e} cells; cut out the part that you need")
        if np.dtype(source.dtypes[0]).kind not in "iuf" or source.dtypes[0] == "uint8":
            raise InputError(f"{where}: its first band has {source.dtypes[0]}, expected depths or heights in metres")
        values = source.read(1, masked=True).astype(float).filled(np.nan)
        return ChartFile(settings, values, source.transform, source.crs)


@contextmanager
def geotiff(path: Path, where: str) -> Iterator[Any]:
    """A GeoTIFF with a coordinate system, as rasterio opens it; ``where`` begins the lines of errors.

    Raises
    ------
    InputError : no rasterio, a file that cannot be read, or says no coordinate system
    """
    try:
        import rasterio
        from rasterio.errors import RasterioError
    except ImportError:
        raise InputError(f"{where}: needs rasterio; install it with: pip install 'rovgraph[charts]'") from None
    try:
        with rasterio.open(path) as source:
            if source.crs is None:
                raise InputError(f"{where}: says no coordinate system; assign one, as gdal_translate -a_srs does")
            yield source
    except RasterioError as error:
        raise InputError(f"{where}: is no GeoTIFF that can be read ({' '.join(str(error).split())[:200]})") from None
