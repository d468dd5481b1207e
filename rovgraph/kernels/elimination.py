"""A dive's factors at a point: linearised and eliminated in one pass, or what they cost.

The rows of `rovgraph.kernels.chain`, a keyframe at a time: motions of `rovgraph.kernels.motion_residual`, measurements
of `rovgraph.kernels.linearization`, and the walks of calibration. Rows that no kernel computes, as priors and the
measurements of sensors from outside, are arguments. Only the eliminated rows are kept for the whole dive.

`eliminate_dive` linearises and eliminates; `eliminate` takes rows that are given, for studies of the solver.
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.kernels.chain import (
    Buffers,
    Elimination,
    PlacedRows,
    Walks,
    close_border,
    eliminate_keyframe,
    load_measurements,
    load_motion,
    make_room,
    triangularise_keyframe,
)
from rovgraph.kernels.compile import Flags, Index, Matrices, Matrix, Vector, kernel, view_helper
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.linearization import (
    LinearizationScratch,
    linearize_measurement,
    make_scratch,
    pick,
    squared_length,
)
from rovgraph.kernels.measurement_row import DIM, KIND, LOSS, LOSS_THRESHOLD, MOST, PRELINEARISED, MeasuredRows
from rovgraph.kernels.motion_residual import make_residual_scratch, motion_error, whiten_motion
from rovgraph.kernels.motion_row import AFTER, RESIDUAL, WIDTH
from rovgraph.kernels.states import States, epoch, with_bias
from rovgraph.kernels.weighting import loss_weight, robust_cost


class DiveFactors(NamedTuple):
    """The constant part of a dive of n keyframes.

    Attributes
    ----------
    motions, W : shapes (n - 1, ROW), (n - 1, 15, 15), of `rovgraph.kernels.motion_row`, square-root information
    scales : shape (n - 1, 6, 6), bias by the IMU's scales in each interval, or (0, 6, 6) where these are exact
    measured : m measurements in the order of keyframes
    first : shape (n + 1,), a keyframe's first measurement
    sensors : a row for each sensor, of `rovgraph.kernels.measurement_row`; those that are `PRELINEARISED` are left out
    gravity : [m/s^2]
    """

    motions: Matrix
    W: Matrices
    scales: Matrices
    measured: MeasuredRows
    first: Index
    sensors: Matrix
    gravity: float


@view_helper
def load_linearized(
    k: int,
    row: int,
    point: States,
    dive: DiveFactors,
    entered: Flags,
    room: Buffers,
    scratch: LinearizationScratch,
    r: Vector,
) -> int:
    """Weighted rows of the measurements of keyframe k into V from ``row`` on; returns the row after them."""
    state, which, sensors = epoch(point, k), dive.measured.which, dive.sensors
    V, sums, last = room.V, room.scale, len(room.scale)
    for m in range(dive.first[k], dive.first[k + 1]):
        sensor = sensors[which[m]]
        if not entered[m] or sensor[KIND] == PRELINEARISED:
            continue
        dim = int(sensor[DIM])
        for a in range(dim):
            r[a] = 0.0
            for j in range(V.shape[1]):
                V[row + a, j] = 0.0
        one = pick(dive.measured, m, sensors, scratch)
        square = linearize_measurement(state, one, dive.gravity, scratch, r, V[row : row + dim])
        root = math.sqrt(loss_weight(square, int(sensor[LOSS]), sensor[LOSS_THRESHOLD]))
        for a in range(dim):
            for j in range(last):
                V[row + a, j] *= root
                sums[j] += V[row + a, j] * V[row + a, j]
            V[row + a, last] = root * r[a]
        row += dim
    return row


@kernel()
def eliminate_dive(
    dive: DiveFactors,
    entered: Flags,
    point: States,
    column: Index,
    walks: Walks,
    given: PlacedRows,
    border_rows: Matrix,
    out: Elimination,
) -> int:
    """Linearise all factors at a point and eliminate them, as `eliminate` does.

    Parameters
    ----------
    entered : shape (m,), admitted measurements
    column : shape (15 + C,), target of each component of state and calibration, -1 where it is not estimated
    given : rows that no kernel computes
    border_rows : as in `eliminate`
    out : of fewer conditionals than keyframes the last one is that of the last keyframe
    """
    b, c = point.b, point.c
    scales, first, given_first = dive.scales, dive.first, given.first
    n, d, size = len(b), out.conditionals.shape[1], c.shape[1]
    most, of_c, of_scale = 0, len(c) > 1, len(scales) > 0
    for k in range(n):
        most = max(most, given_first[k + 1] - given_first[k] + MOST * (first[k + 1] - first[k]))
    room, last, stop = make_room(d, len(out.border), most, border_rows), len(out.border) + len(border_rows), 0
    scratch, r = make_scratch(size, column), np.empty(MOST)
    moving, unwhitened, A = make_residual_scratch(), np.empty((MOTION, WIDTH)), np.empty((MOTION, WIDTH))
    C, targets, bias = np.zeros((MOTION, 6 * of_scale)), np.empty(6 * of_scale, np.int64), np.empty((2, 6))
    for i in range(len(targets)):
        targets[i] = column[MOTION + ACC_SCALE + i]
    out.left[0], dense = 0.0, 0
    for k in range(n):
        end = load_measurements(k, given, MOTION, d, room)
        end = load_linearized(k, end, point, dive, entered, room, scratch, r)
        last, stop, failing = triangularise_keyframe(k, n, end, last, stop, room, out)
        if k < n - 1:
            for i in range(6):
                shift = 0.0
                for j in range(len(targets)):
                    shift += scales[k, i, j] * c[(k + 1) * of_c, ACC_SCALE + j]
                bias[0, i], bias[1, i] = b[k, i] + shift, b[k + 1, i] + shift
            before, after = with_bias(epoch(point, k), bias[0]), with_bias(epoch(point, k + 1), bias[1])
            motion_error(dive.motions[k], before, after, unwhitened, moving)
            whiten_motion(dive.W[k], unwhitened, A)
            for i in range(MOTION):
                A[i, RESIDUAL] = -A[i, RESIDUAL]
                for j in range(len(targets)):
                    C[i, j] = 0.0
                    for m in range(6):  # of both biases alike, which leaves the walk of the bias out of it
                        C[i, j] += (A[i, 9 + m] + A[i, AFTER + 9 + m]) * scales[k, m, j]
            dense = load_motion(A, C, targets, walks.weight[k], walks.kept[k], walks.r[k], room)
        failing = max(failing, eliminate_keyframe(k, n, dense, room, out.conditionals))
        if failing >= 0:
            return failing
    return close_border(n, d, room, out.border)


@view_helper
def _squared_lengths_at(
    k: int, dive: DiveFactors, point: States, scratch: LinearizationScratch, square_out: Vector
) -> None:
    """Those of keyframe k."""
    state, which, sensors = epoch(point, k), dive.measured.which, dive.sensors
    for m in range(dive.first[k], dive.first[k + 1]):
        square_out[m] = 0.0
        if sensors[which[m], KIND] != PRELINEARISED:
            square_out[m] = squared_length(state, pick(dive.measured, m, sensors, scratch), dive.gravity, scratch)


@kernel()
def squared_lengths(dive: DiveFactors, point: States, square_out: Vector) -> None:
    """Squared lengths of the whitened innovations of a dive's measurements, shape (m,); 0 where `PRELINEARISED`."""
    scratch = make_scratch(point.c.shape[1], np.empty(0, np.int64))
    for k in range(len(dive.first) - 1):
        _squared_lengths_at(k, dive, point, scratch, square_out)


@kernel()
def robust_costs(square: Vector, which: Index, sensors: Matrix, entered: Flags) -> float:
    """Sum of the robust costs of the admitted measurements, from their squared lengths."""
    total = 0.0
    for m in range(len(square)):
        if entered[m]:
            sensor = sensors[which[m]]
            total += robust_cost(square[m], int(sensor[LOSS]), sensor[LOSS_THRESHOLD])
    return total


class LinearMotions(NamedTuple):
    """Whitened rows of n - 1 motions.

    Attributes
    ----------
    A : shape (n - 1, s, 2 (s + 1)), columns of the keyframe before, right-hand side, columns of the keyframe after,
        and one that is not read
    C, targets : shapes (n - 1, s, e) and (e,), other columns, of the keyframe before or of the border
    """

    A: Matrices
    C: Matrices
    targets: Index


@kernel()
def eliminate(motions: LinearMotions, walks: Walks, measured: PlacedRows, border_rows: Matrix, out: Elimination) -> int:
    """Eliminate n keyframes in the order of time, then the border.

    Parameters
    ----------
    walks : of the last d - s components
    border_rows : shape (p, c + 1), of the border's priors with their right-hand sides

    Returns
    -------
    -1, or the first component that the rows do not determine, ``k d + j`` of a keyframe and ``n d + j`` of the border
    """
    A, C, first = motions.A, motions.C, measured.first
    n, d, s, c = out.conditionals.shape[0], out.conditionals.shape[1], A.shape[1], out.border.shape[0]
    most = 0
    for k in range(n):
        most = max(most, first[k + 1] - first[k])
    room, last, stop = make_room(d, c, most, border_rows), c + border_rows.shape[0], 0
    out.left[0], dense = 0.0, 0
    for k in range(n):
        end = load_measurements(k, measured, s, d, room)
        last, stop, failing = triangularise_keyframe(k, n, end, last, stop, room, out)
        if k < n - 1:
            dense = load_motion(A[k], C[k], motions.targets, walks.weight[k], walks.kept[k], walks.r[k], room)
        failing = max(failing, eliminate_keyframe(k, n, dense, room, out.conditionals))
        if failing >= 0:
            return failing
    return close_border(n, d, room, out.border)
