"""Integrated IMU samples reproduce the motion they were made of."""

from itertools import pairwise

import numpy as np
import pytest
from dives import LIVELY, altered, as_log, batch, changed, falcon, fed, kept, level_log, simulated
from motions import predict

from rovgraph.errors import InputError
from rovgraph.geometry import Array, earth_rate_n, exp_rotation, log_rotation, rpy_from_matrix
from rovgraph.inference.graph.isam2 import IncrementalEstimator
from rovgraph.inference.initialise import initialise
from rovgraph.kernels import measurement_row, motion_row
from rovgraph.kernels.motion import BRIDGE_GYR
from rovgraph.kernels.preintegration import typical_scatter
from rovgraph.model.config import Config, parse_config
from rovgraph.model.state import State
from rovgraph.problem.motion import preintegrate, preintegration_params, scatter
from rovgraph.simulate import Path, scenario
from rovgraph.simulate.dive import specific_force_and_rate

START, END = 31.0, 36.0
ARM = (-0.4, 0.3, 0.2)


@pytest.fixture(scope="module")
def path() -> Path:
    return scenario("falcon", 60.0, 0.5, LIVELY)


def moved(motion: Array) -> Array:
    """Rotation vector, change of position and of velocity, shape (9,)."""
    return motion[motion_row.TANGENT : motion_row.BIAS]


def samples(path: Path, config: Config, rate: float) -> np.ndarray:
    """Perfect samples in body axes at the IMU's place, shape (m, 7)."""
    motion = path.motion(np.arange(int(path.duration * rate)) / rate)
    return np.column_stack([motion.time, specific_force_and_rate(motion, config)])


def at_imu(path: Path, config: Config, time: float) -> State:
    m, arm = path.motion([time]), np.asarray(config.imu.lever_arm_m)
    R = m.R_nb[0]
    return State(m.R_nb, m.p_n + R @ arm, m.v_n + R @ np.cross(m.w_b[0], arm), np.zeros((1, 6)))


def error(path: Path, config: Config, rate: float) -> np.ndarray:
    """Length of the error in attitude, velocity and position after the motion from START to END."""
    nothing = np.zeros(6)
    imu, stops = samples(path, config, rate), np.array([])
    motion, *_ = preintegrate(preintegration_params(config), nothing, imu, START, stops, END)
    got = predict(motion, at_imu(path, config, START))
    true = at_imu(path, config, END)
    turn = log_rotation(true.R_nb[0].T @ got.R_nb[0])
    parts = (turn, got.v_n - true.v_n, got.p_n - true.p_n)
    return np.array([np.linalg.norm(p) for p in parts])


@pytest.mark.parametrize("arm", [(0.0, 0.0, 0.0), ARM], ids=["at the origin", "off the origin"])
def test_motion_is_reproduced_to_second_order(path, arm):
    config = Config.model_validate({"imu": {"lever_arm_m": arm}})
    coarse, fine = error(path, config, 25.0), error(path, config, 50.0)
    assert (fine < [2e-3, 5e-3, 2e-2]).all()
    assert (fine < coarse / 3.0).all()  # a quarter, as far as the samples' phase allows
    assert (error(path, config, 100.0) < coarse / 9.0).all()


def test_snapshots_are_what_separate_integrations_give(path):
    config = Config()
    imu, bias = samples(path, config, 100.0), np.array([0.1, -0.1, 0.05, 0.01, -0.02, 0.03])
    params = preintegration_params(config)
    stops = np.array([START, START + 0.333, START + 0.333, START + 0.34, END])
    *_, snapshots = preintegrate(params, bias, imu, START, stops, END)
    assert len(snapshots) == len(stops)
    dt, dR, dv, dp = snapshots[:, 0], snapshots[:, 1:10].reshape(-1, 3, 3), snapshots[:, 10:13], snapshots[:, 13:]
    assert dt[0] == 0.0
    for k, stop in enumerate(stops[1:], 1):
        alone, *_ = preintegrate(params, bias, imu, START, np.array([]), float(stop))
        assert dt[k] == pytest.approx(stop - START)
        # the last step of one is cut in the other
        np.testing.assert_allclose(dR[k], exp_rotation(moved(alone)[:3]), atol=1e-7)
        np.testing.assert_allclose(dv[k], moved(alone)[6:], atol=1e-6)
        np.testing.assert_allclose(dp[k], moved(alone)[3:6], atol=1e-6)


def test_intervals_that_meet_between_samples_lose_nothing(path):
    config, params = Config(), preintegration_params(Config())
    imu, none = samples(path, config, 50.0), np.array([])
    whole, *_ = preintegrate(params, np.zeros(6), imu, START, none, END)
    state = at_imu(path, config, START)
    cuts = np.array([START, START + 0.0071, START + 1.2345, START + 3.3333, END])
    there = state
    for a, b in pairwise(cuts):
        there = predict(preintegrate(params, np.zeros(6), imu, a, none, b)[0], there)
    together = predict(whole, state)
    # a step that is cut is integrated in two, which is as exact as the samples are dense
    assert np.linalg.norm(there.p_n - together.p_n) < 0.5 * error(path, config, 50.0)[2] + 1e-3
    assert log_rotation(there.R_nb[0].T @ together.R_nb[0]) == pytest.approx(0.0, abs=1e-4)


def test_a_bias_is_taken_off_the_samples(path):
    config, bias = Config(), np.array([0.1, -0.2, 0.05, 0.01, -0.02, 0.03])
    imu = samples(path, config, 100.0)
    wrong = imu + np.append(0.0, bias)
    none, params = np.array([]), preintegration_params(config)
    clean, *_ = preintegrate(params, np.zeros(6), imu, START, none, END)
    known, *_ = preintegrate(params, bias, wrong, START, none, END)
    np.testing.assert_allclose(moved(known), moved(clean), atol=1e-9)


@pytest.mark.parametrize("mount", [(0, 0, 0), (176.6, 1.2, 30), (-90, 0, 45)])
def test_mounting_of_the_imu_does_not_matter_once_it_is_known(mount):
    config = parse_config("environment: {dip_deg: 70, field_norm: 1}")
    same = changed(config, imu={"mount_rpy_deg": mount})
    straight, turned = (simulated(c, 40.0, noise=False, seed=2) for c in (config, same))
    a, b = (batch(s.log, s.config).problem for s in (straight, turned))
    assert len(a) == len(b) > 100
    for one, other in zip(a.motions, b.motions, strict=True):
        np.testing.assert_allclose(moved(one), moved(other), atol=1e-8)
    np.testing.assert_allclose(a.rate_b[1:], b.rate_b[1:], atol=1e-9)


def test_earths_rate_points_north_and_up_in_the_north():
    np.testing.assert_allclose(earth_rate_n(0.0), [7.292115e-5, 0, 0])
    np.testing.assert_allclose(earth_rate_n(np.pi / 2), [0, 0, -7.292115e-5], atol=1e-12)
    np.testing.assert_allclose(earth_rate_n(-np.pi / 2), [0, 0, 7.292115e-5], atol=1e-12)


LATITUDE, STILL_S = 58.3, 400.0


def still_heading(on: bool) -> float:
    """Heading after `STILL_S` at rest on a turning Earth, gyro alone [rad]; it begins at 0."""
    lat = np.deg2rad(LATITUDE)
    config = Config.model_validate({"environment": {"earth_rotation": on, "latitude_deg": LATITUDE}})
    time = np.arange(0.0, STILL_S + 0.1, 0.1)
    signal = np.concatenate([[0, 0, -config.environment.gravity], earth_rate_n(lat)])
    imu = np.column_stack([time, np.tile(signal, (len(time), 1))])
    state = State(np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)))
    params = preintegration_params(config)
    for begin in np.arange(0.0, STILL_S, 1.0):
        part = imu[(imu[:, 0] > begin - 0.2) & (imu[:, 0] < begin + 1.2)]
        motion, *_ = preintegrate(params, np.zeros(6), part, begin, np.array([]), begin + 1.0)
        state = predict(motion, state)
    return float(rpy_from_matrix(state.R_nb[0])[2])


def test_a_turning_earth_turns_the_heading_of_who_does_not_know_it():
    # sin(58.3 deg) of 15.04 deg/h in 400 s is 1.42 deg; the level is lost as well, which changes it a little
    expected = -7.292115e-5 * np.sin(np.deg2rad(LATITUDE)) * STILL_S
    assert np.rad2deg(expected) == pytest.approx(-1.42, abs=0.01)
    assert still_heading(False) == pytest.approx(expected, rel=0.02)
    assert abs(still_heading(True)) < np.deg2rad(0.01)


def silent(seconds: float, **imu: float):
    """A log whose IMU says nothing for a while from 20 s on, and its configuration."""
    case = simulated(changed(falcon(), imu=imu), 40.0, seed=5)
    time = case.log["imu"].time
    return case, kept(case.log, "imu", (time < 20.0) | (time > 20.0 + seconds))


def test_a_gap_in_the_imu_is_bridged_with_an_inflated_covariance():
    case, log = silent(3.0)
    problem = batch(log, case.config).problem
    bridged = np.flatnonzero(problem.bridged)
    assert len(bridged)
    assert ((problem.time[bridged] > 19.9) & (problem.time[bridged] < 23.3)).all()
    density = np.sqrt(problem.covariances[:, 0, 0] / problem.motions[:, motion_row.DURATION])  # of the rotation
    assert density[bridged[1] - 1] == pytest.approx(BRIDGE_GYR, rel=0.1)
    assert density[bridged[1] - 1] > 50 * np.median(density[~problem.bridged[1:]])
    # and a ping in the gap knows that its rate is a guess
    pings = problem.rows[problem.of_sensor("dvl")]
    time = pings[:, measurement_row.TIME]
    inside = problem.bridged[problem.interval[problem.of_sensor("dvl")]] & (time > 20.2) & (time < 22.9)
    assert inside.any() and (pings[inside, measurement_row.RATE_SD] == BRIDGE_GYR).all()


@pytest.mark.parametrize("rate", [10.0, 30.0, 100.0])
def test_the_rate_is_that_of_its_own_time(rate):
    """Of a slow IMU on the line between the samples around it, of a fast one on the parabola through those near it."""
    curved = rate > 50.0
    pings = np.array([0.523, 0.55, 1.101, 1.7, 2.318, 3.071])  # two of them close together, one at a sample
    log = level_log(
        4.0, np.array([0.0, 0.0, -9.81]), np.zeros(3), rate, dvl=(pings, np.tile([0, 0, 0, 1, np.nan], (6, 1)))
    )
    time, rng = log["imu"].time, np.random.default_rng(3)
    gyr = np.outer(np.square(time), [0.1, -0.2, 0.3]) if curved else rng.standard_normal((len(time), 3))
    log = altered(log, "imu", np.column_stack([log["imu"].data[:, :3], gyr]))

    def true(t: float) -> list[float]:
        return [np.square(t) * s for s in (0.1, -0.2, 0.3)] if curved else [np.interp(t, time, g) for g in gyr.T]

    own = {"dvl": {"lever_arm_m": [0.3, 0.0, 0.1]}, "graph": {"min_gap_s": 0.1}, "start": {"heading_deg": 0.0}}
    config = changed(Config(), **own)
    problem = batch(log, config).problem
    seen = problem.rows[problem.of_sensor("dvl")]
    times, after = seen[:, measurement_row.TIME], seen[:, measurement_row.DT] > 0.0
    assert sorted(times) == pings.tolist() and set(after) == {True, False}
    for row, t in zip(seen, times, strict=True):
        np.testing.assert_allclose(row[measurement_row.RATE : measurement_row.RATE + 3], true(t), atol=1e-9)
    for rate_b, t in zip(problem.rate_b[1:-1], problem.time[1:-1], strict=True):
        np.testing.assert_allclose(rate_b, true(t), atol=1e-9)


def test_keyframes_stand_at_the_pings_within_a_gap_of_the_imu():
    case, log = silent(3.0)
    pings = log["dvl"].time
    times = batch(log, case.config).problem.time
    assert np.isin(pings[(pings > 20.1) & (pings < 22.9)], times).all()


def test_a_keyframe_stands_where_samples_come_again_and_what_follows_is_whole():
    """What is measured after a gap would otherwise be carried through it from the keyframe before."""
    case, log = silent(3.0)
    problem = batch(log, case.config).problem
    again = log["imu"].time[log["imu"].time > 20.0][0]
    [at] = np.flatnonzero(problem.time == again)
    assert problem.gap_s[at] == pytest.approx(3.02, abs=0.02)
    assert problem.gap_s[at + 1] == 0.0
    carried = problem.rows[(problem.interval == at + 1) & (problem.keyframe == at), measurement_row.DT]
    assert len(carried) and carried.max() < 0.2


def test_every_interval_in_a_gap_knows_how_long_it_is():
    case, log = silent(3.0)
    problem = batch(log, case.config).problem
    inside = (problem.time > 20.1) & (problem.time <= 23.0)
    assert inside.sum() > 5
    np.testing.assert_allclose(problem.gap_s[inside], 3.02, rtol=0.0, atol=0.02)


def test_a_gap_longer_than_allowed_is_refused_with_row_and_remedy():
    case, log = silent(3.0, max_gap_s=2.0)
    after = int(np.searchsorted(log["imu"].time, 21.0))
    row = log["imu"].row[after]
    with pytest.raises(InputError, match=rf"row {row}: the IMU is silent for 3\.0 s .* imu\.max_gap_s = 2"):
        fed(IncrementalEstimator(initialise(log, case.config)), log)


def test_a_single_lost_sample_is_no_gap():
    case = simulated(falcon(), 40.0, seed=5)
    keep = np.ones(len(case.log["imu"]), bool)
    keep[[1500, 1700, 1701]] = False
    assert not batch(kept(case.log, "imu", keep), case.config).problem.bridged.any()


def test_helpers_of_these_tests_make_logs_in_the_logs_contract():
    case = simulated(falcon(), 32.0, seed=1)
    again = as_log(case.dive.log_frame)
    assert again.sensors == {"imu", "mag", "dvl", "dvl_heading", "depth"}
    assert [m.sensor for m in again.measurements()].count("imu") == len(again["imu"]) == 3201
    zeroed = altered(again, "depth", 0 * again["depth"].data)
    assert not zeroed["depth"].data.any()
    assert level_log(1.0, np.zeros(3), np.zeros(3))["imu"].data.shape == (101, 6)


@pytest.mark.parametrize("count", [3, 4, 33])
def test_typical_scatter_is_the_median_over_samples_and_the_mean_over_axes(count):
    rng = np.random.default_rng(3)
    table = np.column_stack([0.01 * np.arange(count), rng.normal(size=(count, 6))])
    typical = np.empty(2)
    typical_scatter(table, typical)
    middle = np.sort(np.abs(scatter(table[:, 0], table[:, 1:])), axis=0)[(count - 2) // 2]
    np.testing.assert_allclose(typical, 1.4826 * middle.reshape(2, 3).mean(axis=1), rtol=1e-15)
