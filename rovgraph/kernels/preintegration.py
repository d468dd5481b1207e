"""IMU preintegration from one keyframe to the next, with its derivative by the bias and its covariance.

The motion is a vector zeta = (theta, p, v) in the tangent space of the keyframe: rotation vector Log(dR), change
of position, change of velocity. A step of length dt with unbiased specific force a and rate w takes it to

    theta' = theta + dt Jr(theta)^-1 w
    p' = p + dt v + dt^2 / 2 R a,  R = Exp(theta)
    v' = v + dt R a

(the tangent preintegration of GTSAM's ImuFactor.pdf). Errors of theta, p, v and of the biases obey x' = F x + w with

        | I + dt d(Jr^-1 w)/dtheta  0  0     0            dt Jr^-1 |
        | dt/2 A                    I  dt I  dt^2/2 R     0        |
    F = | A                         0  I     dt R         0        |,  A = -dt R S(a) Jr(theta)
        | 0                         0  0     I            0        |
        | 0                         0  0     0            I        |

so the covariance becomes F P F' + Q, and the derivative H of zeta by the bias obeys (H', -I) = F (H, -I).

Between two samples both signals are taken as linear. The step above turns the specific force with the attitude at
its beginning; rotating it by half the step's turn first makes the integration second order.

Beside the integral, IMU samples around a keyframe give its angular rate, their mean, gaps and noise. Samples are a
table of shape (m, 7): time, specific force, rate, body axes.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Matrix, Vector, helper, kernel
from rovgraph.kernels.motion_row import BIAS, BY_BIAS, DURATION, EARTH_RATE, GRAVITY, NOISE, TANGENT
from rovgraph.kernels.rotations import (
    cross,
    exp_and_left_jacobian,
    exp_rotation,
    inverse_jacobian_with_slope,
    multiply,
    multiply_transposed,
    right_jacobian,
    skew,
)

Index = NDArray[np.int64]

STEP = 8  # numbers of a step: time of its end, length, specific force, rate
SNAPSHOT = 16  # numbers of a snapshot: time since the keyframe, dR by rows, dv, dp


@helper
def first_after(imu: Array, time: float) -> int:
    """Index of the first sample after a time."""
    low, high = 0, len(imu)
    while low < high:
        middle = (low + high) // 2
        if imu[middle, 0] <= time:
            low = middle + 1
        else:
            high = middle
    return low


@helper
def _most_steps(imu: Array, start: float, stops: Array, end: float) -> int:
    return first_after(imu, end) - first_after(imu, start) + len(stops) + 1


@helper
def _steps(imu: Array, start: float, stops: Array, end: float, bias: Array, steps_out: Array) -> int:
    """From one sample or stop to the next, with the signal in their middle; how many."""
    sample = first_after(imu, start)
    after, stop, count, now, last = sample, 0, 0, start, len(imu) - 1
    force, rate, turned = np.empty(3), np.empty(3), np.empty(3)
    while now < end:
        while sample <= last and imu[sample, 0] <= now:
            sample += 1
        while stop < len(stops) and stops[stop] <= now:
            stop += 1
        then = end
        if sample <= last:
            then = min(then, imu[sample, 0])
        if stop < len(stops):
            then = min(then, stops[stop])
        middle, dt = 0.5 * (then + now), then - now
        while after < last and imu[after, 0] < middle:
            after += 1
        before = max(after - 1, 0)
        after = min(before + 1, last)
        span = imu[after, 0] - imu[before, 0]
        share = min(max((middle - imu[before, 0]) / span, 0.0), 1.0) if span > 0.0 else 0.0
        step = steps_out[count]
        step[0], step[1] = then, dt
        for i in range(6):
            step[2 + i] = imu[before, 1 + i] + share * (imu[after, 1 + i] - imu[before, 1 + i])
        for i in range(3):
            force[i], rate[i] = step[2 + i] - bias[i], step[5 + i] - bias[3 + i]
        cross(rate, force, turned)
        for i in range(3):
            step[2 + i] += 0.5 * dt * turned[i]
        now, count = then, count + 1
    return count


@helper
def _advance(zeta: Array, step: Array, bias: Array, work: Array, F_out: Array) -> None:
    """One step of the motion, in place, and the parts of F: I + dt d(Jr^-1 w)/dtheta, dt Jr^-1, A, dt R."""
    turn, inverse, A, R = F_out[0], F_out[1], F_out[2], F_out[3]
    Jl, dt = work, step[1]
    ax, ay, az = step[2] - bias[0], step[3] - bias[1], step[4] - bias[2]
    w = R[0]  # not in use yet
    w[0], w[1], w[2] = step[5] - bias[3], step[6] - bias[4], step[7] - bias[5]
    inverse_jacobian_with_slope(zeta, w, 0.5, inverse, turn)
    wx, wy, wz = dt * w[0], dt * w[1], dt * w[2]
    exp_and_left_jacobian(zeta, R, Jl)
    for i in range(3):
        zeta[i] += inverse[i, 0] * wx + inverse[i, 1] * wy + inverse[i, 2] * wz
        for j in range(3):
            turn[i, j] *= dt
            inverse[i, j] *= dt
            R[i, j] *= dt
        turn[i, i] += 1.0
    ux = R[0, 0] * ax + R[0, 1] * ay + R[0, 2] * az
    uy = R[1, 0] * ax + R[1, 1] * ay + R[1, 2] * az
    uz = R[2, 0] * ax + R[2, 1] * ay + R[2, 2] * az
    for j in range(3):  # R S(a) Jr = S(R a) Jl
        A[0, j] = uz * Jl[1, j] - uy * Jl[2, j]
        A[1, j] = ux * Jl[2, j] - uz * Jl[0, j]
        A[2, j] = uy * Jl[0, j] - ux * Jl[1, j]
    zeta[3] += dt * (zeta[6] + 0.5 * ux)
    zeta[4] += dt * (zeta[7] + 0.5 * uy)
    zeta[5] += dt * (zeta[8] + 0.5 * uz)
    zeta[6] += ux
    zeta[7] += uy
    zeta[8] += uz


@helper
def _propagate(F: Array, dt: float, noise: Array, duration: float, X: Array) -> None:
    """F P F' + Q and F (H, -I) in place.

    ``X`` has shape (21, 9): the covariance of zeta, of the biases with zeta, and H'. The biases' own is known.
    """
    _apply(F, dt, X)
    acc_variance, gyr_variance = noise[2] * noise[2] * duration, noise[3] * noise[3] * duration
    for row in range(9, 16, 6):
        for k in range(3):
            _apply_to_bias(F, dt, k, acc_variance, gyr_variance, X, row)
        acc_variance = gyr_variance = -1.0  # in H stands -I
    for i in range(9):
        for j in range(i):
            X[i, j], X[j, i] = X[j, i], X[i, j]
    _apply(F, dt, X)
    acc, gyr = noise[0] * noise[0], noise[1] * noise[1] / dt
    for i in range(3):
        for j in range(3):
            X[i, j] += gyr * (F[1, i, 0] * F[1, j, 0] + F[1, i, 1] * F[1, j, 1] + F[1, i, 2] * F[1, j, 2])
        X[3 + i, 3 + i] += dt * (0.25 * dt * dt * acc + noise[4] * noise[4])
        X[3 + i, 6 + i] += 0.5 * dt * dt * acc
        X[6 + i, 3 + i] += 0.5 * dt * dt * acc
        X[6 + i, 6 + i] += dt * acc


@helper
def _apply(F: Array, dt: float, X: Array) -> None:
    """The first nine rows of F times each column of the covariance, the biases' being in rows 9 to 14."""
    for j in range(9):
        x, y, z = X[0, j], X[1, j], X[2, j]
        a, b, c, d, e, f = X[9, j], X[10, j], X[11, j], X[12, j], X[13, j], X[14, j]
        for i in range(3):
            faster = F[2, i, 0] * x + F[2, i, 1] * y + F[2, i, 2] * z + F[3, i, 0] * a + F[3, i, 1] * b + F[3, i, 2] * c
            turned = F[0, i, 0] * x + F[0, i, 1] * y + F[0, i, 2] * z + F[1, i, 0] * d + F[1, i, 1] * e + F[1, i, 2] * f
            X[i, j] = turned
            X[3 + i, j] += dt * (X[6 + i, j] + 0.5 * faster)
            X[6 + i, j] += faster


@helper
def _apply_to_bias(F: Array, dt: float, k: int, acc: float, gyr: float, X: Array, row: int) -> None:
    """The same for the columns, in rows from ``row`` on, of the biases ``k``; their own variances are given."""
    g = row + 3 + k
    x, y, z = X[g, 0], X[g, 1], X[g, 2]
    for i in range(3):
        faster = F[3, i, k] * acc
        X[row + k, 3 + i] += dt * (X[row + k, 6 + i] + 0.5 * faster)
        X[row + k, 6 + i] += faster
        faster = F[2, i, 0] * x + F[2, i, 1] * y + F[2, i, 2] * z
        X[g, i] = F[0, i, 0] * x + F[0, i, 1] * y + F[0, i, 2] * z + F[1, i, k] * gyr
        X[g, 3 + i] += dt * (X[g, 6 + i] + 0.5 * faster)
        X[g, 6 + i] += faster


@helper
def _residual_by_motion(zeta: Array, duration: float, row: Array, J_out: Array) -> None:
    """Derivative of the residual by zeta, shape (9, 9), of which the zeros are not written.

    Rotation, position and velocity in the axes of the keyframe at the end. On a turning Earth the velocity in n
    depends on the position; taken for a keyframe before that stands level and faces north, as GTSAM does.
    """
    R, Jr, spin, there, spun = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    rate = np.empty(3)
    exp_rotation(zeta, R)
    right_jacobian(zeta, Jr)
    for i in range(3):
        rate[i] = -duration * row[EARTH_RATE + i]
    exp_rotation(rate, spin)
    multiply(spin, R, there)
    for i in range(3):
        rate[i] = row[EARTH_RATE + i]
    skew(rate, spin)
    multiply(spin, there, spun)
    multiply_transposed(there, spun, spin)
    for i in range(3):
        for j in range(3):
            J_out[i, j], J_out[3 + i, 3 + j], J_out[6 + i, 6 + j] = Jr[i, j], R[j, i], R[j, i]
            J_out[6 + i, 3 + j] = -(spin[i, 0] * R[j, 0] + spin[i, 1] * R[j, 1] + spin[i, 2] * R[j, 2])


@helper
def _write_covariance(zeta: Array, X: Array, noise: Array, row: Array, S_out: Array) -> None:
    """From the covariance of zeta and the biases to that of the factor's residual: bias before less bias after."""
    J, half = np.zeros((9, 9)), np.empty((15, 9))
    _residual_by_motion(zeta, row[DURATION], row, J)
    for i in range(15):
        for j in range(9):
            half[i, j] = 0.0
            for k in range(9):
                half[i, j] += J[j, k] * X[i, k]
    for i in range(15):
        for j in range(15):
            S_out[i, j] = 0.0
    for j in range(9):
        for i in range(j, 9):
            total = 0.0
            for k in range(9):
                total += J[i, k] * half[k, j]
            S_out[i, j] = S_out[j, i] = total
        for i in range(9, 15):
            S_out[i, j] = S_out[j, i] = -half[i, j]
    for i in range(9, 15):
        walk = noise[2] if i < 12 else noise[3]
        S_out[i, i] = walk * walk * row[DURATION]


@helper
def _write_snapshot(duration: float, zeta: Array, R: Array, snapshot_out: Array) -> None:
    exp_rotation(zeta, R)
    snapshot_out[0] = duration
    for i in range(3):
        for j in range(3):
            snapshot_out[1 + 3 * i + j] = R[i, j]
        snapshot_out[10 + i], snapshot_out[13 + i] = zeta[6 + i], zeta[3 + i]


@helper
def integrate(
    imu: Array, start: float, end: float, stops: Array, row: Array, S_out: Array, snapshots_out: Array
) -> None:
    """Integrate the samples of one interval; parameters as of `preintegrate`, of one interval."""
    zeta, X, F, work = np.zeros(9), np.zeros((21, 9)), np.empty((4, 3, 3)), np.empty((3, 3))
    bias, noise = row[BIAS : BIAS + 6], row[NOISE:GRAVITY]
    steps, duration, taken = np.empty((_most_steps(imu, start, stops, end), STEP)), 0.0, 0
    count = _steps(imu, start, stops, end, bias, steps)
    while taken < len(stops) and stops[taken] <= start:
        _write_snapshot(0.0, zeta, work, snapshots_out[taken])
        taken += 1
    for k in range(count):
        _advance(zeta, steps[k], bias, work, F)
        _propagate(F, steps[k, 1], noise, duration, X)
        duration += steps[k, 1]
        while taken < len(stops) and stops[taken] <= steps[k, 0]:
            _write_snapshot(duration, zeta, work, snapshots_out[taken])
            taken += 1
    row[DURATION] = duration
    for i in range(9):
        row[TANGENT + i] = zeta[i]
        for j in range(6):
            row[BY_BIAS + 6 * i + j] = X[15 + j, i]
    _write_covariance(zeta, X, noise, row, S_out)


@kernel()
def preintegrate(
    imu: Matrix, start: float, end: float, stops: Vector, row_out: Vector, S_out: Matrix, snapshots_out: Matrix
) -> None:
    """Integrate IMU samples over an interval.

    Parameters
    ----------
    imu : ndarray, shape (m, 7), time, specific force, rate in body axes; held beyond their ends
    start, end : [s]
    stops : ndarray, shape (k,), times at which a snapshot is wanted, increasing [s]
    row_out : ndarray, shape (ROW,), with bias, noise and rate of the Earth where `rovgraph.kernels.motion_row` has
        them; duration and motion are written
    S_out : ndarray, shape (15, 15), covariance of the residual
    snapshots_out : ndarray, shape (k, SNAPSHOT)
    """
    integrate(imu, start, end, stops, row_out, S_out, snapshots_out)


@kernel("f8[:, ::1](f8[:, ::1], f8, f8[::1], f8, f8[::1])")
def integrated_steps(imu: Array, start: float, stops: Array, end: float, bias: Array) -> Array:
    """The steps that `preintegrate` takes, shape (s, STEP), with the biases still in them."""
    steps = np.empty((_most_steps(imu, start, stops, end), STEP))
    return steps[: _steps(imu, start, stops, end, bias, steps)]


HALF_WINDOW_S = 0.05  # around a time, over which the rate is averaged; measurements wait that long
ENOUGH_FOR_A_CURVE = 5  # samples in that window; a slower IMU is interpolated between two
MEAN_OF = 21  # times of an interval, in a mean over it


@helper
def first_not_before(imu: Array, time: float) -> int:
    """Index of the first sample at or after a time."""
    low, high = 0, len(imu)
    while low < high:
        middle = (low + high) // 2
        if imu[middle, 0] < time:
            low = middle + 1
        else:
            high = middle
    return low


@helper
def fit_rate(imu: Array, time: float, rate_out: Array) -> tuple[float, float]:
    """Rate at a time, of a parabola through the samples within `HALF_WINDOW_S` of it, if they are enough.

    With fewer samples a parabola is too uncertain; then the rate is interpolated. The lever arm turns
    the noise of the rate into velocity, and the derivative by the misalignment into knowledge that is not there, so a
    single sample would not do.

    Returns
    -------
    Step between the samples, 0 where there is but one [s], and the share of a sample's variance that is left
    """
    begin, end = first_not_before(imu, time - HALF_WINDOW_S), first_not_before(imu, time + HALF_WINDOW_S + 1e-9)
    parabola = end - begin >= ENOUGH_FOR_A_CURVE
    if not parabola:
        begin = first_not_before(imu, time)
        if begin == len(imu) or imu[begin, 0] > time:
            begin -= 1
        begin = min(max(begin, 0), max(len(imu) - 2, 0))
        end = min(begin + 2, len(imu))
    if end - begin < 2:
        for i in range(3):
            rate_out[i] = imu[begin, 4 + i]
        return 0.0, 1.0
    s0 = s1 = s2 = s3 = s4 = 0.0
    for k in range(begin, end):
        x = (imu[k, 0] - time) / HALF_WINDOW_S
        s0, s1, s2, s3, s4 = s0 + 1.0, s1 + x, s2 + x * x, s3 + x * x * x, s4 + x * x * x * x
    a, b, c = 0.0, -s1, s2  # the last row of the normal matrix's inverse
    if parabola:
        a, b, c = s3 * s1 - s2 * s2, s3 * s2 - s4 * s1, s4 * s2 - s3 * s3
    scale, share = 1.0 / (a * s2 + b * s1 + c * s0), 0.0
    for i in range(3):
        rate_out[i] = 0.0
    for k in range(begin, end):
        x = (imu[k, 0] - time) / HALF_WINDOW_S
        weight = scale * ((a * x + b) * x + c)
        share += weight * weight
        for i in range(3):
            rate_out[i] += weight * imu[k, 4 + i]
    return (imu[end - 1, 0] - imu[begin, 0]) / (end - begin - 1), share


@helper
def survey(imu: Array, start: float, end: float) -> tuple[float, float, float, float]:
    """Gaps between the samples of an interval, and how much these scatter.

    Returns
    -------
    longest, within : step between samples, of all, and of those between which ``start`` to ``end`` lies [s]
    acc, gyr : how much samples differ from the mean of their neighbours, as noise densities: white noise of density d
        gives values of standard deviation d
    """
    longest = within = acc = gyr = 0.0
    for k in range(1, len(imu)):
        step = imu[k, 0] - imu[k - 1, 0]
        longest = max(longest, step)
        if imu[k, 0] > start and imu[k - 1, 0] < end:
            within = max(within, step)
    if len(imu) > 2:
        for k in range(1, len(imu) - 1):
            for i in range(1, 4):
                odd = imu[k, i] - 0.5 * (imu[k - 1, i] + imu[k + 1, i])
                acc += odd * odd
                odd = imu[k, 3 + i] - 0.5 * (imu[k - 1, 3 + i] + imu[k + 1, 3 + i])
                gyr += odd * odd
        period = (imu[len(imu) - 1, 0] - imu[0, 0]) / (len(imu) - 1)
        share = period / 1.5 / (3.0 * (len(imu) - 2))
        acc, gyr = math.sqrt(acc * share), math.sqrt(gyr * share)
    return longest, within, acc, gyr


@helper
def typical_scatter(imu: Array, typical_out: Array) -> None:
    """How much at least three samples, shape (m, 7), scatter as a rule, as noise densities; shape (2,).

    By the median along each axis, which knocks leave as it is, of differences as `survey` takes them.
    """
    inner = len(imu) - 2
    odd = np.empty(inner)
    root = math.sqrt((imu[inner + 1, 0] - imu[0, 0]) / (inner + 1) / 1.5)
    for half in range(2):
        total = 0.0
        for i in range(1 + 3 * half, 4 + 3 * half):
            for k in range(inner):
                odd[k] = abs((imu[k + 1, i] - 0.5 * (imu[k, i] + imu[k + 2, i])) * root)
            total += np.sort(odd)[inner // 2]
        typical_out[half] = 1.4826 * (total / 3.0)


@helper
def mean_signal(imu: Array, begin: float, end: float, mean_out: Array) -> None:
    """Mean of specific force and rate, shape (6,), of `MEAN_OF` times from begin to end."""
    for i in range(6):
        mean_out[i] = 0.0
    for m in range(MEAN_OF):
        time = begin + (end - begin) * m / (MEAN_OF - 1)
        after = min(max(first_not_before(imu, time), 1), len(imu) - 1)
        before = max(after - 1, 0)
        span = imu[after, 0] - imu[before, 0]
        share = min(max((time - imu[before, 0]) / span, 0.0), 1.0) if span > 0.0 else 0.0
        for i in range(6):
            step = imu[after, 1 + i] - imu[before, 1 + i]
            mean_out[i] += (imu[before, 1 + i] + share * step) / MEAN_OF


@kernel()
def fit_rates(imu: Matrix, time: Vector, rate_out: Matrix) -> None:
    """Rate at n times, shape (n, 3), as of `fit_rate`."""
    for n in range(len(time)):
        fit_rate(imu, time[n], rate_out[n])
