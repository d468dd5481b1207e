"""A path: the smooth motion of the body's origin that a simulated dive follows, and the route that it is made from.

Position and roll, pitch, yaw are quintic splines in time, so that velocity, acceleration,
angular rate and angular acceleration are their exact derivatives. With the Euler angles
(r, p, y) of ``R_nb = Rz(y) Ry(p) Rx(r)`` the angular rate in body axes is

    w_x = r' - y' sin p
    w_y = p' cos r + y' cos p sin r
    w_z = y' cos p cos r - p' sin r

and the angular acceleration its derivative. A route is a list of points to pass, which becomes a path in time.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.kernels.earth import latitude_at, radii, scales


@dataclass(frozen=True)
class Route:
    """Straight legs between m points.

    Attributes
    ----------
    points : ndarray, shape (m, 3), north, east, down [m]
    pace : ndarray, shape (m - 1,), speed on each leg as a multiple of the dive's speed
    pause : ndarray, shape (m,), stay at each point [s]; the vehicle turns meanwhile
    crab : ndarray, shape (m - 1,), yaw minus course on each leg [rad]
    """

    points: Array
    pace: Array
    pause: Array
    crab: Array

    @staticmethod
    def of(points: ArrayLike, pace: ArrayLike = 1.0, pause: ArrayLike = 0.0, crab: ArrayLike = 0.0) -> "Route":
        """A route from anything that broadcasts to the right shapes."""
        p = np.asarray(points, float)
        legs = (len(p) - 1,)
        return Route(
            p,
            np.broadcast_to(np.asarray(pace, float), legs),
            np.broadcast_to(np.asarray(pause, float), (len(p),)),
            np.broadcast_to(np.asarray(crab, float), legs),
        )

    @staticmethod
    def level(points: Array, depth: float) -> "Route":
        """A route at one depth [m] through points of shape (m, 2), north and east [m]."""
        return Route.of(np.column_stack([points, np.full(len(points), depth)]))

    @property
    def lengths(self) -> Array:
        """Length of each leg [m], shape (m - 1,)."""
        return np.asarray(np.linalg.norm(np.diff(self.points, axis=0), axis=1))

    def time(self, speed: float) -> float:
        """Time it takes at a speed, pauses included [s]."""
        return float((self.lengths / self.pace).sum() / speed + self.pause[1:].sum())

    def repeated(self, times: int) -> "Route":
        """The route several times in a row; it has to end where it begins."""
        points = np.vstack([self.points, *[self.points[1:]] * (times - 1)])
        pause = np.concatenate([self.pause, *[self.pause[1:]] * (times - 1)])
        return Route(points, np.tile(self.pace, times), pause, np.tile(self.crab, times))


def courses(points: Array) -> Array:
    """Course of each leg [rad], unwrapped; a vertical leg keeps the course before it.

    Parameters
    ----------
    points : ndarray, shape (m, 3)

    Returns
    -------
    ndarray, shape (m - 1,)
    """
    legs = np.diff(points[:, :2], axis=0)
    known = np.flatnonzero(np.hypot(*legs.T) > 1e-9)
    if not len(known):
        return np.zeros(len(legs))
    last = np.clip(np.searchsorted(known, np.arange(len(legs)), side="right") - 1, 0, None)
    north, east = legs[known[last]].T
    return np.unwrap(np.arctan2(east, north))


def timetable(route: Route, speed: float) -> tuple[Array, Array, Array]:
    """Times, positions and yaw at the beginning and the end of every leg.

    Parameters
    ----------
    route : Route with m points
    speed : [m/s]

    Returns
    -------
    time : ndarray, shape (2 (m - 1),) [s], not decreasing, from 0
    p_n : ndarray, shape (2 (m - 1), 3) [m]
    yaw : ndarray, shape (2 (m - 1),) [rad], unwrapped
    """
    end = np.cumsum(route.lengths / (route.pace * speed) + np.append(0.0, route.pause[1:-1]))
    begin = np.append(0.0, end[:-1] + route.pause[1:-1])
    yaw = courses(route.points) + route.crab
    return (
        np.column_stack([begin, end]).ravel(),
        np.stack([route.points[:-1], route.points[1:]], axis=1).reshape(-1, 3),
        np.repeat(yaw, 2),
    )


GRID_S = 0.1  # spacing of the splines' nodes
TRUNCATE = 5.0  # reach of the smoothing, in its sd


@dataclass(frozen=True)
class Motion:
    """The body's motion at n epochs.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    R_nb : ndarray, shape (n, 3, 3)
    p_n, v_n, a_n : ndarray, shape (n, 3), of the body's origin [m, m/s, m/s^2]
    w_b : ndarray, shape (n, 3), angular rate [rad/s], body axes
    alpha_b : ndarray, shape (n, 3), angular acceleration [rad/s^2], body axes
    """

    time: Array
    R_nb: Array
    p_n: Array
    v_n: Array
    a_n: Array
    w_b: Array
    alpha_b: Array

    def __len__(self) -> int:
        return len(self.time)


@dataclass(frozen=True)
class Waves:
    """Oscillation that waves add to a path.

    Attributes
    ----------
    heave : amplitude [m]
    roll, pitch : amplitude [rad]
    frequency : [Hz]; 0.34 is what the thesis saw in the lake (3.1.4)
    """

    heave: float = 0.015
    roll: float = float(np.deg2rad(0.6))
    pitch: float = float(np.deg2rad(0.4))
    frequency: float = 0.34

    def at(self, time: Array, envelope: Array) -> Array:
        """Heave, roll and pitch, shape (n, 3), under an envelope of shape (n,)."""
        phase = 2.0 * np.pi * self.frequency * time[:, None] + np.array([0.0, 1.0, 2.5])
        amplitude = np.array([self.heave, self.roll, self.pitch])
        return np.asarray(envelope[:, None] * np.sin(phase) * amplitude)


CALM = Waves(0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Thrusters:
    """Drive signals of the thrusters, each held until the next.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    signals : ndarray, shape (n, m) [percent]
    """

    time: Array
    signals: Array


@dataclass(frozen=True)
class Path:
    """Smooth motion of the body's origin from time 0 to ``duration``.

    Attributes
    ----------
    spline : quintic spline of (north, east, down, roll, pitch, yaw) over time
    duration : [s]
    offset_n : ndarray, shape (3,), added to the spline's positions [m]
    thrusters : what drove it, None = nothing did, it is a motion as such
    latitude : of the origin of frame "earth", in which positions are angles at its scale [rad]; NaN = n is flat
    """

    spline: BSpline
    duration: float
    offset_n: Array = field(default_factory=lambda: np.zeros(3))
    thrusters: Thrusters | None = None
    latitude: float = math.nan

    @staticmethod
    def through(time: Array, p_n: Array, rpy: Array, rest: bool = True, thrusters: Thrusters | None = None) -> "Path":
        """The path through given positions and attitudes.

        Parameters
        ----------
        time : ndarray, shape (n,) [s], increasing from 0, n >= 6
        p_n : ndarray, shape (n, 3) [m]
        rpy : ndarray, shape (n, 3) [rad], yaw unwrapped
        rest : it is at rest at both ends; otherwise the ends are like what is next to them
        thrusters : what drove it
        """
        still = [(1, np.zeros(6)), (2, np.zeros(6))]
        ends = (still, still) if rest else None
        spline = make_interp_spline(time, np.hstack([p_n, rpy]), k=5, bc_type=ends)
        return Path(spline, float(time[-1]), thrusters=thrusters)

    def shifted(self, offset_n: ArrayLike) -> "Path":
        """The same path begun elsewhere; ``offset_n`` has shape (3,) [m]."""
        return replace(self, offset_n=self.offset_n + np.asarray(offset_n, float))

    def motion(self, time: ArrayLike) -> Motion:
        """The motion at ``time``, shape (n,), within 0 and ``duration`` [s]."""
        t = np.asarray(time, float)
        x, first, second = (self.spline(t, nu) for nu in range(3))
        rpy = x[:, 3:]
        w_b, alpha_b = body_rates(rpy, first[:, 3:], second[:, 3:])
        p_n, v_n, a_n = x[:, :3] + self.offset_n, first[:, :3], second[:, :3]
        if not math.isnan(self.latitude):
            latitude = latitude_at(self.latitude, p_n[:, 0])
            north, east = scales(self.latitude, latitude, p_n[:, 2])
            v_n = v_n / np.column_stack([north, east, np.ones(len(t))])
            M, N = radii(latitude)
            grows = np.column_stack([v_n[:, 2] / M, v_n[:, 2] / N + v_n[:, 0] * np.tan(latitude) / M, 0.0 * t])
            a_n = a_n / np.column_stack([north, east, np.ones(len(t))]) - grows * v_n
        return Motion(t, matrix_from_rpy(rpy), p_n, v_n, a_n, w_b, alpha_b)


def body_rates(rpy: Array, first: Array, second: Array) -> tuple[Array, Array]:
    """Angular rate and acceleration in body axes from the derivatives of the Euler angles.

    Parameters
    ----------
    rpy, first, second : ndarray, shape (n, 3), roll, pitch, yaw and their derivatives

    Returns
    -------
    w_b, alpha_b : ndarray, shape (n, 3) [rad/s, rad/s^2]
    """
    (sr, sp, _), (cr, cp, _) = np.sin(rpy).T, np.cos(rpy).T
    dr, dp, dy = first.T
    ddr, ddp, ddy = second.T
    w_b = [dr - dy * sp, dp * cr + dy * cp * sr, dy * cp * cr - dp * sr]
    turn = ddy * cp - dy * dp * sp  # derivative of y' cos p
    alpha_b = [
        ddr - ddy * sp - dy * dp * cp,
        ddp * cr - dp * dr * sr + turn * sr + dy * dr * cp * cr,
        turn * cr - dy * dr * cp * sr - ddp * sr - dp * dr * cr,
    ]
    return np.stack(w_b, axis=-1), np.stack(alpha_b, axis=-1)


@dataclass(frozen=True)
class Style:
    """How a vehicle follows a route.

    Attributes
    ----------
    rest : time at rest before it sets off [s]
    smoothing : sd of the Gaussian that rounds corners and ramps the speed [s]
    turning : the same for yaw [s]
    waves : Waves
    """

    rest: float = 10.0
    smoothing: float = 1.2
    turning: float = 2.0
    waves: Waves = Waves()

    @property
    def lead(self) -> float:
        """Time that smoothing needs before and after the motion [s]."""
        return TRUNCATE * max(self.smoothing, self.turning)

    @property
    def still(self) -> float:
        """Time of a dive that is not under way [s]."""
        return self.rest + 2.0 * self.lead


def path_along(route: Route, speed: float, duration: float | None = None, style: Style | None = None) -> Path:
    """The path that follows a route at a speed, and begins and ends at rest.

    A route that is not finished in time is cut short; one finished earlier ends in waiting.

    Parameters
    ----------
    route : Route
    speed : [m/s]
    duration : [s], None = what the route takes

    Raises
    ------
    InputError : too short a duration to move at all
    """
    style = style or Style()
    duration = float(np.ceil(route.time(speed) + style.still)) if duration is None else duration
    moving = moving_time(duration, style)
    nodes, p_n, yaw = timetable(route, speed)
    time = np.linspace(0.0, duration, int(np.ceil(duration / GRID_S)) + 1)
    on_route = np.clip(time - style.rest - style.lead, 0.0, moving)

    def follow(column: Array, sd: float) -> Array:
        return smoothed(np.interp(on_route, nodes, column), sd / (time[1] - time[0]))

    p_n = np.column_stack([follow(c, style.smoothing) for c in p_n.T])
    heave, roll, pitch = style.waves.at(time, _envelope(time, duration, style)).T
    p_n[:, 2] += heave
    return Path.through(time, p_n, np.column_stack([roll, pitch, follow(yaw, style.turning)]))


def smoothed(x: Array, sd: float) -> Array:
    """Convolution with a Gaussian of ``sd`` samples; beyond its ends ``x`` stays constant.

    Parameters
    ----------
    x : ndarray, shape (n,)
    """
    reach = int(np.ceil(TRUNCATE * sd))
    kernel = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sd) ** 2)
    return np.convolve(np.pad(x, reach, mode="edge"), kernel / kernel.sum(), mode="valid")


def moving_time(duration: float, style: Style) -> float:
    """Time under way in a dive of ``duration``: without the rest and the ramps [s]."""
    if not (np.isfinite(duration) and duration > style.still):
        least = style.still + 1.0
        raise InputError(f"duration of {duration} s: at least {least:.0f} s are needed, {style.still:.0f} s go to rest")
    return duration - style.still


def _envelope(time: Array, duration: float, style: Style) -> Array:
    """0 at rest, 1 under way, a smooth step of ``lead`` seconds between."""
    x = np.clip(np.minimum(time - style.rest, duration - time) / style.lead, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x**2))
