"""Dives to simulate, by name.

A scenario is a function of duration and speed (either may be None for its default) and a
`Style`; it returns a `Path` that begins at north = east = 0.
"""

import difflib
from collections.abc import Callable, Sequence

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.model.thesis import END_N
from rovgraph.simulate.path import Path, Route, Style, moving_time, path_along

Scenario = Callable[[float | None, float | None, Style], Path]
FASTEST = 20.0  # [m/s]
# The thesis's route: its end is that of (4.3), bends and depths on the way are a choice
VATTERN = [(0, 0, 5), (8, 2, 5), (17, -6, 6), (18, -17, 7), (28, -21, 7), (34, -31, 6), (*END_N, 6)]


def scenario(name: str, duration: float | None = None, speed: float | None = None, style: Style | None = None) -> Path:
    """The path of a scenario.

    Parameters
    ----------
    name : key of `SCENARIOS`
    duration : [s], None = the scenario's own
    speed : [m/s], None = the scenario's own

    Raises
    ------
    InputError : no such scenario; a duration or speed that cannot be
    """
    if name not in SCENARIOS:
        near = difflib.get_close_matches(name, SCENARIOS, 1)
        hint = f", did you mean {near[0]}?" if near else ""
        raise InputError(f"unknown scenario {name!r}{hint} (known: {', '.join(sorted(SCENARIOS))})")
    if speed is not None and not 0.0 < speed <= FASTEST:
        raise InputError(f"speed of {speed} m/s: more than 0 and at most {FASTEST} is expected")
    return SCENARIOS[name](duration, speed, style or Style())


def _endless(route: Route, default_speed: float, default_duration: float = 480.0) -> Scenario:
    """A closed route, repeated until the time is over."""

    def make(duration: float | None, speed: float | None, style: Style) -> Path:
        duration = default_duration if duration is None else duration
        speed = default_speed if speed is None else speed
        rounds = int(np.ceil(moving_time(duration, style) / route.time(speed)))
        return path_along(route.repeated(rounds), speed, duration, style)

    return make


def _once(route: Route, default_speed: float) -> Scenario:
    """A route that is followed to its end; without a speed, at the speed that takes the time given."""

    def make(duration: float | None, speed: float | None, style: Style) -> Path:
        if duration is None:
            return path_along(route, speed or default_speed, style=style)
        moving = moving_time(duration, style) - route.pause[1:].sum()
        length = (route.lengths / route.pace).sum()  # [m], a slow leg counts for more
        if moving <= 0 or (speed is not None and length / speed > moving + 1e-9):
            raise InputError(
                f"duration of {duration} s is too short to reach the end of the route: "
                f"{np.ceil(route.time(speed or default_speed) + style.still):.0f} s at {speed or default_speed} m/s"
            )
        return path_along(route, speed or length / moving, duration, style)

    return make


def _straight(duration: float | None, speed: float | None, style: Style) -> Path:
    """North, at constant speed until the time is over."""
    duration, speed = 120.0 if duration is None else duration, 0.4 if speed is None else speed
    length = speed * moving_time(duration, style)
    return path_along(Route.of([(0, 0, 5), (length, 0, 5)]), speed, duration, style)


def _ring(radius: float, sign: float) -> Array:
    """Points of a circle that leaves the origin northwards, to starboard for sign +1."""
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    return np.column_stack([radius * np.sin(angle), sign * radius * (1.0 - np.cos(angle)), np.full(73, 5.0)])


def _accelerate_and_stop() -> Route:
    """3 m ahead, a stop, 3 m astern, a stop; the heading stays."""
    return Route.of([(0, 0, 5), (3, 0, 5), (0, 0, 5)], pause=[0, 4, 4], crab=[0.0, -np.pi])


def _spiral() -> Route:
    """Two turns that widen and go down, two that narrow and come up."""
    angle = np.linspace(0.0, 8.0 * np.pi, 289)
    share = 0.5 - 0.5 * np.cos(0.25 * angle)
    radius, depth = 2.0 + 4.0 * share, 4.0 + 4.0 * share
    points = np.column_stack([radius * np.sin(angle), 2.0 - radius * np.cos(angle), depth])
    return Route.of(points)


def lanes(count: int, length: float, apart: float) -> Array:
    """Ends of parallel lanes to and fro, the first one north from the origin; shape (count, 2, 2) [m]."""
    return np.array([[(n, apart * i) for n in ((0.0, length) if i % 2 == 0 else (length, 0.0))] for i in range(count)])


def _lawnmower() -> Route:
    """Six lanes of 25 m, 4 m apart, and back to the beginning."""
    return Route.level(np.vstack([lanes(6, 25.0, 4.0).reshape(-1, 2), np.zeros(2)]), 8.0)


def _falcon() -> Route:
    """An inspection: out, round a structure at two depths, sideways along a wall, stops, back."""
    rows = [
        # north, east, down, pace and crab [deg] of the leg that ends here, pause [s]
        (0, 0, 4, 1, 0, 0),
        (9, 1, 4, 1, 0, 0),
        (12, 8, 5, 1, 0, 4),
        (4, 13, 7, 1.1, 0, 0),
        (-5, 9, 7, 1.1, 0, 0),
        (-7, 0, 7, 0.9, 0, 5),
        (-7, 0, 9, 0.6, 0, 0),
        (0, -6, 9, 1, 0, 0),
        (8, -7, 9, 1, 90, 5),
        (8, 0, 9, 0.8, 90, 4),
        (3, 2, 8, 1, 0, 0),
        (7, 3, 8, 1, 0, 0),
        (16, 6, 6, 1.2, 0, 5),
        (15, -5, 6, 1, -30, 0),
        (5, -11, 6, 1, -30, 5),
        (-4, -5, 5, 1.1, 0, 0),
        (-3, 4, 5, 1, 0, 0),
        (3, 3, 4, 0.8, 0, 0),
        (0, 0, 4, 1, 0, 10),
    ]
    table = np.array(rows, float)
    return Route.of(table[:, :3], table[1:, 3], table[:, 5], np.deg2rad(table[1:, 4]))


def _vattern() -> Route:
    """From the origin to the thesis's end point."""
    return Route.of(VATTERN)


def _turning(turns: float) -> Scenario:
    """At one place: turns to starboard, and as many back."""

    def make(duration: float | None, speed: float | None, style: Style) -> Path:
        duration = 480.0 if duration is None else duration
        steps = np.append(np.arange(9), np.arange(7, -1, -1))
        place, stay = np.tile([0.0, 0.0, MANOEUVRE_DEPTH_M], (len(steps) + 1, 1)), moving_time(duration, style)
        route = Route.of(place, pause=stay / (len(steps) - 1), crab=0.25 * np.pi * turns * steps)
        return path_along(route, 1.0, duration, style)

    return make


def _above(points: Sequence[tuple[float, float]], pause: float = 0.0) -> Route:
    """From the middle along points, north and east in units of the manoeuvres' radius, and back."""
    there = [(0.0, 0.0), *points, (0.0, 0.0)]
    size = MANOEUVRE_RADIUS_M
    return Route.of([(size * north, size * east, MANOEUVRE_DEPTH_M) for north, east in there], pause=pause)


def _round() -> Route:
    """Out to a circle, once round, and back."""
    angle = np.linspace(0.0, 2.0 * np.pi, 73)
    return _above([(float(np.cos(a)), float(np.sin(a))) for a in angle])


# What survey crews do above a beacon, or around it, to calibrate an acoustic system. Two lines through the middle, in
# both senses, pass the cardinal points on reciprocal headings; four sides and two diagonals are the box of six lines.
MANOEUVRE_DEPTH_M, MANOEUVRE_RADIUS_M = 50.0, 25.0
MANOEUVRES = ("spin", "cardinal", "box", "round")
_CARDINAL = _above([(1, 0), (-1, 0), (0, 0), (0, 1), (0, -1)], pause=10.0)
_BOX = _above([(1, 1), (-1, 1), (-1, -1), (1, -1), (1, 1), (-1, -1), (-1, 1), (1, -1)])

SCENARIOS: dict[str, Scenario] = {
    "falcon": _endless(_falcon(), 0.35),
    "lawnmower": _endless(_lawnmower(), 0.4),
    "square": _endless(Route.of([(0, 0, 5), (10, 0, 5), (10, 10, 5), (0, 10, 5), (0, 0, 5)]), 0.4),
    "circle": _endless(Route.of(_ring(5.0, 1.0)), 0.4),
    "figure8": _endless(Route.of(np.vstack([_ring(5.0, 1.0), _ring(5.0, -1.0)[1:]])), 0.4),
    "straight": _straight,
    "accelerate-and-stop": _endless(_accelerate_and_stop(), 0.4),
    "spiral": _endless(_spiral(), 0.4),
    "vattern": _once(_vattern(), 0.3),
    "hold": _turning(0.0),
    "spin": _turning(1.0),
    "cardinal": _once(_CARDINAL, 0.4),
    "box": _once(_BOX, 0.4),
    "round": _once(_round(), 0.4),
}
