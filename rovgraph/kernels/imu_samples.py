"""What IMU samples around a keyframe say beyond their integral: rate, mean, gaps and noise.

Samples are a table of shape (m, 7): time, specific force, rate, body axes. Of n times or intervals each has its own
part of the table, from ``first`` to before ``last``.
"""

import math

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper, kernel

Index = NDArray[np.int64]


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


@kernel("void(f8[:, ::1], i8[::1], i8[::1], f8[::1], f8, i8, f8[:, ::1], f8[:, ::1])")
def fit_rates(
    table: Array,
    first: Index,
    last: Index,
    time: Array,
    half_window: float,
    enough: int,
    rate_out: Array,
    fit_out: Array,
) -> None:
    """Rate at n times, of a parabola through the samples within ``half_window`` of each, if there are ``enough``.

    Through fewer a parabola says too little; then it is interpolated between the two around it.

    Parameters
    ----------
    rate_out : shape (n, 3)
    fit_out : shape (n, 2), step between the samples, 0 where there is but one [s], and the share of the variance of a
        sample that is left in the rate
    """
    for n in range(len(time)):
        imu, rate = table[first[n] : last[n]], rate_out[n]
        begin, end = first_not_before(imu, time[n] - half_window), first_not_before(imu, time[n] + half_window + 1e-9)
        parabola = end - begin >= enough
        if not parabola:
            begin = first_not_before(imu, time[n])
            if begin == len(imu) or imu[begin, 0] > time[n]:
                begin -= 1
            begin = min(max(begin, 0), max(len(imu) - 2, 0))
            end = min(begin + 2, len(imu))
        if end - begin < 2:
            for i in range(3):
                rate[i] = imu[begin, 4 + i]
            fit_out[n, 0], fit_out[n, 1] = 0.0, 1.0
            continue
        s0 = s1 = s2 = s3 = s4 = 0.0
        for k in range(begin, end):
            x = (imu[k, 0] - time[n]) / half_window
            s0, s1, s2, s3, s4 = s0 + 1.0, s1 + x, s2 + x * x, s3 + x * x * x, s4 + x * x * x * x
        a, b, c = 0.0, -s1, s2  # the last row of the normal matrix's inverse
        if parabola:
            a, b, c = s3 * s1 - s2 * s2, s3 * s2 - s4 * s1, s4 * s2 - s3 * s3
        scale, share = 1.0 / (a * s2 + b * s1 + c * s0), 0.0
        for i in range(3):
            rate[i] = 0.0
        for k in range(begin, end):
            x = (imu[k, 0] - time[n]) / half_window
            weight = scale * ((a * x + b) * x + c)
            share += weight * weight
            for i in range(3):
                rate[i] += weight * imu[k, 4 + i]
        fit_out[n, 0], fit_out[n, 1] = (imu[end - 1, 0] - imu[begin, 0]) / (end - begin - 1), share


@kernel("void(f8[:, ::1], i8[::1], i8[::1], f8[::1], f8[::1], f8[:, ::1])")
def survey(table: Array, first: Index, last: Index, start: Array, end: Array, found_out: Array) -> None:
    """Gaps between the samples of n intervals, and how much these scatter.

    Parameters
    ----------
    found_out : shape (n, 4)

        longest, within   step between samples, of all, and of those between which ``start`` to ``end`` lies [s]
        acc, gyr          how much samples differ from the mean of their neighbours, as noise densities: white noise
                          of density d gives values of standard deviation d
    """
    for n in range(len(start)):
        imu = table[first[n] : last[n]]
        longest = within = acc = gyr = 0.0
        for k in range(1, len(imu)):
            step = imu[k, 0] - imu[k - 1, 0]
            longest = max(longest, step)
            if imu[k, 0] > start[n] and imu[k - 1, 0] < end[n]:
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
        found_out[n, 0], found_out[n, 1], found_out[n, 2], found_out[n, 3] = longest, within, acc, gyr


@kernel("void(f8[:, ::1], f8[::1])")
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


@kernel("void(f8[:, ::1], i8[::1], i8[::1], f8[::1], f8[::1], i8, f8[:, ::1])")
def mean_signals(
    table: Array, first: Index, last: Index, begin: Array, end: Array, count: int, mean_out: Array
) -> None:
    """Means over n intervals of specific force and rate, of ``count`` times from begin to end; shape (n, 6)."""
    for n in range(len(begin)):
        imu, mean = table[first[n] : last[n]], mean_out[n]
        for i in range(6):
            mean[i] = 0.0
        for m in range(count):
            time = begin[n] + (end[n] - begin[n]) * m / (count - 1)
            after = min(max(first_not_before(imu, time), 1), len(imu) - 1)
            before = max(after - 1, 0)
            span = imu[after, 0] - imu[before, 0]
            share = min(max((time - imu[before, 0]) / span, 0.0), 1.0) if span > 0.0 else 0.0
            for i in range(6):
                step = imu[after, 1 + i] - imu[before, 1 + i]
                mean[i] += (imu[before, 1 + i] + share * step) / count
