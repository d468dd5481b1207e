"""Soundings along the straight lines of a survey, and the relief of the bottom that they show.

The bottom is a Gaussian process, z(x) = plane + relief, with a Matern covariance

    k(r) = s^2 (1 + q) exp(-q),   q = sqrt(3) r / l

whose sd s and length l make the soundings along the lines likeliest, together with their white noise. Relief that does
not exceed the noise is of no use.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

CELL_M = 2.0  # of a line, along and across, within which soundings are averaged
SCATTER = 4.0  # sd of soundings in a cell and those beside it over what is usual, from which they are fish
JUMP = 5.0  # depth within two cells along a line over what is usual: a rock or a wall, or fish
LINE_M, LINE_S = 20.0, 15.0  # shortest line
STRAIGHT_S, STRAIGHT = 10.0, 0.98  # a line: mean resultant of the heading around each moment; longest silence
BEND = np.cos(np.pi / 4.0)  # from where it began, at which a line ends
STRETCH, STRETCHES = 32, 60  # cells of a stretch, and stretches, to which relief is fitted
LENGTHS_M = np.geomspace(1.0, 30.0, 12)  # of relief
NOISES = np.geomspace(1e-3, 10.0, 13)  # variance of a sounding over that of the relief
EXCESS = 10.0  # of the log likelihood with relief over that of noise alone [nats]
HEIGHT, TILT = 3.0, 0.02  # sd of a line's own height [m] and slope about a place: tide, depth sensor, trim
SLOPE = 0.3  # sd of the bottom's slope there, beside its relief
ENOUGH_PAIRS = 100  # cells of lines a lag apart that show its correlation


@dataclass(frozen=True)
class Line:
    """Soundings along a straight part of a track, averaged in cells.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    along, across : ndarray of int, shape (n,), of each cell
    place : ndarray, shape (n, 2), north and east [m]
    depth : ndarray, shape (n,) [m]
    noise : sd of a depth by the scatter of its soundings [m]
    jumps : ndarray of bool, shape (n,), cells where the depth jumps: rocks and walls, or the ends of a school of fish
    """

    time: Array
    along: NDArray[np.int64]
    across: NDArray[np.int64]
    place: Array
    depth: Array
    noise: float
    jumps: NDArray[np.bool_]

    @cached_property
    def centre(self) -> tuple[Array, Array, Array]:
        """Time, place and half width of the swath, cell by cell along the line, shapes (m,), (m, 2) and ()."""
        cells, which, count = np.unique(self.along, return_inverse=True, return_counts=True)
        columns = np.column_stack([self.time, self.place])
        mean = np.stack([np.bincount(which, c, len(cells)) for c in columns.T], axis=-1) / count[:, None]
        off = np.linalg.norm(self.place - mean[which, 1:], axis=1)
        return mean[:, 0], mean[:, 1:], np.asarray(np.quantile(off, 0.9))

    def profiles(self) -> list[NDArray[np.intp]]:
        """Indices of the cells side by side with the same distance across, each in order along the line."""
        sides = [np.flatnonzero(self.across == side) for side in np.unique(self.across)]
        return [own[np.argsort(self.along[own])] for own in sides]


def lines_of(time: Array, heading: Array, position: Array, at: Array, place: Array, depth: Array) -> list[Line]:
    """Straight parts of a track, with their soundings.

    Parameters
    ----------
    time, heading, position : ndarray, shapes (n,), (n,), (n, 2), of the track
    at, place, depth : ndarray, shapes (m,), (m, 2), (m,), of the soundings, in the order of time
    """
    if len(at) < STRETCH:
        return []
    t, p, arc, parts = _straight(time, heading, position, at)
    cells = []
    for first, last in parts:
        own = slice(*np.searchsorted(at, (t[first], t[last - 1])).tolist())
        if own.stop - own.start > STRETCH // 2:
            cells.append(_in_cells(t[first:last], p[first:last], arc[first:last], at[own], place[own], depth[own]))
    shown = [square[square > 0.0] for *_, square in cells]
    usual = max(float(np.median(np.concatenate([*shown, [1e-9]]))), 1e-9)  # of the survey: half of a line may be fish
    lines = []
    for mean, count, square in cells:
        good = (count >= 0.25 * np.median(count)) & (square <= SCATTER**2 * usual)
        if good.sum() > STRETCH // 2:
            noise, mean = float(np.sqrt((square / count)[good].mean())), mean[good]
            along, across = np.round(mean[:, 1:3].T).astype(np.int64)
            lines.append(Line(mean[:, 0], along, across, mean[:, 3:5], mean[:, 5], noise, along < 0))
    rises = [_rises(line) for line in lines]
    least = JUMP / 0.6745 * float(np.nanmedian(np.concatenate([*rises, [0.0]])))
    return [replace(line, jumps=rise > least) for line, rise in zip(lines, rises, strict=True)]


def line_ends(time: Array, heading: Array, position: Array) -> list[float]:
    """When straight parts of a track have ended, for good [s]; parameters of `lines_of`."""
    t, _, _, parts = _straight(time, heading, position, time)
    return [float(t[last]) for _, last in parts if last < len(t) - int(STRAIGHT_S)]


def _straight(
    time: Array, heading: Array, position: Array, at: Array
) -> tuple[Array, Array, Array, list[tuple[int, int]]]:
    """A track every second: time, place and way so far; and its straight parts, first and one after the last.

    They end where there is nothing ``at`` times of soundings, shape (m,), for long.
    """
    t = np.arange(time[0], time[-1], 1.0)
    e = np.interp(t, time, np.cos(heading)) + 1j * np.interp(t, time, np.sin(heading))
    e /= np.maximum(np.abs(e), 1e-9)
    width = int(STRAIGHT_S)
    total = np.concatenate([[0.0], np.cumsum(e)])
    low, high = np.maximum(np.arange(len(t)) - width // 2, 0), np.minimum(np.arange(len(t)) + width // 2 + 1, len(t))
    straight = np.abs((total[high] - total[low]) / (high - low)) > STRAIGHT
    later = np.searchsorted(at, t).clip(1, len(at) - 1)
    straight &= at[later] - at[later - 1] < STRAIGHT_S
    p = np.stack([np.interp(t, time, axis) for axis in position.T], axis=-1)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    parts, first = [], 0
    while first < len(t):
        last = first
        while last < len(t) and straight[last] and (e[last] * np.conj(e[first])).real > BEND:
            last += 1
        if last - first > LINE_S and arc[last - 1] - arc[first] > LINE_M:
            parts.append((first, last))
        first = max(last, first + 1)
    return t, p, arc, parts


def _rises(line: Line) -> Array:
    """How far the depth goes up or down within two cells of the same distance across, nan at ends [m]."""
    rises = np.full(len(line.depth), np.nan)
    for own in line.profiles():
        rises[own[1:-1]] = np.abs(line.depth[own[2:]] - line.depth[own[:-2]])
    return rises


def _in_cells(
    t: Array, p: Array, arc: Array, at: Array, place: Array, depth: Array
) -> tuple[Array, NDArray[np.int64], Array]:
    """Means of a line's soundings in n cells, shape (n, 6), how many there are, and their mean squared scatter."""
    way = p[-1] - p[0]
    way = way / np.linalg.norm(way)
    here = np.stack([np.interp(at, t, axis) for axis in p.T], axis=-1)
    off = place - here
    along = np.floor((np.interp(at, t, arc) + off @ way) / CELL_M).astype(np.int64)
    across = np.round(off @ (-way[1], way[0]) / CELL_M).astype(np.int64)
    cells, which, count = np.unique(np.column_stack([along, across]), axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    columns = np.column_stack([at, along, across, place, depth])
    mean = np.stack([np.bincount(which, c, len(count)) for c in columns.T], axis=-1) / count[:, None]
    scatter, spare = np.bincount(which, (depth - mean[which, 5]) ** 2), _around(cells, np.asarray(count - 1.0, float))
    square = np.where(spare > 0.5, _around(cells, np.asarray(scatter, float)) / np.maximum(spare, 1.0), 0.0)
    return mean, count, square


def _around(cells: NDArray[np.int64], values: Array) -> Array:
    """Sums over n cells, shape (n, 2), and their neighbours: beams that land astride two cells leave few in each."""
    from scipy.ndimage import uniform_filter  # type: ignore[attr-defined]

    own = tuple((cells - cells.min(axis=0)).T)
    grid = np.zeros(np.ptp(cells, axis=0) + 1)
    grid[own] = values
    return np.asarray(9.0 * uniform_filter(grid, 3, mode="constant")[own])


@dataclass(frozen=True)
class Relief:
    """The bottom as soundings along lines show it.

    Attributes
    ----------
    sd, length : of the relief [m]
    noise : sd of a cell's depth [m]
    gain : log likelihood over that of noise on planes
    """

    sd: float
    length: float
    noise: float
    gain: float

    @property
    def shows(self) -> bool:
        """Whether it is more than the noise of the soundings."""
        return self.gain > EXCESS and self.sd > self.noise

    def covariance(self, r: Array) -> Array:
        """Of the relief at some distances."""
        return self.sd**2 * _matern(r / self.length)

    def of_line(self, x: Array) -> Array:
        """Covariance of what soundings of a line at n places have by themselves: noise, height and slope."""
        away = x - x.mean(axis=0)
        return np.asarray(self.noise**2 * np.eye(len(x)) + HEIGHT**2 + TILT**2 * away @ away.T)


def _matern(r: Array) -> Array:
    q = np.sqrt(3.0) * r
    return np.asarray((1.0 + q) * np.exp(-q))


def fit_relief(lines: Sequence[Line]) -> Relief:
    """The relief that makes the soundings along the lines likeliest, on slopes of their own in stretches."""
    stretches = [
        (line.place[own[k : k + STRETCH]], line.depth[own[k : k + STRETCH]])
        for line in lines
        for own in line.profiles()
        for k in range(0, len(own) - STRETCH + 1, STRETCH)
    ]
    if len(stretches) < 2:
        return Relief(0.0, 1.0, 1.0, 0.0)
    some = np.linspace(0, len(stretches) - 1, min(len(stretches), STRETCHES)).round().astype(int)
    x, z = (np.array([stretches[k][part] for k in some]) for part in (0, 1))
    along = np.linalg.norm(x - x[:, :1], axis=2)  # across, slanted beams land further out where it is deeper
    Q = np.linalg.qr(np.stack([np.ones_like(along), along], axis=2), mode="complete")[0][:, :, 2:]
    z = np.einsum("sij,si->sj", Q, z)
    r = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)

    def log_likelihood(K: Array) -> tuple[float, float]:
        """Of the soundings with a covariance to scale, and its scale."""
        L = np.linalg.cholesky(np.swapaxes(Q, 1, 2) @ K @ Q)
        variance = float(np.mean(np.linalg.solve(L, z[..., None]) ** 2))
        spread = 2.0 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
        return -0.5 * (z.size * np.log(max(variance, 1e-12)) + spread), variance

    unit = np.eye(STRETCH)
    none, _ = log_likelihood(np.broadcast_to(unit, r.shape))
    fits = []
    for length, noise in product(LENGTHS_M, NOISES):
        score, variance = log_likelihood(_matern(r / length) + noise * unit)
        fits.append(Relief(float(np.sqrt(variance)), length, float(np.sqrt(noise * variance)), score - none))
    best = max(fits, key=lambda fit: fit.gain)
    noise = max(best.noise, float(np.median([line.noise for line in lines])))
    return Relief(best.sd, best.length, noise, best.gain)


def repetition(lines: Sequence[Line], far: float) -> float:
    """How far the correlation of lines of one direction with themselves rises again at lags up to ``far`` [m]."""
    way = np.array([np.arctan2(*(line.place[-1] - line.place[0])) for line in lines])
    direction = np.round(way / (np.pi / 4.0)).astype(int) % 4
    lags = np.arange(1, int(far / CELL_M) + 1)
    most = 0.0
    for some in range(4):
        product, square, pairs = np.zeros((3, len(lags)))
        for line in (lines[k] for k in np.flatnonzero(direction == some).tolist()):
            for own in line.profiles():
                z = np.full(np.ptp(line.along[own]) + 1, np.nan)
                z[line.along[own] - line.along[own].min()] = line.depth[own]
                known = np.flatnonzero(np.isfinite(z))
                if len(known) < STRETCH // 2:
                    continue
                z[known] -= np.polyval(np.polyfit(known, z[known], 1), known)
                for j, lag in enumerate(lags[lags <= len(z) // 2]):
                    u, v = z[:-lag], z[lag:]
                    both = np.isfinite(u) & np.isfinite(v)
                    product[j] += u[both] @ v[both]
                    square[j] += 0.5 * (u[both] @ u[both] + v[both] @ v[both])
                    pairs[j] += both.sum()
        alike = (product / np.maximum(square, 1e-12))[pairs > ENOUGH_PAIRS]
        most = max(most, float((alike - np.minimum.accumulate(alike)).max(initial=0.0)))
    return most
