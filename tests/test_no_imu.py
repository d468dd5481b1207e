"""A dive without an IMU: the vehicle's own attitude, a DVL, and a constant velocity in between."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
from dives import Simulated, as_log, attitude_errors, batch, changed, falcon, renewed, true_at, without
from scipy.stats import chi2

from rovgraph.config import Config
from rovgraph.geometry import Array, wrap_angle
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.simulate import Truth, scenario, simulate
from rovgraph.simulate.files import known
from rovgraph.trajectory import Trajectory

SEEDS = range(1, 25)
SECONDS, PING_RATE = 200.0, 1.0
QUANTITIES = ("position", "velocity", "attitude")
KINDS = ("smoothed", "filtered")
HEADING_SD, TILT_SD = np.deg2rad(1.0), np.deg2rad(0.5)


def drawn(seed: int) -> tuple[Simulated, Config]:
    """A dive whose IMU is silent, and what an estimator is told of it."""
    keys = {"heading": {"vehicle_sd_deg": 1.0}, "tilt": {"sd_deg": 0.5}, "motion": {"rate_sd_dps": 3.0}}
    config = changed(falcon(), **keys, dvl={"velocity_sd_mps": [0.02, 0.02, 0.02]})
    dive = simulate(
        scenario("falcon", SECONDS), Truth(config, start_error=True, dvl_rate=PING_RATE), np.random.default_rng(seed)
    )
    case = Simulated(config, dive, as_log(dive.log_frame))
    log = without(case.log, "imu", "mag", "ahrs", "dvl_heading")
    case = replace(case, log=with_attitude(log, case, np.random.default_rng(100 + seed)))
    return case, known(dive, config)


def with_attitude(log: Log, case: Simulated, rng: np.random.Generator) -> Log:
    """The log with roll, pitch and the magnetic heading of the body at each ping."""
    time, hidden = log["dvl"].time, case.dive.hidden["calibration"]
    rpy = true_at(case, time).rpy
    magnetic = rpy[:, 2] - np.deg2rad(case.config.environment.declination_deg)
    sine, cosine = hidden["vehicle_compass_deviation"]
    magnetic += hidden["vehicle_compass_offset"][0] + sine * np.sin(magnetic) + cosine * np.cos(magnetic)
    heading = wrap_angle(magnetic + HEADING_SD * rng.standard_normal(len(time)))
    tilt = rpy[:, :2] + TILT_SD * rng.standard_normal((len(time), 2))
    streams, row = dict(log.streams), log["dvl"].row
    for sensor, data in (("vehicle_heading", heading[:, None]), ("vehicle_tilt", tilt)):
        streams[sensor] = Stream(sensor, STREAMS[sensor], time, data, row)
    return replace(log, streams=streams)


def nees(trajectory: Trajectory, case: Simulated, epoch: int) -> Array:
    """Normalised error squared of position, velocity and attitude at one epoch, shape (3,)."""
    truth = true_at(case, trajectory.time)
    error = (trajectory.p_n - truth.p_n, trajectory.v_n - truth.v_n, attitude_errors(trajectory, case))
    covariance = (trajectory.cov_p, trajectory.cov_v, trajectory.cov_theta)
    return np.array([e[epoch] @ np.linalg.solve(P[epoch], e[epoch]) for e, P in zip(error, covariance, strict=True)])


def one_dive(seed: int) -> Array:
    """NEES smoothed at mid-dive and filtered at the end, and smoothed with too little process noise; (3, 3)."""
    case, config = drawn(seed)
    smoothed, filtered = batch(case.log, config).solve().trajectory, renewed(case.log, config).solve().trajectory
    stiff = batch(case.log, changed(config, motion={"acc": 1e-3, "gyr": 1e-2})).solve().trajectory
    middle = len(smoothed) // 2
    return np.array([nees(t, case, k) for t, k in ((smoothed, middle), (filtered, -1), (stiff, middle))])


def all_dives(seeds: range) -> Array:
    """NEES of many dives, shape (dives, 3 kinds, 3 quantities)."""
    with ProcessPoolExecutor(2) as pool:
        return np.array(list(pool.map(one_dive, seeds)))


if __name__ == "__main__":  # python tests/test_no_imu.py FIRST LAST: the same by hand, on other dives
    import sys

    first, last = (int(a) for a in sys.argv[1:3])
    found = all_dives(range(first, last))
    print("band", np.round(chi2.ppf([0.025, 0.975], 3 * len(found)) / len(found), 2), *QUANTITIES)
    for name, row in zip((*KINDS, "stiff"), found.mean(axis=0), strict=True):
        print(f"{name:14}", np.round(row, 2))
