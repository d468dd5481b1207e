"""The filter over many intervals in a row: correct, predict, correct.

What `rovgraph.engine.filter.FilterEngine.step` does with one, as far as nothing is needed that no kernel knows: it
stops before an interval with a measurement that is `GIVEN`, and where the attitude is so poorly known that it has to
be found before it is linearised at (`rovgraph.engine.alignment`).
"""

from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import AnyMatrix, AnyVector, Index, Matrices, Matrix, Vector, helper, kernel, view_helper
from rovgraph.kernels.correction import Correct, Corrected, GivenRows
from rovgraph.kernels.filter_state import FilterModel, FilterState
from rovgraph.kernels.layout import VELOCITY
from rovgraph.kernels.measurement_row import GIVEN, KIND, MeasurementRows
from rovgraph.kernels.prediction import Predicted, PredictFilter


@helper
def attitude_variances(x: Array, P: Array) -> tuple[float, float]:
    """Variance of the tilt, the larger one, and of the heading [rad^2]; x and P as `filter_intervals` takes them."""
    variance = np.zeros(3)  # of turns about north, east and down
    for axis in range(3):
        for i in range(3):
            for j in range(3):
                variance[axis] += x[3 * axis + i] * P[i, j] * x[3 * axis + j]
    return max(variance[0], variance[1]), variance[2]


@kernel()
def attitude_variances_of(x: AnyVector, P: AnyMatrix) -> tuple[float, float]:
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


class Intervals(NamedTuple):
    """k intervals, and where a filter stops before one.

    Attributes
    ----------
    motions, scales : shapes (k, ROW), (k, 6, 6) or (0, 6, 6), as of `rovgraph.kernels.dive`
    taken : shape (k + 1,), the first measurement of each, and how many there are
    here : shape (k,), the first measurement at the keyframe that ends each
    poorly_known : shape (2,), variances of tilt and heading beyond which the attitude has to be found first [rad^2]
    """

    motions: Matrix
    scales: Matrices
    taken: Index
    here: Index
    poorly_known: Vector


class Filtered(NamedTuple):
    """What `filter_intervals` writes.

    Attributes
    ----------
    x, c : shapes (k, 21), (k, C), the keyframes
    predicted_x, predicted_c : the same before what was measured at them
    pose, velocity, sd : shapes (k, 6, 6), (k, 3, 3), (k, size), covariances, and sd of the error
    nis, weight : shape (m,), of the measurements
    """

    x: Matrix
    c: Matrix
    predicted_x: Matrix
    predicted_c: Matrix
    pose: Matrices
    velocity: Matrices
    sd: Matrix
    nis: Vector
    weight: Vector


@kernel()
def filter_intervals(
    known: FilterState,
    intervals: Intervals,
    measured: MeasurementRows,
    model: FilterModel,
    since: Vector,
    out: Filtered,
    correct: Correct,
    predict_filter: PredictFilter,
) -> int:
    """Take up to k intervals.

    Parameters
    ----------
    known : the keyframe before them, afterwards that at the end of the last one that is taken
    measured : of the intervals
    since : as `rovgraph.kernels.correction.correct`
    correct, predict_filter : of `rovgraph.kernels.correction` and `rovgraph.kernels.prediction`

    Returns
    -------
    How many intervals are taken
    """
    x, c, P, B, L = known
    rows, which, scales = measured
    taken, here = intervals.taken, intervals.here
    size, nothing = model.walk.shape[1], np.empty(0)
    given = GivenRows(nothing, np.empty((0, len(L))))
    exact, there = np.empty((0, 0)), np.empty(21)
    predicted = Predicted(there, c, np.empty((size, size)), np.empty((size, size)))
    for k in range(len(here)):
        tilt, heading = attitude_variances(x, P)
        poorly_known = tilt > intervals.poorly_known[0] or heading > intervals.poorly_known[1]
        if poorly_known or not knows_all(which[taken[k] : taken[k + 1]], model.sensors):
            return k
        for arrived in range(2):
            if arrived:
                scale = intervals.scales[k] if len(intervals.scales) else exact
                predict_filter(known, intervals.motions[k], scale, model, predicted)
                _copy(there, x)
                _copy(x, out.predicted_x[k])
                _copy(c, out.predicted_c[k])
            begin, end = (here[k], taken[k + 1]) if arrived else (taken[k], here[k])
            if begin < end:
                some = MeasurementRows(rows[begin:end], which[begin:end], scales[begin:end])
                corrected = Corrected(out.nis[begin:end], out.weight[begin:end], nothing)
                correct(known, some, given, model, since, True, corrected)
        _copy(x, out.x[k])
        _copy(c, out.c[k])
        _covariance(P, B, 0, out.pose[k])
        _covariance(P, B, VELOCITY, out.velocity[k])
        for i in range(size):
            variance = P[i, i]
            for j in range(len(L)):
                variance += B[i, j] * B[i, j]
            out.sd[k, i] = np.sqrt(variance)
    return len(here)
