"""Uncertainty is honest: over many dives the errors are as large as the estimate says.

Each truth is drawn from what the estimator believes: start, biases, calibration and noise.
The normalised error squared (NEES) of position, velocity and attitude, summed over
independent dives, then follows a chi-square distribution (Bar-Shalom et al. 2001, 5.4.2).
Losses are the defaults (Huber).
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from dives import Simulated, as_log, attitude_errors, batch, changed, falcon, incremental, renewed, true_at
from scipy.stats import chi2

from rovgraph.geometry import Array
from rovgraph.inference.trajectory import Trajectory
from rovgraph.model.config import Config
from rovgraph.simulate import Truth, scenario, simulate
from rovgraph.simulate.files import known

SEEDS = range(1, 25)
SECONDS, PING_RATE = 100.0, 2.5  # fewer pings than a real DVL
QUANTITIES = ("position", "velocity", "attitude")
KINDS = ("smoothed", "filtered", "smoothed with a boastful DVL")
OF_ISAM2 = ("isam2 smoothed", "isam2 filtered")
OVERCONFIDENT = 3.0


def drawn(seed: int) -> tuple[Simulated, Config]:
    """A dive, and the configuration an estimator is given: the planned start and an uncertain heading."""
    config, rng = falcon(), np.random.default_rng(seed)
    dive = simulate(scenario("falcon", SECONDS), Truth(config, start_error=True, dvl_rate=PING_RATE), rng)
    case = Simulated(config, dive, as_log(dive.log_frame))
    heading = np.rad2deg(dive.truth.rpy[0, 2]) + config.start.heading_sd_deg * rng.standard_normal()
    down = float(dive.truth.p_n[0, 2] - dive.hidden["start_offset"][2])
    return case, changed(known(dive, config), start={"heading_deg": float(heading), "down_m": down})


def nees(trajectory: Trajectory, case: Simulated, epoch: int) -> Array:
    """Normalised error squared of position, velocity and attitude at one epoch, shape (3,)."""
    truth = true_at(case, trajectory.time)
    error = (trajectory.p_n - truth.p_n, trajectory.v_n - truth.v_n, attitude_errors(trajectory, case))
    covariance = (trajectory.cov_p, trajectory.cov_v, trajectory.cov_theta)
    return np.array([e[epoch] @ np.linalg.solve(P[epoch], e[epoch]) for e, P in zip(error, covariance, strict=True)])


def one_dive(seed: int) -> Array:
    """NEES of one dive: smoothed at mid-dive and filtered at the end, smoothed with a boastful DVL; (3, 3)."""
    case, config = drawn(seed)
    smoothed = batch(case.log, config).solve().trajectory
    filtered = renewed(case.log, config).solve().trajectory
    sd = [s / OVERCONFIDENT for s in config.dvl.velocity_sd_mps]
    boastful = batch(case.log, changed(config, dvl={"velocity_sd_mps": sd})).solve().trajectory
    middle = len(smoothed) // 2
    return np.array([nees(smoothed, case, middle), nees(filtered, case, -1), nees(boastful, case, middle)])


def one_dive_of_isam2(seed: int) -> Array:
    """NEES of one dive by iSAM2: smoothed at mid-dive, filtered at the end; (2, 3)."""
    case, config = drawn(seed)
    isam2 = incremental(case.log, config)
    smoothed, filtered = isam2.solve().trajectory, isam2.filtered().trajectory
    return np.array([nees(smoothed, case, len(smoothed) // 2), nees(filtered, case, -1)])


def all_dives(seeds: range, one: Callable[[int], Array] = one_dive) -> Array:
    """NEES of many dives, shape (dives, kinds, 3 quantities)."""
    with ProcessPoolExecutor(2) as pool:
        return np.array(list(pool.map(one, seeds)))


@pytest.fixture(scope="session")
def mean_nees() -> Array:
    return np.asarray(all_dives(SEEDS).mean(axis=0))


@pytest.fixture(scope="session")
def mean_nees_of_isam2() -> Array:
    return np.asarray(all_dives(SEEDS, one_dive_of_isam2).mean(axis=0))


def band(dives: int) -> tuple[float, float]:
    """Within which the mean NEES of 3 components lies with 95 %."""
    low, high = chi2.ppf([0.025, 0.975], 3 * dives) / dives
    return float(low), float(high)


@pytest.mark.parametrize("quantity", range(3), ids=QUANTITIES)
@pytest.mark.parametrize("kind", range(2), ids=KINDS[:2])
def test_errors_are_as_large_as_the_estimate_says(mean_nees, kind, quantity):
    low, high = band(len(SEEDS))
    assert low < mean_nees[kind, quantity] < high


@pytest.mark.slow
@pytest.mark.parametrize("quantity", range(3), ids=QUANTITIES)
@pytest.mark.parametrize("kind", range(2), ids=OF_ISAM2)
def test_errors_are_as_large_as_isam2_says(mean_nees_of_isam2, kind, quantity):
    low, high = band(len(SEEDS))
    assert low < mean_nees_of_isam2[kind, quantity] < high


def test_a_dvl_declared_three_times_too_good_is_found_out(mean_nees):
    assert (mean_nees[2] > band(len(SEEDS))[1]).any()


if __name__ == "__main__":  # python tests/test_consistency.py FIRST LAST: the same by hand, on other dives
    import sys

    first, last = (int(a) for a in sys.argv[1:3])
    seeds = range(first, last)
    found = np.concatenate([all_dives(seeds), all_dives(seeds, one_dive_of_isam2)], axis=1)
    print("band", np.round(band(len(found)), 2), *QUANTITIES)
    for name, row in zip((*KINDS, *OF_ISAM2), found.mean(axis=0), strict=True):
        print(f"{name:30}", np.round(row, 2))
