"""One measurement against the state at its keyframe: whitened innovation and Jacobian, for smoother and filter alike.

    r = W (z - h(x(t), c)),  H = W dh/d(x, c)      x(t): the keyframe's state, propagated to the measurement's time

with the bias b + S k where the IMU's scale may be off by k (`rovgraph.problem.motion`).

The state x(t) at a measurement's own time is

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

Late stamps. An instrument whose stamps are late by tau measured at stamp - tau. A derivative by time suffices for an
offset that is small against the motion; half a second is not. So the motion from the keyframe is kept at knots around
the stamp, as far as the prior of tau reaches, and interpolated: rotation along its geodesic, velocity and position
linearly, and the rate on cubic arcs (Catmull and Rom 1974). Linear pieces fail for the rate: the noise of a knot and
that of the slope beside it are correlated, which through the lever arm looks like an offset. The slope of the cubic
arcs is symmetric about each knot. Predictions are exact for any tau, and

    dh/dtau = H (d rotation, d position, d velocity)/dtau - H_bias d rate/dtau
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Index, Matrices, Matrix, Vector, helper, kernel, view_helper
from rovgraph.kernels.layout import ACC_BIAS, ACC_SCALE, GYR_BIAS, MOTION, TRANSLATION, VELOCITY
from rovgraph.kernels.layout import VELOCITY as VELOCITY_AT
from rovgraph.kernels.measurement_row import (
    ASSUMED,
    DIM,
    DP,
    DR,
    DT,
    DV,
    GAIN,
    KIND,
    KNOT,
    KNOT_DT,
    KNOT_LAG,
    KNOT_RATE,
    KNOT_S,
    LOSS,
    LOSS_THRESHOLD,
    MOST,
    OFFSET,
    PARAMS,
    RATE,
    RATE_SD,
    ROW,
    SD,
    MeasuredRows,
    Z,
)
from rovgraph.kernels.measurements import WORK as PREDICT_WORK
from rovgraph.kernels.measurements import has_context, is_angular, predict, wrap
from rovgraph.kernels.rotations import (
    cross,
    exp_rotation,
    log_rotation,
    multiply,
    multiply_transposed,
    right_jacobian,
    rotate,
    rotate_back,
)
from rovgraph.kernels.states import Epoch, States, epoch
from rovgraph.kernels.weighting import loss_weight, whiten

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


class Measured(NamedTuple):
    """A measurement.

    Attributes
    ----------
    row, sensor : of `rovgraph.kernels.measurement_row`
    scale : shape (6, 6), bias by the IMU's scales, or (0, 0) where these are exact
    window : shape (K, KNOT), motion around a stamp that may be late, or (0, 0)
    """

    row: Array
    sensor: Array
    scale: Array
    window: Array


class LinearizationScratch(NamedTuple):
    """Arrays to calculate with.

    Attributes
    ----------
    bias : shape (6,), of the keyframe and of the IMU's scale
    z, H : shapes (3,), (3, 15 + C), predicted measurement, then the innovation; its derivative
    W : shape (3, 3), square-root information, lower triangular
    R, p, v : attitude, position and velocity at the measurement's time
    rate, by_offset : shapes (3,), (4, 3), rate there; how rotation, position, velocity and rate go with a late stamp
    F : shape (15, 15), zero at first
    knot, placing : shapes (KNOT,), (4, 3, 3), to place a late stamp with
    predicting, moving : shapes (WORK, 3, 3)
    used, column : shapes (u,), components of state and calibration that are estimated, and the column of each
    exact : shape (0, 0), bias by the IMU's scales where these are exact
    """

    bias: Array
    z: Array
    H: Array
    W: Array
    R: Array
    p: Array
    v: Array
    rate: Array
    by_offset: Array
    F: Array
    knot: Array
    placing: Array
    predicting: Array
    moving: Array
    used: Index
    column: Index
    exact: Array


@helper
def make_scratch(calibration_size: int, column: Index) -> LinearizationScratch:
    """Arrays for a calibration vector of that length; made once.

    ``column``, shape (15 + C,), is the column of each component of state and calibration, -1 where it is not
    estimated; of shape (0,) nothing is.
    """
    count, used, columns = 0, np.empty(len(column), np.int64), np.empty(len(column), np.int64)
    for j in range(len(column)):
        if column[j] >= 0:
            used[count], columns[count] = j, column[j]
            count += 1
    H, F = np.zeros((MOST, MOTION + calibration_size)), np.zeros((MOTION, MOTION))
    there = np.empty((3, 3)), np.empty(3), np.empty(3), np.empty(3), np.empty((4, 3))
    work = np.empty((PREDICT_WORK, 3, 3)), np.empty((WORK, 3, 3))
    late, estimated = (np.empty(KNOT), np.empty((4, 3, 3))), (used[:count].copy(), columns[:count].copy())
    innovation = np.empty(6), np.empty(MOST), H, np.empty((MOST, MOST))
    return LinearizationScratch(*innovation, *there, F, *late, *work, *estimated, np.empty((0, 0)))


@helper
def pick(measured: MeasuredRows, m: int, sensors: Array, scratch: LinearizationScratch) -> Measured:
    """One of some measurements."""
    scale = measured.scales[m] if len(measured.scales) else scratch.exact
    window = measured.windows[measured.window[m]] if measured.window[m] >= 0 else scratch.exact
    return Measured(measured.rows[m], sensors[measured.which[m]], scale, window)


@view_helper
def _interpolate(window: Array, late: float, motion_out: Array, slope_out: Array, work: Array) -> None:
    """The motion at a time between two knots, as numbers of a knot, and its slope by the time offset.

    Shapes (KNOT,) and (4, 3): rotation, position, velocity, rate.
    """
    last = 3
    while last + 1 < len(window) and not math.isnan(window[last + 1, KNOT_LAG]):
        last += 1
    x = (late - window[0, KNOT_LAG]) / KNOT_S
    k = min(max(math.floor(x), 1), last - 2)
    x -= k
    before, here, after, beyond = window[k - 1], window[k], window[k + 1], window[k + 2]
    turned, turn = work[0], work[1, 0]
    dR_here, dR_after = here[KNOT_DT + 1 : KNOT_DT + 10].reshape(3, 3), after[KNOT_DT + 1 : KNOT_DT + 10].reshape(3, 3)
    multiply_transposed(dR_here, dR_after, turned)
    log_rotation(turned, turn)
    for i in range(3):
        slope_out[0, i] = turn[i] / KNOT_S
        turn[i] *= x
    exp_rotation(turn, turned)
    multiply(dR_here, turned, motion_out[KNOT_DT + 1 : KNOT_DT + 10].reshape(3, 3))
    motion_out[KNOT_DT] = (1.0 - x) * here[KNOT_DT] + x * after[KNOT_DT]
    for i in range(3):
        for j in (KNOT_DT + 10 + i, KNOT_DT + 13 + i):  # velocity, position
            motion_out[j] = (1.0 - x) * here[j] + x * after[j]
        slope_out[1, i] = (after[KNOT_DT + 13 + i] - here[KNOT_DT + 13 + i]) / KNOT_S
        slope_out[2, i] = (after[KNOT_DT + 10 + i] - here[KNOT_DT + 10 + i]) / KNOT_S
        j = KNOT_RATE + i
        first, second = 0.5 * (after[j] - before[j]), before[j] - 2.5 * here[j] + 2.0 * after[j] - 0.5 * beyond[j]
        third = 1.5 * (here[j] - after[j]) + 0.5 * (beyond[j] - before[j])
        motion_out[j] = here[j] + x * (first + x * (second + x * third))
        slope_out[3, i] = (first + x * (2.0 * second + 3.0 * x * third)) / KNOT_S


@view_helper
def place(state: Epoch, one: Measured, gravity: float, derive: bool, scratch: LinearizationScratch) -> bool:
    """The state at a measurement's own time, and the rate there, in ``scratch``; False = it is the keyframe's.

    On request with their derivatives by the keyframe's state, and by how late the stamp is.
    """
    row, bias, late = one.row, scratch.bias, len(one.window) > 0
    for i in range(6):
        bias[i] = state.b[i]
        for k in range(len(one.scale)):
            bias[i] += one.scale[i, k] * state.c[ACC_SCALE + k]
    for i in range(3):
        scratch.rate[i] = row[RATE + i]
    if not late and row[DT] == 0.0:
        return False
    dt, dR, dv, dp = row[DT], row[DR:DV].reshape(3, 3), row[DV:DP], row[DP:ASSUMED]
    if late:
        knot = scratch.knot
        _interpolate(one.window, state.c[int(one.sensor[OFFSET])], knot, scratch.by_offset, scratch.placing)
        dt, dR = knot[KNOT_DT], knot[KNOT_DT + 1 : KNOT_DT + 10].reshape(3, 3)
        dv, dp = knot[KNOT_DT + 10 : KNOT_DT + 13], knot[KNOT_DT + 13 : KNOT_DT + 16]
        for i in range(3):
            scratch.rate[i] = knot[KNOT_RATE + i]
    assumed, seen = row[ASSUMED : ASSUMED + 6], Epoch(state.R, state.p, state.v, bias, state.c)
    there = Epoch(scratch.R, scratch.p, scratch.v, bias, state.c)
    propagate(seen, Snapshot(dt, dR, dv, dp, assumed), gravity, there, scratch.moving)
    if derive:
        propagation_jacobian(state.R, dt, scratch.F, scratch.moving)
        if late:
            _by_offset(state, dt, assumed, gravity, scratch)
    return True


@view_helper
def _by_offset(state: Epoch, dt: float, assumed: Array, gravity: float, scratch: LinearizationScratch) -> None:
    """From slopes of the motion to those of the state, as `LinearizationScratch.by_offset` has them, in place."""
    slope, turn, back = scratch.by_offset, scratch.placing[0, 0], scratch.placing[1]
    moved, seen = scratch.placing[2], scratch.placing[3, 0]
    bias, by_turn, by_p, by_v = scratch.bias, moved[0], moved[1], moved[2]
    for i in range(3):
        turn[i] = dt * (bias[3 + i] - assumed[3 + i])  # back over the turn that the bias adds
    exp_rotation(turn, back)
    rotate(back, slope[0], by_turn)
    for i in range(3):
        slope[1, i] += dt * (bias[i] - assumed[i])
        slope[2, i] += bias[i] - assumed[i]
    rotate(state.R, slope[1], by_p)
    rotate(state.R, slope[2], by_v)
    for i in range(3):
        by_p[i] -= state.v[i]
        slope[0, i] = by_turn[i] + bias[3 + i] - assumed[3 + i]
        slope[2, i] = by_v[i]
    by_p[2] -= gravity * dt
    slope[2, 2] -= gravity
    rotate_back(scratch.R, by_p, seen)
    for i in range(3):
        slope[1, i] = seen[i]


@view_helper
def innovate(state: Epoch, one: Measured, gravity: float, derive: bool, scratch: LinearizationScratch) -> None:
    """Innovation and square-root information, and on request the derivative of the prediction, in ``scratch``."""
    row, sensor = one.row, one.sensor
    kind, dim = int(sensor[KIND]), int(sensor[DIM])
    z, H, W = scratch.z[:dim], scratch.H[:dim], scratch.W[:dim, :dim]
    for a in range(dim):  # columns that are not estimated are not read
        for j in range(MOTION):
            H[a, j] = 0.0
        for j in scratch.used:
            H[a, j] = 0.0
        if sensor[OFFSET] >= 0.0:
            H[a, MOTION + int(sensor[OFFSET])] = 0.0
    params, work = row[ROW:] if has_context(kind) else sensor[PARAMS:], scratch.predicting
    if place(state, one, gravity, derive, scratch):
        there = Epoch(scratch.R, scratch.p, scratch.v, scratch.bias, state.c)
        predict(kind, there, scratch.rate, params, z, H, work)
        if derive:
            if len(one.window):
                offset = MOTION + int(sensor[OFFSET])
                for a in range(dim):
                    for i in range(3):
                        by = scratch.by_offset
                        H[a, offset] += H[a, i] * by[0, i] + H[a, 3 + i] * by[1, i] + H[a, VELOCITY_AT + i] * by[2, i]
                        H[a, offset] -= H[a, GYR_BIAS + i] * by[3, i]  # the rate enters less its bias
            chain(H, scratch.F)
    else:
        seen = Epoch(state.R, state.p, state.v, scratch.bias, state.c)
        predict(kind, seen, scratch.rate, params, z, H, work)
    if derive:
        for a in range(dim):
            for k in range(len(one.scale)):
                by_bias = 0.0
                for i in range(6):
                    by_bias += H[a, 9 + i] * one.scale[i, k]
                H[a, MOTION + ACC_SCALE + k] = by_bias
    whiten(row[SD:ROW], sensor[GAIN : GAIN + 9].reshape(3, 3)[:dim, :dim], row[RATE_SD], W)
    for a in range(dim):
        difference = row[Z + a] - z[a]
        z[a] = wrap(difference) if is_angular(kind) else difference


@view_helper
def squared_length(state: Epoch, one: Measured, gravity: float, scratch: LinearizationScratch) -> float:
    """Squared length of the whitened innovation."""
    innovate(state, one, gravity, False, scratch)
    square = 0.0
    for a in range(int(one.sensor[DIM])):
        whitened = 0.0
        for k in range(a + 1):
            whitened += scratch.W[a, k] * scratch.z[k]
        square += whitened * whitened
    return square


@view_helper
def linearize_measurement(
    state: Epoch, one: Measured, gravity: float, scratch: LinearizationScratch, r_out: Array, H_out: Array
) -> float:
    """Whitened innovation of one measurement, its derivative, and its squared length.

    ``r_out`` and ``H_out``, shapes (dim,), (dim, n), are zero before; its columns are those of ``scratch``.
    """
    innovate(state, one, gravity, True, scratch)
    z, H, W, square = scratch.z, scratch.H, scratch.W, 0.0
    for a in range(int(one.sensor[DIM])):
        for k in range(a + 1):
            r_out[a] += W[a, k] * z[k]
        square += r_out[a] * r_out[a]
    for u in range(len(scratch.used)):
        j, column = scratch.used[u], scratch.column[u]
        for k in range(int(one.sensor[DIM])):
            by = H[k, j]
            if by != 0.0:
                for a in range(k, int(one.sensor[DIM])):
                    H_out[a, column] += W[a, k] * by
    return square


@view_helper
def _linearize_one(
    j: int,
    begin: int,
    states: States,
    measured: MeasuredRows,
    sensors: Matrix,
    gravity: float,
    weighted: bool,
    scratch: LinearizationScratch,
    r_out: Vector,
    H_out: Matrix,
) -> int:
    """Measurement j of `linearize`, from a row on; returns the row after it."""
    one, state = pick(measured, j, sensors, scratch), epoch(states, j if len(states.R) > 1 else 0)
    end = begin + int(one.sensor[DIM])
    r = r_out[begin:end]
    if len(H_out) > 0:
        square = linearize_measurement(state, one, gravity, scratch, r, H_out[begin:end])
    else:
        innovate(state, one, gravity, False, scratch)
        square = 0.0
        for a in range(end - begin):
            for k in range(a + 1):
                r[a] += scratch.W[a, k] * scratch.z[k]
            square += r[a] * r[a]
    if weighted:
        root = math.sqrt(loss_weight(square, int(one.sensor[LOSS]), one.sensor[LOSS_THRESHOLD]))
        for a in range(begin, end):
            r_out[a] *= root
            for i in range(H_out.shape[1]):
                H_out[a, i] *= root
    return end


@kernel()
def linearize(
    states: States,
    measured: MeasuredRows,
    sensors: Matrix,
    column: Index,
    gravity: float,
    weighted: bool,
    r_out: Vector,
    H_out: Matrix,
) -> None:
    """Whitened innovations and Jacobians of m measurements, one after the other, none of them `PRELINEARISED`.

    Parameters
    ----------
    states : of each measurement's keyframe, or one of all
    column : shape (15 + C,), column of each component, -1 where it has none
    weighted : multiply them by the root of the weight of their loss
    r_out, H_out : shapes (k,), (k, n), zero before; of shape (0, n) the Jacobians are left out
    """
    begin, scratch = 0, make_scratch(states.c.shape[1], column)
    for j in range(len(measured.which)):
        begin = _linearize_one(j, begin, states, measured, sensors, gravity, weighted, scratch, r_out, H_out)


@kernel()
def place_measurements(
    states: States,
    measured: MeasuredRows,
    sensors: Matrix,
    gravity: float,
    out: States,
    rate_out: Matrix,
    F_out: Matrices,
) -> None:
    """States at the own times of m measurements, for models without a kernel; with derivatives.

    Parameters
    ----------
    states : of each measurement's keyframe
    out : R, p, v, and the bias with what the IMU's scales make of it; c holds (m, 12): how rotation, position and
        velocity go with a late stamp, and how the rate does
    rate_out, F_out : shapes (m, 3), (m, 15, 15) by the keyframe's state; of shape (0, 15, 15) these are left out
    """
    scratch, derive = make_scratch(states.c.shape[1], np.empty(0, np.int64)), len(F_out) > 0
    for m in range(len(measured.which)):
        one, state = pick(measured, m, sensors, scratch), epoch(states, m)
        moved = place(state, one, gravity, derive, scratch)
        for i in range(3):
            out.p[m, i] = scratch.p[i] if moved else state.p[i]
            out.v[m, i] = scratch.v[i] if moved else state.v[i]
            rate_out[m, i] = scratch.rate[i]
            for j in range(3):
                out.R[m, i, j] = scratch.R[i, j] if moved else state.R[i, j]
            for j in range(4):
                out.c[m, 3 * j + i] = scratch.by_offset[j, i]
        for i in range(6):
            out.b[m, i] = scratch.bias[i]
        if derive:
            for i in range(MOTION):
                for j in range(MOTION):
                    F_out[m, i, j] = scratch.F[i, j] if moved else 1.0 * (i == j)
