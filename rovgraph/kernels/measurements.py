"""Measurement equations with their derivatives, for one epoch and for many.

Each equation is written once, here and in `rovgraph.kernels.compass`; simulator, graph, filters and observability
call it through the models of `rovgraph.sensors`, the filter's kernel calls `predict`.

==============  =========================================================  ==================
kind            equation                                                   source
==============  =========================================================  ==================
DVL             z = (1 + k + e) R_sb (R_bn (v_n - u_n) + (w - b_g)         (3.16), (3.17)
                x (l + dl)), u the velocity of the bottom
DVL_WATER       the same with c for u, c the current, without e
DVL_COMPASS     z = h + A + e + B sin h + C cos h, h the DVL's heading     (3.17); deviation
                less the declination, e an error that lasts                curve: Bowditch
COMPASS         the same, with an x axis that is known
MAGNETOMETER    z = |H| ((1 + s) S R_sb R_bn u(declination - A - ...,      (3.11), (3.14),
                dip + d) + iron)                                           S: (3.2)
POSITION        some of (1 + k) (p + R_nb l) + offset + e, north, east, down
PLACE_OFFSET    z = (p + R_nb l)_north,east - m, m where the place is
WATER_VELOCITY  z = (R_bn c_n)_forward,starboard
TILT            z = roll and pitch of R_nb
==============  =========================================================  ==================

Arguments of `predict`:

    state      calibration vector and all; of PLACE_OFFSET, north and east of the place follow that vector and are its
               last two
    rate       shape (3,), measured angular rate in b, its bias still in it [rad/s]
    params     the model's own numbers, as ``packed`` of each model in `rovgraph.sensors` says
    z_out      shape (dim,)
    H_out      shape (dim, 15 + len(c)), derivative by the error of the state and by c

Of ``H_out`` a kind writes the columns that it depends on, and always the same ones, so that a buffer which was zero
at first can be used again and again:

    DVL, DVL_WATER   rotation, velocity, gyro, dvl_roll to dvl_lever_arm; dvl_error and
                     bottom_velocity, DVL_WATER: current
    DVL_COMPASS      rotation, its offset, error and curve, dvl_roll to dvl_yaw
    COMPASS          rotation, its offset, error and curve
    MAGNETOMETER     rotation, mag_offset to field_scale
    POSITION         rotation, translation, its scale, offset and error
    PLACE_OFFSET     rotation, translation, the last two
    WATER_VELOCITY   rotation, current
    TILT             rotation
"""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compass import compass, dvl_mount, magnetometer, tilt
from rovgraph.kernels.compile import Index, Matrices, Matrix, kernel, view_helper
from rovgraph.kernels.layout import (
    BOTTOM_VELOCITY,
    CURRENT,
    DVL_ERROR,
    DVL_LEVER_ARM,
    DVL_ROLL,
    DVL_SCALE,
    GYR_BIAS,
    MOTION,
    TRANSLATION,
    VELOCITY,
)
from rovgraph.kernels.rotations import cross, dot, rotate, rotate_back
from rovgraph.kernels.states import Epoch, States

DVL, DVL_WATER, DVL_COMPASS, COMPASS, MAGNETOMETER, POSITION, PLACE_OFFSET, WATER_VELOCITY, TILT = range(9)
WORK = 6  # matrices (3, 3) that `predict` needs to calculate with


@view_helper
def is_angular(kind: int) -> bool:
    """Whether the components are angles, so that differences wrap."""
    return kind in (DVL_COMPASS, COMPASS, TILT)


@view_helper
def dvl_velocity(
    state: Epoch, rate: Array, params: Array, water: bool, z_out: Array, H_out: Array, work: Array
) -> None:
    """Velocity of the DVL in its own axes, over ground or relative to the water."""
    R, v, b, c = state.R, state.v, state.b, state.c
    R_bs, axes = work[0], work[1]
    body, w, arm, v_b, row, turn = work[2, 0], work[2, 1], work[2, 2], work[3, 0], work[3, 1], work[3, 2]
    dvl_mount(c[DVL_ROLL], c[DVL_ROLL + 1], c[DVL_ROLL + 2], R_bs, axes)
    for i in range(3):
        w[i] = rate[i] - b[3 + i]
        arm[i] = params[i] + c[DVL_LEVER_ARM + i]
        row[i] = v[i]
    below = CURRENT if water else BOTTOM_VELOCITY
    row[0] -= c[below]
    row[1] -= c[below + 1]
    rotate_back(R, row, body)
    cross(w, arm, v_b)
    for i in range(3):
        v_b[i] += body[i]
    gain = 1.0 + c[DVL_SCALE]
    if not water:  # the bottom's slope is the bottom's
        gain += c[DVL_ERROR]
    for i in range(3):
        for k in range(3):
            row[k] = gain * R_bs[k, i]  # of (1 + k) R_sb; a row times S(u) is the row x u
        z_out[i] = dot(row, v_b)
        cross(row, body, H_out[i, 0:3])
        rotate(R, row, H_out[i, VELOCITY : VELOCITY + 3])
        cross(row, arm, H_out[i, GYR_BIAS : GYR_BIAS + 3])
        cross(row, w, H_out[i, MOTION + DVL_LEVER_ARM : MOTION + DVL_LEVER_ARM + 3])
        cross(row, v_b, turn)
        rotate_back(axes, turn, H_out[i, MOTION + DVL_ROLL : MOTION + DVL_ROLL + 3])
        H_out[i, MOTION + DVL_SCALE] = z_out[i] / gain
        H_out[i, MOTION + below] = -H_out[i, VELOCITY]
        H_out[i, MOTION + below + 1] = -H_out[i, VELOCITY + 1]
        if not water:
            H_out[i, MOTION + DVL_ERROR] = H_out[i, MOTION + DVL_SCALE]


@view_helper
def _point(R: Array, p: Array, lever_arm_b: Array, axis: int, H_out: Array) -> float:
    """One component in n of a point on the vehicle; ``H_out`` is its row."""
    row = R[axis]
    cross(lever_arm_b, row, H_out[0:3])
    for k in range(3):
        H_out[TRANSLATION + k] = row[k]
    return p[axis] + dot(row, lever_arm_b)  # type: ignore[no-any-return]


@view_helper
def position(R: Array, p: Array, c: Array, params: Array, z_out: Array, H_out: Array) -> None:
    """Some of north, east, down of a point on the vehicle, with errors of scale, constant and lasting."""
    offset, scale, error = int(params[3]), int(params[4]), int(params[5])
    for i in range(len(z_out)):
        z_out[i] = _point(R, p, params[0:3], int(params[6 + i]), H_out[i])
        if scale >= 0:
            larger = 1.0 + c[scale]
            for k in range(TRANSLATION + 3):
                H_out[i, k] *= larger
            H_out[i, MOTION + scale] = z_out[i]
            z_out[i] *= larger
        if offset >= 0:
            z_out[i] += c[offset + i]
            H_out[i, MOTION + offset + i] = 1.0
        if error >= 0:
            z_out[i] += c[error + i]
            H_out[i, MOTION + error + i] = 1.0


@view_helper
def place_offset(R: Array, p: Array, c: Array, params: Array, z_out: Array, H_out: Array) -> None:
    """North and east from a place to a point on the vehicle."""
    place = len(c) - 2
    for i in range(2):
        z_out[i] = _point(R, p, params[0:3], i, H_out[i]) - c[place + i]
        H_out[i, MOTION + place + i] = -1.0


@view_helper
def water_velocity(R: Array, c: Array, z_out: Array, H_out: Array) -> None:
    """Forward and starboard components of the water's velocity."""
    north, east = c[CURRENT], c[CURRENT + 1]
    for i in range(2):
        z_out[i] = R[0, i] * north + R[1, i] * east
        H_out[i, MOTION + CURRENT], H_out[i, MOTION + CURRENT + 1] = R[0, i], R[1, i]
    down = R[0, 2] * north + R[1, 2] * east
    H_out[0, 0], H_out[0, 1], H_out[0, 2] = 0.0, -down, z_out[1]
    H_out[1, 0], H_out[1, 1], H_out[1, 2] = down, 0.0, -z_out[0]


@view_helper
def predict(kind: int, state: Epoch, rate: Array, params: Array, z_out: Array, H_out: Array, work: Array) -> None:
    """The measurement that a state predicts, and its derivatives; ``work`` has shape (WORK, 3, 3)."""
    R, p, c = state.R, state.p, state.c
    if kind in (DVL, DVL_WATER):
        dvl_velocity(state, rate, params, kind == DVL_WATER, z_out, H_out, work)
    elif kind in (DVL_COMPASS, COMPASS):
        compass(R, c, params, kind == DVL_COMPASS, z_out, H_out, work)
    elif kind == MAGNETOMETER:
        magnetometer(R, c, params, z_out, H_out, work)
    elif kind == POSITION:
        position(R, p, c, params, z_out, H_out)
    elif kind == PLACE_OFFSET:
        place_offset(R, p, c, params, z_out, H_out)
    elif kind == WATER_VELOCITY:
        water_velocity(R, c, z_out, H_out)
    elif kind == TILT:
        tilt(R, z_out, H_out)


@kernel()
def predict_many(
    kind: int, states: States, rate: Matrix, params: Matrix, columns: Index, z_out: Matrix, H_out: Matrices
) -> None:
    """`predict` of n epochs: every array with the epochs in front, or with one row for all of them.

    Of the Jacobians ``H_out``, shape (n, dim, len(columns)), has some ``columns``: over a long dive all of them
    would be mostly zeros.
    """
    R, p, v, b, c = states
    H, work = np.zeros((z_out.shape[1], MOTION + c.shape[1])), np.empty((WORK, 3, 3))
    # a row that stands for all epochs stays
    of_R, of_p, of_v, of_b = len(R) > 1, len(p) > 1, len(v) > 1, len(b) > 1
    of_c, of_rate, of_params = len(c) > 1, len(rate) > 1, len(params) > 1
    for k in range(len(z_out)):
        state = Epoch(R[k * of_R], p[k * of_p], v[k * of_v], b[k * of_b], c[k * of_c])
        predict(kind, state, rate[k * of_rate], params[k * of_params], z_out[k], H, work)
        for i in range(len(H)):
            for j in range(len(columns)):
                H_out[k, i, j] = H[i, columns[j]]
