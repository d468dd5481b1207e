"""What an estimate publishes: the body's position, velocity and sds, from states at an IMU with an arm."""

from types import SimpleNamespace

import numpy as np
import pytest
from dives import falcon

from rovgraph.geometry import exp_rotation
from rovgraph.inference.estimate import body_trajectory, velocity_covariance
from rovgraph.kernels.assembly import KEYFRAME, RATE_B, SPREAD, TIME
from rovgraph.model.state import State

ARM_B = np.array([2.0, -2.0, 1.0])  # 3 m
N, DRAWS = 4, 40_000


@pytest.fixture(scope="module")
def published():
    """States of a few keyframes, their covariances in GTSAM's tangent space, and the trajectory of the body."""
    rng = np.random.default_rng(5)
    R_nb = exp_rotation(rng.normal(0.0, 1.0, (N, 3)))
    p_n, v_n = rng.normal(0.0, 9.0, (2, N, 3))
    bias = rng.normal(0.0, 0.1, (N, 6))
    rate_b, rate_sd = rng.normal(0.0, 0.5, (N, 3)), 0.02
    roots = rng.normal(0.0, 0.01, (N, 15, 15))
    P = roots @ roots.transpose(0, 2, 1)
    keyframes = np.zeros((N, KEYFRAME))
    keyframes[:, TIME], keyframes[:, RATE_B : RATE_B + 3], keyframes[:, SPREAD] = np.arange(N), rate_b, rate_sd
    config = falcon(imu={"lever_arm_m": ARM_B.tolist()})
    initial = SimpleNamespace(config=config, beliefs={}, streams=())
    states = State(R_nb, p_n, v_n, bias, {})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rovgraph.inference.estimate.rests_on_doubtful_compass", lambda initial: False)
        cov_v = velocity_covariance(keyframes, states, initial, P)
        track = body_trajectory(keyframes, states, initial, P[:, :6, :6], cov_v)
    return states, rate_b, rate_sd, P, track


def test_the_body_lies_an_arm_away_and_moves_as_it_turns(published):
    states, rate_b, _, _, track = published
    for k in range(N):
        R, omega_b = states.R_nb[k], rate_b[k] - states.bias[k, 3:]
        np.testing.assert_allclose(track.p_n[k], states.p_n[k] - R @ ARM_B)
        np.testing.assert_allclose(track.v_n[k], states.v_n[k] - R @ np.cross(omega_b, ARM_B))


def test_published_covariances_are_those_of_sampled_states(published):
    """Drawn in the tangent space: R exp(theta), p + R rho, v, bias, and the gyro's noise in the velocity of the arm."""
    states, rate_b, rate_sd, P, track = published
    rng = np.random.default_rng(6)
    for k in range(N):
        R = states.R_nb[k]
        xi = rng.multivariate_normal(np.zeros(15), P[k], DRAWS)
        turned = R @ exp_rotation(xi[:, :3])
        p = states.p_n[k] + xi[:, 3:6] @ R.T - turned @ ARM_B
        rate = rate_b[k] + rate_sd * rng.standard_normal((DRAWS, 3)) - states.bias[k, 3:] - xi[:, 12:]
        v = states.v_n[k] + xi[:, 6:9] - np.einsum("nij,nj->ni", turned, np.cross(rate, ARM_B))
        for found, given in (
            (np.cov(p.T), track.cov_p[k]),
            (np.cov(v.T), track.cov_v[k]),
            (np.cov((xi[:, :3] @ R.T).T), track.cov_theta[k]),
        ):
            scale = np.sqrt(np.outer(np.diag(given), np.diag(given)))
            np.testing.assert_allclose(found / scale, given / scale, atol=0.03)
