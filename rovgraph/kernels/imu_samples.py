"""What IMU samples around a keyframe say beyond their integral: rate, mean, gaps and noise.

Samples are a table of shape (m, 7): time, specific force, rate, body axes.
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Matrix, Vector, helper, kernel

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

    Through fewer a parabola says too little; then it is interpolated between the two around it. The lever arm turns
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
