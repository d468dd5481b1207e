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
from rovgraph.kernels.compile import helper, kernel
from rovgraph.kernels.error_coordinates import ErrorLayout, local, retract
from rovgraph.kernels.error_coordinates import make_scratch as make_coordinates_scratch
from rovgraph.kernels.linearization import linearize_measurement, make_scratch
from rovgraph.kernels.measurement_row import (
    BEND,
    DIM,
    GATE,
    GIVEN,
    KIND,
    LOSS,
    READMIT,
    SEEN_FRAME,
    SEES,
    SEES_HEADING,
    SEES_VELOCITY,
    TIME,
)
from rovgraph.kernels.robust_update import (
    inflate,
    innovation_covariance,
    joseph,
    leave_out,
    normalised_squared,
    reweight,
)
from rovgraph.kernels.weighting import loss_weight

Index = NDArray[np.int64]

NO_SCALE = np.empty((0, 0))  # of an IMU whose scale is exact
RETURN_SD = 3.0  # a sensor that was left out for long returns with an innovation within this many sd


@helper
def move(x: Array, c: Array, P: Array, delta: Array, layout: ErrorLayout) -> None:
    """Move a state by ``delta`` along the error's coordinates, and its covariance's basis with it; in place."""
    size, rows = len(layout.columns), len(layout.rows)
    scratch, basis = make_coordinates_scratch(len(layout.seen), len(c)), np.zeros((size, size))
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
    scratch = make_coordinates_scratch(len(layout.seen), len(c))
    other = (other_x[0:9].reshape(3, 3), other_x[9:12], other_x[12:15], other_x[15:21], other_c)
    own = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    local(own[0], own[1], own[2], own[3], c, other, layout, scratch, delta_out, basis_out)


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
    begin, scratch = 0, make_scratch(len(c))
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    for j in range(len(which)):
        sensor = sensors[which[j]]
        end = begin + int(sensor[DIM])
        own, r, H = scale[j] if len(scale) else NO_SCALE, r_out[begin:end], H_out[begin:end]
        square = linearize_measurement(R, p, v, b, c, rows[j], sensor, own, gravity, column, scratch, r, H)
        if weighted:
            root = math.sqrt(loss_weight(square, int(sensor[LOSS]), sensor[BEND]))
            for a in range(begin, end):
                r_out[a] *= root
                for i in range(H_out.shape[1]):
                    H_out[a, i] *= root
        begin = end


@helper
def correct_keyframe(
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
    layout: ErrorLayout,
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
    layout : of the error
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
    loss, bend, taken, scratch = np.empty(m, np.int64), np.empty(m), 0, make_scratch(len(c))
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
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
            own = scale[j] if len(scale) else NO_SCALE
            own_r, own_H = r[begin:end], H[begin:end]
            linearize_measurement(R, p, v, b, c, rows[j], sensor, own, gravity, column, scratch, own_r, own_H)
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
    move(x, c, P, delta, layout)
    for i in range(len(places_out)):
        places_out[i] = delta[n - len(places_out) + i]


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
    """`correct_keyframe`, from Python; columns to basis_rows are those of its layout."""
    layout, out = ErrorLayout(columns, seen, seen_params, basis_rows), (nis_out, weight_out, places_out)
    tables = sensors, column, scale, given_r, given_H
    correct_keyframe(x, c, P, rows, which, *tables, layout, since, gated, gravity, *out)
