"""Errors that last: first-order Gauss-Markov processes in filter, smoother, iSAM2 and simulator."""

import numpy as np
import pytest
from dives import changed, falcon, incremental, renewed, rms, simulated, smoothed, true_at
from scipy.stats import chi2

from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.initialise import initialise
from rovgraph.inference.optimum import joint_prior_sd
from rovgraph.inference.smoother import assemble, newest_calibration
from rovgraph.model.calibration import LAYOUT
from rovgraph.model.config import beliefs, parse_config
from rovgraph.model.gauss_markov import stationary_walk, walked
from rovgraph.model.state import POSE
from rovgraph.simulate import Truth
from rovgraph.simulate.dive import draw_lasting
from rovgraph.simulate.files import known

FIXES = {"fix": {"sd_m": 0.1}, "start": {"position_sd_m": 0.1}}
LASTING = {"fix_error": {"estimate": True, "sd": 1.0, "time_constant_s": 20.0}}
SLOW = {"dvl_rate": 2.0, "imu_rate": 50.0, "fix_interval": 1.0, "start_error": True}


def optimum_of(log, config):
    return assemble(log, initialise(log, config)).optimum()


@pytest.fixture(scope="module")
def case():
    return simulated(falcon(**FIXES, calibration=LASTING), 60.0, seed=3, **SLOW)


@pytest.fixture(scope="module")
def best(case):
    return optimum_of(case.log, case.config)


def test_variance_is_stationary_however_time_is_divided():
    walk = stationary_walk(0.7, 30.0)
    for seconds in (0.01, 3.0, 300.0):
        kept, sd = walked(walk, 30.0, seconds)
        assert kept**2 * 0.7**2 + sd**2 == pytest.approx(0.7**2)
    (kept, sd), (half, half_sd) = walked(walk, 30.0, 8.0), walked(walk, 30.0, 4.0)
    assert kept == pytest.approx(half**2) and sd**2 == pytest.approx((1 + half**2) * half_sd**2)


def test_a_time_constant_without_end_is_a_random_walk():
    kept, sd = walked(0.2, np.array([np.inf, 1e9]), 9.0)
    np.testing.assert_array_equal(kept[0], 1.0)
    np.testing.assert_allclose(sd, 0.6, rtol=1e-6)


def test_sd_of_an_error_stays_where_nothing_measures_it(best):
    for keyframe in (0, len(best.problem) // 2, len(best.problem) - 1):
        np.testing.assert_allclose(joint_prior_sd(best, keyframe)["fix_error"], 1.0)


def test_prediction_is_the_process_and_its_mean():
    config = falcon(calibration={"current": {"mean": [0.3, -0.2], "sd": 0.1, "time_constant_s": 5.0}})
    case = simulated(config, 32.0, water_track=True, **SLOW)
    dive = assemble(case.log, initialise(case.log, case.config))
    engine = FilterEngine(dive.initial)
    before, time = engine.start(), dive.problem.time
    own, seconds = engine.layout.columns["current"], time[5] - time[4]
    before.c[LAYOUT["current"]] = 1.3, 0.8
    before.P[own, own] *= 0.25
    before.P[own, 0:3] = before.P[0:3, own].T[:] = 1e-4
    done = engine.predict(dive.problem, 5, before)
    kept = np.exp(-seconds / 5.0)
    np.testing.assert_allclose(done.predicted.c[LAYOUT["current"]], [0.3 + kept, -0.2 + kept])
    expected = done.F @ before.P @ done.F.T + done.Q
    np.testing.assert_allclose(done.predicted.P, expected, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(np.diag(done.predicted.P[own, own]), 0.01 * (1 - kept**2 * 0.75))


def test_the_filter_ends_where_the_smoother_does(case, best):
    end = renewed(case.log, case.config).known
    own = FilterEngine(initialise(case.log, case.config)).layout.columns["fix_error"]
    there, P = newest_calibration(best.state.calibration)["fix_error"], best.covariances()["fix_error"][-1]
    sd = np.sqrt(np.diag(P))
    np.testing.assert_allclose(np.sqrt(np.diag(end.P[own, own])), sd, rtol=0.02)
    assert (np.abs(end.c[LAYOUT["fix_error"]] - there) < 0.1 * sd).all()


def test_isam2_knows_position_as_well_as_the_smoother_does(case, best):
    """Of the error its newest value belongs to the newest fix, not to the keyframe before: it is compared roughly."""
    solver = incremental(case.log, case.config)
    there, P = newest_calibration(best.state.calibration)["fix_error"], best.covariances()["fix_error"][-1]
    assert (np.abs(solver.latest().calibration["fix_error"].ravel() - there) < np.sqrt(np.diag(P))).all()
    sd = np.sqrt(np.diag(best.covariances()[POSE][-1])[3:])
    np.testing.assert_allclose(np.sqrt(np.diag(solver.known.P)[3:6]), sd, rtol=0.05)


def test_without_noise_an_error_is_found():
    """The start is known to the centimetre, so what the fixes say at first is their error."""
    config = falcon(fix={"sd_m": 0.01}, start={"position_sd_m": 0.01}, calibration=LASTING)
    true = {"fix_error": np.array([0.8, -0.5])}
    case = simulated(config, 40.0, noise=False, calibration=true, **{**SLOW, "start_error": False})
    found = optimum_of(case.log, case.config)
    off = found.state.calibration["fix_error"] - true["fix_error"]
    assert np.abs(off[:20]).max() < 0.03
    assert (np.abs(off) < 3 * np.sqrt(np.diagonal(found.covariances()["fix_error"], axis1=1, axis2=2))).all()


def test_a_simulated_error_has_the_sd_and_the_time_constant_that_are_believed():
    config = parse_config("calibration: {ahrs_error: {estimate: true, sd_deg: 2, time_constant_s: 10}}")
    rng = np.random.default_rng(0)
    zero = {name: belief.mean for name, belief in beliefs(config).items()}
    values = draw_lasting(Truth(config), zero, 4e4, rng).at(np.arange(0.0, 4e4, 1.0))["ahrs_error"][:, 0]
    assert np.rad2deg(rms(values)) == pytest.approx(2.0, rel=0.1)
    assert np.mean(values[10:] * values[:-10]) / rms(values) ** 2 == pytest.approx(np.exp(-1.0), abs=0.05)


def test_a_simulated_dive_begins_with_the_draw_and_says_how_the_error_goes_on(case):
    time, values = case.dive.hidden["lasting"].series["fix_error"]
    np.testing.assert_allclose(
        case.dive.hidden["calibration"]["fix_error"],
        np.array([np.interp(case.truth.time[-1], time, v) for v in values.T]),
    )
    fixes = case.log["fix"]
    at = case.dive.path.motion(fixes.time).p_n[:, :2] + case.dive.hidden["lasting"].at(fixes.time)["fix_error"]
    assert rms(fixes.data[:, :2] - at) < 0.5 < rms(values)


def normalised(case, config) -> float:
    """Normalised error squared of north and east at the end."""
    trajectory = smoothed(case.log, config).trajectory
    off = (trajectory.p_n - true_at(case, trajectory.time).p_n)[-1, :2]
    return float(off @ np.linalg.solve(trajectory.cov_p[-1, :2, :2], off))


def test_errors_are_as_large_as_the_estimate_says_once_the_process_is_believed():
    """And a white belief, the only one before, is found out by the same dives."""
    config = falcon(**FIXES, calibration={"fix_error": {**LASTING["fix_error"], "time_constant_s": 30.0}})
    cases = [simulated(config, 60.0, seed=seed, **SLOW) for seed in range(1, 9)]
    low, high = chi2.ppf([0.005, 0.995], 2 * len(cases)) / len(cases)
    white = changed(config, calibration={"fix_error": {"estimate": False}}, fix={"sd_m": 1.0})
    assert low < np.mean([normalised(case, known(case.dive, config)) for case in cases]) < high
    assert np.mean([normalised(case, known(case.dive, white)) for case in cases]) > high
