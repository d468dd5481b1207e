"""What the measurements of a keyframe say, and the Kalman filter's update with robust losses.

Of n filters side by side, each with measurements of its own: rows that one does not have are
zero, and say nothing.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, identity, transpose
from rovgraph.graph.measurements import loss_weight

MAX_REWEIGHTINGS = 20
SETTLED = 1e-3  # change of a weight


def normalised_squared(P: Array, r: Array, H: Array) -> float:
    """Innovation squared over its covariance (NIS): chi-square with ``len(r)`` degrees of freedom.

    Parameters
    ----------
    P : ndarray, shape (d, d), covariance before the update
    r : ndarray, shape (dim,), innovation, whitened with the measurement's noise
    H : ndarray, shape (dim, d), Jacobian, whitened alike
    """
    return _normalised_squared(r, H @ P @ H.T)


def _normalised_squared(r: Array, S: Array) -> float:
    if len(r) == 1:
        return float(r[0] * r[0] / (S[0, 0] + 1.0))
    return float(r @ np.linalg.solve(S + identity(len(r)), r))


class Innovations:
    """Whitened innovations of n filters, with the covariance before they enter.

    Parameters
    ----------
    P : ndarray, shape (n, d, d); changed by `doubt`
    r : ndarray, shape (n, m)
    H : ndarray, shape (n, m, d)
    parts : for each filter the rows of each of its measurements
    """

    def __init__(self, P: Array, r: Array, H: Array, parts: Sequence[Sequence[slice]]) -> None:
        self.P, self.r, self.H, self.parts = P, r, H, parts
        self._PHt = P @ transpose(H)
        self._S = H @ self._PHt

    def nis(self, k: int, part: slice) -> float:
        """Normalised innovation squared of a measurement of filter ``k``."""
        return _normalised_squared(self.r[k, part], self._S[k, part, part])

    def leave_out(self, k: int, part: slice) -> None:
        """Make nothing of a measurement of filter ``k``."""
        self.r[k, part], self.H[k, part], self._PHt[k, :, part] = 0.0, 0.0, 0.0
        self._S[k, part, :] = self._S[k, :, part] = 0.0

    def doubt(self, k: int, P: Array) -> None:
        """Another covariance of filter ``k``, shape (d, d)."""
        self.P[k] = P
        self._PHt[k] = P @ self.H[k].T
        self._S[k] = self.H[k] @ self._PHt[k]

    def update(self, losses: Sequence[Sequence[str]]) -> tuple[Array, Array, list[list[float]]]:
        """Minimise the robust cost of the measurements and of a prior of covariance P.

        By reweighting: weights follow from the residuals after the update, as in the graph's cost,
        not from the innovations, which a vague prior makes large.

        Parameters
        ----------
        losses : "none", "huber" or "cauchy", of each filter's measurements

        Returns
        -------
        delta : ndarray, shape (n, d), the corrections
        P : ndarray, shape (n, d, d), covariance after them, Joseph's form
        weights : of each filter's measurements
        """
        rows = self.r.shape[1]
        owner, kinds = self._owners(losses)
        weights: Array = np.ones(owner.shape[:2])
        renewed = weights
        settled = np.zeros((len(owner), 1), bool)  # filters do not wait for each other: what has settled stays
        for _ in range(MAX_REWEIGHTINGS):
            root = np.asarray(np.sqrt(_times(transpose(owner), weights)))
            inverse = np.linalg.inv(root[:, :, None] * self._S * root[:, None, :] + identity(rows))
            gain = root * _times(inverse, root * self.r)
            squared = _times(owner, (self.r - _times(self._S, gain)) ** 2)
            latest = np.ones_like(squared)
            for (loss, dim), chosen in kinds.items():
                latest[chosen] = loss_weight(squared[chosen], loss, dim)
            renewed = np.where(settled, renewed, latest)
            settled |= np.abs(renewed - weights).max(axis=1, keepdims=True) < SETTLED
            if settled.all():
                break
            weights = np.where(settled, weights, renewed)
        K = (self._PHt * root[:, None, :]) @ inverse
        kept = identity(self.P.shape[1]) - K @ (root[:, :, None] * self.H)
        P = kept @ self.P @ transpose(kept) + K @ transpose(K)
        of_each = [row[: len(parts)] for row, parts in zip(renewed.tolist(), self.parts, strict=True)]
        return _times(self._PHt, gain), P, of_each

    def _owners(self, losses: Sequence[Sequence[str]]) -> tuple[Array, dict[tuple[str, int], NDArray[np.bool_]]]:
        """Which rows are whose: 1 or 0, shape (n, most, m); and the measurements of each loss and dimension."""
        n, most = len(self.parts), max(len(parts) for parts in self.parts)
        owner = np.zeros((n, most, self.r.shape[1]))
        kinds: dict[tuple[str, int], NDArray[np.bool_]] = {}
        for k, parts in enumerate(self.parts):
            for j, (part, loss) in enumerate(zip(parts, losses[k], strict=True)):
                owner[k, j, part] = 1.0
                kind = loss, part.stop - part.start
                if kind not in kinds:
                    kinds[kind] = np.zeros((n, most), bool)
                kinds[kind][k, j] = True
        return owner, kinds


def _times(M: Array, v: Array) -> Array:
    """Matrices times vectors, shapes (n, a, b) and (n, b)."""
    return np.asarray((M @ v[..., None])[..., 0])
