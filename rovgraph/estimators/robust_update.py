"""A Kalman filter's update with robust losses."""

from collections.abc import Sequence
from itertools import accumulate

import numpy as np

from rovgraph.geometry import Array
from rovgraph.graph.measurements import loss_weight

MAX_REWEIGHTINGS = 20
SETTLED = 1e-3  # change of a weight


def normalised_squared(P: Array, r: Array, H: Array) -> float:
    """Innovation squared over its covariance (NIS): chi-square with ``len(r)`` degrees of freedom.

    Parameters
    ----------
    P : ndarray, shape (size, size), covariance before the update
    r : ndarray, shape (dim,), innovation, whitened with the measurement's noise
    H : ndarray, shape (dim, size), Jacobian, whitened alike
    """
    return float(r @ np.linalg.solve(H @ P @ H.T + np.eye(len(r)), r))


def robust_update(
    P: Array, r: Sequence[Array], H: Sequence[Array], losses: Sequence[str]
) -> tuple[Array, Array, list[float]]:
    """Minimise the robust cost of some measurements and of a prior of covariance P.

    By reweighting: weights follow from the residuals after the update, as in the graph's cost,
    not from the innovations, which a vague prior makes large.

    Parameters
    ----------
    P : ndarray, shape (size, size)
    r : ndarray, shape (dim,) each, whitened innovations
    H : ndarray, shape (dim, size) each, whitened Jacobians
    losses : "none", "huber" or "cauchy", of each

    Returns
    -------
    delta : ndarray, shape (size,), the correction
    P : ndarray, shape (size, size), covariance after it, Joseph's form
    weights : of each measurement
    """
    residual, J = np.concatenate(r), np.concatenate(H)
    sizes = [len(one) for one in r]
    parts = [slice(end - size, end) for end, size in zip(accumulate(sizes), sizes, strict=True)]
    PJt = P @ J.T
    S, unit = J @ PJt, np.eye(len(residual))
    weights = np.ones(len(r))
    for _ in range(MAX_REWEIGHTINGS):
        root = np.sqrt(weights).repeat(sizes)
        inverse = np.linalg.inv(root[:, None] * S * root + unit)
        gain = root * (inverse @ (root * residual))
        left = residual - S @ gain
        squared = [left[part] @ left[part] for part in parts]
        renewed = np.array([loss_weight(*one) for one in zip(squared, losses, sizes, strict=True)])
        change, weights = np.abs(renewed - weights).max(), renewed
        if change < SETTLED:
            break
    K = (PJt * root) @ inverse
    kept = np.eye(len(P)) - K @ (root[:, None] * J)
    return PJt @ gain, kept @ P @ kept.T + K @ K.T, weights.tolist()
