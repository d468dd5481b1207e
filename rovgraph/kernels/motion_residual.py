"""Residual of the states at both ends of an interval against the motion between them, with its derivatives.

The residual is that of ``gtsam.CombinedImuFactor``: the logarithm on SE_2(3) of what `rovgraph.kernels.motion`
predicts, (R, p, v), seen from the keyframe after, and the change of bias:

    phi = Log(R_j' R),  r = (phi, Jl(phi)^-1 R_j' (p - p_j), Jl(phi)^-1 R_j' (v - v_j), b_i - b_j)

In an IMU outage and without an IMU it is the difference from the prediction of `rovgraph.kernels.motion` for that case.
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Matrices, Matrix, helper, kernel, view_helper
from rovgraph.kernels.layout import ACC_BIAS
from rovgraph.kernels.motion import (
    MotionScratch,
    coasting_covariance,
    coasting_error,
    cruising_covariance,
    cruising_error,
    is_coasted,
    is_cruising,
    make_motion_scratch,
    predict_motion,
    predict_with_jacobian,
)
from rovgraph.kernels.motion_row import AFTER, RESIDUAL, WIDTH
from rovgraph.kernels.rotations import (
    inverse_jacobian_with_slope,
    inverse_right_jacobian,
    log_rotation,
    multiply_transposed,
    rotate_back,
)
from rovgraph.kernels.states import Epoch, States, epoch, with_bias

BIASES = ACC_BIAS  # components of a residual from there on are changes of bias


class ResidualScratch(NamedTuple):
    """Arrays to calculate with.

    Attributes
    ----------
    motion : of `rovgraph.kernels.motion`
    there : the predicted state; its position and velocity become how far those after are from them
    apart, phi, Jr : shapes (3, 3), (3,), (3, 3), the rotation between them, its logarithm and Jr(phi)^-1
    seen, Jl, slope, back : shapes (3,), (3, 3), (3, 3), (3, 3), of one of the linear errors
    """

    motion: MotionScratch
    there: Epoch
    apart: Array
    phi: Array
    Jr: Array
    seen: Array
    Jl: Array
    slope: Array
    back: Array


@helper
def make_residual_scratch() -> ResidualScratch:
    """Arrays for all motions of a dive; made once."""
    there = Epoch(np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(6), np.empty(0))
    between = np.empty((3, 3)), np.empty(3), np.empty((3, 3)), np.empty(3)
    return ResidualScratch(make_motion_scratch(), there, *between, np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)))


@helper
def motion_error(row: Array, before: Epoch, after: Epoch, A_out: Array, scratch: ResidualScratch) -> None:
    """Residual of one interval and its derivatives by both states, shape (15, WIDTH)."""
    for i in range(15):
        for j in range(WIDTH):
            A_out[i, j] = 0.0
    if is_cruising(row):
        cruising_error(row, before, after, A_out)
    elif is_coasted(row):
        coasting_error(row, before, after, A_out)
    else:
        _inertial_error(row, before, after, A_out, scratch)


@view_helper
def _inertial_error(row: Array, before: Epoch, after: Epoch, A_out: Array, scratch: ResidualScratch) -> None:
    """`motion_error` of an interval with samples; ``A_out`` was zero."""
    there, apart, phi, Jr, R_j = scratch.there, scratch.apart, scratch.phi, scratch.Jr, after.R
    predict_with_jacobian(row, before, there, scratch.motion)
    multiply_transposed(R_j, there.R, apart)
    log_rotation(apart, phi)
    inverse_right_jacobian(phi, Jr)
    J = scratch.motion.J
    for i in range(6):
        A_out[9 + i, RESIDUAL] = before.b[i] - after.b[i]
        A_out[9 + i, 9 + i], A_out[9 + i, AFTER + 9 + i] = 1.0, -1.0
    for i in range(3):
        A_out[i, RESIDUAL] = phi[i]
        there.p[i] -= after.p[i]
        there.v[i] -= after.v[i]
        for j in range(15):
            A_out[i, j] = Jr[i, 0] * J[0, j] + Jr[i, 1] * J[1, j] + Jr[i, 2] * J[2, j]
        for j in range(3):
            A_out[i, AFTER + j] = -Jr[j, i]  # Jl^-1 is Jr^-1 transposed
    _linear_error(3, there.p, R_j, A_out, scratch)
    _linear_error(6, there.v, R_j, A_out, scratch)
    for i in range(3):  # position is perturbed in body axes
        x, y, z = A_out[3 + i, AFTER + 3], A_out[3 + i, AFTER + 4], A_out[3 + i, AFTER + 5]
        for j in range(3):
            A_out[3 + i, AFTER + 3 + j] = x * R_j[0, j] + y * R_j[1, j] + z * R_j[2, j]


@view_helper
def _linear_error(at: int, away: Array, R_j: Array, A: Array, scratch: ResidualScratch) -> None:
    """Rows ``at`` to ``at + 2``: Jl(phi)^-1 R_j' away, where the derivatives of phi are in the first three."""
    seen, Jl, slope, back, J = scratch.seen, scratch.Jl, scratch.slope, scratch.back, scratch.motion.J
    rotate_back(R_j, away, seen)
    inverse_jacobian_with_slope(scratch.phi, seen, -0.5, Jl, slope)
    x, y, z = seen[0], seen[1], seen[2]
    for i in range(3):
        row = A[at + i]
        row[RESIDUAL] = Jl[i, 0] * x + Jl[i, 1] * y + Jl[i, 2] * z
        row[AFTER] = Jl[i, 1] * z - Jl[i, 2] * y
        row[AFTER + 1] = Jl[i, 2] * x - Jl[i, 0] * z
        row[AFTER + 2] = Jl[i, 0] * y - Jl[i, 1] * x
        for j in range(3):
            back[i, j] = Jl[i, 0] * R_j[j, 0] + Jl[i, 1] * R_j[j, 1] + Jl[i, 2] * R_j[j, 2]
            row[AFTER + at + j] = -back[i, j]
            after = AFTER + j
            row[after] += slope[i, 0] * A[0, after] + slope[i, 1] * A[1, after] + slope[i, 2] * A[2, after]
        for j in range(15):
            row[j] = back[i, 0] * J[at, j] + back[i, 1] * J[at + 1, j] + back[i, 2] * J[at + 2, j]
            row[j] += slope[i, 0] * A[0, j] + slope[i, 1] * A[1, j] + slope[i, 2] * A[2, j]


@view_helper
def _whitening(S: Array, ordered: Array, W_out: Array) -> None:
    """The inverse of the Cholesky factor of S, biases first; S and ``ordered``, shape (15, 15), are lost."""
    for i in range(15):
        for j in range(15):
            ordered[i, j] = S[(i + BIASES) % 15, (j + BIASES) % 15]
    for j in range(15):
        for i in range(j, 15):
            total = ordered[i, j]
            for k in range(j):
                total -= ordered[i, k] * ordered[j, k]
            ordered[i, j] = total / math.sqrt(ordered[j, j]) if i > j else total
        ordered[j, j] = math.sqrt(ordered[j, j])
    for j in range(15):
        for i in range(15):
            S[i, j] = 0.0
        S[j, j] = 1.0 / ordered[j, j]
        for i in range(j + 1, 15):
            total = 0.0
            for k in range(j, i):
                total -= ordered[i, k] * S[k, j]
            S[i, j] = total / ordered[i, i]
    for i in range(15):
        for j in range(15):
            W_out[(i + BIASES) % 15, (j + BIASES) % 15] = S[i, j]


@view_helper
def whiten_motion(W: Array, A: Array, A_out: Array) -> None:
    """W A of one interval, for W of `motion_weights` and A of `motion_error`.

    Rows of biases have their own two columns and the residual in A, and nothing before the biases in W.
    """
    for i in range(BIASES):
        x, y, z = W[i, 0], W[i, 1], W[i, 2]
        for j in range(WIDTH):
            A_out[i, j] = x * A[0, j] + y * A[1, j] + z * A[2, j]
        for k in range(1, i // 3 + 1):  # three at a time: a row that is added to is written less often
            x, y, z = W[i, 3 * k], W[i, 3 * k + 1], W[i, 3 * k + 2]
            for j in range(WIDTH):
                A_out[i, j] += x * A[3 * k, j] + y * A[3 * k + 1, j] + z * A[3 * k + 2, j]
    for i in range(BIASES, 15):
        for j in range(WIDTH):
            A_out[i, j] = 0.0
    for i in range(15):
        for m in range(BIASES, 15 if i < BIASES else i + 1):
            A_out[i, m] += W[i, m] * A[m, m]
            A_out[i, RESIDUAL] += W[i, m] * A[m, RESIDUAL]
            A_out[i, AFTER + m] += W[i, m] * A[m, AFTER + m]


@helper
def motion_covariance(row: Array, covariance: Array, S_out: Array) -> None:
    """Covariance of the residual of one interval, shape (15, 15); ``covariance`` is that of its samples."""
    if is_cruising(row):
        cruising_covariance(row, S_out)
        return
    if is_coasted(row):
        coasting_covariance(row, S_out)
        return
    for i in range(15):
        for j in range(15):
            S_out[i, j] = covariance[i, j]


@kernel()
def motion_residuals(motions: Matrix, W: Matrices, states: States, shift: Matrix, r_out: Matrix) -> None:
    """Whitened residuals between n keyframes in a row, without derivatives.

    Parameters
    ----------
    motions, W : ndarray, shapes (n - 1, ROW), (n - 1, 15, 15), the latter of `motion_weights`
    states : of the keyframes
    shift : ndarray, shape (n - 1, 6), bias that errors of the IMU's scale make in each interval, or (0, 6)
    r_out : ndarray, shape (n - 1, 15)
    """
    r, b_i, b_j, A = np.empty(15), np.empty(6), np.empty(6), np.empty((15, WIDTH))
    scratch = make_residual_scratch()
    there, apart, seen, Jr = scratch.there, scratch.apart, scratch.seen, scratch.Jr
    for k in range(len(motions)):
        before, after = epoch(states, k), epoch(states, k + 1)
        for i in range(6):
            by_scale = shift[k, i] if len(shift) else 0.0
            b_i[i], b_j[i] = before.b[i] + by_scale, after.b[i] + by_scale
            r[9 + i] = b_i[i] - b_j[i]
        before, after = with_bias(before, b_i), with_bias(after, b_j)
        if is_coasted(motions[k]):
            motion_error(motions[k], before, after, A, scratch)
            for i in range(15):
                r[i] = A[i, RESIDUAL]
        else:
            predict_motion(motions[k], before, there, scratch.motion)
            multiply_transposed(after.R, there.R, apart)
            log_rotation(apart, r[0:3])
            inverse_right_jacobian(r[0:3], Jr)
            for i in range(3):
                there.p[i] -= after.p[i]
                there.v[i] -= after.v[i]
            rotate_back(after.R, there.p, seen)
            rotate_back(Jr, seen, r[3:6])  # Jl^-1 is Jr^-1 transposed
            rotate_back(after.R, there.v, seen)
            rotate_back(Jr, seen, r[6:9])
        for i in range(15):
            total = 0.0
            for j in range(15):
                total += W[k, i, j] * r[j]
            r_out[k, i] = total


@kernel()
def motion_errors(
    motions: Matrix, before: States, after: States, r_out: Matrix, A_i_out: Matrices, A_j_out: Matrices
) -> None:
    """Residuals of n intervals, shape (n, 15), and their derivatives by the states at both ends, (n, 15, 15).

    For the keyframes of a dive in a row these have ``R[:-1]`` and ``R[1:]`` and so on. The derivative by errors of
    the IMU's scale is that by the bias before, rows 0 to 8, times S.
    """
    scratch, A = make_residual_scratch(), np.empty((15, WIDTH))
    for k in range(len(motions)):
        motion_error(motions[k], epoch(before, k), epoch(after, k), A, scratch)
        for i in range(15):
            r_out[k, i] = A[i, RESIDUAL]
            for j in range(15):
                A_i_out[k, i, j], A_j_out[k, i, j] = A[i, j], A[i, AFTER + j]


@helper
def motion_weight(motion: Array, covariance: Array, W_out: Array) -> None:
    """`motion_weights` of one interval, shape (15, 15)."""
    S = np.empty((15, 15))
    motion_covariance(motion, covariance, S)
    _whitening(S, np.empty((15, 15)), W_out)


@kernel()
def motion_weights(motions: Matrix, covariances: Matrices, W_out: Matrices) -> None:
    """W, with W' W the information of each residual, shape (n, 15, 15), as ``covariances``.

    It whitens biases first, then rotation, position and velocity, so that the rows of biases are those of their walks.
    """
    for k in range(len(motions)):
        motion_weight(motions[k], covariances[k], W_out[k])
