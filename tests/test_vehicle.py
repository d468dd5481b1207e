"""The vehicle in water obeys the equations of motion, and its derivatives are theirs."""

from dataclasses import replace

import numpy as np
import pytest

from rovgraph.errors import InputError
from rovgraph.geometry import exp_rotation, rotate, transpose
from rovgraph.model.config import Config, parse_config
from rovgraph.model.hydrodynamics import Hydrodynamics
from rovgraph.model.thesis import FLIP
from rovgraph.sensors.instruments import hydrodynamics

FALCON = hydrodynamics(Config())
RNG = np.random.default_rng(0)
DOWN = np.array([0.0, 0.0, 1.0])


def draws(*shape: int, scale: float = 1.0) -> np.ndarray:
    return scale * RNG.standard_normal(shape)


def slope(f, x: np.ndarray, h: float = 1e-6) -> np.ndarray:
    """Central differences of ``f`` by the last axis of ``x``."""
    steps = h * np.eye(x.shape[-1])
    return np.stack([(f(x + s) - f(x - s)) / (2 * h) for s in steps], axis=-1)


def assert_jacobians(f, jacobians: dict[str, np.ndarray], arguments: dict[str, np.ndarray]) -> None:
    assert set(jacobians) == set(arguments)
    for name, x in arguments.items():
        expected = slope(lambda value, name=name: f(**{**arguments, name: value}), x)
        np.testing.assert_allclose(jacobians[name], expected, atol=1e-6, err_msg=name)


def test_drags_derivatives_are_its_differences():
    x = {"velocity": draws(20, 3), "drag": draws(20, 6, scale=0.3)}
    assert_jacobians(lambda velocity, drag: FALCON.drag(velocity, drag)[0], FALCON.drag(x["velocity"], x["drag"])[1], x)
    x = {"rate": draws(20, 3), "turning_drag": draws(20, 6, scale=0.3)}
    H = FALCON.turning_drag(x["rate"], x["turning_drag"])[1]
    assert_jacobians(lambda rate, turning_drag: FALCON.turning_drag(rate, turning_drag)[0], H, x)


def test_accelerations_derivatives_are_their_differences():
    x = {"velocity": draws(20, 3), "rate": draws(20, 3), "force": draws(20, 3, scale=50), "drag": draws(20, 6)}

    def linear(velocity, rate, force, drag):
        return FALCON.acceleration(velocity, rate, force, drag)

    assert_jacobians(lambda **keys: linear(**keys)[0], linear(**x)[1], x)

    x = {"rate": draws(20, 3), "down": draws(20, 3), "moment": draws(20, 3, scale=9), "turning_drag": draws(20, 6)}

    def turning(rate, down, moment, turning_drag):
        return FALCON.turning_acceleration(rate, down, moment, turning_drag)

    assert_jacobians(lambda **keys: turning(**keys)[0], turning(**x)[1], x)


def test_one_epoch_is_as_many_epochs():
    v, w, u = draws(4, 3), draws(4, 3), draws(4, 5, scale=40)
    force, moment = FALCON.force_and_moment(u)
    many, H = FALCON.acceleration(v, w, force)
    one, H_one = FALCON.acceleration(v[2], w[2], FALCON.force_and_moment(u[2])[0])
    np.testing.assert_allclose(one, many[2], rtol=1e-12)
    for name in H:
        np.testing.assert_allclose(H_one[name], H[name][2])
    np.testing.assert_allclose(
        FALCON.turning_acceleration(w[2], DOWN, moment[2])[0], FALCON.turning_acceleration(w, DOWN, moment)[0][2]
    )


def test_thrust_is_the_thesiss_polynomial_and_grows_with_the_signal():
    np.testing.assert_allclose(FALCON.thrust(np.array([100.0, -50.0, 0.0])), [170.0, -13.25, 0.0])
    u = np.linspace(-100, 100, 2001)
    assert np.all(np.diff(FALCON.thrust(u)) > 0)


def test_moment_is_that_of_each_thruster_about_the_centre_of_mass():
    u = draws(5, scale=50)
    force, moment = FALCON.force_and_moment(u)
    each = FALCON.thrust(u)[:, None] * FALCON.thruster_directions
    np.testing.assert_allclose(force, each.sum(axis=0))
    np.testing.assert_allclose(moment, np.cross(FALCON.thruster_positions, each).sum(axis=0), atol=1e-12)


def test_the_falcons_thrusters_reach_surge_sway_heave_and_heading():
    assert np.linalg.matrix_rank(FALCON.allocation[[0, 1, 2, 5]]) == 4


def test_drag_opposes_every_axis_of_the_motion():
    v = draws(200, 3)
    assert np.all(FALCON.drag(v)[0] * v < 0) and np.all(FALCON.turning_drag(v)[0] * v < 0)


def settled(rate_of, start: np.ndarray, seconds: float) -> np.ndarray:
    x = start
    for _ in range(int(seconds / 0.01)):
        x = x + 0.01 * rate_of(x)
    return x


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_terminal_velocity_is_the_root_of_the_quadratic(axis):
    """c_quad v^2 + c_lin v = F, by hand, along and about each axis."""
    push = 40.0 * np.eye(3)[axis]
    linear, quadratic = [42.0, 180.0, 90.0][axis], [140.0, 55.0, 400.0][axis]
    by_hand = (-linear + np.sqrt(linear**2 + 4 * quadratic * 40.0)) / (2 * quadratic)
    v = settled(lambda v: FALCON.acceleration(v, np.zeros(3), push)[0], np.zeros(3), 20.0)
    np.testing.assert_allclose(v, by_hand * np.eye(3)[axis], atol=1e-6)

    c = [42.0, 55.0, 90.0][axis]
    by_hand = (-c + np.sqrt(c**2 + 4 * c * 40.0)) / (2 * c)
    neutral = replace(FALCON, centre_of_buoyancy=np.zeros(3))  # or it would right itself
    w = settled(lambda w: neutral.turning_acceleration(w, DOWN, push)[0], np.zeros(3), 20.0)
    np.testing.assert_allclose(w, by_hand * np.eye(3)[axis], atol=1e-6)


def drifted(vehicle: Hydrodynamics, v, w) -> tuple[np.ndarray, np.ndarray]:
    """Energy without thrust above that at rest, and the work of drag so far [J]; midpoint rule, 2 s."""
    R, step, energy, work = exp_rotation([0.4, -0.3, 1.0]), 1e-3, [], [0.0]
    rest = vehicle.energy(np.zeros(3), np.zeros(3), DOWN)

    def rates(R, v, w):
        alpha = vehicle.turning_acceleration(w, R[2], vehicle.munk_moment(v))[0]
        return vehicle.acceleration(v, w, np.zeros(3))[0], alpha

    for _ in range(2000):
        energy.append(vehicle.energy(v, w, R[2]) - rest)
        a, alpha = rates(R, v, w)
        half = v + 0.5 * step * a, w + 0.5 * step * alpha
        a, alpha = rates(R @ exp_rotation(0.5 * step * w), *half)
        work.append(work[-1] + step * (vehicle.drag(half[0])[0] @ half[0] + vehicle.turning_drag(half[1])[0] @ half[1]))
        v, w, R = v + step * a, w + step * alpha, R @ exp_rotation(step * half[1])
    return np.array(energy), np.array(work[:-1])


FAST = np.array([1.0, -0.8, 0.6]), np.array([0.8, -0.6, 1.2])


def test_without_thrust_energy_falls_and_by_the_work_of_drag():
    energy, work = drifted(FALCON, *FAST)
    assert np.all(np.diff(energy) < 0)
    np.testing.assert_allclose(energy - energy[0], work, atol=1e-4 * energy[0])


def test_without_drag_energy_stays():
    none = {name: np.zeros(3) for name in FALCON.__dataclass_fields__ if "drag" in name}
    np.testing.assert_allclose(
        drifted(replace(FALCON, **none), *FAST)[0] / drifted(FALCON, *FAST)[0][0], 1.0, atol=1e-4
    )


def test_two_metres_a_second_and_three_turns_die_away_at_a_hundred_hertz():
    """Euler's rule at the thesis's sample time neither blows up nor rings on (2.26)."""
    v, w, R = np.array([2.0, -2.0, 2.0]), np.array([3.0, -3.0, 3.0]), np.eye(3)
    rest, first = FALCON.energy(0 * v, 0 * w, DOWN), FALCON.energy(v, w, R[2])
    for _ in range(6000):
        a = FALCON.acceleration(v, w, np.zeros(3))[0]
        alpha = FALCON.turning_acceleration(w, R[2], FALCON.munk_moment(v))[0]
        v, w = v + 0.01 * a, w + 0.01 * alpha
        R = R @ exp_rotation(0.01 * w)
        assert FALCON.energy(v, w, R[2]) <= first
    assert FALCON.energy(v, w, R[2]) - rest < 1e-3 * (first - rest)


def test_buoyancy_rights_a_vehicle_that_leans():
    leaning = transpose(np.asarray(exp_rotation([0.2, 0.0, 0.0])))[:, 2]  # to starboard
    alpha = FALCON.turning_acceleration(np.zeros(3), leaning, np.zeros(3))[0]
    assert alpha[0] == pytest.approx(-73.3 * 9.81 * 0.2 * np.sin(0.2) / (3.7 + 9.0))
    np.testing.assert_allclose(FALCON.turning_acceleration(np.zeros(3), DOWN, np.zeros(3))[0], 0.0)


def test_forward_port_up_gives_the_same_motion():
    """The thesis's axes: every vector flipped, moments and rates too."""

    def flip(x):
        return rotate(FLIP, x)

    other = replace(
        FALCON,
        centre_of_buoyancy=flip(FALCON.centre_of_buoyancy),
        thruster_positions=flip(FALCON.thruster_positions),
        thruster_directions=flip(FALCON.thruster_directions),
    )
    v, w, u, down = draws(9, 3), draws(9, 3), draws(9, 5, scale=40), draws(9, 3)
    (force, moment), (force_up, moment_up) = FALCON.force_and_moment(u), other.force_and_moment(u)
    np.testing.assert_allclose(force_up, flip(force), atol=1e-12)
    np.testing.assert_allclose(moment_up, flip(moment), atol=1e-12)
    a, a_up = FALCON.acceleration(v, w, force)[0], other.acceleration(flip(v), flip(w), force_up)[0]
    np.testing.assert_allclose(a_up, flip(a), atol=1e-12)
    alpha = FALCON.turning_acceleration(w, down, moment)[0]
    alpha_up = other.turning_acceleration(flip(w), flip(down), moment_up)[0]
    np.testing.assert_allclose(alpha_up, flip(alpha), atol=1e-12)
    np.testing.assert_allclose(other.munk_moment(flip(v)), flip(FALCON.munk_moment(v)), atol=1e-12)


def test_a_thruster_without_direction_is_refused():
    text = "vehicle: {thrusters: [{position_m: [0, 0, 0], direction: [0, 0, 0]}]}"
    with pytest.raises(InputError, match=r"thrusters\.0\.direction"):
        hydrodynamics(parse_config(text))
