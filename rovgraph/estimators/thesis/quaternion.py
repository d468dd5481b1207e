"""Unit quaternions (eta, eps) of b relative to n, as far as the thesis's filters need them.

    R_nb = I + 2 eta S(eps) + 2 S(eps)^2
    q'   = 1/2 T(q) w = 1/2 Omega(w) q                                            (2.6)

The thesis writes them between w (north-west-up) and its own b (forward-port-up). Turning
both frames half a turn about their x axes changes the sign of eps_2 and eps_3 and leaves
the equations as they are.

R_nb is quadratic in q, T is linear: their derivatives are constant tensors, made once.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rovgraph.estimators.thesis.core import times
from rovgraph.geometry import Array, skew


def _square(q: Array) -> Array:
    """R_nb - I, every element a quadratic form of q; shape (3, 3)."""
    S = skew(q[1:])
    return np.asarray(2.0 * q[0] * S + 2.0 * S @ S)


def _second() -> Array:
    """d2 R_nb / dq dq, shape (3, 3, 4, 4)."""
    e = np.eye(4)
    pairs = [[_square(a + b) - _square(a) - _square(b) for b in e] for a in e]
    return np.moveaxis(np.array(pairs), (0, 1), (2, 3))


def _rates() -> Array:
    """dT/dq, shape (4, 3, 4): T = RATES @ q, Omega = sum over j of RATES[:, j] w_j."""
    eta, e1, e2, e3 = np.eye(4)
    rows = [[-e1, -e2, -e3], [eta, -e3, e2], [e3, eta, -e1], [-e2, e1, eta]]
    return np.array(rows)


SECOND = _second()
RATES = _rates()
_FLAT_RATES = RATES.reshape(12, 4)
_EYE = np.eye(3)


class Turn:
    """A constant matrix times R_nb or its transpose, with its slope.

    Parameters
    ----------
    inverse : take R_bn instead of R_nb
    left : ndarray, shape (..., 3, 3), or None for the identity

    Attributes
    ----------
    second : ndarray, shape (..., 3, 3, 4, 4), second derivative by q
    """

    def __init__(self, inverse: bool = False, left: Array | None = None) -> None:
        second = np.swapaxes(SECOND, 0, 1) if inverse else SECOND
        self._base = _EYE if left is None else left
        self.second: Array = np.einsum("...ij,jkab->...ikab", self._base, second)
        self._flat = self.second.reshape(*self._base.shape[:-2], 36, 4)

    def __call__(self, q: Array) -> tuple[Array, Array]:
        """The matrix, shape (..., 3, 3), and its derivative by q, shape (..., 3, 3, 4)."""
        slope = times(self._flat, q).reshape(*q.shape[:-1], 9, 4)
        turned: Array = self._base + 0.5 * times(slope, q).reshape(*q.shape[:-1], 3, 3)
        return turned, slope.reshape(*q.shape[:-1], 3, 3, 4)


_TURN = Turn()


def matrix(q: Array) -> Array:
    """R_nb, shape (..., 3, 3); a rotation where q is of unit length."""
    return _TURN(q)[0]


def rate_matrix(q: Array) -> Array:
    """T(q) of (2.6), shape (..., 4, 3); ``2 T'`` takes a change of q to a rotation vector in b."""
    return times(_FLAT_RATES, q).reshape(*q.shape[:-1], 4, 3)


def unit(q: Array) -> Array:
    """q at unit length; of quaternions on a leading axis, each."""
    return np.asarray(q / np.sqrt((q * q).sum(axis=-1, keepdims=True)))


def from_matrix(R_nb: ArrayLike) -> Array:
    """Quaternions of rotation matrices, shape (..., 4)."""
    xyzw = Rotation.from_matrix(R_nb).as_quat()
    return np.asarray(xyzw[..., [3, 0, 1, 2]])
