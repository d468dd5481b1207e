"""Predicts what crosslines would leave of a survey's drift: of ``rovgraph plan --survey`` and ``observe --crosslines``.

Lines and crosslines are simulated as manoeuvres are (`rovgraph.lab.plan.simulated`). The joint covariance of that track
is conditioned on its crossings (`rovgraph.inference.crossovers`). Each is worth the Fisher information that soundings
of the bottom's relief have on its shift, and is taken as matched if its shift is predicted within the range of the
search, the best predicted next.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rovgraph.dive import smooth
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.bottom import bottom_of
from rovgraph.inference.crossovers import (
    BESIDE_M,
    ENOUGH,
    FARTHEST_M,
    SIGMAS,
    Crossing,
    Field,
    crossings_of,
    drift_of,
    field_at,
)
from rovgraph.inference.drift import Drift, LoopClosure, condition
from rovgraph.inference.initialise import initialise
from rovgraph.inference.relief import Line, Relief, fit_relief, lines_of
from rovgraph.inference.smoother import assemble
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.plan import DVL_HZ, IMU_HZ, SensorRates, simulated
from rovgraph.lab.survey import STYLE, Survey, planned_swath
from rovgraph.log import Log
from rovgraph.model.calibration import ACOUSTICS
from rovgraph.model.config import Config
from rovgraph.process import Progress, no_progress
from rovgraph.sensors import SENSORS
from rovgraph.sensors.instruments import HEADING_STREAMS
from rovgraph.simulate.path import path_along

COUNTS = (1, 2, 4)  # crosslines, at places of `Survey.places`
NONE = np.empty(0)
USUAL_RELIEF = Relief(0.35, 4.5, 0.15, np.inf)  # where it is not known: 1 m over 20 m, by a DVL 10 m above it
MOST_IMU_HZ = 50.0  # simulated; more tell no more of the drift
PLACES = {"fix", "place", *ACOUSTICS}  # sensors that show places


@dataclass(frozen=True)
class Crossed:
    """A survey with k crosslines.

    Attributes
    ----------
    along : ndarray, shape (k,), where they cross, along the lines from `Survey.corner`, as they are driven [m]
    duration : that they take [s]
    crossings : that are matched
    sd : horizontal, rms over the survey's lines [m]
    shape_sd : what of it is no shift, rotation or scale of the whole
    """

    along: Array
    duration: float
    crossings: int
    sd: float
    shape_sd: float


@dataclass(frozen=True)
class CrosslinePlan:
    """What crosslines would leave of a survey's drift.

    Attributes
    ----------
    survey, relief : its lines, and the bottom
    ranked : the survey by itself, then with the best one, two and four; these only where the bottom shows relief
    """

    survey: Survey
    relief: Relief
    ranked: Sequence[Crossed]


def stated_relief(given: tuple[float, float] | None) -> Relief:
    """Relief of an sd and a correlation length [m]; None = `USUAL_RELIEF`.

    Raises
    ------
    InputError : they are no lengths
    """
    if given is None:
        return USUAL_RELIEF
    if not all(0.0 < x < np.inf for x in given):
        raise InputError(f"relief {given[0]:g} {given[1]:g}: sd and length of more than 0 m are expected")
    return Relief(*given, USUAL_RELIEF.noise, np.inf)


def plan_crosslines(
    survey: Survey, config: Config, sensors: SensorRates, relief: Relief, progress: Progress = no_progress
) -> CrosslinePlan:
    """Predict what crosslines after a planned survey would leave of its drift.

    Parameters
    ----------
    survey, relief : as planned, and the bottom there
    config, sensors : what is believed of the vehicle, and how often its sensors measure
    progress : called now and then

    Raises
    ------
    InputError : sensors that show places; lines too short to match
    """
    progress("simulating", 0.0)
    first = _Driven.simulated(survey, NONE, config, sensors, relief)
    if len(first.lines) < len(survey.legs):
        raise InputError(f"{survey.source}: its lines are too short to match")
    return CrosslinePlan(survey, relief, [first.crossed(()), *_ranked(survey, config, sensors, relief, progress)])


def plan_crosslines_after(
    log: Log, config: Config, relief: tuple[float, float] | None = None, progress: Progress = no_progress
) -> CrosslinePlan:
    """Predict what crosslines after a recorded survey would leave of its drift.

    Parameters
    ----------
    log, config : the dive, and what is believed of vehicle and sensors
    relief : of the bottom, for a log without ranges, as `stated_relief` takes it
    progress : called now and then

    Raises
    ------
    InputError : no parallel lines, sensors that show places; relief of a log that shows its own
    """
    dive = smooth(log, _chained(config), "smoothed", progress)
    first, streams = dive.estimates[0], dive.initial.streams
    _refuse_places(log.source, streams)
    if "imu" not in streams:
        raise InputError(f"{log.source}: it has no IMU; crosslines are planned for dives with one")
    track, bottom, there = first.trajectory, bottom_of(log, config, first), stated_relief(relief)
    if bottom is not None and relief is not None:
        raise InputError(f"{log.source}: its ranges show the relief of the bottom; take --relief out")
    if bottom is None:
        lines = _swath(track.time, track.rpy[:, 2], track.p_n[:, :2], planned_swath(config))
    else:
        used = bottom.soundings[bottom.soundings["used"] == 1]
        soundings = (used[names].to_numpy() for names in ("time", ["north", "east"], "depth"))
        lines = lines_of(track.time, track.rpy[:, 2], track.p_n[:, :2], *soundings)
        there = fit_relief(lines)
    survey = Survey.recorded(log.source, lines, track)
    recorded = _Driven(survey, NONE, there, track, drift_of(first, lines), lines, range(len(lines)))
    imu_hz = 1.0 / np.median(np.diff(log.streams["imu"].time))
    ping_hz = 1.0 / np.median(np.diff(track.time))
    sensors = SensorRates(float(np.clip(imu_hz, *IMU_HZ)), float(np.clip(ping_hz, *DVL_HZ)))
    sources = tuple(SENSORS[s].heading_source for s in HEADING_STREAMS if s in streams)
    config = config.with_values(heading={"sources": sources})
    return CrosslinePlan(survey, there, [recorded.crossed(()), *_ranked(survey, config, sensors, there, progress)])


def _chained(config: Config) -> Config:
    """A configuration whose dives have a joint covariance."""
    return config.with_values(graph={"crossovers": False, "solver": "batch"}, chart={"file": None})


def _refuse_places(source: str, streams: Collection[str]) -> None:
    if shown := sorted(PLACES & {*streams}):
        raise InputError(f"{source}: it has {' and '.join(shown)}; crosslines are planned for dead reckoning")


def _ranked(survey: Survey, config: Config, sensors: SensorRates, relief: Relief, progress: Progress) -> list[Crossed]:
    """With the best crosslines, each added to those before as all of them show it, and then driven by themselves."""
    if not relief.shows:
        return []
    progress("simulating", 0.2)
    out, chosen, places = [], list[int](), survey.places
    together = _Driven.simulated(survey, places, config, sensors, relief)
    for done, count in enumerate(COUNTS):
        while len(chosen) < count:
            left = [k for k in range(len(places)) if k not in chosen]
            chosen.append(min(left, key=lambda k: together.crossed([*chosen, k]).sd))
        progress("simulating", 0.4 + 0.2 * done)
        some = places[sorted(chosen)]
        alone = together if count == len(places) else _Driven.simulated(survey, some, config, sensors, relief)
        out.append(alone.crossed(range(count)))
    return out


@dataclass(frozen=True)
class _Driven:
    """A survey that was driven, with or without crosslines.

    Attributes
    ----------
    survey, relief : its lines, and the bottom
    along : of its crosslines
    track, drift : as smoothed
    lines : of the track
    numbers : of each among the lines and crosslines of the survey
    """

    survey: Survey
    along: Array
    relief: Relief
    track: Trajectory
    drift: Drift
    lines: Sequence[Line]
    numbers: Sequence[int]

    @staticmethod
    def simulated(survey: Survey, along: Array, config: Config, sensors: SensorRates, relief: Relief) -> "_Driven":
        path = path_along(survey.route(along), survey.speed, style=STYLE)
        rates = replace(sensors, imu_rate=min(sensors.imu_rate, MOST_IMU_HZ))
        log, config = simulated(path, _chained(config), rates, survey.source)
        initial = initialise(log, config)
        _refuse_places(survey.source, initial.streams)
        estimate = assemble(log, initial).solve()
        track = estimate.trajectory
        swath = _swath(track.time, track.rpy[:, 2], track.p_n[:, :2], survey.swath)
        found = [(x, survey.line_at(float(x.time.mean()), along)) for x in swath]
        lines, numbers = [x for x, number in found if number >= 0], [number for _, number in found if number >= 0]
        return _Driven(survey, along, relief, track, drift_of(estimate, lines), lines, numbers)

    @cached_property
    def crossings(self) -> list[tuple[Crossing, Array]]:
        """All of them, with the information that soundings have on the shift of each, shape (2, 2) [1/m^2]."""
        found = [c for k in range(1, len(self.lines)) for c in crossings_of(self.lines, k, self.drift)]
        return [(c, _worth(self.lines, c, self.relief)) for c in found]

    def crossed(self, some: Collection[int]) -> Crossed:
        """With the crossings of some crosslines, and those of the survey by itself."""
        own = range(len(self.survey.legs))
        driven = {*own, *(len(own) + k for k in some)}
        both = [(c, J) for c, J in self.crossings if {self.numbers[c.line], self.numbers[c.earlier]} <= driven]
        closures = _matched(self.drift, both) if self.relief.shows else []
        left = self.drift.given(closures) if closures else self.drift
        spans = [x.time[[0, -1]] for x, number in zip(self.lines, self.numbers, strict=True) if number in own]
        on = np.any([(begin <= left.time) & (left.time <= end) for begin, end in spans], axis=0)
        place = np.stack([np.interp(left.time[on], self.track.time, x) for x in self.track.p_n[:, :2].T], axis=-1)
        rows, along = np.repeat(on, 2), self.along[[*some]] if len(some) else NONE
        more = self.survey.route(along).time(self.survey.speed) - self.survey.route(NONE).time(self.survey.speed)
        return Crossed(along, more, len(closures), *_sds(left.P[np.ix_(rows, rows)], place))


def _swath(time: Array, heading: Array, position: Array, across: Array) -> list[Line]:
    """Lines of a track whose soundings are at some places to starboard, shape (s,) [m]."""
    t = np.arange(time[0], time[-1], 0.5)
    north, east, psi = (np.interp(t, time, x) for x in (*position.T, np.unwrap(heading)))
    off = np.stack([-np.outer(np.sin(psi), across), np.outer(np.cos(psi), across)], axis=-1)
    place = (np.stack([north, east], axis=-1)[:, None] + off).reshape(-1, 2)
    return lines_of(time, heading, position, np.repeat(t, len(across)), place, np.zeros(len(place)))


def _worth(lines: Sequence[Line], crossing: Crossing, relief: Relief) -> Array:
    """Information of a crossing's soundings on its shift, shape (2, 2) [1/m^2]."""
    field = field_at(lines, crossing, np.zeros(2), BESIDE_M, relief, None)
    assert isinstance(field, Field)
    return field.expected_information()


def _matched(drift: Drift, crossings: Sequence[tuple[Crossing, Array]]) -> list[LoopClosure]:
    """Loop closures of the crossings that come within the range of the search, in the order in which they do."""
    if len(crossings) < ENOUGH:
        return []
    ends = [c.times for c, _ in crossings]
    H = drift.between(ends)
    P, mean = H @ drift.P @ H.T + np.diag(drift.beams(ends)), np.zeros(len(H))
    left, closures = [*range(len(crossings))], list[LoopClosure]()
    while left:
        reach = [SIGMAS * float(np.sqrt(np.linalg.eigvalsh(P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2])[-1])) for k in left]
        k = left.pop(int(np.argmin(reach)))
        if min(reach) > FARTHEST_M:
            break
        crossing, J = crossings[k]
        P = condition(mean, P, np.eye(2, len(H), 2 * k), J, np.zeros(2))[1]
        closures.append(LoopClosure(crossing.times, J, np.zeros(2)))
    return closures if len(closures) >= ENOUGH else []


def _sds(P: Array, place: Array) -> tuple[float, float]:
    """Horizontal, rms over m places with a joint covariance, and without shift, rotation and scale of all [m]."""
    x = place - place.mean(axis=0)
    turned = np.stack([-x[:, 1], x[:, 0]], axis=-1)
    Q = np.linalg.qr(np.column_stack([np.tile(np.eye(2), (len(x), 1)), x.ravel(), turned.ravel()]))[0]
    whole, common = np.trace(P), np.trace(Q.T @ P @ Q)
    return float(np.sqrt(whole / len(x))), float(np.sqrt(max(whole - common, 0.0) / len(x)))
