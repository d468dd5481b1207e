"""The IMU's motion over intervals as linear transitions with noise, for Kalman filters.

InsertResult from the graph's own factors, so that a filter believes of the IMU exactly what the graph does.
"""

from collections.abc import Sequence

import numpy as np

from rovgraph.geometry import Array, transpose
from rovgraph.graph.assembly import KeyframeInterval
from rovgraph.graph.coasting import coasting, in_outage
from rovgraph.graph.factors import unscaled
from rovgraph.graph.scale import biased
from rovgraph.graph.values import gtsam_state
from rovgraph.state import State


def transitions(
    intervals: Sequence[KeyframeInterval], before: Sequence[State], after: Sequence[State]
) -> tuple[Array, Array]:
    """Transition matrices and process noise of n intervals, first order.

    The factor's Jacobians A_i, A_j by the two keyframes say A_i e_i + A_j e_j = noise of the
    residual's covariance S, so e_j = F e_i + w with F = -A_j^-1 A_i and cov w = A_j^-1 S A_j^-T.

    Parameters
    ----------
    intervals : with motion
    before, after : State of one epoch each, ``after`` predicted from ``before``

    Returns
    -------
    F, Q : ndarray, shape (n, 15, 15), pose, velocity, bias, in the tangent space of `State`
    """
    A = np.zeros((2, len(intervals), 15, 15)).swapaxes(2, 3)  # columns in a row, where GTSAM writes them
    S = np.empty((len(intervals), 15, 15))
    for k, (interval, one, other) in enumerate(zip(intervals, before, after, strict=True)):
        if in_outage(interval):
            _, A[0, k], A[1, k], S[k] = coasting(interval, one, other)
            continue
        assert interval.pim is not None
        if interval.scale_to_bias is not None:
            one, other = biased(one, interval.scale_to_bias[None]), biased(other, interval.scale_to_bias[None])
        (pose_i, velocity_i, bias_i), (pose_j, velocity_j, bias_j) = gtsam_state(one), gtsam_state(other)
        of_i, of_j = ([own[:, columns] for columns in _COLUMNS] for own in A[:, k])
        jacobians = (*of_i[:2], *of_j[:2], of_i[2], of_j[2])
        unscaled(interval).evaluateError(pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j, *jacobians)
        S[k] = interval.pim.residualCovariance()
    inverse = np.linalg.inv(A[1])
    return -inverse @ A[0], inverse @ S @ transpose(inverse)


_COLUMNS = (slice(0, 6), slice(6, 9), slice(9, 15))
