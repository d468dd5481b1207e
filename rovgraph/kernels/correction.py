"""The filter's correction at one keyframe: linearise, gate, update, move.

    r = W (z - h(x)),  H = W dh/dx                    whitened innovation of each measurement, at its own time
    NIS = r' (H P H' + I)^-1 r                        beyond gate^2 it is left out
    dx, P                                             `rovgraph.kernels.robust_update`
    x <- x + dx, P <- B P B'                          `rovgraph.kernels.error_coordinates`

A sensor that was left out for longer than `DISTRUSTED_S` returns only within `RETURN_SD` of what the filter, whose
uncertainty grows without it, holds possible. Left out for longer than its `READMIT`, it is believed to see something
that no model knows, and inflates the covariance of what it sees.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.change_of_basis import change_basis
from rovgraph.kernels.compile import helper, kernel
from rovgraph.kernels.error_coordinates import ErrorLayout, local, retract
from rovgraph.kernels.error_coordinates import make_scratch as make_coordinates_scratch
from rovgraph.kernels.layout import TRANSLATION, VELOCITY
from rovgraph.kernels.linearization import Scratch, linearize_measurement, make_scratch
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
    correction,
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
WIDE = 30.0  # sd of a prediction, in those of its measurement, from which it is corrected by iterations
MAX_RELINEARIZATIONS = 5
STANDS = 0.1  # a correction within as many sd needs no other point to linearise at
DISTRUSTED_S = 2.0  # of being left out after which a sensor may be wrong for longer than single measurements [s]
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
def determinant(A: Array) -> float:
    """Of a matrix of shape (3, 3)."""
    total = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        total += A[0, i] * (A[1, j] * A[2, k] - A[1, k] * A[2, j])
    return total


@helper
def coordinates_of_velocity(x: Array, P: Array, layout: ErrorLayout) -> ErrorLayout:
    """The layout in which velocity moves along those axes, n's or the body's, along which it is known more sharply.

    A DVL knows it along the body's, where a correction of heading must not touch what it has seen. In its silence
    depth alone knows velocity, along n: moved as the DVL sees it, a correction of tilt by 0.3 degrees would make
    15 mm/s downwards of a velocity that is 3 m/s off, which depth takes for knowledge of all of the velocity.
    The measure is the volume of the error's ellipsoid: that of v_n against that of R' v_n, whose error along n is
    d_v + v_n x R d_R.
    """
    along_n, along_body, turn = P[VELOCITY : VELOCITY + 3, VELOCITY : VELOCITY + 3], np.empty((3, 3)), np.zeros((3, 6))
    for k in range(3):  # columns v_n x R e_k
        a, b, c = x[k], x[3 + k], x[6 + k]
        turn[0, k] = x[13] * c - x[14] * b
        turn[1, k] = x[14] * a - x[12] * c
        turn[2, k] = x[12] * b - x[13] * a
        turn[k, 3 + k] = 1.0
    product = np.empty((3, 6))
    for i in range(3):
        for j in range(6):
            total = 0.0
            for k in range(6):
                total += turn[i, k] * P[k if k < 3 else k + 3, j if j < 3 else j + 3]
            product[i, j] = total
    for i in range(3):
        for j in range(3):
            total = 0.0
            for k in range(6):
                total += product[i, k] * turn[j, k]
            along_body[i, j] = total
    if determinant(along_body) <= determinant(along_n):
        return layout
    others = layout.seen[:, 2] != VELOCITY
    return ErrorLayout(layout.columns, layout.seen[others], layout.params[others], layout.rows)


@helper
def directions_seen(x: Array, sensor: Array, n: int, elapsed: float) -> tuple[Array, Array]:
    """Directions of the error in which something unknown has moved a state by one in what a sensor sees.

    Parameters
    ----------
    x, sensor : state (21,) and row of the sensor
    n : length of the error
    elapsed : time within which it happened [s]

    Returns
    -------
    seen : shape (n, s), velocity in n, or turn or shift along n's axes; a velocity with the way since, half of the
        time in the mean
    spread : shape (n, s), sd of that way, since a knock may have come at any time: elapsed / sqrt(12)
    """
    count = 0
    for k in range(3):
        count += sensor[SEES + k] != 0.0
    seen, spread, j = np.zeros((n, count)), np.zeros((n, count)), 0
    frame = int(sensor[SEEN_FRAME])
    for k in range(3):
        if sensor[SEES + k] == 0.0:
            continue
        if frame == SEES_VELOCITY:
            seen[VELOCITY + k, j] = 1.0
            for i in range(3):
                seen[TRANSLATION + i, j] = 0.5 * elapsed * x[3 * k + i]  # column k of R_bn
                spread[TRANSLATION + i, j] = elapsed / math.sqrt(12.0) * x[3 * k + i]
        else:
            begin = 0 if frame == SEES_HEADING else TRANSLATION
            for i in range(3):
                seen[begin + i, j] = x[3 * k + i]
        j += 1
    return seen, spread


@helper
def admit(nis: float, time: float, sensor: Array, since: Array, index: int) -> bool:
    """Whether a measurement lies within its gate; keeps in ``since`` since when its sensor is left out."""
    gate = sensor[GATE]
    if time - since[index] > min(DISTRUSTED_S, sensor[READMIT]):  # never where that is nan
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
def linearize_keyframe(
    x: Array,
    c: Array,
    measured: tuple[Array, Index, Array, Index, Array, float],
    first: Index,
    scratch: Scratch,
    r_out: Array,
    H_out: Array,
) -> None:
    """Whitened innovations and Jacobians of the measurements of a keyframe but those that are `GIVEN`."""
    rows, which, sensors, column, scale, gravity = measured
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    for j in range(len(which)):
        sensor, begin, end = sensors[which[j]], first[j], first[j + 1]
        if sensor[KIND] != GIVEN:
            own, own_r, own_H = scale[j] if len(scale) else NO_SCALE, r_out[begin:end], H_out[begin:end]
            linearize_measurement(R, p, v, b, c, rows[j], sensor, own, gravity, column, scratch, own_r, own_H)


@helper
def widest(S: Array) -> float:
    """The largest variance of a prediction, that of the measurement being 1."""
    most = 0.0
    for a in range(len(S)):
        most = max(most, S[a, a])
    return most


@helper
def relinearize(
    x: Array,
    c: Array,
    P: Array,
    measured: tuple[Array, Index, Array, Index, Array, float],
    first: Index,
    losses: tuple[Index, Array, Array, Array, Array],
    layout: ErrorLayout,
    scratch: Scratch,
    entered: Array,
    r: Array,
    H: Array,
    HP: Array,
    S: Array,
    behind_out: Array,
) -> None:
    """Move a prediction to where its correction leads, and linearise there: the iterated filter (Bell and Cathey 1993).

    P stays the prediction's covariance, about another state. Innovations become those of the prediction, by the new
    Jacobians, and ``behind_out``, shape (size,), the error that leads back to the prediction.

    Parameters
    ----------
    x, c, P, r, H, HP, S : as of `correct_keyframe`, renewed in place; r, H, HP and S without what is left out
    losses : as of `reweight`
    entered : shape (m,), 0 of a measurement that is left out
    """
    n, size, rows = len(P), len(layout.columns), len(layout.rows)
    loss, bend, root, inverse, weight = losses
    coordinates = coordinates_of_velocity(x, P, layout)
    predicted_x, predicted_c, predicted_P = x.copy(), c.copy(), P.copy()
    delta, basis, work = np.empty(n), np.eye(size), make_coordinates_scratch(len(layout.seen), len(c))
    for _ in range(MAX_RELINEARIZATIONS):
        reweight(r, S, first, loss, bend, root, inverse, weight)
        correction(r, HP, root, inverse, delta)
        square = 0.0
        for i in range(size):
            delta[i] += behind_out[i]
            square = max(square, delta[i] * delta[i] / P[i, i])
        if square < STANDS * STANDS:
            return
        R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
        retract(R, p, v, b, c, delta[0:size], coordinates, work, basis)
        there = (predicted_x[0:9].reshape(3, 3), predicted_x[9:12], predicted_x[12:15], predicted_x[15:21], predicted_c)
        local(R, p, v, b, c, there, coordinates, work, behind_out, basis)
        P[:] = predicted_P
        change_basis(P, basis, layout.rows, np.empty((rows, n)), np.empty((rows, size + 1), np.int64))
        r[:] = 0.0
        H[:] = 0.0
        linearize_keyframe(x, c, measured, first, scratch, r, H)
        for a in range(len(r)):
            for i in range(size):
                r[a] -= H[a, i] * behind_out[i]
        innovation_covariance(P, H, HP, S)
        for j in range(len(entered)):
            if entered[j] == 0.0:
                leave_out(r, H, HP, S, first[j], first[j + 1])


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
    for j in range(m):
        sensor, begin, end = sensors[which[j]], first[j], first[j + 1]
        loss[j], bend[j] = int(sensor[LOSS]), sensor[BEND]
        if sensor[KIND] == GIVEN:
            for a in range(begin, end):
                r[a] = given_r[taken]
                for i in range(given_H.shape[1]):
                    H[a, i] = given_H[taken, i]
                taken += 1
    measured = (rows, which, sensors, column, scale, gravity)
    linearize_keyframe(x, c, measured, first, scratch, r, H)
    innovation_covariance(P, H, HP, S)
    entered = False
    for j in range(m):
        sensor, begin, end = sensors[which[j]], first[j], first[j + 1]
        nis_out[j] = normalised_squared(S, r, begin, end)
        weight_out[j] = 1.0
        if gated and not admit(nis_out[j], rows[j, TIME], sensor, since, which[j]):
            weight_out[j] = 0.0
            elapsed = rows[j, TIME] - since[which[j]]
            if elapsed > sensor[READMIT]:
                seen, spread = directions_seen(x, sensor, n, elapsed)
                inflate(P, r, H, begin, end, seen, spread)
                innovation_covariance(P, H, HP, S)
            leave_out(r, H, HP, S, begin, end)
        else:
            entered = True
    if not entered:
        return
    root, inverse, weight, delta = np.empty(first[m]), np.empty_like(S), np.empty(m), np.empty(n)
    behind = np.zeros(len(layout.columns))
    if taken == 0 and widest(S) > WIDE * WIDE:
        losses = (loss, bend, root, inverse, weight)
        relinearize(x, c, P, measured, first, losses, layout, scratch, weight_out, r, H, HP, S, behind)
    reweight(r, S, first, loss, bend, root, inverse, weight)
    joseph(P, r, H, HP, root, inverse, delta)
    for i in range(len(behind)):
        delta[i] += behind[i]
    for j in range(m):
        weight_out[j] *= weight[j]
    move(x, c, P, delta, coordinates_of_velocity(x, P, layout))
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
