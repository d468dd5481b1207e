"""Short propagation between a keyframe and a measurement's own time."""

import gtsam
import numpy as np
import pytest
from motions import Delta, propagate

from rovgraph.geometry import exp_rotation, log_rotation, rotate, transpose
from rovgraph.model.state import BIAS, POSE, VELOCITY, State, stack_states

GRAVITY, N, STEP = 9.81, 5, 1e-6


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def state(rng):
    def draw(size, dim):
        return size * rng.standard_normal((N, dim))

    calibration = {"dvl_yaw": np.array([0.1]), "hard_iron": draw(0.1, 3)}
    return State(exp_rotation(draw(1.0, 3)), draw(10.0, 3), draw(1.0, 3), draw(0.1, 6), calibration)


def motion(rng, dt=0.4):
    """A motion large enough that every term of the propagation shows."""

    def draw(size, dim):
        return size * rng.standard_normal((N, dim))

    return Delta(dt * rng.uniform(0.5, 1.5, N), exp_rotation(draw(0.5, 3)), draw(1.0, 3), draw(0.5, 3), draw(0.1, 6))


def difference(a, b):
    """From a to b in the tangent space, shape (n, 15)."""
    turn = log_rotation(transpose(a.R_nb) @ b.R_nb)
    return np.hstack([turn, rotate(transpose(a.R_nb), b.p_n - a.p_n), b.v_n - a.v_n, b.bias - a.bias])


def test_jacobian_of_propagation_is_its_finite_difference(rng):
    here, delta = state(rng), motion(rng)
    there, F = propagate(here, delta, GRAVITY)
    column = 0
    for variable, dim in ((POSE, 6), (VELOCITY, 3), (BIAS, 6)):
        for k in range(dim):
            d = STEP * np.eye(dim)[k]
            ahead = propagate(here.retract(variable, d), delta, GRAVITY)[0]
            behind = propagate(here.retract(variable, -d), delta, GRAVITY)[0]
            numeric = (difference(there, ahead) - difference(there, behind)) / (2 * STEP)
            np.testing.assert_allclose(F[:, :, column], numeric, atol=1e-7, err_msg=f"{variable} {k}")
            column += 1


def test_propagation_is_gtsams_prediction(rng):
    here = state(rng)
    params = gtsam.PreintegrationCombinedParams.MakeSharedD(GRAVITY)
    bias = here.bias[0]
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    for k in range(30):
        pim.integrateMeasurement(np.array([0.3, 0.1 * k, -9.0]), np.array([0.2, -0.1, 0.02 * k]), 0.01)
    delta = Delta(
        *(np.array([v]) for v in (pim.deltaTij(), pim.deltaRij().matrix(), pim.deltaVij(), pim.deltaPij(), bias))
    )
    one = here.at([0])
    nav = gtsam.NavState(gtsam.Rot3(one.R_nb[0]), one.p_n[0], one.v_n[0])

    def apart(there, predicted):
        return max(
            np.abs(there.R_nb[0] - predicted.attitude().matrix()).max(),
            np.abs(there.p_n[0] - predicted.position()).max(),
            np.abs(there.v_n[0] - predicted.velocity()).max(),
        )

    now = pim.predict(nav, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    assert apart(propagate(one, delta, GRAVITY)[0], now) < 1e-9
    # with another bias: to first order in the bias, and in the turn of the interval
    change = np.array([0.02, -0.01, 0.03, 2e-3, -1e-3, 3e-3])
    after = pim.predict(nav, gtsam.imuBias.ConstantBias(*np.split(bias + change, 2)))
    moved = apart(propagate(one, delta, GRAVITY)[0], after)
    assert moved > 5e-3
    assert apart(propagate(one.retract(BIAS, change), delta, GRAVITY)[0], after) < 0.2 * moved


def test_no_motion_leaves_the_state_as_it_is(rng):
    here = state(rng)
    there, F = propagate(here, Delta.none(N), GRAVITY)
    np.testing.assert_array_equal(difference(here, there), 0.0)
    np.testing.assert_allclose(F, np.broadcast_to(np.eye(15), F.shape), atol=1e-15)


def test_free_fall_is_gravity_alone():
    zero = np.zeros((1, 3))
    here = State(np.eye(3)[None], zero, zero, np.zeros((1, 6)))
    there, _ = propagate(here, Delta(np.array([2.0]), np.eye(3)[None], zero, zero, np.zeros((1, 6))), GRAVITY)
    np.testing.assert_allclose(there.v_n[0], [0, 0, 2 * GRAVITY])
    np.testing.assert_allclose(there.p_n[0], [0, 0, 2 * GRAVITY])


def test_pose_is_perturbed_on_the_right_as_gtsam_does(rng):
    here, delta = state(rng), 0.1 * rng.standard_normal(6)
    for k in range(N):
        pose = gtsam.Pose3(gtsam.Rot3(here.R_nb[k]), here.p_n[k])
        # to first order: GTSAM's retraction of a pose is the full exponential map
        small = pose.retract(1e-5 * delta)
        moved = here.retract(POSE, 1e-5 * delta)
        np.testing.assert_allclose(moved.R_nb[k], small.rotation().matrix(), atol=1e-9)
        np.testing.assert_allclose(moved.p_n[k], small.translation(), atol=1e-9)


def test_stacked_states_and_selected_epochs_undo_each_other(rng):
    here = state(rng)
    parts = [
        State(
            here.R_nb[[k]],
            here.p_n[[k]],
            here.v_n[[k]],
            here.bias[[k]],
            {"hard_iron": here.calibration["hard_iron"][k]},
        )
        for k in range(N)
    ]
    again = stack_states(parts)
    np.testing.assert_array_equal(difference(here, again), 0.0)
    np.testing.assert_array_equal(again.calibration["hard_iron"], here.calibration["hard_iron"])
    some = here.at([3, 1])
    np.testing.assert_array_equal(some.p_n, here.p_n[[3, 1]])
    np.testing.assert_array_equal(some.calibration["hard_iron"], here.calibration["hard_iron"][[3, 1]])
    np.testing.assert_array_equal(some.calibration["dvl_yaw"], [0.1])
