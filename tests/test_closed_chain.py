"""A chain given loop closures: every mean and covariance is that of the dense problem."""

import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from dives import campaign_log, simulated
from scipy.linalg import block_diag

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from crossovers import SMALL, dive, matern
from fault_campaign.judge import nees

import rovgraph as rg
from rovgraph.geometry import log_rotation, right_jacobian
from rovgraph.inference import posterior as posterior_of
from rovgraph.inference.bottom import bottom_of
from rovgraph.inference.closed_chain import ClosedChain
from rovgraph.inference.crossovers import closed, with_crossovers
from rovgraph.inference.drift import Drift, LoopClosure
from rovgraph.inference.error_state import newest_known
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.initialise import initialise
from rovgraph.inference.posterior import Posterior
from rovgraph.inference.smoother import assemble, estimate_of, smoothed
from rovgraph.model.state import MOTION_STATE

CALIBRATION = {
    "dvl_scale": {"estimate": "considered", "sd": 0.01},
    "dvl_yaw": {"estimate": True, "sd_deg": 2.0},
    "mag_offset": {"estimate": True, "walk_deg": 0.1},
}
TIMES = (29.3, 3.1), (33.37, 14.2), (25.0, 16.6)
W = 900.0 * np.array([[1.0, 0.2], [0.2, 0.5]])
SHIFTS = np.array([[0.05, -0.03], [0.02, 0.06], [-0.04, 0.01]])
PLACE_SD = 0.05


@cache
def solved():
    """A short dive and its posterior."""
    case = simulated(rg.Config().with_values(calibration=CALIBRATION), 35.0, dvl_rate=3.0)
    initial = initialise(case.log, case.config)
    best = assemble(case.log, initial).optimum()
    assert best.unknowns.considered and best.wide.layout.walking
    return initial, Posterior.of(best, initial)


@cache
def conditioned():
    """Its optimum given three loop closures, and one on a chart whose place is uncertain."""
    known = solved()[1]
    closures = [LoopClosure(ends, W, W @ shift) for ends, shift in zip(TIMES, SHIFTS, strict=True)]
    closures.append(LoopClosure((22.2, np.inf), W, W @ (0.1, 0.2)))
    drift = Drift(np.array([0.0, 35.0]), np.zeros(4), np.eye(4), beams_sd=0.0).beside(np.array([0.02, 0.0]), PLACE_SD)
    return closures, *closed(known, drift, closures)


@cache
def dense():
    """Mean and covariance of all variables, chain and place of the chart, by inverting the whole information."""
    _, known = solved()
    root, best, closures = known._marginals().root, known.optimum, conditioned()[0]
    (n, d), c, h = root.conditionals.shape[:2], len(root.border), len(best.believed)
    R = np.zeros((n * d + c, n * d + c))
    for k, (rows, begin) in enumerate(zip(root.conditionals, range(0, n * d, d), strict=True)):
        R[begin : begin + d, begin : begin + d] = rows[:, :d]
        if k < n - 1:
            R[begin : begin + d, begin + d : begin + 2 * d] = rows[:, d : 2 * d]
        R[begin : begin + d, n * d :] = rows[:, 2 * d : 2 * d + c]
    R[n * d :, n * d :] = root.border[:, :-1]
    information, free = R.T @ R, n * d + c - h
    own = np.linalg.inv(information[:free, :free])
    by = np.vstack([-own @ information[:free, free:], np.eye(h)])
    P = block_diag(own, np.zeros((h, h))) + by @ best.believed @ by.T
    P = block_diag(P, PLACE_SD**2 * np.eye(2))
    H, mean = np.zeros((2 * len(closures), len(P))), np.zeros(len(P))
    mean[-2:] = 0.02, 0.0
    for row, closure in zip(H.reshape(len(closures), 2, -1), closures, strict=True):
        for sign, time in zip((1.0, -1.0), closure.times, strict=True):
            k = int(np.searchsorted(known.time, time)) - 1
            if not np.isfinite(time):
                row[:, -2:] += sign * np.eye(2)
                continue
            share = (time - known.time[k]) / (known.time[k + 1] - known.time[k])
            for j, part in ((k, 1.0 - share), (k + 1, share)):
                row[:, j * d + 3 : j * d + 6] += sign * part * best.state.R_nb[j, :2]
    noise = np.kron(np.eye(len(closures)), np.linalg.inv(W))
    gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + noise)
    gain[free : n * d + c] = 0.0  # of what is considered
    shifts = noise @ np.concatenate([one.pull for one in closures])
    keep = np.eye(len(P)) - gain @ H
    return mean + gain @ (shifts - H @ mean), keep @ P @ keep.T + gain @ noise @ gain.T


def turns(keyframes):
    """Derivative of an error about the new state by that about the old one."""
    before, after = solved()[1].optimum.state.R_nb, conditioned()[1].state.R_nb
    out = []
    for k in keyframes:
        turned = before[k].T @ after[k]
        rest = np.eye(conditioned()[1].step.x.shape[1] - 6)
        out.append(block_diag(right_jacobian(log_rotation(turned)), turned.T, rest))
    return out


def assert_covariance(P, expected):
    sd = np.sqrt(np.diagonal(expected))
    assert np.abs((P - expected) / np.outer(sd, sd)).max() < 1e-6


def test_every_state_and_constant_moves_as_in_the_dense_problem():
    best, (mean, P) = conditioned()[1], dense()
    n, d = best.step.x.shape
    expected = mean[: n * d].reshape(n, d)
    assert np.abs(expected).max(axis=0).min() > 0.0
    np.testing.assert_allclose(best.step.x, expected, atol=1e-9 + 1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(best.step.y, mean[n * d : -2], atol=1e-9)
    before, after = solved()[1].optimum.state, best.state
    assert np.array_equal(after.calibration["dvl_scale"], before.calibration["dvl_scale"])
    (yaw,) = best.wide.layout.places["dvl_yaw"][1:]
    moved = after.calibration["dvl_yaw"] - before.calibration["dvl_yaw"]
    np.testing.assert_allclose(moved, mean[n * d : -2][yaw], atol=1e-10)
    left = conditioned()[2]
    np.testing.assert_allclose(left.mean[-2:], mean[-2:], atol=1e-9)
    assert_covariance(left.P[-2:, -2:], P[-2:, -2:])


def test_marginal_covariances_are_those_of_the_dense_problem():
    best, (_, P) = conditioned()[1], dense()
    n, d = best.step.x.shape
    own = best.covariances()
    for k, turn in zip((0, 40, n - 1), turns((0, 40, n - 1)), strict=True):
        block = turn @ P[k * d : (k + 1) * d, k * d : (k + 1) * d] @ turn.T
        assert_covariance(own[MOTION_STATE][k], block[:15, :15])
        assert_covariance(own["mag_offset"][k], block[15:, 15:])
    border, part = best.wide.layout.places["dvl_yaw"]
    assert border
    assert_covariance(own["dvl_yaw"][0], P[n * d : -2, n * d : -2][part, part])
    assert own["dvl_scale"][0, 0, 0] == 0.01**2
    newest = block_diag(turns([n - 1])[0], np.eye(len(P) - 2 - n * d))
    newest = newest @ P[(n - 1) * d : -2, (n - 1) * d : -2] @ newest.T
    layout = best.wide.layout
    names = (*best.unknowns.estimated, *best.unknowns.considered)
    chosen = np.concatenate([np.arange(15), *(layout.target(name) for name in names)])
    assert_covariance(best.newest_covariance(), newest[np.ix_(chosen, chosen)])


def test_the_joint_covariance_is_that_of_the_dense_problem_and_of_the_track():
    initial, _ = solved()
    best, (_, P) = conditioned()[1], dense()
    estimate, d = estimate_of(best, {}, initial), best.step.x.shape[1]
    track, keyframes = estimate.trajectory, [10, 60]
    assert np.allclose(initial.config.imu.lever_arm_m, 0.0)
    joint, _ = estimate.posterior.at(track.time[keyframes])
    rows = np.concatenate([k * d + np.arange(15) for k in keyframes])
    turn = block_diag(*(one[:15, :15] for one in turns(keyframes)))
    assert_covariance(joint, turn @ P[np.ix_(rows, rows)] @ turn.T)
    for k in keyframes:
        one = estimate.covariance(track.time[k], axes="n").to_numpy()
        np.testing.assert_allclose(one[3:6, 3:6], track.cov_p[k], rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(one[:3, :3], track.cov_theta[k], rtol=1e-8, atol=1e-14)
    level = np.zeros((4, 30))
    for a, k in enumerate(keyframes):
        level[2 * a : 2 * a + 2, 15 * a + 3 : 15 * a + 6] = track.R_nb[k, :2]
    assert_covariance(estimate.posterior.horizontal(keyframes), level @ joint @ level.T)


def test_draws_have_the_joint_covariance():
    initial, _ = solved()
    estimate = estimate_of(conditioned()[1], {}, initial)
    track, keyframes = estimate.trajectory, [10, 60]
    own = np.array([one.p_n[keyframes, :2].ravel() for one in estimate.sample(4000, seed=1)])
    off = own - track.p_n[keyframes, :2].ravel()
    P = estimate.posterior.horizontal(keyframes)
    sd = np.sqrt(np.diagonal(P))
    assert np.abs((np.cov(off.T) - P) / np.outer(sd, sd)).max() < 0.07
    assert np.abs(off.mean(axis=0) / sd).max() < 0.08
    open_ = solved()[1].horizontal(keyframes)
    assert np.abs((P - open_) / np.outer(sd, sd)).max() > 0.3  # that of before would not pass


def test_of_a_long_dive_it_is_the_same(monkeypatch):
    known, best = solved()[1], conditioned()[1]
    P, pull = known.of_chain(best.keyframes.tolist()), np.zeros(len(best.root))
    whole = ClosedChain.of(known.optimum, best.keyframes, P, pull, best.root).covariances()[MOTION_STATE].copy()
    monkeypatch.setattr("rovgraph.inference.chain_optimum.SHORT", 10)
    monkeypatch.setattr(posterior_of, "KEPT", 10)
    again = ClosedChain.of(known.optimum, best.keyframes, P, pull, best.root)
    np.testing.assert_allclose(again.covariances()[MOTION_STATE], whole, rtol=1e-9, atol=1e-14)


def test_the_filters_newest_keyframe_is_that_of_the_dive():
    initial, known = solved()
    best, engine = conditioned()[1], FilterEngine(initial)
    before, after = newest_known(engine, known.optimum), newest_known(engine, best)
    np.testing.assert_allclose(after.x[9:12], best.state.p_n[-1])
    np.testing.assert_allclose(after.covariance[:15, :15], best.covariances()[MOTION_STATE][-1], rtol=1e-6, atol=1e-14)
    assert np.array_equal(after.L, before.L) and np.linalg.eigvalsh(after.P).min() > 0.0
    assert after.covariance[2, 2] < before.covariance[2, 2]  # the heading that turned the track is better known, too


@pytest.mark.slow
def test_of_surveys_the_compass_is_better_known_and_errors_are_as_large_as_they_say():
    """Dives with a compass whose offset, which no crossing shows, and deviation are drawn as they are stated."""
    found, spreads = [], []
    for seed in range(1000, 1010):
        made = dive(matern, seed, SMALL, 0.005)
        log, config = campaign_log(made)
        initial = initialise(log, config)
        before = smoothed(assemble(log, initial).optimum(), initial)
        bottom = bottom_of(log, initial.config, before)
        after, crossovers = with_crossovers(before, bottom, initial.beliefs, None, (0.0, 0.0))
        assert len(crossovers.closures) > 20
        spread, sds = [], []
        for one in (before, after):
            rows = one.trajectory.to_frame().query("time > 60.0")
            error = rows["yaw"].to_numpy() - made.motion.heading(rows["time"].to_numpy())
            spread.append(np.std(np.mod(error + np.pi, 2.0 * np.pi) - np.pi))
            sds.append([c.sd for c in one.calibration if c.label.startswith("ahrs_deviation")])
        spreads.append(spread)
        assert (np.array(sds[1]) < 0.5 * np.array(sds[0])).all()
        values, _, _ = nees(rows, made.motion)
        found.append([values["position"], values["heading"]])
    # in a dive it is almost one number: 99 % of chi-square of 20 and 10 degrees of freedom
    mean = np.mean(found, axis=0)
    assert 0.37 < mean[0] < 2.0 and 0.21 < mean[1] < 2.53
