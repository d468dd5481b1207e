"""Lags and axes between sensors that measure one motion, for all comparisons.

Cross-correlations of whole dives by FFT, the lag of the largest, the possible orders of axes, and normal equations
of the parts of a dive: leaving out one after the other shows how much a fit depends on it, without a model of the
errors that two sensors do not share.

`lag` finds how much later one signal is than another, and their slope, by the changes of both within windows. The fit
is ``change_b = slope * change_a + const``, so biases and constant offsets drop out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.check.inertial import fast_length, in_gap
from rovgraph.geometry import Array, signed_permutations
from rovgraph.rules import FOLLOWS, REACH_S

PARTS = 10  # of a dive
ORIENTATIONS = signed_permutations()  # the 48 ways to name axes; the first is as they are


def correlate(a: Array, b: Array, first: int, last: int) -> Array:
    """Cross-correlations: sum over t of a_i(t) b_j(t + lag), for (n, i) and (m, j); shape (i, j, lags).

    Parameters
    ----------
    first, last : lags, first < 0 <= last
    """
    size = fast_length(max(len(b) - first, len(a) + last))
    A, B = (np.fft.rfft(v, size, axis=0).T for v in (a, b))
    sums = np.fft.irfft(A.conj()[:, None] * B, size, axis=-1)
    return np.concatenate([sums[..., first:], sums[..., : last + 1]], axis=-1)


def peak(lags: Array, agreement: Array) -> float:
    """Where an agreement is largest, between even lags by a parabola; NaN at their ends."""
    k = int(np.argmax(agreement))
    if not 0 < k < len(lags) - 1:
        return np.nan
    before, largest, after = agreement[k - 1 : k + 2]
    bend = before - 2.0 * largest + after
    return float(lags[k] + (0.5 * (lags[1] - lags[0]) * (before - after) / bend if bend < 0 else 0.0))


def normal_equations(J: Array, left: Array, variance: float) -> tuple[Array, Array]:
    """Information and gradient of each part of a dive, shapes (PARTS, q, q) and (PARTS, q).

    Parameters
    ----------
    J, left : ndarray, shape (n, k, q) and (n, k), residuals in the order of time, and what they fall by
    variance : of a residual
    """
    parts = np.array_split(np.arange(len(left)), PARTS)
    H = np.array([np.einsum("nik,nil->kl", J[p], J[p], optimize=True) for p in parts]) / variance
    return H, np.array([np.einsum("nik,ni->k", J[p], left[p]) for p in parts]) / variance


def spread(without: Array) -> Array:
    """Standard deviation of a fit by those without one part each, shape (PARTS, ...)."""
    return np.asarray(np.sqrt((PARTS - 1) * np.var(without, axis=0)))


MIN_WINDOWS = 15
LARGEST_LAG = 3.0  # that is searched for [s]
FAR_BETTER = 4.0  # times smaller a part that two signals do not share
OVERLAP = 5  # windows that begin within one


@dataclass(frozen=True)
class Signal:
    """An integrated quantity over time, such as a heading without jumps.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    value : ndarray, shape (n,)
    """

    time: Array
    value: Array

    def at(self, times: Array, longest: float) -> Array:
        """Values at times of any order, NaN in a gap; shape (len(times),)."""
        return np.where(in_gap(times, self.time, longest), np.nan, np.interp(times, self.time, self.value))

    def changes(self, edges: Array, longest: float) -> Array:
        """Change from each edge to the next, NaN next to a gap; shape (len(edges) - 1,)."""
        return np.diff(self.at(edges, longest))


@dataclass(frozen=True)
class LineFit:
    """Straight line through the changes of two signals.

    Attributes
    ----------
    slope, correlation : of b's changes against a's
    sd_a, sd_b : of the changes
    windows : how many
    """

    slope: float
    correlation: float
    sd_a: float
    sd_b: float
    windows: int


@dataclass(frozen=True)
class Lag:
    """How much later one signal shows a motion than another.

    Attributes
    ----------
    seconds : NaN if they do not follow each other
    sd : NaN if it is not known
    evidence : how much better they agree than unshifted, in chi-square
    """

    seconds: float
    sd: float
    evidence: float = 0.0


def fit(a: Signal, b: Signal, window: float) -> LineFit:
    """Compare the changes of two signals."""
    first, last = max(a.time[0], b.time[0]) + LARGEST_LAG, min(a.time[-1], b.time[-1]) - LARGEST_LAG
    edges = np.arange(first, last, window)
    if len(edges) < 3:
        return LineFit(np.nan, 0.0, 0.0, 0.0, 0)
    x, y = a.changes(edges, window), b.changes(edges, window)
    both = np.isfinite(x) & np.isfinite(y)
    x, y = x[both], y[both]
    if len(x) < 3 or x.std() == 0.0 or y.std() == 0.0:
        return LineFit(np.nan, 0.0, 0.0, 0.0, len(x))
    correlation = float(np.corrcoef(x, y)[0, 1])
    return LineFit(correlation * float(y.std() / x.std()), correlation, float(x.std()), float(y.std()), len(x))


def coarse_lag(a: Signal, b: Signal, window: float) -> float:
    """How much later b shows the same motion than a, to a step, where that is beyond what `lag` searches; else 0 [s].

    Legs of a dive are alike, so a shifted one has to agree far better than the one that is not shifted.
    """
    step = 0.5
    first, last = max(a.time[0], b.time[0]), min(a.time[-1], b.time[-1])
    times = np.arange(first, last, step)
    apart = max(1, round(window / step))
    if len(times) < 4 * MIN_WINDOWS * apart:
        return 0.0
    values = [signal.at(times, window) for signal in (a, b)]
    changes = [value[apart:] - value[:-apart] for value in values]
    known = [np.isfinite(change) for change in changes]
    x, y = (np.where(k, change - np.nanmean(change), 0.0) for k, change in zip(known, changes, strict=True))
    reach = int(min(REACH_S / step, 0.4 * len(x)))
    left, right = (np.column_stack([k * 1.0, v, v * v]) for k, v in zip(known, (x, y), strict=True))
    both = correlate(left, right, -reach, reach)
    sums = np.array([both[0, 0], both[1, 0], both[0, 1], both[2, 0], both[0, 2], both[1, 1]]).T
    lags = step * np.arange(-reach, reach + 1)
    correlation = np.where(sums[:, 0] > 0.5 * len(x), _correlation(sums), 0.0)
    near = np.abs(lags) <= LARGEST_LAG
    best = int(np.argmax(correlation))
    far_better = 1.0 - correlation[near].max() ** 2 > FAR_BETTER * (1.0 - correlation[best] ** 2)
    return float(lags[best]) if correlation[best] > FOLLOWS and far_better else 0.0


def lag(a: Signal, b: Signal, window: float, coarse: float | None = None) -> Lag:
    """How much later b shows the same motion than a; NaN if they do not follow each other.

    ``a``, the less noisy one, is moved along: b's noise is then the same at every lag, so that
    the correlation is a smooth function of it. The standard deviation comes from leaving out one
    part of the log after the other, which needs no model of what the two signals do not share.
    ``coarse`` is the result of `coarse_lag`, where other signals determine it better.
    """
    step = 0.1
    lags = np.arange(-LARGEST_LAG, LARGEST_LAG + step / 2, step)
    first, last = max(a.time[0], b.time[0]) + LARGEST_LAG, min(a.time[-1], b.time[-1]) - LARGEST_LAG
    times = np.arange(first, last, window / OVERLAP)
    count = len(times) - OVERLAP
    if count < OVERLAP * MIN_WINDOWS:
        return Lag(np.nan, np.nan)

    def changes(signal: Signal, late: float) -> Array:
        value = signal.at(times - late, window)
        return value[OVERLAP:] - value[:-OVERLAP]

    centre = coarse_lag(a, b, window) if coarse is None else coarse
    b = Signal(b.time - centre, b.value)
    part, y = np.arange(count) * PARTS // count, changes(b, 0.0)
    sums = np.array([_moments(changes(a, float(x)), y, part) for x in lags])
    every = sums.sum(axis=-1)
    correlation = _correlation(every)
    seconds = _peak(lags, correlation)
    without = np.array([_peak(lags, _correlation(every - sums[..., k])) for k in range(PARTS)])
    unshifted = correlation[len(lags) // 2] if centre == 0.0 else 0.0
    better = np.log((1.0 - unshifted**2) / max(1.0 - float(correlation.max()) ** 2, 1e-9))
    return Lag(centre + seconds, float(spread(without)), float(better * count / OVERLAP))


def _moments(x: Array, y: Array, part: NDArray[np.int64]) -> Array:
    """Sums over the windows of each part: how many, x, y, x squared, y squared, x times y; shape (6, PARTS)."""
    both = np.isfinite(x) & np.isfinite(y)
    x, y = np.where(both, x, 0.0), np.where(both, y, 0.0)
    return np.array([np.bincount(part, w, PARTS) for w in (both * 1.0, x, y, x * x, y * y, x * y)])


def _correlation(sums: Array) -> Array:
    """Absolute correlation of sums (m, 6) as `_moments` gives them; shape (m,), 0 without variation."""
    n, x, y, xx, yy, xy = sums.T
    spread = (n * xx - x * x) * (n * yy - y * y)
    return np.asarray(np.abs(n * xy - x * y) / np.sqrt(np.where(spread > 0.0, spread, np.inf)))


def _peak(lags: Array, correlation: Array) -> float:
    """Lag at which a correlation is largest [s]; NaN if the signals do not follow each other there."""
    return peak(lags, correlation) if correlation.max() >= FOLLOWS else np.nan
