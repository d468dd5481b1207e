"""Alarms on the choice between optima: stretches of a sensor that were taken out, and a choice that was close."""

from collections.abc import Iterator
from math import exp, isfinite

from rovgraph.engine.gauss_newton import Stretch
from rovgraph.estimators.alarms.alarm import Statistic
from rovgraph.estimators.alarms.evidence import Evidence, span

TAKEN_OUT_S = 0.0  # any
CLOSE = 1e-4  # likelihood of the next best explanation against the best


def taken_out(evidence: Evidence) -> Iterator[Statistic]:
    """Stretches in which a sensor contradicts all others, of `rovgraph.engine.stretches`."""
    for stretch in () if evidence.optimum is None else evidence.optimum.solution.stretches:
        yield taken_out_in(stretch, evidence.start)


def taken_out_in(stretch: Stretch, start: float) -> Statistic:
    """One such stretch; ``start`` is when the dive began [s]."""
    return Statistic(
        "taken out",
        stretch.sensor,
        stretch.begin,
        stretch.end,
        stretch.end - stretch.begin,
        TAKEN_OUT_S,
        float("inf"),
        f"contradicts the other sensors together, {span(stretch.begin, stretch.end, start)}, and was left out there",
        "look at the instrument at that time: a bias, a false lock, water for the bottom; an error that grew "
        "slowly may have begun earlier",
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
        CLOSE,
        float("inf"),
        f"sensors contradict each other, and which one to leave out was decided by a cost of {margin:.1f} only",
        "look at the sensors that were rejected, and take the wrong one out of the log",
    )
