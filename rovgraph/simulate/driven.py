"""Dives driven through the thrusters: the world, the pilots, the equations of motion, and scenarios.

`World` draws from a seed what an estimator has no access to: the sea, the vehicle's drag, iron on the seabed and the
field in the lake. It has a pilot drive in it, and gives the true values that sensors measure. docs/simulation.md has
the sources of the figures. The dives of the thesis, and others, are functions from a `World` to its path and truth.

The equations of motion are integrated at 100 Hz. `rovgraph.model.hydrodynamics` states them; here they are repeated in
plain floats, since a step of a hundredth of a second is too short for arrays (a test compares the two). With c the
velocity of the water and v that of the vehicle relative to it, body axes,

    M v' = F + D(v) - w x M v
    J w' = tau + D(w) + r_cb x B - w x J w + M v x v
    p_n' = R_nb v + c_n,   (roll, pitch, yaw)' = E w

integrated by the rule of Adams and Bashforth of second order. Water that accelerates tilts
the pressure, and with it the direction of buoyancy: B = -m (g - c_n').

Pilots compute the thrusters' signals from the vehicle's true state. A pilot has a desired velocity (surge, sway, heave,
yaw rate). `VelocityControl` turns it into forces: the drag of the desired velocity, a part proportional to the velocity
error and its integral (which finds the current), spread over the thrusters by the pseudo-inverse of their allocation
and turned into signals by the inverse of (2.21). `Autopilot` follows a route: along the line of sight to a point ahead
on the leg (Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control, 10.3), slower in turns and before a
stop, on station where a route pauses. `Steps` leaves one axis uncontrolled and pushes there with a given force.

Pilots use the true position: they stand for a person at the camera who sees the cable on the seabed (1.6), and no
estimate takes part. The gains are choices.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import cos, sin

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, wrap_angle
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config, beliefs
from rovgraph.model.hydrodynamics import Hydrodynamics
from rovgraph.model.thesis import FAN_RAD_PER_SAMPLE, SAMPLE_S
from rovgraph.sensors.instruments import hydrodynamics
from rovgraph.simulate.choices import Choices
from rovgraph.simulate.environment import GRAVITY, STILL, Magnetism, Sea, drawn_distortion, drawn_sea, iron_near
from rovgraph.simulate.path import Path, Route, Thrusters, courses
from rovgraph.simulate.scenario import VATTERN
from rovgraph.simulate.truth import THESIS, Truth, Vibration

STEP_S = 0.01  # Ts of (2.26)
CONTROL_S = 0.1  # between two signals
SETTLING_S = 40.0  # driven before the log begins, so that it begins on station
RISE_S = 0.12  # from 10 to 90 percent of a thruster's signal, below (2.22)
LAG_S = RISE_S / 3.36  # time constant of each of two first-order lags that rise so

WILDEST = 50.0  # velocity or angular rate beyond which the integration has failed [m/s, rad/s]

_SUBSTEPS = round(CONTROL_S / STEP_S)
Vector = tuple[float, ...]


@dataclass(frozen=True)
class Craft:
    """Motion of the vehicle as a pilot sees it.

    Attributes
    ----------
    time : [s], negative before the log begins
    p_n : ndarray, shape (3,) [m]
    rpy : ndarray, shape (3,) [rad], yaw unwrapped
    v_b : ndarray, shape (3,), velocity over ground [m/s]
    w_b : ndarray, shape (3,) [rad/s]
    """

    time: float
    p_n: Array
    rpy: Array
    v_b: Array
    w_b: Array


Pilot = Callable[[Craft], Array]  # signals of the thrusters, shape (m,) [percent]


def drive(vehicle: Hydrodynamics, sea: Sea, pilot: Pilot, start: ArrayLike, duration: float) -> Path:
    """The path of a vehicle that a pilot drives.

    Parameters
    ----------
    vehicle : Hydrodynamics, as it truly is
    sea : Sea
    pilot : gives the signals every `CONTROL_S`, from `SETTLING_S` before the log begins
    start : array_like, shape (4,), north, east, down [m] and yaw [rad], at rest
    duration : [s], rounded up to whole `CONTROL_S`

    Returns
    -------
    Path, with the signals of its thrusters

    Raises
    ------
    InputError : the motion leaves all bounds, as with drag too large for the mass
    """
    ticks, settling = int(np.ceil(duration / CONTROL_S - 1e-9)), round(SETTLING_S / CONTROL_S)
    time = CONTROL_S * np.arange(-settling, ticks + 1)
    fine: Array = STEP_S * np.arange(-settling * _SUBSTEPS, (ticks + 1) * _SUBSTEPS, dtype=float)
    water, pull = sea.velocity(fine), np.array([0.0, 0.0, GRAVITY]) - sea.acceleration(fine)
    north, east, down, yaw = (float(x) for x in np.asarray(start, float))
    state: Vector = (*(-water[0]).tolist(), 0.0, 0.0, 0.0, north, east, down, 0.0, 0.0, yaw)
    rates, before = _rates(vehicle), None
    lag = _Lag(len(vehicle.thruster_positions))
    signals, states = [], []
    for k, now in enumerate(time):
        part = slice(k * _SUBSTEPS, (k + 1) * _SUBSTEPS)
        signals.append(np.clip(pilot(_craft(now, state, water[part.start])), -100.0, 100.0))
        force, moment = vehicle.force_and_moment(lag.follow(signals[-1]))
        inputs = zip(force.tolist(), moment.tolist(), water[part].tolist(), pull[part].tolist(), strict=True)
        for F, tau, c, g in inputs:
            states.append(state)
            rate = rates(state, F, tau, c, g)
            before = before or rate
            state = tuple([x + STEP_S * (1.5 * a - 0.5 * b) for x, a, b in zip(state, rate, before, strict=True)])
            before = rate
            if not -WILDEST < min(state[:6]) <= max(state[:6]) < WILDEST:
                raise InputError(
                    f"vehicle: at {now:.1f} s the motion diverges; steps of {STEP_S} s are too long "
                    "for drag, inertia or thrust as large or small as these"
                )
    first, last = settling * _SUBSTEPS, (settling + ticks) * _SUBSTEPS
    motion = np.array(states[first : last + 1])
    thrusters = Thrusters(np.round(time[settling:], 4), np.array(signals[settling:]))
    return Path.through(grid(len(motion)), motion[:, 6:9], motion[:, 9:], rest=False, thrusters=thrusters)


def grid(n: int) -> Array:
    """Times of n steps of the integration, from 0, shape (n,) [s]."""
    return np.asarray(STEP_S * np.arange(n), float)


class _Lag:
    """Two first-order lags in a row between a signal and the thruster's turning."""

    def __init__(self, thrusters: int) -> None:
        self.first, self.second = np.zeros(thrusters), np.zeros(thrusters)
        t = STEP_S * np.arange(_SUBSTEPS + 1)[:, None] / LAG_S
        self.decay, self.ramp = np.exp(-t), t * np.exp(-t)

    def follow(self, signals: Array) -> Array:
        """The delayed signals at the steps until the next signal, shape (steps, m)."""
        first, second = self.first - signals, self.second - signals
        delayed = signals + self.decay * second + self.ramp * first
        self.first, self.second = signals + self.decay[-1] * first, delayed[-1]
        return np.asarray(delayed[:-1])


def _craft(time: float, state: Vector, water_n: Array) -> Craft:
    values = np.array(state)
    v_b = values[:3] + matrix_from_rpy(values[9:]).T @ water_n
    return Craft(float(time), values[6:9], values[9:], v_b, values[3:6])


def _rates(vehicle: Hydrodynamics) -> Callable[[Vector, Vector, Vector, Vector, Vector], Vector]:
    """The right-hand side of the equations of motion for one vehicle, in plain floats.

    It takes velocity relative to the water, angular rate, position, roll, pitch, yaw (12 in
    all), thrust and its moment, velocity of the water and gravity less its acceleration.
    """
    (mx, my, mz), (jx, jy, jz) = vehicle.mass.tolist(), vehicle.inertia.tolist()
    (ax, ay, az), (bx, by, bz) = vehicle.drag_linear.tolist(), vehicle.drag_quadratic.tolist()
    (dx, dy, dz), (ex, ey, ez) = vehicle.turning_drag_linear.tolist(), vehicle.turning_drag_quadratic.tolist()
    lift = vehicle.buoyancy / GRAVITY
    rx, ry, rz = (lift * vehicle.centre_of_buoyancy).tolist()

    def rates(state: Vector, F: Vector, tau: Vector, c: Vector, g: Vector) -> Vector:
        vx, vy, vz, wx, wy, wz, _, _, _, roll, pitch, yaw = state
        sr, cr, sp, cp, sy, cy = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
        px, py, pz = mx * vx, my * vy, mz * vz
        qx, qy, qz = jx * wx, jy * wy, jz * wz
        # R_nb by its rows
        r11, r12, r13 = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
        r21, r22, r23 = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
        r31, r32, r33 = -sp, cp * sr, cp * cr
        gx, gy, gz = (
            r11 * g[0] + r21 * g[1] + r31 * g[2],
            r12 * g[0] + r22 * g[1] + r32 * g[2],
            r13 * g[0] + r23 * g[1] + r33 * g[2],
        )
        turn = (wy * sr + wz * cr) / cp
        return (
            (F[0] - (ax + bx * abs(vx)) * vx - wy * pz + wz * py) / mx,
            (F[1] - (ay + by * abs(vy)) * vy - wz * px + wx * pz) / my,
            (F[2] - (az + bz * abs(vz)) * vz - wx * py + wy * px) / mz,
            (tau[0] - (dx + ex * abs(wx)) * wx - ry * gz + rz * gy - wy * qz + wz * qy + py * vz - pz * vy) / jx,
            (tau[1] - (dy + ey * abs(wy)) * wy - rz * gx + rx * gz - wz * qx + wx * qz + pz * vx - px * vz) / jy,
            (tau[2] - (dz + ez * abs(wz)) * wz - rx * gy + ry * gx - wx * qy + wy * qx + px * vy - py * vx) / jz,
            r11 * vx + r12 * vy + r13 * vz + c[0],
            r21 * vx + r22 * vy + r23 * vz + c[1],
            r31 * vx + r32 * vy + r33 * vz + c[2],
            wx + turn * sp,
            wy * cr - wz * sr,
            turn,
        )

    return rates


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


REST_S = 10.0
DRAG_SD = 0.2  # relative error of the believed drag: a choice
AHRS_RATE, AHRS_MEMORY_S = 10.0, 20.0  # the unit's own attitude errs slowly: a choice


@dataclass(frozen=True)
class World:
    """A dive's surroundings and its vehicle.

    Attributes
    ----------
    config : what is believed; mountings and places are taken as exact
    choices : Choices
    seed : of the dive
    rng : numpy Generator of the world, apart from that of the sensors
    drag : relative error of the believed drag, by calibration variable, shape (3,) each
    """

    config: Config
    choices: Choices
    seed: int
    rng: np.random.Generator
    drag: dict[str, Array]

    @staticmethod
    def drawn(config: Config, choices: Choices, seed: int) -> "World":
        """The world of a seed."""
        rng = np.random.default_rng([seed, 1])
        drag = {}
        for name in ("drag_linear", "drag_quadratic"):
            error = DRAG_SD * rng.standard_normal(3).clip(-3.0, 3.0)
            drag[name] = error if choices.noise else np.zeros(3)
        return World(config, choices, seed, rng, drag)

    @property
    def believed(self) -> Hydrodynamics:
        """The vehicle that pilots and estimators believe in."""
        return hydrodynamics(self.config)

    @property
    def vehicle(self) -> Hydrodynamics:
        """The vehicle as it is."""
        vehicle = self.believed
        return replace(
            vehicle,
            drag_linear=vehicle.drag_linear * (1.0 + self.drag["drag_linear"]),
            drag_quadratic=vehicle.drag_quadratic * (1.0 + self.drag["drag_quadratic"]),
        )

    def along(self, route: Route, speed: float, sea: Sea, duration: float, yaw: float | None = None) -> Path:
        """The path of the autopilot along a route.

        Parameters
        ----------
        route : Route
        speed : [m/s]
        sea : Sea
        duration : [s]
        yaw : heading at the beginning [rad], None = along the route

        Raises
        ------
        InputError : the end is not reached in time
        """
        pilot = Autopilot(VelocityControl(self.believed), route, speed, REST_S)
        yaw = float((courses(route.points) + route.crab)[0]) if yaw is None else yaw
        path = drive(self.vehicle, sea, pilot, [*route.points[0], yaw], duration)
        if pilot.arrival is None:
            raise InputError(f"duration of {duration:g} s at {speed:.2f} m/s: the end of the route is not reached")
        return path.shifted(route.points[0] - path.motion([0.0]).p_n[0])

    def truth(self, path: Path, sea: Sea, lake: bool) -> Truth:
        """What the thesis's sensors obey here; in a lake among iron, and in another field than the tank's."""
        belief = beliefs(self.config)
        calibration = {name: belief[name].mean for name in ("dvl_roll", "dvl_pitch", "dvl_yaw")}
        calibration |= self.drag | {"current": sea.current_n[:2]}
        for name in ("field_dip", "field_scale"):
            error = TABLE[name].sd * self.rng.standard_normal(1)
            calibration[name] = error if lake and self.choices.noise else np.zeros(1)
        disturbed = lake if self.choices.disturbances is None else self.choices.disturbances
        return Truth(
            self.config,
            calibration=calibration,
            noise=self.choices.noise,
            start_error=lake and self.choices.noise,
            ahrs_rate=AHRS_RATE,
            ahrs_memory=AHRS_MEMORY_S,
            covariances=THESIS,
            magnetism=Magnetism(iron_near(path, self.config, self.rng)) if disturbed else Magnetism(),
            outlier_share=self.choices.outliers,
            dropouts=self.choices.dropouts,
            profiles=self.choices.profiles,
            places=self.choices.places,
            false_places=self.choices.false_places,
        )


RIPPLES_M = 0.005  # amplitude of the waves in the tank: a choice
FAN_MPS2 = 0.004  # amplitude of the fan's line: a choice, clear of the white noise around it
LONGEST_S = 3600.0  # of a dive that is driven: its steps are held in memory

# of the steps of thrust, surge, sway, heave [m/s], yaw [rad/s]: a choice
EXCITED_SPEEDS = ((0.3, 0.6, 0.9), (0.3, 0.6, 0.9), (0.1, 0.25, 0.4), (0.2, 0.4, 0.6))

Made = tuple[Path, Truth]


@dataclass(frozen=True)
class Driven:
    """A scenario.

    Attributes
    ----------
    make : from a world to a path and what its sensors obey
    choices : names of the choices it has
    variants : that it has, the first is the default unless ``about`` states another
    about : one line for people
    """

    make: Callable[[World], Made]
    choices: frozenset[str]
    variants: tuple[str, ...]
    about: str


@dataclass(frozen=True)
class ThesisRun:
    """One of the thesis's three runs: how fast, and how long it stays at the landmarks."""

    speed: float
    duration: float
    pace: tuple[float, ...]
    pause: tuple[float, ...]


# Durations and the highest speed, 0.6 m/s, are the thesis's (4.3); how they came about is a choice.
RUNS = {
    "1": ThesisRun(0.35, 250.0, (1, 1, 1, 1, 1, 1), (0, 0, 0, 0, 0, 0, 0)),
    "2": ThesisRun(0.35, 250.0, (1, 1.7, 1, 0.8, 1.7, 0.8), (0, 0, 15, 0, 15, 0, 0)),
    "3": ThesisRun(0.2, 500.0, (1, 1.5, 1, 0.7, 1, 1), (0, 20, 20, 0, 20, 20, 0)),
}


def _vattern(world: World) -> Made:
    """The thesis's route; which of the three runs comes with the seed."""
    choices = world.choices
    run = RUNS[choices.variant or str(world.seed % len(RUNS) + 1)]
    route = Route.of(VATTERN, run.pace, run.pause)
    return _followed(world, route, run.speed, run.duration)


def _docking(world: World) -> Made:
    """From a distance to a point before the dock, and slowly in."""
    route = Route.of(
        [(0, 0, 5), (10, 3, 6), (20, 9, 8), (25, 14, 9.2), (26.6, 15.6, 9.2), (27, 16, 9.2)],
        pace=[1, 1, 0.8, 0.4, 0.2],
        pause=[0, 0, 0, 15, 0, 0],
    )
    return _followed(world, route, 0.4, 200.0)


def _followed(world: World, route: Route, speed: float, duration: float) -> Made:
    """A route through the lake; another speed than its own changes its duration, and the other way round."""
    chosen = world.choices
    if chosen.speed is not None and not 0.0 < chosen.speed <= 1.0:
        raise InputError(f"speed of {chosen.speed} m/s: more than 0 and at most 1 is expected of these thrusters")
    moving = duration - REST_S - route.pause.sum()
    if chosen.speed is not None:
        moving, speed = moving * speed / chosen.speed, chosen.speed
        duration = _duration(float(np.ceil(moving + REST_S + route.pause.sum())), duration)
    if chosen.duration is not None:
        left = _duration(chosen.duration, duration) - REST_S - route.pause.sum()
        if left <= 0.0:
            raise InputError(f"duration of {chosen.duration:g} s: {duration - moving:g} s go to rest and stops alone")
        speed, duration = speed if chosen.speed is not None else speed * moving / left, chosen.duration
    sea = drawn_sea(world.rng, float(route.points[:, 2].mean()), chosen.current)
    path = world.along(route, speed, sea, float(duration))
    return path, world.truth(path, sea, lake=True)


def _excited(world: World) -> Made:
    """Steps of thrust in surge, sway, heave and yaw, each forth and back, at three speeds each.

    The highest are about half of what the thrusters give: only there does quadratic drag stand
    out from linear drag, in sway most of all.
    """
    vehicle, station = world.believed, np.array([0.0, 0.0, 8.0, 0.0])
    forces = []
    for axis, speeds in enumerate(EXCITED_SPEEDS):
        for speed in speeds:
            motion = np.zeros(6)
            motion[AXES[axis]] = speed
            drag = np.append(vehicle.drag(motion[:3])[0], vehicle.turning_drag(motion[3:])[0])
            forces.append(-drag[AXES] * (np.arange(4) == axis))
    pilot = Steps(VelocityControl(vehicle), np.array(forces), station, REST_S)
    sea = drawn_sea(world.rng, float(station[2]), world.choices.current)
    path = drive(world.vehicle, sea, pilot, station, pilot.duration)
    path = path.shifted(station[:3] - path.motion([0.0]).p_n[0])
    return path, world.truth(path, sea, lake=True)


def _tank(world: World) -> Made:
    """Turned about z and then about x in a crane, then a lap of the tank; the samples of the field are raw."""
    turns_z, turns_x, pace_s, pause_s = 1.5, 2, 40.0, 5.0
    ends = np.cumsum([REST_S, turns_z * pace_s, pause_s, turns_x * pace_s, pause_s])
    time = grid(round(ends[-1] / STEP_S))
    yaw = 2.0 * np.pi * turns_z * _eased((time - ends[0]) / (turns_z * pace_s))
    roll = 2.0 * np.pi * turns_x * _eased((time - ends[2]) / (turns_x * pace_s))
    corners = np.array([(0, 0, 1.5), (-4, 0, 1.5), (-4, 3, 1.5), (0, 3, 1.5), (0, 0, 1.5)])
    speed = 0.2 if world.choices.speed is None else world.choices.speed
    if not 0.0 < speed <= 0.5:
        raise InputError(f"speed of {speed} m/s: more than 0 and at most 0.5 is expected in a tank of 4 by 3 m")
    route = Route.of(corners)
    duration = float(np.ceil(1.3 * route.time(speed) + 2.0 * REST_S + 25.0))
    lap = world.along(route, speed, STILL, duration, yaw=float(yaw[-1]))
    path = _joined(time, np.tile(corners[0], (len(time), 1)), np.column_stack([roll, 0.0 * time, yaw]), lap)
    truth = world.truth(path, STILL, lake=False)
    if world.choices.variant != "calibrated" and world.choices.noise:
        truth = replace(truth, magnetism=replace(truth.magnetism, distortion=drawn_distortion(world.rng)))
    upside_down = (float(ends[2]), float(ends[3]))  # the beams meet no bottom
    return path, replace(truth, dropouts=(*truth.dropouts, upside_down))


def _eased(x: Array) -> Array:
    """0 before 0, 1 after 1, a smooth step of which the second derivative is continuous between."""
    x = np.clip(x, 0.0, 1.0)
    return np.asarray(x**3 * (10.0 - 15.0 * x + 6.0 * x**2))


def _joined(time: Array, p_n: Array, rpy: Array, then: Path) -> Path:
    """A motion without thrust, and after it a path that begins where it ends."""
    later = grid(round(then.duration / STEP_S) + 1)
    values = then.spline(later)
    values[:, :3] += then.offset_n
    values[:, 3] += rpy[-1, 0]  # whole turns
    assert then.thrusters is not None
    begin = STEP_S * len(time)
    idle = CONTROL_S * np.arange(round(begin / CONTROL_S), dtype=float)
    signals = np.vstack([np.zeros((len(idle), then.thrusters.signals.shape[1])), then.thrusters.signals])
    times: Array = np.concatenate([idle, begin + then.thrusters.time])
    thrusters = Thrusters(np.round(times, 4), signals)
    return Path.through(
        grid(len(time) + len(later)),
        np.vstack([p_n, values[:, :3]]),
        np.vstack([rpy, values[:, 3:]]),
        rest=False,
        thrusters=thrusters,
    )


def _stationary(world: World) -> Made:
    """At rest: on land above the fan, or afloat in the tank's waves."""
    afloat = world.choices.variant == "water"
    duration = _duration(world.choices.duration, 600.0)
    heading = float(wrap_angle(world.rng.uniform(0.0, 2.0 * np.pi)))
    depth = 2.0 if afloat else 0.0
    sea = drawn_sea(world.rng, depth, (0.0, 0.0), RIPPLES_M) if afloat else STILL

    def idle(craft: Craft) -> Array:
        return np.zeros(len(world.vehicle.thruster_positions))

    path = drive(world.vehicle, sea, idle, [0.0, 0.0, depth, heading], duration)
    path = path.shifted([0.0, 0.0, depth] - path.motion([0.0]).p_n[0])
    truth = world.truth(path, sea, lake=False)
    if not afloat:
        fan = Vibration(FAN_RAD_PER_SAMPLE / (2.0 * np.pi * SAMPLE_S), FAN_MPS2)
        truth = replace(truth, vibration=fan, depth_rate=None, dropouts=((0.0, float("inf")),))
    return path, truth


def _duration(chosen: float | None, planned: float) -> float:
    if chosen is not None and not (1.0 <= chosen <= LONGEST_S):
        raise InputError(f"duration of {chosen:g} s: between 1 and {LONGEST_S:.0f} s are expected")
    return planned if chosen is None else chosen


_LAKE = frozenset({"duration", "speed", "current"})
DRIVEN: dict[str, Driven] = {
    "vattern": Driven(_vattern, _LAKE | {"variant"}, tuple(RUNS), "the thesis's route, one of three runs by the seed"),
    "docking": Driven(_docking, _LAKE, (), "to a dock, slowly in the end"),
    "excited": Driven(_excited, frozenset({"current"}), (), "steps of thrust on every axis"),
    "tank": Driven(_tank, frozenset({"speed", "variant"}), ("raw", "calibrated"), "turns about z and x, then a lap"),
    "stationary": Driven(_stationary, frozenset({"duration", "variant"}), ("land", "water"), "at rest"),
}
