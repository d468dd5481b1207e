"""The filter over many intervals in a row: correct, predict, correct.

What `rovgraph.engine.filter.FilterEngine.step` does with one, as far as nothing is needed that no kernel knows: it
stops before an interval with a measurement that is `GIVEN`, and where the attitude is so poorly known that it has to
be found before it is linearised at (`rovgraph.engine.alignment`).
"""

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import given, helper, kernel
from rovgraph.kernels.correction import correct_keyframe
from rovgraph.kernels.error_coordinates import ErrorLayout
from rovgraph.kernels.measurement_row import GIVEN, KIND
from rovgraph.kernels.prediction import predict_keyframe

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


@helper
def _correct(
    x: Array,
    c: Array,
    P: Array,
    begin: int,
    end: int,
    rows: Array,
    which: Index,
    sensors: Array,
    column: Index,
    row_scales: Array,
    layout: ErrorLayout,
    since: Array,
    gravity: float,
    nis_out: Array,
    weight_out: Array,
) -> None:
    """Correct a keyframe by the measurements from ``begin`` to ``end``, in place."""
    if begin == end:
        return
    scales = row_scales[begin:end] if len(row_scales) else row_scales
    measured = (rows[begin:end], which[begin:end], sensors, column, scales, np.empty(0), np.empty((0, len(P))))
    out = (nis_out[begin:end], weight_out[begin:end], np.empty(0))
    correct_keyframe(x, c, P, *measured, layout, since, True, gravity, *out)


@kernel(
    "i8(f8[::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, ::1], i8[::1], f8[:, :, ::1], i8[::1], i8[::1],"
    " f8[:, ::1], i8[::1], f8[:, ::1], i8[::1], i8[:, ::1], f8[:, ::1], i8[::1], f8[::1], f8, f8[::1], f8[:, ::1],"
    " f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], f8[::1], f8[::1])"
)
def filter_intervals(
    x: Array,
    c: Array,
    P: Array,
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
) -> int:
    """Take up to k intervals.

    Parameters
    ----------
    x, c, P : the keyframe before them, afterwards that at the end of the last one that is taken
    motions, scales : shapes (k, ROW), (k, 6, 6) or (0, 6, 6), as of `rovgraph.kernels.dive`
    rows, which, row_scales : of their measurements
    taken : shape (k + 1,), the first measurement of each interval, and how many there are
    here : shape (k,), the first measurement at the keyframe that ends each
    sensors, column, since, gravity, columns to basis_rows : as `rovgraph.kernels.correction.correct_keyframe`
    walk : shape (3, size), as `rovgraph.kernels.prediction.predict_keyframe`
    poorly_known : shape (2,), variances of tilt and heading beyond which the attitude has to be found first [rad^2]
    x_out, c_out : shapes (k, 21), (k, C), the keyframes
    predicted_x_out, predicted_c_out : the same before what was measured at them
    pose_out, velocity_out, sd_out : shapes (k, 6, 6), (k, 3, 3), (k, size), covariances, and sd of the error
    nis_out, weight_out : shape (m,), of the measurements

    Returns
    -------
    How many intervals are taken
    """
    size, layout = walk.shape[1], ErrorLayout(columns, seen, seen_params, basis_rows)
    F, Q, no_scale, there = np.empty((size, size)), np.empty((size, size)), np.empty((0, 0)), np.empty(21)
    tables, out = (rows, which, sensors, column, row_scales), (nis_out, weight_out)
    for k in range(len(here)):
        begin, end = taken[k], taken[k + 1]
        tilt, heading = attitude_variances(x, P)
        if tilt > poorly_known[0] or heading > poorly_known[1] or not knows_all(which[begin:end], sensors):
            return k
        _correct(x, c, P, begin, here[k], *tables, layout, since, gravity, *out)
        scale = scales[k] if len(scales) else no_scale
        predict_keyframe(x, c, P, motions[k], scale, column, walk, there, c, F, Q)
        x[:] = there
        predicted_x_out[k], predicted_c_out[k] = x, c
        _correct(x, c, P, here[k], end, *tables, layout, since, gravity, *out)
        x_out[k], c_out[k] = x, c
        pose_out[k], velocity_out[k] = P[:6, :6], P[6:9, 6:9]
        for i in range(size):
            sd_out[k, i] = np.sqrt(P[i, i])
    return len(here)
