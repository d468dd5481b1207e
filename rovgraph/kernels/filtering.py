"""The filter over many intervals in a row: correct, predict, correct.

What `rovgraph.engine.filter.FilterEngine.step` does with one, as far as nothing is needed that no kernel knows: it
stops before an interval with a measurement that is `GIVEN`, and where the attitude is so poorly known that it has to
be found before it is linearised at (`rovgraph.engine.alignment`).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import given, helper, kernel, view_helper
from rovgraph.kernels.correction import CORRECT
from rovgraph.kernels.layout import VELOCITY
from rovgraph.kernels.measurement_row import GIVEN, KIND
from rovgraph.kernels.prediction import PREDICT_FILTER

Index = NDArray[np.int64]


@helper
def attitude_variances(x: Array, P: Array) -> tuple[float, float]:
    """Variance of the tilt, the larger one, and of the heading [rad^2]; x and P as `filter_intervals` takes them."""
    variance = np.zeros(3)  # of turns about north, east and down
    for axis in range(3):
        for i in range(3):
            for j in range(3):
                variance[axis] += x[3 * axis + i] * P[i, j] * x[3 * axis + j]
    return max(variance[0], variance[1]), variance[2]


@kernel(f"UniTuple(f8, 2)({given(1)}, {given(2)})")
def attitude_variances_of(x: Array, P: Array) -> tuple[float, float]:
    """`attitude_variances`, from Python."""
    return attitude_variances(x, P)


@helper
def knows_all(which: Index, sensors: Array) -> bool:
    """Whether kernels know the equations of all measurements."""
    given = 0
    for j in range(len(which)):
        given += sensors[which[j], KIND] == GIVEN
    return given == 0


@view_helper
def _copy(v: Array, v_out: Array) -> None:
    """The first components of a vector, as many as ``v_out`` has; a loop, since assigned slices compile slowly."""
    for i in range(len(v_out)):
        v_out[i] = v[i]


@view_helper
def _covariance(P: Array, B: Array, first: int, P_out: Array) -> None:
    """P + B B' of the components from ``first`` on."""
    for i in range(len(P_out)):
        for j in range(len(P_out)):
            total = P[first + i, first + j]
            for k in range(B.shape[1]):
                total += B[first + i, k] * B[first + j, k]
            P_out[i, j] = total


@kernel(
    "i8(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8[::1], "
    "f8[:, :, ::1], i8[::1], i8[::1], f8[:, ::1], i8[::1], f8[:, ::1], i8[::1], i8[:, ::1], f8[:, ::1], i8[::1], "
    "f8[::1], f8, f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], "
    f"f8[:, ::1], f8[::1], f8[::1], FunctionType({CORRECT}), FunctionType({PREDICT_FILTER}))"
)
def filter_intervals(
    x: Array,
    c: Array,
    P: Array,
    B: Array,
    L: Array,
    motions: Array,
    scales: Array,
    rows: Array,
    which: Index,
    row_scales: Array,
    taken: Index,
    here: Index,
    sensors: Array,
    column: Index,
    walk: Array,
    columns: Index,
    seen: Index,
    seen_params: Array,
    basis_rows: Index,
    since: Array,
    gravity: float,
    poorly_known: Array,
    x_out: Array,
    c_out: Array,
    predicted_x_out: Array,
    predicted_c_out: Array,
    pose_out: Array,
    velocity_out: Array,
    sd_out: Array,
    nis_out: Array,
    weight_out: Array,
    correct: Callable[..., None],
    predict_filter: Callable[..., None],
) -> int:
    """Take up to k intervals.

    Parameters
    ----------
    x, c, P, B : the keyframe before them, afterwards that at the end of the last one that is taken
    L : root of the covariance of what is considered
    motions, scales : shapes (k, ROW), (k, 6, 6) or (0, 6, 6), as of `rovgraph.kernels.dive`
    rows, which, row_scales : of their measurements
    taken : shape (k + 1,), the first measurement of each interval, and how many there are
    here : shape (k,), the first measurement at the keyframe that ends each
    sensors, column, since, gravity, columns to basis_rows : as `rovgraph.kernels.correction.correct`
    walk : shape (3, size), as `rovgraph.kernels.prediction.predict_filter`
    poorly_known : shape (2,), variances of tilt and heading beyond which the attitude has to be found first [rad^2]
    x_out, c_out : shapes (k, 21), (k, C), the keyframes
    predicted_x_out, predicted_c_out : the same before what was measured at them
    pose_out, velocity_out, sd_out : shapes (k, 6, 6), (k, 3, 3), (k, size), covariances, and sd of the error
    nis_out, weight_out : shape (m,), of the measurements
    correct, predict_filter : of `rovgraph.kernels.correction` and `rovgraph.kernels.prediction`

    Returns
    -------
    How many intervals are taken
    """
    size, nothing, none_given = walk.shape[1], np.empty(0), np.empty((0, len(L)))
    F, Q, exact, there = np.empty((size, size)), np.empty((size, size)), np.empty((0, 0)), np.empty(21)
    for k in range(len(here)):
        tilt, heading = attitude_variances(x, P)
        known = knows_all(which[taken[k] : taken[k + 1]], sensors)
        if tilt > poorly_known[0] or heading > poorly_known[1] or not known:
            return k
        for arrived in range(2):
            if arrived:
                scale = scales[k] if len(scales) else exact
                predict_filter(x, c, P, B, L, motions[k], scale, column, walk, size, there, c, F, Q)
                _copy(there, x)
                _copy(x, predicted_x_out[k])
                _copy(c, predicted_c_out[k])
            begin, end = (here[k], taken[k + 1]) if arrived else (taken[k], here[k])
            if begin < end:
                own = row_scales[begin:end] if len(row_scales) else row_scales
                tables = (sensors, column, own, nothing, none_given, columns, seen, seen_params, basis_rows)
                out = nis_out[begin:end], weight_out[begin:end], nothing
                correct(x, c, P, B, L, rows[begin:end], which[begin:end], *tables, since, True, gravity, *out)
        _copy(x, x_out[k])
        _copy(c, c_out[k])
        _covariance(P, B, 0, pose_out[k])
        _covariance(P, B, VELOCITY, velocity_out[k])
        for i in range(size):
            variance = P[i, i]
            for j in range(len(L)):
                variance += B[i, j] * B[i, j]
            sd_out[k, i] = np.sqrt(variance)
    return len(here)
