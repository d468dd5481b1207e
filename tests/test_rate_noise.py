"""The gyro's noise in the DVL's arm adds spurious information and draws arm and scale; what is left is right."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from dives import batch, falcon, interrupted, renewed, simulated, started, without

from rovgraph.dive import DiveEstimates, smooth
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.gauss_newton import COARSE
from rovgraph.inference.observability import OBSERVABLE_BELOW, relative_sd, shown
from rovgraph.inference.optimum import NEWEST, estimated_parts
from rovgraph.inference.rate_noise import ARM, score_of_rate_noise
from rovgraph.inference.score_test import score_test
from rovgraph.lab.observability import observe
from rovgraph.simulate.path import Style

CALM = Style()  # no waves
SEEDS = range(1, 9)
NEAR, FAR = 0.86 / 8.0, 26.1 / 8.0  # between them is the mean square of eight normal numbers but once in 500
USUAL, NOISY = 7e-4, 2e-3  # of the gyro: an MTi's, and three times that [rad/s/rtHz]


def optimum(
    seed: int, gyr: float = USUAL, estimate: bool | str = "considered", silent_s: float = 0.0, seconds: float = 60.0
) -> ChainOptimum:
    """A calm dive, its DVL where it is believed to be, and silent at the end."""
    config = falcon(calibration={ARM: {"estimate": estimate}}, imu={"noise": {"gyr": gyr}})
    case = simulated(config, seconds, seed=seed, style=CALM, calibration={ARM: [0.0, 0.0, 0.0]})
    log = interrupted(case.log, seconds - silent_s, silent_s + 1.0, "dvl") if silent_s else case.log
    best = batch(log, started(case)).optimum()
    assert isinstance(best, ChainOptimum)
    return best


calm = cache(optimum)


def least_squares_sd(best: ChainOptimum) -> np.ndarray:
    return best.relative_sd()[ARM] * best.beliefs[ARM].sd


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_least_squares_draws_the_arm_to_zero_as_far_as_is_said(seed):
    """Of a gyro three times as noisy as an MTi most of the arm is lost, at a small sd."""
    best = calm(seed, NOISY)
    arm = best.blocks["dvl"].instrument.model.lever_arm_b
    found, sd = best.estimating([ARM]).state.calibration[ARM], least_squares_sd(best)
    assert (np.abs(found) > 4.0 * sd).all()
    assert np.allclose(found, -np.sign(arm) * score_of_rate_noise(best).drawn(sd), atol=0.3 * np.abs(arm))


def test_a_released_arm_is_right_without_what_is_spurious():
    steps: dict[str, list[float]] = {label: [] for label in calm(1).beliefs[ARM].variable.labels}
    for seed in SEEDS:
        for one in score_test(calm(seed), [ARM]):
            steps[one.label].append(one.step / one.sd)
    for values in steps.values():
        assert len(values) == len(SEEDS) and NEAR < np.mean(np.square(values)) < FAR


def test_an_estimated_arm_is_right_where_least_squares_is_off():
    off, least_squares, truth = [], [], np.array([0.1, -0.05, 0.03])
    for seed in SEEDS:
        config = falcon(calibration={ARM: {"estimate": True}}, imu={"noise": {"gyr": 0.5 * USUAL}})
        case = simulated(config, 60.0, seed=seed, style=CALM, calibration={ARM: truth})
        best = batch(case.log, started(case)).optimum()
        assert isinstance(best, ChainOptimum) and ARM in best.unknowns.estimated
        plain = replace(best.chain, beliefs={**best.beliefs, ARM: replace(best.beliefs[ARM], score=0.0)})
        sd = np.sqrt(np.diag(best.newest_covariance())[NEWEST:][estimated_parts(best)[ARM]])
        drawn = plain.moved(best.state, plain.step(best.state, best.solution.gates), 1.0).calibration[ARM]
        off.append((best.state.calibration[ARM] - truth) / sd)
        least_squares.append((drawn - truth) / sd)
    assert (np.mean(np.square(off), axis=0) < FAR).all()
    assert np.mean(np.square(least_squares), axis=0).max() > FAR


def test_noise_draws_no_scale_of_the_dvl_in_smoother_and_filter():
    """Least squares and a filter linearised at its prediction are 3.5 sd too low on average."""
    off = []
    for seed in SEEDS[:6]:
        config = falcon(calibration={"dvl_scale": {"estimate": True, "sd": 0.02}}, imu={"noise": {"gyr": 2.0 * USUAL}})
        case = simulated(config, 200.0, seed=seed, style=CALM, calibration={"dvl_scale": 0.005})
        log, config = without(case.log, "fix"), started(case)
        found = [est.solve().calibration for est in (batch(log, config), renewed(log, config))]
        scales = [one for rows in found for one in rows if one.label == "dvl_scale"]
        off.append([(one.value - 0.005) / one.sd for one in scales])
    assert (np.abs(np.mean(off, axis=0)) < 3.0 / np.sqrt(len(off))).all()


def test_a_released_scale_is_not_drawn_by_noise():
    """Least squares alone is 3.4 sd too low on average."""
    off = []
    for seed in SEEDS[:6]:
        config = falcon(calibration={"dvl_scale": {"estimate": False}}, imu={"noise": {"gyr": 2.0 * USUAL}})
        case = simulated(config, 200.0, seed=seed, style=CALM, calibration={"dvl_scale": 0.01})
        best = batch(without(case.log, "fix"), started(case)).optimum()
        assert isinstance(best, ChainOptimum)
        (scale,) = score_test(best, ["dvl_scale"])
        off.append((scale.step - 0.01) / scale.sd)
    assert abs(np.mean(off)) < 3.0 / np.sqrt(len(off))


def test_the_score_is_the_derivative_of_the_cost():
    """At its optimum the cost with a score rises to both sides of the arm, by the same."""
    best = calm(1, 0.5 * USUAL, True)
    assert isinstance(best.beliefs[ARM].score, np.ndarray) and (np.abs(best.beliefs[ARM].score) > 10.0).any()
    step = best.chain.step(best.state, best.solution.gates)
    assert best.chain.promised(step) < COARSE
    there = replace(step, x=np.zeros_like(step.x), y=np.zeros_like(step.y))
    part = best.chain.layout.places[ARM][1]
    for k in range(3):
        y = np.zeros_like(step.y)
        y[part.start + k] = 0.01
        up, down = (
            best.chain.cost(best.chain.moved(best.state, replace(there, y=s * y), 1.0), best.solution.gates)
            for s in (1.0, -1.0)
        )
        middle = best.chain.cost(best.state, best.solution.gates)
        assert min(up, down) > middle and abs(up - down) < 0.2 * (up + down - 2.0 * middle)


def test_nothing_is_said_of_an_arm_whose_information_is_mostly_spurious():
    best = calm(1, NOISY)
    shares = score_of_rate_noise(best).share(least_squares_sd(best))
    assert len(score_test(best, [ARM])) == (shares < 0.5).sum() < 3


def test_an_arm_that_noise_moves_stays_considered_though_least_squares_shows_it():
    best = optimum(1, NOISY, seconds=120.0)
    assert (best.relative_sd()[ARM] < OBSERVABLE_BELOW).all() and ARM in best.unknowns.considered
    assert ARM not in shown(best)


def test_an_arm_that_noise_moves_is_considered_though_it_is_to_be_estimated():
    best = calm(1, NOISY, True)
    assert ARM in best.unknowns.considered and np.all(best.beliefs[ARM].score == 0.0)
    assert np.array_equal(best.state.calibration[ARM], best.beliefs[ARM].mean)


def test_a_silent_end_changes_little_of_what_is_spurious():
    whole, silent = calm(1), optimum(1, silent_s=8.0)
    ratio = score_of_rate_noise(silent).information / score_of_rate_noise(whole).information
    assert (ratio < 52.0 / 60.0 + 0.02).all() and (ratio > 0.8 * 52.0 / 60.0).all()


def test_the_verdict_on_an_arm_knows_what_is_spurious():
    best = calm(1, NOISY)
    prior, sd = {ARM: np.full(3, best.beliefs[ARM].sd)}, least_squares_sd(best)
    ratio = relative_sd(best.estimating([ARM]), np.diag(sd**2), prior)[ARM]
    assert (ratio > 0.9).any() and (sd / prior[ARM] < 0.5).all()


def test_observe_knows_what_is_spurious():
    config = falcon(imu={"noise": {"gyr": NOISY}})
    case = simulated(config, 60.0, seed=1, style=CALM, calibration={ARM: [0.0, 0.0, 0.0]})
    seen = observe(case.log, started(case), also=[ARM])
    sds = {label: seen.relative[-1, k] for k, label in enumerate(seen.labels) if label.startswith(ARM)}
    assert len(sds) == 3 and sds["dvl_lever_arm_z"] > 0.7


def moved_by_noise(offset: float, estimate: bool | str = "considered") -> DiveEstimates:
    """A dive without waves whose gyro's noise would move the arm's z, its DVL to starboard of where it is stated."""
    config = falcon(calibration={ARM: {"estimate": estimate}}, imu={"noise": {"gyr": 1.5e-3}})
    case = simulated(config, 90.0, seed=2, style=CALM, calibration={ARM: [0.0, offset, 0.0]})
    return smooth(case.log, started(case))


@pytest.mark.slow
@pytest.mark.parametrize("estimate", ["considered", True])
def test_a_dvl_that_is_elsewhere_is_found_said_and_used(estimate):
    dive = moved_by_noise(0.2, estimate)
    said = [line for line in dive.assumptions if "elsewhere" in line]
    assert len(said) == 1 and "(calibration.dvl_lever_arm)" in said[0] and not dive.warnings
    mean = dive.initial.beliefs["dvl_lever_arm"].mean
    assert abs(mean[1] - 0.2) < 0.05


def test_a_dvl_in_its_place_is_left_there():
    dive = moved_by_noise(0.0)
    assert not any("elsewhere" in line for line in dive.assumptions)
    assert not dive.initial.revealed.calibration


def test_beams_add_the_spurious_information_of_the_velocity_that_they_make():
    """But for the rate's noise, which each row of a beam has by itself."""
    head = {
        "beams": {"angle_deg": 22.5, "azimuth_deg": [135, 225, 315, 45]},
        "velocity_sd_mps": [0.005, 0.005, 0.00146],
    }
    case = simulated(falcon(dvl=head), 60.0, style=CALM, calibration={ARM: [0.0, 0.0, 0.0]})
    along, whole = (
        score_of_rate_noise(batch(case.log, started(case, dvl={"use": use})).optimum()) for use in ("beams", "velocity")
    )
    ratio = along.information / whole.information
    assert (ratio > 0.7).all() and (ratio < 1.2).all()
    assert np.allclose(along.score / whole.score, ratio, rtol=0.1)
