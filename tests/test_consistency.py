"""Uncertainty is honest: over many dives the errors are as large as the estimate says.

Each truth is drawn from what the estimator believes: start, biases, calibration and noise.
The normalised error squared (NEES) of position, velocity and attitude, summed over
independent dives, then follows a chi-square distribution (Bar-Shalom et al. 2001, 5.4.2).
Losses are the defaults (Huber).
"""

from concurrent.futures import ProcessPoolExecutor

import numpy as np
import pytest
from dives import Simulated, as_log, attitude_errors, batch, changed, falcon, incremental, renewed, true_at
from scipy.stats import chi2

from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.simulate import Truth, scenario, simulate
from rovgraph.simulate.files import known
from rovgraph.trajectory import Trajectory

SEEDS = range(1, 25)
SECONDS, PING_RATE = 100.0, 2.5  # fewer pings than a real DVL
QUANTITIES = ("position", "velocity", "attitude")
KINDS = ("smoothed", "filtered", "isam2 smoothed", "isam2 filtered")
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
    """NEES of one dive: smoothed at mid-dive and filtered at the end, twice, smoothed with a boastful DVL; (5, 3)."""
    case, config = drawn(seed)
    smoothed = batch(case.log, config).solve().trajectory
    filtered = renewed(case.log, config).solve().trajectory
    isam2 = incremental(case.log, config)
    whole, newest = isam2.solve().trajectory, isam2.filtered().trajectory
    sd = [s / OVERCONFIDENT for s in config.dvl.velocity_sd_mps]
    boastful = batch(case.log, changed(config, dvl={"velocity_sd_mps": sd})).solve().trajectory
    middle = len(smoothed) // 2
    ends = [(smoothed, middle), (filtered, -1), (whole, middle), (newest, -1), (boastful, middle)]
    return np.array([nees(trajectory, case, epoch) for trajectory, epoch in ends])


def all_dives(seeds: range) -> Array:
    """NEES of many dives, shape (dives, 5 kinds, 3 quantities)."""
    with ProcessPoolExecutor(2) as pool:
        return np.array(list(pool.map(one_dive, seeds)))


@pytest.fixture(scope="session")
def mean_nees() -> Array:
    return np.asarray(all_dives(SEEDS).mean(axis=0))


def band(dives: int) -> tuple[float, float]:
    """Within which the mean NEES of 3 components lies with 95 %."""
    low, high = chi2.ppf([0.025, 0.975], 3 * dives) / dives
    return float(low), float(high)


@pytest.mark.parametrize("quantity", range(3), ids=QUANTITIES)
@pytest.mark.parametrize("kind", range(4), ids=KINDS)
def test_errors_are_as_large_as_the_estimate_says(mean_nees, kind, quantity):
    low, high = band(len(SEEDS))
    assert low < mean_nees[kind, quantity] < high


def test_a_dvl_declared_three_times_too_good_is_found_out(mean_nees):
    assert (mean_nees[4] > band(len(SEEDS))[1]).any()


if __name__ == "__main__":  # python tests/test_consistency.py FIRST LAST: the same by hand, on other dives
    import sys

    first, last = (int(a) for a in sys.argv[1:3])
    found = all_dives(range(first, last))
    print("band", np.round(band(len(found)), 2), *QUANTITIES)
    for name, row in zip((*KINDS, "overconfident"), found.mean(axis=0), strict=True):
        print(f"{name:14}", np.round(row, 2))
