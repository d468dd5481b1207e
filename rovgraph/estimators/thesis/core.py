"""The arithmetic of a Kalman filter, and models that are quadratic in the state.

    P <- F P F' + Q
    L L' = H P H' + R,  W = L^-1 H P,  e = L^-1 (z - h)
    x <- x + W' e,  P <- P - W' W

The whitened innovation e has unit covariance if the filter is consistent, and its sum of
squares is the normalised innovation squared (Bar-Shalom, Li and Kirubarajan 2001, 5.4).
W' W is symmetric to the last bit, so that P stays symmetric without being told.

All of it broadcasts: a leading axis, where there is one, is that of filters side by side.
What comes out of one does not depend on the others, to the last bit.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.linalg import get_lapack_funcs

from rovgraph.geometry import Array

Linearized = tuple[Array, Array]  # a model's value and its Jacobian
Innovate = Callable[[Array], Linearized]  # state -> innovation and H

_cholesky, _invert_triangle = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)


def times(A: Array, x: Array) -> Array:
    """``A @ x`` of a matrix and a vector over leading axes."""
    return np.asarray((A @ x[..., None])[..., 0])


class Quadratic:
    """y = c + L x + x' T x / 2, with its Jacobian J = L + T x; so y = c + (L + J) x / 2.

    Parameters
    ----------
    constant : ndarray, shape (..., m)
    linear : ndarray, shape (..., m, n)
    second : ndarray, shape (..., m, n, n), symmetric in the last two axes
    """

    def __init__(self, constant: Array, linear: Array, second: Array) -> None:
        *batch, m, n = linear.shape
        slope = second.reshape(*batch, m * n, n)
        self._parts = constant, linear, second
        self._varying = np.flatnonzero(slope.any(axis=(*range(len(batch)), -1)))
        self._slope = slope[..., self._varying, :].copy()
        self._base = linear.reshape(*batch, m * n)[..., self._varying]

    @classmethod
    def together(cls, members: Sequence["Quadratic"]) -> "Quadratic":
        """Those of several filters side by side."""
        return cls(*(np.stack(parts) for parts in zip(*(m._parts for m in members), strict=True)))

    def __call__(self, x: Array) -> Linearized:
        """Value, shape (..., m), and Jacobian, shape (..., m, n)."""
        constant, linear, _ = self._parts
        J = np.empty((*x.shape[:-1], *linear.shape[-2:]))
        J[...] = linear
        J.reshape(*x.shape[:-1], -1)[..., self._varying] = self._base + times(self._slope, x)
        return constant + 0.5 * times(linear + J, x), J


def diagonal(A: Array) -> Array:
    """The diagonals of new matrices, to be written to; shape (..., n)."""
    n = A.shape[-1]
    return A.reshape(*A.shape[:-2], n * n)[..., :: n + 1]


def propagate_covariance(P: Array, F: Array, moving: int) -> Array:
    """F P F', symmetric.

    Parameters
    ----------
    P, F : ndarray, shape (..., n, n)
    moving : beyond the first so many, the state stands still: F is the identity there
    """
    F = F[..., :moving, :moving]
    spread = F @ P[..., :moving, :]
    square = spread[..., :moving] @ F.mT
    new = P.copy()
    new[..., :moving, :moving] = 0.5 * (square + square.mT)
    new[..., :moving, moving:] = spread[..., moving:]
    new[..., moving:, :moving] = spread[..., moving:].mT
    return new


def inverse_root(S: Array) -> Array:
    """L^-1 of ``L L' = S``, shape (..., m, m); NaN where S is not positive definite.

    LAPACK by itself, for one after the other, takes less time than NumPy's functions of them all.
    """
    out = np.empty_like(S)
    for root, each in zip(out.reshape(-1, *S.shape[-2:]), S.reshape(-1, *S.shape[-2:]), strict=True):
        L, failed = _cholesky(each, lower=1)
        root[...] = np.nan if failed else _invert_triangle(L, lower=1)[0]
    return out


def update(x: Array, P: Array, residual: Array, H: Array, R: Array) -> tuple[Array, Array, Array, Array]:
    """One measurement.

    Parameters
    ----------
    x, P : ndarray, shapes (..., n), (..., n, n)
    residual : ndarray, shape (..., m), measured minus predicted
    H, R : ndarray, shapes (..., m, n), (..., m, m)

    Returns
    -------
    x, P : after the measurement; not finite where the innovation's covariance is not
        positive definite: the filter has diverged
    normalised : ndarray, shape (..., m), whitened innovation
    sd : ndarray, shape (..., m), standard deviations of the innovation
    """
    HP = H @ P
    S = HP @ H.mT + R
    whitener = inverse_root(S)
    W, normalised = whitener @ HP, times(whitener, residual)
    sd = np.sqrt(S.diagonal(axis1=-2, axis2=-1))
    return x + times(W.mT, normalised), P - W.mT @ W, normalised, sd


def iterated_update(
    x: Array, P: Array, innovate: Innovate, R: Array, iterations: int = 1
) -> tuple[Array, Array, Array, Array, Array]:
    """A measurement linearised again at each iterate (Bell and Cathey 1993).

    Parameters
    ----------
    x, P : ndarray, shapes (..., n), (..., n, n)
    innovate : state -> innovation, shape (..., m), and H, shape (..., m, n)
    R : ndarray, shape (..., m, m)
    iterations : 1 is the plain extended Kalman filter

    Returns
    -------
    innovation, x, P, normalised, sd : the first and the last two as of the first iteration
    """
    innovation, H = innovate(x)
    new, P_new, normalised, sd = update(x, P, innovation, H, R)
    for _ in range(iterations - 1):
        residual, H = innovate(new)
        new, P_new, _, _ = update(x, P, residual - times(H, x - new), H, R)
    return innovation, new, P_new, normalised, sd
