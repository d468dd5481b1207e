"""The filter's correction at one keyframe: linearise, gate, update, move.

    r = W (z - h(x)),  H = W dh/dx                    whitened innovation of each measurement, at its own time
    NIS = r' (H P H' + I)^-1 r                        beyond gate^2 it is left out
    dx, P                                             `rovgraph.kernels.robust_update`
    x <- x + dx, P <- B P B'                          `rovgraph.kernels.error_coordinates`

Which measurements enter, and what a sensor does that was left out for long, is in `rovgraph.kernels.admission`.
"""

from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.admission import admit, directions_seen
from rovgraph.kernels.change_of_basis import change_basis, turn_rows
from rovgraph.kernels.compile import helper
from rovgraph.kernels.error_coordinates import local, retract
from rovgraph.kernels.error_coordinates import make_scratch as make_coordinates_scratch
from rovgraph.kernels.filter_state import FilterModel, FilterState
from rovgraph.kernels.linearization import Scratch, linearize_measurement, make_scratch, pick
from rovgraph.kernels.measurement_row import BEND, DIM, GIVEN, KIND, LOSS, READMIT, TIME, MeasuredRows
from rovgraph.kernels.moves import move
from rovgraph.kernels.robust_update import (
    Innovations,
    Weights,
    correction,
    inflate,
    innovation_covariance,
    joseph,
    leave_out,
    normalised_squared,
    reweight,
)
from rovgraph.kernels.states import epoch_in
from rovgraph.kernels.velocity_coordinates import coordinates_of_velocity

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
    known: FilterState, measured: MeasuredRows, model: FilterModel, scratch: Scratch, found: Innovations
) -> None:
    """Whitened innovations and Jacobians of the measurements of a keyframe but those that are `GIVEN`.

    Columns of what is considered, behind those of what is estimated, are multiplied by L.
    """
    which = measured.which
    L, sensors, estimated = known.L, model.sensors, len(model.layout.columns)
    first, r_out, H_out, H_y_out = found.first, found.r, found.H, found.H_y
    wide = np.zeros((len(r_out), estimated + len(L))) if len(L) else H_out
    state = epoch_in(known.x, known.c)
    for j in range(len(which)):
        begin, end = first[j], first[j + 1]
        if sensors[which[j], KIND] != GIVEN:
            one = pick(measured, j, sensors, scratch)
            linearize_measurement(state, one, model.gravity, scratch, r_out[begin:end], wide[begin:end])
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
    known: FilterState,
    measured: MeasuredRows,
    model: FilterModel,
    entered: Array,
    found: Innovations,
    weights: Weights,
    scratch: Scratch,
    behind_out: Array,
) -> None:
    """Move a prediction to where its correction leads, and linearise there: the iterated filter (Bell and Cathey 1993).

    P stays the prediction's covariance, about another state. Innovations become those of the prediction, by the new
    Jacobians, and ``behind_out``, shape (size,), the error that leads back to the prediction.

    Parameters
    ----------
    known, found : renewed in place; the innovations without what is left out
    entered : shape (m,), 0 of a measurement that is left out
    """
    x, c, P, B, L = known
    r, H, layout = found.r, found.H, model.layout
    n, size, rows = len(P), len(layout.columns), len(layout.rows)
    coordinates = coordinates_of_velocity(x, P, layout)
    predicted_x, predicted_c, predicted_P, predicted_B = x.copy(), c.copy(), P.copy(), B.copy()
    delta, basis, work = np.empty(n), np.eye(size), make_coordinates_scratch(len(layout.seen), len(c))
    state, predicted = epoch_in(x, c), epoch_in(predicted_x, predicted_c)
    for _ in range(MAX_RELINEARIZATIONS):
        reweight(found, weights)
        correction(found, weights, delta)
        square = 0.0
        for i in range(size):
            delta[i] += behind_out[i]
            square = max(square, delta[i] * delta[i] / P[i, i])
        if square < STANDS * STANDS:
            return
        retract(state, delta[0:size], coordinates, work, basis)
        local(state, predicted, coordinates, work, behind_out, basis)
        for i in range(n):
            for k in range(n):
                P[i, k] = predicted_P[i, k]
            for k in range(len(L)):
                B[i, k] = predicted_B[i, k]
        change_basis(P, basis, layout.rows, np.empty((rows, n)), np.empty((rows, size + 1), np.int64))
        turn_rows(B, basis, layout.rows, np.empty((rows, len(L))))
        r.fill(0.0)
        H.fill(0.0)
        linearize_keyframe(known, measured, model, scratch, found)
        for a in range(len(r)):
            for i in range(size):
                r[a] -= H[a, i] * behind_out[i]
        innovation_covariance(P, found)
        for j in range(len(entered)):
            if entered[j] == 0.0:
                leave_out(found, j)


class GivenRows(NamedTuple):
    """Whitened rows of k measurements of kind `GIVEN`, shapes (k,), (k, n); what is considered comes last."""

    r: Array
    H: Array


class Corrected(NamedTuple):
    """What `correct` writes.

    Attributes
    ----------
    nis, weight : shape (m,), of the measurements; weight 0 = left out
    places : correction of the places
    """

    nis: Array
    weight: Array
    places: Array


@helper
def correct(
    known: FilterState,
    measured: MeasuredRows,
    given: GivenRows,
    model: FilterModel,
    since: Array,
    gated: bool,
    out: Corrected,
) -> int:
    """Correct a keyframe by m measurements, in place.

    Parameters
    ----------
    since : shape (s,), since when each sensor is left out, nan where it is not [s]
    gated : False lets everything in

    Returns
    -------
    How many rows of ``given`` were taken
    """
    x, P, B, L = known.x, known.P, known.B, known.L
    rows, which, sensors, layout = measured.rows, measured.which, model.sensors, model.layout
    nis_out, weight_out, places_out = out
    m, n = len(which), len(P)
    first = np.zeros(m + 1, np.int64)
    for j in range(m):
        first[j + 1] = first[j] + int(sensors[which[j], DIM])
    r, H, H_y = np.zeros(first[m]), np.zeros((first[m], n)), np.zeros((first[m], len(L)))
    S = np.empty((first[m], first[m]))
    found = Innovations(first, r, H, H_y, np.empty((first[m], n)), S)
    loss, bend, taken, scratch = np.empty(m, np.int64), np.empty(m), 0, make_scratch(len(known.c), model.column)
    for j in range(m):
        sensor = sensors[which[j]]
        loss[j], bend[j] = int(sensor[LOSS]), sensor[BEND]
        if sensor[KIND] == GIVEN:
            for a in range(first[j], first[j + 1]):
                r[a] = given.r[taken]
                split(given.H[taken], L, H[a, : given.H.shape[1] - len(L)], H_y[a])
                taken += 1
    linearize_keyframe(known, measured, model, scratch, found)
    innovation_covariance(P, found)
    entered = False
    for j in range(m):
        sensor = sensors[which[j]]
        nis_out[j] = normalised_squared(S, r, first[j], first[j + 1])
        weight_out[j] = 1.0
        if gated and not admit(nis_out[j], rows[j, TIME], sensor, since, which[j]):
            weight_out[j] = 0.0
            elapsed = rows[j, TIME] - since[which[j]]
            if elapsed > sensor[READMIT]:
                directions, spread = directions_seen(x, sensor, n, elapsed)
                inflate(P, found, j, directions, spread)
                innovation_covariance(P, found)
            leave_out(found, j)
        else:
            entered = True
    if not entered:
        return taken
    delta, behind = np.empty(n), np.zeros(len(layout.columns))
    weights = Weights(loss, bend, np.empty(m), np.empty(first[m]), np.empty_like(S))
    if taken == 0 and widest(S) > WIDE * WIDE:
        relinearize(known, measured, model, weight_out, found, weights, scratch, behind)
    reweight(found, weights)
    joseph(P, B, found, weights, delta)
    for i in range(len(behind)):
        delta[i] += behind[i]
    for j in range(m):
        weight_out[j] *= weights.weight[j]
    move(known, delta, coordinates_of_velocity(x, P, layout))
    for i in range(len(places_out)):
        places_out[i] = delta[n - len(places_out) + i]
    return taken
