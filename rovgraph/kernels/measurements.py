"""Measurement equations with their derivatives, for one epoch and for many.

Each equation is written once, here. Simulator, graph, filters and observability call it through the models of
`rovgraph.sensors`; kernels call `predict`.

==============  =========================================================  ==================
kind            equation                                                   source
==============  =========================================================  ==================
DVL             z = (1 + k + e) R_sb (R_bn (v_n - u_n) + (w - b_g)         (3.16), (3.17)
                x (l + dl)), u the velocity of the bottom
DVL_WATER       the same with c for u, c the current, without e
DVL_BEAM        z = (1 + k + e + s h) (d + a t) . u + d . f, u of DVL     Janus geometry:
                without its scale, d the beam's direction, t how it goes   Gordon 1996 (RDI)
                with its angle, h the altitude
WATER_LAYER     DVL_WATER with (1 - f) c_i + f c_j for c, of the knots
                above and below
DVL_COMPASS     z = h + A + e + B sin h + C cos h, h the DVL's heading     (3.17); deviation
                less the declination, e an error that lasts                curve: Bowditch
COMPASS         the same, with an x axis that is known
MAGNETOMETER    z = |H| ((1 + s) S R_sb R_bn u(declination - A - ...,      (3.11), (3.14),
                dip + d) + iron)                                           S: (3.2)
POSITION        some of (1 + k) (p + s R_nb l) + offset + e, north, east,   s: `earth.scales`
                down
PLACE_OFFSET    z = (p + s R_nb l)_north,east - m, m where the place is
WATER_VELOCITY  z = (R_bn c_n)_forward,starboard
TILT            z = roll and pitch of R_nb
ACOUSTIC        z = (1 + k) r + offset + clock + e; and 0, 0, less how     ranges both ways, below
                far the direction lies from the one that is seen
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
    DVL_BEAM         the same as DVL, dvl_bias, dvl_altitude_scale, and its angle
    WATER_LAYER      the same as DVL_WATER, of water_layer_1 to the last or current
    DVL_COMPASS      rotation, its offset, error and curve, dvl_roll to dvl_yaw
    COMPASS          rotation, its offset, error and curve
    MAGNETOMETER     rotation, mag_offset to field_scale
    POSITION         rotation, translation, its scale, offset and error
    PLACE_OFFSET     rotation, translation, the last two
    WATER_VELOCITY   rotation, current
    TILT             rotation
    ACOUSTIC         rotation, translation, velocity, and what its context names

The heading, a compass's deviation and the magnetometer in full:

    h = atan2(u_e, u_n) - declination, u = R_nb a, a the instrument's x axis in b
    deviation = A + e + B sin h + C cos h, e an error that lasts          Bowditch
    compass       z = h + deviation                                       (3.17)
    magnetometer  z = |H| ((1 + s) S R_sb R_bn u(declination - deviation, dip + d) + iron)
                                                                          (3.11), (3.14), S: (3.2)

An acoustic exchange in full, with the head on a ship; q is the transponder, T the head:

    r = (|q(asked) - T(asked)| + |q(heard) - T(heard)|) / 2               two way; one way the second alone,
                                                                          of two receivers the second less the first
    u = R_hs R_sn (q - T) / |q - T|                                       direction in the head's axes
    z = (B' u) a / sin a, a the angle between u and the measured m        B: across and up, both at right angles to m

A bearing turns fast where the vehicle is below the ship; the two components across m do not. With the head on the
vehicle the ends are exchanged.

Signs follow the corrected equations: declination is atan2(H_e, H_n), the heading is clockwise from north.
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Index, Matrices, Matrix, kernel, view_helper
from rovgraph.kernels.earth import latitude_at, scales
from rovgraph.kernels.layout import (
    BOTTOM_VELOCITY,
    CURRENT,
    DVL_ALTITUDE_SCALE,
    DVL_BIAS,
    DVL_ERROR,
    DVL_LEVER_ARM,
    DVL_ROLL,
    DVL_SCALE,
    FIELD_DIP,
    FIELD_SCALE,
    GYR_BIAS,
    HARD_IRON,
    MAG_DEVIATION,
    MAG_OFFSET,
    MOTION,
    SOFT_IRON,
    TRANSLATION,
    VELOCITY,
    WATER_LAYER_1,
    WATER_LAYER_14,
)
from rovgraph.kernels.measurement_row import (
    ABOVE_AT,
    ALTITUDE,
    ARM,
    ARM_AT,
    ASKED,
    BEACON_AT,
    BEAM,
    BEAM_ARM,
    BEAM_AT,
    BEAM_TILT,
    BELOW_AT,
    CLOCK_AT,
    DIRECTION_AT,
    DOWN_AT,
    DRIFT_AT,
    FRAME,
    HEARD,
    INVERTED,
    LATE_AT,
    LAYER_ARM,
    MOUNT_AT,
    MOVES,
    OFFSET_AT,
    ORIGIN,
    RANGE_AT,
    SCALE_AT,
    SEEN,
    SHARE,
    SINCE,
    STATED,
    TURNS,
    WAIT,
    WAYS,
)
from rovgraph.kernels.rotations import cross, dot, exp_rotation, multiply, multiply_transposed, rotate, rotate_back
from rovgraph.kernels.states import Epoch, States


@view_helper
def wrap(angle: float) -> float:
    """Angle wrapped to [-pi, pi) [rad]."""
    wrapped: float = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped


@view_helper
def dvl_mount(roll: float, pitch: float, yaw: float, R_bs_out: Array, axes_out: Array) -> None:
    """R_bs = Rz(yaw) Ry(pitch) Rx(roll), and the axes in b that the three angles turn about, a column each."""
    cr, cp, cy = math.cos(roll), math.cos(pitch), math.cos(yaw)
    sr, sp, sy = math.sin(roll), math.sin(pitch), math.sin(yaw)
    R_bs_out[0, 0], R_bs_out[0, 1], R_bs_out[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R_bs_out[1, 0], R_bs_out[1, 1], R_bs_out[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R_bs_out[2, 0], R_bs_out[2, 1], R_bs_out[2, 2] = -sp, cp * sr, cp * cr
    axes_out[0, 0], axes_out[0, 1], axes_out[0, 2] = R_bs_out[0, 0], -sy, 0.0
    axes_out[1, 0], axes_out[1, 1], axes_out[1, 2] = R_bs_out[1, 0], cy, 0.0
    axes_out[2, 0], axes_out[2, 1], axes_out[2, 2] = R_bs_out[2, 0], 0.0, 1.0


@view_helper
def heading_of(R: Array, axis_b: Array, gradient_out: Array) -> float:
    """Heading of an axis of the body, true; a rotation d of the body changes it by ``gradient . d``."""
    north, east = dot(R[0], axis_b), dot(R[1], axis_b)
    # du = R_nb (d x a), dh = (north du_e - east du_n) / (north^2 + east^2)
    square = north * north + east * east
    x = (north * R[1, 0] - east * R[0, 0]) / square
    y = (north * R[1, 1] - east * R[0, 1]) / square
    z = (north * R[1, 2] - east * R[0, 2]) / square
    gradient_out[0] = axis_b[1] * z - axis_b[2] * y
    gradient_out[1] = axis_b[2] * x - axis_b[0] * z
    gradient_out[2] = axis_b[0] * y - axis_b[1] * x
    return math.atan2(east, north)


@view_helper
def compass(R: Array, p: Array, c: Array, params: Array, in_dvl: bool, z_out: Array, H_out: Array, work: Array) -> None:
    """Heading of an instrument's x axis, of the DVL's with the mounting that the calibration has.

    The declination changes with the place, by so little for a metre that the heading does not show the place.
    """
    R_bs, axes, axis, gradient = work[0], work[1], work[2, 0], work[2, 1]
    offset, curve, error = int(params[1]), int(params[2]), int(params[3])
    if in_dvl:
        dvl_mount(c[DVL_ROLL], c[DVL_ROLL + 1], c[DVL_ROLL + 2], R_bs, axes)
    for i in range(3):
        axis[i] = R_bs[i, 0] if in_dvl else params[4 + i]
    heading = heading_of(R, axis, gradient) - (params[0] + params[7] * p[0] + params[8] * p[1])
    sine, cosine = math.sin(heading), math.cos(heading)
    deviation = c[offset] + c[curve] * sine + c[curve + 1] * cosine
    if error >= 0:
        deviation += c[error]
        H_out[0, MOTION + error] = 1.0
    z_out[0] = wrap(heading + deviation)

    gain = 1.0 + c[curve] * cosine - c[curve + 1] * sine
    for i in range(3):
        gradient[i] *= gain
        H_out[0, i] = gradient[i]
    H_out[0, MOTION + offset] = 1.0
    H_out[0, MOTION + curve], H_out[0, MOTION + curve + 1] = sine, cosine
    if in_dvl:
        for k in range(3):
            by_angle = gradient[0] * axes[0, k] + gradient[1] * axes[1, k] + gradient[2] * axes[2, k]
            H_out[0, MOTION + DVL_ROLL + k] = by_angle


@view_helper
def tilt(R: Array, z_out: Array, H_out: Array) -> None:
    """Roll and pitch of the body: atan2(d_y, d_z) and -asin(d_x), d the direction down in b."""
    x, y, z = R[2, 0], R[2, 1], R[2, 2]
    across = y * y + z * z  # a rotation e of the body changes d by d x e
    z_out[0], z_out[1] = math.atan2(y, z), -math.asin(min(max(x, -1.0), 1.0))
    H_out[0, 0], H_out[0, 1], H_out[0, 2] = 1.0, -x * y / across, -x * z / across
    H_out[1, 0], H_out[1, 1], H_out[1, 2] = 0.0, z / math.sqrt(across), -y / math.sqrt(across)


@view_helper
def _field_turns(declination: float, dip: float, out: Array) -> None:
    """Unit vector of the field in n, its derivative by the dip and that by the declination, as columns."""
    cos_d, sin_d, cos_i, sin_i = math.cos(declination), math.sin(declination), math.cos(dip), math.sin(dip)
    out[0, 0], out[0, 1], out[0, 2] = cos_i * cos_d, -sin_i * cos_d, -cos_i * sin_d
    out[1, 0], out[1, 1], out[1, 2] = cos_i * sin_d, -sin_i * sin_d, cos_i * cos_d
    out[2, 0], out[2, 1], out[2, 2] = sin_i, cos_i, 0.0


@view_helper
def _soft_iron(soft: Array, S_out: Array) -> None:
    """I + the symmetric matrix of components xx, yy, zz, xy, xz, yz."""
    for i in range(3):
        S_out[i, i] = 1.0 + soft[i]
    S_out[0, 1] = S_out[1, 0] = soft[3]
    S_out[0, 2] = S_out[2, 0] = soft[4]
    S_out[1, 2] = S_out[2, 1] = soft[5]


@view_helper
def _by_soft_iron(w: Array, H_out: Array) -> None:
    """Derivative of S w by the components of S."""
    first = MOTION + SOFT_IRON
    for i in range(3):
        H_out[i, first + i] = w[i]
    H_out[0, first + 3], H_out[1, first + 3] = w[1], w[0]
    H_out[0, first + 4], H_out[2, first + 4] = w[2], w[0]
    H_out[1, first + 5], H_out[2, first + 5] = w[2], w[1]


@view_helper
def magnetometer(R: Array, p: Array, c: Array, params: Array, z_out: Array, H_out: Array, work: Array) -> None:
    """Magnetic field in IMU axes, with deviation, soft iron and hard iron; its declination as that of `compass`."""
    declination = params[0] + params[12] * p[0] + params[13] * p[1]
    turns_n, turns_b, S, A, M, seen = work[0], work[1], work[2], work[3], work[4], work[0]
    u_b, gradient, w = work[5, 0], work[5, 1], work[5, 2]
    magnitude, gain = params[2], 1.0 + c[FIELD_SCALE]
    for i in range(3):
        u_b[i] = params[3 + 3 * i]  # the x axis, for its heading
        for k in range(3):
            A[i, k] = magnitude * gain * params[3 + 3 * k + i]
    heading = heading_of(R, u_b, gradient) - declination
    sine, cosine = math.sin(heading), math.cos(heading)
    B, C = c[MAG_DEVIATION], c[MAG_DEVIATION + 1]
    slope = B * cosine - C * sine
    _field_turns(declination - (c[MAG_OFFSET] + B * sine + C * cosine), params[1] + c[FIELD_DIP], turns_n)
    multiply_transposed(R, turns_n, turns_b)
    _soft_iron(c[SOFT_IRON : SOFT_IRON + 6], S)
    multiply(S, A, M)
    multiply(M, turns_b, seen)
    for i in range(3):
        u_b[i] = turns_b[i, 0]
    rotate(A, u_b, w)
    _by_soft_iron(w, H_out)
    for i in range(3):
        field, by_dip, by_deviation = seen[i, 0], seen[i, 1], -seen[i, 2]
        z_out[i] = field + magnitude * c[HARD_IRON + i]
        cross(M[i], u_b, H_out[i, 0:3])
        for k in range(3):
            H_out[i, k] += by_deviation * slope * gradient[k]
        H_out[i, MOTION + MAG_OFFSET] = by_deviation
        H_out[i, MOTION + MAG_DEVIATION] = by_deviation * sine
        H_out[i, MOTION + MAG_DEVIATION + 1] = by_deviation * cosine
        H_out[i, MOTION + HARD_IRON + i] = magnitude
        H_out[i, MOTION + FIELD_DIP] = by_dip
        H_out[i, MOTION + FIELD_SCALE] = field / gain


DVL, DVL_WATER, DVL_COMPASS, COMPASS, MAGNETOMETER, POSITION, PLACE_OFFSET, WATER_VELOCITY, TILT = range(9)
ACOUSTIC, DVL_BEAM, WATER_LAYER = 9, 10, 11
WORK = 8  # matrices (3, 3) that `predict` needs to calculate with


@view_helper
def is_angular(kind: int) -> bool:
    """Whether the components are angles, so that differences wrap."""
    return kind in (DVL_COMPASS, COMPASS, TILT)


@view_helper
def has_context(kind: int) -> bool:
    """Whether its numbers come with each measurement, and not with the sensor."""
    return kind in (ACOUSTIC, DVL_BEAM, WATER_LAYER)


@view_helper
def dvl_velocity(
    state: Epoch, rate: Array, params: Array, water: bool, z_out: Array, H_out: Array, work: Array
) -> None:
    """Velocity of the DVL in its own axes, over ground or relative to the water."""
    c = state.c
    R_bs, row, gain = work[0], work[3, 1], 1.0 + c[DVL_SCALE]
    below = CURRENT if water else BOTTOM_VELOCITY
    _dvl_motion(state, rate, params, c[below], c[below + 1], work)
    if not water:  # the bottom's slope is the bottom's
        gain += c[DVL_ERROR]
    for i in range(3):
        for k in range(3):
            row[k] = gain * R_bs[k, i]  # of (1 + k) R_sb
        z_out[i] = _along(state, gain, below, H_out[i], work)
        if not water:
            H_out[i, MOTION + DVL_ERROR] = H_out[i, MOTION + DVL_SCALE]


@view_helper
def water_layer(state: Epoch, rate: Array, x: Array, z_out: Array, H_out: Array, work: Array) -> None:
    """Velocity of the DVL in its own axes, relative to a layer of the water, whose context is ``x``."""
    c, above, below, share = state.c, int(x[ABOVE_AT]), int(x[BELOW_AT]), x[SHARE]
    R_bs, row, gain = work[0], work[3, 1], 1.0 + c[DVL_SCALE]
    for i in range(3):  # of the knots of other layers
        for j in range(MOTION + WATER_LAYER_1, MOTION + WATER_LAYER_14 + 2):
            H_out[i, j] = 0.0
    north = (1.0 - share) * c[above] + share * c[below]
    east = (1.0 - share) * c[above + 1] + share * c[below + 1]
    _dvl_motion(state, rate, x[LAYER_ARM : LAYER_ARM + 3], north, east, work)
    for i in range(3):
        for k in range(3):
            row[k] = gain * R_bs[k, i]
        z_out[i] = _along(state, gain, above, H_out[i], work)
        for k in range(2):
            H_out[i, MOTION + above + k] *= 1.0 - share
            if below != above:
                H_out[i, MOTION + below + k] = -share * H_out[i, VELOCITY + k]


@view_helper
def _dvl_motion(state: Epoch, rate: Array, arm_b: Array, north: float, east: float, work: Array) -> None:
    """The DVL's mounting and velocity: ``work`` has R_bs, the axes of its angles, and in row 2 velocity of the state's
    origin, rate and lever arm, in 3, 0 the DVL's velocity over what moves ``north`` and ``east``, all in b."""
    c, body, w, arm, v_b, row = state.c, work[2, 0], work[2, 1], work[2, 2], work[3, 0], work[3, 1]
    dvl_mount(c[DVL_ROLL], c[DVL_ROLL + 1], c[DVL_ROLL + 2], work[0], work[1])
    for i in range(3):
        w[i] = rate[i] - state.b[3 + i]
        arm[i] = arm_b[i] + c[DVL_LEVER_ARM + i]
        row[i] = state.v[i]
    row[0] -= north
    row[1] -= east
    rotate_back(state.R, row, body)
    cross(w, arm, v_b)
    for i in range(3):
        v_b[i] += body[i]


@view_helper
def _along(state: Epoch, gain: float, below: int, H_out: Array, work: Array) -> float:
    """The DVL's velocity along the direction in ``work[3, 1]``, ``gain`` times a unit vector in b; ``H_out`` is its
    row. ``work`` is that of `_dvl_motion`."""
    body, w, arm, v_b, row, turn = work[2, 0], work[2, 1], work[2, 2], work[3, 0], work[3, 1], work[3, 2]
    z = dot(row, v_b)
    cross(row, body, H_out[0:3])  # a row times S(u) is the row x u
    rotate(state.R, row, H_out[VELOCITY : VELOCITY + 3])
    cross(row, arm, H_out[GYR_BIAS : GYR_BIAS + 3])
    cross(row, w, H_out[MOTION + DVL_LEVER_ARM : MOTION + DVL_LEVER_ARM + 3])
    cross(row, v_b, turn)
    rotate_back(work[1], turn, H_out[MOTION + DVL_ROLL : MOTION + DVL_ROLL + 3])
    H_out[MOTION + DVL_SCALE] = z / gain
    H_out[MOTION + below] = -H_out[VELOCITY]
    H_out[MOTION + below + 1] = -H_out[VELOCITY + 1]
    return z


@view_helper
def dvl_beam(state: Epoch, rate: Array, x: Array, z_out: Array, H_out: Array, work: Array) -> None:
    """Velocity of the DVL along one of its beams, whose context is ``x``, over ground."""
    c, R_bs, d, row = state.c, work[0], work[4, 0], work[3, 1]
    north, east = c[BOTTOM_VELOCITY], c[BOTTOM_VELOCITY + 1]
    _dvl_motion(state, rate, x[BEAM_ARM : BEAM_ARM + 3], north, east, work)
    gain, angle, along = 1.0 + c[DVL_SCALE] + c[DVL_ERROR] + x[ALTITUDE] * c[DVL_ALTITUDE_SCALE], 0.0, 0.0
    if x[BEAM_AT] >= 0.0:
        angle = c[int(x[BEAM_AT])]
        rotate_back(R_bs, work[3, 0], d)  # the DVL's velocity in its own axes
        H_out[0, MOTION + int(x[BEAM_AT])] = gain * dot(d, x[BEAM_TILT : BEAM_TILT + 3])
    for i in range(3):
        d[i] = gain * (x[BEAM + i] + angle * x[BEAM_TILT + i])
        along += x[BEAM + i] * c[DVL_BIAS + i]
        H_out[0, MOTION + DVL_BIAS + i] = x[BEAM + i]
    rotate(R_bs, d, row)
    z_out[0] = _along(state, gain, BOTTOM_VELOCITY, H_out[0], work)
    H_out[0, MOTION + DVL_ERROR] = H_out[0, MOTION + DVL_SCALE]
    H_out[0, MOTION + DVL_ALTITUDE_SCALE] = x[ALTITUDE] * H_out[0, MOTION + DVL_SCALE]
    z_out[0] += along


Scale = tuple[float, float, float]


@view_helper
def _metres(origin: float, north: float, down: float) -> Scale:
    """What a metre changes north, east and down by at a place; ``origin``, its latitude, NaN of a flat frame.

    Derivatives take it as constant: by a metre it changes by less than 1e-6 below a latitude of 80 deg.
    """
    if math.isnan(origin):
        return 1.0, 1.0, 1.0
    of_north, of_east = scales(origin, latitude_at(origin, north), down)
    return of_north, of_east, 1.0


@view_helper
def _point(R: Array, p: Array, lever_arm_b: Array, scale: float, axis: int, H_out: Array) -> float:
    """One component in n of a point on the vehicle, which a metre changes by ``scale``; ``H_out`` is its row."""
    row = R[axis]
    cross(lever_arm_b, row, H_out[0:3])
    for k in range(3):
        H_out[k] *= scale
        H_out[TRANSLATION + k] = row[k]
    return p[axis] + scale * dot(row, lever_arm_b)  # type: ignore[no-any-return]


@view_helper
def position(R: Array, p: Array, c: Array, params: Array, z_out: Array, H_out: Array) -> None:
    """Some of north, east, down of a point on the vehicle, with errors of scale, constant and lasting."""
    offset, scale, error, metres = int(params[3]), int(params[4]), int(params[5]), _metres(params[6], p[0], p[2])
    for i in range(len(z_out)):
        axis = int(params[7 + i])
        z_out[i] = _point(R, p, params[0:3], metres[axis], axis, H_out[i])
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
    place, metres = len(c) - 2, _metres(params[3], p[0], p[2])
    for i in range(2):
        z_out[i] = _point(R, p, params[0:3], metres[i], i, H_out[i]) - c[place + i]
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
def _angle_factor(cosine: float) -> tuple[float, float]:
    """a / sin a of an angle, and its slope by the cosine."""
    if cosine > 1.0 - 1e-6:
        return 1.0 + (1.0 - cosine) / 3.0, -1.0 / 3.0
    square = max(1.0 - cosine * cosine, 1e-12)
    factor = math.acos(max(cosine, -1.0)) / math.sqrt(square)
    return factor, (cosine * factor - 1.0) / square


@view_helper
def _by_ends(state: Epoch, x: Array, by: Array, scale: Scale, F: Array, late: Array, row: Array, work: Array) -> None:
    """Derivative of a component by all that moves the ends of an exchange.

    ``by``, by them when asked and when heard, in n, and a row to work with; ``scale``, what a metre changes north and
    east by; ``F`` is the attitude of the head's frame, ``late`` how the other end goes with the time offset, reversed.
    """
    total, body, arm, turned = work[0], work[1], work[2], by[2]
    inverted, arm_at = x[INVERTED] != 0.0, int(x[ARM_AT])
    for i in range(3):
        total[i] = by[0, i] + by[1, i]
        row[VELOCITY + i] += x[WAIT] * by[0, i] + x[WAIT + 1] * by[1, i]
    rotate_back(state.R, total, body)
    for i in range(3):
        arm[i] = x[ARM + i]
        if inverted and arm_at >= 0:
            arm[i] += state.c[arm_at + i]
    cross(arm, body, turned)
    for i in range(3):
        row[i] += turned[i]
        row[TRANSLATION + i] += (
            state.R[0, i] * total[0] / scale[0] + state.R[1, i] * total[1] / scale[1] + state.R[2, i] * total[2]
        )
    if arm_at >= 0:
        if not inverted:
            rotate_back(F, total, body)
        for i in range(3):
            row[MOTION + arm_at + i] += body[i] if inverted else -body[i]
    if x[BEACON_AT] >= 0.0:
        row[MOTION + int(x[BEACON_AT])] -= total[0] / scale[0]
        row[MOTION + int(x[BEACON_AT]) + 1] -= total[1] / scale[1]
    if x[DOWN_AT] >= 0.0:
        row[MOTION + int(x[DOWN_AT])] -= total[2]
    if x[LATE_AT] >= 0.0:
        row[MOTION + int(x[LATE_AT])] += dot(total, late)


@view_helper
def acoustic(state: Epoch, x: Array, z_out: Array, H_out: Array, work: Array) -> None:
    """Range, and where there are three components direction, of an exchange whose context is ``x``."""
    R, c, inverted = state.R, state.c, x[INVERTED] != 0.0
    F, ends, late, by, spare = work[0], work[1], work[2, 0], work[3], work[4]
    arm, there, error, offset = work[2, 1], work[2, 2], work[5, 0], 0.0
    if x[LATE_AT] >= 0.0:
        offset = c[int(x[LATE_AT])] - x[STATED]
    for i in range(3):  # the frame that the head is mounted in
        error[i] = 0.0 if x[ARM_AT] < 0.0 else c[int(x[ARM_AT]) + i]
        arm[i] = x[ARM + i] + (error[i] if inverted else 0.0)
        late[i] = 0.0 if inverted else -offset * x[TURNS + i]
    if inverted:
        for i in range(3):
            for k in range(3):
                F[i, k] = R[i, k]
    else:
        exp_rotation(late, work[6])
        multiply(x[FRAME : FRAME + 9].reshape(3, 3), work[6], F)
    rotate(R, arm, there)
    rotate(F, error, work[5, 1])
    cross(x[TURNS : TURNS + 3], error, work[5, 2])
    rotate(F, work[5, 2], late)  # how the other end goes with the offset, reversed
    for i in range(3):
        late[i] = x[MOVES + i] + (0.0 if inverted else late[i])
        other = 0.0
        if i < 2 and x[BEACON_AT] >= 0.0:
            other = c[int(x[BEACON_AT]) + i]
        if i == 2 and x[DOWN_AT] >= 0.0:
            other = c[int(x[DOWN_AT])]
        ends[0, i] = state.p[i] - other - x[ASKED + i]
        ends[1, i] = state.p[i] - other - x[HEARD + i]
    scale = _metres(x[ORIGIN], state.p[0] - 0.5 * ends[1, 0], state.p[2] - 0.5 * ends[1, 2])  # halfway
    for i in range(3):
        place = there[i] + offset * x[MOVES + i] - (0.0 if inverted else work[5, 1, i])
        ends[0, i] = ends[0, i] / scale[i] + place + x[WAIT] * state.v[i]
        ends[1, i] = ends[1, i] / scale[i] + place + x[WAIT + 1] * state.v[i]
    by_asked, by_heard = 0.5, 0.5
    if x[WAYS] != 2.0:
        by_asked, by_heard = (0.0, 1.0) if x[WAYS] == 1.0 else (-1.0, 1.0)
    asked, heard = max(math.sqrt(dot(ends[0], ends[0])), 1e-6), max(math.sqrt(dot(ends[1], ends[1])), 1e-6)
    there_and_back = by_heard * heard + by_asked * asked
    sound = 1.0 + (c[int(x[SCALE_AT])] if x[SCALE_AT] >= 0.0 else 0.0)
    z_out[0] = sound * there_and_back
    for a in range(len(z_out)):
        for j in range(TRANSLATION + 6):
            H_out[a, j] = 0.0
    for at, dim in ((ARM_AT, 3), (BEACON_AT, 2), (DOWN_AT, 1), (MOUNT_AT, 3), (LATE_AT, 1)):
        if x[at] >= 0.0:
            for a in range(len(z_out)):
                for j in range(dim):
                    H_out[a, MOTION + int(x[at]) + j] = 0.0
    for i in range(3):
        by[0, i] = sound * by_asked * ends[0, i] / asked
        by[1, i] = sound * by_heard * ends[1, i] / heard
    _by_ends(state, x, by, scale, F, late, H_out[0], spare)
    if x[SCALE_AT] >= 0.0:
        H_out[0, MOTION + int(x[SCALE_AT])] = there_and_back
    for at in (OFFSET_AT, CLOCK_AT, RANGE_AT):
        if x[at] >= 0.0:
            z_out[0] += c[int(x[at])]
            H_out[0, MOTION + int(x[at])] = 1.0
    if x[DRIFT_AT] >= 0.0:
        z_out[0] += x[SINCE] * c[int(x[DRIFT_AT])]
        H_out[0, MOTION + int(x[DRIFT_AT])] = x[SINCE]
    if len(z_out) == 3:
        _direction(state, x, F, heard, scale, late, z_out, H_out, work)


@view_helper
def _direction(
    state: Epoch, x: Array, F: Array, length: float, scale: Scale, late: Array, z_out: Array, H_out: Array, work: Array
) -> None:
    """Components 1 and 2 of `acoustic`: across and up from the direction that is measured."""
    c, inverted, mount = state.c, x[INVERTED] != 0.0, int(x[MOUNT_AT])
    ends, by, spare, R_fh, axes = work[1], work[3], work[4], work[6], work[7]
    u_n, u_f, u = ends[0], work[5, 0], work[5, 1]  # the end that was asked has been used
    sense = -1.0 if inverted else 1.0
    for i in range(3):
        u_n[i] = sense * ends[1, i] / length
    rotate_back(F, u_n, u_f)
    if mount >= 0:
        dvl_mount(c[mount], c[mount + 1], c[mount + 2], R_fh, axes)
        rotate_back(R_fh, u_f, u)
    else:
        for i in range(3):
            u[i] = u_f[i]
    mx, my, mz = x[SEEN], x[SEEN + 1], x[SEEN + 2]
    cosine = mx * u[0] + my * u[1] + mz * u[2]
    factor, slope = _angle_factor(cosine)
    level = math.sqrt(mx * mx + my * my)
    sine, cos = (my / level, mx / level) if level > 1e-12 else (0.0, 1.0)
    k, k_f, turned = by[2], work[5, 2], work[2, 1]
    for a in range(1, 3):
        ex, ey, ez = (-sine, cos, 0.0) if a == 1 else (-mz * cos, -mz * sine, level)
        along = ex * u[0] + ey * u[1] + ez * u[2]
        z_out[a] = factor * along
        k[0] = factor * ex + along * slope * mx
        k[1] = factor * ey + along * slope * my
        k[2] = factor * ez + along * slope * mz
        if mount >= 0:
            rotate(R_fh, k, k_f)
        else:
            for i in range(3):
                k_f[i] = k[i]
        cross(k_f, u_f, turned)
        if mount >= 0:
            for j in range(3):
                by_angle = turned[0] * axes[0, j] + turned[1] * axes[1, j] + turned[2] * axes[2, j]
                H_out[a, MOTION + mount + j] = by_angle
        if inverted:
            for j in range(3):
                H_out[a, j] += turned[j]
        elif x[LATE_AT] >= 0.0:
            H_out[a, MOTION + int(x[LATE_AT])] -= dot(turned, x[TURNS : TURNS + 3])
        rotate(F, k_f, turned)
        off = dot(turned, u_n)
        for i in range(3):
            by[0, i], by[1, i] = 0.0, sense * (turned[i] - off * u_n[i]) / length
        _by_ends(state, x, by, scale, F, late, H_out[a], spare)
        if x[DIRECTION_AT] >= 0.0:
            z_out[a] += c[int(x[DIRECTION_AT]) + a - 1]
            H_out[a, MOTION + int(x[DIRECTION_AT]) + a - 1] = 1.0


@view_helper
def predict(kind: int, state: Epoch, rate: Array, params: Array, z_out: Array, H_out: Array, work: Array) -> None:
    """The measurement that a state predicts, and its derivatives; ``work`` has shape (WORK, 3, 3)."""
    R, p, c = state.R, state.p, state.c
    if kind in (DVL, DVL_WATER):
        dvl_velocity(state, rate, params, kind == DVL_WATER, z_out, H_out, work)
    elif kind in (DVL_COMPASS, COMPASS):
        compass(R, p, c, params, kind == DVL_COMPASS, z_out, H_out, work)
    elif kind == MAGNETOMETER:
        magnetometer(R, p, c, params, z_out, H_out, work)
    elif kind == POSITION:
        position(R, p, c, params, z_out, H_out)
    elif kind == PLACE_OFFSET:
        place_offset(R, p, c, params, z_out, H_out)
    elif kind == WATER_VELOCITY:
        water_velocity(R, c, z_out, H_out)
    elif kind == TILT:
        tilt(R, z_out, H_out)
    elif kind == ACOUSTIC:
        acoustic(state, params, z_out, H_out, work)
    elif kind == DVL_BEAM:
        dvl_beam(state, rate, params, z_out, H_out, work)
    elif kind == WATER_LAYER:
        water_layer(state, rate, params, z_out, H_out, work)


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
