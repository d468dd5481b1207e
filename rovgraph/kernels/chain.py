"""A dive's linear least squares: keyframes in a chain, with a border of constants, by square-root information.

The errors x_k of the keyframes (d components each) and y of the border (c components) minimise the squares of

    A_i x_k + A_j x_{k+1} + C y - r     whitened rows of the motion between two keyframes
    J x_k + C y - r                     whitened rows of a measurement, or of a prior, at a keyframe
    C y - r                             whitened rows of priors of the border

They are eliminated in the order of time (`rovgraph.kernels.elimination`), by Householder
reflections of these rows, to

    R_k x_k + S_k x_{k+1} + T_k y = z_k + white noise,     R_k upper triangular
                          R_y y = z_y + white noise,     R_y upper triangular

(Golub and Van Loan 2013, 5.1 and 5.2; Bierman 1977, chapters IV and X), from which solution, covariances, draws
and sensitivities follow backwards in time (`rovgraph.kernels.chain_posterior`). The information matrix is never
formed: that squares the condition number, and a motion's rows determine positions to 1e-3 m where the prior may be
1000 m wide.

A target is the index of a column that rows have beyond their own: below d a component of x_k, from d on a
component of y. Columns with a negative target are ignored.
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Index, IndexMatrix, Matrices, Matrix, Vector, helper, kernel, view_helper

LANES = 8  # columns are worked on in multiples of it, so that loops become vector instructions


@helper
def padded(columns: int) -> int:
    """The next multiple of `LANES`."""
    return (columns + LANES - 1) // LANES * LANES


@view_helper
def reflect(W: Array, pivot: int, first: int, last: int, column: int, v: Array, w: Array) -> None:
    """Householder reflection of the rows ``pivot`` and ``first`` to ``last`` of W that clears a column of the latter.

    W has a multiple of `LANES` columns, of which those before ``column`` stay as they are. v and w are work
    space of as many elements as W has rows and columns.
    """
    if pivot < 0 or first < 0 or column < 0:
        return  # never true; lets the compiler use vector instructions
    count = last - first
    square, other = 0.0, 0.0
    for i in range(count):
        v[i] = W[first + i, column]
        W[first + i, column] = 0.0
    for i in range(count // 2):  # two sums do not wait for each other
        square += v[2 * i] * v[2 * i]
        other += v[2 * i + 1] * v[2 * i + 1]
    square += other
    if count % 2:
        square += v[count - 1] * v[count - 1]
    if square == 0.0:
        return
    top = W[pivot, column]
    norm = -math.copysign(math.sqrt(top * top + square), top)
    lead = top - norm
    gain = 1.0 / (lead * norm)  # -2 over the square of (lead, v)
    W[pivot, column] = 0.0
    begin = column // LANES * LANES
    width = (W.shape[1] // LANES - column // LANES) * LANES
    for c in range(width):
        w[c] = lead * W[pivot, begin + c]
    fours = count // 4
    for k in range(fours):  # rows at a time, so that w is written less often
        i, v_0, v_1, v_2, v_3 = first + 4 * k, v[4 * k], v[4 * k + 1], v[4 * k + 2], v[4 * k + 3]
        for c in range(width):
            two = v_0 * W[i, begin + c] + v_1 * W[i + 1, begin + c]
            w[c] += two + v_2 * W[i + 2, begin + c] + v_3 * W[i + 3, begin + c]
    for i in range(4 * fours, count):
        factor = v[i]
        for c in range(width):
            w[c] += factor * W[first + i, begin + c]
    factor = gain * lead
    for c in range(width):
        W[pivot, begin + c] += factor * w[c]
    W[pivot, column] = norm
    for i in range(count):
        factor = gain * v[i]
        if factor == 0.0:
            continue
        for c in range(width):
            W[first + i, begin + c] += factor * w[c]


@view_helper
def triangularise(W: Array, columns: int, top: int, dense: int, end: int, v: Array, w: Array) -> None:
    """Clear the first columns of W's rows ``top`` to ``end`` below the diagonal; rows above are triangular.

    Row i from ``dense`` on is zero before column i - top, and left out of the reflections until then.
    """
    for j in range(columns):
        reflect(W, j, max(j + 1, top), min(end, max(dense, top + j + 1)), j, v, w)


UNDETERMINED = 1e-10  # a pivot below this part of its column is rounding
PENDING = 48  # rows that are folded into the border at a time


class Walks(NamedTuple):
    """Random walks from keyframe to keyframe: ``weight (x_{k+1} - kept x_k) = r`` is white; shape (n - 1, walking)."""

    weight: Matrix
    kept: Matrix
    r: Matrix


class PlacedRows(NamedTuple):
    """Whitened rows of measurements in the order of keyframes.

    Attributes
    ----------
    rows : shape (m, s + q + 1): the first s components of the keyframe, q others, right-hand side
    targets : shape (m, q), of the q others
    first : shape (n + 1,), a keyframe's first row
    """

    rows: Matrix
    targets: IndexMatrix
    first: Index


class Elimination(NamedTuple):
    """Output of an elimination.

    Attributes
    ----------
    stops : shape (f,), increasing, keyframes at which to keep the information of the rows so far
    conditionals : shape (n, d, 2 d + c + 1), columns R_k, S_k, T_k, z_k
    border : shape (c, c + 1), columns R_y, z_y
    filtered : shape (f, d + c, d + c + 1), triangular: rows of that keyframe and of the border, of data up to it
    left : shape (1,), sum of squares at the minimum
    """

    stops: Index
    conditionals: Matrices
    border: Matrix
    filtered: Matrices
    left: Vector


class Buffers(NamedTuple):
    """Where rows are worked on.

    Attributes
    ----------
    V : shape (d + most, padded(d + c + 1)), rows of a keyframe and the border: what is known, then measurements
    W : shape (2 d, padded(2 d + c + 1)), of a keyframe, the one after it and the border: what is known, then the motion
    Y : shape (rows, padded(c + 1)), of the border: its triangle, then rows that are yet to be folded into it
    scale : shape (d + c,), sums of squares of the columns' rows so far
    v, w : as many elements as the largest of them has rows and columns
    """

    V: Array
    W: Array
    Y: Array
    scale: Array
    v: Array
    w: Array


@helper
def make_room(d: int, c: int, most: int, border_rows: Array) -> Buffers:
    """Room for keyframes of d components, each with at most so many rows of measurements; the border's priors in it."""
    V, W = np.zeros((d + most, padded(d + c + 1))), np.zeros((2 * d, padded(2 * d + c + 1)))
    Y = np.zeros((c + border_rows.shape[0] + PENDING + most, padded(c + 1)))
    scale = np.zeros(d + c)
    for i in range(border_rows.shape[0]):
        for j in range(c):
            scale[d + j] += border_rows[i, j] * border_rows[i, j]
    append_rows(border_rows, 0, border_rows.shape[0], 0, c + 1, c, Y)
    return Buffers(V, W, Y, scale, np.zeros(max(2 * d + most, Y.shape[0])), np.zeros(W.shape[1]))


@view_helper
def append_rows(source: Array, begin: int, end: int, column: int, columns: int, at: int, Y_out: Array) -> int:
    """Copy columns of a source's rows into rows ``at`` and on; returns the row after them."""
    for i in range(begin, end):
        for j in range(columns):
            Y_out[at, j] = source[i, column + j]
        at += 1
    return at


@view_helper
def fold_border(Y: Array, c: int, end: int, v: Array, w: Array) -> float:
    """Fold the rows below the border's triangle into it; returns the square that no value of the border explains."""
    triangularise(Y, c, c, end, end, v, w)
    left = 0.0
    for i in range(c, end):
        left += Y[i, c] * Y[i, c]
    return left


@view_helper
def load_measurements(k: int, measured: PlacedRows, s: int, d: int, room: Buffers) -> int:
    """Rows of a keyframe's measurements into V, below the d rows that are known of it; returns the row after them."""
    rows, targets, begin = measured.rows, measured.targets, measured.first[k]
    count: int = measured.first[k + 1] - begin
    last, V_out, scale_out = rows.shape[1] - 1, room.V, room.scale
    for i in range(count):
        row = begin + i
        for j in range(V_out.shape[1]):
            V_out[d + i, j] = 0.0
        for j in range(s):
            V_out[d + i, j] = rows[row, j]
        for j in range(targets.shape[1]):
            if targets[row, j] >= 0:
                V_out[d + i, targets[row, j]] += rows[row, s + j]
        for j in range(scale_out.shape[0]):
            scale_out[j] += V_out[d + i, j] * V_out[d + i, j]
        V_out[d + i, scale_out.shape[0]] = rows[row, last]
    return d + count


@view_helper
def load_motion(A: Array, C: Array, targets: Index, walk: Array, kept: Array, walk_r: Array, room: Buffers) -> int:
    """Rows of the motion after a keyframe into W, below its own d; the scale becomes that of the keyframe after it.

    A has shape (s, 2 (s + 1)): columns of the keyframe before, right-hand side, columns of the keyframe after. The rest
    is that of `rovgraph.kernels.elimination.eliminate`, of one motion. Returns the first row of W from which on row
    d + i is zero before column i, for `triangularise`: the rows of walks.
    """
    s, d, W_out, scale_out = len(A), len(A) + len(walk), room.W, room.scale
    last = d + len(scale_out)
    for i in range(d, 2 * d):
        for j in range(W_out.shape[1]):
            W_out[i, j] = 0.0
    for j in range(d):
        scale_out[j] = 0.0
    for i in range(s):
        for j in range(s):
            W_out[d + i, j] = A[i, j]
            W_out[d + i, d + j] = A[i, s + 1 + j]
            scale_out[j] += A[i, s + 1 + j] * A[i, s + 1 + j]
        for j in range(len(targets)):
            if targets[j] >= d:
                W_out[d + i, d + targets[j]] += C[i, j]
                scale_out[targets[j]] += C[i, j] * C[i, j]
            elif targets[j] >= 0:
                W_out[d + i, targets[j]] += C[i, j]
        W_out[d + i, last] = A[i, s]
    for i in range(s, d):
        factor = walk[i - s]
        W_out[d + i, i], W_out[d + i, d + i] = -factor * kept[i - s], factor
        W_out[d + i, last] = walk_r[i - s]
        scale_out[i] = factor * factor
    dense = s
    while dense > 0 and _starts_at(W_out[d + dense - 1], dense - 1):
        dense -= 1
    return d + dense


@view_helper
def _starts_at(row: Array, column: int) -> bool:
    """Whether a row is zero before a column."""
    zeros = 0
    while zeros < column and row[zeros] == 0.0:
        zeros += 1
    return zeros == column


@view_helper
def join(V: Array, Y: Array, d: int, c: int, at: int, joint_out: Array) -> None:
    """Rows of a keyframe and of the border as one triangle with its right-hand side."""
    for i in range(d):
        for j in range(d + c + 1):
            joint_out[at, i, j] = V[i, j]
    for i in range(c):
        for j in range(d):
            joint_out[at, d + i, j] = 0.0
        for j in range(c + 1):
            joint_out[at, d + i, d + j] = Y[i, j]


@view_helper
def undetermined(triangle: Array, scale: Array, begin: int, end: int, shift: int) -> int:
    """The first column whose pivot is rounding or no number, plus ``shift``, or -1.

    The triangle is that of columns ``begin`` to ``end`` of ``scale``, the squares of the rows that went into it.
    """
    for j in range(begin, end):
        pivot = triangle[j - begin, j - begin]
        if not pivot * pivot > UNDETERMINED * UNDETERMINED * scale[j]:
            return j + shift
    return -1


@view_helper
def triangularise_keyframe(
    k: int, n: int, end: int, last: int, stop: int, room: Buffers, out: Elimination
) -> tuple[int, int, int]:
    """Make a triangle of keyframe k's rows in V, up to ``end``, and put it where its motion is added.

    Parameters
    ----------
    last : of Y, the row after those that are in use
    stop : the next of the stops

    Returns
    -------
    last, stop : afterwards
    failing : the first component that is not determined at a stop, or -1
    """
    V, W, Y, d, stops = room.V, room.W, room.Y, room.W.shape[0] // 2, out.stops
    c, failing = room.scale.shape[0] - d, -1
    triangularise(V, d, 0, end, end, room.v, room.w)
    last = append_rows(V, d, end, d, c + 1, last, Y)
    stops_here = stop < stops.shape[0] and stops[stop] == k
    if last > c + PENDING or stops_here or k == n - 1:
        out.left[0] += fold_border(Y, c, last, room.v, room.w)
        last = c
    if stops_here:
        failing = max(undetermined(V, room.scale, 0, d, k * d), undetermined(Y, room.scale, d, d + c, (n - 1) * d))
        join(V, Y, d, c, stop, out.filtered)
        stop += 1
    for i in range(d):
        for j in range(d):
            W[i, j] = V[i, j]
            W[i, d + j] = 0.0
        for j in range(c + 1):
            W[i, 2 * d + j] = V[i, d + j]
    return last, stop, failing


@view_helper
def eliminate_keyframe(k: int, n: int, dense: int, room: Buffers, conditionals_out: Array) -> int:
    """Eliminate keyframe k from W; what is left is known of the one after it. Returns what is not determined, or -1.

    ``dense`` is what `load_motion` returned. Of the conditional only R's diagonal is kept where there is room for one
    column.
    """
    W, d = room.W, room.W.shape[0] // 2
    c = room.scale.shape[0] - d
    if k < n - 1:
        triangularise(W, d, d, dense, 2 * d, room.v, room.w)
        append_rows(W, d, 2 * d, d, d + c + 1, 0, room.V)
    # before the last keyframe, where scale is that of the next by now, a motion determines all that is a number
    failing, row = undetermined(W, room.scale, 0, d, k * d), min(k, conditionals_out.shape[0] - 1)
    if conditionals_out.shape[2] == 1:
        for i in range(d):
            conditionals_out[row, i, 0] = W[i, i]
        return failing
    for i in range(d):
        for j in range(2 * d + c + 1):
            conditionals_out[row, i, j] = W[i, j]
    return failing


@view_helper
def close_border(n: int, d: int, room: Buffers, border_out: Array) -> int:
    """The border's triangle, when all keyframes are eliminated; returns what is not determined, or -1."""
    c = room.scale.shape[0] - d
    append_rows(room.Y, 0, c, 0, c + 1, 0, border_out)
    return undetermined(room.Y, room.scale, d, d + c, (n - 1) * d)


@kernel("void(f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], i8[::1], f8[::1], i8[::1], f8[:, ::1], i8[:, ::1])")
def place_rows(
    r: Array, J: Array, C: Array, C_targets: Index, weight: Array, first: Index, rows_out: Array, targets_out: Index
) -> None:
    """Put the rows of m measurements of one sensor where `load_measurements` reads them.

    Parameters
    ----------
    r : shape (m, dim), whitened right-hand sides
    J : shape (m, dim, s), whitened Jacobians by the first s components of the keyframe
    C, C_targets : shapes (m, dim, e) and (e,), by others
    weight : shape (m,), of their squares (robust losses, gates)
    first : shape (m,), the first row of each
    rows_out : shape (rows, s + q + 1), with q >= e
    targets_out : shape (rows, q)
    """
    s, e, last = J.shape[2], C.shape[2], rows_out.shape[1] - 1
    for k in range(r.shape[0]):
        factor = math.sqrt(weight[k])
        for row in range(first[k], first[k] + r.shape[1]):
            i = row - first[k]
            for j in range(last - s):
                targets_out[row, j] = C_targets[j] if j < e else -1
            for j in range(last + 1):
                rows_out[row, j] = 0.0
            if factor == 0.0:
                continue  # whatever its rows are, no numbers perhaps
            for j in range(s):
                rows_out[row, j] = factor * J[k, i, j]
            for j in range(e):
                rows_out[row, s + j] = factor * C[k, i, j]
            rows_out[row, last] = factor * r[k, i]
