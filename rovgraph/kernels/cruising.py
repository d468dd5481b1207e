"""Motion without an IMU: one interval, written for the callers in `rovgraph.kernels.motion`.

The vehicle goes on as it went along its own axes: nearly constant velocity, white noise acceleration (Bar-Shalom et al.
2001, 6.2.2), of the velocity u = R_bn v_n in the body's axes, which a turn takes with it,

    u_j = u_i + w,              var w = t q^2
    p_j = p_i + t (v_i + v_j) / 2 + w,  var w = t^3 q^2 / 12        what is left once both velocities are known

Roll, pitch and yaw go on as in `rovgraph.kernels.coasting`. In a long silence, in which the way that it faces is lost,
the vehicle coasts instead.
"""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.coasting import angle_error, angle_transition, coast, coasting_covariance
from rovgraph.kernels.compile import helper
from rovgraph.kernels.motion_row import DURATION, NOISE
from rovgraph.kernels.rotations import multiply, multiply_transposed, rotate, rotate_back, skew


@helper
def cruise(row: Array, R: Array, p: Array, v: Array, R_out: Array, p_out: Array, v_out: Array) -> None:
    """The state at the end of an interval."""
    u = np.empty(3)
    coast(row, R, p, v, R_out, p_out, v_out)
    rotate_back(R, v, u)
    rotate(R_out, u, v_out)
    for i in range(3):
        p_out[i] = p[i] + 0.5 * row[DURATION] * (v[i] + v_out[i])


@helper
def cruising_covariance(row: Array, S_out: Array) -> None:
    """Covariance of the residual, shape (15, 15)."""
    coasting_covariance(row, S_out)
    t, acc, integration = row[DURATION], row[NOISE], row[NOISE + 4]
    for i in range(3):
        S_out[3 + i, 3 + i] = acc * acc * t * t * t / 12.0 + integration * integration * t
        S_out[3 + i, 6 + i] = S_out[6 + i, 3 + i] = 0.0


@helper
def cruising_error(
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
    """Residual: roll, pitch, yaw, position in n, velocity in the body's axes, bias; its derivatives by both states."""
    half, u, S = 0.5 * row[DURATION], np.empty((2, 3)), np.empty((2, 3, 3))
    angle_error(row, R_i, R_j, r_out, A_i_out, A_j_out)
    rotate_back(R_i, v_i, u[0])
    rotate_back(R_j, v_j, u[1])
    skew(u[0], S[0])
    skew(u[1], S[1])
    for i in range(3):
        r_out[3 + i] = p_j[i] - p_i[i] - half * (v_i[i] + v_j[i])
        r_out[6 + i] = u[1, i] - u[0, i]
        A_i_out[3 + i, 6 + i] = A_j_out[3 + i, 6 + i] = -half
        for j in range(3):
            A_i_out[3 + i, 3 + j], A_j_out[3 + i, 3 + j] = -R_i[i, j], R_j[i, j]
            A_i_out[6 + i, j], A_j_out[6 + i, j] = -S[0, i, j], S[1, i, j]
            A_i_out[6 + i, 6 + j], A_j_out[6 + i, 6 + j] = -R_i[j, i], R_j[j, i]
    for i in range(6):
        r_out[9 + i] = bias_j[i] - bias_i[i]


@helper
def cruising_transition(row: Array, R_i: Array, v_i: Array, R_j: Array, F_out: Array, Q_out: Array) -> None:
    """Linear transition and its noise, shape (15, 15), where ``R_j`` was predicted from ``R_i``.

    The residual is zero where the errors e are those of noise w: in the body's axes the velocity's error is
    R' e_v + u x e_R, which goes over as it is; that of position follows the mean of both velocities.
    """
    t, u, turned, S, M = row[DURATION], np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    by_turn, back = np.empty((3, 3)), np.empty((3, 3))
    cruising_covariance(row, Q_out)
    of_position, of_velocity, G = Q_out[3, 3], Q_out[6, 6], np.zeros((9, 9))
    angle_transition(row, R_i, R_j, F_out, Q_out)
    rotate_back(R_i, v_i, u)
    skew(u, S)
    multiply(R_j, S, by_turn)  # of the velocity in n by a turn of the body, with the other sign
    multiply_transposed(R_j, R_i, back)
    for i in range(3):
        for j in range(3):
            M[i, j] = R_j[i, 0] * R_i[j, 0] + R_j[i, 1] * R_i[j, 1] + R_j[i, 2] * R_i[j, 2]
            turned[i, j] = by_turn[i, j]
            for k in range(3):
                turned[i, j] -= by_turn[i, k] * F_out[k, j]
    for i in range(3):
        for j in range(3):
            F_out[6 + i, j], F_out[6 + i, 6 + j] = turned[i, j], M[i, j]
            F_out[3 + i, 3 + j] = back[i, j]
            G[i, j], G[6 + i, j], G[6 + i, 6 + j] = (1.0 if i == j else 0.0), -by_turn[i, j], R_j[i, j]
            G[3 + i, 3 + j] = R_j[j, i]
    for i in range(3):
        for j in range(3):
            F_out[3 + i, j] = F_out[3 + i, 6 + j] = 0.0
            for k in range(3):
                F_out[3 + i, j] += 0.5 * t * R_j[k, i] * turned[k, j]
                F_out[3 + i, 6 + j] += 0.5 * t * R_j[k, i] * ((1.0 if k == j else 0.0) + M[k, j])
                G[3 + i, j] += 0.5 * t * R_j[k, i] * G[6 + k, j]
                G[3 + i, 6 + j] += 0.5 * t * R_j[k, i] * G[6 + k, 6 + j]
    _add_noise(G, of_position, of_velocity, Q_out)


@helper
def _add_noise(G: Array, of_position: float, of_velocity: float, Q: Array) -> None:
    """Of pose and velocity, G w with cov w the rotation's in ``Q``, and variances of position and velocity."""
    W, GW = np.zeros((9, 9)), np.zeros((9, 9))
    for i in range(3):
        W[3 + i, 3 + i], W[6 + i, 6 + i] = of_position, of_velocity
        for j in range(3):
            W[i, j] = Q[i, j]
    for i in range(9):
        for j in range(9):
            for k in range(9):
                GW[i, j] += G[i, k] * W[k, j]
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += GW[i, k] * G[j, k]
            Q[i, j] = total
