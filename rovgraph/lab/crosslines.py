"""Predicts by how much crosslines would reduce the drift of a survey: the work of ``rovgraph observe --crosslines``.

The lines of a recorded dive and crosslines after them are simulated without noise, with the sensors of the dive, as
manoeuvres are in `rovgraph.lab.plan`. The joint covariance of that track is conditioned on its crossings
(`rovgraph.inference.crossovers`). Each is worth the Fisher information that soundings of the bottom's relief have on
its shift, and is taken as matched if its shift is predicted within the range of the search, the best predicted next.
"""

from collections.abc import Sequence
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
    Drift,
    Field,
    LoopClosure,
    condition,
    crossings_of,
    drift_of,
    field_at,
)
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.initialise import initialise
from rovgraph.inference.relief import CELL_M, Line, Relief, fit_relief, lines_of
from rovgraph.inference.smoother import assemble
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.plan import DVL_HZ, IMU_HZ
from rovgraph.log import Log
from rovgraph.model.calibration import ACOUSTICS
from rovgraph.model.config import AS_WRITTEN, Config
from rovgraph.process import Progress, no_progress
from rovgraph.sensors import SENSORS
from rovgraph.sensors.instruments import HEADING_STREAMS
from rovgraph.simulate import CALM, Path, Style, Truth, simulate
from rovgraph.simulate.path import Route, path_along, timetable

COUNTS = (1, 2, 4)  # crosslines
USUAL_RELIEF = Relief(0.35, 4.5, 0.15, np.inf)  # of a log without ranges: 1 m over 20 m, by a DVL 10 m above it
OVER_M = 10.0  # that a crossline begins before the first line and ends behind the last
ALONG = np.cos(np.pi / 6.0)  # of a line's course with that of the survey
MOST_IMU_HZ = 50.0  # simulated; more tell no more of the drift
STYLE = Style(smoothing=4.0, turning=4.0, waves=CALM)  # of the simulated dive: its turns take some 15 s
DEPTH_M = 5.0
PLACES = ("fix", "place", *ACOUSTICS)  # sensors that show places


@dataclass(frozen=True)
class Crossed:
    """A survey with some crosslines.

    Attributes
    ----------
    along : ndarray, shape (k,), where they cross, along the lines from `CrosslinePlan.corner` [m]
    ends : ndarray, shape (k, 2, 2), their ends, north and east [m]
    crossings : that are matched
    sd : horizontal, rms over the survey's lines [m]
    shape_sd : what of it is no shift, rotation or scale of the whole
    """

    along: Array
    ends: Array
    crossings: int
    sd: float
    shape_sd: float


@dataclass(frozen=True)
class CrosslinePlan:
    """What crosslines would show of a survey's drift.

    Attributes
    ----------
    lines, length : parallel ones, and of all of them together [m]
    course : of its lines [rad]
    corner : ndarray, shape (2,), where they begin, north and east [m]
    relief : of the bottom
    ranked : the dive as recorded, then with the best one, two and four; these only where the bottom shows relief
    """

    lines: int
    length: float
    course: float
    corner: Array
    relief: Relief
    ranked: Sequence[Crossed]


def plan_crosslines(
    log: Log, config: Config, relief: tuple[float, float] | None = None, progress: Progress = no_progress
) -> CrosslinePlan:
    """Predict what crosslines after a dive would show of its drift.

    Parameters
    ----------
    log, config : the dive, and what is believed of vehicle and sensors
    relief : sd and correlation length of the bottom's relief, for a log without ranges [m]; None = `USUAL_RELIEF`
    progress : called now and then

    Raises
    ------
    InputError : the dive has no parallel lines, or sensors that show places; relief of a log that shows its own
    """
    config = config.with_values(graph={"crossovers": False}, chart={"file": None})
    dive = smooth(log, config, "smoothed", progress)
    first = dive.estimates[0]
    shown = sorted({*PLACES} & {*dive.initial.streams})
    if shown or first.posterior is None:
        raise InputError(f"{log.source}: crosslines are planned for dives without {' and '.join(shown) or 'places'}")
    lines, relief_there = _lines_and_relief(log, config, first, relief)
    grid = _Grid.of(log.source, lines)
    drift, none = drift_of(first, lines), [None] * len(lines)
    recorded = _Driven(drift, lines, none, first.trajectory, relief_there).crossed([])
    ranked = [recorded]
    if relief_there.shows:
        sources = tuple(SENSORS[s].heading_source for s in HEADING_STREAMS if s in dive.initial.streams)
        imu = log.streams.get("imu")
        imu_hz = MOST_IMU_HZ if imu is None else float(1.0 / np.median(np.diff(imu.time)))
        rates = imu_hz, float(1.0 / np.median(np.diff(first.posterior.time)))
        ranked += _ranked(grid, config.with_values(heading={"sources": sources}), rates, relief_there, progress)
    return CrosslinePlan(grid.parallel, grid.length, grid.course, grid.corner, relief_there, ranked)


def _lines_and_relief(
    log: Log, config: Config, estimate: Estimate, given: tuple[float, float] | None
) -> tuple[list[Line], Relief]:
    """Lines of a dive, and the relief that its soundings show, or that is stated where it has none."""
    bottom, track = bottom_of(log, config, estimate), estimate.trajectory
    if bottom is None:
        relief = USUAL_RELIEF if given is None else Relief(*given, USUAL_RELIEF.noise, np.inf)
        return _swath(track.time, track.rpy[:, 2], track.p_n[:, :2], 0.0), relief
    if given is not None:
        raise InputError(f"{log.source}: its ranges show the relief of the bottom; take --relief out")
    used = bottom.soundings[bottom.soundings["used"] == 1]
    soundings = (used[names].to_numpy() for names in ("time", ["north", "east"], "depth"))
    lines = lines_of(track.time, track.rpy[:, 2], track.p_n[:, :2], *soundings)
    return lines, fit_relief(lines)


def _swath(time: Array, heading: Array, position: Array, half_width: float) -> list[Line]:
    """Lines of a track whose soundings fill a swath."""
    t = np.arange(time[0], time[-1], 0.5)
    p, psi = (
        np.stack([np.interp(t, time, axis) for axis in x.T], axis=-1) for x in (position, np.unwrap(heading)[:, None])
    )
    side = np.hstack([-np.sin(psi), np.cos(psi)])
    across = np.arange(-half_width, half_width + 1e-9, CELL_M) if half_width else np.zeros(1)
    place = (p[:, None] + across[:, None] * side[:, None]).reshape(-1, 2)
    return lines_of(time, heading, position, np.repeat(t, len(across)), place, np.zeros(len(place)))


@dataclass(frozen=True)
class _Grid:
    """Lines of a survey as legs, and crosslines over them.

    Attributes
    ----------
    legs : ndarray, shape (n, 2, 2), ends of its lines in the order of time [m]
    parallel, length : how many of them are parallel, and how long these are together [m]
    corner, course : where the lines begin, and their course [rad]
    crosslines : ndarray, shape (k, 2, 2), as they are driven
    along : ndarray, shape (k,), where each crosses, along the lines from the corner [m]
    speed, half_width : of its lines and their swath [m/s, m]
    """

    legs: Array
    parallel: int
    length: float
    corner: Array
    course: float
    crosslines: Array
    along: Array
    speed: float
    half_width: float

    @staticmethod
    def of(source: str, lines: Sequence[Line]) -> "_Grid":
        legs = np.array([line.centre[1][[0, -1]] for line in lines]).reshape(-1, 2, 2)
        way = (legs[:, 1] - legs[:, 0]) @ (1.0, 1j)
        course = float(np.angle((way**2 / np.maximum(np.abs(way), 1e-9)).sum()) / 2.0)
        u = np.array([np.cos(course), np.sin(course)])
        v = np.array([-u[1], u[0]])
        parallel = np.abs(way * np.exp(-1j * course)).clip(1e-9)
        own = np.abs((way * np.exp(-1j * course)).real) > ALONG * parallel
        if own.sum() < ENOUGH:
            raise InputError(f"{source}: a survey of {ENOUGH} parallel lines or more is needed, found {int(own.sum())}")
        x, y = legs[own] @ u, legs[own] @ v
        (low, high), (left, right) = (x.min(), x.max()), (y.min() - OVER_M, y.max() + OVER_M)
        along = (np.arange(max(COUNTS)) + 0.5) / max(COUNTS) * (high - low)
        if np.abs(low + along[-1] - legs[-1, 1] @ u) < np.abs(low + along[0] - legs[-1, 1] @ u):
            along = along[::-1]
        sides = [left, right] if np.abs(legs[-1, 1] @ v - left) < np.abs(legs[-1, 1] @ v - right) else [right, left]
        ends = [[(low + a) * u + s * v for s in (sides if k % 2 == 0 else sides[::-1])] for k, a in enumerate(along)]
        lengths = np.linalg.norm(legs[:, 1] - legs[:, 0], axis=1)
        speed = float(np.median([n / np.ptp(line.centre[0]) for n, line in zip(lengths, lines, strict=True)]))
        half_width = float(np.median([line.centre[2] for line in lines]))
        return _Grid(
            legs,
            int(own.sum()),
            float(lengths[own].sum()),
            low * u + (left + OVER_M) * v,
            course,
            np.array(ends),
            along,
            speed,
            half_width,
        )

    @property
    def route(self) -> Route:
        """All of it."""
        points = np.vstack([self.legs.reshape(-1, 2), self.crosslines.reshape(-1, 2)])
        return Route.of(np.column_stack([points, np.full(len(points), DEPTH_M)]))

    def path(self) -> Path:
        """All of it, in calm water."""
        duration = float(np.ceil(self.route.time(self.speed))) + STYLE.rest + 2.0 * STYLE.lead
        return path_along(self.route, self.speed, duration, STYLE)

    def crossline_at(self, time: float) -> int | None:
        """The number of the crossline that is driven at a time; None = a line of the survey, or a way between."""
        begin, end = timetable(self.route, self.speed)[0].reshape(-1, 2).T + STYLE.rest + STYLE.lead
        on = np.flatnonzero((begin <= time) & (time <= end))
        k, way = divmod(int(on[0]) - 2 * len(self.legs), 2) if len(on) else (-1, 0)
        return k if k >= 0 and not way else None


def _simulated(grid: _Grid, config: Config, imu_hz: float, ping_hz: float) -> Estimate:
    """The survey with all crosslines, smoothed."""
    first = grid.legs[0]
    start: dict[str, object] = {"north_m": float(first[0, 0]), "east_m": float(first[0, 1])}
    if config.start.heading_deg is not None:
        start["heading_deg"] = float(np.rad2deg(np.arctan2(*(first[1] - first[0])[::-1])))
    config = config.model_copy(update={**AS_WRITTEN, "delay_s": {}}).with_values(start=start)
    truth = Truth(
        config, noise=False, imu_rate=float(np.clip(imu_hz, IMU_HZ[0], MOST_IMU_HZ)),
        dvl_rate=float(np.clip(ping_hz, *DVL_HZ)),
    )  # fmt: skip
    frame = simulate(grid.path(), truth, np.random.default_rng(0)).log_frame
    log = Log.from_frame(frame, source="crosslines")
    return assemble(log, initialise(log, config)).solve()


def _ranked(
    grid: _Grid, config: Config, rates: tuple[float, float], relief: Relief, progress: Progress
) -> list[Crossed]:
    """With the best crosslines, each added to those before as all of them show it, and then driven by themselves."""
    out, chosen = [], list[int]()
    progress("simulating", 0.2)
    together = _Driven.of(grid, _simulated(grid, config, *rates), relief)
    for done, count in enumerate(COUNTS):
        while len(chosen) < count:
            left = [k for k in range(len(grid.along)) if k not in chosen]
            chosen.append(min(left, key=lambda k: together.crossed([*chosen, k]).sd))
        progress("simulating", 0.4 + 0.2 * done)
        some = sorted(chosen)
        if count < len(grid.along):
            alone = replace(grid, crosslines=grid.crosslines[some], along=grid.along[some])
            out.append(_Driven.of(alone, _simulated(alone, config, *rates), relief).crossed(range(count)))
        else:
            out.append(together.crossed(some))
    return out


@dataclass(frozen=True)
class _Driven:
    """A survey that was driven, with or without crosslines.

    Attributes
    ----------
    drift, lines : of its track
    crosslines : number of the crossline that each line is, or None
    track : of it
    relief : of the bottom
    grid : of the crosslines; None = without
    """

    drift: Drift
    lines: Sequence[Line]
    crosslines: Sequence[int | None]
    track: Trajectory
    relief: Relief
    grid: _Grid | None = None

    @staticmethod
    def of(grid: _Grid, estimate: Estimate, relief: Relief) -> "_Driven":
        track = estimate.trajectory
        lines = _swath(track.time, track.rpy[:, 2], track.p_n[:, :2], grid.half_width)
        which = [grid.crossline_at(float(line.time.mean())) for line in lines]
        return _Driven(drift_of(estimate, lines), lines, which, track, relief, grid)

    @cached_property
    def crossings(self) -> list[tuple[Crossing, Array]]:
        """All of them, with the information that soundings have on the shift of each, shape (2, 2) [1/m^2]."""
        found = [c for k in range(1, len(self.lines)) for c in crossings_of(self.lines, k, self.drift)]
        return [(c, _worth(self.lines, c, self.relief)) for c in found]

    def crossed(self, some: Sequence[int]) -> Crossed:
        """With the crossings of some crosslines, and those of the survey by itself."""
        driven = {None, *some}
        both = [(c, J) for c, J in self.crossings if {self.crosslines[c.line], self.crosslines[c.earlier]} <= driven]
        closures = _matched(self.drift, both) if self.relief.shows else []
        left = self.drift.given(closures) if closures else self.drift
        own = np.zeros(len(left.time), bool)
        for line in (x for x, k in zip(self.lines, self.crosslines, strict=True) if k is None):
            own |= (left.time >= line.time[0]) & (left.time <= line.time[-1])
        place = np.stack([np.interp(left.time[own], self.track.time, x) for x in self.track.p_n[:, :2].T], axis=-1)
        rows = np.repeat(own, 2)
        P, grid, order = left.P[np.ix_(rows, rows)], self.grid, list(some)
        if grid is None or not order:
            return Crossed(np.empty(0), np.empty((0, 2, 2)), len(closures), *_sds(P, place))
        order.sort(key=lambda k: float(grid.along[k]))
        return Crossed(grid.along[order], grid.crosslines[order], len(closures), *_sds(P, place))


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
