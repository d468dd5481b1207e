"""Motion without an IMU: one interval, written for the callers in `rovgraph.kernels.motion`.

The vehicle goes on as it went along its own axes: nearly constant velocity, white noise acceleration (Bar-Shalom et al.
2001, 6.2.2), of the velocity u = R_bn v_n in the body's axes, which a turn takes with it; its attitude walks.

    R_j = R_i Exp(w),  var w = t d^2
    u_j = u_i + w,     var w = t q^2
    p_j = p_i + t (v_i + v_j) / 2 + w,  var w = t^3 q^2 / 12        what is left once both velocities are known

with q and d the noise densities of acceleration and rate of turn.
"""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper
from rovgraph.kernels.motion_row import AFTER, DURATION, NOISE, RESIDUAL
from rovgraph.kernels.rotations import (
    inverse_right_jacobian,
    log_rotation,
    multiply,
    multiply_transposed,
    rotate_back,
    skew,
)
from rovgraph.kernels.states import Epoch


@helper
def cruise(row: Array, state: Epoch, out: Epoch) -> None:
    """Attitude, position and velocity at the end of an interval."""
    for i in range(3):
        out.p[i], out.v[i] = state.p[i] + row[DURATION] * state.v[i], state.v[i]
        for j in range(3):
            out.R[i, j] = state.R[i, j]


@helper
def cruising_covariance(row: Array, S_out: Array) -> None:
    """Covariance of the residual, shape (15, 15)."""
    for i in range(15):
        for j in range(15):
            S_out[i, j] = 0.0
    t, acc, gyr, integration = row[DURATION], row[NOISE], row[NOISE + 1], row[NOISE + 4]
    for i in range(3):
        S_out[i, i] = gyr * gyr * t
        S_out[3 + i, 3 + i] = acc * acc * t * t * t / 12.0 + integration * integration * t
        S_out[6 + i, 6 + i] = acc * acc * t
        S_out[9 + i, 9 + i] = row[NOISE + 2] * row[NOISE + 2] * t
        S_out[12 + i, 12 + i] = row[NOISE + 3] * row[NOISE + 3] * t


@helper
def cruising_error(row: Array, before: Epoch, after: Epoch, A_out: Array) -> None:
    """Residual: rotation, position in n, velocity in the body's axes, bias; its derivatives by both states.

    ``A_out`` was zero.
    """
    half, u, S, turn, Jr, phi = (
        0.5 * row[DURATION],
        np.empty((2, 3)),
        np.empty((2, 3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
    )
    R_i, p_i, v_i, bias_i = before.R, before.p, before.v, before.b
    R_j, p_j, v_j, bias_j = after.R, after.p, after.v, after.b
    multiply_transposed(R_i, R_j, turn)
    log_rotation(turn, phi)
    inverse_right_jacobian(phi, Jr)
    rotate_back(R_i, v_i, u[0])
    rotate_back(R_j, v_j, u[1])
    skew(u[0], S[0])
    skew(u[1], S[1])
    for i in range(15):
        A_out[i, i], A_out[i, AFTER + i] = -1.0, 1.0
    for i in range(3):
        A_out[i, RESIDUAL] = phi[i]
        A_out[3 + i, RESIDUAL] = p_j[i] - p_i[i] - half * (v_i[i] + v_j[i])
        A_out[6 + i, RESIDUAL] = u[1, i] - u[0, i]
        A_out[3 + i, 6 + i] = A_out[3 + i, AFTER + 6 + i] = -half
        for j in range(3):
            A_out[i, j], A_out[i, AFTER + j] = -Jr[j, i], Jr[i, j]  # Jl^-1 is Jr^-1 transposed
            A_out[3 + i, 3 + j], A_out[3 + i, AFTER + 3 + j] = -R_i[i, j], R_j[i, j]
            A_out[6 + i, j], A_out[6 + i, AFTER + j] = -S[0, i, j], S[1, i, j]
            A_out[6 + i, 6 + j], A_out[6 + i, AFTER + 6 + j] = -R_i[j, i], R_j[j, i]
    for i in range(6):
        A_out[9 + i, RESIDUAL] = bias_j[i] - bias_i[i]


@helper
def cruising_transition(row: Array, R: Array, v: Array, F_out: Array, Q_out: Array) -> None:
    """Linear transition and its noise, shape (15, 15), from a state to the predicted one, which has its attitude.

    With the noise (w, x, y) of rotation, position and velocity u, velocity errs by R (y - u x w) more, and position in
    the body's axes by x and half the time of that.
    """
    half, u, U, RU = 0.5 * row[DURATION], np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    cruising_covariance(row, Q_out)
    turns, drifts, speeds = Q_out[0, 0], Q_out[3, 3], Q_out[6, 6]
    rotate_back(R, v, u)
    skew(u, U)
    multiply(R, U, RU)
    for i in range(15):
        for j in range(15):
            F_out[i, j] = 0.0
        F_out[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            F_out[3 + i, 6 + j] = 2.0 * half * R[j, i]
            across = 0.0  # of u x w, in the body's axes and in n
            across_n = 0.0
            mixed = 0.0
            for k in range(3):
                across += turns * U[i, k] * U[j, k]
                across_n += turns * RU[i, k] * RU[j, k]
                mixed += turns * U[i, k] * RU[j, k]
            one = 1.0 if i == j else 0.0
            Q_out[3 + i, 3 + j] = drifts * one + half * half * (speeds * one + across)
            Q_out[6 + i, 6 + j] = speeds * one + across_n
            Q_out[3 + i, 6 + j] = Q_out[6 + j, 3 + i] = half * (speeds * R[j, i] + mixed)
            Q_out[j, 3 + i] = Q_out[3 + i, j] = -half * turns * U[i, j]
            Q_out[j, 6 + i] = Q_out[6 + i, j] = -turns * RU[i, j]
