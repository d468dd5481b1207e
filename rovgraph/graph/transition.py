"""The IMU's motion over an interval as a linear transition with noise, for Kalman filters.

Taken from the graph's own factor, so that a filter believes of the IMU exactly what the graph does.
"""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.graph.assembly import Interval
from rovgraph.graph.factors import unscaled
from rovgraph.graph.scale import biased
from rovgraph.graph.values import gtsam_state
from rovgraph.state import State


def transition(interval: Interval, before: State, after: State) -> tuple[Array, Array]:
    """Transition matrix and process noise of an interval, first order.

    The factor's Jacobians A_i, A_j by the two keyframes say A_i e_i + A_j e_j = noise of the
    residual's covariance S, so e_j = F e_i + w with F = -A_j^-1 A_i and cov w = A_j^-1 S A_j^-T.

    Parameters
    ----------
    interval : with motion
    before, after : State of one epoch each, ``after`` predicted from ``before``

    Returns
    -------
    F, Q : ndarray, shape (15, 15), pose, velocity, bias, in the tangent space of `State`
    """
    assert interval.pim is not None
    if interval.felt is not None:
        before, after = biased(before, interval.felt[None]), biased(after, interval.felt[None])
    A = np.zeros((2, 15, 15)).swapaxes(1, 2)  # columns in a row, where GTSAM writes them
    (pose_i, velocity_i, bias_i), (pose_j, velocity_j, bias_j) = gtsam_state(before), gtsam_state(after)
    of_i, of_j = ([own[:, columns] for columns in _COLUMNS] for own in A)
    jacobians = (*of_i[:2], *of_j[:2], of_i[2], of_j[2])
    unscaled(interval).evaluateError(pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j, *jacobians)
    inverse = np.linalg.inv(A[1])
    return -inverse @ A[0], inverse @ interval.pim.residualCovariance() @ inverse.T


_COLUMNS = (slice(0, 6), slice(6, 9), slice(9, 15))
