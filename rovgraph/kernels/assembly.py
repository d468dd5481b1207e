"""Measurements in the order of time become keyframes, the motion between them, and rows of numbers.

A keyframe stands at every DVL ping, and wherever `KeyframeRule.max_gap` passes without one. A ping that comes up to
`KeyframeRule.longest` after the last keyframe makes the keyframe itself: where the period of pings is about
``max_gap``, rounding would otherwise decide whether a ping has a keyframe. Where samples of the IMU are missing there
is one at the first sample after them, so that nothing is carried through a gap. Without an IMU every measurement makes
one, but for what is within `KeyframeRule.min_gap` of one.

Any other measurement belongs to the keyframe before it and carries the motion from there to its own time. What is
looked at has waited until the samples reach `KeyframeRule.around` past it, so its rate can be fitted through samples
on either side. Some sensors count once between two keyframes, the first time: their errors last longer than that.

A measurement stands at its stamp less the time offset that is assumed; what remains until the one that is estimated is
bridged by a window, the motion at knots around the stamp, as far as the prior reaches.

==================  ====  ==========================================================================================
event
==================  ====  ==========================================================================================
`STAMP`, `PLACED`   1, 1  as it came, and where it stands [s]
`SENSOR`, `LINE`    1, 1  its sensor, and in the log
`NAME`                 1  of a place
`FATE`                 1  0, or why it is left out
`VALUES`               *  D components and their D sds, D as many as any sensor has, 3 at least, the third of two sds
                          being a covariance; and the context
==================  ====  ==========================================================================================

==================  ====  ==========================================================================================
keyframe
==================  ====  ==========================================================================================
`TIME`                 1  [s]
`COUNT`                1  samples that had come when it was made
`UPTO`, `HERE`      1, 1  events of the intervals up to this one, in their order; those of them that are at it
`SEGMENT`, `BEGUN`  1, 1  of time that it lies in, and when that began [s]
`RATE_B`, `SPREAD`  3, 1  measured rate, bias still in it, and its noise [rad/s]
`FIRST`, `LAST`     1, 1  samples of the interval that ends with it, from the first to before the last
`TAKEN`                1  rows of measurements up to it
`BELIEVED`             2  densities of noise of accelerometer and gyro from here on [SI/rtHz]
`SCATTER`              2  that the interval's samples show; nan = they show none
`SIGHTED`              1  sightings of places up to it
`FIRST_KNOT`           1  of the water's knots that are kept, the uppermost; of no kernel
==================  ====  ==========================================================================================
"""

import math
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels import motion_row
from rovgraph.kernels.compile import Index, IndexMatrix, Matrices, Matrix, Vector, helper, kernel
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.measurement_row import ASSUMED, KNOT_LAG, KNOT_RATE, MOST, RATE, RATE_SD, SNAPSHOT, Z
from rovgraph.kernels.measurement_row import TIME as AT
from rovgraph.kernels.motion import BRIDGE_ACC, BRIDGE_GYR
from rovgraph.kernels.motion_residual import motion_weight
from rovgraph.kernels.preintegration import (
    HALF_WINDOW_S,
    first_after,
    first_not_before,
    fit_rate,
    integrate,
    mean_signal,
    survey,
    typical_scatter,
)
from rovgraph.kernels.preintegration import SNAPSHOT as NUMBERS

STAMP, PLACED, SENSOR, LINE, NAME, FATE, VALUES = 0, 1, 2, 3, 4, 5, 6
TIME, COUNT, UPTO, HERE, SEGMENT, BEGUN, RATE_B, SPREAD, FIRST, LAST = 0, 1, 2, 3, 4, 5, 6, 9, 10, 11
TAKEN, BELIEVED, SCATTER, SIGHTED, FIRST_KNOT, KEYFRAME = 12, 13, 15, 17, 18, 19
IN, EARLY, LATE, UNFINISHED, BEYOND, IN_VIEW, REFUSED = 0, 1, 2, 3, 4, 5, 6  # fates; of the last there may be more
CLOSES, ONCE, TURNED, DIM, SIGHTS, LAG, ABOUT = 0, 1, 2, 3, 4, 5, 6  # of a sensor; LAG is its place in ``lags`` or -1
SAMPLES, READ, ORDERED, KEYFRAMES, ROWS, WINDOWS, FORGOTTEN = 0, 1, 2, 3, 4, 5, 6  # counts
WHICH, KEYFRAME_OF, INTERVAL_OF, LINE_OF, WINDOW_OF, NUMBER_OF, OF = 0, 1, 2, 3, 4, 5, 6  # what a row is of

SHORTEST_S = 1e-3  # an interval
KNOT_WINDOW_S = 0.1  # either side of a knot, over which the rate is taken; the less noise is in its slope the better
PERIODS = 50  # of samples, whose median defines a gap
LONGEST_CRUISED_S = 10.0  # between measurements without an IMU; in a longer outage its turns are unknown
KNOCK = 3.0  # times the believed noise, before an interval's own scatter is taken
NOISIER = 1.25  # times the believed density, before what samples show as a rule is taken
INTERVALS, ENOUGH = 200, 20  # the newest intervals that show it, and how many are enough
CHANGED = 0.05  # part by which densities have to differ to be taken


class KeyframeRule(NamedTuple):
    """Where keyframes stand, and how an interval is integrated.

    Attributes
    ----------
    around : how far past a time samples have to be for it to be looked at [s]
    max_gap, longest, min_gap : between keyframes where no ping comes; while one may come still; least [s]
    segment_s : of time, in which calibration that walks has one value [s]
    every_s : time after which a place counts again [s]
    without_imu, learns, scaled : 1 = no IMU; noise is learnt; the IMU's scale may be wrong
    rate_sd : of the rate without an IMU [rad/s]
    context : numbers of a measurement's context, where a sensor has one
    """

    around: float
    max_gap: float
    longest: float
    min_gap: float
    segment_s: float
    every_s: float
    without_imu: float
    learns: float
    scaled: float
    rate_sd: float
    context: float


class Streams(NamedTuple):
    """Samples and events that have arrived.

    Attributes
    ----------
    imu : shape (m, 7), time, specific force, rate in body axes
    events : shape (e, VALUES + 2 D + context), in the order in which they came
    order : shape (e,), events in the order of where they are put
    sensors : shape (s, ABOUT)
    steps : shape (PERIODS + 1,), longest regular sample interval, by so many periods [s]
    """

    imu: Matrix
    events: Matrix
    order: Index
    sensors: IndexMatrix
    steps: Vector


class Integration(NamedTuple):
    """How motions are integrated, and windows of late stamps.

    Attributes
    ----------
    row : shape (ROW,), a motion's with bias, noise, gravity and rate of the Earth
    R_bs : shape (3, 3), mounting of the IMU
    lags : shape (l, K), time offsets that are reckoned with, ascending; nan behind the last [s]
    """

    row: Vector
    R_bs: Matrix
    lags: Matrix


class DiveArrays(NamedTuple):
    """A dive of n keyframes and m measurements, with room for more.

    Attributes
    ----------
    keyframes : shape (n, KEYFRAME)
    motions, covariances, weights : shapes (n, ROW), (n, 15, 15), (n, 15, 15), of the interval that ends with each
        keyframe but the first
    scales : shape (n, 6, 6), of it, too, or (0, 6, 6)
    rows, row_scales : shapes (m, Z + 2 D + context), (m, 6, 6) or (0, 6, 6)
    of : shape (OF, m), sensor, keyframe, interval, line, window or -1, number of a sighting or -1
    windows : shape (w, K, KNOT)
    names : shape (m,), of places
    counts : shape (7,), how much of each there is
    """

    keyframes: Matrix
    motions: Matrix
    covariances: Matrices
    weights: Matrices
    scales: Matrices
    rows: Matrix
    row_scales: Matrices
    of: IndexMatrix
    windows: Matrices
    names: Vector
    counts: Index


# where keyframes stand


@helper
def _longest_step(steps: Array, count: int) -> float:
    """Longest regular sample interval, after so many samples [s]."""
    return float(steps[min(max(count, 1), len(steps)) - 1])


@helper
def _read(streams: Streams, assumed: Array, before: float, counts: Index) -> None:
    """Put the events that have come before a time in the order of where they stand."""
    events, order, read, ordered = streams.events, streams.order, counts[READ], counts[ORDERED]
    while read < len(events) and events[read, STAMP] < before:
        sensor = int(events[read, SENSOR])
        if events[read, FATE] < REFUSED:
            placed = events[read, STAMP] - assumed[sensor]
            events[read, PLACED] = placed
            k = ordered
            while k > 0 and events[order[k - 1], PLACED] > placed:
                order[k] = order[k - 1]
                k -= 1
            order[k] = read
            ordered += 1
        read += 1
    counts[READ], counts[ORDERED] = read, ordered


@helper
def _stand(dive: DiveArrays, rule: KeyframeRule, time: float, upto: int, here: int) -> None:
    """Have a keyframe stand at a time, with the events up to ``upto``, ``here`` of which are at it."""
    n = dive.counts[KEYFRAMES]
    row = dive.keyframes[n]
    row[TIME], row[COUNT], row[UPTO], row[HERE] = time, dive.counts[FORGOTTEN] + dive.counts[SAMPLES], upto, here
    row[SEGMENT], row[BEGUN] = 0.0, time
    if n > 0:
        before = dive.keyframes[n - 1]
        if time - before[BEGUN] >= rule.segment_s:
            row[SEGMENT] = before[SEGMENT] + 1.0
        else:
            row[SEGMENT], row[BEGUN] = before[SEGMENT], before[BEGUN]
    dive.counts[KEYFRAMES] = n + 1


@helper
def _silence(streams: Streams, dive: DiveArrays, rule: KeyframeRule, time: float, longest: float, looked: int) -> None:
    """Keyframes for a time without pings, wherever it is longer than ``longest`` [s]."""
    while time - dive.keyframes[dive.counts[KEYFRAMES] - 1, TIME] > longest:
        last = dive.keyframes[dive.counts[KEYFRAMES] - 1]
        due, upto = last[TIME] + rule.max_gap, int(last[UPTO])
        while upto < looked and streams.events[streams.order[upto], PLACED] <= due:
            upto += 1
        _stand(dive, rule, due, upto, 0)


@helper
def _look(streams: Streams, dive: DiveArrays, rule: KeyframeRule, until: float) -> None:
    """Place what has waited for the IMU up to a time."""
    imu, events, order, counts = streams.imu, streams.events, streams.order, dive.counts
    start, looked = dive.keyframes[counts[KEYFRAMES] - 1, TIME], int(dive.keyframes[counts[KEYFRAMES] - 1, UPTO])
    after = first_after(imu, start)  # first sample that may come after a gap
    heard = events[order[looked - 1], PLACED] if looked > 0 else math.inf
    while True:
        time, arrived = math.inf, math.inf
        if looked < counts[ORDERED]:
            time, arrived = events[order[looked], PLACED], events[order[looked], STAMP]
        missing = False
        while rule.without_imu == 0.0 and after < counts[SAMPLES] and imu[after, 0] <= min(time, until):
            known = counts[FORGOTTEN] + after
            missing = after > 0 and imu[after, 0] - imu[after - 1, 0] > _longest_step(streams.steps, known)
            if missing:
                break
            after += 1
        if missing and (imu[after, 0] < time or imu[after, 0] <= arrived):
            gap_end = imu[after, 0]
            _silence(streams, dive, rule, gap_end, rule.longest, looked)
            start = dive.keyframes[counts[KEYFRAMES] - 1, TIME]
            if gap_end - start > SHORTEST_S:
                _stand(dive, rule, gap_end, looked, 0)
                start = gap_end
            after += 1
            continue
        if not time <= until:
            break
        _silence(streams, dive, rule, time, rule.longest, looked)
        start = dive.keyframes[counts[KEYFRAMES] - 1, TIME]
        if rule.without_imu != 0.0 and time - heard > LONGEST_CRUISED_S and time > start:
            _stand(dive, rule, time, looked, 0)  # a keyframe that what is measured at it can align
            looked += 1
        elif streams.sensors[int(events[order[looked], SENSOR]), CLOSES] != 0 and time - start >= rule.min_gap:
            here, looked = 1, looked + 1
            while looked < counts[ORDERED] and events[order[looked], PLACED] == time:
                if rule.without_imu == 0.0 and streams.sensors[int(events[order[looked], SENSOR]), CLOSES] == 0:
                    break  # the beams of one ping are at its keyframe
                here, looked = here + 1, looked + 1
            _stand(dive, rule, time, looked, here)
        else:
            looked += 1
        heard = time
    _silence(streams, dive, rule, until, rule.longest, looked)


@helper
def _finish(streams: Streams, dive: DiveArrays, rule: KeyframeRule) -> None:
    """Place the rest, and a last keyframe at the last sample; one that stands there has what is measured with it."""
    events, order, counts = streams.events, streams.order, dive.counts
    end = streams.imu[counts[SAMPLES] - 1, 0]
    _look(streams, dive, rule, end)
    within = counts[ORDERED]
    while within > 0 and events[order[within - 1], PLACED] > end:
        within -= 1
        events[order[within], FATE] = LATE
    _silence(streams, dive, rule, end, rule.max_gap, within)
    last = dive.keyframes[counts[KEYFRAMES] - 1]
    if end - last[TIME] >= SHORTEST_S:
        _stand(dive, rule, end, within, 0)
    else:
        for k in range(int(last[UPTO]), within):
            if streams.sensors[int(events[order[k], SENSOR]), ONCE] != 0:  # of an interval that there is not
                events[order[k], FATE] = UNFINISHED
        last[HERE] += within - last[UPTO]
        last[UPTO] = within


@helper
def _next_due(streams: Streams, assumed: Array, rule: KeyframeRule, dive: DiveArrays) -> float:
    """From when on a keyframe may be past, by the events that have come [s]."""
    counts, events = dive.counts, streams.events
    if counts[KEYFRAMES] == 0:
        return -math.inf
    last = dive.keyframes[counts[KEYFRAMES] - 1]
    soon = last[TIME] + rule.longest
    for k in range(int(last[UPTO]), counts[ORDERED] + len(events) - counts[READ]):
        event = events[streams.order[k] if k < counts[ORDERED] else counts[READ] + k - counts[ORDERED]]
        sensor = int(event[SENSOR])
        if event[FATE] < REFUSED and streams.sensors[sensor, CLOSES] != 0:
            placed = event[STAMP] - assumed[sensor]
            if rule.min_gap <= placed - last[TIME] < soon - last[TIME]:
                soon = placed
    return float(soon)


@kernel()
def place_keyframes(
    streams: Streams, assumed: Vector, rule: KeyframeRule, dive: DiveArrays, until: int, one: bool, finish: bool
) -> float:
    """Where keyframes stand, as samples come one after the other.

    Parameters
    ----------
    assumed : shape (s,), how late the stamps of each sensor are [s]
    until : count of samples that may be looked at
    one : stop at the sample by which a keyframe is past
    finish : there are no more, so that what is left is placed

    Returns
    -------
    From when on another keyframe may be past, by the events that have come [s]
    """
    imu, counts = streams.imu, dive.counts
    while counts[SAMPLES] < until:
        time = imu[counts[SAMPLES], 0]
        _read(streams, assumed, time, counts)
        counts[SAMPLES] += 1
        if counts[KEYFRAMES] == 0:
            early = 0
            while early < counts[ORDERED] and streams.events[streams.order[early], PLACED] < time:
                streams.events[streams.order[early], FATE] = EARLY
                early += 1
            _stand(dive, rule, time, early, 0)
            _look(streams, dive, rule, time - rule.around)
            if one:
                break
        else:
            before = counts[KEYFRAMES]
            _look(streams, dive, rule, time - rule.around)
            if one and counts[KEYFRAMES] > before:
                break
    if finish and counts[KEYFRAMES] > 0:
        _read(streams, assumed, math.inf, counts)
        _finish(streams, dive, rule)
    return _next_due(streams, assumed, rule, dive)


# what lies between them


@helper
def _first_covering(imu: Array, time: float, span: float) -> int:
    """The first of those samples that cover a time and what is up to ``span`` before it."""
    return max(first_after(imu, time - span) - 1, 0)


@helper
def _noise_of_rate(step: float, share: float, longest_step: float, gyr: float) -> float:
    """Noise of a fitted rate, by the results of `fit_rate` [rad/s]."""
    if step > longest_step:
        return BRIDGE_GYR
    return gyr * math.sqrt(share / (step if step > 0.0 else 1.0))


@helper
def _learn(keyframes: Array, k: int, acc: float, gyr: float) -> None:
    """Take the noise that the newest intervals show as a rule, where it is more than is believed; blind to knocks."""
    seen, count = np.empty((INTERVALS, 2)), 0
    j = k
    while j > 0 and count < INTERVALS:
        if not math.isnan(keyframes[j, SCATTER]):
            seen[count, 0], seen[count, 1] = keyframes[j, SCATTER], keyframes[j, SCATTER + 1]
            count += 1
        j -= 1
    noise = (acc, gyr)
    if count >= ENOUGH:
        middle = np.sort(seen[:count, 0])[count // 2], np.sort(seen[:count, 1])[count // 2]
        noise = (middle[0] if middle[0] > NOISIER * acc else acc, middle[1] if middle[1] > NOISIER * gyr else gyr)
    believed = keyframes[k, BELIEVED : BELIEVED + 2]
    if max(abs(noise[0] / believed[0] - 1.0), abs(noise[1] / believed[1] - 1.0)) > CHANGED:
        believed[0], believed[1] = noise


@helper
def _scale_to_bias(imu: Array, begin: float, end: float, row: Array, R_bs: Array, S_out: Array) -> None:
    """The IMU's mean signal over a time as its scale errors make a bias of it, shape (6, 6)."""
    signal = np.empty(6)
    mean_signal(imu, begin, end, signal)
    for half in range(2):
        for j in range(3):
            along = 0.0  # the IMU's axis j
            for i in range(3):
                along += (signal[3 * half + i] - row[motion_row.BIAS + 3 * half + i]) * R_bs[i, j]
            for i in range(3):
                S_out[3 * half + i, 3 * half + j] = R_bs[i, j] * along
                S_out[3 * half + i, 3 * (1 - half) + j] = 0.0


@helper
def _window(
    imu: Array, stamp: float, lag: Array, start: float, longest_step: float, row: Array, window_out: Array
) -> bool:
    """The motion from a keyframe to knots around a stamp; False = samples are missing.

    The rate is taken from its means over a window and over half of it, extrapolated to none: what curves cancels,
    noise averages.
    """
    count = 0
    for k in range(len(lag)):
        window_out[k, KNOT_LAG] = lag[k]
        count += not math.isnan(lag[k])
    begin, end = min(start, stamp - lag[count - 1]), max(start, stamp - lag[0])
    if not (imu[0, 0] <= begin and begin < end and end <= imu[len(imu) - 1, 0]):
        return False
    for k in range(first_after(imu, begin), min(first_not_before(imu, end) + 1, len(imu))):
        if imu[k, 0] - imu[k - 1, 0] > longest_step:
            return False
    stops = np.empty(count + 1)
    for k in range(count):
        stops[k] = stamp - lag[k]
    stops[count] = start
    stops, motion, snapshots = np.sort(stops), row.copy(), np.empty((count + 1, NUMBERS))
    integrate(imu, begin, end, stops, motion, np.empty((MOTION, MOTION)), snapshots)
    at_start = snapshots[first_not_before_in(stops, start)]
    angle = np.zeros((len(imu), 3))
    for k in range(1, len(imu)):
        for i in range(3):
            angle[k, i] = angle[k - 1, i] + 0.5 * (imu[k, 0] - imu[k - 1, 0]) * (imu[k, 4 + i] + imu[k - 1, 4 + i])
    wide, narrow = np.empty(3), np.empty(3)
    for k in range(count):
        knot, out = snapshots[first_not_before_in(stops, stamp - lag[k])], window_out[k]
        dt = knot[0] - at_start[0]
        out[0] = dt
        for i in range(3):
            out[10 + i] = out[13 + i] = 0.0
            for j in range(3):
                out[1 + 3 * i + j] = 0.0
                for m in range(3):  # into the keyframe's axes
                    out[1 + 3 * i + j] += at_start[1 + 3 * m + i] * knot[1 + 3 * m + j]
                out[10 + i] += at_start[1 + 3 * j + i] * (knot[10 + j] - at_start[10 + j])
                out[13 + i] += at_start[1 + 3 * j + i] * (knot[13 + j] - at_start[13 + j] - dt * at_start[10 + j])
        _mean_rate(imu, angle, stamp - lag[k], KNOT_WINDOW_S, wide)
        _mean_rate(imu, angle, stamp - lag[k], 0.5 * KNOT_WINDOW_S, narrow)
        for i in range(3):
            out[KNOT_RATE + i] = (4.0 * narrow[i] - wide[i]) / 3.0
    return True


@helper
def first_not_before_in(stops: Array, time: float) -> int:
    """Place of the first of some times at or after a time."""
    k = 0
    while stops[k] < time:
        k += 1
    return k


@helper
def _angle_at(imu: Array, angle: Array, time: float, angle_out: Array) -> None:
    """Integral of the rate, linear between the samples, shape (3,)."""
    after = min(max(first_not_before(imu, time), 1), len(imu) - 1)
    share = (time - imu[after - 1, 0]) / (imu[after, 0] - imu[after - 1, 0])
    for i in range(3):
        angle_out[i] = angle[after - 1, i] + share * (angle[after, i] - angle[after - 1, i])


@helper
def _mean_rate(imu: Array, angle: Array, time: float, half: float, mean_out: Array) -> None:
    """Mean rate over a window around a time, as far as there are samples."""
    first, last = imu[0, 0], imu[len(imu) - 1, 0]
    begin, end = min(max(time - half, first), last), min(max(time + half, first), last)
    from_, to = np.empty(3), np.empty(3)
    _angle_at(imu, angle, begin, from_)
    _angle_at(imu, angle, end, to)
    for i in range(3):
        mean_out[i] = (to[i] - from_[i]) / (end - begin)


@helper
def _in_view(dive: DiveArrays, rule: KeyframeRule, row: int, name: float, time: float) -> bool:
    """Whether a place has counted just now; rows before ``row`` are looked at."""
    j = row - 1
    while j >= 0 and dive.rows[j, AT] > time - rule.every_s - rule.longest:
        if dive.of[NUMBER_OF, j] >= 0 and dive.names[j] == name and time - dive.rows[j, AT] < rule.every_s:
            return True
        j -= 1
    return False


@helper
def _motion(
    streams: Streams, rule: KeyframeRule, integration: Integration, dive: DiveArrays, k: int, longest_step: float
) -> None:
    """What is believed of the interval that ends with keyframe k, to integrate it."""
    keyframe, row = dive.keyframes[k], dive.motions[k]
    imu = streams.imu[int(keyframe[FIRST]) : int(keyframe[LAST])]
    longest, within, acc, gyr = survey(imu, dive.keyframes[k - 1, TIME], keyframe[TIME])
    for i in range(motion_row.ROW):
        row[i] = integration.row[i]
    for i in range(BELIEVED, BELIEVED + 2):
        keyframe[i] = dive.keyframes[k - 1, i]
    keyframe[SCATTER] = keyframe[SCATTER + 1] = math.nan
    noise = row[motion_row.NOISE : motion_row.NOISE + 2]
    if rule.without_imu != 0.0:  # constant velocity; in a long outage the heading is unknown
        row[motion_row.GAP] = motion_row.NO_IMU
        if within > LONGEST_CRUISED_S:
            noise[0], noise[1], row[motion_row.GAP] = BRIDGE_ACC, BRIDGE_GYR, within
        return
    if within > longest_step:
        noise[0], noise[1], row[motion_row.GAP] = BRIDGE_ACC, BRIDGE_GYR, within
        return
    row[motion_row.GAP] = 0.0
    believed = keyframe[BELIEVED : BELIEVED + 2]
    if len(imu) >= 3 and longest <= longest_step:
        if rule.learns != 0.0:
            typical_scatter(imu, keyframe[SCATTER : SCATTER + 2])
            _learn(dive.keyframes, k, integration.row[motion_row.NOISE], integration.row[motion_row.NOISE + 1])
        noise[0], noise[1] = believed[0], believed[1]
        if acc >= KNOCK * believed[0] or gyr >= KNOCK * believed[1]:
            noise[0], noise[1] = max(acc, believed[0]), max(gyr, believed[1])
    else:
        noise[0], noise[1] = believed[0], believed[1]


@helper
def _between(
    streams: Streams, rule: KeyframeRule, dive: DiveArrays, k: int, pieces: Array, chosen: Index, out: Array
) -> int:
    """What is measured between keyframe k and the one before, in the order of time; how many.

    ``chosen`` are places in the events, or of pieces, less than zero; ``out`` are their times.
    """
    seen, count, piece = np.zeros(len(streams.sensors), np.bool_), 0, 0
    while piece < len(pieces) and pieces[piece, NAME] < k:
        piece += 1
    end = int(dive.keyframes[k, UPTO]) - int(dive.keyframes[k, HERE])
    for j in range(int(dive.keyframes[k - 1, UPTO]), end):
        event = streams.order[j]
        sensor = int(streams.events[event, SENSOR])
        if seen[sensor]:
            continue
        seen[sensor] = streams.sensors[sensor, ONCE] != 0
        while (
            piece < len(pieces) and pieces[piece, NAME] == k and pieces[piece, PLACED] < streams.events[event, PLACED]
        ):
            chosen[count], out[count] = -1 - piece, pieces[piece, PLACED]
            piece, count = piece + 1, count + 1
        chosen[count], out[count] = event, streams.events[event, PLACED]
        count += 1
    while piece < len(pieces) and pieces[piece, NAME] == k:
        chosen[count], out[count] = -1 - piece, pieces[piece, PLACED]
        piece, count = piece + 1, count + 1
    return count


@helper
def _take(
    streams: Streams,
    rule: KeyframeRule,
    integration: Integration,
    dive: DiveArrays,
    k: int,
    here: bool,
    event: Array,
    snapshot: Array,
) -> float:
    """Give a measurement its row; its fate.

    ``here`` = it is at keyframe k, and not between it and the one before.
    """
    imu, counts, sensor = streams.imu, dive.counts, streams.sensors[int(event[SENSOR])]
    keyframe, m, dim = dive.keyframes[k], counts[ROWS], int(sensor[DIM])
    start = keyframe[TIME] if here else dive.keyframes[k - 1, TIME]
    before = keyframe[TIME] if k == 0 else dive.keyframes[k - 1, TIME]
    every = imu[_first_covering(imu, before, rule.around) : int(keyframe[COUNT]) - counts[FORGOTTEN]]
    window, number, longest_step = -1, -1, _longest_step(streams.steps, int(keyframe[COUNT]))
    if sensor[LAG] >= 0:
        window = counts[WINDOWS]
        lag = integration.lags[sensor[LAG]]
        if not _window(every, event[STAMP], lag, start, longest_step, integration.row, dive.windows[window]):
            return BEYOND
    if sensor[SIGHTS] != 0:
        if _in_view(dive, rule, m, event[NAME], event[PLACED]):
            return IN_VIEW
        number = int(keyframe[SIGHTED]) + 1
        keyframe[SIGHTED] = number
    context = int(rule.context)
    row, most = dive.rows[m], (len(event) - VALUES - context) // 2
    for i in range(len(row)):
        row[i] = 0.0
    row[AT] = event[PLACED]
    for i in range(NUMBERS):
        row[SNAPSHOT + i] = snapshot[i]
    for i in range(6):
        row[ASSUMED + i] = integration.row[motion_row.BIAS + i]
    for i in range(dim):
        if sensor[SIGHTS] == 0:
            row[Z + i] = event[VALUES + i]
    for i in range(max(dim, MOST)):
        row[Z + max(dim, MOST) + i] = event[VALUES + most + i]
    for i in range(context):
        row[Z + 2 * most + i] = event[VALUES + 2 * most + i]
    if here:
        for i in range(3):
            row[RATE + i] = keyframe[RATE_B + i]
        row[RATE_SD] = keyframe[SPREAD]
    elif sensor[TURNED] != 0:
        if rule.without_imu != 0.0:
            row[RATE_SD] = rule.rate_sd
        else:
            samples = imu[int(keyframe[FIRST]) : int(keyframe[LAST])]
            step, share = fit_rate(samples, event[PLACED], row[RATE : RATE + 3])
            row[RATE_SD] = _noise_of_rate(step, share, longest_step, keyframe[BELIEVED + 1])
    if rule.scaled != 0.0:
        _scale_to_bias(every, start, event[PLACED], integration.row, integration.R_bs, dive.row_scales[m])
    dive.of[WHICH, m], dive.of[KEYFRAME_OF, m], dive.of[INTERVAL_OF, m] = int(event[SENSOR]), k - (not here), k
    dive.of[LINE_OF, m], dive.of[WINDOW_OF, m], dive.of[NUMBER_OF, m] = int(event[LINE]), window, number
    dive.names[m] = event[NAME]
    counts[ROWS], counts[WINDOWS] = m + 1, counts[WINDOWS] + (window >= 0)
    return IN


@kernel()
def assemble(
    streams: Streams, pieces: Matrix, rule: KeyframeRule, integration: Integration, dive: DiveArrays, begin: int
) -> None:
    """Motions, measurements and their windows, of the keyframes that stand from ``begin`` on.

    Parameters
    ----------
    pieces : shape (p, VALUES + 2 D), events that thrusters make between keyframes, in the order of time; their `NAME`
        is the keyframe that ends the interval
    """
    imu, counts = streams.imu, dive.counts
    still = np.zeros(NUMBERS)
    still[1] = still[5] = still[9] = 1.0
    for k in range(begin, counts[KEYFRAMES]):
        keyframe = dive.keyframes[k]
        count, time = int(keyframe[COUNT]) - counts[FORGOTTEN], keyframe[TIME]
        before = time if k == 0 else dive.keyframes[k - 1, TIME]
        longest_step = _longest_step(streams.steps, int(keyframe[COUNT]))
        first, last = (
            _first_covering(imu, before, HALF_WINDOW_S),
            min(first_not_before(imu, time + rule.around) + 1, count),
        )
        keyframe[FIRST], keyframe[LAST] = first, last
        if k == 0:
            for i in range(2):
                keyframe[BELIEVED + i] = integration.row[motion_row.NOISE + i]
            keyframe[SCATTER] = keyframe[SCATTER + 1] = math.nan
        keyframe[SIGHTED] = 0.0 if k == 0 else dive.keyframes[k - 1, SIGHTED]
        if k > 0:
            _motion(streams, rule, integration, dive, k, longest_step)
            room = int(keyframe[UPTO]) - int(dive.keyframes[k - 1, UPTO]) + len(pieces)
            chosen, stops = np.empty(room, np.int64), np.empty(room)
            found = _between(streams, rule, dive, k, pieces, chosen, stops)
            snapshots = np.empty((found, NUMBERS))
            motion, covariance = dive.motions[k], dive.covariances[k]
            integrate(imu[first:last], before, time, stops[:found], motion, covariance, snapshots)
            motion_weight(motion, covariance, dive.weights[k])
            if rule.scaled != 0.0:
                _scale_to_bias(imu[first:last], before, time, integration.row, integration.R_bs, dive.scales[k])
            for j in range(found):
                piece = chosen[j] < 0
                event = pieces[-1 - chosen[j]] if piece else streams.events[chosen[j]]
                event[FATE] = _take(streams, rule, integration, dive, k, False, event, snapshots[j])
        if rule.without_imu != 0.0:
            keyframe[RATE_B : RATE_B + 3], keyframe[SPREAD] = 0.0, rule.rate_sd
        else:
            step, share = fit_rate(imu[first:last], time, keyframe[RATE_B : RATE_B + 3])
            keyframe[SPREAD] = _noise_of_rate(step, share, longest_step, keyframe[BELIEVED + 1])
        for j in range(int(keyframe[UPTO]) - int(keyframe[HERE]), int(keyframe[UPTO])):
            event = streams.events[streams.order[j]]
            if event[FATE] != UNFINISHED:
                event[FATE] = _take(streams, rule, integration, dive, k, True, event, still)
        keyframe[TAKEN] = counts[ROWS]
        keyframe[FIRST], keyframe[LAST] = first + counts[FORGOTTEN], last + counts[FORGOTTEN]
