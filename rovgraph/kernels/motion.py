"""Motion over an interval: prediction and linear transition, with the IMU, through its outage, or without one.

Motions are rows of `rovgraph.kernels.motion_row`. The bias of a state is the one that its samples show; of the
predicted state only attitude, position and velocity are written. Derivatives are by rotation, position (in body axes),
velocity (in n), bias.

**With the IMU.** With zeta = (theta, p, v) preintegrated, corrected to first order for the bias b that differs from the
assumed one,

    R_j = R_i Exp(theta),  p_j = p_i + t v_i + t^2 / 2 g + R_i p,  v_j = v_i + t g + R_i v

On a turning Earth this holds in the axes that n has at the beginning, for v + S(w) p in place of v; what comes out
is turned back by Exp(-t w), and gravity turns meanwhile. Equal to GTSAM's ``PreintegratedCombinedMeasurements``.

**In frame "earth"** (`rovgraph.kernels.earth`) the axes of n follow the vehicle: they turn by w_in = w_ie + w_en, the
Earth's rate and the transport rate (v_east / (N + h), -v_north / (M + h), -v_east tan lat / (N + h)), north and
east are angles (Groves 2013, 5.4). In the axes that n has at the beginning, held still, with the ground speed u and its
integral s,

    u' = R f + g - w_ie x u,    so    u = v_i + V - w_ie x s,    s = t v_i + P - w_ie x (t^2/2 v_i + t/3 P)
    d = s - w_in x (t^2/2 v_i + 2 t/3 P)
    R_j = E R_i Exp(theta),  v_j = E u,  p_j = p_i + diag(k_north, k_east, 1) d,    E = Exp(-t w_in)

with P, V what specific force and gravity do, the latter turning with n; d the way over ground along the axes of the
moment; k of `rovgraph.kernels.earth.scales` in the middle of the way. Left out are terms of (w t)^2 v t, below a
nanometre in a second. Gravity is that of the row at the origin, and changes as the normal one does with latitude and
depth.

**IMU outage**, where samples are missing for longer than `LONGEST_BRIDGED_S`. Integrating an interpolated specific
force needs the attitude, and an error of an unmeasured attitude turns gravity into motion: after five seconds tens of
metres, from which a linear filter does not recover. A vehicle that is heavy below and light above does not roll over
meanwhile. So it is taken to continue as before, with velocity and heading as random walks, and a tilt that rights
itself, a first-order Gauss-Markov process (Gelb 1974):

    tilt_j = a tilt_i + w,  a = exp(-t / RIGHTING_S),  var w = (1 - a^2) TILT_SD^2
    yaw_j = yaw_i + dyaw + w,  p_j = p_i + t v_i + w,  v_j = v_i + w,  bias_j = bias_i + w

with dyaw from the interpolated gyro, and p and v driven by one white acceleration. Roll, pitch and yaw change with
a turn of the body by

    B = | 1  sin r tan p  cos r tan p |           | 1  0      -sin p       |
        | 0  cos r        -sin r      |,   B^-1 = | 0  cos r  sin r cos p  |
        | 0  sin r sec p  cos r sec p |           | 0  -sin r cos r cos p  |

**Without an IMU**: nearly constant velocity, white noise acceleration (Bar-Shalom et al. 2001, 6.2.2), of the velocity
u = R_bn v_n along the body's axes, which turns with the vehicle; the attitude is a random walk.

    R_j = R_i Exp(w),  var w = t d^2
    u_j = u_i + w,     var w = t q^2
    p_j = p_i + t (v_i + v_j) / 2 + w,  var w = t^3 q^2 / 12        what is left once both velocities are known

with q and d the noise densities of acceleration and rate of turn.
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import EARTH_RATE as OMEGA
from rovgraph.geometry import Array
from rovgraph.kernels.compile import Matrices, Matrix, helper, kernel, view_helper
from rovgraph.kernels.earth import GRAVITY_PER_DEPTH, latitude_at, normal_gravity, radii, scales
from rovgraph.kernels.motion_row import (
    AFTER,
    BIAS,
    BY_BIAS,
    DURATION,
    EARTH_RATE,
    GAP,
    GRAVITY,
    LATITUDE,
    NO_IMU,
    NOISE,
    RESIDUAL,
    TANGENT,
)
from rovgraph.kernels.rotations import (
    cross,
    dot,
    exp_rotation,
    inverse_right_jacobian,
    log_rotation,
    multiply,
    multiply_transposed,
    right_jacobian,
    rotate,
    rotate_back,
    skew,
)
from rovgraph.kernels.states import Epoch, States, epoch

BRIDGE_ACC, BRIDGE_GYR = 0.3, 0.3  # densities over a gap: an ROV at its liveliest [SI/rtHz]
TILT_SD = math.radians(8.0)  # of a vehicle that rights itself
RIGHTING_S = 2.0 * TILT_SD**2 / BRIDGE_GYR**2  # so that at first it tilts as any ROV turns


@helper
def roll_pitch_yaw(R: Array, rpy_out: Array) -> None:
    """Roll, pitch, yaw of a rotation matrix [rad]."""
    rpy_out[0] = math.atan2(R[2, 1], R[2, 2])
    rpy_out[1] = -math.asin(min(max(R[2, 0], -1.0), 1.0))
    rpy_out[2] = math.atan2(R[1, 0], R[0, 0])


@helper
def _from_roll_pitch_yaw(rpy: Array, R_out: Array) -> None:
    cr, cp, cy = math.cos(rpy[0]), math.cos(rpy[1]), math.cos(rpy[2])
    sr, sp, sy = math.sin(rpy[0]), math.sin(rpy[1]), math.sin(rpy[2])
    R_out[0, 0], R_out[0, 1], R_out[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    R_out[1, 0], R_out[1, 1], R_out[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    R_out[2, 0], R_out[2, 1], R_out[2, 2] = -sp, cp * sr, cp * cr


@helper
def _by_turn(rpy: Array, B_out: Array) -> None:
    """B: derivative of roll, pitch, yaw by a turn of the body."""
    cr, cp, sr, tp = math.cos(rpy[0]), math.cos(rpy[1]), math.sin(rpy[0]), math.tan(rpy[1])
    B_out[0, 0], B_out[0, 1], B_out[0, 2] = 1.0, sr * tp, cr * tp
    B_out[1, 0], B_out[1, 1], B_out[1, 2] = 0.0, cr, -sr
    B_out[2, 0], B_out[2, 1], B_out[2, 2] = 0.0, sr / cp, cr / cp


@helper
def _kept(row: Array) -> float:
    """What is kept of roll and pitch."""
    return math.exp(-row[DURATION] / RIGHTING_S)


@helper
def _predict_angles(row: Array, R: Array, rpy_out: Array) -> None:
    turn = np.empty((3, 3))
    exp_rotation(row[TANGENT : TANGENT + 3], turn)
    roll_pitch_yaw(R, rpy_out)
    rpy_out[0] *= _kept(row)
    rpy_out[1] *= _kept(row)
    rpy_out[2] += math.atan2(turn[1, 0], turn[0, 0])


@view_helper
def _is_on_earth(row: Array) -> bool:
    """Whether the motion is in frame "earth"."""
    return not math.isnan(row[LATITUDE])


@helper
def _scale_of(row: Array, p: Array, v: Array) -> tuple[float, float, float, float]:
    """What a metre along each axis of n changes position by, in the middle of a way; and east by north."""
    if not _is_on_earth(row):
        return 1.0, 1.0, 1.0, 0.0
    half = 0.5 * row[DURATION]
    latitude = latitude_at(row[LATITUDE], p[0] + half * v[0])
    north, east = scales(row[LATITUDE], latitude, p[2] + half * v[2])
    return north, east, 1.0, east * math.tan(latitude) / radii(row[LATITUDE])[0]


@helper
def coast(row: Array, state: Epoch, out: Epoch) -> None:
    """Attitude, position and velocity at the end of an interval."""
    rpy, k = np.empty(3), _scale_of(row, state.p, state.v)
    _predict_angles(row, state.R, rpy)
    _from_roll_pitch_yaw(rpy, out.R)
    for i in range(3):
        out.p[i], out.v[i] = state.p[i] + row[DURATION] * k[i] * state.v[i], state.v[i]


@helper
def coasting_covariance(row: Array, S_out: Array) -> None:
    """Covariance of the residual, shape (15, 15)."""
    t, kept = row[DURATION], _kept(row)
    for i in range(15):
        for j in range(15):
            S_out[i, j] = 0.0
    S_out[0, 0] = S_out[1, 1] = (1.0 - kept * kept) * TILT_SD * TILT_SD
    S_out[2, 2] = BRIDGE_GYR * BRIDGE_GYR * t
    acc, acc_walk, gyr_walk, integration = BRIDGE_ACC, row[NOISE + 2], row[NOISE + 3], row[NOISE + 4]
    for i in range(3):
        S_out[3 + i, 3 + i] = acc * acc * t * t * t / 3.0 + integration * integration * t
        S_out[3 + i, 6 + i] = S_out[6 + i, 3 + i] = 0.5 * acc * acc * t * t
        S_out[6 + i, 6 + i] = acc * acc * t
        S_out[9 + i, 9 + i] = acc_walk * acc_walk * t
        S_out[12 + i, 12 + i] = gyr_walk * gyr_walk * t


@helper
def coasting_error(row: Array, before: Epoch, after: Epoch, A_out: Array) -> None:
    """Residual: roll, pitch, yaw, position, velocity, bias, and its derivatives by both states; ``A_out`` was zero."""
    known, predicted, rpy, B_i, B_j = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    kept, R_i, p_i, v_i, bias_i = _kept(row), before.R, before.p, before.v, before.b
    R_j, p_j, v_j, bias_j = after.R, after.p, after.v, after.b
    k = _scale_of(row, p_i, v_i)
    by_north = row[DURATION] * k[3] * v_i[1]
    roll_pitch_yaw(R_i, known)
    roll_pitch_yaw(R_j, rpy)
    _predict_angles(row, R_i, predicted)
    _by_turn(known, B_i)
    _by_turn(rpy, B_j)
    for i in range(15):
        A_out[i, i], A_out[i, AFTER + i] = -1.0, 1.0
    for i in range(3):
        angle = rpy[i] - predicted[i]
        A_out[i, RESIDUAL] = angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))
        A_out[3 + i, RESIDUAL] = p_j[i] - p_i[i] - row[DURATION] * k[i] * v_i[i]
        A_out[6 + i, RESIDUAL] = v_j[i] - v_i[i]
        A_out[3 + i, 6 + i] = -row[DURATION] * k[i]
        for j in range(3):
            A_out[i, j] = -B_i[i, j] * (kept if i < 2 else 1.0)
            A_out[i, AFTER + j] = B_j[i, j]
            A_out[3 + i, 3 + j], A_out[3 + i, AFTER + 3 + j] = -R_i[i, j], R_j[i, j]
    A_out[4, 6] -= 0.5 * row[DURATION] * by_north
    for j in range(3):
        A_out[4, 3 + j] -= by_north * R_i[0, j]
    for i in range(6):
        A_out[9 + i, RESIDUAL] = bias_j[i] - bias_i[i]


@helper
def coasting_transition(row: Array, state: Epoch, R_j: Array, F_out: Array, Q_out: Array) -> None:
    """Linear transition and its noise, shape (15, 15), where ``R_j`` was predicted from a state."""
    before, rpy, B, back = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    kept, t, R_i, k = _kept(row), row[DURATION], state.R, _scale_of(row, state.p, state.v)
    roll_pitch_yaw(R_i, before)
    roll_pitch_yaw(R_j, rpy)
    _by_turn(before, B)
    sr, cr, sp, cp = math.sin(rpy[0]), math.cos(rpy[0]), math.sin(rpy[1]), math.cos(rpy[1])
    back[0, 0], back[0, 1], back[0, 2] = 1.0, 0.0, -sp
    back[1, 0], back[1, 1], back[1, 2] = 0.0, cr, sr * cp
    back[2, 0], back[2, 1], back[2, 2] = 0.0, -sr, cr * cp
    by_north = t * k[3] * state.v[1]
    coasting_covariance(row, Q_out)
    tilt, heading, both = Q_out[0, 0], Q_out[2, 2], Q_out[3, 6]
    for i in range(15):
        for j in range(15):
            F_out[i, j] = 0.0
        F_out[i, i] = 1.0
    for i in range(3):
        for j in range(3):
            F_out[i, j] = kept * (back[i, 0] * B[0, j] + back[i, 1] * B[1, j]) + back[i, 2] * B[2, j]
            F_out[3 + i, 3 + j] = R_j[0, i] * R_i[0, j] + R_j[1, i] * R_i[1, j] + R_j[2, i] * R_i[2, j]
            F_out[3 + i, 3 + j] += by_north * R_j[1, i] * R_i[0, j]
            F_out[3 + i, 6 + j] = t * k[j] * R_j[j, i]
            Q_out[i, j] = tilt * (back[i, 0] * back[j, 0] + back[i, 1] * back[j, 1]) + heading * back[i, 2] * back[j, 2]
            Q_out[3 + i, 6 + j] = Q_out[6 + j, 3 + i] = both * R_j[j, i]
        F_out[3 + i, 6] += 0.5 * t * by_north * R_j[1, i]


@helper
def cruise(row: Array, state: Epoch, out: Epoch) -> None:
    """Attitude, position and velocity at the end of an interval."""
    k = _scale_of(row, state.p, state.v)
    for i in range(3):
        out.p[i], out.v[i] = state.p[i] + row[DURATION] * k[i] * state.v[i], state.v[i]
        for j in range(3):
            out.R[i, j] = state.R[i, j]


@helper
def cruising_covariance(row: Array, S_out: Array) -> None:
    """Covariance of the residual, shape (15, 15)."""
    for i in range(15):
        for j in range(15):
            S_out[i, j] = 0.0
    t, acc, gyr, integration = row[DURATION], row[NOISE], row[NOISE + 1], row[NOISE + 4]
    for i in range(3):
        S_out[i, i] = gyr * gyr * t
        S_out[3 + i, 3 + i] = acc * acc * t * t * t / 12.0 + integration * integration * t
        S_out[6 + i, 6 + i] = acc * acc * t
        S_out[9 + i, 9 + i] = row[NOISE + 2] * row[NOISE + 2] * t
        S_out[12 + i, 12 + i] = row[NOISE + 3] * row[NOISE + 3] * t


@helper
def cruising_error(row: Array, before: Epoch, after: Epoch, A_out: Array) -> None:
    """Residual: rotation, position in n, velocity in the body's axes, bias; its derivatives by both states.

    ``A_out`` was zero.
    """
    half, u, S, turn, Jr, phi = (
        0.5 * row[DURATION],
        np.empty((2, 3)),
        np.empty((2, 3, 3)),
        np.empty((3, 3)),
        np.empty((3, 3)),
        np.empty(3),
    )
    R_i, p_i, v_i, bias_i = before.R, before.p, before.v, before.b
    R_j, p_j, v_j, bias_j = after.R, after.p, after.v, after.b
    k = _scale_of(row, p_i, v_i)
    multiply_transposed(R_i, R_j, turn)
    log_rotation(turn, phi)
    inverse_right_jacobian(phi, Jr)
    rotate_back(R_i, v_i, u[0])
    rotate_back(R_j, v_j, u[1])
    skew(u[0], S[0])
    skew(u[1], S[1])
    for i in range(15):
        A_out[i, i], A_out[i, AFTER + i] = -1.0, 1.0
    for i in range(3):
        A_out[i, RESIDUAL] = phi[i]
        A_out[3 + i, RESIDUAL] = p_j[i] - p_i[i] - half * k[i] * (v_i[i] + v_j[i])
        A_out[6 + i, RESIDUAL] = u[1, i] - u[0, i]
        A_out[3 + i, 6 + i] = A_out[3 + i, AFTER + 6 + i] = -half * k[i]
        for j in range(3):
            A_out[i, j], A_out[i, AFTER + j] = -Jr[j, i], Jr[i, j]  # Jl^-1 is Jr^-1 transposed
            A_out[3 + i, 3 + j], A_out[3 + i, AFTER + 3 + j] = -R_i[i, j], R_j[i, j]
            A_out[6 + i, j], A_out[6 + i, AFTER + j] = -S[0, i, j], S[1, i, j]
            A_out[6 + i, 6 + j], A_out[6 + i, AFTER + 6 + j] = -R_i[j, i], R_j[j, i]
    by_north = half * k[3] * (v_i[1] + v_j[1])
    A_out[4, 6] -= half * by_north
    for j in range(3):
        A_out[4, 3 + j] -= by_north * R_i[0, j]
    for i in range(6):
        A_out[9 + i, RESIDUAL] = bias_j[i] - bias_i[i]


@helper
def cruising_transition(row: Array, state: Epoch, F_out: Array, Q_out: Array) -> None:
    """Linear transition and its noise, shape (15, 15), from a state to the predicted one, which has its attitude.

    With the noise (w, x, y) of rotation, position and velocity u, velocity errs by R (y - u x w) more, and position in
    the body's axes by x and half the time of that.
    """
    half, u, U, RU = 0.5 * row[DURATION], np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    R, v, scale = state.R, state.v, _scale_of(row, state.p, state.v)
    cruising_covariance(row, Q_out)
    turns, drifts, speeds = Q_out[0, 0], Q_out[3, 3], Q_out[6, 6]
    rotate_back(R, v, u)
    skew(u, U)
    multiply(R, U, RU)
    for i in range(15):
        for j in range(15):
            F_out[i, j] = 0.0
        F_out[i, i] = 1.0
    by_north = 2.0 * half * scale[3] * v[1]
    for i in range(3):
        for j in range(3):
            F_out[3 + i, 3 + j] += by_north * R[1, i] * R[0, j]
            F_out[3 + i, 6 + j] = 2.0 * half * scale[j] * R[j, i] + (half * by_north * R[1, i] if j == 0 else 0.0)
            across = 0.0  # of u x w, in the body's axes and in n
            across_n = 0.0
            mixed = 0.0
            for k in range(3):
                across += turns * U[i, k] * U[j, k]
                across_n += turns * RU[i, k] * RU[j, k]
                mixed += turns * U[i, k] * RU[j, k]
            one = 1.0 if i == j else 0.0
            Q_out[3 + i, 3 + j] = drifts * one + half * half * (speeds * one + across)
            Q_out[6 + i, 6 + j] = speeds * one + across_n
            Q_out[3 + i, 6 + j] = Q_out[6 + j, 3 + i] = half * (speeds * R[j, i] + mixed)
            Q_out[j, 3 + i] = Q_out[3 + i, j] = -half * turns * U[i, j]
            Q_out[j, 6 + i] = Q_out[6 + i, j] = -turns * RU[i, j]


LONGEST_BRIDGED_S = 0.75  # intervals in a gap of the IMU that is longer are coasted through


class MotionScratch(NamedTuple):
    """Arrays to calculate with.

    Attributes
    ----------
    zeta : shape (9,), the motion, corrected for the bias
    turn : shape (3, 3), Exp(theta)
    E, ER : shapes (3, 3), the rotation by which the axes of n turn back meanwhile, and of the body's after it
    vectors, matrices : shapes (8, 3), (4, 3, 3)
    J : shape (9, 15), derivative by the state before, of `predict_with_jacobian`
    """

    zeta: Array
    turn: Array
    E: Array
    ER: Array
    vectors: Array
    matrices: Array
    J: Array


@helper
def make_motion_scratch() -> MotionScratch:
    """Arrays for all motions of a dive; made once."""
    turns = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    return MotionScratch(np.empty(9), *turns, np.empty((8, 3)), np.empty((4, 3, 3)), np.empty((9, 15)))


@view_helper
def is_coasted(row: Array) -> bool:
    """Whether an interval is coasted through."""
    return bool(row[GAP] > LONGEST_BRIDGED_S)


@view_helper
def is_cruising(row: Array) -> bool:
    """Whether there is no IMU."""
    return bool(row[GAP] == NO_IMU)


@view_helper
def correct_motion(row: Array, bias: Array, zeta_out: Array) -> None:
    """The motion, corrected for the bias."""
    for i in range(9):
        zeta_out[i] = row[TANGENT + i]
        for j in range(6):
            zeta_out[i] += row[BY_BIAS + 6 * i + j] * (bias[j] - row[BIAS + j])


@view_helper
def _gravity(t: float, g: float, rate: Array, once: Array, twice: Array, p_out: Array, v_out: Array) -> None:
    """Add to position and velocity what gravity does in a time while n turns at a rate."""
    once[0], once[1], once[2] = rate[1] * g, -rate[0] * g, 0.0
    cross(rate, once, twice)
    square = t * t * dot(rate, rate)
    if square < 0.01:
        a = 0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0)))
        b = (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))) / 6.0
        c = (1.0 - square / 30.0 * (1.0 - square / 56.0 * (1.0 - square / 90.0))) / 24.0
    else:
        angle = math.sqrt(square)
        a = (1.0 - math.cos(angle)) / square
        b = (angle - math.sin(angle)) / (angle * square)
        c = (0.5 - a) / square
    for i in range(3):
        v_out[i] += t * t * (a * once[i] + t * b * twice[i])
        p_out[i] += t * t * t * (b * once[i] + t * c * twice[i])
    v_out[2] += t * g
    p_out[2] += 0.5 * t * t * g


@view_helper
def _turning(row: Array) -> bool:
    return bool(row[EARTH_RATE] != 0.0 or row[EARTH_RATE + 1] != 0.0 or row[EARTH_RATE + 2] != 0.0)


@view_helper
def _predict(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> None:
    """The state after the motion ``zeta`` of the scratch, whose ``turn`` and ``E`` it makes."""
    R, p, v, R_out, p_out, v_out = state.R, state.p, state.v, out.R, out.p, out.v
    t, zeta, turn, E = row[DURATION], scratch.zeta, scratch.turn, scratch.E
    exp_rotation(zeta, turn)
    for i in range(3):
        p_out[i] = p[i] + t * v[i] + R[i, 0] * zeta[3] + R[i, 1] * zeta[4] + R[i, 2] * zeta[5]
        v_out[i] = v[i] + R[i, 0] * zeta[6] + R[i, 1] * zeta[7] + R[i, 2] * zeta[8]
    if not _turning(row):
        p_out[2] += 0.5 * t * t * row[GRAVITY]
        v_out[2] += t * row[GRAVITY]
        multiply(R, turn, R_out)
        for i in range(3):
            for j in range(3):
                E[i, j] = 1.0 if i == j else 0.0
        return
    vectors = scratch.vectors
    rate, far, fast, along, twice = vectors[0], vectors[1], vectors[2], vectors[3], vectors[4]
    for i in range(3):
        rate[i] = row[EARTH_RATE + i]
    _gravity(t, row[GRAVITY], rate, along, twice, p_out, v_out)
    cross(rate, p, along)
    for i in range(3):
        fast[i] = v_out[i] + along[i]
        far[i] = p_out[i] + t * along[i]
        along[i] = -t * rate[i]
    exp_rotation(along, E)
    multiply(R, turn, scratch.ER)
    multiply(E, scratch.ER, R_out)
    rotate(E, far, p_out)
    rotate(E, fast, v_out)
    cross(rate, p_out, along)
    for i in range(3):
        v_out[i] -= along[i]


# of an interval in frame "earth": where its vectors lie in the scratch
RATE_IN, RATE_IE, PULL, RUN, WAY, ASIDE, WORK, CHANGE = 0, 1, 2, 3, 4, 5, 6, 7


@view_helper
def _move_on_earth(row: Array, v: Array, vectors: Array, u_out: Array) -> None:
    """Velocity u, and the way d in `WAY`, by a velocity before and by P and V in `PULL` and `RUN`; linear in these."""
    t, P, V, way, aside, work = row[DURATION], vectors[PULL], vectors[RUN], vectors[WAY], vectors[ASIDE], vectors[WORK]
    for i in range(3):
        aside[i] = t * (0.5 * t * v[i] + P[i] / 3.0)
        way[i] = t * v[i] + P[i]
    cross(vectors[RATE_IE], aside, work)
    for i in range(3):
        way[i] -= work[i]
        aside[i] += t * P[i] / 3.0
    cross(vectors[RATE_IE], way, work)
    for i in range(3):
        u_out[i] = v[i] + V[i] - work[i]
    cross(vectors[RATE_IN], aside, work)
    for i in range(3):
        way[i] -= work[i]


@view_helper
def _predict_on_earth(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> tuple[float, float]:
    """`_predict` in frame "earth"; the scales of north and east in the middle of the way."""
    R, p, v, t, zeta, vectors = state.R, state.p, state.v, row[DURATION], scratch.zeta, scratch.vectors
    rate, w_ie, P, V = vectors[RATE_IN], vectors[RATE_IE], vectors[PULL], vectors[RUN]
    way, work, u = vectors[WAY], vectors[WORK], vectors[CHANGE]
    latitude = latitude_at(row[LATITUDE], p[0])
    M, N = radii(latitude)
    gravity = row[GRAVITY] + normal_gravity(latitude) - normal_gravity(row[LATITUDE]) + GRAVITY_PER_DEPTH * p[2]
    exp_rotation(zeta, scratch.turn)
    for i in range(3):
        P[i] = R[i, 0] * zeta[3] + R[i, 1] * zeta[4] + R[i, 2] * zeta[5]
        V[i] = R[i, 0] * zeta[6] + R[i, 1] * zeta[7] + R[i, 2] * zeta[8]
    w_ie[0], w_ie[1], w_ie[2] = OMEGA * math.cos(latitude), 0.0, -OMEGA * math.sin(latitude)
    by_north, by_east = (v[0] + 0.5 * V[0]) / (M - p[2]), (v[1] + 0.5 * V[1]) / (N - p[2])
    rate[0], rate[1], rate[2] = w_ie[0] + by_east, -by_north, w_ie[2] - by_east * math.tan(latitude)
    _gravity(t, gravity, rate, vectors[ASIDE], work, P, V)
    _move_on_earth(row, v, vectors, u)
    for i in range(3):
        work[i] = -t * rate[i]
    exp_rotation(work, scratch.E)
    rotate(scratch.E, u, out.v)
    multiply(R, scratch.turn, scratch.ER)
    multiply(scratch.E, scratch.ER, out.R)
    k_north, k_east = scales(row[LATITUDE], latitude + 0.5 * way[0] / M, p[2] + 0.5 * way[2])
    out.p[0], out.p[1], out.p[2] = p[0] + k_north * way[0], p[1] + k_east * way[1], p[2] + way[2]
    return k_north, k_east


@view_helper
def _predict_on_earth_with_jacobian(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> None:
    """`predict_with_jacobian` in frame "earth", corrected for the bias.

    A change of the state changes the way, and with it the transport rate. What a change of latitude does to rates and
    radii in one interval is left out, but for the scale of east.
    """
    zeta, t, J, R, Jr, vectors = scratch.zeta, row[DURATION], scratch.J, state.R, scratch.matrices[0], scratch.vectors
    k_north, k_east = _predict_on_earth(row, state, out, scratch)
    latitude = latitude_at(row[LATITUDE], state.p[0])
    M, N = radii(latitude)
    tangent = math.tan(latitude)
    east_by_latitude, latitude_by_north = k_east * vectors[WAY, 1] * tangent / N, M / radii(row[LATITUDE])[0]
    P, V, way, change = vectors[PULL], vectors[RUN], vectors[WAY], vectors[CHANGE]
    v, work = scratch.matrices[1, 0], scratch.matrices[1, 1]
    right_jacobian(zeta, Jr)
    for j in range(15):
        for i in range(3):
            J[i, j] = v[i] = P[i] = V[i] = 0.0
        if j < 3:
            a, b = (j + 1) % 3, (j + 2) % 3
            for i in range(3):  # of -R S(zeta)
                J[i, j] = scratch.turn[j, i]
                P[i] = R[i, b] * zeta[3 + a] - R[i, a] * zeta[3 + b]
                V[i] = R[i, b] * zeta[6 + a] - R[i, a] * zeta[6 + b]
        elif j < 6:
            V[2] = t * GRAVITY_PER_DEPTH * R[2, j - 3]
            P[2] = 0.5 * t * V[2]
        elif j < 9:
            v[j - 6] = 1.0
        else:
            at = BY_BIAS + j - 9
            for i in range(3):
                J[i, j] = Jr[i, 0] * row[at] + Jr[i, 1] * row[at + 6] + Jr[i, 2] * row[at + 12]
                P[i] = R[i, 0] * row[at + 18] + R[i, 1] * row[at + 24] + R[i, 2] * row[at + 30]
                V[i] = R[i, 0] * row[at + 36] + R[i, 1] * row[at + 42] + R[i, 2] * row[at + 48]
        by_north, by_east = t * (v[0] + 0.5 * V[0]) / M, t * (v[1] + 0.5 * V[1]) / N
        change[0], change[1], change[2] = by_east, -by_north, -by_east * tangent  # of t w_en
        fall = 0.5 * t * row[GRAVITY]
        V[0] -= fall * by_north
        V[1] -= fall * by_east
        P[0] -= t / 3.0 * fall * by_north
        P[1] -= t / 3.0 * fall * by_east
        _move_on_earth(row, v, vectors, work)
        rotate(scratch.E, work, v)
        cross(out.v, change, work)
        for i in range(3):
            J[3 + i, j], J[6 + i, j] = way[i], v[i] + work[i]
        rotate_back(out.R, change, work)
        for i in range(3):
            J[i, j] -= work[i]
        J[3, j] *= k_north
        J[4, j] = k_east * way[1] + 0.5 * east_by_latitude * way[0]
        if 3 <= j < 6:
            J[4, j] += east_by_latitude * latitude_by_north * R[0, j - 3]
            for i in range(3):
                J[3 + i, j] += R[i, j - 3]


@view_helper
def predict_with_jacobian(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> None:
    """The state after an interval, and how it depends on that before it.

    J of the scratch becomes the turn of the body, position and velocity in n by rotation, position, velocity, bias.
    """
    zeta, t, turn, Jr = scratch.zeta, row[DURATION], scratch.turn, scratch.matrices[0]
    E, ER, J_out = scratch.E, scratch.ER, scratch.J
    correct_motion(row, state.b, zeta)
    if _is_on_earth(row):
        _predict_on_earth_with_jacobian(row, state, out, scratch)
        return
    _predict(row, state, out, scratch)
    multiply(E, state.R, ER)
    right_jacobian(zeta, Jr)
    for i in range(3):
        for j in range(3):
            J_out[i, j], J_out[i, 3 + j], J_out[i, 6 + j] = turn[j, i], 0.0, 0.0
            J_out[3 + i, 3 + j], J_out[6 + i, 3 + j] = ER[i, j], 0.0
            J_out[3 + i, 6 + j], J_out[6 + i, 6 + j] = t * E[i, j], E[i, j]
        for k in (3, 6):  # -E R S(zeta)
            x, y, z = zeta[k], zeta[k + 1], zeta[k + 2]
            J_out[k + i, 0] = ER[i, 2] * y - ER[i, 1] * z
            J_out[k + i, 1] = ER[i, 0] * z - ER[i, 2] * x
            J_out[k + i, 2] = ER[i, 1] * x - ER[i, 0] * y
        for j in range(6):
            at = BY_BIAS + j
            J_out[i, 9 + j] = Jr[i, 0] * row[at] + Jr[i, 1] * row[at + 6] + Jr[i, 2] * row[at + 12]
            at += 18
            J_out[3 + i, 9 + j] = ER[i, 0] * row[at] + ER[i, 1] * row[at + 6] + ER[i, 2] * row[at + 12]
            at += 18
            J_out[6 + i, 9 + j] = ER[i, 0] * row[at] + ER[i, 1] * row[at + 6] + ER[i, 2] * row[at + 12]
    if _turning(row):
        _add_turning(row, state.R, scratch)


@view_helper
def _add_turning(row: Array, R: Array, scratch: MotionScratch) -> None:
    """Terms of a turning Earth in the derivatives, for v + S(w) p in place of v."""
    t, rate, J = row[DURATION], scratch.vectors[0], scratch.J
    spin, spun, turned = scratch.matrices[1], scratch.matrices[2], scratch.matrices[3]
    skew(rate, spin)
    multiply(spin, R, spun)
    multiply(scratch.E, spun, turned)
    for i in range(3):
        for j in range(3):
            J[3 + i, 3 + j] += t * turned[i, j]
            J[6 + i, 3 + j] += turned[i, j]
    for j in range(15):
        for i in range(3):
            J[6 + i, j] -= spin[i, 0] * J[3, j] + spin[i, 1] * J[4, j] + spin[i, 2] * J[5, j]


@view_helper
def predict_motion(row: Array, state: Epoch, out: Epoch, scratch: MotionScratch) -> None:
    """The state at the end of one interval that is not coasted through, without derivatives."""
    correct_motion(row, state.b, scratch.zeta)
    if _is_on_earth(row):
        _predict_on_earth(row, state, out, scratch)
    else:
        _predict(row, state, out, scratch)


@helper
def predict_with_transition(
    row: Array, covariance: Array, state: Epoch, out: Epoch, F_out: Array, Q_out: Array
) -> None:
    """The state at the end of one interval; its error's transition and process noise, shape (15, 15).

    The residual's derivatives by both states give A_i e_i + A_j e_j = noise of covariance S. Where the state after
    is the predicted one, A_j is -1 on the diagonal but for velocity, -R_j', so that e_j = F e_i + w with F and
    Q = cov w without an inverse.
    """
    if is_cruising(row):
        cruise(row, state, out)
        cruising_transition(row, state, F_out, Q_out)
        return
    if is_coasted(row):
        coast(row, state, out)
        coasting_transition(row, state, out.R, F_out, Q_out)
        return
    scratch = make_motion_scratch()
    J, R_out = scratch.J, out.R
    predict_with_jacobian(row, state, out, scratch)
    for i in range(15):
        for j in range(15):
            F_out[i, j], Q_out[i, j] = 0.0, covariance[i, j]
        F_out[i, i] = 1.0
    for j in range(15):
        x, y, z = Q_out[6, j], Q_out[7, j], Q_out[8, j]
        for i in range(3):
            F_out[i, j], F_out[6 + i, j] = J[i, j], J[6 + i, j]
            F_out[3 + i, j] = R_out[0, i] * J[3, j] + R_out[1, i] * J[4, j] + R_out[2, i] * J[5, j]
            Q_out[6 + i, j] = R_out[i, 0] * x + R_out[i, 1] * y + R_out[i, 2] * z
    for j in range(15):
        x, y, z = Q_out[j, 6], Q_out[j, 7], Q_out[j, 8]
        for i in range(3):
            Q_out[j, 6 + i] = R_out[i, 0] * x + R_out[i, 1] * y + R_out[i, 2] * z


@kernel()
def transitions(
    motions: Matrix, covariances: Matrices, states: States, out: States, F_out: Matrices, Q_out: Matrices
) -> None:
    """The states at the ends of n intervals, and how errors get there.

    Parameters
    ----------
    motions, covariances : ndarray, shapes (n, ROW), (n, 15, 15)
    states, out : at their beginnings, and at their ends
    F_out, Q_out : ndarray, shape (n, 15, 15), transitions and process noise
    """
    for k in range(len(motions)):
        state, there = epoch(states, k), epoch(out, k)
        predict_with_transition(motions[k], covariances[k], state, there, F_out[k], Q_out[k])
