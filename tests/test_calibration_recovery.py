"""What a lively dive shows of each calibration variable: without noise the truth is found, and known to be near."""

from functools import cache

import numpy as np
import pytest
from dives import (
    Simulated,
    batch,
    changed,
    falcon,
    incremental,
    position_errors,
    renewed,
    rms,
    simulated,
    started,
)

from rovgraph.geometry import Array
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.graph.isam2 import IncrementalEstimator
from rovgraph.log import Log
from rovgraph.model.calibration import LAYERS, TABLE
from rovgraph.model.config import Config

DEG = float(np.deg2rad(1.0))
TRUTH: dict[str, list[float]] = {
    "dvl_roll": [np.pi + 1.5 * DEG],
    "dvl_pitch": [-1.0 * DEG],
    "dvl_yaw": [49.0 * DEG],
    "dvl_scale": [0.01],
    "dvl_lever_arm": [0.05, -0.04, 0.03],
    "dvl_time_offset": [0.15],
    "hard_iron": [0.02, -0.01, 0.03],
    "soft_iron": [0.02, -0.015, 0.01, 0.01, -0.02, 0.015],
    "depth_offset": [0.2],
    "current": [0.1, -0.15],
}
HELD = {"field_dip": {"estimate": False}, "field_scale": {"estimate": False}}  # what soft iron is told from
SECONDS, PINGS = 80.0, 3.0  # [s], [Hz]
REQUIRED_S = 0.02  # of a DVL's time offset
OFFSET = "dvl_time_offset"


@cache
def everything() -> Simulated:
    """A dive without noise in which every variable is off."""
    # of a gyro's noise that is not there nothing must be taken off
    config = falcon(calibration={name: {"estimate": True} for name in TRUTH} | HELD, imu={"noise": {"gyr": 1e-5}})
    truth = {name: np.array(value) for name, value in TRUTH.items()}
    return simulated(config, SECONDS, noise=False, calibration=truth, water_track=True, dvl_rate=PINGS)


def errors(estimate: Estimate, name: str, true: list[float]) -> tuple[Array, Array]:
    """Error and sd of a variable's components, shape (dim,)."""
    found = {e.label: e for e in estimate.calibration}
    of = [found[label] for label in TABLE[name].labels]
    return np.array([e.value for e in of]) - true, np.array([e.sd for e in of])


@cache
def estimates() -> dict[str, Estimate]:
    case = everything()
    config = started(case)
    return {"batch": batch(case.log, config).solve(), "filter": renewed(case.log, config).solve()}


@pytest.mark.parametrize("name", TRUTH)
@pytest.mark.parametrize("kind", ["batch", "filter"])
def test_a_lively_dive_shows_the_variable_among_all_others(kind, name):
    error, sd = errors(estimates()[kind], name, TRUTH[name])
    assert (np.abs(error) < sd).all()  # without noise only the prior pulls
    assert (sd < 0.75 * TABLE[name].sd).all()  # the dive has shown something of it


def late(offset: float, sd: float, seconds: float = 50.0, noise: bool = False) -> Simulated:
    """A dive with late stamps, and a configuration that expects them to be off by ``sd``."""
    others = {name: {"estimate": False} for name in TABLE if name not in LAYERS}
    config = falcon(calibration=others | {OFFSET: {"estimate": True, "sd": sd}})
    truth = {OFFSET: np.array([offset])}
    return simulated(config, seconds, seed=2, noise=noise, calibration=truth, dvl_rate=PINGS)


@pytest.mark.parametrize("offset", [0.0, 0.5, -0.3])
def test_batch_finds_any_time_offset_and_the_track_is_as_good_as_without(offset):
    case = late(offset, sd=0.2)
    estimate = batch(case.log, started(case)).solve()
    error, sd = errors(estimate, OFFSET, [offset])
    assert np.abs(error) < sd < REQUIRED_S
    assert rms(position_errors(estimate.trajectory, case)) < 0.02


def isam2(log: Log, config: Config) -> IncrementalEstimator:
    """As `smooth` has it: a second time, with the pings where the first has found them to belong."""
    first = incremental(log, config)
    moved = batch(log, config).placed_again(first.latest().calibration)
    if moved is None:
        return first
    again = IncrementalEstimator(moved.initial)
    for k in range(len(moved.problem)):
        again.step(moved.problem, k)
    return again


@pytest.mark.parametrize(
    "estimator",
    [
        pytest.param(batch, id="batch"),
        pytest.param(renewed, id="filter"),
        pytest.param(isam2, id="isam2", marks=pytest.mark.slow),
    ],
)
def test_with_noise_the_time_offset_is_found_as_required(estimator):
    case = late(0.3, sd=0.1, seconds=34.0, noise=True)
    error, sd = errors(estimator(case.log, started(case)).solve(), OFFSET, [0.3])
    assert np.abs(error) < REQUIRED_S
    assert sd < REQUIRED_S / 2


def test_a_time_offset_that_is_known_is_held_and_costs_nothing():
    case = late(0.4, sd=0.1)
    known = started(case, calibration={OFFSET: {"estimate": False, "mean": 0.4}})
    ignored = started(case, calibration={OFFSET: {"estimate": False}})
    fitted, misfit = (batch(case.log, config).solve() for config in (known, ignored))
    assert fitted.summary["cost"] < 1e-3 * misfit.summary["cost"]
    assert rms(position_errors(fitted.trajectory, case)) < 0.02


def test_a_time_offset_that_may_walk_is_found_where_it_stands_still():
    case = late(0.2, sd=0.1)
    config = changed(started(case), calibration={OFFSET: {"walk": 1e-3}})
    estimate = batch(case.log, config).solve()
    history = estimate.history[OFFSET]
    assert len(history.time) > 3
    assert (np.abs(history.value[:, 0] - 0.2) < history.sd[:, 0]).all()


def test_pings_that_the_imu_does_not_cover_are_left_out_and_counted():
    case = late(0.0, sd=0.2)
    smoother = batch(case.log, started(case))
    early = (case.log["dvl"].time < 0.8).sum()
    reason = "calibration.dvl_time_offset reaches beyond the IMU's samples"
    assert smoother.left_out["dvl", reason] >= early > 0


OTHERS = {"ahrs_time_offset": 0.1, "mag_time_offset": -0.08, "depth_time_offset": 0.15, "fix_time_offset": 0.7}


@cache
def others_late(noise: bool) -> Simulated:
    """A dive whose stamps of compasses, depth and fixes are late, each by as much as `OTHERS` says."""
    held = {name: {"estimate": name in ("ahrs_offset", "mag_offset")} for name in TABLE if name not in LAYERS}
    config = falcon(
        heading={"sources": ["ahrs", "mag"], "ahrs_sd_deg": 0.3, "mag_sd_deg": 0.3},
        calibration=held | {name: {"estimate": True} for name in OTHERS},
        fix={"sd_m": 0.1},
    )
    truth = {name: np.array([late]) for name, late in OTHERS.items()}
    aids = {"fix_interval": 1.0, "ahrs_rate": 5.0, "dvl_rate": PINGS}
    return simulated(config, 60.0, seed=2, noise=noise, calibration=truth, **aids)


@pytest.mark.parametrize("estimator", [batch, renewed], ids=["batch", "filter"])
@pytest.mark.parametrize(
    "noise", [pytest.param(False, id="without noise", marks=pytest.mark.slow), pytest.param(True, id="with noise")]
)
def test_time_offsets_of_compasses_depth_and_fixes_are_found(estimator, noise):
    case = others_late(noise)
    estimate = estimator(case.log, started(case)).solve()
    for name, late in OTHERS.items():
        error, sd = errors(estimate, name, [late])
        assert sd < 0.3 * TABLE[name].sd, name
        assert np.abs(error) < (4.0 if noise else 1.0) * sd, name


def test_smoother_and_filter_agree_on_every_time_offset():
    case = others_late(True)
    both = [estimator(case.log, started(case)).solve() for estimator in (batch, renewed)]
    for name in OTHERS:
        (smoothed, sd), (filtered, _) = (errors(estimate, name, [0.0]) for estimate in both)
        assert np.abs(smoothed - filtered) < sd, name
