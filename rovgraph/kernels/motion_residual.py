"""How the states at both ends of an interval disagree with the IMU's motion between them.

The residual is that of ``gtsam.CombinedImuFactor``: the logarithm on SE_2(3) of what `rovgraph.kernels.motion`
predicts, (R, p, v), seen from the keyframe after, and the change of bias:

    phi = Log(R_j' R),  r = (phi, Jl(phi)^-1 R_j' (p - p_j), Jl(phi)^-1 R_j' (v - v_j), b_i - b_j)

Of an interval that is coasted through it is that of `rovgraph.kernels.coasting`, without an IMU that of
`rovgraph.kernels.cruising`.
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.coasting import coasting_covariance, coasting_error
from rovgraph.kernels.compile import helper, kernel
from rovgraph.kernels.cruising import cruising_covariance, cruising_error
from rovgraph.kernels.motion import is_coasted, is_cruising, predict_motion, predict_with_jacobian
from rovgraph.kernels.motion_row import COVARIANCE
from rovgraph.kernels.rotations import (
    inverse_jacobian_with_slope,
    inverse_right_jacobian,
    log_rotation,
    multiply_transposed,
    rotate_back,
)


@helper
def motion_error(
    row: Array,
    R_i: Array,
    p_i: Array,
    v_i: Array,
    bias_i: Array,
    R_j: Array,
    p_j: Array,
    v_j: Array,
    bias_j: Array,
    r_out: Array,
    A_i_out: Array,
    A_j_out: Array,
) -> None:
    """Residual of one interval, shape (15,), and its derivatives by both states, shape (15, 15)."""
    if is_cruising(row):
        cruising_error(row, R_i, p_i, v_i, bias_i, R_j, p_j, v_j, bias_j, r_out, A_i_out, A_j_out)
        return
    if is_coasted(row):
        coasting_error(row, R_i, p_i, v_i, bias_i, R_j, p_j, v_j, bias_j, r_out, A_i_out, A_j_out)
        return
    R, away, J = np.empty((3, 3)), np.empty((2, 3)), np.empty((9, 15))
    phi, apart, Jr = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    predict_with_jacobian(row, R_i, p_i, v_i, bias_i, R, away[0], away[1], J)
    multiply_transposed(R_j, R, apart)
    log_rotation(apart, phi)
    inverse_right_jacobian(phi, Jr)
    for i in range(15):
        for j in range(15):
            A_i_out[i, j] = A_j_out[i, j] = 0.0
    for i in range(6):
        r_out[9 + i] = bias_i[i] - bias_j[i]
        A_i_out[9 + i, 9 + i], A_j_out[9 + i, 9 + i] = 1.0, -1.0
    for i in range(3):
        r_out[i], away[0, i], away[1, i] = phi[i], away[0, i] - p_j[i], away[1, i] - v_j[i]
        for j in range(15):
            A_i_out[i, j] = Jr[i, 0] * J[0, j] + Jr[i, 1] * J[1, j] + Jr[i, 2] * J[2, j]
        for j in range(3):
            A_j_out[i, j] = -Jr[j, i]  # Jl^-1 is Jr^-1 transposed
    for k in range(2):
        _linear_error(3 + 3 * k, away[k], R_j, J, r_out, A_i_out, A_j_out)
    for i in range(3):  # position is perturbed in body axes
        x, y, z = A_j_out[3 + i, 3], A_j_out[3 + i, 4], A_j_out[3 + i, 5]
        for j in range(3):
            A_j_out[3 + i, 3 + j] = x * R_j[0, j] + y * R_j[1, j] + z * R_j[2, j]


@helper
def _linear_error(at: int, away: Array, R_j: Array, J: Array, r: Array, A_i: Array, A_j: Array) -> None:
    """Rows ``at`` to ``at + 2``: Jl(phi)^-1 R_j' away, where phi and its derivatives are in the first three."""
    seen, Jl, slope, back = np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    rotate_back(R_j, away, seen)
    inverse_jacobian_with_slope(r, seen, -0.5, Jl, slope)
    x, y, z = seen[0], seen[1], seen[2]
    for i in range(3):
        r[at + i] = Jl[i, 0] * x + Jl[i, 1] * y + Jl[i, 2] * z
        A_j[at + i, 0] = Jl[i, 1] * z - Jl[i, 2] * y
        A_j[at + i, 1] = Jl[i, 2] * x - Jl[i, 0] * z
        A_j[at + i, 2] = Jl[i, 0] * y - Jl[i, 1] * x
        for j in range(3):
            back[i, j] = Jl[i, 0] * R_j[j, 0] + Jl[i, 1] * R_j[j, 1] + Jl[i, 2] * R_j[j, 2]
            A_j[at + i, at + j] = -back[i, j]
            A_j[at + i, j] += slope[i, 0] * A_j[0, j] + slope[i, 1] * A_j[1, j] + slope[i, 2] * A_j[2, j]
        for j in range(15):
            for k in range(3):
                A_i[at + i, j] += back[i, k] * J[at + k, j] + slope[i, k] * A_i[k, j]


@helper
def _whitening(S: Array, W_out: Array) -> None:
    """The inverse of the Cholesky factor of S, which is lost."""
    for j in range(15):
        for i in range(j, 15):
            total = S[i, j]
            for k in range(j):
                total -= S[i, k] * S[j, k]
            S[i, j] = total / math.sqrt(S[j, j]) if i > j else total
        S[j, j] = math.sqrt(S[j, j])
    for j in range(15):
        for i in range(15):
            W_out[i, j] = 0.0
        W_out[j, j] = 1.0 / S[j, j]
        for i in range(j + 1, 15):
            total = 0.0
            for k in range(j, i):
                total -= S[i, k] * W_out[k, j]
            W_out[i, j] = total / S[i, i]


@helper
def whiten_motion(W: Array, r: Array, A_i: Array, A_j: Array) -> None:
    """W r, W A_i, W A_j of one interval in place, for the lower triangular W of `motion_weights`."""
    for i in range(14, -1, -1):
        total = 0.0
        for k in range(i + 1):
            total += W[i, k] * r[k]
        r[i] = total
        for j in range(15):
            A_i[i, j] *= W[i, i]
            A_j[i, j] *= W[i, i]
        for k in range(i):
            w = W[i, k]
            for j in range(15):
                A_i[i, j] += w * A_i[k, j]
                A_j[i, j] += w * A_j[k, j]


@helper
def motion_covariance(row: Array, S_out: Array) -> None:
    """Covariance of the residual of one interval, shape (15, 15)."""
    if is_cruising(row):
        cruising_covariance(row, S_out)
        return
    if is_coasted(row):
        coasting_covariance(row, S_out)
        return
    for i in range(15):
        for j in range(15):
            S_out[i, j] = row[COVARIANCE + 15 * i + j]


@kernel("void(f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])")
def motion_residuals(
    motions: Array, W: Array, R: Array, p: Array, v: Array, bias: Array, shift: Array, r_out: Array
) -> None:
    """Whitened residuals between n keyframes in a row, without derivatives.

    Parameters
    ----------
    motions, W : ndarray, shapes (n - 1, ROW), (n - 1, 15, 15), the latter of `motion_weights`
    R, p, v, bias : ndarray, shapes (n, 3, 3), (n, 3), (n, 3), (n, 6)
    shift : ndarray, shape (n - 1, 6), bias that errors of the IMU's scale make in each interval, or (0, 6)
    r_out : ndarray, shape (n - 1, 15)
    """
    R_end, p_end, v_end, apart, seen = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty(3)
    r, b_i, b_j, Jr, A = np.empty(15), np.empty(6), np.empty(6), np.empty((3, 3)), np.empty((2, 15, 15))
    for k in range(len(motions)):
        for i in range(6):
            own = shift[k, i] if len(shift) else 0.0
            b_i[i], b_j[i] = bias[k, i] + own, bias[k + 1, i] + own
            r[9 + i] = b_i[i] - b_j[i]
        if is_coasted(motions[k]):
            motion_error(motions[k], R[k], p[k], v[k], b_i, R[k + 1], p[k + 1], v[k + 1], b_j, r, A[0], A[1])
        else:
            predict_motion(motions[k], R[k], p[k], v[k], b_i, R_end, p_end, v_end)
            multiply_transposed(R[k + 1], R_end, apart)
            log_rotation(apart, r[0:3])
            inverse_right_jacobian(r[0:3], Jr)
            for i in range(3):
                p_end[i] -= p[k + 1, i]
                v_end[i] -= v[k + 1, i]
            rotate_back(R[k + 1], p_end, seen)
            rotate_back(Jr, seen, r[3:6])  # Jl^-1 is Jr^-1 transposed
            rotate_back(R[k + 1], v_end, seen)
            rotate_back(Jr, seen, r[6:9])
        for i in range(15):
            total = 0.0
            for j in range(i + 1):
                total += W[k, i, j] * r[j]
            r_out[k, i] = total


@kernel(
    "void(f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1],"
    " f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1])"
)
def motion_errors(
    motions: Array,
    R_i: Array,
    p_i: Array,
    v_i: Array,
    bias_i: Array,
    R_j: Array,
    p_j: Array,
    v_j: Array,
    bias_j: Array,
    r_out: Array,
    A_i_out: Array,
    A_j_out: Array,
) -> None:
    """Residuals of n intervals, shape (n, 15), and their derivatives by the states at both ends, (n, 15, 15).

    For the keyframes of a dive in a row these are ``R[:-1]`` and ``R[1:]`` and so on. The derivative by errors of
    the IMU's scale is that by the bias before, rows 0 to 8, times S.
    """
    for k in range(len(motions)):
        motion_error(
            motions[k],
            R_i[k],
            p_i[k],
            v_i[k],
            bias_i[k],
            R_j[k],
            p_j[k],
            v_j[k],
            bias_j[k],
            r_out[k],
            A_i_out[k],
            A_j_out[k],
        )


@kernel("void(f8[:, ::1], f8[:, :, ::1])")
def motion_weights(motions: Array, W_out: Array) -> None:
    """W, lower triangular, with W' W the information of each residual, shape (n, 15, 15)."""
    S = np.empty((15, 15))
    for k in range(len(motions)):
        motion_covariance(motions[k], S)
        _whitening(S, W_out[k])
