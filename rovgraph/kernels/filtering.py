"""The filter over one interval, and over many in a row: correct, predict, correct.

`filter_intervals` is what `rovgraph.engine.filter.FilterEngine.step` does, as far as nothing is needed that no kernel
knows: it stops before an interval with a measurement that is `GIVEN`, and where the attitude is so poorly known that
it has to be found before it is linearised at (`rovgraph.engine.alignment`).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import AnyMatrix, AnyVector, Index, Matrices, Matrix, Vector, helper, kernel, view_helper
from rovgraph.kernels.correction import Corrected, GivenRows, correct
from rovgraph.kernels.filter_state import FilterModel, FilterState
from rovgraph.kernels.layout import VELOCITY
from rovgraph.kernels.measurement_row import GIVEN, KIND, MeasuredRows, some_of
from rovgraph.kernels.prediction import predict_filter


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


@view_helper
def _keep(known: FilterState, out: FilterState) -> None:
    """Copy an estimate, as far as there is room for it."""
    _copy(known.x, out.x)
    _copy(known.c, out.c)
    for i in range(len(out.P)):
        _copy(known.P[i], out.P[i])
        _copy(known.B[i], out.B[i])


class Interval(NamedTuple):
    """One interval and its m measurements.

    Attributes
    ----------
    motion : row of `rovgraph.kernels.motion_row`, or (0,): there is none, and all is measured at one keyframe
    covariance : of the motion's residual, shape (15, 15)
    scale : shape (6, 6), bias by the IMU's scales, or (0, 0) where these are exact
    measured : its measurements
    between : how many of them, the first ones, belong to the keyframe before
    given_r, given_H : of `GivenRows`
    """

    motion: Vector
    covariance: Matrix
    scale: Matrix
    measured: MeasuredRows
    between: int
    given_r: Vector
    given_H: Matrix


class Taken(NamedTuple):
    """What `take_interval` writes beside the estimate at the end.

    Attributes
    ----------
    departed, predicted : the keyframe before, corrected, and that after it, not yet corrected; or
        empty arrays where these are not asked for
    F, Q : shape (n, n), transition from one to the other, and its noise
    nis, weight : shape (m,), of the measurements; weight 0 = left out
    places : correction of the places at the last keyframe
    """

    departed: FilterState
    predicted: FilterState
    F: Matrix
    Q: Matrix
    nis: Vector
    weight: Vector
    places: Vector


TakeInterval = Callable[[FilterState, Interval, FilterModel, Vector, bool, Taken], None]  # type of `take_interval`


@kernel(by_address=True)
def take_interval(
    known: FilterState, interval: Interval, model: FilterModel, since: Vector, gated: bool, out: Taken
) -> None:
    """Take one interval.

    Parameters
    ----------
    known : the keyframe before it, afterwards that at its end
    since : shape (s,), since when each sensor is left out, nan where it is not [s]
    gated : False lets everything in
    """
    used, between = 0, interval.between
    for arrived in range(2):
        if arrived and len(interval.motion):
            _keep(known, out.departed)
            predict_filter(known, interval.motion, interval.covariance, interval.scale, model, out.F, out.Q)
            _keep(known, out.predicted)
        begin, end = (between, len(interval.measured.which)) if arrived else (0, between)
        if begin < end:
            measured = some_of(interval.measured, begin, end)
            given = GivenRows(interval.given_r[used:], interval.given_H[used:])
            corrected = Corrected(out.nis[begin:end], out.weight[begin:end], out.places)
            used += correct(known, measured, given, model, since, gated, corrected)


class Intervals(NamedTuple):
    """k intervals, and where a filter stops before one.

    Attributes
    ----------
    motions, covariances : shapes (k, ROW), (k, 15, 15), of their residuals
    scales : shape (k, 6, 6) or (0, 6, 6), as of `rovgraph.kernels.dive`
    taken : shape (k + 1,), the first measurement of each, and how many there are
    here : shape (k,), the first measurement at the keyframe that ends each
    poorly_known : shape (2,), variances of tilt and heading beyond which the attitude has to be found first [rad^2]
    """

    motions: Matrix
    covariances: Matrices
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
    measured: MeasuredRows,
    model: FilterModel,
    since: Vector,
    out: Filtered,
    take_interval: TakeInterval,
) -> int:
    """Take up to k intervals.

    Parameters
    ----------
    known : the keyframe before them, afterwards that at the end of the last one that is taken
    measured : of the intervals
    since, take_interval : of `take_interval`

    Returns
    -------
    How many intervals are taken
    """
    x, c, P, B, L = known
    taken, here = intervals.taken, intervals.here
    size, exact, nothing, none = model.walk.shape[1], np.empty((0, 0)), np.empty(0), np.empty((0, len(L)))
    F, Q, untold = np.empty((size, size)), np.empty((size, size)), FilterState(nothing, nothing, exact, exact, exact)
    for k in range(len(here)):
        tilt, heading = attitude_variances(x, P)
        begin, end = taken[k], taken[k + 1]
        poorly_known = tilt > intervals.poorly_known[0] or heading > intervals.poorly_known[1]
        if poorly_known or not knows_all(measured.which[begin:end], model.sensors):
            return k
        scale = intervals.scales[k] if len(intervals.scales) else exact
        some = some_of(measured, begin, end)
        motion, covariance = intervals.motions[k], intervals.covariances[k]
        interval = Interval(motion, covariance, scale, some, here[k] - begin, nothing, none)
        predicted = FilterState(out.predicted_x[k], out.predicted_c[k], exact, exact, exact)
        taken_out = Taken(untold, predicted, F, Q, out.nis[begin:end], out.weight[begin:end], nothing)
        take_interval(known, interval, model, since, True, taken_out)
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
