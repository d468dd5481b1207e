"""All statistics of a dive, and the alarms and advice that they give.

`STATISTICS` are the functions: each takes the `Evidence` of a dive and yields figures that are small in healthy dives
(docs/alarms.md). A figure beyond its limit is an `Alarm`; the worst of them is the verdict.
"""

from collections.abc import Callable, Iterator, Sequence

from rovgraph.diagnosis import constants, motion, residuals
from rovgraph.diagnosis.alarm import Alarm, Statistic, alarm_of
from rovgraph.diagnosis.evidence import Evidence

TINY = 1e-9  # a limit may be 0

STATISTICS: tuple[Callable[[Evidence], Iterator[Statistic]], ...] = (
    motion.dvl_cause,
    residuals.findings_of_check,
    motion.found_noise,
    motion.fast_current,
    constants.contradicted_constants,
    constants.alignment_entered_twice,
    constants.moved_calibration,
    constants.earth_rate,
    motion.bias_drift,
    residuals.frozen_sensors,
    residuals.no_attitude,
    motion.excluded_intervals,
    motion.ambiguous_optimum,
    residuals.left_out,
    residuals.filter_alone,
    residuals.innovations,
    residuals.rejected,
    residuals.too_large,
    residuals.too_small,
    residuals.correlated_residuals,
    motion.imu_disagreement,
    motion.rivals,
    motion.filter_smoother_separation,
    motion.uncertain,
    constants.split_half_drift,
)


def statistics(evidence: Evidence) -> list[Statistic]:
    """Every number of a dive, within its limits or not."""
    config, streams = evidence.initial.config, evidence.log.streams
    return [residuals.by_far_knots(one, config, streams) for function in STATISTICS for one in function(evidence)]


def find_alarms(numbers: Sequence[Statistic], start: float) -> list[Alarm]:
    """Figures beyond their limits, the worst of each kind and sensor, causes before consequences.

    Parameters
    ----------
    numbers : of `statistics`
    start : when the dive began [s]
    """
    worst = [alarm for alarm in _worst(numbers) if alarm.severity != "advice"]
    contradicted = {alarm.sensor for alarm in worst if alarm.kind in ("axes", "clock")}  # in the check's own words
    worst = [alarm for alarm in worst if alarm.kind != "check" or alarm.sensor not in contradicted]
    return [*worst, *residuals.contradictions(worst, start)]


def find_advice(numbers: Sequence[Statistic]) -> list[Alarm]:
    """Advice on values that could be stated better, no evidence of error, the worst of each kind and sensor."""
    return [one for one in _worst(numbers) if one.severity == "advice"]


def _worst(numbers: Sequence[Statistic]) -> list[Alarm]:
    worst: dict[tuple[str, str], Alarm] = {}
    for alarm in filter(None, map(alarm_of, numbers)):
        known = worst.get((alarm.kind, alarm.sensor))
        if known is None or _badness(alarm) > _badness(known):
            worst[alarm.kind, alarm.sensor] = alarm
    return [*worst.values()]


def _badness(alarm: Alarm) -> tuple[bool, float]:
    return alarm.severity == "wrong", alarm.figure / max(alarm.limit, TINY)
