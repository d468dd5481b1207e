"""iSAM2 and the renewed filter: agreement with the batch, gating, and a cost that does not grow."""

import gtsam
import numpy as np
import pytest
from dives import (
    altered,
    attitude_errors,
    batch,
    changed,
    falcon,
    fed,
    incremental,
    position_errors,
    renewed,
    rms,
    simulated,
)

from rovgraph.engine.unknowns import Unknowns
from rovgraph.errors import InputError
from rovgraph.estimators.eskf.error_state import REINITIALISE_AT_S, ErrorStateFilter, replay
from rovgraph.estimators.incremental import IncrementalEstimator
from rovgraph.estimators.initialise import initialise
from rovgraph.geometry import Array, log_rotation, transpose
from rovgraph.graph.incremental import Incremental
from rovgraph.graph.keys import key
from rovgraph.log import Log
from rovgraph.state import POSE

DEG = np.deg2rad(1.0)


@pytest.fixture(scope="session")
def case():
    return simulated(falcon(), 70.0, seed=6, dvl_rate=3.0)


@pytest.fixture(scope="session")
def whole(case) -> IncrementalEstimator:
    """iSAM2 over the whole dive."""
    return incremental(case.log, case.config)


@pytest.fixture(scope="session")
def filtered(case) -> ErrorStateFilter:
    return renewed(case.log, case.config)


def test_isam2_ends_where_the_batch_does(case, whole):
    expected, got = batch(case.log, case.config).solve().trajectory, whole.solve().trajectory
    assert np.linalg.norm(got.p_n - expected.p_n, axis=1).max() < 0.01
    turn = log_rotation(transpose(expected.R_nb) @ got.R_nb)
    assert np.linalg.norm(turn, axis=1).max() < 0.05 * DEG
    np.testing.assert_allclose(got.p_sd, expected.p_sd, rtol=0.05, atol=1e-3)


def test_filter_ends_where_the_batch_does(case, filtered):
    """At the last keyframe both know the same: all of the dive."""
    expected, got = batch(case.log, case.config).solve().trajectory, filtered.solve().trajectory
    assert np.linalg.norm(got.p_n[-1] - expected.p_n[-1]) < 0.02
    turn = log_rotation(transpose(expected.R_nb[-1:]) @ got.R_nb[-1:])
    assert np.linalg.norm(turn) < 0.05 * DEG
    for known in ("p_sd", "v_sd", "rpy_sd"):
        np.testing.assert_allclose(getattr(got, known)[-1], getattr(expected, known)[-1], rtol=0.1)


def test_the_filter_is_as_good_as_isam2_at_its_newest_keyframe(case, filtered):
    isam2 = IncrementalEstimator(filtered.beginning)
    newest: dict[int, Array] = {}
    for interval in filtered.intervals:
        isam2.step(interval)
        if isam2.updated == interval.index:
            newest[interval.index] = isam2.latest().p_n[0]
    arm = np.array(case.config.imu.lever_arm_m)
    keyframes = list(newest)
    true = case.truth.at(np.array([filtered.intervals[k].time for k in keyframes]))
    at_imu = true.p_n + true.R_nb @ arm
    errors = [
        rms(np.linalg.norm(p - at_imu, axis=1))
        for p in (np.array([newest[k] for k in keyframes]), filtered.history.states.p_n[keyframes])
    ]
    assert errors[1] < 1.05 * errors[0]


def test_filtered_errors_lie_within_what_is_said_of_them(case, filtered):
    trajectory = filtered.solve().trajectory
    assert (position_errors(trajectory, case) < 5.0 * np.linalg.norm(trajectory.p_sd, axis=1)).all()
    yaw = attitude_errors(trajectory, case)[:, 2]
    assert (np.abs(yaw) < 5.0 * trajectory.rpy_sd[:, 2]).all()


def test_feeding_measurements_and_replaying_intervals_are_the_same(case, filtered):
    again = replay(batch(case.log, case.config).intervals, initialise(case.log, case.config), REINITIALISE_AT_S)
    a, b = filtered.solve(), again.solve()
    np.testing.assert_allclose(a.trajectory.p_n, b.trajectory.p_n, atol=1e-9)
    np.testing.assert_allclose(a.trajectory.cov_p, b.trajectory.cov_p, atol=1e-9)


def test_the_future_does_not_change_what_was_filtered(case, filtered):
    half = Log(case.log.source, {s: _until(stream, 40.0) for s, stream in case.log.streams.items()})
    # the start resolves the log's own noise and field, so both are told the same
    estimator = fed(ErrorStateFilter(filtered.beginning, REINITIALISE_AT_S), half)
    short, full = estimator.solve().trajectory, filtered.solve().trajectory
    n = int(np.searchsorted(full.time, 39.0))
    np.testing.assert_allclose(short.p_n[:n], full.p_n[:n], atol=1e-9)


def _until(stream, end):
    keep = stream.time < end
    return type(stream)(stream.sensor, stream.columns, stream.time[keep], stream.data[keep], stream.row[keep])


def test_progress_is_reported():
    case = simulated(falcon(), 33.0, seed=6, dvl_rate=5.0)
    told: list[float] = []
    replay(batch(case.log, case.config).intervals, initialise(case.log, case.config), progress=told.append)
    assert told and all(0.0 <= done <= 1.0 for done in told)
    assert told == sorted(told)


# gates


def spoilt(case, wrong, by=1.0) -> Log:
    data = case.log["dvl"].data.copy()
    data[wrong, 0] += by
    return altered(case.log, "dvl", data)


def dvl_weights(estimator) -> dict[float, float]:
    residuals = estimator.solve().residuals
    dvl = residuals[residuals["sensor"] == "dvl"]
    return dict(zip(dvl["time"], dvl["weight"], strict=True))


def test_a_gross_outlier_is_kept_out(case, filtered):
    wrong = np.arange(100, 200, 20)
    estimator = renewed(spoilt(case, wrong), case.config)
    weights = dvl_weights(estimator)
    assert {t for t, w in weights.items() if w == 0.0 and t > 5.0} == set(case.log["dvl"].time[wrong])
    a, b = estimator.solve().trajectory, filtered.solve().trajectory
    assert np.linalg.norm(a.p_n - b.p_n, axis=1).max() < 0.1


def test_a_good_ping_is_not_kept_out_while_the_level_is_uncertain(filtered):
    assert all(weight > 0.0 for weight in dvl_weights(filtered).values())


def test_an_open_gate_lets_everything_in(case):
    config = changed(case.config, dvl={"gate_sd": None})
    weights = dvl_weights(renewed(spoilt(case, np.arange(100, 200, 20)), config))
    assert min(weights.values()) > 0.0


def test_a_variable_that_nothing_determines_is_named_in_one_line():
    engine = Incremental(Unknowns({}, {}))
    factor = gtsam.BetweenFactorPose3(key(POSE, 0), key(POSE, 1), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))
    values = gtsam.Values()
    values.insert(key(POSE, 0), gtsam.Pose3())
    values.insert(key(POSE, 1), gtsam.Pose3())
    with pytest.raises(InputError, match=r"^the data do not determine pose of keyframe [01]: [^\n]*$"):
        engine.add([factor], values)
        engine.update()


# the cost of a callback


def test_the_engine_keeps_the_linearisation_point_alive():
    engine = Incremental(Unknowns({}, {}))
    values = gtsam.Values()
    values.insert(key(POSE, 0), gtsam.Pose3())
    prior = gtsam.PriorFactorPose3(key(POSE, 0), gtsam.Pose3(), gtsam.noiseModel.Unit.Create(6))
    engine.add([prior], values)
    engine.update()
    assert engine._theta is engine._engine.getLinearizationPoint()
    assert engine._theta.size() == 1


@pytest.mark.parametrize("kept", [True, False])
def test_a_callback_gets_the_linearisation_point_itself_while_the_engine_keeps_it(kept):
    """And else a copy of all values, each time, whose cost grows with the dive."""
    engine, given = Incremental(Unknowns({}, {})), []

    def error(_, values, H):
        given.append(values)
        if H is not None:
            H[0] = np.eye(6)
        return np.asarray(gtsam.Pose3.Logmap(values.atPose3(name)))

    theta = engine._theta if kept else None
    if not kept:
        engine.copy_values()
    name, noise = key(POSE, 0), gtsam.noiseModel.Unit.Create(6)
    values = gtsam.Values()
    values.insert(name, gtsam.Pose3())
    engine.add([gtsam.PriorFactorPose3(name, gtsam.Pose3(), noise), gtsam.CustomFactor(noise, [name], error)], values)
    engine.update()
    engine.update()
    assert given and all((values is theta) == kept for values in given)
