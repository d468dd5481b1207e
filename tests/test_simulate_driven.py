"""Dives driven through the thrusters obey the equations of motion and go where they are sent."""

import itertools
from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pytest

from rovgraph.errors import InputError
from rovgraph.geometry import cross, rotate, transpose
from rovgraph.log import Log
from rovgraph.model.config import load_config
from rovgraph.model.thesis import END_N, R_MTI, WAVE_HZ
from rovgraph.sensors.instruments import hydrodynamics
from rovgraph.simulate import Choices, Dive, Path, falcon, simulated
from rovgraph.simulate.driven import (
    AXES,
    CONTROL_S,
    RUNS,
    STEP_S,
    Autopilot,
    Craft,
    VelocityControl,
    World,
    _Lag,
    drive,
    hold,
)
from rovgraph.simulate.environment import STILL, Sea, drawn_sea
from rovgraph.simulate.path import Route
from rovgraph.simulate.scenario import VATTERN

CONFIG = falcon()
VEHICLE = hydrodynamics(CONFIG)
STRAIGHT = Route.of([(0, 0, 5), (6, 0, 5), (6, 8, 6)], pause=[0, 6, 0])
DRIFT = Sea(np.array([0.06, -0.08, 0.0]), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))


def autopilot(route: Route = STRAIGHT, speed: float = 0.35) -> Autopilot:
    return Autopilot(VelocityControl(VEHICLE), route, speed, rest=5.0)


@pytest.fixture(scope="module")
def world() -> World:
    return World.drawn(CONFIG, Choices(), seed=5)


@pytest.fixture(scope="module")
def wavy(world) -> tuple[Path, Sea]:
    """A drive through waves and current, with the true vehicle's drag not the believed one."""
    sea = drawn_sea(world.rng, 5.0, (0.06, -0.08))
    return world.along(STRAIGHT, 0.5, sea, 100.0), sea


@pytest.fixture(
    scope="module", params=["1", *(pytest.param(run, marks=pytest.mark.slow) for run in sorted(RUNS) if run != "1")]
)
def vattern(request) -> tuple[str, Dive]:
    return request.param, simulated("vattern", 4, choices=Choices(variant=request.param))[0]


def delayed(path: Path) -> np.ndarray:
    """What the thrusters do at every step, from the signals."""
    lag = _Lag(len(VEHICLE.thruster_positions))
    assert path.thrusters is not None
    return np.concatenate([lag.follow(signals) for signals in path.thrusters.signals])


def test_motion_obeys_the_hydrodynamics(world, wavy):
    """The spline's second derivative against `Hydrodynamics` at the spline's own velocity."""
    path, sea = wavy
    steps = np.arange(200, 9900)
    motion, signals = path.motion(STEP_S * steps), delayed(path)[steps]
    assert np.abs(np.diff(signals, axis=0)).max() > 1.0  # they do change
    force, moment = world.vehicle.force_and_moment(signals)
    R_bn = transpose(motion.R_nb)
    water, pull = sea.velocity(motion.time), [0, 0, 9.81] - sea.acceleration(motion.time)
    v_b = rotate(R_bn, motion.v_n - water)
    scale_to_bias = rotate(R_bn, motion.a_n - sea.acceleration(motion.time)) - cross(motion.w_b, v_b)
    error = scale_to_bias - world.vehicle.acceleration(v_b, motion.w_b, force)[0]
    noise = np.sqrt(np.diag(R_MTI))
    assert np.all(np.sqrt(np.mean(error**2, axis=0)) < 0.1 * noise[:3])
    assert np.all(np.abs(error.mean(axis=0)) < 1e-4)
    turning = world.vehicle.turning_acceleration(
        motion.w_b, rotate(R_bn, pull) / 9.81, moment + world.vehicle.munk_moment(v_b)
    )[0]
    # integrated over a sample, it stays below the gyro's noise
    assert np.all(np.sqrt(np.mean((motion.alpha_b - turning) ** 2, axis=0)) * STEP_S < 0.1 * noise[3:6])


def test_wrong_drag_would_be_seen(wavy):
    """The check above has a reason to fail: the believed vehicle does not explain the motion."""
    path, sea = wavy
    steps = np.arange(2000, 5000)
    motion = path.motion(STEP_S * steps)
    R_bn = transpose(motion.R_nb)
    v_b = rotate(R_bn, motion.v_n - sea.velocity(motion.time))
    scale_to_bias = rotate(R_bn, motion.a_n - sea.acceleration(motion.time)) - cross(motion.w_b, v_b)
    force = VEHICLE.force_and_moment(delayed(path)[steps])[0]
    assert np.abs((scale_to_bias - VEHICLE.acceleration(v_b, motion.w_b, force)[0]).mean(axis=0)).max() > 1e-2


def test_thrusters_rise_in_a_hundred_and_twenty_milliseconds():
    lag, step = _Lag(1), np.array([100.0])
    rise = np.concatenate([lag.follow(step) for _ in range(10)])[:, 0]
    time = STEP_S * np.arange(len(rise))
    begin, end = np.interp([10.0, 90.0], rise, time)
    assert end - begin == pytest.approx(0.12, abs=0.005)
    assert rise[0] == 0.0 and rise[-1] == pytest.approx(100.0, abs=1e-3)


def test_vattern_ends_where_the_thesis_does(vattern):
    run, dive = vattern
    assert dive.path.duration == RUNS[run].duration
    there = dive.truth.p_n[-1, :2] - dive.truth.p_n[0, :2]
    assert np.linalg.norm(there - END_N) < 1.0
    assert np.linalg.norm(dive.truth.v_n[-1]) < 0.1  # on station, waves aside


def test_vattern_keeps_to_the_route_and_below_the_thesiss_speed(vattern):
    _, dive = vattern
    bends, track = np.array(VATTERN, float), dive.truth.p_n[::50] - dive.hidden["start_offset"]
    legs = list(itertools.pairwise(bends))

    def distance(p: np.ndarray) -> float:
        along = [np.clip((p - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1) for a, b in legs]
        return min(float(np.linalg.norm(p - a - x * (b - a))) for (a, b), x in zip(legs, along, strict=True))

    assert max(map(distance, track)) < 1.0
    assert 0.2 < np.linalg.norm(dive.truth.v_n, axis=1).max() < 0.7


@pytest.mark.parametrize(
    "current", [(0.1, 0.0), *(pytest.param(c, marks=pytest.mark.slow) for c in ((-0.07, 0.07), (0.0, -0.1)))]
)
def test_vattern_is_reached_against_any_current_that_is_drawn(current):
    world = World.drawn(CONFIG, Choices(current=current), seed=1)
    run = RUNS["1"]
    path = world.along(Route.of(VATTERN, run.pace, run.pause), run.speed, drawn_sea(world.rng, 5.0, current), 250.0)
    ends = path.motion([0.0, 250.0]).p_n
    assert np.linalg.norm(ends[1, :2] - END_N) < 1.0


@pytest.mark.slow
def test_run_of_vattern_comes_with_the_seed():
    durations = [simulated("vattern", seed)[0].path.duration for seed in (3, 4, 5)]
    assert sorted(durations) == [250.0, 250.0, 500.0]


def test_pilot_stops_where_the_route_does_and_turns_there():
    path = drive(VEHICLE, STILL, autopilot(), [0, 0, 5, 0], 90.0)
    motion = path.motion(np.arange(0.0, 90.0, 0.1))
    near = np.linalg.norm(motion.p_n - STRAIGHT.points[1], axis=1) < 0.3
    assert near.sum() * 0.1 >= 6.0
    assert np.linalg.norm(motion.v_n[near], axis=1).min() < 0.02
    assert np.arctan2(motion.R_nb[-1, 1, 0], motion.R_nb[-1, 0, 0]) == pytest.approx(np.pi / 2, abs=0.05)


def test_pilot_keeps_station_heading_and_depth_in_a_current():
    control = VelocityControl(VEHICLE)
    station = np.array([1.0, 2.0, 6.0])
    path = drive(VEHICLE, DRIFT, lambda craft: control.signals(hold(craft, station, 0.8), craft), [*station, 0.8], 30.0)
    motion = path.motion(np.arange(0.0, 30.0, 0.5))
    np.testing.assert_allclose(motion.p_n, np.tile(station, (60, 1)), atol=0.1)
    np.testing.assert_allclose(np.arctan2(motion.R_nb[:, 1, 0], motion.R_nb[:, 0, 0]), 0.8, atol=0.01)
    assert path.thrusters is not None and np.abs(path.thrusters.signals[-1]).max() > 5.0  # it works against it


def test_crab_angle_is_held():
    route = Route.of([(0, 0, 5), (10, 0, 5)], crab=np.deg2rad(60.0))
    path = drive(VEHICLE, STILL, autopilot(route, 0.2), [0, 0, 5, np.deg2rad(60.0)], 40.0)
    motion = path.motion(np.arange(20.0, 35.0, 1.0))
    np.testing.assert_allclose(np.rad2deg(np.arctan2(motion.R_nb[:, 1, 0], motion.R_nb[:, 0, 0])), 60.0, atol=2.0)
    assert np.abs(motion.p_n[:, 1]).max() < 0.1


def test_signals_saturate_at_a_hundred_percent():
    control = VelocityControl(VEHICLE)
    craft = Craft(0.0, np.zeros(3), np.zeros(3), np.array([-3.0, 2.0, -2.0]), np.array([0.0, 0.0, 2.0]))
    signals = control.signals(np.zeros(4), craft)
    assert np.abs(signals).max() == 100.0 and np.abs(signals).min() <= 100.0


def test_allocation_gives_the_force_that_was_asked_for():
    control, rng = VelocityControl(VEHICLE), np.random.default_rng(0)
    craft = Craft(0.0, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    for push in rng.uniform(-40.0, 40.0, (20, 4)) * [1, 1, 1, 0.3]:
        force, moment = VEHICLE.force_and_moment(control.signals(np.zeros(4), craft, push))
        np.testing.assert_allclose(np.append(force, moment)[AXES], push, rtol=0.02, atol=0.05)


def test_signals_are_logged_ten_times_a_second_and_become_a_stream(vattern):
    _, dive = vattern
    stream = Log.from_frame(dive.log_frame)["thruster"]
    assert stream.columns == tuple(f"thruster_{i}" for i in range(1, 6))
    np.testing.assert_allclose(np.diff(stream.time), CONTROL_S, atol=1e-9)
    assert np.all(np.isfinite(stream.data)) and 20.0 < np.abs(stream.data).max() <= 100.0


def test_drag_is_found_again_in_the_excited_run():
    """Least squares of M v' + w x M v - F on -v and -|v| v: what an estimator could at best learn."""
    dive, _ = simulated("excited", 3, choices=Choices(current=(0.0, 0.0)))
    time = STEP_S * np.arange(200, round(dive.path.duration / STEP_S) - 10)
    motion = dive.path.motion(time)
    v_b = rotate(transpose(motion.R_nb), motion.v_n)
    a_b = rotate(transpose(motion.R_nb), motion.a_n) - cross(motion.w_b, v_b)
    force = VEHICLE.force_and_moment(delayed(dive.path)[200 : 200 + len(time)])[0]
    left = VEHICLE.mass * a_b + cross(motion.w_b, VEHICLE.mass * v_b) - force
    truth = dive.hidden["calibration"]
    for axis in range(3):
        v = v_b[:, axis]
        assert np.abs(v).max() > 0.2
        linear, quadratic = np.linalg.lstsq(-np.column_stack([v, np.abs(v) * v]), left[:, axis], rcond=None)[0]
        # waves, which the regression does not know, are what keeps it from being exact
        assert linear == pytest.approx(VEHICLE.drag_linear[axis] * (1 + truth["drag_linear"][axis]), rel=0.15)
        assert quadratic == pytest.approx(VEHICLE.drag_quadratic[axis] * (1 + truth["drag_quadratic"][axis]), rel=0.15)


def test_excited_run_turns_too():
    dive, _ = simulated("excited", 3)
    rate = dive.path.motion(np.arange(0.0, dive.path.duration, 0.1)).w_b[:, 2]
    assert rate.max() > 0.4 and rate.min() < -0.4


def test_docking_ends_slowly_at_the_dock():
    dive, _ = simulated("docking", 2)
    late = dive.truth.time > dive.truth.time[-1] - 30.0
    assert np.linalg.norm(dive.truth.p_n[-1] - dive.truth.p_n[0] - [27, 16, 4.2]) < 0.3
    assert np.linalg.norm(dive.truth.v_n[late], axis=1).max() < 0.15


def test_without_noise_the_vehicle_is_the_believed_one():
    world = World.drawn(CONFIG, Choices(noise=False), seed=5)
    np.testing.assert_array_equal(world.vehicle.drag_linear, VEHICLE.drag_linear)
    assert not np.allclose(World.drawn(CONFIG, Choices(), seed=5).vehicle.drag_linear, VEHICLE.drag_linear)


def test_waves_have_the_thesiss_frequency_and_a_consistent_acceleration():
    sea = drawn_sea(np.random.default_rng(1), 5.0)
    time, h = np.arange(0.0, 400.0, 0.1), 1e-4
    slope = (sea.velocity(time + h) - sea.velocity(time - h)) / (2 * h)
    np.testing.assert_allclose(sea.acceleration(time), slope, atol=1e-8)
    velocity = sea.velocity(time) - sea.current_n
    power = np.abs(np.fft.rfft(velocity, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(time), 0.1)
    assert (frequency[:, None] * power).sum() / power.sum() == pytest.approx(WAVE_HZ, abs=0.03)
    level, upright = np.linalg.norm(velocity[:, :2], axis=1).std(), velocity[:, 2].std()
    assert 1e-3 < upright < 0.05 and level > 0.3 * upright
    deep = drawn_sea(np.random.default_rng(1), 10.0)
    assert np.abs(deep.amplitude_n).max() < 0.2 * np.abs(sea.amplitude_n).max()


def test_falcon_travels_with_the_package():
    assert falcon() == load_config(FilePath(__file__).parents[1] / "rovgraph" / "model" / "falcon.yaml")


@pytest.mark.parametrize(
    ("name", "keys", "words"),
    [
        ("vatern", {}, "did you mean vattern.*docking"),
        ("vattern", {"variant": "4"}, "no variant '4'; it has 1, 2, 3"),
        ("vattern", {"duration": 60.0, "variant": "1"}, "not reached"),
        ("vattern", {"duration": 20.0, "variant": "2"}, "rest and stops"),
        ("vattern", {"speed": 4.0}, "at most 1"),
        ("vattern", {"speed": float("nan")}, "at most 1"),
        ("docking", {"duration": float("inf")}, "duration"),
        ("docking", {"speed": 1e-3}, "duration"),
        ("vattern", {"duration": 3601.0}, "between 1 and 3600"),
        ("excited", {"speed": 0.3}, "no choice of speed"),
        ("tank", {"current": (0.1, 0.0)}, "no choice of current"),
        ("tank", {"speed": 0.0}, "speed"),
        ("stationary", {"duration": -1.0}, "duration"),
        ("square", {"variant": "1"}, "no choice of variant"),
        ("square", {"outliers": 2.0}, "outliers"),
    ],
)
def test_what_cannot_be_is_refused(name, keys, words):
    with pytest.raises(InputError, match=words):
        simulated(name, 1, choices=Choices(**keys))


@pytest.mark.slow
def test_chosen_duration_changes_the_speed_and_chosen_speed_the_duration():
    slow = simulated("docking", 1, choices=Choices(duration=300.0))[0]
    fast = simulated("docking", 1, choices=Choices(speed=0.5))[0]
    assert slow.path.duration == 300.0 and fast.path.duration < 200.0
    highest = [np.linalg.norm(d.truth.v_n, axis=1).max() for d in (slow, fast)]
    assert highest[0] < 0.35 and highest[1] > 0.45


@pytest.mark.slow
def test_a_vehicle_without_enough_thrusters_says_so():
    weak = CONFIG.model_copy(update={"vehicle": CONFIG.vehicle.model_copy(update={"thrust": (0.01, 0.0, 0.0)})})
    with pytest.raises(InputError, match="not reached"):
        simulated("docking", 1, weak)
    few = CONFIG.vehicle.model_copy(update={"thrusters": CONFIG.vehicle.thrusters[:2]})
    with pytest.raises(InputError):
        simulated("docking", 1, CONFIG.model_copy(update={"vehicle": few}))


def test_a_vehicle_that_the_steps_are_too_long_for_is_refused():
    vehicle = CONFIG.vehicle.model_copy(update={"turning_drag_linear": (42.0, 55.0, 1e6)})
    with pytest.raises(InputError, match="the motion diverges"):
        simulated("docking", 1, CONFIG.model_copy(update={"vehicle": vehicle}))


def test_same_seed_same_dive_and_the_world_is_apart_from_the_sensors(world):
    one, two = (simulated("docking", 7)[0].log_frame for _ in range(2))
    assert one.equals(two)
    again = World.drawn(replace(world).config, Choices(), seed=5)
    np.testing.assert_array_equal(again.vehicle.drag_linear, world.vehicle.drag_linear)
