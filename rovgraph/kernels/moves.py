"""An estimate moved along the coordinates of its error, and the error between two estimates."""

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.change_of_basis import change_basis, turn_rows
from rovgraph.kernels.compile import helper, kernel
from rovgraph.kernels.error_coordinates import ErrorLayout, local, make_scratch, retract

Index = NDArray[np.int64]


@helper
def move(x: Array, c: Array, P: Array, B: Array, delta: Array, layout: ErrorLayout) -> None:
    """Move a state by ``delta`` along the error's coordinates, and its covariance's basis with it; in place.

    P and B are those of `rovgraph.kernels.robust_update`.
    """
    size, rows = len(layout.columns), len(layout.rows)
    scratch, basis = make_scratch(len(layout.seen), len(c)), np.zeros((size, size))
    for i in range(size):
        basis[i, i] = 1.0
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    retract(R, p, v, b, c, delta[0:size], layout, scratch, basis)
    change_basis(P, basis, layout.rows, np.empty((rows, len(P))), np.empty((rows, size + 1), np.int64))
    turn_rows(B, basis, layout.rows, np.empty((rows, B.shape[1])))


@kernel("void(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1], i8[::1], i8[:, ::1], f8[:, ::1], i8[::1])")
def move_estimate(
    x: Array,
    c: Array,
    P: Array,
    B: Array,
    delta: Array,
    columns: Index,
    seen: Index,
    seen_params: Array,
    basis_rows: Index,
) -> None:
    """`move`, with the parts of a layout."""
    move(x, c, P, B, delta, ErrorLayout(columns, seen, seen_params, basis_rows))


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
    scratch = make_scratch(len(layout.seen), len(c))
    other = (other_x[0:9].reshape(3, 3), other_x[9:12], other_x[12:15], other_x[15:21], other_c)
    own = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    local(own[0], own[1], own[2], own[3], c, other, layout, scratch, delta_out, basis_out)
