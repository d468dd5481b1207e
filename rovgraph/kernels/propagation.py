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

from typing import NamedTuple

from rovgraph.geometry import Array
from rovgraph.kernels.compile import view_helper
from rovgraph.kernels.layout import ACC_BIAS, GYR_BIAS, MOTION, TRANSLATION, VELOCITY
from rovgraph.kernels.rotations import cross, exp_rotation, multiply, right_jacobian, rotate
from rovgraph.kernels.states import Epoch

WORK = 4  # matrices (3, 3) that `propagate` needs to calculate with, and leaves to `propagation_jacobian`


class Snapshot(NamedTuple):
    """The IMU's motion from a keyframe to a time ``dt`` after it, and the bias that it assumed, shape (6,)."""

    dt: float
    dR: Array
    dv: Array
    dp: Array
    assumed: Array


@view_helper
def propagate(state: Epoch, motion: Snapshot, gravity: float, out: Epoch, work: Array) -> None:
    """The state after a motion from a keyframe; attitude, position and velocity are written."""
    R, p, v, b, R_out, p_out, v_out = state.R, state.p, state.v, state.b, out.R, out.p, out.v
    dt, dR, dv, dp, assumed = motion.dt, motion.dR, motion.dv, motion.dp, motion.assumed
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
