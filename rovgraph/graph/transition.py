"""The IMU's motion over an interval as a linear transition with noise, for Kalman filters.

Taken from the graph's own factor, so that a filter believes of the IMU exactly what the graph does.
"""

import gtsam
import numpy as np

from rovgraph.geometry import Array
from rovgraph.graph.assembly import Interval
from rovgraph.graph.factors import unscaled
from rovgraph.graph.scale import biased
from rovgraph.graph.values import insert_state
from rovgraph.state import State


def transition(interval: Interval, before: State, after: State) -> tuple[Array, Array]:
    """Transition matrix and process noise of an interval, first order.

    The factor's whitened Jacobians A_i, A_j by the two keyframes say A_i e_i + A_j e_j = white
    noise of unit covariance, so e_j = F e_i + w with F = -A_j^-1 A_i and cov w = A_j^-1 A_j^-T.

    Parameters
    ----------
    interval : with motion
    before, after : State of one epoch each, ``after`` predicted from ``before``

    Returns
    -------
    F, Q : ndarray, shape (15, 15), pose, velocity, bias, in the tangent space of `State`
    """
    i, j = interval.index - 1, interval.index
    values = gtsam.Values()
    if interval.felt is not None:
        before, after = biased(before, interval.felt[None]), biased(after, interval.felt[None])
    insert_state(values, i, before)
    insert_state(values, j, after)
    A, _ = unscaled(interval).linearize(values).jacobian()  # pose and velocity of i and of j, bias of i and of j
    noise = np.linalg.inv(A[:, _AFTER])
    return -noise @ A[:, _BEFORE], noise @ noise.T


_BEFORE, _AFTER = np.r_[0:9, 18:24], np.r_[9:18, 24:30]
