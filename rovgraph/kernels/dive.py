"""A dive's factors at a point: linearised and eliminated in one pass, or what they cost.

The rows of `rovgraph.kernels.chain`, a keyframe at a time: motions of `rovgraph.kernels.motion_residual`, measurements
of `rovgraph.kernels.linearization`, and the walks of calibration. What no kernel knows, as priors and the measurements
of sensors from outside, comes as rows. Nothing but what is eliminated is kept for the whole dive.

A point is R, p, v, b of n keyframes, shapes (n, 3, 3), (n, 3), (n, 3), (n, 6), and c, their calibration vectors, shape
(n, C), or (1, C) where nothing walks. What is constant of a dive is

    motions, W     shapes (n - 1, ROW), (n - 1, 15, 15), of `rovgraph.kernels.motion_row`, square-root information
    scales         shape (n - 1, 6, 6), bias by the IMU's scales in each interval, or (0, 6, 6) where these are exact
    rows, which    shapes (m, ROW), (m,), measurements in the order of keyframes, and the sensor that each is of
    first          shape (n + 1,), a keyframe's first measurement
    row_scales     shape (m, 6, 6) or (0, 6, 6), as scales, from the keyframe to each measurement
    sensors        a row for each sensor, of `rovgraph.kernels.measurement_row`; those that are `GIVEN` are left out
"""

import math

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.chain import (
    Room,
    absorb,
    close_border,
    load_measurements,
    load_motion,
    make_room,
    pass_on,
)
from rovgraph.kernels.compile import kernel, view_helper
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.linearization import Scratch, linearize_measurement, make_scratch, squared_length
from rovgraph.kernels.measurement_row import BEND, DIM, GIVEN, KIND, LOSS, MOST
from rovgraph.kernels.motion_residual import make_residual_scratch, motion_error, whiten_motion
from rovgraph.kernels.motion_row import AFTER, RESIDUAL, WIDTH
from rovgraph.kernels.weighting import loss_weight, robust_cost

Index = NDArray[np.int64]
Flags = NDArray[np.bool_]


@view_helper
def load_linearized(
    begin: int,
    end: int,
    row: int,
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    c: Array,
    rows: Array,
    which: Index,
    row_scales: Array,
    sensors: Array,
    entered: Flags,
    gravity: float,
    room: Room,
    scratch: Scratch,
    r: Array,
) -> int:
    """Weighted rows of measurements ``begin`` to ``end`` into V from ``row`` on; returns the row after them."""
    V, sums, last = room.V, room.scale, len(room.scale)
    for m in range(begin, end):
        sensor = sensors[which[m]]
        if not entered[m] or sensor[KIND] == GIVEN:
            continue
        dim = int(sensor[DIM])
        for a in range(dim):
            r[a] = 0.0
            for j in range(V.shape[1]):
                V[row + a, j] = 0.0
        scale = row_scales[m] if len(row_scales) else scratch.exact
        H = V[row : row + dim]
        square = linearize_measurement(R, p, v, b, c, rows[m], sensor, scale, gravity, scratch, r, H)
        root = math.sqrt(loss_weight(square, int(sensor[LOSS]), sensor[BEND]))
        for a in range(dim):
            for j in range(last):
                V[row + a, j] *= root
                sums[j] += V[row + a, j] * V[row + a, j]
            V[row + a, last] = root * r[a]
        row += dim
    return row


@kernel(
    "i8(f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], i8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1], b1[::1],"
    " f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[::1], f8, f8[:, ::1], f8[:, ::1], f8[:, ::1],"
    " f8[:, ::1], i8[:, ::1], i8[::1], f8[:, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1])"
)
def eliminate_dive(
    motions: Array,
    W: Array,
    scales: Array,
    rows: Array,
    which: Index,
    first: Index,
    row_scales: Array,
    sensors: Array,
    entered: Flags,
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    c: Array,
    column: Index,
    gravity: float,
    walk: Array,
    kept: Array,
    walk_r: Array,
    given: Array,
    given_targets: Index,
    given_first: Index,
    border_rows: Array,
    stops: Index,
    conditionals_out: Array,
    border_out: Array,
    filtered_out: Array,
    left_out: Array,
) -> int:
    """Linearise all factors at a point and eliminate them, as `rovgraph.kernels.linear_chain.eliminate`.

    Parameters
    ----------
    motions to sensors : of the dive
    entered : shape (m,), measurements that are let in
    R, p, v, b, c : the point
    column : shape (15 + C,), target of each component of state and calibration, -1 where it is not estimated
    gravity : [m/s^2]
    walk, kept, walk_r : as `rovgraph.kernels.linear_chain.eliminate`
    given, given_targets, given_first : rows, targets and first, of what no kernel knows
    border_rows to left_out : as `rovgraph.kernels.linear_chain.eliminate`; of fewer ``conditionals_out`` than
        keyframes the last one is that of the last keyframe
    """
    n, d, size = len(R), conditionals_out.shape[1], c.shape[1]
    most, of_c, of_scale = 0, len(c) > 1, len(scales) > 0
    for k in range(n):
        most = max(most, given_first[k + 1] - given_first[k] + MOST * (first[k + 1] - first[k]))
    room, last, stop = make_room(d, border_out.shape[0], most, border_rows), len(border_out) + len(border_rows), 0
    scratch, own = make_scratch(size, column), np.empty(MOST)
    moving, unwhitened, A = make_residual_scratch(), np.empty((MOTION, WIDTH)), np.empty((MOTION, WIDTH))
    C, targets, bias = np.zeros((MOTION, 6 * of_scale)), np.empty(6 * of_scale, np.int64), np.empty((2, 6))
    for i in range(len(targets)):
        targets[i] = column[MOTION + ACC_SCALE + i]
    left_out[0], dense = 0.0, 0
    for k in range(n):
        c_k = c[k * of_c]
        end = load_measurements(given, given_targets, given_first[k], given_first[k + 1], MOTION, d, room)
        state, measured = (R[k], p[k], v[k], b[k], c_k), (rows, which, row_scales, sensors, entered)
        end = load_linearized(first[k], first[k + 1], end, *state, *measured, gravity, room, scratch, own)
        last, stop, failing = absorb(k, n, end, last, stops, stop, room, filtered_out, left_out)
        if k < n - 1:
            for i in range(6):
                shift = 0.0
                for j in range(len(targets)):
                    shift += scales[k, i, j] * c[(k + 1) * of_c, ACC_SCALE + j]
                bias[0, i], bias[1, i] = b[k, i] + shift, b[k + 1, i] + shift
            after = R[k + 1], p[k + 1], v[k + 1], bias[1]
            motion_error(motions[k], R[k], p[k], v[k], bias[0], *after, unwhitened, moving)
            whiten_motion(W[k], unwhitened, A)
            for i in range(MOTION):
                A[i, RESIDUAL] = -A[i, RESIDUAL]
                for j in range(len(targets)):
                    C[i, j] = 0.0
                    for m in range(6):  # of both biases alike, which leaves the walk of the bias out of it
                        C[i, j] += (A[i, 9 + m] + A[i, AFTER + 9 + m]) * scales[k, m, j]
            dense = load_motion(A, C, targets, walk[k], kept[k], walk_r[k], room)
        failing = max(failing, pass_on(k, n, dense, room, conditionals_out))
        if failing >= 0:
            return failing
    return close_border(n, d, room, border_out)


@kernel(
    "void(f8[:, ::1], i8[::1], i8[::1], f8[:, :, ::1], f8[:, ::1],"
    " f8[:, :, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8, f8[::1])"
)
def squared_lengths(
    rows: Array,
    which: Index,
    first: Index,
    row_scales: Array,
    sensors: Array,
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    c: Array,
    gravity: float,
    square_out: Array,
) -> None:
    """Squared lengths of the whitened innovations of a dive's measurements, shape (m,); 0 of those that are `GIVEN`."""
    scratch, of_c = make_scratch(c.shape[1], np.empty(0, np.int64)), len(c) > 1
    for k in range(len(first) - 1):
        for m in range(first[k], first[k + 1]):
            sensor, square_out[m] = sensors[which[m]], 0.0
            if sensor[KIND] != GIVEN:
                scale = row_scales[m] if len(row_scales) else scratch.exact
                state = R[k], p[k], v[k], b[k], c[k * of_c]
                square_out[m] = squared_length(*state, rows[m], sensor, scale, gravity, scratch)


@kernel("f8(f8[::1], i8[::1], f8[:, ::1], b1[::1])")
def robust_costs(square: Array, which: Index, sensors: Array, entered: Flags) -> float:
    """Sum of the robust costs of measurements of some squared lengths, of those that are let in."""
    total = 0.0
    for m in range(len(square)):
        if entered[m]:
            sensor = sensors[which[m]]
            total += robust_cost(square[m], int(sensor[LOSS]), sensor[BEND])
    return total
