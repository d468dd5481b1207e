"""The arithmetic of a Kalman filter, and models that are quadratic in the state.

    P <- F P F' + Q
    L L' = H P H' + R,  W = L^-1 H P,  e = L^-1 (z - h)
    x <- x + W' e,  P <- P - W' W

The whitened innovation e has unit covariance if the filter is consistent, and its sum of
squares is the normalised innovation squared (Bar-Shalom, Li and Kirubarajan 2001, 5.4).
W' W is symmetric to the last bit, so that P stays symmetric without being told.
"""

from collections.abc import Callable

import numpy as np
from scipy.linalg import get_lapack_funcs

from rovgraph.geometry import Array

Linearized = tuple[Array, Array]  # a model's value and its Jacobian
Innovate = Callable[[Array], Linearized]  # state -> innovation and H

_cholesky, _invert_triangle = get_lapack_funcs(("potrf", "trtri"), dtype=np.float64)


class Quadratic:
    """y = c + L x + x' T x / 2, with its Jacobian J = L + T x; so y = c + (L + J) x / 2.

    Parameters
    ----------
    constant : ndarray, shape (m,)
    linear : ndarray, shape (m, n)
    second : ndarray, shape (m, n, n), symmetric in the last two axes
    """

    def __init__(self, constant: Array, linear: Array, second: Array) -> None:
        self._constant, self._linear = constant, linear.copy()
        self._varying = np.flatnonzero(second.any(axis=2))
        self._slope = second.reshape(linear.size, -1)[self._varying].copy()
        self._base = linear.reshape(-1)[self._varying]
        self._J = linear.copy()
        self._entries = self._J.reshape(-1)

    def __call__(self, x: Array) -> Linearized:
        """Value, shape (m,), and Jacobian, shape (m, n)."""
        self._entries[self._varying] = self._base + self._slope @ x
        return self._constant + 0.5 * (self._linear @ x + self._J @ x), self._J.copy()


def propagate_covariance(P: Array, F: Array) -> Array:
    """F P F', symmetric."""
    spread = F @ P @ F.T
    return np.asarray(0.5 * (spread + spread.T))


def update(x: Array, P: Array, residual: Array, H: Array, R: Array) -> tuple[Array, Array, Array, Array]:
    """One measurement.

    Parameters
    ----------
    x, P : ndarray, shapes (n,), (n, n)
    residual : ndarray, shape (m,), measured minus predicted
    H, R : ndarray, shapes (m, n), (m, m)

    Returns
    -------
    x, P : after the measurement
    normalised : ndarray, shape (m,), whitened innovation
    sd : ndarray, shape (m,), standard deviations of the innovation

    Raises
    ------
    FloatingPointError : the innovation's covariance is not positive definite: the filter
        has diverged
    """
    HP = H @ P
    S = HP @ H.T + R
    L, failed = _cholesky(S, lower=1)
    if failed:
        raise FloatingPointError("innovation covariance is not positive definite")
    whitener, _ = _invert_triangle(L, lower=1)
    W, normalised = whitener @ HP, whitener @ residual
    return x + normalised @ W, P - W.T @ W, normalised, np.sqrt(S.diagonal())


def iterated_update(
    x: Array, P: Array, innovate: Innovate, R: Array, iterations: int = 1
) -> tuple[Array, Array, Array, Array, Array]:
    """A measurement linearised anew at each iterate (Bell and Cathey 1993).

    Parameters
    ----------
    x, P : ndarray, shapes (n,), (n, n)
    innovate : state -> innovation, shape (m,), and H, shape (m, n)
    R : ndarray, shape (m, m)
    iterations : 1 is the plain extended Kalman filter

    Returns
    -------
    innovation, x, P, normalised, sd : the first and the last two as of the first iteration
    """
    innovation, H = innovate(x)
    new, P_new, normalised, sd = update(x, P, innovation, H, R)
    for _ in range(iterations - 1):
        residual, H = innovate(new)
        new, P_new, _, _ = update(x, P, residual - H @ (x - new), H, R)
    return innovation, new, P_new, normalised, sd
