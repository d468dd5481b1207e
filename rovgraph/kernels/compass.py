"""Heading, deviation of a compass, the magnetometer, and tilt, for one epoch.

    h = atan2(u_e, u_n) - declination, u = R_nb a, a the instrument's x axis in b
    deviation = A + e + B sin h + C cos h, e an error that lasts          Bowditch
    compass       z = h + deviation                                       (3.17)
    magnetometer  z = |H| ((1 + s) S R_sb R_bn u(declination - deviation, dip + d) + iron)
                                                                          (3.11), (3.14), S: (3.2)

Signs follow the corrected equations: declination is atan2(H_e, H_n), the heading is clockwise from north.
`rovgraph.kernels.measurements` says what the arguments are and which columns of ``H_out`` are written.
"""

import math

from rovgraph.geometry import Array
from rovgraph.kernels.compile import view_helper
from rovgraph.kernels.layout import (
    DVL_ROLL,
    FIELD_DIP,
    FIELD_SCALE,
    HARD_IRON,
    MAG_DEVIATION,
    MAG_OFFSET,
    MOTION,
    SOFT_IRON,
)
from rovgraph.kernels.rotations import cross, dot, multiply, multiply_transposed, rotate


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
def compass(R: Array, c: Array, params: Array, in_dvl: bool, z_out: Array, H_out: Array, work: Array) -> None:
    """Magnetic heading of an instrument's x axis, of the DVL's with the mounting that the calibration has."""
    R_bs, axes, axis, gradient = work[0], work[1], work[2, 0], work[2, 1]
    offset, curve, error = int(params[1]), int(params[2]), int(params[3])
    if in_dvl:
        dvl_mount(c[DVL_ROLL], c[DVL_ROLL + 1], c[DVL_ROLL + 2], R_bs, axes)
    for i in range(3):
        axis[i] = R_bs[i, 0] if in_dvl else params[4 + i]
    heading = heading_of(R, axis, gradient) - params[0]
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
def magnetometer(R: Array, c: Array, params: Array, z_out: Array, H_out: Array, work: Array) -> None:
    """Magnetic field in IMU axes, with deviation, soft iron and hard iron."""
    turns_n, turns_b, S, A, M, seen = work[0], work[1], work[2], work[3], work[4], work[0]
    u_b, gradient, w = work[5, 0], work[5, 1], work[5, 2]
    magnitude, gain = params[2], 1.0 + c[FIELD_SCALE]
    for i in range(3):
        u_b[i] = params[3 + 3 * i]  # the x axis, for its heading
        for k in range(3):
            A[i, k] = magnitude * gain * params[3 + 3 * k + i]
    heading = heading_of(R, u_b, gradient) - params[0]
    sine, cosine = math.sin(heading), math.cos(heading)
    B, C = c[MAG_DEVIATION], c[MAG_DEVIATION + 1]
    slope = B * cosine - C * sine
    _field_turns(params[0] - (c[MAG_OFFSET] + B * sine + C * cosine), params[1] + c[FIELD_DIP], turns_n)
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
