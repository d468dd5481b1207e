"""iSAM2 and the renewed filter: agreement with the batch, gating, and a cost that does not grow."""

import gtsam
import numpy as np
import pytest
from dives import (
    altered,
    attitude_errors,
    batch,
    changed,
    exact,
    falcon,
    fed,
    incremental,
    position_errors,
    renewed,
    rms,
    simulated,
)
from live import message

from rovgraph.dive import smooth
from rovgraph.errors import InputError
from rovgraph.geometry import Array, log_rotation, transpose
from rovgraph.inference.chain_optimum import smooth_chain
from rovgraph.inference.error_state import REINITIALISE_AT_S, ErrorStateFilter, replay
from rovgraph.inference.filter_step import calibration_vector, states_of
from rovgraph.inference.fixed_lag import FixedLag
from rovgraph.inference.graph import isam2 as incremental_module
from rovgraph.inference.graph.batch import measurement_factor, motion_factor
from rovgraph.inference.graph.isam2 import UPDATE_S, IncrementalEstimator, IntervalTerms, Linearization
from rovgraph.inference.graph.values import CALIBRATION, insert_calibration, insert_state, key
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import smoothed as smoothed_results
from rovgraph.kernels.layout import MOTION
from rovgraph.lab.estimators import outcomes, select
from rovgraph.live.clocks import Clocks
from rovgraph.live.navigator import Navigator
from rovgraph.log import Log
from rovgraph.model.state import BIAS, POSE, VELOCITY

DEG = np.deg2rad(1.0)
UNIT = gtsam.noiseModel.Unit.Create(6)


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
    isam2 = IncrementalEstimator(filtered.initial)
    newest: dict[int, Array] = {}
    for k in range(len(filtered.problem)):
        isam2.step(filtered.problem, k)
        if isam2.updated == k:
            newest[k] = isam2.latest().p_n[0]
    arm = np.array(case.config.imu.lever_arm_m)
    keyframes = list(newest)
    true = case.truth.at(filtered.problem.time[keyframes])
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
    again = replay(batch(case.log, case.config).problem, initialise(case.log, case.config), REINITIALISE_AT_S)
    a, b = filtered.solve(), again.solve()
    np.testing.assert_allclose(a.trajectory.p_n, b.trajectory.p_n, atol=1e-9)
    np.testing.assert_allclose(a.trajectory.cov_p, b.trajectory.cov_p, atol=1e-9)


def test_the_future_does_not_change_what_was_filtered(case, filtered):
    half = Log(case.log.source, {s: _until(stream, 40.0) for s, stream in case.log.streams.items()})
    # the start resolves the log's own noise and field, so both are told the same
    estimator = fed(ErrorStateFilter(filtered.initial, REINITIALISE_AT_S), half)
    short, full = estimator.solve().trajectory, filtered.solve().trajectory
    n = int(np.searchsorted(full.time, 39.0))
    np.testing.assert_allclose(short.p_n[:n], full.p_n[:n], atol=1e-9)


def _until(stream, end):
    keep = stream.time < end
    return type(stream)(stream.sensor, stream.columns, stream.time[keep], stream.data[keep], stream.row[keep])


def test_progress_is_reported():
    case = simulated(falcon(), 33.0, seed=6, dvl_rate=5.0)
    told: list[float] = []
    replay(batch(case.log, case.config).problem, initialise(case.log, case.config), progress=told.append)
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


def test_a_variable_that_nothing_determines_is_named_in_one_line(filtered):
    engine = IncrementalEstimator(filtered.initial).engine
    between = gtsam.JacobianFactor(key(POSE, 0), np.eye(6), key(POSE, 1), -np.eye(6), np.zeros(6), UNIT)
    engine._graph.push_back(gtsam.LinearContainerFactor(between))
    for index in range(2):
        engine._values.insert(key(POSE, index), np.zeros(6))
    with pytest.raises(InputError, match=r"^the data do not determine pose of keyframe [01]: [^\n]*$"):
        engine.update()


# filtered and smoothed from one pass


def apart(one, other) -> Array:
    """How far two trajectories are apart, in units of the other's sd, shape (n, 6): position, then attitude in n."""
    a, b = one.trajectory, other.trajectory
    turn = np.einsum("nij,nj->ni", b.R_nb, log_rotation(transpose(b.R_nb) @ a.R_nb))
    sd = np.sqrt(np.diagonal(b.cov_theta, axis1=1, axis2=2))
    return np.abs(np.concatenate([(a.p_n - b.p_n) / b.p_sd, turn / sd], axis=1))


def test_what_isam2_smooths_at_its_end_is_the_chains_optimum(case, whole):
    chain = batch(case.log, exact(case.config)).solve()
    assert apart(whole.solve(), chain).max() < 0.01
    np.testing.assert_allclose(whole.solve().trajectory.p_sd, chain.trajectory.p_sd, rtol=1e-3)


def test_what_isam2_knows_of_its_newest_keyframe_is_what_the_dive_so_far_shows(case, whole):
    """Each filtered keyframe against the optimum of all data up to it, from the graph of a chain."""
    dive = batch(case.log, case.config)
    filtered, off = whole.history.states, []
    for end in range(30, len(dive.problem), 30):
        states = filtered.at(np.arange(end + 1))
        best = smooth_chain(dive.problem.upto(end + 1), dive.initial, states)
        sd = np.sqrt(np.diag(best.newest_covariance()))
        newest = best.state.at([end])
        turn = log_rotation(transpose(newest.R_nb) @ filtered.R_nb[end : end + 1])[0]
        off.append(np.concatenate([turn, newest.R_nb[0].T @ (filtered.p_n[end] - newest.p_n[0])]) / sd[:6])
    assert len(off) > 5
    assert np.abs(off).max() < 1.0
    assert rms(np.array(off)) < 0.3


def test_isam2_and_the_filter_agree_on_every_keyframe_but_the_first_seconds(case, whole, filtered):
    off = apart(whole.filtered(), filtered.solve())
    later = whole.filtered().trajectory.time > 10.0
    assert rms(off[later]) < 0.3


def test_isam2s_filtered_estimate_is_of_the_pass_itself(case, whole):
    """What came later does not change it, and its residuals are innovations."""
    half = Log(case.log.source, {s: _until(stream, 40.0) for s, stream in case.log.streams.items()})
    short, full = fed(IncrementalEstimator(whole.initial), half).filtered().trajectory, whole.filtered().trajectory
    n = int(np.searchsorted(full.time, 39.0))
    np.testing.assert_allclose(short.p_n[:n], full.p_n[:n], atol=1e-9)
    nis = whole.filtered().summary["nis"]["dvl"]
    assert 0.6 * nis["dim"] < nis["mean"] < 1.5 * nis["dim"]


def test_isam2_keeps_gross_outliers_out_by_its_own_innovations(case, whole):
    wrong = np.arange(100, 200, 20)
    estimator = incremental(spoilt(case, wrong), case.config)
    times = set(case.log["dvl"].time[wrong])
    for estimate in (estimator.filtered(), estimator.solve()):
        dvl = estimate.residuals[estimate.residuals["sensor"] == "dvl"]
        assert set(dvl.loc[(dvl["weight"] == 0.0) & (dvl["time"] > 5.0), "time"]) == times
    a, b = estimator.filtered().trajectory, whole.filtered().trajectory
    assert np.linalg.norm(a.p_n - b.p_n, axis=1).max() < 0.1


def test_the_rows_of_an_interval_are_gtsams_factors_of_it(whole):
    """The motion's, and the robust ones of its measurements, at two keyframes that are somewhat off."""
    engine, unknowns = whole.filter, whole.filter.unknowns
    problem = whole.problem
    between = np.bincount(problem.interval[problem.keyframe < problem.interval], minlength=len(problem))
    here = np.bincount(problem.interval[problem.keyframe == problem.interval], minlength=len(problem))
    j = 50 + int(np.flatnonzero(((between > 1) & (here > 0))[50:])[0])
    own = np.arange(*problem.measured_in(j))
    states = whole.history.states.at([j - 1, j])
    x = np.concatenate([states.R_nb.reshape(2, 9), states.p_n + 0.01, states.v_n - 0.02, states.bias], axis=1)
    c = calibration_vector({name: value[-1] for name, value in states.calibration.items()})
    terms = IntervalTerms(engine, problem, j, own, segment=0)
    (rows,) = Linearization(engine, whole.initial.prior).linearize([terms], x, c[None])
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for k in range(2):
        insert_state(values, j - 1 + k, states_of(x[k : k + 1], c))
    insert_calibration(values, states_of(x[:1], c).calibration, unknowns)
    graph.add(motion_factor(problem, j, unknowns, 0))
    seen = [engine.measurements(problem, np.array([row])) for row in own]
    for measured in seen:
        graph.add(measurement_factor(measured, 0))
    order = gtsam.Ordering()
    for k in (j - 1, j):
        for variable in (POSE, VELOCITY, BIAS):
            order.push_back(key(variable, k))
    touched = {name for measured in seen for name in measured.unknowns.estimated}
    names = [name for name in unknowns.estimated if name in touched]
    for name in names:
        order.push_back(key(name))
    used = np.concatenate([np.r_[engine.layout.columns[name]] for name in names]) - MOTION
    J = np.hstack([rows.A_i, rows.A_j, rows.C[:, used]])
    assert not np.delete(rows.C, used, axis=1).any()
    for mine, other in zip((J.T @ J, J.T @ rows.r), graph.linearize(values).hessian(order), strict=True):
        np.testing.assert_allclose(mine / np.abs(other).max(), other / np.abs(other).max(), atol=1e-8)


def test_what_isam2_tells_of_its_newest_keyframe_is_its_joint_marginal(whole):
    """The root of the tree has it, also after iSAM2 has been put up again."""
    engine, problem = whole.engine, whole.problem
    keys = [key(POSE, len(problem) - 1), key(CALIBRATION, int(problem.segment[-1]))]
    x, _, P, _ = engine.newest()
    np.testing.assert_allclose(P, engine._engine.jointMarginalCovariance(keys).fullMatrix(), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(x, engine.estimate()[0][-1], atol=1e-3)


def test_isam2_claims_no_more_of_the_heading_than_the_dive_so_far_shows(case, whole):
    """Against the chain, linearised at its optimum."""
    ratio, dive = [], batch(case.log, case.config)
    heading = whole.filtered().trajectory.rpy_sd[:, 2]
    for seconds in range(6, 40, 2):
        end = int(dive.problem.time.searchsorted(dive.problem.time[0] + seconds))
        best = smooth_chain(dive.problem.upto(end + 1), dive.initial, whole.history.states.at(np.arange(end + 1)))
        so_far = smoothed_results(best, dive.initial).trajectory.rpy_sd[-1, 2]
        ratio.append(heading[end] / so_far)
    assert min(ratio) > 0.8
    assert np.mean(ratio) > 0.95


def test_smooth_writes_both_estimates_of_one_pass(case):
    config = changed(case.config, graph={"solver": "isam2"})
    kinds = [estimate.kind for estimate in smooth(case.log, config).estimates]
    assert kinds == ["smoothed", "filtered", "dead_reckoning"]


def test_comparing_both_estimates_runs_isam2_once(case, monkeypatch):
    ran = []
    original = incremental_module.run_isam2
    monkeypatch.setattr(
        incremental_module, "run_isam2", lambda *given, **more: ran.append(1) or original(*given, **more)
    )
    chosen = select(["isam2-filtered-a", "isam2-smoothed-a"])
    found = list(outcomes(chosen, case.log, case.config))
    assert [o.error for o in found] == [None, None] and ran == [1]
    assert [o.estimate.kind for o in found] == ["filtered", "smoothed"]


# data as they arrive


def test_online_puts_out_isam2s_estimate(case, monkeypatch):
    """The filter goes on from iSAM2's newest keyframe once a second, and ends where the dive does."""
    adopted, adopt = [], FixedLag.adopt_passed
    monkeypatch.setattr(
        FixedLag,
        "adopt_passed",
        lambda engine, known, gates: adopted.append(known) or adopt(engine, known, gates),
    )
    nav = Navigator(case.config, patient=True, smooth=True, clocks=Clocks(trust=True))
    for m in case.log.measurements():
        nav.take(message(m))
    nav.finish()
    seconds = case.log["imu"].time[-1] - case.config.graph.lag_s
    assert 0.6 * seconds < len(adopted) <= seconds / UPDATE_S
    assert nav.isam2 is not None and not [e for e in nav._take_events() if e.kind == "lost"]
    solution, smoothed = nav.solution(), batch(case.log, case.config).solve().trajectory
    assert np.abs((solution.position - smoothed.p_n[-1]) / smoothed.p_sd[-1]).max() < 0.5
    np.testing.assert_allclose(solution.position_sd, smoothed.p_sd[-1], rtol=0.1)
    known, truth = nav.isam2.solve().trajectory, smoothed.at(nav.isam2.solve().trajectory.time)
    assert np.linalg.norm(known.p_n - truth.p_n, axis=1).max() < 0.1


def test_a_filter_that_goes_on_from_its_own_estimate_stays_where_it_is(case):
    engine, passed = FixedLag(initialise(case.log, case.config), 5.0, 0.3), []
    engine.passed = passed.append
    for m in case.log.measurements():
        if m.time < 30.0:
            engine.add(m)
    before = engine.snapshots[-1].known
    engine.adopt_passed(passed[-1].known, passed[-1].gates)
    np.testing.assert_allclose(engine.snapshots[-1].known.x, before.x, atol=1e-12)
    np.testing.assert_allclose(engine.snapshots[-1].known.P, before.P, atol=1e-15)
