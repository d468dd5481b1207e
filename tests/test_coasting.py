"""A silence of the IMU: the same motion for graph and filters, and tracks that do not leave in it."""

from dataclasses import replace

import numpy as np
import pytest
from dives import batch, falcon, incremental, interrupted, position_errors, renewed, simulated, started
from motions import predict, problem_of, residual, transition, weights

from rovgraph.geometry import Array, matrix_from_rpy, rpy_from_matrix
from rovgraph.inference.graph.batch import motion_factor
from rovgraph.inference.graph.values import state_values
from rovgraph.kernels.motion import BRIDGE_ACC, BRIDGE_GYR, RIGHTING_S, TILT_SD
from rovgraph.model.state import BIAS, POSE, VELOCITY, State
from rovgraph.problem.calibration_roles import CalibrationRoles
from rovgraph.problem.motion import SCALES, preintegrate, preintegration_params
from rovgraph.problem.problem import Problem

SECONDS = 0.9
NONE = np.full((15, 15), np.nan)  # covariance of samples that count for nothing


@pytest.fixture(scope="module")
def dive() -> Problem:
    """Of whose motion nothing is known but that the vehicle turned at 0.3 rad/s before and after."""
    return silent(SECONDS + 0.2)


@pytest.fixture(scope="module")
def motion(dive) -> Array:
    return dive.motions[0]


def silent(gap_s: float) -> Problem:
    params = preintegration_params(falcon())
    params = replace(params, densities=(BRIDGE_ACC, BRIDGE_GYR, *params.densities[2:]))
    samples = np.array([[t, 0.3, 0.1, -9.8, 0.02, -0.05, 0.3] for t in (-0.1, SECONDS + 0.1)])
    motion, covariance, _ = preintegrate(params, np.zeros(6), samples, 0.0, np.empty(0), SECONDS, gap_s)
    return problem_of(np.array([0.0, SECONDS]), motion[None], covariance[None])


def covariance(motion: Array) -> Array:
    """Of the residual."""
    [W] = weights(motion[None], NONE[None])
    return np.linalg.inv(W.T @ W)


def state(rpy: list[float], p_n: list[float], v_n: list[float]) -> State:
    bias = np.array([[0.02, -0.01, 0.03, 0.002, -0.003, 0.001]])
    return State(matrix_from_rpy([rpy]), np.array([p_n]), np.array([v_n]), bias)


BEFORE, AFTER = state([0.1, -0.2, 2.0], [3, -2, 5], [0.4, -0.2, 0.1]), state([0.3, 0.1, 2.4], [4, -2, 5], [0.1, 0.2, 0])


def test_an_interval_is_blind_where_the_imu_was_silent_for_more_than_three_quarters_of_a_second(dive):
    assert dive.coasted[1]
    assert not silent(0.7).coasted[1]


def test_it_goes_on_as_it_went_turns_as_it_turned_and_rights_itself(motion):
    after = predict(motion, BEFORE)
    np.testing.assert_allclose(after.v_n, BEFORE.v_n)
    np.testing.assert_allclose(after.p_n, BEFORE.p_n + SECONDS * BEFORE.v_n)
    left = np.exp(-SECONDS / RIGHTING_S)
    np.testing.assert_allclose(
        rpy_from_matrix(after.R_nb[0]), [0.1 * left, -0.2 * left, 2.0 + 0.3 * SECONDS], atol=0.01
    )
    np.testing.assert_allclose(residual(motion, BEFORE, after)[0], 0.0, atol=1e-12)


def test_its_derivatives_are_those_of_the_residual(motion):
    _, A_i, A_j = residual(motion, BEFORE, AFTER)
    columns = [(POSE, k) for k in range(6)] + [(VELOCITY, k) for k in range(3)] + [(BIAS, k) for k in range(6)]
    for column, (variable, k) in enumerate(columns):
        step = np.zeros(3 if variable == VELOCITY else 6)
        step[k] = 1e-6
        for A, side in ((A_i, 0), (A_j, 1)):
            ends = []
            for sign in (1.0, -1.0):
                states = [BEFORE, AFTER]
                states[side] = states[side].retract(variable, sign * step)
                ends.append(residual(motion, *states)[0])
            np.testing.assert_allclose(A[:, column], (ends[0] - ends[1]) / 2e-6, atol=1e-7)


def test_the_factor_is_the_residual_whitened(dive, motion):
    values = state_values(0, BEFORE)
    values.insert(state_values(1, AFTER))
    (r, A_i, A_j), S = residual(motion, BEFORE, AFTER), covariance(motion)
    fixed = {name: np.zeros(3) for name in SCALES}
    factor = motion_factor(dive, 1, CalibrationRoles(fixed, {}), 1)
    assert 2.0 * factor.error(values) == pytest.approx(r @ np.linalg.solve(S, r))
    A, _ = factor.linearize(values).jacobian()
    both = np.concatenate([A_i[:, :9], A_j[:, :9], A_i[:, 9:], A_j[:, 9:]], axis=1)
    np.testing.assert_allclose(A.T @ A, both.T @ np.linalg.solve(S, both), rtol=1e-6, atol=1e-3)


def test_filters_have_it_from_the_same_derivatives(motion):
    after, F, Q = transition(motion, NONE, BEFORE)
    (_, A_i, A_j), S = residual(motion, BEFORE, after), covariance(motion)
    np.testing.assert_allclose(A_j @ F, -A_i, atol=1e-9)
    np.testing.assert_allclose(A_j @ Q @ A_j.T, S, atol=1e-12)


def test_a_tilt_that_is_as_vague_as_a_vehicles_stays_so(motion):
    """However long the silence is: it is what a vehicle that rights itself does."""
    known = state([0.0, 0.0, 1.0], [0, 0, 5], [0, 0, 0])
    P = np.zeros((15, 15))
    for _ in range(10):
        _, F, Q = transition(motion, NONE, known)
        P = F @ P @ F.T + Q
    np.testing.assert_allclose(np.sqrt(np.diag(P)[:2]), TILT_SD, rtol=1e-3)
    assert np.sqrt(P[2, 2]) == pytest.approx(BRIDGE_GYR * np.sqrt(10 * SECONDS), rel=1e-3)


@pytest.mark.parametrize("seconds", [3.0, 9.0])
def test_a_silence_of_everything_bends_neither_the_smoothed_track_nor_the_filtered_one(seconds):
    """Bridged by an interpolated specific force both were tens of metres off after nine seconds."""
    case = simulated(falcon(imu={"max_gap_s": 60.0}), 60.0, seed=3, dvl_rate=4.0)
    log, config = interrupted(case.log, 20.0, seconds), started(case)
    for estimate in (batch(log, config).solve(), renewed(log, config).solve()):
        error = position_errors(estimate.trajectory, case)
        sd = np.sqrt(np.trace(estimate.trajectory.cov_p, axis1=1, axis2=2))
        assert error.max() < 0.5 * seconds
        assert (error < 3.0 * sd + 0.05).all()
        assert sd.max() < 1.0 * seconds


def test_isam2_and_the_batch_smoother_coast_alike():
    case = simulated(falcon(imu={"max_gap_s": 60.0}), 50.0, seed=3, dvl_rate=4.0)
    log, config = interrupted(case.log, 20.0, 6.0), started(case)
    a, b = (make(log, config).solve().trajectory for make in (batch, incremental))
    np.testing.assert_allclose(a.p_n, b.p_n, atol=0.01)
