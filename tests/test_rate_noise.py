"""The gyro's noise in the DVL's arm: it feigns information and draws the arm to zero; what is left of both is right."""

from functools import cache

import numpy as np
import pytest
from dives import batch, falcon, simulated, started

from rovgraph.engine.chain_optimum import ChainOptimum
from rovgraph.engine.rate_noise import ARM, feigned, noise_moves_arm
from rovgraph.engine.released import release
from rovgraph.estimators.dive import Dive, smooth
from rovgraph.estimators.observability import relative_sd
from rovgraph.simulate.path import Style

CALM = Style()  # no waves
SEEDS = range(1, 9)
NOISY = {"imu": {"noise": {"gyr": 2e-3}}}  # [rad/s/rtHz], three times an MTi's
CONSIDERED = {ARM: {"estimate": "considered"}}


@cache
def calm(seed: int, noisy: bool) -> ChainOptimum:
    """A dive of a minute, its DVL where it is believed to be."""
    config = falcon(calibration=CONSIDERED, **(NOISY if noisy else {}))
    case = simulated(config, 60.0, seed=seed, style=CALM, calibration={ARM: [0.0, 0.0, 0.0]})
    best = batch(case.log, started(case)).optimum()
    assert isinstance(best, ChainOptimum)
    return best


def least_squares_sd(best: ChainOptimum) -> np.ndarray:
    return best.relative_sd()[ARM] * best.beliefs[ARM].sd


@pytest.mark.parametrize("seed", SEEDS[:2])
def test_least_squares_draws_the_arm_to_zero_as_far_as_is_said(seed):
    """Of a gyro three times as noisy as an MTi most of the arm is lost, at a small sd."""
    best = calm(seed, noisy=True)
    arm = next(b for s, b in best.blocks.items() if s == "dvl").instrument.model.lever_arm_b
    found, sd = best.estimating([ARM]).state.calibration[ARM], least_squares_sd(best)
    assert (np.abs(found) > 4.0 * sd).all()
    assert np.allclose(found, -np.sign(arm) * feigned(best).drawn(sd), atol=0.3 * np.abs(arm))


def test_a_released_arm_is_right_without_what_is_feigned():
    steps = {label: [] for label in ("dvl_lever_arm_x", "dvl_lever_arm_y", "dvl_lever_arm_z")}
    for seed in SEEDS:
        for one in release(calm(seed, noisy=False), [ARM]):
            steps[one.label].append(one.step / one.sd)
    for values in steps.values():  # with chi-square's 99.9 % quantile of 8; as least squares has it, x has 14
        assert len(values) == len(SEEDS) and np.mean(np.square(values)) < 26.1 / 8.0


def test_nothing_is_said_of_an_arm_whose_information_is_feigned():
    best = calm(1, noisy=True)
    assert (feigned(best).share(least_squares_sd(best)) > 0.5).any()
    assert len(release(best, [ARM])) < 3


def test_an_arm_that_noise_moves_stays_considered():
    best = calm(1, noisy=True)
    assert noise_moves_arm(best, least_squares_sd(best)) and ARM in best.unknowns.considered


def test_the_verdict_on_an_arm_knows_what_is_feigned():
    best = calm(1, noisy=True).estimating([ARM])
    prior, sd = {ARM: np.full(3, best.beliefs[ARM].sd)}, least_squares_sd(calm(1, noisy=True))
    assert (relative_sd(best, np.diag(sd**2), prior)[ARM] > 0.9).any() and (sd / prior[ARM] < 0.5).all()


def test_an_estimated_arm_is_right_without_what_is_feigned():
    """Least squares draws x by 4 sds in these dives."""
    off, truth = [], [0.1, -0.05, 0.03]
    for seed in SEEDS:
        case = simulated(
            falcon(calibration={ARM: {"estimate": True}}), 60.0, seed, style=CALM, calibration={ARM: truth}
        )
        rows = [c for c in batch(case.log, started(case)).solve().calibration if c.label.startswith(ARM)]
        assert all(row.estimated for row in rows)
        off.append([(row.value - true) / row.sd for row, true in zip(rows, truth, strict=True)])
    assert (np.mean(np.square(off), axis=0) < 26.1 / 8.0).all()


def moved_by_noise(offset: float) -> Dive:
    """A dive without waves whose gyro's noise would move the arm's z, its DVL to starboard of where it is stated."""
    config = falcon(calibration=CONSIDERED, imu={"noise": {"gyr": 1.5e-3}})
    case = simulated(config, 90.0, seed=2, style=CALM, calibration={ARM: [0.0, offset, 0.0]})
    return smooth(case.log, started(case))


def test_a_dvl_that_is_elsewhere_is_found_said_and_used():
    dive = moved_by_noise(0.2)
    said = [line for line in dive.assumptions if "elsewhere" in line]
    assert len(said) == 1 and "(calibration.dvl_lever_arm)" in said[0] and not dive.warnings
    mean = np.array(dive.initial.config.calibration.dvl_lever_arm.mean)
    assert abs(mean[1] - 0.2) < 0.05
    assert dive.estimates[0].summary["considered"] == [ARM]


def test_a_dvl_in_its_place_is_left_there():
    dive = moved_by_noise(0.0)
    assert not any("elsewhere" in line for line in dive.assumptions)
    assert dive.initial.config.calibration.dvl_lever_arm.mean is None
