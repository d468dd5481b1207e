"""Rows made triangular by Householder reflections (Golub and Van Loan 2013, 5.1 and 5.2)."""

import math

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper, view_helper

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
        return  # it never is; the compiler must know it to use vector instructions
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
