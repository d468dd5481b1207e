"""The common parts of the thesis's filters: models, the Kalman update, quaternions, and rows of many epochs.

The arithmetic is that of `rovgraph.kernels.thesis_filters`. A leading axis, where there is one, is that of filters
side by side. The result of one does not depend on the others, to the last bit.

Unit quaternions (eta, eps) give the attitude of b relative to n:

    R_nb = I + 2 eta S(eps) + 2 S(eps)^2
    q'   = 1/2 T(q) w = 1/2 Omega(w) q                                            (2.6)

The thesis writes them between w (north-west-up) and its own b (forward-port-up). Turning
both frames half a turn about their x axes changes the sign of eps_2 and eps_3 and leaves
the equations as they are.

R_nb is quadratic in q, T is linear: their derivatives are constant tensors, made once.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from rovgraph.geometry import Array, skew
from rovgraph.kernels import thesis_filters as kernels

Linearized = tuple[Array, Array]  # a model's value and its Jacobian
Innovate = Callable[[Array], Linearized]  # state -> innovation and H
Mask = NDArray[np.bool_]

ORDER = 3  # of the polynomials, at most


def times(A: Array, x: Array) -> Array:
    """``A @ x`` of a matrix and a vector over leading axes."""
    return np.asarray((A @ x[..., None])[..., 0])


class Polynomials:
    """Polynomials of the state, of the third order at most, with their Jacobian.

    Parameters
    ----------
    m, n : number of polynomials, and length of the state
    """

    def __init__(self, m: int, n: int) -> None:
        self._size = m, n
        self._places, self._factors = np.empty(0, np.int64), np.empty((0, ORDER), np.int64)
        self._c = np.empty((1, 0))

    def add(self, rows: slice, tensor: Array, *parts: slice) -> None:
        """Add ``sum over j, k.. of tensor[i, j, k..] u_j v_k..`` to the i-th of some polynomials.

        Parameters
        ----------
        rows : which
        tensor : ndarray, shape (rows, len(u), len(v)..)
        parts : places of u, v.. in the state
        """
        place = np.indices(tensor.shape).reshape(tensor.ndim, -1)
        factors = np.full((ORDER, tensor.size), -1)
        for k, part in enumerate(parts):
            factors[k] = part.start + place[k + 1]
        self._places = np.concatenate([self._places, rows.start + place[0]])
        self._factors = np.concatenate([self._factors, np.sort(factors, axis=0).T])
        self._c = np.concatenate([self._c, tensor.reshape(1, -1)], axis=1)

    @classmethod
    def together(cls, members: Sequence["Polynomials"]) -> "Polynomials":
        """Those of several filters side by side, which differ in their coefficients alone."""
        whole = cls(*members[0]._size)
        terms = np.column_stack([members[0]._places, members[0]._factors])
        unlike, which = np.unique(terms, axis=0, return_inverse=True)  # x_i x_j and x_j x_i are one term
        c = np.zeros((len(members), len(unlike)))
        np.add.at(c.T, which.ravel(), np.concatenate([m._c for m in members]).T)
        c = c[:1] if (c == c[0]).all() else c
        used = c.any(axis=0)
        whole._places, whole._factors = unlike[used, 0].copy(), unlike[used, 1:].copy()
        whole._c = np.ascontiguousarray(c[:, used])
        return whole

    def __call__(self, x: Array) -> Linearized:
        """Values, shape (..., m), and Jacobian, shape (..., m, n)."""
        m, n = self._size
        y, J = np.empty((*x.shape[:-1], m)), np.empty((*x.shape[:-1], m, n))
        terms = self._c, self._places, self._factors
        kernels.evaluate_polynomials(*terms, x.reshape(-1, n), y.reshape(-1, m), J.reshape(-1, m, n))
        return y, J

    def step(self, x: Array, dt: float | Array) -> Linearized:
        """``x + dt y``, where y is the rate of x, by forward Euler (2.26), and F."""
        n = x.shape[-1]
        new, F = np.empty(x.shape), np.empty((*x.shape, n))
        terms, flat = (self._c, self._places, self._factors), x.reshape(-1, n)
        dt = np.full(len(flat), dt) if np.ndim(dt) == 0 else np.asarray(dt)
        kernels.step_polynomials(*terms, flat, dt, new.reshape(-1, n), F.reshape(-1, n, n))
        return new, F


def diagonal(A: Array) -> Array:
    """The diagonals of new matrices, to be written to; shape (..., n)."""
    n = A.shape[-1]
    return A.reshape(*A.shape[:-2], n * n)[..., :: n + 1]


def propagate_covariance(P: Array, F: Array, Q: Array, moving: int) -> Array:
    """F P F' + Q, as `rovgraph.kernels.thesis_filters.propagate_covariances`; Q may be whole matrices."""
    new, whole = np.empty_like(P), Q.ndim == P.ndim
    kernels.propagate_covariances(P, F, np.zeros(P.shape[:2]) if whole else Q, moving, new)
    return new + Q if whole else new


def iterated_update(
    x: Array, P: Array, innovate: Innovate, R: Array, measured: Mask, iterations: int = 1
) -> tuple[Array, Array, Array, Array, Array]:
    """A measurement linearised again at each iterate (Bell and Cathey 1993).

    Parameters
    ----------
    x, P : ndarray, shapes (filters, n), (filters, n, n)
    innovate : state -> innovation, shape (filters, m), and H, shape (filters, m, n)
    R : ndarray, shape (filters, m, m)
    measured : ndarray, shape (filters, m), of bool; what is not changes nothing
    iterations : 1 is the plain extended Kalman filter

    Returns
    -------
    innovation, x, P, normalised, sd : the first and the last two as of the first iteration; the innovation of what is
        not measured is undefined
    """
    innovation, H = innovate(x)
    new, P_new, normalised, sd = _update(x, P, innovation, H, R, measured)
    for _ in range(iterations - 1):
        residual, H = innovate(new)
        new, P_new, _, _ = _update(x, P, residual - times(H, x - new), H, R, measured)
    return innovation, new, P_new, normalised, sd


def _update(
    x: Array, P: Array, residual: Array, H: Array, R: Array, measured: Mask
) -> tuple[Array, Array, Array, Array]:
    """State and covariance after a measurement, whitened innovation and its sd before."""
    out = np.empty_like(x), np.empty_like(P), np.empty_like(residual), np.empty_like(residual)
    kernels.update(x, P, kernels.FilterInnovations(residual, H, R, measured), *out)
    return out


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


class ConstantTurn:
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


_TURN = ConstantTurn()


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


Index = int | NDArray[np.int64]  # of an epoch, or of one for each member of a batch


class Epochs:
    """Given values at each epoch; those of several logs lie one after the other.

    Parameters
    ----------
    rows : ndarray, shape (n, ...)
    first : where each member's begin, shape (members,); 0 of a single log
    """

    def __init__(self, rows: Array, first: Index = 0) -> None:
        self._rows, self._first = rows, first

    def at(self, epoch: Index) -> Array:
        """The row at an epoch, or that of each member at its own."""
        return np.asarray(self._rows[self._first + epoch])

    @classmethod
    def together(cls, members: Sequence["Epochs"]) -> "Epochs":
        """Those of single logs as one."""
        ends = np.cumsum([len(m._rows) for m in members])
        return cls(np.concatenate([m._rows for m in members]), np.concatenate([[0], ends[:-1]]))


def widened(rows: Array, width: int) -> Array:
    """Rows with columns of NaN added, shape (n, width)."""
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=np.nan)
