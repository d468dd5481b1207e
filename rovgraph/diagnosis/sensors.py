"""Alarms on the sensors themselves: those that froze, and pairs that contradict each other."""

from collections.abc import Iterator, Sequence
from itertools import combinations

from rovgraph.diagnosis.alarm import Alarm, Statistic
from rovgraph.diagnosis.evidence import Evidence, span
from rovgraph.instruments import HEADING_STREAMS
from rovgraph.rules import RULES, Severity

MEASURE_THE_SAME = (
    ("heading", HEADING_STREAMS),
    ("vertical motion", ("dvl", "depth")),
    ("horizontal motion", ("dvl", "fix", "place", "dvl_water", "thruster")),
)
OF_RESIDUALS = ("rejected", "too large", "lasting")


def checked(evidence: Evidence) -> Iterator[Statistic]:
    """What the check of the log says is wrong with the data, and neither the log's reader nor the estimate has mended.

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


def frozen(evidence: Evidence) -> Iterator[Statistic]:
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
    """Longest time without heading, and without tilt, in which nothing said what the DVL's pings mean."""
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
