"""One measurement against the state at its keyframe: whitened innovation and Jacobian, for smoother and filter alike.

    r = W (z - h(x(t), c)),  H = W dh/d(x, c)      x(t): the keyframe's state, propagated to the measurement's time

with the bias b + S k where the IMU's scale may be off by k (`rovgraph.engine.scale`).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compass import wrap
from rovgraph.kernels.compile import helper, kernel, view_helper
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.measurement_row import (
    ASSUMED,
    BEND,
    DIM,
    DP,
    DR,
    DT,
    DV,
    GAIN,
    KIND,
    LOSS,
    MOST,
    PARAMS,
    RATE,
    RATE_SD,
    SD,
    Z,
)
from rovgraph.kernels.measurements import WORK as PREDICT_WORK
from rovgraph.kernels.measurements import is_angular, predict
from rovgraph.kernels.propagation import WORK as PROPAGATE_WORK
from rovgraph.kernels.propagation import chain, propagate, propagation_jacobian
from rovgraph.kernels.weighting import loss_weight, whiten

Index = NDArray[np.int64]


class Scratch(NamedTuple):
    """Arrays to calculate with.

    Attributes
    ----------
    bias : shape (6,), of the keyframe and of the IMU's scale
    z, H : shapes (3,), (3, 15 + C), predicted measurement, then the innovation; its derivative
    W : shape (3, 3), square-root information, lower triangular
    R, there : shapes (3, 3), (2, 3), attitude, position and velocity at the measurement's time
    F : shape (15, 15), zero at first
    predicting, moving : shapes (WORK, 3, 3)
    used, column : shapes (u,), components of state and calibration that are estimated, and the column of each
    exact : shape (0, 0), bias by the IMU's scales where these are exact
    """

    bias: Array
    z: Array
    H: Array
    W: Array
    R: Array
    there: Array
    F: Array
    predicting: Array
    moving: Array
    used: Index
    column: Index
    exact: Array


@helper
def make_scratch(calibration_size: int, column: Index) -> Scratch:
    """Arrays for a calibration vector of that length; made once.

    ``column``, shape (15 + C,), is the column of each component of state and calibration, -1 where it is not
    estimated; of shape (0,) nothing is.
    """
    count, used, columns = 0, np.empty(len(column), np.int64), np.empty(len(column), np.int64)
    for j in range(len(column)):
        if column[j] >= 0:
            used[count], columns[count] = j, column[j]
            count += 1
    H, F = np.zeros((MOST, MOTION + calibration_size)), np.zeros((MOTION, MOTION))
    state = np.empty((3, 3)), np.empty((2, 3))
    work = np.empty((PREDICT_WORK, 3, 3)), np.empty((PROPAGATE_WORK, 3, 3))
    estimated = used[:count].copy(), columns[:count].copy()
    return Scratch(
        np.empty(6), np.empty(MOST), H, np.empty((MOST, MOST)), *state, F, *work, *estimated, np.empty((0, 0))
    )


@view_helper
def _innovate(
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    c: Array,
    row: Array,
    sensor: Array,
    scale: Array,
    gravity: float,
    derive: bool,
    scratch: Scratch,
) -> None:
    """Innovation and square-root information, and on request the derivative of the prediction, in ``scratch``."""
    kind, dim, dt = int(sensor[KIND]), int(sensor[DIM]), row[DT]
    bias, z, H, W = scratch.bias, scratch.z[:dim], scratch.H[:dim], scratch.W[:dim, :dim]
    for i in range(6):
        bias[i] = b[i]
        for k in range(len(scale)):
            bias[i] += scale[i, k] * c[ACC_SCALE + k]
    for a in range(dim):  # columns that are not estimated nobody reads
        for j in range(MOTION):
            H[a, j] = 0.0
        for j in scratch.used:
            H[a, j] = 0.0
    rate, params, work = row[RATE : RATE + 3], sensor[PARAMS:], scratch.predicting
    if dt != 0.0:
        dR, dv, dp = row[DR:DV].reshape(3, 3), row[DV:DP], row[DP:ASSUMED]
        there_R, there_p, there_v, motion = scratch.R, scratch.there[0], scratch.there[1], scratch.moving
        assumed = row[ASSUMED : ASSUMED + 6]
        propagate(R, p, v, bias, dt, dR, dv, dp, assumed, gravity, there_R, there_p, there_v, motion)
        predict(kind, there_R, there_p, there_v, bias, c, rate, params, z, H, work)
        if derive:
            propagation_jacobian(R, dt, scratch.F, motion)
            chain(H, scratch.F)
    else:
        predict(kind, R, p, v, bias, c, rate, params, z, H, work)
    if derive:
        for a in range(dim):
            for k in range(len(scale)):
                by_bias = 0.0
                for i in range(6):
                    by_bias += H[a, 9 + i] * scale[i, k]
                H[a, MOTION + ACC_SCALE + k] = by_bias
    whiten(row[SD : SD + dim], sensor[GAIN : GAIN + 9].reshape(3, 3)[:dim, :dim], row[RATE_SD], W)
    for a in range(dim):
        difference = row[Z + a] - z[a]
        z[a] = wrap(difference) if is_angular(kind) else difference


@view_helper
def squared_length(
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    c: Array,
    row: Array,
    sensor: Array,
    scale: Array,
    gravity: float,
    scratch: Scratch,
) -> float:
    """Squared length of the whitened innovation; parameters as `linearize_measurement`."""
    _innovate(R, p, v, b, c, row, sensor, scale, gravity, False, scratch)
    square = 0.0
    for a in range(int(sensor[DIM])):
        whitened = 0.0
        for k in range(a + 1):
            whitened += scratch.W[a, k] * scratch.z[k]
        square += whitened * whitened
    return square


@view_helper
def linearize_measurement(
    R: Array,
    p: Array,
    v: Array,
    b: Array,
    c: Array,
    row: Array,
    sensor: Array,
    scale: Array,
    gravity: float,
    scratch: Scratch,
    r_out: Array,
    H_out: Array,
) -> float:
    """Whitened innovation of one measurement, its derivative, and its squared length.

    Parameters
    ----------
    R, p, v, b : the keyframe's state, as `rovgraph.kernels.measurements.predict` takes it
    c : calibration vector
    row, sensor : of `rovgraph.kernels.measurement_row`
    scale : shape (6, 6), bias by the IMU's scales, or (0, 0) where these are exact
    gravity : [m/s^2]
    scratch : of `make_scratch`
    r_out, H_out : shapes (dim,), (dim, n), zero before
    """
    _innovate(R, p, v, b, c, row, sensor, scale, gravity, True, scratch)
    z, H, W, square = scratch.z, scratch.H, scratch.W, 0.0
    for a in range(int(sensor[DIM])):
        for k in range(a + 1):
            r_out[a] += W[a, k] * z[k]
        square += r_out[a] * r_out[a]
    for u in range(len(scratch.used)):
        j, own = scratch.used[u], scratch.column[u]
        for a in range(int(sensor[DIM])):
            for k in range(a + 1):
                H_out[a, own] += W[a, k] * H[k, j]
    return square


@kernel("void(f8[::1], f8[::1], f8[:, ::1], i8[::1], f8[:, ::1], i8[::1], f8[:, :, ::1], f8, b1, f8[::1], f8[:, ::1])")
def linearize(
    x: Array,
    c: Array,
    rows: Array,
    which: Index,
    sensors: Array,
    column: Index,
    scale: Array,
    gravity: float,
    weighted: bool,
    r_out: Array,
    H_out: Array,
) -> None:
    """Whitened innovations and Jacobians of m measurements of a keyframe, none of them `GIVEN`; as a filter takes.

    ``weighted`` ones are multiplied by the root of the weight of their loss.
    """
    begin, scratch = 0, make_scratch(len(c), column)
    R, p, v, b = x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21]
    for j in range(len(which)):
        sensor = sensors[which[j]]
        end = begin + int(sensor[DIM])
        own, r, H = scale[j] if len(scale) else scratch.exact, r_out[begin:end], H_out[begin:end]
        square = linearize_measurement(R, p, v, b, c, rows[j], sensor, own, gravity, scratch, r, H)
        if weighted:
            root = math.sqrt(loss_weight(square, int(sensor[LOSS]), sensor[BEND]))
            for a in range(begin, end):
                r_out[a] *= root
                for i in range(H_out.shape[1]):
                    H_out[a, i] *= root
        begin = end
