"""Series thinned for display: of every stretch its extremes are kept, so that no peak is lost."""

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

STRETCHES = 700  # of a series; a screen is hardly wider
GAP = 5.0  # usual periods


def extremes(*series: Array, stretches: int = STRETCHES) -> NDArray[np.intp]:
    """Indices of the smallest and largest value of each stretch, of every series, both ends kept.

    Parameters
    ----------
    series : ndarray, shape (n,), drawn together; NaN is a gap, and one of each stretch of gaps is kept
    stretches : of equal length in samples

    Returns
    -------
    ndarray of int, increasing, at most 2 + 3 times ``stretches`` for each series
    """
    n = len(series[0])
    if n <= 2 * stretches:
        return np.arange(n)
    size = -(-n // stretches)
    chosen = [np.array([0, n - 1])]
    for values in series:
        padded = np.full(size * stretches, np.nan)
        padded[:n] = values
        blocks = padded.reshape(stretches, size)
        begin = np.arange(stretches) * size
        unknown = np.isnan(blocks)
        chosen.append(begin + np.where(unknown, np.inf, blocks).argmin(axis=1))
        chosen.append(begin + np.where(unknown, -np.inf, blocks).argmax(axis=1))
        gap = unknown.any(axis=1)
        chosen.append((begin + unknown.argmax(axis=1))[gap])
    index = np.unique(np.concatenate(chosen))
    return index[index < n]


def broken(time: Array, values: Array) -> tuple[Array, Array]:
    """A line that breaks where nothing was measured: NaN at both ends of every gap of `GAP` usual periods or more.

    Parameters
    ----------
    time, values : ndarray, shape (n,), time increasing
    """
    period = np.diff(time)
    usual = float(np.median(period)) if len(period) else 0.0
    gaps = np.flatnonzero(period > GAP * max(usual, 1e-6))
    ends = np.column_stack([time[gaps] + usual, time[gaps + 1] - usual]).ravel()
    place = np.repeat(gaps + 1, 2)
    return np.insert(time, place, ends), np.insert(values, place, np.nan)


def cloud(values: Array, most: int = 1500) -> NDArray[np.intp]:
    """Indices of points: some spread evenly, so that the density shows, and the extremes of every stretch."""
    return np.union1d(spread(len(values), most), extremes(values, stretches=200))


def spread(n: int, most: int) -> NDArray[np.intp]:
    """At most ``most`` indices spread evenly over n, both ends kept."""
    return np.arange(n) if n <= most else np.unique(np.linspace(0, n - 1, most).round().astype(np.intp))
