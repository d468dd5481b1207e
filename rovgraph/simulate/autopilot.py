"""Pilots: from where the vehicle is to the signals of its thrusters.

A pilot wants a velocity (surge, sway, heave, yaw rate). `VelocityControl` turns it into
forces: the drag of the wanted velocity, a part proportional to what is missing and its
integral (which finds the current), spread over the thrusters by the pseudo-inverse of their
allocation and turned into signals by the inverse of (2.21). `Autopilot` wants what follows a
route: along the line of sight to a point ahead on the leg (Fossen 2011, Handbook of Marine
Craft Hydrodynamics and Motion Control, 10.3), slower in turns and before a stop, on station
where a route pauses. `Steps` wants nothing on one axis and pushes there with a given force.

Pilots know where the vehicle is: they stand for a person at the camera who sees the cable on
the seabed (1.6), and no estimate of ours takes part. The gains are choices.
"""

from dataclasses import dataclass, field

import numpy as np

from rovgraph.geometry import Array, matrix_from_rpy, wrap_angle
from rovgraph.simulate.driven import CONTROL_S, Craft
from rovgraph.simulate.route import Route, courses
from rovgraph.vehicle import Hydrodynamics

AXES = [0, 1, 2, 5]  # surge, sway, heave, yaw among forces and moments
RESPONSE_S = 0.8  # time in which a missing velocity is made up
INTEGRAL_S = 4.0
INTEGRAL_MAX = 0.4  # [m/s, rad/s]
SLEW = np.array([0.15, 0.15, 0.1, 0.4])  # of what is wanted [m/s^2, rad/s^2]
TURN_GAIN, TURN_MAX = 0.6, 0.4  # yaw rate per heading error [1/s], at most [rad/s]
STATION_GAIN, STATION_MAX = 0.35, 0.2  # velocity per distance from station [1/s], at most [m/s]
AHEAD_M = 2.0  # line of sight: distance of the point that is aimed at
PASSED_M, ARRIVED_M = 0.5, 0.25  # a point is passed, a stop is reached
SLOWEST = 0.25  # part of the speed that is kept in a turn


class VelocityControl:
    """From a wanted velocity to the thrusters' signals.

    Parameters
    ----------
    vehicle : Hydrodynamics, as believed
    """

    def __init__(self, vehicle: Hydrodynamics) -> None:
        self.vehicle = vehicle
        self.inertia = np.append(vehicle.mass, vehicle.inertia[2])
        self.spread = np.linalg.pinv(vehicle.allocation[AXES])
        self.percent = np.linspace(-100.0, 100.0, 401)
        self.thrust = vehicle.thrust(self.percent)
        self.wanted, self.integral = np.zeros(4), np.zeros(4)

    def signals(self, wanted: Array, craft: Craft, push: Array | None = None) -> Array:
        """Signals for the next `CONTROL_S`, shape (m,) [percent], within -100 and 100.

        Parameters
        ----------
        wanted : ndarray, shape (4,), surge, sway, heave [m/s], yaw rate [rad/s]
        craft : Craft
        push : ndarray, shape (4,), force instead of control where it is not NaN [N, N m]
        """
        step = SLEW * CONTROL_S
        self.wanted = self.wanted + np.clip(wanted - self.wanted, -step, step)
        missing = self.wanted - np.append(craft.v_b, craft.w_b[2])
        self.integral = np.clip(self.integral + missing * (CONTROL_S / INTEGRAL_S), -INTEGRAL_MAX, INTEGRAL_MAX)
        rate = np.array([0.0, 0.0, self.wanted[3]])
        drag = np.append(self.vehicle.drag(self.wanted[:3])[0], self.vehicle.turning_drag(rate)[0][2])
        force = self.inertia / RESPONSE_S * (missing + self.integral) - drag
        if push is not None:
            force = np.where(np.isnan(push), force, push)
            self.integral = np.where(np.isnan(push), self.integral, 0.0)
        return np.asarray(np.interp(self.spread @ force, self.thrust, self.percent))


def hold(craft: Craft, point: Array, yaw: float) -> Array:
    """Wanted velocity that keeps to a point and a heading, shape (4,)."""
    away = matrix_from_rpy(craft.rpy).T @ (STATION_GAIN * (point - craft.p_n))
    return np.append(away * min(1.0, STATION_MAX / max(float(np.linalg.norm(away)), 1e-9)), turn_rate(craft, yaw))


def turn_rate(craft: Craft, yaw: float) -> float:
    """Wanted yaw rate towards a heading [rad/s]."""
    return float(np.clip(TURN_GAIN * wrap_angle(yaw - craft.rpy[2]), -TURN_MAX, TURN_MAX))


@dataclass
class Autopilot:
    """Follows a route and stays at its end.

    Attributes
    ----------
    control : VelocityControl
    route : Route
    speed : [m/s]
    rest : on station at the beginning of the route until this time [s]
    arrival : time at which the end was reached [s], None = not yet
    """

    control: VelocityControl
    route: Route
    speed: float
    rest: float
    arrival: float | None = None
    leg: int = 0
    paused_until: float = field(default=-np.inf)

    def __post_init__(self) -> None:
        self.course = courses(self.route.points)

    def __call__(self, craft: Craft) -> Array:
        return self.control.signals(self._wanted(craft), craft)

    def _wanted(self, craft: Craft) -> Array:
        points, last = self.route.points, len(self.course) - 1
        waiting = craft.time < max(self.rest, self.paused_until)
        if not waiting and self.leg <= last and self._reached(craft):
            self.leg += 1
            self.paused_until = craft.time + self.route.pause[self.leg]
            waiting = bool(self.route.pause[self.leg] > 0.0)
            self.arrival = craft.time if self.leg > last else None
        if waiting or self.leg > last:
            leg = min(self.leg, last)
            return hold(craft, points[self.leg], self.course[leg] + self.route.crab[leg])
        return self._along(craft, points[self.leg], points[self.leg + 1])

    def _stops(self) -> bool:
        """The leg ends at a stop."""
        return self.leg == len(self.course) - 1 or self.route.pause[self.leg + 1] > 0.0

    def _reached(self, craft: Craft) -> bool:
        """The end of the leg is passed, or reached if it is a stop."""
        begin, end = self.route.points[self.leg : self.leg + 2]
        if self._stops():
            return bool(np.linalg.norm(craft.p_n - end) < ARRIVED_M)
        return bool((end - craft.p_n) @ (end - begin) < PASSED_M * np.linalg.norm(end - begin))

    def _along(self, craft: Craft, begin: Array, end: Array) -> Array:
        """Wanted velocity that follows a leg."""
        length = float(np.linalg.norm(end - begin))
        u = (end - begin) / length
        ahead = min(float((craft.p_n - begin) @ u) + AHEAD_M, length)
        sight = begin + ahead * u - craft.p_n
        sight /= max(float(np.linalg.norm(sight)), 1e-9)
        level = np.hypot(*u[:2]) > 0.3  # a steep leg has no course of its own
        yaw = (np.arctan2(sight[1], sight[0]) if level else self.course[self.leg]) + self.route.crab[self.leg]
        speed = self.speed * self.route.pace[self.leg]
        if self._stops():
            speed = min(speed, STATION_GAIN * float(np.linalg.norm(end - craft.p_n)))
        speed *= max(SLOWEST, float(np.cos(yaw - craft.rpy[2])))
        return np.append(matrix_from_rpy(craft.rpy).T @ (speed * sight), turn_rate(craft, yaw))


@dataclass
class Steps:
    """Pushes along one axis after the other, forth and back; the others hold heading and depth.

    Attributes
    ----------
    control : VelocityControl
    forces : ndarray, shape (k, 4), one axis of each row is not zero [N, N m]
    station : ndarray, shape (4,), point and yaw that are held until ``rest`` is over
    rest : [s]
    push, pause : duration of a push one way, and between pushes [s]
    """

    control: VelocityControl
    forces: Array
    station: Array
    rest: float
    push: float = 10.0
    pause: float = 5.0

    @property
    def duration(self) -> float:
        """Time it takes in all [s]."""
        return self.rest + len(self.forces) * (2.0 * self.push + self.pause)

    def __call__(self, craft: Craft) -> Array:
        which, since = divmod(craft.time - self.rest, 2.0 * self.push + self.pause)
        if which < 0 or which >= len(self.forces):
            return self.control.signals(hold(craft, self.station[:3], float(self.station[3])), craft)
        level = hold(craft, np.append(craft.p_n[:2], self.station[2]), float(self.station[3]))
        if since >= 2.0 * self.push:
            return self.control.signals(level, craft)
        force = self.forces[int(which)] * (1.0 if since < self.push else -1.0)
        return self.control.signals(level, craft, np.where(force == 0.0, np.nan, force))
