"""A chain whose rows are at hand, eliminated: for studies of the solver; `rovgraph.kernels.dive` makes them itself."""

from typing import NamedTuple

from rovgraph.kernels.chain import (
    Elimination,
    PlacedRows,
    Walks,
    absorb,
    close_border,
    load_measurements,
    load_motion,
    make_room,
    pass_on,
)
from rovgraph.kernels.compile import Index, Matrices, Matrix, kernel


class LinearMotions(NamedTuple):
    """Whitened rows of n - 1 motions.

    Attributes
    ----------
    A : shape (n - 1, s, 2 (s + 1)), columns of the keyframe before, right-hand side, columns of the keyframe after,
        and one that is not read
    C, targets : shapes (n - 1, s, e) and (e,), other columns, of the keyframe before or of the border
    """

    A: Matrices
    C: Matrices
    targets: Index


@kernel()
def eliminate(motions: LinearMotions, walks: Walks, measured: PlacedRows, border_rows: Matrix, out: Elimination) -> int:
    """Eliminate n keyframes in the order of time, then the border.

    Parameters
    ----------
    walks : of the last d - s components
    border_rows : shape (p, c + 1), of the border's priors with their right-hand sides

    Returns
    -------
    -1, or the first component that the rows do not determine, ``k d + j`` of a keyframe and ``n d + j`` of the border
    """
    A, C, first = motions.A, motions.C, measured.first
    n, d, s, c = out.conditionals.shape[0], out.conditionals.shape[1], A.shape[1], out.border.shape[0]
    most = 0
    for k in range(n):
        most = max(most, first[k + 1] - first[k])
    room, last, stop = make_room(d, c, most, border_rows), c + border_rows.shape[0], 0
    out.left[0], dense = 0.0, 0
    for k in range(n):
        end = load_measurements(k, measured, s, d, room)
        last, stop, failing = absorb(k, n, end, last, stop, room, out)
        if k < n - 1:
            dense = load_motion(A[k], C[k], motions.targets, walks.weight[k], walks.kept[k], walks.r[k], room)
        failing = max(failing, pass_on(k, n, dense, room, out.conditionals))
        if failing >= 0:
            return failing
    return close_border(n, d, room, out.border)
