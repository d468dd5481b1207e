"""The filter's prediction over one interval.

    x_j = f(x_i, b + S k),  e_j = F e_i + w,  P_j = F P_i F' + Q

    B_j = F B_i + F_y                                                     of what is considered

f, F and Q of pose, velocity and bias are the motion's (`rovgraph.kernels.motion`); k are the IMU's scale errors
where S is given. Calibration that walks adds its variance a second times the interval to Q; with a time constant it
is a first-order Gauss-Markov process (Gelb 1974), of which F keeps exp(-dt / T).
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper, view_helper
from rovgraph.kernels.filter_state import FilterModel, FilterState
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.motion import predict_with_transition
from rovgraph.kernels.motion_row import DURATION
from rovgraph.kernels.states import Epoch, epoch_in, with_bias

MOVED = 9  # components that the motion mixes: rotation, position, velocity; biases and calibration stay


@helper
def carry(P: Array, F: Array, Q: Array) -> None:
    """P <- F P F' + Q, F the unit matrix but for its first rows and its diagonal; P stays symmetric."""
    n = len(P)
    FP, own = np.zeros((MOVED, n)), np.empty(MOVED)
    for i in range(MOVED):
        for j in range(n):
            share = F[i, j]
            if share != 0.0:
                for k in range(n):
                    FP[i, k] += share * P[j, k]
    for i in range(MOVED):
        for k in range(MOVED, n):
            P[i, k] = P[k, i] = FP[i, k]
    for i in range(MOVED):
        for k in range(i + 1):
            total = 0.0
            for j in range(n):
                total += FP[i, j] * F[k, j]
            own[k] = total
        for k in range(i + 1):
            P[i, k] = P[k, i] = own[k]
    for i in range(MOVED, n):
        if F[i, i] != 1.0:
            for k in range(n):
                P[i, k] *= F[i, i]
            for k in range(n):
                P[k, i] *= F[i, i]
    for i in range(n):
        for j in range(n):
            P[i, j] += Q[i, j]


@view_helper
def carry_considered(B: Array, F: Array, moved: Array, own: Array) -> None:
    """B <- F B + F_y, ``moved`` being the rows of F_y that are not zero; ``own`` (MOVED,) is to calculate with."""
    for k in range(B.shape[1]):
        for i in range(MOVED):
            own[i] = moved[i, k]
            for j in range(len(B)):
                own[i] += F[i, j] * B[j, k]
        for i in range(MOVED):
            B[i, k] = own[i]
        for i in range(MOVED, len(B)):
            B[i, k] *= F[i, i]


@helper
def predict_filter(
    known: FilterState, motion: Array, covariance: Array, scale: Array, model: FilterModel, F_out: Array, Q_out: Array
) -> None:
    """Carry an estimate over an interval, in place.

    Parameters
    ----------
    motion, covariance : row of `rovgraph.kernels.motion_row`, and that of its residual, shape (15, 15)
    scale : shape (6, 6), bias by the IMU's scales, or (0, 0) where these are exact
    F_out, Q_out : shape (n, n), transition and noise
    """
    x, c, P, B, L = known
    column, walk, estimated = model.column, model.walk, model.walk.shape[1]
    n, moved = len(P), np.zeros((MOVED, len(L)))
    bias, F, Q = x[15:21].copy(), np.zeros((MOTION, MOTION)), np.zeros((MOTION, MOTION))
    if len(scale):
        for i in range(6):
            for k in range(6):
                bias[i] += scale[i, k] * c[ACC_SCALE + k]
    there = np.empty(15)
    out = Epoch(there[0:9].reshape(3, 3), there[9:12], there[12:15], bias, c)
    predict_with_transition(motion, covariance, with_bias(epoch_in(x, c), bias), out, F, Q)
    for i in range(15):
        x[i] = there[i]
    F_out.fill(0.0)
    Q_out.fill(0.0)
    for i in range(n):
        F_out[i, i] = 1.0
    for i in range(estimated):
        Q_out[i, i] = walk[0, i] * motion[DURATION]
    for i in range(MOTION, len(column)):
        own = column[i]
        if 0 <= own < estimated and walk[1, own] > 0.0:
            rate = walk[1, own]
            keep = math.exp(-rate * motion[DURATION])
            F_out[own, own] = keep
            Q_out[own, own] = walk[0, own] * (1.0 - keep * keep) / (2.0 * rate)
            c[i - MOTION] = walk[2, own] + keep * (c[i - MOTION] - walk[2, own])
    for i in range(MOTION):
        for j in range(MOTION):
            F_out[i, j] = F[i, j]
            Q_out[i, j] += Q[i, j]
    if len(scale):
        for k in range(6):
            own = column[MOTION + ACC_SCALE + k]
            if own >= 0:  # a scale moves the state as the bias does that it makes, but not the bias itself
                for i in range(MOVED):
                    by = 0.0
                    for j in range(6):
                        by += F[i, MOVED + j] * scale[j, k]
                    if own < estimated:
                        F_out[i, own] += by
                    else:
                        for j in range(len(L)):
                            moved[i, j] += by * L[own - estimated, j]
    carry(P, F_out, Q_out)
    if len(L):
        carry_considered(B, F_out, moved, np.empty(MOVED))
