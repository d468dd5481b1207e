"""An estimate moved along the coordinates of its error, and the error between two estimates."""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.change_of_basis import change_basis, turn_rows
from rovgraph.kernels.compile import Matrix, Vector, helper, kernel
from rovgraph.kernels.error_coordinates import ErrorLayout, local, make_scratch, retract
from rovgraph.kernels.filter_state import FilterState
from rovgraph.kernels.states import epoch_in


@helper
def move(known: FilterState, delta: Array, layout: ErrorLayout) -> None:
    """Move a state by ``delta`` along the error's coordinates, and its covariance's basis with it; in place."""
    x, c, P, B = known.x, known.c, known.P, known.B
    size, rows = len(layout.columns), len(layout.rows)
    scratch, basis = make_scratch(len(layout.seen), len(c)), np.zeros((size, size))
    for i in range(size):
        basis[i, i] = 1.0
    retract(epoch_in(x, c), delta[0:size], layout, scratch, basis)
    change_basis(P, basis, layout.rows, np.empty((rows, len(P))), np.empty((rows, size + 1), np.int64))
    turn_rows(B, basis, layout.rows, np.empty((rows, B.shape[1])))


@kernel()
def move_estimate(known: FilterState, delta: Vector, layout: ErrorLayout) -> None:
    """`move`, from Python."""
    move(known, delta, layout)


@kernel()
def difference(
    x: Vector, c: Vector, other_x: Vector, other_c: Vector, layout: ErrorLayout, delta_out: Vector, basis_out: Matrix
) -> None:
    """The error that leads from a state to another; ``basis_out``, the unit matrix before, takes errors back."""
    scratch = make_scratch(len(layout.seen), len(c))
    local(epoch_in(x, c), epoch_in(other_x, other_c), layout, scratch, delta_out, basis_out)
