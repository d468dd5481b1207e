"""Attitude of dead reckoning: the gyro integrated, levelled by gravity, turned by a compass.

    R_j = Exp(-w_ie dt) R_i dR Exp(-dt b'),   v_j = v_i + R_i dv + g dt

carry attitude and velocity from one epoch to the next, with the IMU's preintegrated motion dR, dv and b' the gyro's
bias beyond the one that was assumed in it. With errors in n, R_nb the true attitude and R the estimate,
R_nb = Exp(phi) R, and beta = -R db that of the gyro's bias,

    phi' = beta + gyro noise,   (v_north, v_east)' = g (-phi_east, phi_north) + accelerometer noise

so each horizontal axis by itself is a chain of velocity, tilt and drift. The DVL's velocity corrects it: gravity is
what the accelerometer shows beyond the DVL's acceleration. The third chain is that of a compass's deviation, heading
and drift,

    deviation <- a deviation + noise,   a = exp(-|turn| / 1 rad)

in which the compass measures deviation plus heading. Gains are those of a Kalman filter of each chain
(Gelb 1974, section 4.2): a complementary filter with bias feedback (Mahony et al. 2008) whose gains follow the noise.
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Flags, Matrices, Matrix, Vector, helper, kernel
from rovgraph.kernels.earth import radii, turning
from rovgraph.kernels.rotations import cross, dot, exp_rotation, multiply, rotate, rotate_back

ANGLE, DRIFT = 1, 2  # components of a chain, after velocity or deviation
DEVIATES_OVER = 1.0  # a turn by which a compass comes to deviate otherwise [rad]
SINCE, CLIPPED, DEVIATION = 0, 1, 2  # of a sensor: time since its last measurement, time of clipped ones, deviation
CLIP_SD = 4.0  # at which innovations are clipped
INFLATE_AFTER_S = 5.0  # of innovations that are all clipped the attitude's covariance is inflated
SHORTEST_S = 0.02  # between two velocities


class Motions(NamedTuple):
    """The IMU's motion to each of m epochs from the one before, zero where there is no motion.

    Attributes
    ----------
    outage : shape (m,), bool, the IMU had an outage meanwhile
    dt, dR, dv : shapes (m,), (m, 3, 3), (m, 3) [s, -, m/s]
    assumed : shape (m, 3), gyro bias that dR is for [rad/s]
    density : shape (m, 3), squared densities of the noise of specific force, of rate, and of the gyro's walk
    """

    outage: Flags
    dt: Vector
    dR: Matrices
    dv: Matrix
    assumed: Matrix
    density: Matrix


class Aiding(NamedTuple):
    """Measurements at m epochs.

    Attributes
    ----------
    dvl : shape (m, 4), velocity of the IMU by the DVL, body axes, but for what the gyro's bias does over the lever
        arm [m/s], and the variance of an axis, infinite = no ping
    compass : shape (m, 3), angle about down from the attitude ``reference`` to the one that the compass shows [rad],
        its variance, infinite = no heading, and what it grows by with the variance of tilt
    reference : shape (m, 3, 3)
    """

    dvl: Matrix
    compass: Matrix
    reference: Matrices


class LevelStart(NamedTuple):
    """Before the first epoch.

    Attributes
    ----------
    R, bias : shapes (3, 3), (3,), attitude and the gyro's bias
    P : shape (2, 3, 3), covariances of the chains of velocity and tilt, and of deviation and heading
    """

    R: Matrix
    bias: Vector
    P: Matrices


class Surroundings(NamedTuple):
    """Constants that are taken as known.

    Attributes
    ----------
    gravity : [m/s^2]
    valid_s : for how long a ping's velocity is used [s]
    held : squared density of the noise of a velocity that is held from then on
    deviation_var : of the compass [rad^2]
    w_ie_n : rate of the Earth in n [rad/s]
    latitude : where the dive begins in frame "earth", in which the former follows from it; NaN = n is flat [rad]
    arm : lever arm of the DVL from the IMU [m]
    """

    gravity: float
    valid_s: float
    held: float
    deviation_var: float
    w_ie_n: Vector
    latitude: float
    arm: Vector


class Reckoned(NamedTuple):
    """Attitude, velocity in n and the gyro's bias so far, shapes (3, 3), (3,), (3,)."""

    R: Array
    v_n: Array
    bias: Array


class AxisFilter(NamedTuple):
    """Covariance of one chain, shape (3, 3), and what is kept of the sensor that corrects it, shape (3,)."""

    P: Array
    history: Array


@helper
def _copy(A: Array, B_out: Array) -> None:
    """Of a matrix; a loop, since numba compiles assigned slices slowly."""
    for i in range(3):
        for j in range(3):
            B_out[i, j] = A[i, j]


@helper
def _propagate_covariance(
    P: Array, kept: float, pull: float, noise: float, dt: float, density: Array, work: Array
) -> None:
    """P <- F P F' + Q of a chain.

    Of the first component ``kept`` is left, an angle changes it by ``pull`` [1/s], ``noise`` is added to its variance.
    """
    F, M = work[0], work[1]
    F[0, 0], F[0, ANGLE], F[0, DRIFT] = kept, pull * dt, 0.5 * pull * dt * dt
    F[ANGLE, 0], F[ANGLE, ANGLE], F[ANGLE, DRIFT] = 0.0, 1.0, dt
    F[DRIFT, 0], F[DRIFT, ANGLE], F[DRIFT, DRIFT] = 0.0, 0.0, 1.0
    for i in range(ANGLE, DRIFT + 1):  # half before and half after: noise of the angle reaches velocity, too
        P[i, i] += 0.5 * density[i] * dt
    multiply(F, P, M)
    for i in range(3):
        for j in range(3):
            P[i, j] = dot(M[i], F[j])
    P[0, 0] += noise
    for i in range(ANGLE, DRIFT + 1):
        P[i, i] += 0.5 * density[i] * dt


@helper
def _kalman_gains(P: Array, with_angle: float, variance: float, gain_out: Array) -> float:
    """Gains of a chain whose first component plus ``with_angle`` times its angle is measured; the innovation's sd."""
    for i in range(3):
        gain_out[i] = P[i, 0] + with_angle * P[i, ANGLE]
    S = gain_out[0] + with_angle * gain_out[ANGLE] + variance
    for i in range(3):
        gain_out[i] /= S
    for i in range(3):
        for j in range(i + 1):
            P[i, j] -= gain_out[i] * gain_out[j] * S
            P[j, i] = P[i, j]
    return math.sqrt(S)


@helper
def _rotate_about_n(R: Array, north: float, east: float, down: float, work: Array) -> None:
    """R <- Exp(phi) R, phi in n."""
    phi, D, M = work[0, 0], work[1], work[2]
    phi[0], phi[1], phi[2] = north, east, down
    exp_rotation(phi, D)
    multiply(D, R, M)
    _copy(M, R)


@helper
def _propagate_attitude(known: Reckoned, dR: Array, dv: Array, outage: bool, work: Array) -> None:
    """Attitude and horizontal velocity after a motion; during an outage of the IMU only heading changes."""
    R, v_n = known.R, known.v_n
    if outage:
        _rotate_about_n(R, 0.0, 0.0, math.atan2(dR[1, 0], dR[0, 0]), work)
        return
    change, M = work[0, 0], work[1]
    rotate(R, dv, change)
    v_n[0] += change[0]
    v_n[1] += change[1]
    multiply(R, dR, M)
    _copy(M, R)


@helper
def _clip(chain: AxisFilter, innovation: float, sd: float, by_angle: float) -> float:
    """Share of an innovation that is used; inflates the covariance of the angle where it stays too large.

    A clipped innovation corrects neither drift nor deviation: it may be wrong itself. After `INFLATE_AFTER_S` of them
    the angle is taken to be off by what explains the innovation, which changes by ``by_angle`` per radian.
    """
    P, history = chain
    share, since = CLIP_SD * sd / max(innovation, 1e-12), history[SINCE]
    history[SINCE] = 0.0
    if share >= 1.0:
        history[CLIPPED] = 0.0
        return 1.0
    history[CLIPPED] += since
    if history[CLIPPED] > INFLATE_AFTER_S:
        angle = min(innovation / by_angle, 1.0)
        P[ANGLE, ANGLE] += angle * angle
        P[DRIFT, DRIFT] += (angle / history[CLIPPED]) ** 2
        history[CLIPPED] = 0.0
    return share


@helper
def _correct_tilt(known: Reckoned, chain: AxisFilter, v_b: Array, variance: float, gravity: float, work: Array) -> None:
    """Velocity, tilt and the horizontal bias of the gyro corrected by the velocity ``v_b`` in body axes."""
    R, v_n, bias = known
    measured, gain, beta = work[0, 0], work[0, 1], work[0, 2]
    rotate(R, v_b, measured)
    north, east, since = measured[0] - v_n[0], measured[1] - v_n[1], chain.history[SINCE]
    sd = _kalman_gains(chain.P, 0.0, variance, gain)
    v_n[0] += gain[0] * north
    v_n[1] += gain[0] * east
    share = _clip(chain, math.hypot(north, east), sd, gravity * max(since, SHORTEST_S))
    angle, drift = share * gain[ANGLE], gain[DRIFT] if share == 1.0 else 0.0
    beta[0], beta[1], beta[2] = drift * east, -drift * north, 0.0
    rotate_back(R, beta, measured)
    for i in range(3):
        bias[i] -= measured[i]
    _rotate_about_n(R, angle * east, -angle * north, 0.0, work)


@helper
def _correct_heading(known: Reckoned, chain: AxisFilter, innovation: float, variance: float, work: Array) -> None:
    """Heading, the vertical bias of the gyro and the compass's deviation corrected by a compass."""
    R, v_n, bias = known
    gain = work[0, 1]
    innovation -= 2.0 * math.pi * math.floor(innovation / (2.0 * math.pi) + 0.5)
    sd = _kalman_gains(chain.P, 1.0, variance, gain)
    share = _clip(chain, abs(innovation), sd, 1.0)
    angle, drift = share * gain[ANGLE] * innovation, 0.0
    if share == 1.0:
        chain.history[DEVIATION] += gain[0] * innovation
        drift = gain[DRIFT] * innovation
    _rotate_about_n(R, 0.0, 0.0, angle, work)
    north, east = v_n[0], v_n[1]
    v_n[0] = math.cos(angle) * north - math.sin(angle) * east
    v_n[1] = math.sin(angle) * north + math.cos(angle) * east
    for i in range(3):
        bias[i] -= R[2, i] * drift


@helper
def _angle_about_down(R: Array, reference: Array) -> float:
    """By which an attitude is turned from another."""
    sine = dot(R[1], reference[0]) - dot(R[0], reference[1])
    return math.atan2(sine, dot(R[0], reference[0]) + dot(R[1], reference[1]))


@kernel()
def reckon_attitude(
    motions: Motions, aiding: Aiding, start: LevelStart, around: Surroundings, R_out: Matrices, bias_out: Matrix
) -> None:
    """Attitude and gyro bias at m epochs, shapes (m, 3, 3), (m, 3), each after the measurement that it has."""
    outage, dt, dR, dv, assumed, density = motions
    dvl, compass, reference = aiding
    gravity, valid_s, held, deviation_var, w_ie_n, latitude, arm = around
    w_in = w_ie_n.copy()
    R, bias, v_n, v_b = start.R.copy(), start.bias.copy(), np.zeros(3), np.zeros(3)
    tilt, heading, since_ping = (
        AxisFilter(start.P[0].copy(), np.zeros(3)),
        AxisFilter(start.P[1].copy(), np.zeros(3)),
        0.0,
    )
    known, dvl_history, compass_history = Reckoned(R, v_n, bias), tilt.history, heading.history
    work, turn, moved = np.zeros((3, 3, 3)), np.zeros((3, 3)), np.zeros(3)
    for k in range(len(dt)):
        if dt[k] > 0.0:
            for i in range(3):
                moved[i] = -dt[k] * (bias[i] - assumed[k, i])
            exp_rotation(moved, work[0])
            multiply(dR[k], work[0], turn)
            _propagate_attitude(known, turn, dv[k], outage[k], work)
            if not math.isnan(latitude):
                turning(latitude, v_n, w_in)
                latitude += dt[k] * v_n[0] / radii(latitude)[0]
            _rotate_about_n(R, -dt[k] * w_in[0], -dt[k] * w_in[1], -dt[k] * w_in[2], work)
            kept = math.exp(-abs(math.atan2(turn[1, 0], turn[0, 0])) / DEVIATES_OVER)
            compass_history[DEVIATION] *= kept
            pull = 0.0 if outage[k] else gravity
            _propagate_covariance(tilt.P, 1.0, pull, density[k, 0] * dt[k], dt[k], density[k], work)
            _propagate_covariance(heading.P, kept, 0.0, (1.0 - kept * kept) * deviation_var, dt[k], density[k], work)
            since_ping += dt[k]
            dvl_history[SINCE] += dt[k]
            compass_history[SINCE] += dt[k]

        variance = dvl[k, 3]
        if variance < math.inf:
            cross(bias, arm, v_b)
            for i in range(3):
                v_b[i] += dvl[k, i]
            since_ping = 0.0
        elif since_ping > valid_s and dvl_history[SINCE] > 0.5 * valid_s:
            variance = held / dvl_history[SINCE]
        if variance < math.inf:
            _correct_tilt(known, tilt, v_b, variance, gravity, work)
        if compass[k, 1] < math.inf:
            variance = compass[k, 1] + compass[k, 2] * tilt.P[ANGLE, ANGLE]
            innovation = compass[k, 0] - _angle_about_down(R, reference[k]) - compass_history[DEVIATION]
            _correct_heading(known, heading, innovation, variance, work)
        _copy(R, R_out[k])
        for i in range(3):
            bias_out[k, i] = bias[i]
