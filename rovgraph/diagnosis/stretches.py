"""Alarms on the choice between optima: a sensor that was ignored for some time, and a choice that was close."""

from collections.abc import Iterator
from math import exp, isfinite

from rovgraph.diagnosis.alarm import Statistic
from rovgraph.diagnosis.evidence import Evidence, span
from rovgraph.engine.gauss_newton import Stretch


def taken_out(evidence: Evidence) -> Iterator[Statistic]:
    """Intervals in which a sensor contradicts all others, of `rovgraph.engine.stretches`."""
    for stretch in () if evidence.optimum is None else evidence.optimum.solution.stretches:
        yield taken_out_in(stretch, evidence.start)


def taken_out_in(stretch: Stretch, start: float) -> Statistic:
    """One such interval; ``start`` is when the dive started [s]."""
    return Statistic(
        "taken out",
        stretch.sensor,
        stretch.begin,
        stretch.end,
        stretch.end - stretch.begin,
        f"contradicts all other sensors, {span(stretch.begin, stretch.end, start)}, and was ignored there",
        "check the instrument at that time: a bias, a false lock, water instead of the bottom; an error that grew "
        "slowly may have started earlier",
    )


def close(evidence: Evidence) -> Iterator[Statistic]:
    """Likelihood of the next best optimum against the one that was chosen."""
    if evidence.optimum is None or not isfinite(evidence.optimum.solution.runner_up):
        return
    margin = evidence.optimum.solution.runner_up
    yield Statistic(
        "close",
        "dive",
        evidence.start,
        evidence.end,
        exp(-margin),
        f"sensors contradict each other, and a cost difference of only {margin:.1f} decided which one to ignore",
        "check the rejected sensors, and remove the wrong one from the log",
    )
