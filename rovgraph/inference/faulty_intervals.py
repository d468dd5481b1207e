"""Intervals in which a sensor is wrong all the time, found by the cost of leaving them out.

Gates look at one measurement at a time. A DVL that is biased for half a minute moves the estimate with it, and its good
pings before and after are rejected instead: another local optimum, which gates do not leave. A burst of rejections
reveals it. Then the measurements around the burst are excluded, one sensor's at a time, the dive is solved without
them, and the interval is fitted to give the least cost.

An interval must cost less than as many single outliers, since it has one cause. It costs as much as the same number of
good measurements may cost by chance:

    J = cost of admitted measurements + sum of rejected rho(gate) + sum over sensors s Q(n dim) / 2

with n a sensor's measurements in its intervals, Q the quantile of chi-square beyond which one in a million lies, and s
the mean square of normalised residuals of admitted measurements, at least 1. So an interval is excluded only where its
measurements cost more than good ones ever do, by the standard of the rest of the dive. Where a sensor is wrong most of
the time, or the dive is no better without the interval, all measurements stay and alarms report it.

The search frees constants that the dive holds and that are not exact, such as the mounting of the DVL: a tilt that is
held at zero makes all pings cost more than they should, so that excluding more of them would always pay.

It solves a dive some dozens of times. Of a long dive it solves the part around the burst, with the information before
it as prior.
"""

import math
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rovgraph.distributions import binomial_tail, chi_square_quantile
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.gauss_newton import (
    FaultyInterval,
    GatedMeasurements,
    Gates,
    GaussNewtonResult,
    Linearizable,
    Point,
    Step,
    minimise,
    standing,
)
from rovgraph.rules import CHANCE, USUAL_SHARE

BURST_S, BURST_COUNT = 5.0, 10  # over which rejections are counted: a time, and as many measurements
SAME_CAUSE_S = 20.0  # bursts at most so far apart have one cause
AROUND_S = (5.0, 20.0, 60.0)  # around a burst, excluded to begin with
NOTICEABLE, CLEAR = 12.0, 100.0  # gain that may be chance; gain that is not chance
OUTWARDS = (0, 2, 8, 16, 32, 64)  # measurements from what is clear
SHARP = 16  # measurements from the one to the other at an edge that is sharp: each costs no more than at its gate
GROWING = 5  # times what is beyond that, a slow error was there before it showed
MARGIN = 2  # measurements outside of an edge that are left out, too
MOST_SHARE = 0.5  # of a sensor's measurements, that stretches may hold
WELL = 1.5  # mean square of normalised residuals of the rest
MAX_STRETCHES = 4
TOLERANCE = 0.1  # decrease of the cost that is left when optima are compared
REACH_S = 300.0  # before and after a burst, of the part of a long dive that is solved in the search


class SubProblem(Protocol[Point, Step]):
    """A part of a dive that is a problem of its own."""

    @property
    def problem(self) -> Linearizable[Point, Step]:
        """The part."""
        ...

    def point(self, whole: Point) -> Point:
        """The point of the part at a point of the dive."""
        ...

    def gates(self, whole: Gates) -> Gates:
        """Those of the part, of the dive's."""
        ...

    def with_gates(self, whole: Gates, own: Gates) -> Gates:
        """The dive's, with those of the part in place of its own."""
        ...


class Partition(Protocol[Point, Step]):
    """How parts of a dive are made, of the kind of problem that is solved."""

    def __call__(
        self, problem: Any, solution: GaussNewtonResult[Point], begin: float, end: float, /
    ) -> SubProblem[Point, Step] | None:
        """The part between two times [s], about a solution; None = it is most of the dive."""
        ...


@dataclass
class Searches:
    """Searches in a dive, kept for other solutions of it with the same configuration.

    A search depends on where it begins, which is an optimum. Optima with the same gates are the same one, from
    wherever they were found, so that what was found from one of them holds for the others.

    Attributes
    ----------
    saved_s : processor time of the searches that were not made again [s]
    """

    saved_s: float = 0.0
    _found: dict[tuple[bytes, ...], tuple[GaussNewtonResult[Any], float]] = field(default_factory=dict)

    def from_optimum(
        self, best: GaussNewtonResult[Point], search: Callable[[], GaussNewtonResult[Point]]
    ) -> GaussNewtonResult[Point]:
        """What ``search`` returns, which begins at an optimum, or returned before."""
        key = tuple(gate.tobytes() for gate in best.gates.values())
        if key in self._found:
            found, spent = self._found[key]
            self.saved_s += spent
            return found
        began = clock.process_time()
        found = search()
        self._found[key] = found, clock.process_time() - began
        return found


def solve(
    problem: Linearizable[Point, Step],
    point: Point,
    freed: Callable[[Point], Linearizable[Point, Step]] | None = None,
    partition: Partition[Point, Step] | None = None,
    searches: Searches | None = None,
    tolerance: float | None = None,
) -> GaussNewtonResult[Point]:
    """The cheapest optimum of a dive: from ``point``, and without stretches in which a sensor contradicts the others.

    Parameters
    ----------
    problem, point : the dive, and where to begin
    freed : the dive, from where it is linearised, with the uncertain constants that ``problem`` holds estimated: an
        error that a mounting explains needs no interval
    partition : makes the parts of a long dive in which stretches are sought; None = they are sought in all of it
    searches : that were made for other solutions of the same dive, as configured the same
    tolerance : as of `rovgraph.inference.gauss_newton.minimise`

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    best = minimise(problem, point, tolerance=tolerance)
    if not _bursts(problem.measured(), best):
        return best

    def search() -> GaussNewtonResult[Point]:
        if freed is None:
            return _without_stretches(problem, best, partition)
        free = freed(best.point)
        return _without_stretches(free, minimise(free, best.point, best.gates, tolerance=TOLERANCE), partition)

    found = search() if searches is None else searches.from_optimum(best, search)
    if not found.stretches:
        return replace(best, runner_up=found.runner_up)
    return resume(problem, found.point if freed is None else best.point, found, tolerance)


def _without_stretches(
    problem: Linearizable[Point, Step], best: GaussNewtonResult[Point], partition: Partition[Point, Step] | None
) -> GaussNewtonResult[Point]:
    """The cheapest of an optimum and those without stretches in which a sensor contradicts the others."""
    tried: list[FaultyInterval] = []
    measured, runner_up = problem.measured(), math.inf
    for _ in range(MAX_STRETCHES):
        burst = next((b for b in _bursts(measured, best) if not any(_overlap(b, t) for t in tried)), None)
        if burst is None:
            break
        tried.append(burst)
        part = partition and partition(problem, best, burst.begin - REACH_S, burst.end + REACH_S)
        if part:
            found = _without_stretch_in(part, problem, best, burst)
        else:
            found = _without_stretch(problem, best, burst, MOST_SHARE)
        if found is not None and _right_elsewhere(problem, found):
            best, runner_up = found, min(runner_up, found.runner_up)
    return replace(best, runner_up=runner_up)


def _without_stretch(
    problem: Linearizable[Point, Step], best: GaussNewtonResult[Point], burst: FaultyInterval, most: float = math.inf
) -> GaussNewtonResult[Point] | None:
    """The cheapest of an optimum and those without a sensor around a burst.

    None = the rest of it fits badly, too, or the stretch holds more than a share ``most`` of a sensor's measurements.
    """
    without = [_taken_out_around(problem, best, burst, sensor) for sensor in problem.measured()]
    ranked = sorted([best, *filter(None, without)], key=lambda one: one.cost)
    if _level(problem, ranked[0]) > WELL:
        return None
    fitted = best if ranked[0] is best else _with_fitted_edges(problem, ranked[0], most)
    runner_up = min((other.cost - ranked[0].cost for other in ranked[1:]), default=math.inf)
    return fitted and replace(fitted, runner_up=runner_up)


def _without_stretch_in(
    part: SubProblem[Point, Step],
    problem: Linearizable[Point, Step],
    best: GaussNewtonResult[Point],
    burst: FaultyInterval,
) -> GaussNewtonResult[Point] | None:
    """The same, sought in a part of the dive; what is found there is solved in all of it."""
    measured = part.problem.measured()
    before = tuple(s for s in best.stretches if s.sensor in measured and _barred(measured, [s])[s.sensor].any())
    in_part = replace(best, point=part.point(best.point), gates=part.gates(best.gates), stretches=before)
    found = _without_stretch(part.problem, resume(part.problem, in_part.point, in_part, TOLERANCE), burst)
    if found is None or found.stretches == before:
        return found and replace(best, runner_up=found.runner_up)
    known = replace(
        found, gates=part.with_gates(best.gates, found.gates), stretches=(*best.stretches, found.stretches[-1])
    )
    whole = resume(problem, best.point, known, TOLERANCE)
    return whole if whole.cost < best.cost else replace(best, runner_up=found.runner_up)


def resume(
    problem: Linearizable[Point, Step], point: Point, known: GaussNewtonResult[Point], tolerance: float | None = None
) -> GaussNewtonResult[Point]:
    """The optimum of a problem close to one whose solution is known, with the same intervals excluded."""
    barred = _barred(problem.measured(), known.stretches)
    return _with_stretches(problem, minimise(problem, point, known.gates, barred, tolerance), known)


def converged(
    problem: Linearizable[Point, Step], point: Point, known: GaussNewtonResult[Point]
) -> GaussNewtonResult[Point] | None:
    """A known solution moved to a point close by, with its gates and stretches; None = gates change there."""
    barred = _barred(problem.measured(), known.stretches)
    stands = standing(problem, point, known.gates, barred)
    return stands and _with_stretches(problem, stands, known)


def _with_stretches(
    problem: Linearizable[Point, Step], solution: GaussNewtonResult[Point], known: GaussNewtonResult[Point]
) -> GaussNewtonResult[Point]:
    """A solution with the stretches of another one, and with what they cost."""
    solution = replace(solution, stretches=known.stretches, runner_up=known.runner_up)
    return replace(solution, cost=solution.cost + _price(problem, solution))


def _right_elsewhere(problem: Linearizable[Point, Step], solution: GaussNewtonResult[Point]) -> bool:
    """Whether every sensor is right most of the time."""
    barred = _barred(problem.measured(), solution.stretches)
    return all(out.mean() <= MOST_SHARE for out in barred.values())


def _bursts(measured: Mapping[str, GatedMeasurements], solution: GaussNewtonResult[Point]) -> list[FaultyInterval]:
    """Times in which a sensor was rejected more often than chance allows, the least likely first."""
    found: list[tuple[float, float, float]] = []
    barred = _barred(measured, solution.stretches)
    for sensor, gate in solution.gates.items():
        out = ~gate & ~barred.get(sensor, np.zeros(len(gate), bool))
        if out.any():
            found += _bursts_of(measured[sensor].time, out)
    return [FaultyInterval("", begin, end) for begin, end, _ in sorted(_joined(found), key=lambda one: one[2])]


def _bursts_of(time: Array, out: NDArray[np.bool_]) -> Iterator[tuple[float, float, float]]:
    """Rejected measurements with too many others around them: begin, end and probability."""
    half = 0.5 * max(BURST_S, BURST_COUNT * float(np.median(np.diff(time)))) if len(time) > 1 else 0.0
    begin, end = time.searchsorted(time - half), time.searchsorted(time + half, side="right")
    count = np.concatenate([[0], np.cumsum(out)])
    k, n = count[end] - count[begin], end - begin
    share = max(USUAL_SHARE, float(np.median(k / n)))
    for at in np.flatnonzero(out):
        chance = binomial_tail(int(k[at]) - 1, int(n[at]), share)
        if chance < CHANCE:
            yield float(time[at]), float(time[at]), chance


def _joined(windows: Sequence[tuple[float, float, float]]) -> list[tuple[float, float, float]]:
    """Windows that have one cause, as one, with the least of their probabilities."""
    out: list[tuple[float, float, float]] = []
    for begin, end, chance in sorted(windows):
        if out and begin - out[-1][1] <= SAME_CAUSE_S:
            out[-1] = out[-1][0], max(end, out[-1][1]), min(chance, out[-1][2])
        else:
            out.append((begin, end, chance))
    return out


def _taken_out_around(
    problem: Linearizable[Point, Step], best: GaussNewtonResult[Point], burst: FaultyInterval, sensor: str
) -> GaussNewtonResult[Point] | None:
    """The cheapest optimum without a sensor's measurements around a burst; None = no such optimum."""
    wider = [FaultyInterval(sensor, burst.begin - more, burst.end + more) for more in AROUND_S]
    found = [_solved_without(problem, best, (*best.stretches, stretch)) for stretch in wider]
    return min(filter(None, found), key=lambda one: one.cost, default=None)


def _with_fitted_edges(
    problem: Linearizable[Point, Step], best: GaussNewtonResult[Point], most: float
) -> GaussNewtonResult[Point] | None:
    """The newest stretch as short as it can be at next to no cost, its edges put out where they are not sharp.

    None = it turns out to hold more than a share ``most`` of the sensor's measurements, which may be clear early.
    Good measurements cost about as much as they save, so the cost is flat outside of the stretch and a wall within. An
    error that grows from nothing is there before it costs anything: the less steep the wall, the longer before.
    """
    time = problem.measured()[best.stretches[-1].sensor].time
    begun = _with_fitted_edge(problem, best, time, end=False, most=math.inf)
    return begun and _with_fitted_edge(problem, begun, time, end=True, most=most * len(time))


def _with_fitted_edge(
    problem: Linearizable[Point, Step], best: GaussNewtonResult[Point], time: Array, end: bool, most: float
) -> GaussNewtonResult[Point] | None:
    """The same for one edge: in by bisection until it is clear, then out by doubled steps until nothing shows.

    None = there are more than ``most`` measurements in it, with the other edge as it is.
    """
    newest, least, nearest = best.stretches[-1], best.cost, best

    @cache  # from whichever edge was nearest when it was first asked for
    def at(index: int) -> GaussNewtonResult[Point] | None:
        edge = float(time[min(max(index, 0), len(time) - 1)])
        moved = replace(newest, end=edge) if end else replace(newest, begin=edge)
        return _solved_without(problem, nearest, (*best.stretches[:-1], moved))

    inside = np.flatnonzero((time >= newest.begin) & (time <= newest.end)).tolist()
    outer, inner = (inside[-1], inside[0]) if end else (inside[0], inside[-1])
    other, clear = inner, outer
    while abs(inner - clear) > 1:
        if abs(inner - other) > most:  # the edge that is sought lies beyond the inner one
            return None
        middle = (inner + clear) // 2
        shorter = at(middle)
        if shorter is not None and shorter.cost <= least + CLEAR:
            clear, nearest = middle, shorter
        else:
            inner = middle
    away = 1 if end else -1
    costs = {k: one.cost for k in OUTWARDS if (one := at(clear + away * k)) is not None}
    steps = next((k for k, cost in costs.items() if cost <= min(costs.values()) + NOTICEABLE), 0)
    return at(clear + away * (steps + MARGIN + GROWING * max(0, steps - SHARP))) or best


def _solved_without(
    problem: Linearizable[Point, Step], begin: GaussNewtonResult[Point], stretches: tuple[FaultyInterval, ...]
) -> GaussNewtonResult[Point] | None:
    """The optimum without some stretches, their costs included; None = they are empty, or needed."""
    measured = problem.measured()
    barred = _barred(measured, stretches)
    if not barred[stretches[-1].sensor].any():
        return None
    before = _barred(measured, begin.stretches)
    gates = {s: gate | before[s] if s in before else gate for s, gate in begin.gates.items()}
    try:
        solution = minimise(problem, begin.point, gates, barred, TOLERANCE)
    except InputError:
        return None
    solution = replace(solution, stretches=stretches)
    return replace(solution, cost=solution.cost + _price(problem, solution))


def _price(problem: Linearizable[Point, Step], solution: GaussNewtonResult[Point]) -> float:
    """What the stretches of a solution cost."""
    measured = problem.measured()
    barred = _barred(measured, solution.stretches)
    numbers = [int(out.sum()) * measured[sensor].dim for sensor, out in barred.items()]
    return _level(problem, solution) * 0.5 * sum(chi_square_quantile(n, CHANCE) for n in numbers)


def _level(problem: Linearizable[Point, Step], solution: GaussNewtonResult[Point]) -> float:
    """Mean square of normalised residuals, at least 1. Motions have as many components as keyframes have."""
    numbers = sum(int(solution.gates[s].sum()) * one.dim for s, one in problem.measured().items())
    return max(1.0, 2.0 * problem.cost(solution.point, solution.gates) / max(numbers, 1))


def _barred(measured: Mapping[str, GatedMeasurements], stretches: Sequence[FaultyInterval]) -> Gates:
    """Sensor -> which of its measurements lie in a stretch."""
    out: Gates = {}
    for s in stretches:
        time = measured[s.sensor].time
        out[s.sensor] = out.get(s.sensor, np.zeros(len(time), bool)) | ((time >= s.begin) & (time <= s.end))
    return out


def _overlap(a: FaultyInterval, b: FaultyInterval) -> bool:
    return a.begin <= b.end and b.begin <= a.end
