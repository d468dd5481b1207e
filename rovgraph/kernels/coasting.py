"""Motion while the IMU is silent: one interval, written for the callers in `rovgraph.kernels.motion`.

Integrating an interpolated specific force needs the attitude, and an attitude that nobody measures would turn
gravity into motion: after five seconds, by tens of metres, of which no linear filter recovers. A vehicle that is
heavy below and light above does not roll over meanwhile. So it is taken to go on as it went, with a velocity that
walks, a heading that walks, and a tilt that rights itself, a first-order Gauss-Markov process (Gelb 1974):

    tilt_j = a tilt_i + w,  a = exp(-t / RIGHTING_S),  var w = (1 - a^2) TILT_SD^2
    yaw_j = yaw_i + dyaw + w,  p_j = p_i + t v_i + w,  v_j = v_i + w,  bias_j = bias_i + w

with dyaw from the interpolated gyro, and p and v driven by one white acceleration. Roll, pitch and yaw change with
a turn of the body by

    B = | 1  sin r tan p  cos r tan p |           | 1  0      -sin p       |
        | 0  cos r        -sin r      |,   B^-1 = | 0  cos r  sin r cos p  |
        | 0  sin r sec p  cos r sec p |           | 0  -sin r cos r cos p  |
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper
from rovgraph.kernels.motion_row import AFTER, DURATION, NOISE, RESIDUAL, TANGENT
from rovgraph.kernels.rotations import exp_rotation
from rovgraph.kernels.states import Epoch

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


@helper
def coast(row: Array, state: Epoch, out: Epoch) -> None:
    """Attitude, position and velocity at the end of an interval."""
    rpy = np.empty(3)
    _predict_angles(row, state.R, rpy)
    _from_roll_pitch_yaw(rpy, out.R)
    for i in range(3):
        out.p[i], out.v[i] = state.p[i] + row[DURATION] * state.v[i], state.v[i]


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
        A_out[3 + i, RESIDUAL] = p_j[i] - p_i[i] - row[DURATION] * v_i[i]
        A_out[6 + i, RESIDUAL] = v_j[i] - v_i[i]
        A_out[3 + i, 6 + i] = -row[DURATION]
        for j in range(3):
            A_out[i, j] = -B_i[i, j] * (kept if i < 2 else 1.0)
            A_out[i, AFTER + j] = B_j[i, j]
            A_out[3 + i, 3 + j], A_out[3 + i, AFTER + 3 + j] = -R_i[i, j], R_j[i, j]
    for i in range(6):
        A_out[9 + i, RESIDUAL] = bias_j[i] - bias_i[i]


@helper
def coasting_transition(row: Array, R_i: Array, R_j: Array, F_out: Array, Q_out: Array) -> None:
    """Linear transition and its noise, shape (15, 15), where ``R_j`` was predicted from ``R_i``."""
    before, rpy, B, back = np.empty(3), np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    kept, t = _kept(row), row[DURATION]
    roll_pitch_yaw(R_i, before)
    roll_pitch_yaw(R_j, rpy)
    _by_turn(before, B)
    sr, cr, sp, cp = math.sin(rpy[0]), math.cos(rpy[0]), math.sin(rpy[1]), math.cos(rpy[1])
    back[0, 0], back[0, 1], back[0, 2] = 1.0, 0.0, -sp
    back[1, 0], back[1, 1], back[1, 2] = 0.0, cr, sr * cp
    back[2, 0], back[2, 1], back[2, 2] = 0.0, -sr, cr * cp
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
            F_out[3 + i, 6 + j] = t * R_j[j, i]
            Q_out[i, j] = tilt * (back[i, 0] * back[j, 0] + back[i, 1] * back[j, 1]) + heading * back[i, 2] * back[j, 2]
            Q_out[3 + i, 6 + j] = Q_out[6 + j, 3 + i] = both * R_j[j, i]
