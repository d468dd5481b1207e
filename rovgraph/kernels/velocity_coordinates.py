"""Along which axes the filter moves velocity, those of n or of the body."""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper
from rovgraph.kernels.error_coordinates import ErrorLayout
from rovgraph.kernels.layout import VELOCITY


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
