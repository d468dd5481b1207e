"""The filter's correction at one keyframe: linearise, gate, update, move.

    r = W (z - h(x)),  H = W dh/dx                    whitened innovation of each measurement, at its own time
    NIS = r' (H P H' + I)^-1 r                        beyond gate^2 it is left out
    dx, P                                             the update below
    x <- x + dx, P <- B P B'                          `rovgraph.kernels.error_coordinates`

Gates. A sensor that was left out for longer than `DISTRUSTED_S` returns only within `RETURN_SD` of the prediction,
whose uncertainty grows without it. After more than its `READMIT` the sensor is taken to measure a motion that no model
has, but for one beam of a DVL whose others agree. The covariance of what it observes is inflated: of velocity along the
axes, n's or the body's, along which it is known better.

Update. Innovations r and Jacobians H are whitened, so their noise is I. With S = H P H' and W the weights of the
losses,

    d = P H' W^1/2 (W^1/2 S W^1/2 + I)^-1 W^1/2 r,   w_j = rho'(|e_j|) / |e_j|,   e = r - H d

are iterated (Huber 1964; Zhang 1997): weights follow from the residuals after the update, as in the smoother's
cost, not from the innovations, which a wide prior makes large. The covariance is Joseph's,
P <- (I - K H) P (I - K H)' + K K', multiplied out so that it costs products of rank m only.

What multiplies the DVL's velocity is linearised between prediction and correction (`draw_no_scale`).

A considered variable is uncertain and never corrected, nor does it move a gain or a gate. Its part of the estimate's
error is B y, y white and of unit variance, so that the covariance of the estimate is P + B B'. With H_y the Jacobian by
y,

    B <- B - K (H B + H_y)                                              the covariance analysis of Schmidt (1966)

Shapes: P (n, n), B (n, h).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper
from rovgraph.kernels.error_coordinates import ErrorColumns, change_basis, local, retract, turn_rows
from rovgraph.kernels.error_coordinates import make_scratch as make_coordinates_scratch
from rovgraph.kernels.filter_state import FilterModel, FilterState, retract_with_covariance
from rovgraph.kernels.layout import DVL_ERROR, DVL_SCALE, MOTION, TRANSLATION, VELOCITY
from rovgraph.kernels.linearization import LinearizationScratch, linearize_measurement, make_scratch, pick
from rovgraph.kernels.measurement_row import (
    DIM,
    GAIN,
    GATE,
    KIND,
    LOSS,
    LOSS_THRESHOLD,
    PRELINEARISED,
    RATE_SD,
    READMIT,
    SD,
    SEEN_FRAME,
    SEES,
    SEES_HEADING,
    SEES_VELOCITY,
    TIME,
    MeasuredRows,
)
from rovgraph.kernels.measurements import DVL, DVL_BEAM, DVL_WATER, WATER_LAYER
from rovgraph.kernels.states import epoch_in
from rovgraph.kernels.weighting import loss_weight

DISTRUSTED_S = 2.0  # of being left out after which a sensor may be wrong for longer than single measurements [s]
RETURN_SD = 3.0  # a sensor that was left out for long returns with an innovation within this many sd


@helper
def observed_directions(x: Array, sensor: Array, n: int, elapsed: float) -> tuple[Array, Array]:
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


Lines = NDArray[np.int64]

MAX_REWEIGHTINGS = 20
SETTLED = 1e-3  # change of a weight
RIDGE = 1e-12  # of the trace, that keeps least squares of what a sensor hardly sees solvable


class Innovations(NamedTuple):
    """Whitened innovations of k measurements, m rows in all.

    Attributes
    ----------
    first : shape (k + 1,), the row where each measurement begins
    r, H, H_y : shapes (m,), (m, n), (m, h), innovations and their Jacobians by the error and by y
    HP, S : shapes (m, n), (m, m), H P and H P H'
    """

    first: Lines
    r: Array
    H: Array
    H_y: Array
    HP: Array
    S: Array


class Weights(NamedTuple):
    """Weights of k measurements, and what they follow from.

    Attributes
    ----------
    loss, bend : shape (k,), of each measurement, of `rovgraph.kernels.weighting`
    weight : shape (k,), of each measurement
    root : shape (m,), square roots of the rows' weights
    inverse : shape (m, m), (W^1/2 S W^1/2 + I)^-1
    """

    loss: Lines
    bend: Array
    weight: Array
    root: Array
    inverse: Array


@helper
def innovation_covariance(P: Array, found: Innovations) -> None:
    """H P and S = H P H'."""
    H, HP_out, S_out = found.H, found.HP, found.S
    m, n = H.shape
    HP_out.fill(0.0)
    for a in range(m):
        for j in range(n):
            h = H[a, j]
            if h != 0.0:
                for i in range(n):
                    HP_out[a, i] += h * P[j, i]
    for a in range(m):
        for b in range(a + 1):
            total = 0.0
            for j in range(n):
                total += H[b, j] * HP_out[a, j]
            S_out[a, b] = S_out[b, a] = total


@helper
def cholesky(A: Array, L_out: Array) -> bool:
    """L with L L' = A, lower triangular; False where A is not positive definite."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L_out[i, k] * L_out[j, k]
            if j < i:
                L_out[i, j] = total / L_out[j, j]
            elif total > 0.0:
                L_out[i, i] = math.sqrt(total)
            else:
                return False
    return True


@helper
def solve_cholesky(L: Array, x: Array) -> None:
    """(L L')^-1 x, in place."""
    n = L.shape[0]
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


@helper
def normalised_squared(S: Array, r: Array, begin: int, end: int) -> float:
    """r' (S + I)^-1 r of rows ``begin`` to ``end``: the normalised innovation squared (NIS)."""
    if end == begin + 1:
        nis: float = r[begin] * r[begin] / (S[begin, begin] + 1.0)
        return nis
    n = end - begin
    A, x = np.empty((n, n)), np.empty(n)
    for i in range(n):
        x[i] = r[begin + i]
        for j in range(n):
            A[i, j] = S[begin + i, begin + j]
        A[i, i] += 1.0
    L = np.empty_like(A)
    cholesky(A, L)
    solve_cholesky(L, x)
    total = 0.0
    for i in range(n):
        total += r[begin + i] * x[i]
    return total


@helper
def leave_out(found: Innovations, j: int) -> None:
    """Make nothing of the rows of measurement ``j``."""
    r, H, H_y, HP, S = found.r, found.H, found.H_y, found.HP, found.S
    for a in range(found.first[j], found.first[j + 1]):
        r[a] = 0.0
        H[a].fill(0.0)
        H_y[a].fill(0.0)
        HP[a].fill(0.0)
        for b in range(len(r)):
            S[a, b] = S[b, a] = 0.0


@helper
def inflate(P: Array, found: Innovations, measurement: int, seen: Array, spread: Array) -> None:
    """Inflate the covariance of what a sensor measures, as if moved by something that no model has.

    As a knock does to velocity and position: P += |x|^2 (seen seen' + spread spread'), x the least squares solution
    of H seen x = r. The directions ``seen``, shape (n, s), are those of the error that the sensor measures, with what
    has followed from it; ``spread``, shape (n, s), is how far that is uncertain. H P and S are out of date after it.
    """
    n, s = seen.shape
    r, H, A, x = found.r, found.H, np.zeros((s, s)), np.zeros(s)
    row = np.empty(s)
    for a in range(found.first[measurement], found.first[measurement + 1]):
        for j in range(s):
            row[j] = 0.0
            for i in range(n):
                row[j] += H[a, i] * seen[i, j]
        for j in range(s):
            x[j] += row[j] * r[a]
            for k in range(s):
                A[j, k] += row[j] * row[k]
    trace = 0.0
    for j in range(s):
        trace += A[j, j]
    for j in range(s):
        A[j, j] += RIDGE * trace
    L = np.empty_like(A)
    if not cholesky(A, L):
        return
    solve_cholesky(L, x)
    square = 0.0
    for j in range(s):
        square += x[j] * x[j]
    for i in range(n):
        for k in range(n):
            for j in range(s):
                P[i, k] += square * (seen[i, j] * seen[k, j] + spread[i, j] * spread[k, j])


@helper
def reweight(found: Innovations, weights: Weights) -> None:
    """Iterate the weights until they rest."""
    first, r, S, loss, bend = found.first, found.r, found.S, weights.loss, weights.bend
    weight_out, root_out, inverse_out = weights.weight, weights.root, weights.inverse
    k, m = len(weight_out), len(r)
    A, L, gain = np.empty((m, m)), np.empty((m, m)), np.empty(m)
    weight_out.fill(1.0)
    root_out.fill(1.0)
    for _ in range(MAX_REWEIGHTINGS):
        for a in range(m):
            for b in range(m):
                A[a, b] = root_out[a] * S[a, b] * root_out[b]
            A[a, a] += 1.0
        cholesky(A, L)
        for a in range(m):
            gain[a] = root_out[a] * r[a]
        solve_cholesky(L, gain)
        for a in range(m):
            gain[a] *= root_out[a]
        change = 0.0
        for j in range(k):
            square = 0.0
            for a in range(first[j], first[j + 1]):
                residual = r[a]
                for b in range(m):
                    residual -= S[a, b] * gain[b]
                square += residual * residual
            weight = loss_weight(square, loss[j], bend[j])
            change = max(change, abs(weight - weight_out[j]))
            weight_out[j] = weight
        if change < SETTLED:
            break
        for j in range(k):
            for a in range(first[j], first[j + 1]):
                root_out[a] = math.sqrt(weight_out[j])
    inverse_out.fill(0.0)
    for a in range(m):
        inverse_out[a, a] = 1.0
        solve_cholesky(L, inverse_out[a])  # symmetric: a row is a column


@helper
def correction(found: Innovations, weights: Weights, delta_out: Array) -> None:
    """The correction by itself: d = P H' W^1/2 (W^1/2 S W^1/2 + I)^-1 W^1/2 r."""
    r, HP, root, inverse = found.r, found.HP, weights.root, weights.inverse
    delta_out.fill(0.0)
    for a in range(len(r)):
        share = 0.0
        for b in range(len(r)):
            share += inverse[a, b] * root[b] * r[b]
        for i in range(len(delta_out)):
            delta_out[i] += HP[a, i] * root[a] * share


@helper
def joseph(P: Array, B: Array, found: Innovations, weights: Weights, delta_out: Array) -> None:
    """The correction, and P and B after it in place; HP and H become W^1/2 times what they were."""
    r, H, H_y, HP, root, inverse = found.r, found.H, found.H_y, found.HP, weights.root, weights.inverse
    m, n = HP.shape
    Kt, HA = np.zeros((m, n)), np.zeros((m, n))  # K', and H times the transpose of A = (I - K H) P
    for a in range(m):
        for i in range(n):
            HP[a, i] *= root[a]
            H[a, i] *= root[a]
    delta_out.fill(0.0)
    for a in range(m):
        for b in range(m):
            share = inverse[a, b]
            for i in range(n):
                Kt[a, i] += share * HP[b, i]
        for i in range(n):
            delta_out[i] += Kt[a, i] * root[a] * r[a]
    for k in range(B.shape[1]):
        for a in range(m):
            off = root[a] * H_y[a, k]
            for i in range(n):
                off += H[a, i] * B[i, k]
            HA[a, 0] = off
        for i in range(n):
            for a in range(m):
                B[i, k] -= Kt[a, i] * HA[a, 0]
    HA.fill(0.0)
    for i in range(n):  # P <- A'
        for a in range(m):
            share = HP[a, i]
            for j in range(n):
                P[i, j] -= share * Kt[a, j]
    for a in range(m):
        for i in range(n):
            h = H[a, i]
            if h != 0.0:
                for j in range(n):
                    HA[a, j] += h * P[i, j]
        for j in range(n):
            HA[a, j] = Kt[a, j] - HA[a, j]
    for i in range(n):  # A (I - K H)' + K K'
        for a in range(m):
            share = Kt[a, i]
            for j in range(n):
                P[i, j] += share * HA[a, j]
    for i in range(n):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])


@helper
def determinant(A: Array) -> float:
    """Of a matrix of shape (3, 3)."""
    total = 0.0
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        total += A[0, i] * (A[1, j] * A[2, k] - A[1, k] * A[2, j])
    return total


@helper
def coordinates_of_velocity(x: Array, P: Array, layout: ErrorColumns) -> ErrorColumns:
    """The layout in which velocity moves along the axes, n's or the body's, along which it is known better.

    A DVL measures it along the body's, where a correction of heading must not change it. In an outage of the DVL
    only depth measures velocity, along n: moved along the body's axes, a correction of tilt by 0.3 degrees would make
    15 mm/s downwards of a velocity that is 3 m/s off, and depth would seem to determine all of the velocity.
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
    return ErrorColumns(layout.columns, layout.seen[others], layout.params[others], layout.rows)


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
    known: FilterState, measured: MeasuredRows, model: FilterModel, scratch: LinearizationScratch, found: Innovations
) -> None:
    """Whitened innovations and Jacobians of the measurements of a keyframe but those that are `PRELINEARISED`.

    Columns of what is considered, behind those of what is estimated, are multiplied by L.
    """
    which = measured.which
    L, sensors, estimated = known.L, model.sensors, len(model.layout.columns)
    first, r_out, H_out, H_y_out = found.first, found.r, found.H, found.H_y
    wide = np.zeros((len(r_out), estimated + len(L))) if len(L) else H_out
    state = epoch_in(known.x, known.c)
    for j in range(len(which)):
        begin, end = first[j], first[j + 1]
        if sensors[which[j], KIND] != PRELINEARISED:
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
    scratch: LinearizationScratch,
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
    """Whitened rows of k measurements of kind `PRELINEARISED`, shapes (k,), (k, n); what is considered comes last."""

    r: Array
    H: Array


class Corrected(NamedTuple):
    """Output of `correct`.

    Attributes
    ----------
    nis, weight : shape (m,), of the measurements; weight 0 = left out
    places : correction of the places
    """

    nis: Array
    weight: Array
    places: Array


@helper
def _one_beam_disagrees(measured: MeasuredRows, sensors: Array, found: Innovations) -> bool:
    """Whether one beam of a DVL lies beyond its gate and two or more within: it is the beam, and not the motion."""
    out, fit = 0, 0
    for j in range(len(measured.which)):
        sensor = sensors[measured.which[j]]
        if sensor[KIND] == DVL_BEAM:
            within = normalised_squared(found.S, found.r, found.first[j], found.first[j + 1]) <= sensor[GATE] ** 2
            out, fit = out + (not within), fit + within
    return out == 1 and fit > 1


@helper
def draw_no_scale(P: Array, measured: MeasuredRows, model: FilterModel, found: Innovations) -> None:
    """Linearise what multiplies the DVL's velocity, its scale and its lasting error, where noise does not draw it.

    The derivative by a scale is the velocity. The predicted one has errors in it that the innovation has, too: those
    that the IMU's noise has brought into the prediction, and the rate's times the arm. Scales would be drawn down with
    every ping (errors in variables). Of the whitened variance S + 1 of an innovation, c S is the IMU's and E the
    rate's. In a steady state the derivative

        H + (c S + E (1 + (1 - c) S)) / (S + 1) r

    makes the expected sum over all pings vanish, what each does to later ones counted. c is 1 / 2n in a filter of what
    noise is integrated to n times: down, once from the accelerometer's; along the other axes twice, from the gyro's by
    way of tilt. ``found`` is renewed in place.
    """
    r, H, S, estimated = found.r, found.H, found.S, found.H.shape[1]
    scales = model.column[MOTION + DVL_SCALE], model.column[MOTION + DVL_ERROR]
    if not (0 <= scales[0] < estimated or 0 <= scales[1] < estimated):
        return
    for j in range(len(measured.which)):
        row, sensor, begin = measured.rows[j], model.sensors[measured.which[j]], found.first[j]
        if sensor[KIND] in (DVL, DVL_WATER, DVL_BEAM, WATER_LAYER):
            for a in range(begin, found.first[j + 1]):
                by_rate = sensor[GAIN + 4 * (a - begin)] * row[RATE_SD] * row[RATE_SD]
                of_rate = by_rate / (by_rate + row[SD + a - begin] * row[SD + a - begin])
                down, north, east = H[a, VELOCITY + 2] ** 2, H[a, VELOCITY] ** 2, H[a, VELOCITY + 1] ** 2
                c = 0.25 + 0.25 * down / (down + north + east + 1e-300)
                for i in scales:
                    if 0 <= i < estimated and H[a, i] != 0.0:
                        H[a, i] += (c * S[a, a] + of_rate * (1.0 + (1.0 - c) * S[a, a])) / (S[a, a] + 1.0) * r[a]
    innovation_covariance(P, found)


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
        loss[j], bend[j] = int(sensor[LOSS]), sensor[LOSS_THRESHOLD]
        if sensor[KIND] == PRELINEARISED:
            for a in range(first[j], first[j + 1]):
                r[a] = given.r[taken]
                split(given.H[taken], L, H[a, : given.H.shape[1] - len(L)], H_y[a])
                taken += 1
    linearize_keyframe(known, measured, model, scratch, found)
    innovation_covariance(P, found)
    entered, alone = False, _one_beam_disagrees(measured, sensors, found)
    for j in range(m):
        sensor = sensors[which[j]]
        nis_out[j] = normalised_squared(S, r, first[j], first[j + 1])
        weight_out[j] = 1.0
        if gated and not admit(nis_out[j], rows[j, TIME], sensor, since, which[j]):
            weight_out[j] = 0.0
            elapsed = rows[j, TIME] - since[which[j]]
            if elapsed > sensor[READMIT] and not (alone and sensor[KIND] == DVL_BEAM):
                directions, spread = observed_directions(x, sensor, n, elapsed)
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
    draw_no_scale(P, measured, model, found)
    reweight(found, weights)
    joseph(P, B, found, weights, delta)
    for i in range(len(behind)):
        delta[i] += behind[i]
    for j in range(m):
        weight_out[j] *= weights.weight[j]
    retract_with_covariance(known, delta, coordinates_of_velocity(x, P, layout))
    for i in range(len(places_out)):
        places_out[i] = delta[n - len(places_out) + i]
    return taken
