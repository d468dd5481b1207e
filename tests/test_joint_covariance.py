"""The joint covariance of a smoothed dive: that of GTSAM, that of its draws, and that of many simulated dives."""

import pickle
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from dives import batch, changed, exact, falcon, interrupted, simulated, smoothed, started, true_at

import rovgraph as rg
from rovgraph.geometry import Array, log_rotation, transpose
from rovgraph.inference import posterior
from rovgraph.inference.estimate import Estimate, state_names
from rovgraph.inference.graph.places import smooth_graph
from rovgraph.inference.graph.values import key
from rovgraph.inference.posterior import Posterior
from rovgraph.model.config import beliefs
from rovgraph.model.state import BIAS, POSE, VELOCITY

AT_IMU = {"imu": {"mount_rpy_deg": [0, 0, 0], "lever_arm_m": [0, 0, 0]}}
CONSIDERED = {
    "calibration": {
        "dvl_yaw": {"estimate": "considered", "sd_deg": 3.0},
        "dvl_scale": {"estimate": "considered", "sd": 0.02},
        "dvl_lever_arm": {"estimate": "considered", "sd": 0.05},
        "depth_offset": {"estimate": "considered", "sd": 0.2},
        "gyr_scale": {"estimate": "considered", "sd": 0.005},
    }
}
WALKS = {"calibration": {"mag_offset": {"estimate": True, "walk_deg": 0.1}}}


@pytest.fixture(scope="module")
def dive() -> Estimate:
    """A minute with considered variables and an IMU off the origin."""
    config = falcon(imu={"lever_arm_m": [0.3, -0.2, 0.1]}, **CONSIDERED)
    case = simulated(config, 60.0, seed=3, imu_rate=50.0)
    estimate = smoothed(case.log, started(case))
    assert {"dvl_scale", "depth_offset"} <= {*estimate.summary["considered"]}
    return estimate


def blocks(P: Array, i: int, j: int) -> Array:
    return P[15 * i : 15 * i + 15, 15 * j : 15 * j + 15]


@pytest.mark.parametrize("sections", [{}, WALKS], ids=["constants", "one that walks"])
def test_it_is_that_of_gtsam(sections):
    """Where nothing is considered: equal to ``jointMarginalCovariance`` of the same linearised factors."""
    case = simulated(exact(falcon(**AT_IMU | sections)), 40.0, seed=2, imu_rate=50.0, dvl_rate=3.0)
    own = batch(case.log, started(case))
    best = own.optimum()
    assert not best.unknowns.considered
    graph = smooth_graph(
        own.problem, own.initial, best.state, {n: np.atleast_2d(v)[-1] for n, v in best.state.calibration.items()}
    )
    values, n = graph.solution.point, len(own.problem)
    marginals = gtsam.Marginals(graph.graph.linearize(values, graph.solution.gates), values)
    # linearised at the same point
    known = Posterior.of(replace(best, solution=replace(best.solution, point=graph.state), begun=None), own.initial)
    for i, j in ((0, n - 1), (5, 70), (63, 64), (64, 65), (40, 41)):
        P, _ = known.at(own.problem.time[[i, j]])
        keys = [key(variable, k) for k in (i, j) for variable in (POSE, VELOCITY, BIAS)]
        joint = marginals.jointMarginalCovariance(keys)
        expected = np.block([[joint.at(a, b) for b in keys] for a in keys])
        sd = np.sqrt(np.diagonal(expected))
        assert np.abs((P - expected) / np.outer(sd, sd)).max() < 1e-6


def test_it_has_the_trajectorys_own_covariance_at_a_keyframe_and_its_names(dive):
    track = dive.trajectory
    for k in (0, 64, 100, len(track) - 1):
        P = dive.covariance(track.time[k], axes="n")
        assert tuple(P.index) == tuple(P.columns) == state_names("n")
        np.testing.assert_allclose(P.to_numpy()[3:6, 3:6], track.cov_p[k], rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(P.to_numpy()[:3, :3], track.cov_theta[k], rtol=1e-9, atol=1e-15)
        np.testing.assert_allclose(P.to_numpy()[6:9, 6:9], track.cov_v[k], rtol=1e-9, atol=1e-15)
    bias_sd = dive.history["gyr_bias"].sd[100]
    np.testing.assert_allclose(np.sqrt(np.diagonal(dive.covariance(track.time[100])))[12:], bias_sd, rtol=1e-9)


def test_north_and_east_alone_are_those_of_the_whole():
    case = simulated(falcon(imu={"lever_arm_m": [0.0, 0.0, 0.0]}, **CONSIDERED), 40.0, seed=3, imu_rate=50.0)
    posterior = smoothed(case.log, started(case)).posterior
    keyframes = [3, 40, 90]
    P, R_nb = posterior.at(posterior.optimum.problem.time[keyframes])
    level = np.zeros((6, 45))
    for k, R in enumerate(R_nb):
        level[2 * k : 2 * k + 2, 15 * k + 3 : 15 * k + 6] = R[:2]
    np.testing.assert_allclose(posterior.horizontal(keyframes), level @ P @ level.T, rtol=1e-6, atol=1e-12)


def test_axes_of_the_body_are_those_of_the_contract(dive):
    time, R = dive.trajectory.time[50], dive.trajectory.R_nb[50]
    b, n = (dive.covariance(time, axes).to_numpy() for axes in "bn")
    np.testing.assert_allclose(R @ b[3:6, 3:6] @ R.T, n[3:6, 3:6], atol=1e-14)
    np.testing.assert_allclose(R @ b[:3, 9:12], n[:3, 9:12], atol=1e-14)
    assert state_names()[3] == "position_x" and state_names("n")[3] == "position_north"


def test_a_joint_covariance_holds_both_and_is_the_same_in_either_order(dive):
    first, second = 12.34, float(dive.trajectory.time[-3])
    P, Q = dive.joint(first, second), dive.joint(second, first)
    np.testing.assert_allclose(P.loc[1, 1], dive.covariance(first), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(P.loc[2, 2], dive.covariance(second), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(P.loc[1, 2], Q.loc[2, 1], rtol=1e-9, atol=1e-15)
    assert np.linalg.eigvalsh(P.to_numpy()).min() > 0.0
    same = dive.joint(first, first)
    np.testing.assert_allclose(same.loc[1, 2], same.loc[1, 1], rtol=1e-12)


def test_between_keyframes_it_goes_over_into_those_at_both_ends(dive):
    """Without a step at the ends, and as with a keyframe more."""
    time = dive.trajectory.time
    for end in (time[40], time[41]):
        near = end + (1e-4 if end == time[40] else -1e-4)
        scale = np.sqrt(np.diagonal(dive.covariance(end)))
        assert np.abs((dive.covariance(near) - dive.covariance(end)) / np.outer(scale, scale)).to_numpy().max() < 0.02


def test_between_keyframes_it_is_that_of_a_dive_with_a_keyframe_there():
    sensors = {
        "imu_rate": 50.0,
        "dvl_rate": 1.3,
        "dvl_jitter": 0.0,
        "depth_rate": None,
    }  # none that counts once in each
    case = simulated(falcon(heading={"sources": ["dvl"]}), 35.0, seed=4, **sensors)
    few, many = (smoothed(case.log, changed(started(case), graph={"max_gap_s": gap})) for gap in (0.9, 0.3))
    ours, more = few.trajectory.time, many.trajectory.time
    new = more[(np.abs(more[:, None] - ours).min(axis=1) > 1e-3) & (more > 12.0)]
    assert len(new) > 10
    for t in new[::4]:
        a, b = (one.covariance(t).to_numpy() for one in (few, many))
        # the noise of an interval is what its samples show, and differs a little
        np.testing.assert_allclose(np.sqrt(np.diagonal(a)), np.sqrt(np.diagonal(b)), rtol=0.1)
        a, b = (one.relative(t, more[-1]).sd for one in (few, many))
        np.testing.assert_allclose(a, b, rtol=0.1)


def test_within_an_outage_of_the_imu_it_is_wider_than_at_its_ends():
    case = simulated(falcon(), 40.0, seed=4, imu_rate=50.0)
    log = interrupted(case.log, 20.0, 1.6, "imu", "dvl")
    estimate = smoothed(log, changed(started(case), imu={"max_gap_s": 5.0}, graph={"max_gap_s": 3.0}))
    time = estimate.trajectory.time
    k = int(np.argmax(np.diff(time)))
    assert time[k + 1] - time[k] > 1.5
    begin, middle, end = (
        np.sqrt(np.diagonal(estimate.covariance(t)))[6:8] for t in (time[k], 0.5 * (time[k] + time[k + 1]), time[k + 1])
    )
    assert (middle > 5.0 * np.maximum(begin, end)).all()


def test_times_of_one_interval_have_its_noise_in_common(dive):
    begin, end = dive.trajectory.time[40:42]
    near, far = begin + 0.4 * (end - begin), begin + 0.6 * (end - begin)
    moved = dive.relative(near, far)
    assert (moved.sd < dive.relative(begin, end).sd).all() and (moved.sd > 0.0).all()
    np.testing.assert_allclose(dive.relative(far, near).value, -moved.value, atol=1e-12)


def test_a_relative_position_is_that_of_the_track_and_leaves_out_what_both_share(dive):
    track, (i, j) = dive.trajectory, (100, 130)
    for axes, R in (("n", np.eye(3)), ("b", track.R_nb[i])):
        moved = dive.relative(track.time[i], track.time[j], axes)
        np.testing.assert_allclose(moved.value, R.T @ (track.p_n[j] - track.p_n[i]), atol=1e-12)
        assert (moved.sd[:2] < track.p_sd[j, :2]).all()
    J = np.hstack([-np.eye(3), np.eye(3)])
    P = dive.joint(track.time[i], track.time[j], "n").to_numpy()[np.ix_([3, 4, 5, 18, 19, 20], [3, 4, 5, 18, 19, 20])]
    np.testing.assert_allclose(dive.relative(track.time[i], track.time[j]).covariance, J @ P @ J.T, atol=1e-14)


def test_draws_scatter_as_it_says(dive):
    draws, track = dive.sample(400, seed=1), dive.trajectory
    at, e = (20, -1), []
    for one in draws:
        theta = log_rotation(transpose(track.R_nb[[*at]]) @ one.R_nb[[*at]])
        parts = [theta, one.p_n[[*at]] - track.p_n[[*at]], one.v_n[[*at]] - track.v_n[[*at]]]
        parts[1] = np.einsum("nji,nj->ni", track.R_nb[[*at]], parts[1])
        e.append(np.hstack(parts).ravel())
    P = dive.joint(track.time[at[0]], track.time[at[1]]).to_numpy()
    is_like(np.array(e), P[np.ix_(*[[*range(9), *range(15, 24)]] * 2)])
    again = dive.sample(1, seed=1)[0]
    np.testing.assert_array_equal(again.p_n, dive.sample(1, seed=1)[0].p_n)


def is_like(errors: Array, P: Array) -> None:
    """Errors, shape (m, k), are draws of a normal distribution: whitened, their covariance is a unit matrix."""
    m, k = errors.shape
    white = np.linalg.solve(np.linalg.cholesky(P), errors.T)
    spread = np.linalg.eigvalsh(white @ white.T / m)
    edge = np.sqrt(k / m)
    assert (1.0 - edge) ** 2 * 0.85 < spread.min() and spread.max() < (1.0 + edge) ** 2 * 1.15
    assert abs((white**2).sum() / m / k - 1.0) < 4.0 * np.sqrt(2.0 / m / k)


def test_a_long_dive_is_eliminated_anew_and_answers_the_same(dive, monkeypatch):
    short = dive.joint(5.0, 50.0)
    monkeypatch.setattr(posterior, "KEPT", 10)
    known = dive.posterior
    long = replace(dive, posterior=Posterior.of(known.optimum, known.initial))
    for _ in range(2):
        np.testing.assert_allclose(long.joint(5.0, 50.0), short, rtol=1e-9, atol=1e-15)
        assert len(long.posterior._kept.root.conditionals) == 0, "of a long dive they are large"


def test_what_displaces_all_positions_is_in_it_and_in_its_draws(dive):
    n = len(dive.trajectory)
    rival = np.column_stack([np.linspace(0.0, 30.0, n), np.zeros(n)])
    other = replace(dive, posterior=dive.posterior.also(rival))
    time = dive.trajectory.time
    a, b = (one.joint(time[n // 2], time[-1], "n").to_numpy()[[3, 18]][:, [3, 18]] for one in (dive, other))
    u = rival[[n // 2, -1], 0]
    np.testing.assert_allclose(b - a, np.outer(u, u), rtol=1e-9)
    ends = np.array([one.p_n[-1, 0] for one in other.sample(100, seed=2)])
    assert ends.std() == pytest.approx(np.sqrt(b[1, 1]), rel=0.25)


def test_an_estimate_comes_back_from_pickle_with_it(dive):
    again = pickle.loads(pickle.dumps(dive))
    np.testing.assert_array_equal(again.covariance(30.0), dive.covariance(30.0))


@pytest.mark.parametrize(
    ("ask", "line"),
    [
        (lambda e: e.covariance(1e4), r"^time 10000 s: beyond the track, which has 0.* to .* s$"),
        (lambda e: e.covariance(float("nan")), "^time nan s: beyond the track"),
        (lambda e: e.joint([1.0, 2.0], 3.0), "^time: is an array, expected one time"),
        (lambda e: e.covariance("yesterday"), r"^time yesterday: expected seconds or a date such as"),
        (lambda e: e.covariance("2026-05-01T10:00:00"), "^time 2026-05-01T10:00:00: is a date, but the track's clock"),
        (lambda e: e.relative(1.0, 2.0, "body"), "^axes 'body': expected b or n$"),
        (lambda e: e.sample(0), "^count 0: expected a whole number from 1$"),
    ],
)
def test_what_it_cannot_answer_is_one_line(dive, ask, line):
    with pytest.raises(rg.InputError, match=line):
        ask(dive)


def test_other_estimates_have_none(dive):
    other = replace(dive, kind="filtered", posterior=None)
    with pytest.raises(rg.InputError, match=r"^the filtered estimate has no joint covariance: "):
        other.covariance(1.0)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_400_dives_scatter_as_it_says():
    """With considered variables drawn from their priors, estimated ones too, and a start that is off.

    The IMU is at the origin. Off it, the gyro's noise is in the DVL's prediction and in the velocity of the arm, and
    counted as if independent: the sd of the Falcon's vertical velocity is then 13 % too wide.
    """
    plain = {sensor: {"loss": "none"} for sensor in ("dvl", "heading", "depth")}
    config, rng, errors = falcon(**plain, **CONSIDERED, **AT_IMU), np.random.default_rng(5), []
    considered = {name: beliefs(config)[name] for name in CONSIDERED["calibration"]}
    for seed in range(400):
        drawn = {n: b.mean + b.sd * rng.standard_normal(b.variable.dim) for n, b in considered.items()}
        case = simulated(config, 32.0, seed, calibration=drawn, imu_rate=25.0, dvl_rate=2.0, start_error=True)
        estimate = smoothed(case.log, config)
        assert {"dvl_scale"} <= {*estimate.summary["considered"]} <= {*considered}
        # at keyframes: a track is interpolated between them
        track = estimate.trajectory[np.searchsorted(estimate.trajectory.time, [14.0, 30.0])]
        truth = true_at(case, track.time)
        theta = log_rotation(transpose(track.R_nb) @ truth.R_nb)
        p = np.einsum("nji,nj->ni", track.R_nb, truth.p_n - track.p_n)
        e = np.hstack([theta, p, truth.v_n - track.v_n]).ravel()
        P = estimate.joint(*track.time).to_numpy()[np.ix_(*[[*range(9), *range(15, 24)]] * 2)]
        errors.append(np.linalg.solve(np.linalg.cholesky(P), e))
    is_like(np.array(errors), np.eye(18))
