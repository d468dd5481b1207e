"""A route: points to pass, before it becomes a smooth path in time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.geometry import Array


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
