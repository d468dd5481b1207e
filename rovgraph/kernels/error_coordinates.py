"""The error of a state in coordinates in which measurements are linear, and how it moves from state to state.

A Kalman filter linearises at an estimate which it then corrects. Measured in coordinates that turn with the
correction, its covariance becomes too small: corrections of heading, misalignment and hard iron count as information
(Huang, Mourikis and Roumeliotis 2010). An invariant filter chooses coordinates that stay (Barrau and Bonnabel 2017).
Here these are attitude and position in n, and for one variable of each instrument the error of what that instrument
measures: of velocity along the DVL's axes, of hard iron as the field along the magnetometer's axes, of a compass offset
as the heading it shows, of a current as the water's velocity along the vehicle's axes, which drag shows. A measurement
is linear in them whatever heading and mounting are, so correcting one adds no information about those.

The error vector is that of `rovgraph.kernels.layout`, of the calibration only what is estimated. From a state x to
another x', attitude and position in n stay as they are, and of each instrument s one variable y_s moves so that
the measured value z_s = h_s(x) moves by its Jacobian H_s at x:

    x' = x + d, R' = R Exp(d_R), p' = p + R d_p, then for each s:  y_s' += Y'^-1 (h_s(x) + H_s d - h_s(x'))

with Y the columns of H_s for y_s. The change of basis B takes an error about x over to x'. Of its rows only those
of the pose and of each y_s differ from the unit matrix:

    B_R = B_p = R'^T R,    H_s' B = H_s,  so  B_s = Y'^-1 (H_s - (H_s' without Y') B)

An instrument observes one variable y_s and depends on no other of these. `rovgraph.inference.filter` lists them.

The change of basis P <- B P B' uses that few rows of B differ from the unit matrix. With T = B P, of which only those
rows are calculated, and from what is not zero in them,

    (B P B')_ri = T_ri for a row r of those and any other i,    (B P B')_rq = sum over k of T_rk B_qk
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Index, IndexMatrix, Matrix, helper, view_helper
from rovgraph.kernels.layout import ACC_BIAS, MOTION, TRANSLATION, VELOCITY
from rovgraph.kernels.measurements import WORK, is_angular, predict, wrap
from rovgraph.kernels.rotations import (
    exp_rotation,
    log_rotation,
    multiply,
    multiply_transposed,
    rotate,
    rotate_back,
)
from rovgraph.kernels.states import Epoch

Indices = NDArray[np.int64]


class ErrorColumns(NamedTuple):
    """Columns of the estimated calibration, and the variables that instruments observe.

    Attributes
    ----------
    columns : ndarray of int, shape (size,), place of each component in all of the error, which is its column in
        a Jacobian of `predict`; of calibration it is 15 more than in the calibration vector
    seen : ndarray of int, shape (m, 3), of each instrument the kind of its equation, its dimension, and the
        component of the error vector with which the variable that it sees begins
    params : ndarray, shape (m, k), the numbers of each equation, the shorter ones with zeros behind
    rows : ndarray of int, shape (r,), rows of a change of basis that differ from the unit matrix
    """

    columns: Index
    seen: IndexMatrix
    params: Matrix
    rows: Index


class ErrorScratch(NamedTuple):
    """Arrays to calculate with, for one `ErrorColumns`.

    Attributes
    ----------
    z, H : predictions of two states and their Jacobians, shapes (2, m, 3) and (2, m, 3, 15 + len(c)), zero at first
    work : shape (WORK + 4, 3, 3), zero at first
    """

    z: Array
    H: Array
    work: Array


TURN, STEP, REST, ZERO = WORK, WORK + 1, WORK + 2, WORK + 3  # matrices of ``work`` beyond those of `predict`


@helper
def make_scratch(instruments: int, calibration_size: int) -> ErrorScratch:
    """Arrays for `retract` and `local` of so many instruments; made once."""
    H = np.zeros((2, instruments, 3, MOTION + calibration_size))
    return ErrorScratch(np.zeros((2, instruments, 3)), H, np.zeros((WORK + 4, 3, 3)))


@view_helper
def _see(s: int, which: int, state: Epoch, layout: ErrorColumns, scratch: ErrorScratch) -> None:
    """What instrument ``s`` sees of a state."""
    z, H, rate = scratch.z[which, s], scratch.H[which, s], scratch.work[ZERO, 0]
    predict(layout.seen[s, 0], state, rate, layout.params[s], z, H, scratch.work)


@view_helper
def _inverse_of_seen(H: Array, first: int, dim: int, columns: Indices, inverse_out: Array) -> None:
    """Inverse of the part of a Jacobian for the seen variable, of dimension 1, 2 or 3, by cofactors."""
    j0 = columns[first]
    if dim == 1:
        inverse_out[0, 0] = 1.0 / H[0, j0]
        return
    j1 = columns[first + 1]
    if dim == 2:
        inverse_out[0, 2] = inverse_out[1, 2] = 0.0
        det = H[0, j0] * H[1, j1] - H[0, j1] * H[1, j0]
        inverse_out[0, 0], inverse_out[0, 1] = H[1, j1] / det, -H[0, j1] / det
        inverse_out[1, 0], inverse_out[1, 1] = -H[1, j0] / det, H[0, j0] / det
        return
    j2 = columns[first + 2]
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        inverse_out[0, i] = H[a, j1] * H[b, j2] - H[a, j2] * H[b, j1]
        inverse_out[1, i] = H[a, j2] * H[b, j0] - H[a, j0] * H[b, j2]
        inverse_out[2, i] = H[a, j0] * H[b, j1] - H[a, j1] * H[b, j0]
    det = H[0, j0] * inverse_out[0, 0] + H[0, j1] * inverse_out[1, 0] + H[0, j2] * inverse_out[2, 0]
    for i in range(3):
        for k in range(3):
            inverse_out[i, k] /= det


@view_helper
def _rows_of_pose(turn: Array, basis_out: Array) -> None:
    """B_R and B_p."""
    for i in range(3):
        for k in range(3):
            basis_out[i, k] = basis_out[TRANSLATION + i, TRANSLATION + k] = turn[i, k]


@view_helper
def _rows_of_seen(
    before: Array, after: Array, inverse: Array, turn: Array, first: int, dim: int, columns: Indices, basis_out: Array
) -> None:
    """B_s = Y'^-1 (H - (H' without Y') B), H before and H' after."""
    size = len(basis_out)
    for k in range(dim):
        row, was, now = basis_out[first + k], before[k], after[k]
        for i in range(3):
            row[i] = was[i] - now[0] * turn[0, i] - now[1] * turn[1, i] - now[2] * turn[2, i]
            row[3 + i] = was[3 + i] - now[3] * turn[0, i] - now[4] * turn[1, i] - now[5] * turn[2, i]
        for j in range(VELOCITY, size):  # the others' rows of B are those of the unit matrix
            row[j] = was[columns[j]] - now[columns[j]]
        for j in range(first, first + dim):
            row[j] = was[columns[j]]
    if dim == 1:
        for j in range(size):
            basis_out[first, j] *= inverse[0, 0]
        return
    for j in range(size):
        a, b = basis_out[first, j], basis_out[first + 1, j]
        c = basis_out[first + 2, j] if dim == 3 else 0.0
        for i in range(dim):
            basis_out[first + i, j] = inverse[i, 0] * a + inverse[i, 1] * b + inverse[i, 2] * c


@view_helper
def retract(state: Epoch, delta: Array, layout: ErrorColumns, scratch: ErrorScratch, basis_out: Array) -> None:
    """Move a state by ``delta``, in place.

    ``basis_out``, shape (size, size), takes an error about the old state over to the new one, to first order in
    ``delta``. It must be the unit matrix at first, or what this function or `local` has written.
    """
    seen, columns, back, inverse = layout.seen, layout.columns, scratch.work[TURN], scratch.work[STEP]
    for s in range(len(seen)):
        _see(s, 0, state, layout, scratch)
    _move(state, delta, columns, scratch.work)
    _rows_of_pose(back, basis_out)
    for s in range(len(seen)):
        kind, dim, first = seen[s, 0], seen[s, 1], seen[s, 2]
        _see(s, 1, state, layout, scratch)
        before, after = scratch.H[0, s], scratch.H[1, s]
        _inverse_of_seen(after, first, dim, columns, inverse)
        for k in range(dim):
            missing = scratch.z[0, s, k] + _product(before[k], delta, columns) - scratch.z[1, s, k]
            missing = wrap(missing) if is_angular(kind) else missing
            for i in range(dim):
                _add(first + i, inverse[i, k] * missing, state.v, state.c, columns)
        _rows_of_seen(before, after, inverse, back, first, dim, columns, basis_out)


@view_helper
def _move(state: Epoch, delta: Array, columns: Indices, work: Array) -> None:
    """All variables moved by themselves, in place; ``work[TURN]`` becomes R'^T R."""
    R, p, v, b, c = state
    back, step, moved, shift = work[TURN], work[STEP], work[REST], work[TURN, 0]
    rotate(R, delta[TRANSLATION:VELOCITY], shift)
    for i in range(3):
        p[i] += shift[i]
        v[i] += delta[VELOCITY + i]
        b[i] += delta[ACC_BIAS + i]
        b[3 + i] += delta[ACC_BIAS + 3 + i]
    for i in range(MOTION, len(columns)):
        c[columns[i] - MOTION] += delta[i]
    exp_rotation(delta[0:3], step)
    multiply(R, step, moved)
    for i in range(3):
        for k in range(3):
            R[i, k] = moved[i, k]
            back[i, k] = step[k, i]


@view_helper
def _add(error: int, change: float, v: Array, c: Array, columns: Indices) -> None:
    """Change a component of what can be seen: velocity or calibration."""
    if error < MOTION:
        v[error - VELOCITY] += change
    else:
        c[columns[error] - MOTION] += change


@view_helper
def _product(row: Array, delta: Array, columns: Indices) -> float:
    """A row of a Jacobian of `predict` times an error."""
    total = 0.0
    for j in range(len(delta)):
        total += row[columns[j]] * delta[j]
    return total


@view_helper
def local(
    state: Epoch, other: Epoch, layout: ErrorColumns, scratch: ErrorScratch, delta_out: Array, basis_out: Array
) -> None:
    """The error that leads from a state to another one: the inverse of `retract`.

    ``basis_out``, as of `retract`, takes an error about the other state over to the first.
    """
    seen, columns, turn, inverse = layout.seen, layout.columns, scratch.work[TURN], scratch.work[STEP]
    multiply_transposed(state.R, other.R, turn)
    log_rotation(turn, delta_out[0:3])
    apart = scratch.work[REST, 0]
    for i in range(3):
        apart[i] = other.p[i] - state.p[i]
        delta_out[VELOCITY + i] = other.v[i] - state.v[i]
        delta_out[ACC_BIAS + i] = other.b[i] - state.b[i]
        delta_out[ACC_BIAS + 3 + i] = other.b[3 + i] - state.b[3 + i]
    rotate_back(state.R, apart, delta_out[TRANSLATION:VELOCITY])
    for i in range(MOTION, len(columns)):
        delta_out[i] = other.c[columns[i] - MOTION] - state.c[columns[i] - MOTION]
    _rows_of_pose(turn, basis_out)
    for s in range(len(seen)):
        kind, dim, first = seen[s, 0], seen[s, 1], seen[s, 2]
        _see(s, 0, state, layout, scratch)
        _see(s, 1, other, layout, scratch)
        here, there = scratch.H[0, s], scratch.H[1, s]
        _inverse_of_seen(here, first, dim, columns, inverse)
        for k in range(dim):  # all of them first: they depend on what they correct
            missing = scratch.z[1, s, k] - scratch.z[0, s, k]
            missing = wrap(missing) if is_angular(kind) else missing
            apart[k] = missing - _product(here[k], delta_out, columns)
        for k in range(dim):
            for i in range(dim):
                delta_out[first + i] += inverse[i, k] * apart[k]
        _rows_of_seen(there, here, inverse, turn, first, dim, columns, basis_out)


@view_helper
def change_basis(P: Array, basis: Array, rows: Indices, product: Array, filled: Indices) -> None:
    """P <- B P B' in place.

    Parameters
    ----------
    P : ndarray, shape (d, d), symmetric; may be wider than the basis, which leaves the rest as it is
    basis : ndarray, shape (size, size)
    rows : ndarray of int, shape (r,), rows of the basis that differ from the unit matrix
    product : ndarray, shape (r, d or more), to calculate with
    filled : ndarray of int, shape (r, size + 1), to calculate with
    """
    for r in range(len(rows)):
        _row_of_product(basis[rows[r]], P, product[r], filled[r])
    for r in range(len(rows)):
        row = rows[r]
        for i in range(len(P)):
            P[row, i] = P[i, row] = product[r, i]
    for r in range(len(rows)):
        for q in range(r + 1):
            other, columns, total = basis[rows[q]], filled[q], 0.0
            for k in range(1, columns[0] + 1):
                total += product[r, columns[k]] * other[columns[k]]
            P[rows[r], rows[q]] = P[rows[q], rows[r]] = total


@view_helper
def turn_rows(A: Array, basis: Array, rows: Indices, product: Array) -> None:
    """A <- B A in place, shape (d, h), for a basis B as of `change_basis`; ``product`` (r, h) is to calculate with."""
    for r in range(len(rows)):
        row = basis[rows[r]]
        for k in range(A.shape[1]):
            product[r, k] = 0.0
            for j in range(len(row)):
                product[r, k] += row[j] * A[j, k]
    for r in range(len(rows)):
        for k in range(A.shape[1]):
            A[rows[r], k] = product[r, k]


@view_helper
def _row_of_product(row: Array, P: Array, product_out: Array, filled_out: Indices) -> None:
    """A row of B times P; which columns of the row are not zero, behind their number."""
    count = 0
    for i in range(len(P)):
        product_out[i] = 0.0
    for j in range(len(row)):
        if row[j] != 0.0:
            count += 1
            filled_out[count] = j
            _add_scaled(row[j], P[j], product_out)
    filled_out[0] = count


@view_helper
def _add_scaled(factor: float, v: Array, sum_out: Array) -> None:
    for i in range(len(v)):
        sum_out[i] += factor * v[i]
