"""What IMU samples around a keyframe say beyond their integral: rate, mean, gaps and noise.

Samples are a table of shape (m, 7): time, specific force, rate, body axes.
"""

import math

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper, kernel


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


@kernel("UniTuple(f8, 2)(f8[:, ::1], f8, f8, i8, f8[::1])")
def fit_rate(imu: Array, time: float, half_window: float, enough: int, rate_out: Array) -> tuple[float, float]:
    """Rate at a time, of a parabola through the samples within ``half_window`` of it, if there are ``enough``.

    Through fewer a parabola says too little; then it is interpolated between the two around it.

    Returns
    -------
    step : between the samples [s]; 0 where there is but one
    share : of the variance of a sample that is left in the rate
    """
    first, last = first_not_before(imu, time - half_window), first_not_before(imu, time + half_window + 1e-9)
    parabola = last - first >= enough
    if not parabola:
        first = first_not_before(imu, time)
        if first == len(imu) or imu[first, 0] > time:
            first -= 1
        first = min(max(first, 0), max(len(imu) - 2, 0))
        last = min(first + 2, len(imu))
    if last - first < 2:
        for i in range(3):
            rate_out[i] = imu[first, 4 + i]
        return 0.0, 1.0
    s0 = s1 = s2 = s3 = s4 = 0.0
    for k in range(first, last):
        x = (imu[k, 0] - time) / half_window
        s0, s1, s2, s3, s4 = s0 + 1.0, s1 + x, s2 + x * x, s3 + x * x * x, s4 + x * x * x * x
    a, b, c = 0.0, -s1, s2  # the last row of the normal matrix's inverse
    if parabola:
        a, b, c = s3 * s1 - s2 * s2, s3 * s2 - s4 * s1, s4 * s2 - s3 * s3
    scale, share = 1.0 / (a * s2 + b * s1 + c * s0), 0.0
    for i in range(3):
        rate_out[i] = 0.0
    for k in range(first, last):
        x = (imu[k, 0] - time) / half_window
        weight = scale * ((a * x + b) * x + c)
        share += weight * weight
        for i in range(3):
            rate_out[i] += weight * imu[k, 4 + i]
    return (imu[last - 1, 0] - imu[first, 0]) / (last - first - 1), share


@kernel("UniTuple(f8, 4)(f8[:, ::1], f8, f8)")
def survey(imu: Array, start: float, end: float) -> tuple[float, float, float, float]:
    """Gaps between samples, and how much these scatter.

    Returns
    -------
    longest, within : step between samples, of all, and of those between which ``start`` to ``end`` lies [s]
    acc, gyr : how much samples differ from the mean of their neighbours, as noise densities: white noise of density
        d gives values of standard deviation d
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


@kernel("void(f8[:, ::1], f8, f8, i8, f8[::1])")
def mean_signal(imu: Array, begin: float, end: float, count: int, mean_out: Array) -> None:
    """Mean over a time of specific force and rate, of ``count`` times from its beginning to its end."""
    for i in range(6):
        mean_out[i] = 0.0
    for n in range(count):
        time = begin + (end - begin) * n / (count - 1)
        after = min(max(first_not_before(imu, time), 1), len(imu) - 1)
        before = max(after - 1, 0)
        span = imu[after, 0] - imu[before, 0]
        share = min(max((time - imu[before, 0]) / span, 0.0), 1.0) if span > 0.0 else 0.0
        for i in range(6):
            step = imu[after, 1 + i] - imu[before, 1 + i]
            mean_out[i] += (imu[before, 1 + i] + share * step) / count
