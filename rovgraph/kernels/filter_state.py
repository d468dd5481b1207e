"""State and model of the filter, as kernels take them.

`FilterState` is carried from keyframe to keyframe, `FilterModel` holds what stays. `retract_with_covariance` moves an
estimate along the coordinates of its error; `local_coordinates` is the error between two estimates.
"""

from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Index, Matrix, Vector, helper, kernel
from rovgraph.kernels.error_coordinates import ErrorColumns, change_basis, local, make_scratch, retract, turn_rows
from rovgraph.kernels.states import epoch_in


class FilterState(NamedTuple):
    """An estimate with the covariance of its error, which kernels change in place.

    Attributes
    ----------
    x : shape (21,), R_nb by rows, p_n, v_n, bias
    c : shape (C,), calibration vector
    P, B : shapes (n, n), (n, h), of `rovgraph.kernels.correction`; places that are remembered come last
    L : shape (h, h), root of the covariance of what is considered
    """

    x: Vector
    c: Vector
    P: Matrix
    B: Matrix
    L: Matrix


class FilterModel(NamedTuple):
    """Sensors, what walks, and where each variable stands in the error.

    Attributes
    ----------
    sensors : shape (s, PARAMS + ...), of `rovgraph.kernels.measurement_row`
    column : shape (15 + C,), place of each component in the error, -1 where it has none; what is considered comes last
    layout : of the error
    walk : shape (3, size), variance that walking adds in a second, one over its time constant [1/s], the mean
    gravity : [m/s^2]
    """

    sensors: Matrix
    column: Index
    layout: ErrorColumns
    walk: Matrix
    gravity: float


@helper
def retract_with_covariance(known: FilterState, delta: Array, layout: ErrorColumns) -> None:
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
def move_estimate(known: FilterState, delta: Vector, layout: ErrorColumns) -> None:
    """`retract_with_covariance`, from Python."""
    retract_with_covariance(known, delta, layout)


@kernel()
def local_coordinates(
    x: Vector, c: Vector, other_x: Vector, other_c: Vector, layout: ErrorColumns, delta_out: Vector, basis_out: Matrix
) -> None:
    """The error that leads from a state to another; ``basis_out``, the unit matrix before, takes errors back."""
    scratch = make_scratch(len(layout.seen), len(c))
    local(epoch_in(x, c), epoch_in(other_x, other_c), layout, scratch, delta_out, basis_out)
