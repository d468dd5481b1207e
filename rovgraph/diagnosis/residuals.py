"""Alarms on residuals: rejected, too large, too small, correlated; and sensors that froze or contradict each other.

Residuals of a smoother vary less than the noise, since each measurement has pulled the estimate towards itself:
their covariance is I - H P H' in units of the noise. So the limits upwards are those of independent noise. Downwards
only the filter's normalised innovations squared (NIS) can tell, whose expectation is the measurement's dimension.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.alarm import Alarm, Statistic
from rovgraph.diagnosis.evidence import MINUTE, Evidence, SensorResiduals, span, windows
from rovgraph.distributions import binomial_tail, chi_square_quantile
from rovgraph.geometry import Array
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.log import Stream
from rovgraph.model.calibration import BEAM_SENSORS, WATER_LAYER
from rovgraph.model.config import Config
from rovgraph.problem.layers import SIDE_LOBES, nearer_knots
from rovgraph.problem.motion import has_constant_velocity
from rovgraph.rules import CHANCE, RULES, USUAL_SHARE, Severity
from rovgraph.sensors.instruments import HEADING_STREAMS

ENOUGH = 20  # measurements
GIVEN_UP = 0.25  # share of a sensor's in the dive, where it has too few in a minute
IN_A_ROW, SCATTERED = 3, 0.25  # from which on rejections follow each other; up to which share others count for nothing
IN_A_MINUTE = 1.5  # times as much
OUTSIDE = "IMU sample"  # before the first or after the last: a ship records her fixes for longer than a dive
REPORTED = ("no bottom lock", "no heading", "no tilt", "frozen", SIDE_LOBES)  # reasons that are normal, or have a rule
LASTING_S = (5.0, 20.0)  # over which errors last, unlike noise
OF_ONE = 8.0  # a single mean may be that much more
SD_KEY = {
    "dvl": "dvl.velocity_sd_mps",
    **dict.fromkeys(BEAM_SENSORS, "dvl.beam_sd_mps"),
    "dvl_water": "dvl.water_velocity_sd_mps",
    "mag": "heading.mag_sd_deg",
    "dvl_heading": "heading.dvl_sd_deg",
    "ahrs": "heading.ahrs_sd_deg",
    "depth": "depth.sd_m",
    "fix": "fix.sd_m",
    "place": "place.sd_m",
    "usbl": "usbl.angle_sd_deg",
    "range": "range.sd_m",
    "thruster": "vehicle.acceleration_sd_mps2",
    WATER_LAYER: "water.cell_sd_mps",
}

_CHANGING_FIELD = (
    "; where the Earth's field changes along the way, state calibration.field_dip.walk_deg: 0.05 "
    "and calibration.field_scale.walk: 0.001"
)


def sd_key(sensor: str) -> str:
    """The configuration's key of a sensor's noise."""
    return SD_KEY.get(sensor, f"the noise of {sensor}")


def by_far_knots(one: Statistic, config: Config, streams: Mapping[str, Stream]) -> Statistic:
    """A figure of the layers of the water with what mends it first where their knots are too far apart."""
    nearer = nearer_knots(config, streams) if one.sensor == WATER_LAYER else None
    return one if nearer is None else replace(one, remedy=f"state water.knot_m: {nearer:g}")


def rejected(evidence: Evidence) -> Iterator[Statistic]:
    """The largest share of a sensor's measurements that was left out in a minute."""
    for r in evidence.residuals.values():
        window = windows(r.time, evidence.start, MINUTE)
        out = r.weight <= 0.0
        count, scattering = np.bincount(window), scatters(r.sensor, evidence.initial.config)
        share = share_rejected(rejections(out, window, scattering), count)
        if count.max(initial=0) < ENOUGH and _gives_up(out):
            share[:] = out.mean()
        worst = int(np.argmax(share))
        bad = np.flatnonzero(share > RULES["rejected"].doubtful)
        begin, end = (bad[0], bad[-1]) if len(bad) else (worst, worst)
        begin_s, end_s = evidence.start + begin * MINUTE, min(evidence.start + (end + 1) * MINUTE, evidence.end)
        inside = {n: o.weight[(o.time >= begin_s) & (o.time <= end_s)] for n, o in evidence.residuals.items()}
        alone = is_one_beam(r.sensor, {n: float(np.mean(w <= 0.0)) for n, w in inside.items() if len(w)})
        yield rejected_in(r.sensor, begin_s, end_s, float(share[worst]), evidence.start, alone)


def is_one_beam(sensor: str, rejected: Mapping[str, float]) -> bool:
    """Whether a sensor is a beam of a DVL two or more of whose others agree with the estimate.

    Parameters
    ----------
    rejected : sensor -> share of its measurements that were rejected at the time
    """
    others = [share for name, share in rejected.items() if name in BEAM_SENSORS and name != sensor]
    return sensor in BEAM_SENSORS and sum(share < RULES["rejected"].doubtful for share in others) > 1


def _gives_up(out: NDArray[np.bool_]) -> bool:
    """Whether a sensor of few measurements, as fixes now and then, was rejected too often in the dive, shape (n,)."""
    by_chance = binomial_tail(max(int(out.sum()) - 1, 0), len(out), USUAL_SHARE) > CHANCE
    return bool(out.mean() > GIVEN_UP) and not by_chance


def scatters(sensor: str, config: Config) -> bool:
    """Whether single outliers are usual: reflections and slipping phases put replies of a transponder anywhere.

    Several beacons that answer in turn, of which one may be wrong, are another matter.
    """
    return sensor == "usbl" and config.usbl.head == "ship"


def rejections(out: NDArray[np.bool_], window: Array, scattering: bool) -> Array:
    """Rejections in each of m windows that are evidence of an error, shape (m,).

    Of a sensor that scatters they are those that follow each other, as those of a wrong mounting or clock or of a
    cluster do; where much is rejected all are, since then nothing says which replies are right.

    Parameters
    ----------
    out, window : ndarray, shape (n,), in the order of time: what was rejected, and the window of each measurement
    scattering : `scatters`
    """
    every = np.bincount(window, out)
    if not scattering:
        return np.asarray(every, float)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], out, [False]])))
    lasting = np.zeros(len(out))
    for begin, end in ends.reshape(-1, 2):
        lasting[begin:end] = end - begin >= IN_A_ROW
    return np.where(every > SCATTERED * np.bincount(window), every, np.bincount(window, lasting))


def share_rejected(out: NDArray[Any], count: NDArray[Any]) -> Array:
    """Share of rejected measurements in each of m windows, 0 where they are too few, shape (m,).

    Parameters
    ----------
    out, count : ndarray, shape (m,), those that were rejected, and all
    """
    by_chance = [
        binomial_tail(max(int(k) - 1, 0), max(int(n), 1), USUAL_SHARE) > CHANCE for k, n in zip(out, count, strict=True)
    ]
    return np.where((count < ENOUGH) | by_chance, 0.0, out / np.maximum(count, 1))


def rejected_in(sensor: str, begin: float, end: float, share: float, start: float, one_beam: bool = False) -> Statistic:
    """A share of rejected measurements in a minute; ``start`` is when the dive began [s].

    ``one_beam`` : the sensor is one beam of a DVL, and its others agree.
    """
    if one_beam:
        return Statistic(
            "one beam",
            sensor,
            begin,
            end,
            share,
            f"up to {share:.0%} of this beam's measurements contradict the DVL's other beams and were rejected, "
            f"{span(begin, end, start)}",
            "the other beams carry the track; look for fouling or a damaged transducer",
        )
    return Statistic(
        "rejected",
        sensor,
        begin,
        end,
        share,
        f"up to {share:.0%} of its measurements contradict the others and were rejected, {span(begin, end, start)}",
        f"if the instrument failed, remove that time from the log; if it lasts, check its mounting, signs "
        f"and clock (rovgraph check), and {sd_key(sensor)}{_CHANGING_FIELD if sensor == 'mag' else ''}",
    )


def too_large(evidence: Evidence) -> Iterator[Statistic]:
    """Mean square of a sensor's weighted residuals, in the whole dive and in its worst minute."""
    if evidence.main.kind == "filtered":  # its innovations hold its own error, too
        return
    for r in evidence.residuals.values():
        used = r.weight > 0.0
        square = r.weight[used] * np.mean(r.normalised[used] ** 2, axis=1)  # as far as it counts
        if len(square) < ENOUGH:
            continue
        window = windows(r.time[used], evidence.start, MINUTE)
        count = np.bincount(window)
        means = np.where(count >= ENOUGH, np.bincount(window, square) / np.maximum(count, 1), 0.0)
        worst = int(np.argmax(means))
        begin = evidence.start + worst * MINUTE
        end, dim = min(begin + MINUTE, evidence.end), r.normalised.shape[1]
        start = evidence.start
        yield too_large_in(r.sensor, start, evidence.end, float(square.mean()), len(square) * dim, start)
        worst_mean, numbers = float(means[worst]), int(count[worst]) * dim
        yield too_large_in(r.sensor, begin, end, worst_mean, numbers, start, IN_A_MINUTE)


def too_large_in(
    sensor: str, begin: float, end: float, square: float, count: int, start: float, factor: float = 1.0
) -> Statistic:
    """A mean square of ``count`` numbers against its limits, and the quantile of as many independent ones.

    ``start`` is when the dive began [s]; ``factor`` raises the limits.
    """
    by_chance = chi_square_quantile(max(count, 1), CHANCE) / max(count, 1)
    return Statistic(
        "too large",
        sensor,
        begin,
        end,
        square,
        f"its residuals are {np.sqrt(square):.1f} times as large as its stated noise, {span(begin, end, start)}",
        f"find what disturbs it there, or raise {sd_key(sensor)}",
        factor,
        by_chance,
    )


def too_small(evidence: Evidence) -> Iterator[Statistic]:
    """Mean of the filter's normalised innovations squared, per dimension, that is far below 1."""
    filtered = evidence.estimate("filtered")
    if has_constant_velocity(evidence.initial.config):  # innovations are the motion's rather than the sensors'
        return
    for sensor, nis in ({} if filtered is None else filtered.summary.get("nis", {})).items():
        if nis["mean"] is None or nis["count"] < ENOUGH:
            continue
        yield too_small_in(sensor, evidence.start, evidence.end, nis["mean"] / nis["dim"])


def too_small_in(sensor: str, begin: float, end: float, mean: float) -> Statistic:
    """A mean of normalised innovations squared, per dimension."""
    return Statistic(
        "too small",
        sensor,
        begin,
        end,
        1.0 / max(mean, 1e-9),
        f"its innovations are {np.sqrt(mean):.2f} times as large as their stated sd, so the stated noise is too large",
        f"lower {sd_key(sensor)}",
    )


def innovations(evidence: Evidence) -> Iterator[Statistic]:
    """Mean of the filter's normalised innovations squared, per dimension, that is far above 1.

    A smoother follows what is wrong for long; the filter meets it first.
    """
    filtered = evidence.estimate("filtered")
    for sensor, nis in ({} if filtered is None else filtered.summary.get("nis", {})).items():
        if nis["mean"] is None or nis["count"] < ENOUGH:
            continue
        count = nis["count"] * nis["dim"]
        mean = nis["mean"] / nis["dim"]
        yield Statistic(
            "innovations",
            sensor,
            evidence.start,
            evidence.end,
            mean,
            f"it surprises the filter: its innovations are {np.sqrt(mean):.1f} times as large as their stated sd",
            f"check the instrument, its mounting and clock (rovgraph check), or raise {sd_key(sensor)}",
            chance=chi_square_quantile(count, CHANCE) / count,
        )


def filter_alone(evidence: Evidence) -> Iterator[Statistic]:
    """Share of a sensor's measurements, after the first seconds, that the filter rejected and the smoother took."""
    if evidence.main.kind != "smoothed":
        return
    for sensor, met in evidence.innovations.items():
        smoothed = evidence.residuals.get(sensor)
        if smoothed is None or len(smoothed.time) != len(met.time) or len(met.time) < ENOUGH:
            continue
        late = met.time > evidence.start + RULES["filter alone"].from_s
        apart = (met.weight <= 0.0) & (smoothed.weight > 0.0) & late
        share = float(share_rejected(np.array([apart.sum()]), np.array([late.sum()]))[0])
        first, last = (float(t) for t in (met.time[apart][[0, -1]] if apart.any() else (evidence.start, evidence.end)))
        yield Statistic(
            "filter alone",
            sensor,
            first,
            last,
            share,
            f"{apart.sum()} of its measurements contradict what was known before and not what came after, "
            f"{evidence.span(first, last)}: the smoothed track may have followed them",
            "check the instrument at that time, and compare the filtered track",
        )


def left_out(evidence: Evidence) -> Iterator[Statistic]:
    """Share of a sensor's measurements that were refused one by one before the estimate."""
    for (sensor, why), count in evidence.left_out.items():
        if sensor not in evidence.log or why.startswith(REPORTED) or (sensor == "fix" and why.endswith(OUTSIDE)):
            continue
        share = count / max(len(evidence.log[sensor]), 1)
        yield Statistic(
            "left out",
            sensor,
            evidence.start,
            evidence.end,
            share,
            f"{share:.0%} of its measurements were left out: {why}",
            _remedy_of_left_out(why),
        )


def _remedy_of_left_out(why: str) -> str:
    if why.endswith("of the ship"):
        return "record the ship all the time, or raise ship.max_gap_s"
    if "transponder" in why:
        return "name the vehicle's, usbl: {beacon: ...}, as usbl_beacon has it"
    return "check its unit and that limit" if "." in why else "check the instrument and its driver"


def correlated_residuals(evidence: Evidence) -> Iterator[Statistic]:
    """Residuals that keep their sign for seconds: the variance of means over a time, which is 1 for white noise."""
    if evidence.main.kind == "filtered":  # its innovations wander while it settles
        return
    for r in evidence.residuals.values():
        for one in correlated_residuals_in(r, evidence.start, evidence.end):
            yield from (
                correlated_residuals_in(_allowing(r, evidence), evidence.start, evidence.end)
                if one.severity
                else (one,)
            )


def _allowing(r: SensorResiduals, evidence: Evidence) -> SensorResiduals:
    """Residuals that allow for what is considered: each of its components moves all of a window alike."""
    best = evidence.optimum
    if not isinstance(best, ChainOptimum) or r.sensor not in best.blocks:
        return r
    block, shared = best.blocks[r.sensor], np.zeros_like(r.normalised)
    normalised = block.normalised(best.state.at(block.keyframe))
    for moved in best.moved_by_considered():
        shared += (block.normalised(moved.at(block.keyframe)) - normalised) ** 2
    return replace(r, shared=shared[np.argsort(block.time, kind="stable")])


def correlated_residuals_in(
    r: SensorResiduals, start: float, end: float, began: float | None = None
) -> Iterator[Statistic]:
    """How long a sensor's residuals from ``start`` to ``end`` last; ``began`` is when the dive did [s]."""
    worst = _most_lasting(r, start)
    if worst is None:
        return
    seconds, component, ratio, by_chance, begin = worst
    yield Statistic(
        "lasting",
        r.sensor,
        begin,
        min(begin + seconds, end),
        ratio,
        f"residuals of {r.components[component]} do not average out: means over {seconds:g} s vary {ratio:.0f} "
        f"times as much as noise, most at {begin - (start if began is None else began):.0f} s",
        _remedy_of_lasting(r.sensor),
        chance=by_chance,
    )


def _most_lasting(r: SensorResiduals, start: float) -> tuple[float, int, float, float, float] | None:
    """Window [s], component, variance ratio, its quantile for noise and where it is largest [s], of the worst one."""
    out: list[tuple[float, int, float, float, float]] = []
    used = r.weight > 0.0
    for seconds in LASTING_S:
        window = windows(r.time[used], start, seconds)
        count = np.bincount(window) if len(window) else np.zeros(1)
        usual = np.median(count[count > 0]) if count.any() else 0.0
        full = count >= max(3.0, 0.3 * usual)
        for component in range(r.normalised.shape[1]) if full.any() else ():
            sums = np.bincount(window, r.normalised[used, component])
            square = (sums**2 / np.maximum(count, 1) / _allowed(r, used, window, component))[full]
            k = int(np.argmax(square))
            begin = start + float(np.flatnonzero(full)[k]) * seconds
            # all windows together, and the largest of them
            n = len(square)
            out.append((seconds, component, float(square.mean()), chi_square_quantile(n, CHANCE) / n, begin))
            out.append(
                (seconds, component, float(square[k]) / OF_ONE, chi_square_quantile(1, CHANCE / n) / OF_ONE, begin)
            )
    return max(out, key=lambda one: one[2] / max(RULES["lasting"].doubtful, one[3]), default=None)


def _allowed(r: SensorResiduals, used: NDArray[np.bool_], window: Array, component: int) -> Array:
    """Variance of the means of windows, times their counts, if what is shared within one is constant in it."""
    shared = np.zeros(len(window)) if r.shared is None else r.shared[used, component]
    return np.asarray(1.0 + np.bincount(window, shared))


def _remedy_of_lasting(sensor: str) -> str:
    """What lets a sensor's errors last, and what to do."""
    if sensor in HEADING_STREAMS:
        return (
            "look for iron near the vehicle or calibrate again (rovgraph calibrate magnetometer), "
            f"or raise {sd_key(sensor)}{_CHANGING_FIELD if sensor == 'mag' else ''}"
        )
    if sensor == "fix":
        return (
            "the fixes are all off there: check fix.lever_arm_m and its clock (rovgraph check), remove them from the "
            "log, raise fix.sd_m, or, if their errors are correlated, estimate calibration.fix_error"
        )
    if sensor == "depth":
        return "the depth contradicts the DVL's vertical velocity: check depth, dvl.mount_rpy_deg and imu.mount_rpy_deg"
    if sensor.startswith("dvl"):
        return f"check dvl.mount_rpy_deg, dvl.lever_arm_m and its clock (rovgraph check), or raise {sd_key(sensor)}"
    return f"look for what disturbs it, or raise {sd_key(sensor)}"


MEASURE_THE_SAME = (
    ("heading", HEADING_STREAMS),
    ("vertical motion", ("dvl", *BEAM_SENSORS, "depth")),
    ("horizontal motion", ("dvl", *BEAM_SENSORS, "fix", "place", "dvl_water", "thruster")),
)
OF_RESIDUALS = ("rejected", "too large", "lasting")


def findings_of_check(evidence: Evidence) -> Iterator[Statistic]:
    """Errors in the data by the check of the log that neither the log's reader nor the estimate has corrected.

    A clock that was set is bridged, and late stamps are no matter where the offset is estimated.
    """
    beliefs = evidence.initial.beliefs
    for finding in evidence.findings:
        offset = beliefs.get(f"{finding.sensor}_time_offset")
        mended = finding.kind == "jump" or (finding.kind == "lag" and offset is not None and offset.estimate)
        if finding.wrong and not mended:
            cause, _, remedy = finding.text.partition("; ")
            remedy = remedy or "rovgraph check has all findings"
            yield Statistic("check", finding.sensor, evidence.start, evidence.end, 1.0, cause, remedy)


def frozen_sensors(evidence: Evidence) -> Iterator[Statistic]:
    """How long a sensor repeated itself; those measurements were left out. Single ones between others cost nothing."""
    by_sensor: dict[str, list[tuple[float, float]]] = {}
    for stretch in evidence.frozen:
        if not stretch.single:
            by_sensor.setdefault(stretch.sensor, []).append((stretch.first, stretch.last))
    for sensor, times in by_sensor.items():
        seconds = sum(last - first for first, last in times)
        yield frozen_for(sensor, times[0][0], times[-1][1], seconds, len(times), evidence.start)


def frozen_for(sensor: str, first: float, last: float, seconds: float, times: int, start: float) -> Statistic:
    """A sensor that repeated itself for some seconds in all, so often; ``start`` is when the dive began [s]."""
    often = "" if times == 1 else f" in {times} intervals"
    return Statistic(
        "frozen",
        sensor,
        first,
        last,
        seconds,
        f"repeats its values for {seconds:.0f} s{often}, {span(first, last, start)}; they were ignored",
        "check the instrument and its driver; the track is less certain there, and its sd includes that",
    )


def no_attitude(evidence: Evidence) -> Iterator[Statistic]:
    """Longest time without heading, and without tilt, in which the DVL's pings have no known direction."""
    for part in ("heading", "tilt"):
        gaps = [gap for gap in evidence.attitude_gaps if gap.part == part and gap.pings]
        if not gaps:
            continue
        worst = max(gaps, key=lambda gap: gap.end - gap.begin)
        seconds, often = worst.end - worst.begin, "" if len(gaps) == 1 else f", the longest of {len(gaps)} times"
        yield Statistic(
            f"no {part}",
            part,
            worst.begin,
            worst.end,
            seconds,
            f"no {part} for {seconds:.0f} s, {evidence.span(worst.begin, worst.end)}{often}: the vehicle's "
            f"turns are unknown there, and {sum(gap.pings for gap in gaps)} DVL pings were ignored",
            f"check the instrument and its driver, or map another source of {part}; position is less certain there, "
            "and its sd includes that",
        )


def contradictions(alarms: Sequence[Alarm], start: float) -> Iterator[Alarm]:
    """Pairs of sensors that measure the same and both disagree with the estimate at the same time.

    The estimate lies between two sensors that contradict each other, so the residuals of both are odd. ``start`` is
    when the dive began [s].
    """
    odd: dict[str, list[Alarm]] = {}
    for alarm in alarms:
        if alarm.kind in OF_RESIDUALS:
            odd.setdefault(alarm.sensor, []).append(alarm)
    for what, names in MEASURE_THE_SAME:
        for one, other in combinations([name for name in names if name in odd], 2):
            both = [(a, b) for a in odd[one] for b in odd[other] if a.begin <= b.end and b.begin <= a.end]
            if not both:
                continue
            a, b = max(both, key=lambda pair: min(pair[0].figure / pair[0].limit, pair[1].figure / pair[1].limit))
            begin, end = max(a.begin, b.begin), min(a.end, b.end)
            severity: Severity = "wrong" if a.severity == b.severity == "wrong" else "doubtful"
            figure = min(a.figure / a.limit, b.figure / b.limit)
            text = (
                f"{one} and {other}: they contradict each other in {what}, {span(begin, end, start)}; remove one "
                "of them from the log to find which one is wrong"
            )
            yield Alarm(
                "contradiction", f"{one}, {other}", begin, end, figure, RULES["contradiction"].doubtful, severity, text
            )
