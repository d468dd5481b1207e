"""Lags and axes between sensors that show one motion: what all comparisons share.

Cross-correlations of whole dives by FFT, the lag at which one is largest, the ways to name axes, and normal equations
of the parts of a dive: leaving out one after the other shows how much a fit depends on it, without a model of what two
sensors do not share.
"""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft

from rovgraph.geometry import Array, signed_permutations

PARTS = 10  # of a dive
ORIENTATIONS = signed_permutations()  # the 48 ways to name axes; the first is as they are


def correlate(a: Array, b: Array, first: int, last: int) -> Array:
    """Cross-correlations: sum over t of a_i(t) b_j(t + lag), for (n, i) and (m, j); shape (i, j, lags).

    Parameters
    ----------
    first, last : lags, first < 0 <= last
    """
    size = next_fast_len(max(len(b) - first, len(a) + last), real=True)
    A, B = (rfft(v, size, axis=0).T for v in (a, b))
    sums = irfft(A.conj()[:, None] * B, size, axis=-1)
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
