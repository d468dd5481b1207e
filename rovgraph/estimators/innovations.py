"""What the measurements of a keyframe say, and the Kalman filter's update with robust losses.

Of n filters side by side, each with measurements of its own.
"""

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

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

    Filters with measurements of the same kinds are one computation, and none gets rows of others: what comes
    of it is the same to the last bit whatever goes beside it.

    Parameters
    ----------
    P : ndarray, shape (n, d, d)
    r, H : for each filter an ndarray, shapes (m,) and (m, d)
    parts : for each filter the rows of each of its measurements
    losses : "none", "huber" or "cauchy", of each of its measurements
    """

    def __init__(
        self,
        P: Array,
        r: Sequence[Array],
        H: Sequence[Array],
        parts: Sequence[Sequence[slice]],
        losses: Sequence[Sequence[str]],
    ) -> None:
        by_kinds: dict[tuple[tuple[int, str], ...], list[int]] = {}
        for k, (own, lost) in enumerate(zip(parts, losses, strict=True)):
            kinds = tuple((part.stop - part.start, loss) for part, loss in zip(own, lost, strict=True))
            by_kinds.setdefault(kinds, []).append(k)
        self._groups: list[tuple[list[int], _Alike]] = []
        self._place: dict[int, tuple[_Alike, int]] = {}
        for kinds, chosen in by_kinds.items():
            group = _Alike(P[chosen], np.array([r[k] for k in chosen]), np.array([H[k] for k in chosen]), kinds)
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

    def update(self) -> list[tuple[Array, Array, list[float]]]:
        """Minimise the robust cost of the measurements and of a prior of covariance P.

        By reweighting: weights follow from the residuals after the update, as in the graph's cost,
        not from the innovations, which a attitude_poorly_known prior makes large.

        Returns
        -------
        of each filter
        delta : ndarray, shape (d,), the correction
        P : ndarray, shape (d, d), covariance after it, Joseph's form
        weights : of its measurements
        """
        out: dict[int, tuple[Array, Array, list[float]]] = {}
        for chosen, group in self._groups:
            out |= dict(zip(chosen, group.update(), strict=True))
        return [out[k] for k in range(len(out))]


class _Alike:
    """Those of n filters with measurements of the same kinds.

    P (n, d, d), r (n, m), H (n, m, d), PHt = P H', S = H P H'; kinds: dimension and loss of each measurement.
    """

    def __init__(self, P: Array, r: Array, H: Array, kinds: tuple[tuple[int, str], ...]) -> None:
        self.P, self.r, self.H, self.kinds = P, r, H, kinds
        self.PHt = P @ transpose(H)
        self.S = H @ self.PHt

    def update(self) -> list[tuple[Array, Array, list[float]]]:
        """As `Innovations.update`."""
        if not self.kinds:
            return [(np.zeros(len(P)), P, []) for P in self.P]
        rows, dims = identity(self.r.shape[1]), [dim for dim, _ in self.kinds]
        begun = list(accumulate(dims[:-1], initial=0))
        weights: Array = np.ones((len(self.r), len(dims)))
        renewed = weights
        settled = np.zeros((len(self.r), 1), bool)  # filters do not wait for each other: what has settled stays
        for _ in range(MAX_REWEIGHTINGS):
            root = np.asarray(np.sqrt(weights).repeat(dims, axis=1))
            inverse = np.linalg.inv(root[:, :, None] * self.S * root[:, None, :] + rows)
            gain = root * _times(inverse, root * self.r)
            squared = np.add.reduceat((self.r - _times(self.S, gain)) ** 2, begun, axis=1)
            latest = [loss_weight(own, loss, dim) for own, (dim, loss) in zip(squared.T, self.kinds, strict=True)]
            renewed = np.where(settled, renewed, np.array(latest).T)
            settled |= np.abs(renewed - weights).max(axis=1, keepdims=True) < SETTLED
            if settled.all():
                break
            weights = np.where(settled, weights, renewed)
        K = (self.PHt * root[:, None, :]) @ inverse
        kept = identity(self.P.shape[1]) - K @ (root[:, :, None] * self.H)
        P = kept @ self.P @ transpose(kept) + K @ transpose(K)
        return list(zip(_times(self.PHt, gain), P, renewed.tolist(), strict=True))


def _times(M: Array, v: Array) -> Array:
    """Matrices times vectors, shapes (n, a, b) and (n, b)."""
    out: Array = (M @ v[..., None])[..., 0]
    return out
