"""The filter over one interval, and over many in a row: correct, predict, correct.

`filter_intervals` does the work of `rovgraph.inference.filter.FilterEngine.step`, as far as kernels can: it stops
before an interval with a measurement that is `PRELINEARISED`, and where the attitude is so poorly known that it must
be found before the measurements are linearised there (`rovgraph.inference.filter`).

The prediction over one interval is

    x_j = f(x_i, b + S k),  e_j = F e_i + w,  P_j = F P_i F' + Q

    B_j = F B_i + F_y                                                     of considered variables

f, F and Q of pose, velocity and bias are the motion's (`rovgraph.kernels.motion`); k are the IMU's scale errors
where S is given. Calibration that walks adds its variance a second times the interval to Q; with a time constant it
is a first-order Gauss-Markov process (Gelb 1974), of which F keeps exp(-dt / T).
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import AnyMatrix, AnyVector, Index, Matrices, Matrix, Vector, helper, kernel, view_helper
from rovgraph.kernels.correction import Corrected, GivenRows, correct
from rovgraph.kernels.filter_state import FilterModel, FilterState
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.measurement_row import KIND, PRELINEARISED, MeasuredRows, some_of
from rovgraph.kernels.motion import predict_with_transition
from rovgraph.kernels.motion_row import DURATION
from rovgraph.kernels.states import Epoch, epoch_in, with_bias

MOVED = 9  # components that the motion mixes: rotation, position, velocity; biases and calibration stay


@helper
def carry(P: Array, F: Array, Q: Array) -> None:
    """P <- F P F' + Q, F the unit matrix but for its first rows and its diagonal; P stays symmetric."""
    n = len(P)
    FP, row = np.zeros((MOVED, n)), np.empty(MOVED)
    for i in range(MOVED):
        for j in range(n):
            share = F[i, j]
            if share != 0.0:
                for k in range(n):
                    FP[i, k] += share * P[j, k]
    for i in range(MOVED):
        for k in range(MOVED, n):
            P[i, k] = P[k, i] = FP[i, k]
    for i in range(MOVED):
        for k in range(i + 1):
            total = 0.0
            for j in range(n):
                total += FP[i, j] * F[k, j]
            row[k] = total
        for k in range(i + 1):
            P[i, k] = P[k, i] = row[k]
    for i in range(MOVED, n):
        if F[i, i] != 1.0:
            for k in range(n):
                P[i, k] *= F[i, i]
            for k in range(n):
                P[k, i] *= F[i, i]
    for i in range(n):
        for j in range(n):
            P[i, j] += Q[i, j]


@view_helper
def carry_considered(B: Array, F: Array, moved: Array, work: Array) -> None:
    """B <- F B + F_y, ``moved`` being the rows of F_y that are not zero; ``work`` (MOVED,) is to calculate with."""
    for k in range(B.shape[1]):
        for i in range(MOVED):
            work[i] = moved[i, k]
            for j in range(len(B)):
                work[i] += F[i, j] * B[j, k]
        for i in range(MOVED):
            B[i, k] = work[i]
        for i in range(MOVED, len(B)):
            B[i, k] *= F[i, i]


@helper
def predict_filter(
    known: FilterState, motion: Array, covariance: Array, scale: Array, model: FilterModel, F_out: Array, Q_out: Array
) -> None:
    """Carry an estimate over an interval, in place.

    Parameters
    ----------
    motion, covariance : row of `rovgraph.kernels.motion_row`, and that of its residual, shape (15, 15)
    scale : shape (6, 6), bias by the IMU's scales, or (0, 0) where these are exact
    F_out, Q_out : shape (n, n), transition and noise
    """
    x, c, P, B, L = known
    column, walk, estimated = model.column, model.walk, model.walk.shape[1]
    n, moved = len(P), np.zeros((MOVED, len(L)))
    bias, F, Q = x[15:21].copy(), np.zeros((MOTION, MOTION)), np.zeros((MOTION, MOTION))
    if len(scale):
        for i in range(6):
            for k in range(6):
                bias[i] += scale[i, k] * c[ACC_SCALE + k]
    there = np.empty(15)
    out = Epoch(there[0:9].reshape(3, 3), there[9:12], there[12:15], bias, c)
    predict_with_transition(motion, covariance, with_bias(epoch_in(x, c), bias), out, F, Q)
    for i in range(15):
        x[i] = there[i]
    F_out.fill(0.0)
    Q_out.fill(0.0)
    for i in range(n):
        F_out[i, i] = 1.0
    for i in range(estimated):
        Q_out[i, i] = walk[0, i] * motion[DURATION]
    for i in range(MOTION, len(column)):
        index = column[i]
        if 0 <= index < estimated and walk[1, index] > 0.0:
            rate = walk[1, index]
            keep = math.exp(-rate * motion[DURATION])
            F_out[index, index] = keep
            Q_out[index, index] = walk[0, index] * (1.0 - keep * keep) / (2.0 * rate)
            c[i - MOTION] = walk[2, index] + keep * (c[i - MOTION] - walk[2, index])
    for i in range(MOTION):
        for j in range(MOTION):
            F_out[i, j] = F[i, j]
            Q_out[i, j] += Q[i, j]
    if len(scale):
        for k in range(6):
            index = column[MOTION + ACC_SCALE + k]
            if index >= 0:  # a scale moves the state as the bias does that it makes, but not the bias itself
                for i in range(MOVED):
                    by = 0.0
                    for j in range(6):
                        by += F[i, MOVED + j] * scale[j, k]
                    if index < estimated:
                        F_out[i, index] += by
                    else:
                        for j in range(len(L)):
                            moved[i, j] += by * L[index - estimated, j]
    carry(P, F_out, Q_out)
    if len(L):
        carry_considered(B, F_out, moved, np.empty(MOVED))


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
    """Whether kernels have the equations of all measurements."""
    given = 0
    for j in range(len(which)):
        given += sensors[which[j], KIND] == PRELINEARISED
    return given == 0


@view_helper
def _copy(v: Array, v_out: Array) -> None:
    """The first components of a vector, as many as ``v_out`` has; a loop, since assigned slices compile slowly."""
    for i in range(len(v_out)):
        v_out[i] = v[i]


@view_helper
def _covariance(P: Array, B: Array, P_out: Array) -> None:
    """P + B B' of the first components."""
    for i in range(len(P_out)):
        for j in range(len(P_out)):
            total = P[i, j]
            for k in range(B.shape[1]):
                total += B[i, k] * B[j, k]
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
    motion : row of `rovgraph.kernels.motion_row`, or (0,) if all measurements are at one keyframe
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
    """Output of `take_interval` beside the estimate at the end.

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
    scales : shape (k, 6, 6) or (0, 6, 6), as of `rovgraph.kernels.elimination`
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
    """Output of `filter_intervals`.

    Attributes
    ----------
    x, c : shapes (k, 21), (k, C), the keyframes
    predicted_x, predicted_c : the same before what was measured at them
    covariance, sd : shapes (k, 15, 15), (k, size), of pose, velocity and bias, and of all of the error
    nis, weight : shape (m,), of the measurements
    """

    x: Matrix
    c: Matrix
    predicted_x: Matrix
    predicted_c: Matrix
    covariance: Matrices
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
        _covariance(P, B, out.covariance[k])
        for i in range(size):
            variance = P[i, i]
            for j in range(len(L)):
                variance += B[i, j] * B[i, j]
            out.sd[k, i] = np.sqrt(variance)
    return len(here)
