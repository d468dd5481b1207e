"""The filter's correction at one keyframe: linearise, gate, update, move.

    r = W (z - h(x)),  H = W dh/dx                    whitened innovation of each measurement, at its own time
    NIS = r' (H P H' + I)^-1 r                        beyond gate^2 it is left out
    dx, P                                             `rovgraph.kernels.robust_update`
    x <- x + dx, P <- B P B'                          `rovgraph.kernels.error_coordinates`

Which measurements enter, and what a sensor does that was left out for long, is in `rovgraph.kernels.admission`.
"""

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.admission import admit, directions_seen
from rovgraph.kernels.change_of_basis import change_basis, turn_rows
from rovgraph.kernels.compile import helper, kernel
from rovgraph.kernels.error_coordinates import ErrorLayout, local, retract
from rovgraph.kernels.error_coordinates import make_scratch as make_coordinates_scratch
from rovgraph.kernels.linearization import Scratch, linearize_measurement, make_scratch
from rovgraph.kernels.measurement_row import BEND, DIM, GIVEN, KIND, LOSS, READMIT, TIME
from rovgraph.kernels.moves import move
from rovgraph.kernels.robust_update import (
    correction,
    inflate,
    innovation_covariance,
    joseph,
    leave_out,
    normalised_squared,
    reweight,
)
from rovgraph.kernels.velocity_coordinates import coordinates_of_velocity

Index = NDArray[np.int64]

CORRECT = (
    "void(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[::1], f8[:, ::1], i8[::1], "
    "f8[:, :, ::1], f8[::1], f8[:, ::1], i8[::1], i8[:, ::1], f8[:, ::1], i8[::1], f8[::1], b1, f8, f8[::1], "
    "f8[::1], f8[::1])"
)  # signature of `correct`

WIDE = 30.0  # sd of a prediction, in those of its measurement, from which it is corrected by iterations
MAX_RELINEARIZATIONS = 5
STANDS = 0.1  # a correction within as many sd needs no other point to linearise at


@helper
def split(row: Array, L: Array, H_out: Array, H_y_out: Array) -> None:
    """A row of a Jacobian, what is considered last: its columns, and those of the others."""
    h, n = len(L), len(row) - len(L)
    for i in range(len(H_out)):
        H_out[i] = row[i]
    for k in range(h):
        H_y_out[k] = 0.0
        for j in range(h):
            H_y_out[k] += row[n + j] * L[j, k]


@helper
def linearize_keyframe(
    x: Array,
    c: Array,
    measured: tuple[Array, Index, Array, Array, float, int],
    first: Index,
    scratch: Scratch,
    r_out: Array,
    H_out: Array,
    H_y_out: Array,
    L: Array,
) -> None:
    """Whitened innovations and Jacobians of the measurements of a keyframe but those that are `GIVEN`.

    Columns of what is considered, behind the ``estimated`` ones, are multiplied by L.
    """
    rows, which, sensors, scale, gravity, estimated = measured
    wide = np.zeros((len(r_out), estimated + len(L))) if len(L) else H_out
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    for j in range(len(which)):
        sensor, begin, end = sensors[which[j]], first[j], first[j + 1]
        if sensor[KIND] != GIVEN:
            own, own_r, own_H = scale[j] if len(scale) else scratch.exact, r_out[begin:end], wide[begin:end]
            linearize_measurement(R, p, v, b, c, rows[j], sensor, own, gravity, scratch, own_r, own_H)
            if len(L):
                for a in range(begin, end):
                    split(wide[a], L, H_out[a, :estimated], H_y_out[a])


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
    B: Array,
    L: Array,
    measured: tuple[Array, Index, Array, Array, float, int],
    first: Index,
    losses: tuple[Index, Array, Array, Array, Array],
    layout: ErrorLayout,
    scratch: Scratch,
    entered: Array,
    r: Array,
    H: Array,
    H_y: Array,
    HP: Array,
    S: Array,
    behind_out: Array,
) -> None:
    """Move a prediction to where its correction leads, and linearise there: the iterated filter (Bell and Cathey 1993).

    P stays the prediction's covariance, about another state. Innovations become those of the prediction, by the new
    Jacobians, and ``behind_out``, shape (size,), the error that leads back to the prediction.

    Parameters
    ----------
    x, c, P, B, r, H, H_y, HP, S : as of `correct`, renewed in place; from r on without what is left out
    losses : as of `reweight`
    entered : shape (m,), 0 of a measurement that is left out
    """
    n, size, rows = len(P), len(layout.columns), len(layout.rows)
    loss, bend, root, inverse, weight = losses
    coordinates = coordinates_of_velocity(x, P, layout)
    predicted_x, predicted_c, predicted_P, predicted_B = x.copy(), c.copy(), P.copy(), B.copy()
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
        for i in range(n):
            for k in range(n):
                P[i, k] = predicted_P[i, k]
            for k in range(len(L)):
                B[i, k] = predicted_B[i, k]
        change_basis(P, basis, layout.rows, np.empty((rows, n)), np.empty((rows, size + 1), np.int64))
        turn_rows(B, basis, layout.rows, np.empty((rows, len(L))))
        r.fill(0.0)
        H.fill(0.0)
        linearize_keyframe(x, c, measured, first, scratch, r, H, H_y, L)
        for a in range(len(r)):
            for i in range(size):
                r[a] -= H[a, i] * behind_out[i]
        innovation_covariance(P, H, HP, S)
        for j in range(len(entered)):
            if entered[j] == 0.0:
                leave_out(r, H, H_y, HP, S, first[j], first[j + 1])


@kernel(CORRECT, by_address=True)
def correct(
    x: Array,
    c: Array,
    P: Array,
    B: Array,
    L: Array,
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
    x, c, P, B : state (21,), calibration vector, and of `rovgraph.kernels.robust_update`; places that are remembered
        come last in P
    L : shape (h, h), root of the covariance of what is considered
    rows, which : shapes (m, ROW), (m,), the measurements and the sensor that each is of
    sensors : shape (s, PARAMS + ...), of `rovgraph.kernels.measurement_row`
    column : shape (15 + C,), place of each component in the error, -1 where it has none; what is considered comes last
    scale : shape (m, 6, 6), bias by the IMU's scales, or (0, 6, 6)
    given_r, given_H : whitened rows of the measurements of kind `GIVEN`, in their order; what is considered comes last
    columns to basis_rows : the error's `rovgraph.kernels.error_coordinates.ErrorLayout`
    since : shape (s,), since when each sensor is left out, nan where it is not [s]
    gated : False lets everything in
    gravity : [m/s^2]
    nis_out, weight_out : shape (m,); weight 0 = left out
    places_out : correction of the places
    """
    m, n, layout = len(which), len(P), ErrorLayout(columns, seen, seen_params, basis_rows)
    first = np.zeros(m + 1, np.int64)
    for j in range(m):
        first[j + 1] = first[j] + int(sensors[which[j], DIM])
    r, H, H_y = np.zeros(first[m]), np.zeros((first[m], n)), np.zeros((first[m], len(L)))
    HP, S = np.empty((first[m], n)), np.empty((first[m], first[m]))
    loss, bend, taken, scratch = np.empty(m, np.int64), np.empty(m), 0, make_scratch(len(c), column)
    for j in range(m):
        sensor, begin, end = sensors[which[j]], first[j], first[j + 1]
        loss[j], bend[j] = int(sensor[LOSS]), sensor[BEND]
        if sensor[KIND] == GIVEN:
            for a in range(begin, end):
                r[a] = given_r[taken]
                split(given_H[taken], L, H[a, : given_H.shape[1] - len(L)], H_y[a])
                taken += 1
    measured = (rows, which, sensors, scale, gravity, len(columns))
    linearize_keyframe(x, c, measured, first, scratch, r, H, H_y, L)
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
                directions, spread = directions_seen(x, sensor, n, elapsed)
                inflate(P, r, H, begin, end, directions, spread)
                innovation_covariance(P, H, HP, S)
            leave_out(r, H, H_y, HP, S, begin, end)
        else:
            entered = True
    if not entered:
        return
    root, inverse, weight, delta = np.empty(first[m]), np.empty_like(S), np.empty(m), np.empty(n)
    behind = np.zeros(len(layout.columns))
    if taken == 0 and widest(S) > WIDE * WIDE:
        losses = (loss, bend, root, inverse, weight)
        relinearize(x, c, P, B, L, measured, first, losses, layout, scratch, weight_out, r, H, H_y, HP, S, behind)
    reweight(r, S, first, loss, bend, root, inverse, weight)
    joseph(P, B, r, H, H_y, HP, root, inverse, delta)
    for i in range(len(behind)):
        delta[i] += behind[i]
    for j in range(m):
        weight_out[j] *= weight[j]
    move(x, c, P, B, delta, coordinates_of_velocity(x, P, layout))
    for i in range(len(places_out)):
        places_out[i] = delta[n - len(places_out) + i]
