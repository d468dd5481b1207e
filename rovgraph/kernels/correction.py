"""The filter's correction at one keyframe: linearise, gate, update, move.

    r = W (z - h(x)),  H = W dh/dx                    whitened innovation of each measurement, at its own time
    NIS = r' (H P H' + I)^-1 r                        beyond gate^2 it is left out
    dx, P                                             `rovgraph.kernels.robust_update`
    x <- x + dx, P <- B P B'                          `rovgraph.kernels.error_coordinates`

A sensor that was left out for longer than its `READMIT` returns within `RETURN_SD`, and meanwhile inflates the
covariance of what it sees.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.change_of_basis import change_basis
from rovgraph.kernels.compass import wrap
from rovgraph.kernels.compile import helper, kernel
from rovgraph.kernels.error_coordinates import ErrorLayout, local, make_scratch, retract
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.measurement_row import (
    ASSUMED,
    BEND,
    DIM,
    DP,
    DR,
    DT,
    DV,
    GAIN,
    GATE,
    GIVEN,
    KIND,
    LOSS,
    PARAMS,
    RATE,
    RATE_SD,
    READMIT,
    SD,
    SEEN_FRAME,
    SEES,
    SEES_HEADING,
    SEES_VELOCITY,
    TIME,
    Z,
)
from rovgraph.kernels.measurements import WORK as PREDICT_WORK
from rovgraph.kernels.measurements import is_angular, predict
from rovgraph.kernels.propagation import WORK as PROPAGATE_WORK
from rovgraph.kernels.propagation import chain, propagate, propagation_jacobian
from rovgraph.kernels.robust_update import (
    inflate,
    innovation_covariance,
    joseph,
    leave_out,
    normalised_squared,
    reweight,
)
from rovgraph.kernels.weighting import loss_weight, whiten

Index = NDArray[np.int64]

RETURN_SD = 3.0  # a sensor that was left out for long returns with an innovation within this many sd


@helper
def move(x: Array, c: Array, P: Array, delta: Array, layout: ErrorLayout) -> None:
    """Move a state by ``delta`` along the error's coordinates, and its covariance's basis with it; in place."""
    size, rows = len(layout.columns), len(layout.rows)
    scratch, basis = make_scratch(len(layout.seen), len(c)), np.zeros((size, size))
    for i in range(size):
        basis[i, i] = 1.0
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    retract(R, p, v, b, c, delta[0:size], layout, scratch, basis)
    change_basis(P, basis, layout.rows, np.empty((rows, len(P))), np.empty((rows, size + 1), np.int64))


@kernel("void(f8[::1], f8[::1], f8[:, ::1], f8[::1], i8[::1], i8[:, ::1], f8[:, ::1], i8[::1])")
def move_estimate(
    x: Array, c: Array, P: Array, delta: Array, columns: Index, seen: Index, seen_params: Array, basis_rows: Index
) -> None:
    """`move`, from Python; the last four are those of `rovgraph.kernels.error_coordinates.ErrorLayout`."""
    move(x, c, P, delta, ErrorLayout(columns, seen, seen_params, basis_rows))


@kernel("void(f8[::1], f8[::1], f8[::1], f8[::1], i8[::1], i8[:, ::1], f8[:, ::1], i8[::1], f8[::1], f8[:, ::1])")
def difference(
    x: Array,
    c: Array,
    other_x: Array,
    other_c: Array,
    columns: Index,
    seen: Index,
    seen_params: Array,
    basis_rows: Index,
    delta_out: Array,
    basis_out: Array,
) -> None:
    """The error that leads from a state to another; ``basis_out``, the unit matrix before, takes errors back."""
    layout = ErrorLayout(columns, seen, seen_params, basis_rows)
    scratch = make_scratch(len(layout.seen), len(c))
    other = (other_x[0:9].reshape(3, 3), other_x[9:12], other_x[12:15], other_x[15:21], other_c)
    own = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    local(own[0], own[1], own[2], own[3], c, other, layout, scratch, delta_out, basis_out)


@helper
def linearize_one(
    x: Array,
    c: Array,
    row: Array,
    sensor: Array,
    scale: Array,
    column: Index,
    gravity: float,
    r_out: Array,
    H_out: Array,
) -> None:
    """Whitened innovation and Jacobian of one measurement.

    Parameters
    ----------
    x : shape (21,), R_nb by rows, p_n, v_n, bias of the keyframe
    c : calibration vector
    row, sensor : of `rovgraph.kernels.measurement_row`
    scale : shape (6, 6), bias by the IMU's scales, or (0, 0) where these are exact
    column : shape (15 + C,), place of each component in the error, -1 where it is not estimated
    r_out, H_out : shapes (dim,), (dim, n), zeros
    """
    kind, dim, C = int(sensor[KIND]), int(sensor[DIM]), len(c)
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21].copy()
    scaled = len(scale) > 0
    if scaled:
        for i in range(6):
            for k in range(6):
                b[i] += scale[i, k] * c[ACC_SCALE + k]
    z, H = np.empty(dim), np.zeros((dim, MOTION + C))
    work = np.empty((PREDICT_WORK, 3, 3))
    params = sensor[PARAMS:]
    if row[DT] != 0.0:
        there_R, there = np.empty((3, 3)), np.empty((2, 3))
        motion_work, F = np.empty((PROPAGATE_WORK, 3, 3)), np.zeros((MOTION, MOTION))
        dR = row[DR : DR + 9].reshape(3, 3)
        dv, dp, assumed = row[DV : DV + 3], row[DP : DP + 3], row[ASSUMED : ASSUMED + 6]
        propagate(R, p, v, b, row[DT], dR, dv, dp, assumed, gravity, there_R, there[0], there[1], motion_work)
        propagation_jacobian(R, row[DT], F, motion_work)
        predict(kind, there_R, there[0], there[1], b, c, row[RATE : RATE + 3], params, z, H, work)
        chain(H, F)
    else:
        predict(kind, R, p, v, b, c, row[RATE : RATE + 3], params, z, H, work)
    if scaled:
        for a in range(dim):
            for k in range(6):
                for i in range(6):
                    H[a, MOTION + ACC_SCALE + k] += H[a, 9 + i] * scale[i, k]
    W = np.empty((dim, dim))
    whiten(row[SD : SD + dim], sensor[GAIN : GAIN + 9].reshape(3, 3)[:dim, :dim], row[RATE_SD], W)
    for a in range(dim):
        difference = row[Z + a] - z[a]
        z[a] = wrap(difference) if is_angular(kind) else difference
    for a in range(dim):
        for k in range(a + 1):
            r_out[a] += W[a, k] * z[k]
        for j in range(MOTION + C):
            if column[j] >= 0:
                for k in range(a + 1):
                    H_out[a, column[j]] += W[a, k] * H[k, j]


@helper
def directions_seen(x: Array, sensor: Array, n: int) -> Array:
    """Directions of the error that a sensor sees, shape (n, s): velocity in n, or turn or shift along n's axes."""
    count = 0
    for k in range(3):
        count += sensor[SEES + k] != 0.0
    seen, j = np.zeros((n, count)), 0
    frame = int(sensor[SEEN_FRAME])
    for k in range(3):
        if sensor[SEES + k] == 0.0:
            continue
        if frame == SEES_VELOCITY:
            seen[6 + k, j] = 1.0
        else:
            begin = 0 if frame == SEES_HEADING else 3
            for i in range(3):
                seen[begin + i, j] = x[3 * k + i]  # column k of R_bn
        j += 1
    return seen


@helper
def admit(nis: float, time: float, sensor: Array, since: Array, index: int) -> bool:
    """Whether a measurement lies within its gate; keeps in ``since`` since when its sensor is left out."""
    gate = sensor[GATE]
    if not math.isnan(since[index]) and time - since[index] > sensor[READMIT]:
        gate = RETURN_SD
    if nis > gate * gate:
        if math.isnan(since[index]):
            since[index] = time
        return False
    since[index] = math.nan
    return True


@kernel("void(f8[::1], f8[::1], f8[:, ::1], i8[::1], f8[:, ::1], i8[::1], f8[:, :, ::1], f8, b1, f8[::1], f8[:, ::1])")
def linearize(
    x: Array,
    c: Array,
    rows: Array,
    which: Index,
    sensors: Array,
    column: Index,
    scale: Array,
    gravity: float,
    weighted: bool,
    r_out: Array,
    H_out: Array,
) -> None:
    """Whitened innovations and Jacobians of m measurements of a keyframe, none of them `GIVEN`; as `correct` takes.

    ``weighted`` ones are multiplied by the root of the weight of their loss.
    """
    begin = 0
    for j in range(len(which)):
        sensor = sensors[which[j]]
        end = begin + int(sensor[DIM])
        own = scale[j] if len(scale) else scale[:, :, 0]
        linearize_one(x, c, rows[j], sensor, own, column, gravity, r_out[begin:end], H_out[begin:end])
        if weighted:
            square = 0.0
            for a in range(begin, end):
                square += r_out[a] * r_out[a]
            root = math.sqrt(loss_weight(square, int(sensor[LOSS]), sensor[BEND]))
            for a in range(begin, end):
                r_out[a] *= root
                for i in range(H_out.shape[1]):
                    H_out[a, i] *= root
        begin = end


@kernel(
    "void(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], i8[::1], f8[:, :, ::1], f8[::1], f8[:, ::1], "
    "i8[::1], i8[:, ::1], f8[:, ::1], i8[::1], f8[::1], b1, f8, f8[::1], f8[::1], f8[::1])"
)
def correct(
    x: Array,
    c: Array,
    P: Array,
    rows: Array,
    which: Index,
    sensors: Array,
    column: Index,
    scale: Array,
    given_r: Array,
    given_H: Array,
    columns: Index,
    seen: Index,
    seen_params: Array,
    basis_rows: Index,
    since: Array,
    gated: bool,
    gravity: float,
    nis_out: Array,
    weight_out: Array,
    places_out: Array,
) -> None:
    """Correct a keyframe by m measurements, in place.

    Parameters
    ----------
    x, c, P : state (21,), calibration vector and covariance (n, n); places that are remembered come last in P
    rows, which : shapes (m, ROW), (m,), the measurements and the sensor that each is of
    sensors : shape (s, PARAMS + ...), of `rovgraph.kernels.measurement_row`
    column : shape (15 + C,), place of each component in the error, -1 where it is not estimated
    scale : shape (m, 6, 6), bias by the IMU's scales, or (0, 6, 6)
    given_r, given_H : whitened rows of the measurements of kind `GIVEN`, in their order
    columns, seen, seen_params, basis_rows : of `rovgraph.kernels.error_coordinates.ErrorLayout`
    since : shape (s,), since when each sensor is left out, nan where it is not [s]
    gated : False lets everything in
    gravity : [m/s^2]
    nis_out, weight_out : shape (m,); weight 0 = left out
    places_out : correction of the places
    """
    m, n = len(which), len(P)
    first = np.zeros(m + 1, np.int64)
    for j in range(m):
        first[j + 1] = first[j] + int(sensors[which[j], DIM])
    r, H = np.zeros(first[m]), np.zeros((first[m], n))
    HP, S = np.empty((first[m], n)), np.empty((first[m], first[m]))
    loss, bend, taken = np.empty(m, np.int64), np.empty(m), 0
    for j in range(m):
        sensor, begin, end = sensors[which[j]], first[j], first[j + 1]
        loss[j], bend[j] = int(sensor[LOSS]), sensor[BEND]
        if sensor[KIND] == GIVEN:
            for a in range(begin, end):
                r[a] = given_r[taken]
                for i in range(given_H.shape[1]):
                    H[a, i] = given_H[taken, i]
                taken += 1
        else:
            own = scale[j] if len(scale) else scale[:, :, 0]
            linearize_one(x, c, rows[j], sensor, own, column, gravity, r[begin:end], H[begin:end])
    innovation_covariance(P, H, HP, S)
    entered = False
    for j in range(m):
        sensor, begin, end = sensors[which[j]], first[j], first[j + 1]
        nis_out[j] = normalised_squared(S, r, begin, end)
        weight_out[j] = 1.0
        if gated and not admit(nis_out[j], rows[j, TIME], sensor, since, which[j]):
            weight_out[j] = 0.0
            if rows[j, TIME] - since[which[j]] > sensor[READMIT]:
                inflate(P, r, H, begin, end, directions_seen(x, sensor, n))
                innovation_covariance(P, H, HP, S)
            leave_out(r, H, HP, S, begin, end)
        else:
            entered = True
    if not entered:
        return
    root, inverse, weight, delta = np.empty(first[m]), np.empty_like(S), np.empty(m), np.empty(n)
    reweight(r, S, first, loss, bend, root, inverse, weight)
    joseph(P, r, H, HP, root, inverse, delta)
    for j in range(m):
        weight_out[j] *= weight[j]
    move(x, c, P, delta, ErrorLayout(columns, seen, seen_params, basis_rows))
    for i in range(len(places_out)):
        places_out[i] = delta[n - len(places_out) + i]
