"""The state between a keyframe and a measurement's own time, with its derivative.

    R(t) = R_i dR'                          dR' = dR Exp(-dt b_g')
    v(t) = v_i + g dt + R_i dv'             dv' = dv - dt b_a'
    p(t) = p_i + v_i dt + g dt^2 / 2 + R_i dp'    dp' = dp - dt^2 / 2 b_a'

dR, dv, dp is the IMU's preintegrated motion over dt, b' the bias beyond the one that it assumed (Forster et al.
2017, IMU preintegration on manifold, first order in the bias over a fraction of a second). With the error in the
order of `rovgraph.kernels.layout`, the derivative F of the state at t by that at the keyframe is

    rotation      dR''                      by rotation,  -dt Jr(-dt b_g')  by gyro
    translation   -dR'' S(dp')              by rotation,  dR'' by translation,  dt dR'' R_i' by velocity,
                  -dt^2 / 2 dR''            by accelerometer, dR'' the transpose of dR'
    velocity      -R_i S(dv')               by rotation,  I by velocity,  -dt R_i by accelerometer

and the biases stay.
"""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import given, kernel, view_helper
from rovgraph.kernels.layout import ACC_BIAS, GYR_BIAS, MOTION, TRANSLATION, VELOCITY
from rovgraph.kernels.rotations import cross, exp_rotation, multiply, right_jacobian, rotate

WORK = 4  # matrices (3, 3) that `propagate` needs to calculate with, and leaves to `propagation_jacobian`


@view_helper
def propagate(
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    dt: float,
    dR: Array,
    dv: Array,
    dp: Array,
    assumed: Array,
    gravity: float,
    R_out: Array,
    p_out: Array,
    v_out: Array,
    work: Array,
) -> None:
    """The state ``dt`` after a keyframe; the motion was integrated with the bias ``assumed``, shape (6,)."""
    turned, corrected_v, corrected_p, turn, correction = work[0], work[1, 0], work[1, 1], work[1, 2], work[2]
    for i in range(3):
        acceleration = b[i] - assumed[i]
        corrected_v[i] = dv[i] - dt * acceleration
        corrected_p[i] = dp[i] - 0.5 * dt * dt * acceleration
        turn[i] = -dt * (b[3 + i] - assumed[3 + i])
    exp_rotation(turn, correction)
    multiply(dR, correction, turned)
    multiply(R, turned, R_out)
    rotate(R, corrected_v, v_out)
    rotate(R, corrected_p, p_out)
    for i in range(3):
        p_out[i] += p[i] + dt * v[i]
        v_out[i] += v[i]
    p_out[2] += 0.5 * gravity * dt * dt
    v_out[2] += gravity * dt


@view_helper
def propagation_jacobian(R: Array, dt: float, F_out: Array, work: Array) -> None:
    """F of the motion that `propagate` took last; ``F_out``, shape (15, 15), was zero or an F before."""
    turned, corrected_v, corrected_p, turn, Jr = work[0], work[1, 0], work[1, 1], work[1, 2], work[2]
    column = work[3, 0]
    right_jacobian(turn, Jr)
    for i in range(VELOCITY, MOTION):
        F_out[i, i] = 1.0
    for i in range(3):
        for k in range(3):
            back = turned[k, i]  # dR' is turned back
            F_out[i, k] = F_out[TRANSLATION + i, TRANSLATION + k] = back
            F_out[i, GYR_BIAS + k] = -dt * Jr[i, k]
            F_out[TRANSLATION + i, ACC_BIAS + k] = -0.5 * dt * dt * back
            F_out[VELOCITY + i, ACC_BIAS + k] = -dt * R[i, k]
            # row i of dR'' R_i' is column i of R_i dR'
            F_out[TRANSLATION + i, VELOCITY + k] = dt * (
                R[k, 0] * turned[0, i] + R[k, 1] * turned[1, i] + R[k, 2] * turned[2, i]
            )
            column[k] = back
        cross(corrected_p, column, F_out[TRANSLATION + i, 0:3])  # a row a of -A S(u) is u x a
        cross(corrected_v, R[i], F_out[VELOCITY + i, 0:3])


@view_helper
def chain(H: Array, F: Array) -> None:
    """H[:, :15] <- H[:, :15] F of a measurement, H of shape (dim, 15 or more)."""
    for row in range(len(H)):
        h = H[row]
        a0, a1, a2 = h[0], h[1], h[2]
        t0, t1, t2 = h[3], h[4], h[5]
        v0, v1, v2 = h[6], h[7], h[8]
        for k in range(3):
            by_turn = a0 * F[0, k] + a1 * F[1, k] + a2 * F[2, k] + t0 * F[3, k] + t1 * F[4, k] + t2 * F[5, k]
            h[k] = by_turn + v0 * F[6, k] + v1 * F[7, k] + v2 * F[8, k]
            h[3 + k] = t0 * F[3, 3 + k] + t1 * F[4, 3 + k] + t2 * F[5, 3 + k]
            h[6 + k] += t0 * F[3, 6 + k] + t1 * F[4, 6 + k] + t2 * F[5, 6 + k]
            h[9 + k] += t0 * F[3, 9 + k] + t1 * F[4, 9 + k] + t2 * F[5, 9 + k]
            h[9 + k] += v0 * F[6, 9 + k] + v1 * F[7, 9 + k] + v2 * F[8, 9 + k]
            h[12 + k] += a0 * F[0, 12 + k] + a1 * F[1, 12 + k] + a2 * F[2, 12 + k]


@view_helper
def _propagate_rows(
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    dt: Array,
    dR: Array,
    dv: Array,
    dp: Array,
    assumed: Array,
    gravity: float,
    R_out: Array,
    p_out: Array,
    v_out: Array,
    F_out: Array,
    turns: Array,
    own: Array,
    work: Array,
) -> None:
    """The loop of `propagate_many`, with its own copies, shapes (2, 3, 3) and (6, 6), of what may be strided."""
    own_p, own_v, own_dv, own_dp, own_b, own_assumed = own[0], own[1], own[2], own[3], own[4], own[5]
    own_R, own_dR = turns[0], turns[1]
    for k in range(len(dt)):
        for i in range(3):
            own_p[i], own_v[i], own_dv[i], own_dp[i] = p[k, i], v[k, i], dv[k, i], dp[k, i]
            own_b[i], own_b[3 + i] = b[k, i], b[k, 3 + i]
            own_assumed[i], own_assumed[3 + i] = assumed[k, i], assumed[k, 3 + i]
            for j in range(3):
                own_R[i, j], own_dR[i, j] = R[k, i, j], dR[k, i, j]
        start = own_R, own_p, own_v, own_b
        motion = dt[k], own_dR, own_dv, own_dp, own_assumed
        propagate(*start, *motion, gravity, R_out[k], p_out[k], v_out[k], work)
        if len(F_out):
            propagation_jacobian(own_R, dt[k], F_out[k], work)


@kernel(
    f"void({given(3)}, {given(2)}, {given(2)}, {given(2)}, {given(1)}, {given(3)}, {given(2)}, {given(2)}, {given(2)}, "
    "f8, f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1])"
)
def propagate_many(
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    dt: Array,
    dR: Array,
    dv: Array,
    dp: Array,
    assumed: Array,
    gravity: float,
    R_out: Array,
    p_out: Array,
    v_out: Array,
    F_out: Array,
) -> None:
    """`propagate` and `propagation_jacobian` of n epochs, all with the epochs in front.

    ``F_out``, shape (n, 15, 15), must be zero; of shape (0, 15, 15) it is left out.
    """
    state, motion, out = (R, p, v, b), (dt, dR, dv, dp, assumed), (R_out, p_out, v_out, F_out)
    turns, own, work = np.empty((2, 3, 3)), np.empty((6, 6)), np.empty((WORK, 3, 3))
    _propagate_rows(*state, *motion, gravity, *out, turns, own, work)
