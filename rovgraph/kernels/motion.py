"""The IMU's motion over an interval: prediction and linear transition.

With zeta = (theta, p, v) preintegrated, corrected to first order for the bias b that differs from the assumed one,

    R_j = R_i Exp(theta),  p_j = p_i + t v_i + t^2 / 2 g + R_i p,  v_j = v_i + t g + R_i v

On a turning Earth this holds in the axes that n has at the beginning, for v + S(w) p in place of v; what comes out
is turned back by Exp(-t w), and gravity turns meanwhile. Equal to GTSAM's ``PreintegratedCombinedMeasurements``.

Intervals without samples for longer than `LONGEST_BRIDGED_S` are coasted through (`rovgraph.kernels.coasting`), those
of a dive without an IMU are cruised (`rovgraph.kernels.cruising`).

Motions are rows of `rovgraph.kernels.motion_row`. States are R_nb, p_n, v_n and the bias that is seen: with errors
k of the IMU's scale, b + S k. Derivatives are by rotation, position (in body axes), velocity (in n), bias.
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.coasting import coast, coasting_transition
from rovgraph.kernels.compile import helper, kernel
from rovgraph.kernels.cruising import cruise, cruising_transition
from rovgraph.kernels.motion_row import BIAS, BY_BIAS, COVARIANCE, DURATION, EARTH_RATE, GAP, GRAVITY, NO_IMU, TANGENT
from rovgraph.kernels.rotations import (
    cross,
    exp_rotation,
    multiply,
    right_jacobian,
    rotate,
    skew,
)

LONGEST_BRIDGED_S = 0.75  # intervals in a gap of the IMU that is longer are coasted through


@helper
def is_coasted(row: Array) -> bool:
    """Whether an interval is coasted through."""
    return bool(row[GAP] > LONGEST_BRIDGED_S)


@helper
def is_cruising(row: Array) -> bool:
    """Whether there is no IMU."""
    return bool(row[GAP] == NO_IMU)


@helper
def correct_motion(row: Array, bias: Array, zeta_out: Array) -> None:
    """The motion, corrected for the bias."""
    for i in range(9):
        zeta_out[i] = row[TANGENT + i]
        for j in range(6):
            zeta_out[i] += row[BY_BIAS + 6 * i + j] * (bias[j] - row[BIAS + j])


@helper
def _gravity(row: Array, rate: Array, p_out: Array, v_out: Array) -> None:
    """What gravity adds to position and velocity while n turns at a rate."""
    t, g, once, twice = row[DURATION], np.zeros(3), np.empty(3), np.empty(3)
    g[2] = row[GRAVITY]
    cross(rate, g, once)
    cross(rate, once, twice)
    square = t * t * (rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2])
    if square < 0.01:
        a = 0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0)))
        b = (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))) / 6.0
        c = (1.0 - square / 30.0 * (1.0 - square / 56.0 * (1.0 - square / 90.0))) / 24.0
    else:
        angle = math.sqrt(square)
        a = (1.0 - math.cos(angle)) / square
        b = (angle - math.sin(angle)) / (angle * square)
        c = (0.5 - a) / square
    for i in range(3):
        v_out[i] = t * (g[i] + t * (a * once[i] + t * b * twice[i]))
        p_out[i] = t * t * (0.5 * g[i] + t * (b * once[i] + t * c * twice[i]))


@helper
def _turning(row: Array) -> bool:
    return bool(row[EARTH_RATE] != 0.0 or row[EARTH_RATE + 1] != 0.0 or row[EARTH_RATE + 2] != 0.0)


@helper
def _predict(
    row: Array, zeta: Array, R: Array, p: Array, v: Array, E: Array, R_out: Array, p_out: Array, v_out: Array
) -> None:
    """The state after the motion ``zeta``, and the rotation ``E`` by which the axes of n turned back meanwhile."""
    t, turn, rate, turned = row[DURATION], np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    fast, far, along, gravity = np.empty(3), np.empty(3), np.empty(3), np.empty((2, 3))
    for i in range(3):
        rate[i] = row[EARTH_RATE + i]
    cross(rate, p, fast)
    _gravity(row, rate, gravity[0], gravity[1])
    for i in range(3):
        fast[i] += v[i]
        far[i] = p[i] + t * fast[i] + gravity[0, i] + R[i, 0] * zeta[3] + R[i, 1] * zeta[4] + R[i, 2] * zeta[5]
        fast[i] += gravity[1, i] + R[i, 0] * zeta[6] + R[i, 1] * zeta[7] + R[i, 2] * zeta[8]
        along[i] = -t * rate[i]
    exp_rotation(zeta, turn)
    exp_rotation(along, E)
    multiply(R, turn, turned)
    multiply(E, turned, R_out)
    rotate(E, far, p_out)
    rotate(E, fast, v_out)
    cross(rate, p_out, along)
    for i in range(3):
        v_out[i] -= along[i]


@helper
def predict_with_jacobian(
    row: Array, R: Array, p: Array, v: Array, bias: Array, R_out: Array, p_out: Array, v_out: Array, J_out: Array
) -> None:
    """The state after an interval, and how it depends on that before it.

    ``J_out`` has shape (9, 15): turn of the body, position and velocity in n by rotation, position, velocity, bias.
    """
    zeta, t = np.empty(9), row[DURATION]
    E, ER, turn, Jr = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    correct_motion(row, bias, zeta)
    _predict(row, zeta, R, p, v, E, R_out, p_out, v_out)
    multiply(E, R, ER)
    exp_rotation(zeta, turn)
    right_jacobian(zeta, Jr)
    for i in range(3):
        for j in range(3):
            J_out[i, j], J_out[i, 3 + j], J_out[i, 6 + j] = turn[j, i], 0.0, 0.0
            J_out[3 + i, 3 + j], J_out[6 + i, 3 + j] = ER[i, j], 0.0
            J_out[3 + i, 6 + j], J_out[6 + i, 6 + j] = t * E[i, j], E[i, j]
        for k in (3, 6):  # -E R S(zeta)
            x, y, z = zeta[k], zeta[k + 1], zeta[k + 2]
            J_out[k + i, 0] = ER[i, 2] * y - ER[i, 1] * z
            J_out[k + i, 1] = ER[i, 0] * z - ER[i, 2] * x
            J_out[k + i, 2] = ER[i, 1] * x - ER[i, 0] * y
        for j in range(6):
            at = BY_BIAS + j
            J_out[i, 9 + j] = Jr[i, 0] * row[at] + Jr[i, 1] * row[at + 6] + Jr[i, 2] * row[at + 12]
            at += 18
            J_out[3 + i, 9 + j] = ER[i, 0] * row[at] + ER[i, 1] * row[at + 6] + ER[i, 2] * row[at + 12]
            at += 18
            J_out[6 + i, 9 + j] = ER[i, 0] * row[at] + ER[i, 1] * row[at + 6] + ER[i, 2] * row[at + 12]
    if _turning(row):
        _add_turning(row, E, R, J_out)


@helper
def _add_turning(row: Array, E: Array, R: Array, J: Array) -> None:
    """What a turning Earth adds to the derivatives: v + S(w) p is what goes on."""
    t, rate, spin, spun, turned = row[DURATION], np.empty(3), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for i in range(3):
        rate[i] = row[EARTH_RATE + i]
    skew(rate, spin)
    multiply(spin, R, spun)
    multiply(E, spun, turned)
    for i in range(3):
        for j in range(3):
            J[3 + i, 3 + j] += t * turned[i, j]
            J[6 + i, 3 + j] += turned[i, j]
    for j in range(15):
        for i in range(3):
            J[6 + i, j] -= spin[i, 0] * J[3, j] + spin[i, 1] * J[4, j] + spin[i, 2] * J[5, j]


@helper
def predict_motion(
    row: Array, R: Array, p: Array, v: Array, bias: Array, R_out: Array, p_out: Array, v_out: Array
) -> None:
    """The state at the end of one interval that is not coasted through, without derivatives."""
    zeta, E = np.empty(9), np.empty((3, 3))
    correct_motion(row, bias, zeta)
    _predict(row, zeta, R, p, v, E, R_out, p_out, v_out)


@helper
def predict_with_transition(
    row: Array,
    R: Array,
    p: Array,
    v: Array,
    bias: Array,
    R_out: Array,
    p_out: Array,
    v_out: Array,
    F_out: Array,
    Q_out: Array,
) -> None:
    """The state at the end of one interval; its error's transition and process noise, shape (15, 15).

    The residual's derivatives by both states say A_i e_i + A_j e_j = noise of covariance S. Where the state after
    is the predicted one, A_j is -1 on the diagonal but for velocity, -R_j', so that e_j = F e_i + w with F and
    Q = cov w without an inverse.
    """
    if is_cruising(row):
        cruise(row, R, p, v, R_out, p_out, v_out)
        cruising_transition(row, R, v, F_out, Q_out)
        return
    if is_coasted(row):
        coast(row, R, p, v, R_out, p_out, v_out)
        coasting_transition(row, R, R_out, F_out, Q_out)
        return
    J = np.empty((9, 15))
    predict_with_jacobian(row, R, p, v, bias, R_out, p_out, v_out, J)
    for i in range(15):
        for j in range(15):
            F_out[i, j], Q_out[i, j] = 0.0, row[COVARIANCE + 15 * i + j]
        F_out[i, i] = 1.0
    for j in range(15):
        x, y, z = Q_out[6, j], Q_out[7, j], Q_out[8, j]
        for i in range(3):
            F_out[i, j], F_out[6 + i, j] = J[i, j], J[6 + i, j]
            F_out[3 + i, j] = R_out[0, i] * J[3, j] + R_out[1, i] * J[4, j] + R_out[2, i] * J[5, j]
            Q_out[6 + i, j] = R_out[i, 0] * x + R_out[i, 1] * y + R_out[i, 2] * z
    for j in range(15):
        x, y, z = Q_out[j, 6], Q_out[j, 7], Q_out[j, 8]
        for i in range(3):
            Q_out[j, 6 + i] = R_out[i, 0] * x + R_out[i, 1] * y + R_out[i, 2] * z


@kernel(
    "void(f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], f8[:, ::1],"
    " f8[:, :, ::1], f8[:, :, ::1])"
)
def transitions(
    motions: Array,
    R: Array,
    p: Array,
    v: Array,
    bias: Array,
    R_out: Array,
    p_out: Array,
    v_out: Array,
    F_out: Array,
    Q_out: Array,
) -> None:
    """The states at the ends of n intervals, and how errors get there.

    Parameters
    ----------
    motions : ndarray, shape (n, ROW)
    R, p, v, bias : ndarray, shapes (n, 3, 3), (n, 3), (n, 3), (n, 6), at their beginnings
    R_out, p_out, v_out : the same at their ends
    F_out, Q_out : ndarray, shape (n, 15, 15), transitions and process noise
    """
    for k in range(len(motions)):
        predict_with_transition(motions[k], R[k], p[k], v[k], bias[k], R_out[k], p_out[k], v_out[k], F_out[k], Q_out[k])
