"""The IMU's motion over an interval: prediction and linear transition.

With zeta = (theta, p, v) preintegrated, corrected to first order for the bias b that differs from the assumed one,

    R_j = R_i Exp(theta),  p_j = p_i + t v_i + t^2 / 2 g + R_i p,  v_j = v_i + t g + R_i v

On a turning Earth this holds in the axes that n has at the beginning, for v + S(w) p in place of v; what comes out
is turned back by Exp(-t w), and gravity turns meanwhile. Equal to GTSAM's ``PreintegratedCombinedMeasurements``.

Intervals without samples for longer than `LONGEST_BRIDGED_S` are coasted through (`rovgraph.kernels.coasting`), those
of a dive without an IMU are cruised (`rovgraph.kernels.cruising`).

Motions are rows of `rovgraph.kernels.motion_row`. The bias of a state is that which is seen; of one that comes out
only attitude, position and velocity are written. Derivatives are by rotation, position (in body axes), velocity (in n),
bias.
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.coasting import coast, coasting_transition
from rovgraph.kernels.compile import Matrices, Matrix, helper, kernel, view_helper
from rovgraph.kernels.cruising import cruise, cruising_transition
from rovgraph.kernels.motion_row import BIAS, BY_BIAS, DURATION, EARTH_RATE, GAP, GRAVITY, NO_IMU, TANGENT
from rovgraph.kernels.rotations import (
    cross,
    dot,
    exp_rotation,
    multiply,
    right_jacobian,
    rotate,
    skew,
)
from rovgraph.kernels.states import Epoch, States, epoch

LONGEST_BRIDGED_S = 0.75  # intervals in a gap of the IMU that is longer are coasted through


class MotionScratch(NamedTuple):
    """Arrays to calculate with.

    Attributes
    ----------
    zeta : shape (9,), the motion, corrected for the bias
    turn : shape (3, 3), Exp(theta)
    E, ER : shapes (3, 3), the rotation by which the axes of n turn back meanwhile, and of the body's after it
    vectors, matrices : shapes (5, 3), (4, 3, 3)
    J : shape (9, 15), derivative by the state before, of `predict_with_jacobian`
    """

    zeta: Array
    turn: Array
    E: Array
    ER: Array
    vectors: Array
    matrices: Array
    J: Array


@helper
def make_motion_scratch() -> MotionScratch:
    """Arrays for all motions of a dive; made once."""
    turns = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    return MotionScratch(np.empty(9), *turns, np.empty((5, 3)), np.empty((4, 3, 3)), np.empty((9, 15)))


@view_helper
def is_coasted(row: Array) -> bool:
    """Whether an interval is coasted through."""
    return bool(row[GAP] > LONGEST_BRIDGED_S)


@view_helper
def is_cruising(row: Array) -> bool:
    """Whether there is no IMU."""
    return bool(row[GAP] == NO_IMU)


@view_helper
def correct_motion(row: Array, bias: Array, zeta_out: Array) -> None:
    """The motion, corrected for the bias."""
    for i in range(9):
        zeta_out[i] = row[TANGENT + i]
        for j in range(6):
            zeta_out[i] += row[BY_BIAS + 6 * i + j] * (bias[j] - row[BIAS + j])


@view_helper
def _gravity(row: Array, rate: Array, once: Array, twice: Array, p_out: Array, v_out: Array) -> None:
    """Add to position and velocity what gravity does while n turns at a rate."""
    t, g = row[DURATION], row[GRAVITY]
    once[0], once[1], once[2] = rate[1] * g, -rate[0] * g, 0.0
    cross(rate, once, twice)
    square = t * t * dot(rate, rate)
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
        v_out[i] += t * t * (a * once[i] + t * b * twice[i])
        p_out[i] += t * t * t * (b * once[i] + t * c * twice[i])
    v_out[2] += t * g
    p_out[2] += 0.5 * t * t * g


@view_helper
def _turning(row: Array) -> bool:
    return bool(row[EARTH_RATE] != 0.0 or row[EARTH_RATE + 1] != 0.0 or row[EARTH_RATE + 2] != 0.0)


@view_helper
def _predict(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> None:
    """The state after the motion ``zeta`` of the scratch, whose ``turn`` and ``E`` it makes."""
    R, p, v, R_out, p_out, v_out = state.R, state.p, state.v, out.R, out.p, out.v
    t, zeta, turn, E = row[DURATION], scratch.zeta, scratch.turn, scratch.E
    exp_rotation(zeta, turn)
    for i in range(3):
        p_out[i] = p[i] + t * v[i] + R[i, 0] * zeta[3] + R[i, 1] * zeta[4] + R[i, 2] * zeta[5]
        v_out[i] = v[i] + R[i, 0] * zeta[6] + R[i, 1] * zeta[7] + R[i, 2] * zeta[8]
    if not _turning(row):
        p_out[2] += 0.5 * t * t * row[GRAVITY]
        v_out[2] += t * row[GRAVITY]
        multiply(R, turn, R_out)
        for i in range(3):
            for j in range(3):
                E[i, j] = 1.0 if i == j else 0.0
        return
    vectors = scratch.vectors
    rate, far, fast, along, twice = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    for i in range(3):
        rate[i] = row[EARTH_RATE + i]
    _gravity(row, rate, along, twice, p_out, v_out)
    cross(rate, p, along)
    for i in range(3):
        fast[i] = v_out[i] + along[i]
        far[i] = p_out[i] + t * along[i]
        along[i] = -t * rate[i]
    exp_rotation(along, E)
    multiply(R, turn, scratch.ER)
    multiply(E, scratch.ER, R_out)
    rotate(E, far, p_out)
    rotate(E, fast, v_out)
    cross(rate, p_out, along)
    for i in range(3):
        v_out[i] -= along[i]


@view_helper
def predict_with_jacobian(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> None:
    """The state after an interval, and how it depends on that before it.

    J of the scratch becomes the turn of the body, position and velocity in n by rotation, position, velocity, bias.
    """
    zeta, t, turn, Jr = scratch.zeta, row[DURATION], scratch.turn, scratch.matrices[0]
    E, ER, J_out = scratch.E, scratch.ER, scratch.J
    correct_motion(row, state.b, zeta)
    _predict(row, state, out, scratch)
    multiply(E, state.R, ER)
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
        _add_turning(row, state.R, scratch)


@view_helper
def _add_turning(row: Array, R: Array, scratch: MotionScratch) -> None:
    """What a turning Earth adds to the derivatives: v + S(w) p is what goes on."""
    t, rate, J = row[DURATION], scratch.vectors[0], scratch.J
    spin, spun, turned = scratch.matrices[1], scratch.matrices[2], scratch.matrices[3]
    skew(rate, spin)
    multiply(spin, R, spun)
    multiply(scratch.E, spun, turned)
    for i in range(3):
        for j in range(3):
            J[3 + i, 3 + j] += t * turned[i, j]
            J[6 + i, 3 + j] += turned[i, j]
    for j in range(15):
        for i in range(3):
            J[6 + i, j] -= spin[i, 0] * J[3, j] + spin[i, 1] * J[4, j] + spin[i, 2] * J[5, j]


@view_helper
def predict_motion(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> None:
    """The state at the end of one interval that is not coasted through, without derivatives."""
    correct_motion(row, state.b, scratch.zeta)
    _predict(row, state, out, scratch)


@helper
def predict_with_transition(
    row: Array, covariance: Array, state: Epoch, out: Epoch, F_out: Array, Q_out: Array
) -> None:
    """The state at the end of one interval; its error's transition and process noise, shape (15, 15).

    The residual's derivatives by both states say A_i e_i + A_j e_j = noise of covariance S. Where the state after
    is the predicted one, A_j is -1 on the diagonal but for velocity, -R_j', so that e_j = F e_i + w with F and
    Q = cov w without an inverse.
    """
    if is_cruising(row):
        cruise(row, state, out)
        cruising_transition(row, state.R, state.v, F_out, Q_out)
        return
    if is_coasted(row):
        coast(row, state, out)
        coasting_transition(row, state.R, out.R, F_out, Q_out)
        return
    scratch = make_motion_scratch()
    J, R_out = scratch.J, out.R
    predict_with_jacobian(row, state, out, scratch)
    for i in range(15):
        for j in range(15):
            F_out[i, j], Q_out[i, j] = 0.0, covariance[i, j]
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


@kernel()
def transitions(
    motions: Matrix, covariances: Matrices, states: States, out: States, F_out: Matrices, Q_out: Matrices
) -> None:
    """The states at the ends of n intervals, and how errors get there.

    Parameters
    ----------
    motions, covariances : ndarray, shapes (n, ROW), (n, 15, 15)
    states, out : at their beginnings, and at their ends
    F_out, Q_out : ndarray, shape (n, 15, 15), transitions and process noise
    """
    for k in range(len(motions)):
        state, there = epoch(states, k), epoch(out, k)
        predict_with_transition(motions[k], covariances[k], state, there, F_out[k], Q_out[k])
