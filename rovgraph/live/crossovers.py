"""Crossovers while a dive goes on: after each line the dive so far is matched, and the filter goes on from that.

When a straight line has ended, the thread that smooths the dive so far (`rovgraph.live.reinitialisations`) matches its
soundings, as `rovgraph smooth` does of a whole dive (`rovgraph.inference.crossovers`), and the filter goes on from the
newest keyframe of the dive given the closures: position, heading, biases and calibration. Each match begins with the
dive as the sensors have it, so no closure counts twice, and one that is refused later is taken back. What crossovers
cannot see stays in the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rovgraph.diagnosis.alarm import Statistic, Verdict, verdict_of
from rovgraph.diagnosis.statistics import find_alarms
from rovgraph.inference.bottom import bottom_of
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.chart import ChartFile
from rovgraph.inference.crossovers import ENOUGH, ON_CHART, Crossovers, closed, crossings_of, lines_over, matched
from rovgraph.inference.drift import Drift
from rovgraph.inference.error_state import newest_known
from rovgraph.inference.estimate import Estimate, body_trajectory, calibration_estimates, residual_frame
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.filter_step import Gaussian
from rovgraph.inference.fixed_lag import FilterSnapshot
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.relief import line_ends
from rovgraph.inference.smoother import newest_calibration, smoothed
from rovgraph.live.solution import CrossingPlace
from rovgraph.log import Log, Measurement, gathered
from rovgraph.model.origin import Origin
from rovgraph.model.state import State
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.problem import Problem
from rovgraph.sensors.dvl_beam import BEAMS

RANGES = (BEAMS, "dvl_altitude")
LOOK_S = 5.0  # between looks whether a line has ended
RECENT_S = 600.0  # of the track, that shows it
NO_RANGES = "there are no ranges to the bottom"
OVER_CHART_M = 200.0  # of way over a chart, after which the dive is matched before the line has ended


@dataclass(frozen=True)
class LiveMatch:
    """What a smoothed dive's crossovers say.

    Attributes
    ----------
    text : for people
    known : the newest keyframe, by what was matched, too; None where nothing was
    places : of the crossings that were looked at
    quiet : nothing to tell, as long as nothing was matched before
    """

    text: str
    known: Gaussian | None = None
    places: tuple[CrossingPlace, ...] = ()
    quiet: bool = False


@dataclass(frozen=True)
class LiveSurvey:
    """What there is to match, beside the track, when the thread begins.

    Attributes
    ----------
    ranges : to the bottom
    chart, origin : of the bottom; latitude and longitude of north = east = 0
    verdict : so far
    used : the filter goes on from a match
    """

    ranges: Sequence[Measurement]
    chart: ChartFile | None
    origin: Origin | None
    verdict: Verdict
    used: bool

    def refused(self, initial: InitialConditions, dive: Problem, states: State) -> LiveMatch | None:
        """Why a dive so far is not worth smoothing, by its track before that; None where it is.

        Parameters
        ----------
        initial : of the filter
        dive, states : the keyframes so far, and as the filter had them
        """
        if self.used:
            return None
        if self.verdict != "trusted":
            return _untrusted(self.verdict)
        if self.chart is not None:
            return None
        track, values = body_trajectory(dive.keyframes, states, initial), newest_calibration(states.calibration)
        rows = calibration_estimates(initial.beliefs, initial.streams, values, {})
        bottom = bottom_of(self._log, initial.config, Estimate("filtered", track, rows, {}, residual_frame()))
        if bottom is None:
            return _refused(NO_RANGES)
        lines, still = lines_over(track, bottom), Drift(track.time[[0, -1]], np.zeros(4), np.zeros((4, 4)))
        enough = sum(len(crossings_of(lines, k, still)) for k in range(1, len(lines))) >= ENOUGH
        return None if enough else LiveMatch("", quiet=True)

    def match(self, engine: FilterEngine, best: Optimum, shown: Sequence[Statistic]) -> LiveMatch:
        """Match a smoothed dive.

        Parameters
        ----------
        engine : of the filter
        best : the dive so far
        shown : by it, of its constants and noise
        """
        verdict = self.verdict
        if verdict == "trusted":
            verdict = verdict_of(find_alarms(shown, float(best.problem.time[0])))
        if verdict != "trusted":
            return _untrusted(verdict)
        if not isinstance(best, ChainOptimum):
            return _refused("they need a dive without places")
        if self.chart is not None and self.origin is None:
            return _refused("the chart needs latitude and longitude of north = east = 0, by a fix or the configuration")
        estimate, initial = smoothed(best, engine.initial), engine.initial
        if (bottom := bottom_of(self._log, initial.config, estimate)) is None or estimate.posterior is None:
            return _refused(NO_RANGES)
        drift, found = matched(estimate, bottom, initial.beliefs, self.chart, self.origin or (0.0, 0.0))
        if not found.closures:
            return LiveMatch(found.text, None, _places(found, drift), quiet=len(found.crossings) < ENOUGH)
        best, _ = closed(estimate.posterior, drift, found.closures)
        known, before = newest_known(engine, best), newest_known(engine, estimate.posterior.optimum)
        moved = float(np.linalg.norm((known.x - before.x)[9:11]))
        sds = [_horizontal_sd(one) for one in (before, known)]
        text = f"{found.text}; the position moves by {moved:.1f} m, its sd goes from {sds[0]:.1f} m to {sds[1]:.1f} m"
        return LiveMatch(text, known, _places(found, drift.given(found.closures)))

    @property
    def _log(self) -> Log:
        return gathered(sorted(self.ranges, key=lambda m: m.time), "received")


def _untrusted(verdict: Verdict) -> LiveMatch:
    return _refused(f"the verdict so far is {verdict}, and they would make the track more certain of its error")


def _refused(why: str) -> LiveMatch:
    return LiveMatch(f"nothing is used: {why}")


NOT_COMPUTED = _refused("the smoothed dive does not determine its joint covariance")


def _horizontal_sd(known: Gaussian) -> float:
    """Of north and east together [m]."""
    R_nb = known.x[:9].reshape(3, 3)
    return float(np.sqrt(np.trace(R_nb[:2] @ known.covariance[3:6, 3:6] @ R_nb[:2].T)))


def _places(found: Crossovers, left: Drift) -> tuple[CrossingPlace, ...]:
    """Where crossings are, on the matched track."""
    out = []
    for crossing, was_matched in zip(found.crossings, found.matched, strict=True):
        of_chart = crossing.earlier == ON_CHART
        north, east = crossing.centre + left.at(np.array([crossing.times[0 if of_chart else 1]]))[0]
        out.append(CrossingPlace(float(north), float(east), was_matched, of_chart))
    return tuple(out)


class LiveCrossovers:
    """Gathers what is to be matched, and notices when a line has ended.

    Parameters
    ----------
    chart : of the bottom, or None

    Attributes
    ----------
    due : a line has ended since the dive was matched last
    used : the filter goes on from a match
    held : the dive is not smoothed for that, as while a recording is read again
    """

    def __init__(self, chart: ChartFile | None) -> None:
        self.used = self.held = self.due = False
        self._chart = chart
        self._ranges: list[Measurement] = []
        self._track: list[tuple[float, float, float, float]] = []  # time, heading, north, east
        self._look, self._way = -np.inf, 0.0
        self._told: set[str] = set()

    def take(self, m: Measurement) -> None:
        """Keep what shows the bottom."""
        if m.sensor in RANGES:
            self._ranges.append(m)

    def passed(self, snapshot: FilterSnapshot) -> None:
        """Take a keyframe that the lag has passed."""
        x, time = snapshot.known.x, snapshot.time
        here = time, float(np.arctan2(x[3], x[0])), float(x[9]), float(x[10])
        if self._chart is not None and self._track:
            self._way += float(np.hypot(x[12], x[13])) * (time - self._track[-1][0])  # a match moves it, too
        self._track.append(here)
        if time < self._look:
            return
        self._look = time + LOOK_S
        t, heading, *place = np.array(self._track).T
        ends = line_ends(t, heading, np.stack(place, axis=-1)) if len(t) > 1 else []
        over = self._way > OVER_CHART_M
        self.due |= bool(ends) or over
        self._way = 0.0 if over else self._way
        since = max(time - RECENT_S, ends[-1] if ends else -np.inf)
        self._track = self._track[int(t.searchsorted(since)) :]

    def survey(self, origin: Origin | None, verdict: Verdict) -> LiveSurvey:
        """What there is to match so far."""
        self.due = False
        return LiveSurvey([*self._ranges], self._chart, origin, verdict, self.used)

    def tell(self, crossed: LiveMatch) -> tuple[str, str] | None:
        """Take what was matched; kind and text of an event, if it is news."""
        before, self.used = self.used, crossed.known is not None
        news = self.used or before or not (crossed.quiet or crossed.text in self._told)
        self._told.add(crossed.text)
        return ("matched" if self.used else "unused", crossed.text.removeprefix("crossovers: ")) if news else None
