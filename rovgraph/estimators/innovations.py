"""What the measurements of a keyframe say, and the Kalman filter's update with robust losses.

Of n filters side by side, each with measurements of its own.
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

    Filters with equally many rows are one computation, and none gets rows of others: what comes of it is
    the same to the last bit whatever goes beside it.

    Parameters
    ----------
    P : ndarray, shape (n, d, d)
    r : for each filter an ndarray, shape (m,)
    H : for each filter an ndarray, shape (m, d)
    parts : for each filter the rows of each of its measurements
    """

    def __init__(self, P: Array, r: Sequence[Array], H: Sequence[Array], parts: Sequence[Sequence[slice]]) -> None:
        by_rows: dict[int, list[int]] = {}
        for k, own in enumerate(r):
            by_rows.setdefault(len(own), []).append(k)
        self._groups: list[tuple[list[int], _Alike]] = []
        self._place: dict[int, tuple[_Alike, int]] = {}
        for chosen in by_rows.values():
            own_r, own_H = np.array([r[k] for k in chosen]), np.array([H[k] for k in chosen])
            group = _Alike(P[chosen], own_r, own_H, [parts[k] for k in chosen])
            self._groups.append((chosen, group))
            self._place |= {k: (group, i) for i, k in enumerate(chosen)}

    def P(self, k: int) -> Array:
        """Covariance of filter ``k`` before they enter, shape (d, d)."""
        group, i = self._place[k]
        return np.asarray(group.P[i])

    def nis(self, k: int, part: slice) -> float:
        """Normalised innovation squared of a measurement of filter ``k``."""
        group, i = self._place[k]
        return _normalised_squared(group.r[i, part], group.S[i, part, part])

    def leave_out(self, k: int, part: slice) -> None:
        """Make nothing of a measurement of filter ``k``."""
        group, i = self._place[k]
        group.r[i, part], group.H[i, part], group.PHt[i, :, part] = 0.0, 0.0, 0.0
        group.S[i, part, :] = group.S[i, :, part] = 0.0

    def doubt(self, k: int, part: slice, seen: Array) -> None:
        """Let something that no model knows have moved what a sensor sees, by as much as its measurement shows.

        As a knock does to the velocity, without doubt about anything else.

        Parameters
        ----------
        k, part : the measurement
        seen : ndarray, shape (d, s), directions of the error that its sensor sees
        """
        group, i = self._place[k]
        moved = np.linalg.lstsq(group.H[i, part] @ seen, group.r[i, part])[0]
        group.P[i] += float(moved @ moved) * seen @ seen.T
        group.PHt[i] = group.P[i] @ group.H[i].T
        group.S[i] = group.H[i] @ group.PHt[i]

    def update(self, losses: Sequence[Sequence[str]]) -> list[tuple[Array, Array, list[float]]]:
        """Minimise the robust cost of the measurements and of a prior of covariance P.

        By reweighting: weights follow from the residuals after the update, as in the graph's cost,
        not from the innovations, which a vague prior makes large.

        Parameters
        ----------
        losses : "none", "huber" or "cauchy", of each filter's measurements

        Returns
        -------
        of each filter
        delta : ndarray, shape (d,), the correction
        P : ndarray, shape (d, d), covariance after it, Joseph's form
        weights : of its measurements
        """
        out: dict[int, tuple[Array, Array, list[float]]] = {}
        for chosen, group in self._groups:
            out |= dict(zip(chosen, group.update([losses[k] for k in chosen]), strict=True))
        return [out[k] for k in range(len(out))]


class _Alike:
    """Those of filters with equally many rows: P (n, d, d), r (n, m), H (n, m, d), PHt = P H', S = H P H'."""

    def __init__(self, P: Array, r: Array, H: Array, parts: Sequence[Sequence[slice]]) -> None:
        self.P, self.r, self.H, self.parts = P, r, H, parts
        self.PHt = P @ transpose(H)
        self.S = H @ self.PHt

    def update(self, losses: Sequence[Sequence[str]]) -> list[tuple[Array, Array, list[float]]]:
        """As `Innovations.update`."""
        if not self.r.size:
            return [(np.zeros(len(P)), P, []) for P in self.P]
        rows = self.r.shape[1]
        owner, kinds = self._owners(losses)
        weights: Array = np.ones(owner.shape[:2])
        renewed = weights
        settled = np.zeros((len(owner), 1), bool)  # filters do not wait for each other: what has settled stays
        for _ in range(MAX_REWEIGHTINGS):
            root = np.asarray(np.sqrt(_times(transpose(owner), weights)))
            inverse = np.linalg.inv(root[:, :, None] * self.S * root[:, None, :] + identity(rows))
            gain = root * _times(inverse, root * self.r)
            squared = _times(owner, (self.r - _times(self.S, gain)) ** 2)
            latest = np.ones_like(squared)
            for (loss, dim), chosen in kinds.items():
                latest[chosen] = loss_weight(squared[chosen], loss, dim)
            renewed = np.where(settled, renewed, latest)
            settled |= np.abs(renewed - weights).max(axis=1, keepdims=True) < SETTLED
            if settled.all():
                break
            weights = np.where(settled, weights, renewed)
        K = (self.PHt * root[:, None, :]) @ inverse
        kept = identity(self.P.shape[1]) - K @ (root[:, :, None] * self.H)
        P = kept @ self.P @ transpose(kept) + K @ transpose(K)
        of_each = [row[: len(parts)] for row, parts in zip(renewed.tolist(), self.parts, strict=True)]
        return list(zip(_times(self.PHt, gain), P, of_each, strict=True))

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
