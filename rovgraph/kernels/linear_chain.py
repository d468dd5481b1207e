"""A chain whose rows are at hand, eliminated: for studies of the solver; `rovgraph.kernels.dive` makes them itself."""

from rovgraph.geometry import Array
from rovgraph.kernels.chain import Index, absorb, close_border, load_measurements, load_motion, make_room, pass_on
from rovgraph.kernels.compile import kernel


@kernel(
    "i8(f8[:, :, ::1], f8[:, :, ::1], i8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], i8[:, ::1], i8[::1],"
    " f8[:, ::1], i8[::1], f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8[::1])"
)
def eliminate(
    A: Array,
    C: Array,
    C_targets: Index,
    walk: Array,
    kept: Array,
    walk_r: Array,
    rows: Array,
    targets: Index,
    first: Index,
    border_rows: Array,
    stops: Index,
    conditionals_out: Array,
    border_out: Array,
    filtered_out: Array,
    left_out: Array,
) -> int:
    """Eliminate n keyframes in the order of time, then the border.

    Parameters
    ----------
    A : shape (n - 1, s, 2 (s + 1)), whitened rows of a motion: columns of the keyframe before it, right-hand side,
        columns of the keyframe after it, and one that is not read
    C, C_targets : shapes (n - 1, s, e) and (e,), its other columns, of the keyframe before it or of the border
    walk, kept, walk_r : shape (n - 1, d - s), the last components walk: ``walk (x_{k+1} - kept x_k) = walk_r`` is white
    rows : shape (m, s + q + 1), of measurements in the order of keyframes: the first s components of the
        keyframe, q others, right-hand side
    targets : shape (m, q), of the q others
    first : shape (n + 1,), a keyframe's first row
    border_rows : shape (p, c + 1), of the border's priors with their right-hand sides
    stops : shape (f,), increasing, keyframes at which to keep what the rows up to there say
    conditionals_out : shape (n, d, 2 d + c + 1), columns R_k, S_k, T_k, z_k
    border_out : shape (c, c + 1), columns R_y, z_y
    filtered_out : shape (f, d + c, d + c + 1), triangular: rows of that keyframe and of the border, of data up to it
    left_out : shape (1,), sum of squares at the minimum

    Returns
    -------
    -1, or the first component that the rows do not determine, ``k d + j`` of a keyframe and ``n d + j`` of the border
    """
    n, d, s, c = conditionals_out.shape[0], conditionals_out.shape[1], A.shape[1], border_out.shape[0]
    most = 0
    for k in range(n):
        most = max(most, first[k + 1] - first[k])
    room, last, stop = make_room(d, c, most, border_rows), c + border_rows.shape[0], 0
    left_out[0], dense = 0.0, 0
    for k in range(n):
        end = load_measurements(rows, targets, first[k], first[k + 1], s, d, room)
        last, stop, failing = absorb(k, n, end, last, stops, stop, room, filtered_out, left_out)
        if k < n - 1:
            dense = load_motion(A[k], C[k], C_targets, walk[k], kept[k], walk_r[k], room)
        failing = max(failing, pass_on(k, n, dense, room, conditionals_out))
        if failing >= 0:
            return failing
    return close_border(n, d, room, border_out)
