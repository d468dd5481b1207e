"""The dives of the thesis, and others, each as a function from a `World` to its path and truth."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.simulate.autopilot import AXES, Steps, VelocityControl
from rovgraph.simulate.driven import CONTROL_S, STEP_S, Craft, drive, grid
from rovgraph.simulate.magnetism import drawn_distortion
from rovgraph.simulate.noise import Vibration
from rovgraph.simulate.path import Path, Thrusters
from rovgraph.simulate.route import Route
from rovgraph.simulate.scenario import VATTERN
from rovgraph.simulate.sea import STILL, drawn_sea
from rovgraph.simulate.truth import Truth
from rovgraph.simulate.worlds import REST_S, World
from rovgraph.thesis import FAN_RAD_PER_SAMPLE, SAMPLE_S

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
    variants : that it has, the first is the default unless ``about`` says otherwise
    about : one line for people
    """

    make: Callable[[World], Made]
    choices: frozenset[str]
    variants: tuple[str, ...]
    about: str


@dataclass(frozen=True)
class Run:
    """One of the thesis's three runs: how fast, and how long it stays at the landmarks."""

    speed: float
    duration: float
    pace: tuple[float, ...]
    pause: tuple[float, ...]


# Durations and the highest speed, 0.6 m/s, are the thesis's (4.3); how they came about is a choice.
RUNS = {
    "1": Run(0.35, 250.0, (1, 1, 1, 1, 1, 1), (0, 0, 0, 0, 0, 0, 0)),
    "2": Run(0.35, 250.0, (1, 1.7, 1, 0.8, 1.7, 0.8), (0, 0, 15, 0, 15, 0, 0)),
    "3": Run(0.2, 500.0, (1, 1.5, 1, 0.7, 1, 1), (0, 20, 20, 0, 20, 20, 0)),
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


def _duration(chosen: float | None, own: float) -> float:
    if chosen is not None and not (1.0 <= chosen <= LONGEST_S):
        raise InputError(f"duration of {chosen:g} s: between 1 and {LONGEST_S:.0f} s are expected")
    return own if chosen is None else chosen


_LAKE = frozenset({"duration", "speed", "current"})
DRIVEN: dict[str, Driven] = {
    "vattern": Driven(_vattern, _LAKE | {"variant"}, tuple(RUNS), "the thesis's route, one of three runs by the seed"),
    "docking": Driven(_docking, _LAKE, (), "to a dock, slowly in the end"),
    "excited": Driven(_excited, frozenset({"current"}), (), "steps of thrust on every axis"),
    "tank": Driven(_tank, frozenset({"speed", "variant"}), ("raw", "calibrated"), "turns about z and x, then a lap"),
    "stationary": Driven(_stationary, frozenset({"duration", "variant"}), ("land", "water"), "at rest"),
}
