"""P <- B P B' for a basis B of which few rows differ from the unit matrix.

With T = B P, of which only those rows are calculated, and from what is not zero in them,

    (B P B')_ri = T_ri for a row r of those and any other i,    (B P B')_rq = sum over k of T_rk B_qk
"""

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import view_helper

Indices = NDArray[np.int64]


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
