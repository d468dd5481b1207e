"""The error-state filter and its smoother: linearisation, recovery, gates, agreement with the graph, honesty."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from dives import (
    Simulated,
    altered,
    attitude_errors,
    batch,
    beginning,
    changed,
    falcon,
    fed,
    kept,
    position_errors,
    rms,
    simulated,
    started,
    without,
)
from rovgraph.estimators.innovations import Innovations
from scipy.optimize import minimize
from test_consistency import OVERCONFIDENT, band, drawn, nees

from rovgraph.calibration import TABLE
from rovgraph.config import Config
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.measurements import loss_and_weight
from rovgraph.engine.preintegration import INTEGRATION_SD, preintegrate, preintegration_params
from rovgraph.engine.transition import predict, transitions
from rovgraph.estimators import error_vector
from rovgraph.estimators.error_vector import ErrorVector
from rovgraph.estimators.eskf.error_state import ErrorStateFilter, alike, replay, replay_together, smoothed_together
from rovgraph.estimators.initialise import initialise
from rovgraph.geometry import Array, log_rotation, matrix_from_rpy, transpose
from rovgraph.instruments import instruments
from rovgraph.log import Log
from rovgraph.sensors import innovation
from rovgraph.simulate import Style
from rovgraph.state import DIMENSION, State

DEG = np.deg2rad(1.0)


def filtered(log: Log, config: Config) -> ErrorStateFilter:
    return fed(ErrorStateFilter(initialise(log, config)), log)


def covariances(estimator: ErrorStateFilter, smoothed: bool = False) -> Array:
    """Of every keyframe, shape (n, size, size)."""
    return np.array([k.P for k in (estimator.backward() if smoothed else estimator.filtered)])


@pytest.fixture(scope="session")
def case() -> Simulated:
    return simulated(falcon(), 60.0, seed=6, dvl_rate=3.0)


@pytest.fixture(scope="session")
def estimator(case) -> ErrorStateFilter:
    return filtered(case.log, case.config)


# motion


def moving(seconds: float, rate: float = 100.0) -> tuple[State, Array]:
    """A state and IMU samples, time, specific force, rate, of a vehicle that turns and accelerates."""
    t = np.arange(0.0, seconds + 1.5 / rate, 1.0 / rate)
    f = np.column_stack([0.3 * np.sin(2 * t), 0.2 + 0 * t, -9.7 + 0.1 * np.cos(t)])
    w = np.column_stack([0.1 * np.cos(3 * t), 0.05 + 0 * t, 0.3 * np.sin(t)])
    bias = np.array([[0.02, -0.01, 0.03, 0.002, -0.003, 0.001]])
    attitude = matrix_from_rpy([[0.1, -0.2, 2.0]])
    return State(attitude, np.array([[3.0, -2.0, 5.0]]), np.array([[0.4, -0.2, 0.1]]), bias), np.column_stack([t, f, w])


def interval_of(samples: Array, seconds: float, bias: Array, config: Config) -> KeyframeInterval:
    noise = config.imu.noise
    params = preintegration_params(config, noise.acc, noise.gyr)
    motion, _ = preintegrate(params, bias, samples, 0.0, np.empty(0), seconds)
    return KeyframeInterval(1, seconds, 0, np.zeros(3), 0.0, motion, [])


def difference(state: State, other: State) -> Array:
    """In the tangent space of `State`, shape (15,)."""
    R_bn = transpose(state.R_nb[0])
    turn = log_rotation(R_bn @ other.R_nb[0])
    change = (R_bn @ (other.p_n - state.p_n)[0], (other.v_n - state.v_n)[0], (other.bias - state.bias)[0])
    return np.concatenate([turn, *change])


def test_transition_is_the_derivative_of_the_prediction():
    state, samples = moving(0.5)
    interval = interval_of(samples, 0.5, np.zeros(6), falcon())
    [after], [F], _ = transitions([interval], [state])
    step, columns = 1e-5, []
    for variable, size in DIMENSION.items():
        for k in range(size):
            ends = [predict(interval, state.retract(variable, sign * step * np.eye(size)[k])) for sign in (1, -1)]
            columns.append((difference(after, ends[0]) - difference(after, ends[1])) / (2 * step))
    np.testing.assert_allclose(F, np.column_stack(columns), atol=1e-6)


def test_process_noise_is_that_of_noisy_samples():
    """Errors of many predictions, whitened with Q, have the covariance of a Wishart matrix over its count."""
    count, seconds, rate = 400, 1.0, 100.0
    config, rng = falcon(), np.random.default_rng(4)
    noise = config.imu.noise
    state, samples = moving(seconds)
    state = replace(state, bias=np.zeros((1, 6)))
    interval = interval_of(samples, seconds, np.zeros(6), config)
    [exact], _, [Q] = transitions([interval], [state])
    densities = np.repeat([noise.acc, noise.gyr], 3)
    walks = np.repeat([noise.acc_walk, noise.gyr_walk], 3)
    errors = []
    for _ in range(count):
        drift = np.cumsum(walks / np.sqrt(rate) * rng.standard_normal((len(samples), 6)), axis=0)
        noisy = samples.copy()
        noisy[:, 1:] += drift + densities * np.sqrt(rate) * rng.standard_normal((len(samples), 6))
        predicted = predict(interval_of(noisy, seconds, np.zeros(6), config), state)
        integration = INTEGRATION_SD * np.sqrt(seconds) * rng.standard_normal((1, 3))
        truth = replace(exact, p_n=exact.p_n + integration, bias=drift[[int(seconds * rate)]])
        errors.append(difference(predicted, truth))
    whitened = np.linalg.solve(np.linalg.cholesky(Q), np.array(errors).T)
    found = whitened @ whitened.T / count
    sd = np.sqrt((1.0 + np.eye(15)) / count)
    assert (np.abs(found - np.eye(15)) < 4.5 * sd).all()


def test_all_measurements_of_a_keyframe_together_are_linearised_as_each_alone(estimator):
    interval = max(estimator.intervals, key=lambda i: len({a.sensor for a in i.measurements}))
    state = estimator.filtered[interval.index].state
    assert len(interval.measurements) > 2
    assert any(a.motion.dt for a in interval.measurements)
    (r,), (H,), [parts] = estimator.recursion.measurements.linearize(state, [interval.measurements])
    for attached, part in zip(interval.measurements, parts, strict=True):
        alone, jacobians = estimator.recursion.measurements.block([attached]).linearize(state)
        np.testing.assert_allclose(r[part], alone[0], atol=1e-9)
        np.testing.assert_allclose(H[part], estimator.error.matrix(jacobians)[0], atol=1e-9)


# coordinates of the error


def error_vector_and_state(rng: np.random.Generator) -> tuple[ErrorVector, State]:
    everything = {n: {"estimate": True} for n in ("dvl_roll", "dvl_pitch", "dvl_scale", "ahrs_offset", "mag_offset")}
    config = falcon(calibration=everything, environment={"field_norm": 48.0})
    sensors = instruments(config)
    estimated = [n for i in sensors.values() for n in i.model.calibration]
    calibration = {n: 0.05 * rng.standard_normal(TABLE[n].dim) for n in estimated}
    state = moving(0.1)[0]
    return ErrorVector(dict.fromkeys(estimated), sensors), replace(state, calibration=calibration)


def test_the_local_error_is_the_inverse_of_the_retraction():
    rng = np.random.default_rng(1)
    error, state = error_vector_and_state(rng)
    delta = 0.2 * rng.standard_normal(error.size)
    moved, _ = error.retract(state, delta[None])
    np.testing.assert_allclose(error.local(state, moved)[0][0], delta, atol=1e-9)


def test_a_change_of_basis_carries_errors_from_one_state_to_another():
    """What lies at delta + e about a state lies at basis e about where delta leads."""
    rng = np.random.default_rng(2)
    error, state = error_vector_and_state(rng)
    delta, e = 1e-4 * rng.standard_normal(error.size), 1e-6 * rng.standard_normal(error.size)
    moved, [basis] = error.retract(state, delta[None])
    [about_moved] = error.local(moved, error.retract(state, (delta + e)[None])[0])[0]
    np.testing.assert_allclose(about_moved, basis @ e, atol=1e-9)
    further, [there] = error.retract(moved, delta[None])
    [back] = error.local(moved, further)[1]
    np.testing.assert_allclose(back @ there, np.eye(error.size), atol=1e-6)


@pytest.mark.parametrize("sensor", error_vector.SEEN)
def test_what_an_instrument_sees_is_linear_in_the_error(sensor):
    """At the size of an unknown heading and mounting, where the first order of `State` is off by per cents."""
    rng = np.random.default_rng(3)
    error, state = error_vector_and_state(rng)
    model = error_vector.seen_model(instruments(falcon(environment={"field_norm": 48.0}))[sensor].model)
    delta = 0.1 * rng.standard_normal(error.size)
    z, H = model.predict(state, np.zeros((1, 3)))
    moved = model.predict(error.retract(state, delta[None])[0], np.zeros((1, 3)))[0]
    linear = (error.matrix(H) @ delta)[0]
    np.testing.assert_allclose(innovation(model, moved, z)[0], linear, atol=1e-9 * max(np.abs(z).max(), 1.0))


# update


def problem(rng: np.random.Generator, spoilt: float = 0.0) -> tuple[Array, list[Array], list[Array]]:
    root = rng.standard_normal((5, 5))
    H = [rng.standard_normal((n, 5)) for n in (3, 1, 2)]
    r = [h @ (0.5 * rng.standard_normal(5)) + rng.standard_normal(len(h)) for h in H]
    r[0][0] += spoilt
    return root @ root.T + 0.1 * np.eye(5), r, H


def updated(P: Array, r: list[Array], H: list[Array], loss: str) -> tuple[Array, Array, list[float]]:
    ends = np.cumsum([0, *map(len, r)]).tolist()
    parts = [slice(*pair) for pair in pairwise(ends)]
    return Innovations(P[None], [np.concatenate(r)], [np.vstack(H)], [parts], [[loss] * len(r)]).update()[0]


def test_an_update_without_losses_is_kalmans():
    P, r, H = problem(np.random.default_rng(1))
    delta, posterior, weights = updated(P, r, H, "none")
    J = np.vstack(H)
    information = np.linalg.inv(P) + J.T @ J
    np.testing.assert_allclose(posterior, np.linalg.inv(information), atol=1e-9)
    np.testing.assert_allclose(delta, np.linalg.solve(information, J.T @ np.concatenate(r)), atol=1e-9)
    assert weights == [1.0] * 3


@pytest.mark.parametrize("loss", ["huber", "cauchy"])
def test_an_update_with_a_loss_minimises_the_robust_cost(loss):
    P, r, H = problem(np.random.default_rng(2), spoilt=15.0)
    delta, _, weights = updated(P, r, H, loss)

    def cost(x: Array) -> float:
        parts = [loss_and_weight((a - h @ x)[None], loss)[0][0] for a, h in zip(r, H, strict=True)]
        return float(0.5 * x @ np.linalg.solve(P, x) + sum(parts))

    best = minimize(cost, delta, tol=1e-10)
    assert cost(delta) < best.fun + 1e-4
    assert weights[0] < 0.5


# dives


def test_a_perfect_log_is_recovered():
    case = simulated(falcon(), 60.0, noise=False, style=Style(), dvl_rate=3.0)
    estimator = filtered(case.log, started(case))
    for estimate in (estimator.solve(), estimator.smoothed()):
        assert position_errors(estimate.trajectory, case).max() < 0.01
        assert np.linalg.norm(attitude_errors(estimate.trajectory, case), axis=1).max() < 0.01 * DEG


def test_smoother_agrees_with_the_graphs(case, estimator):
    """Same models, same priors: what differs is of the second order in what is uncertain."""
    expected, got = batch(case.log, case.config).solve().trajectory, estimator.smoothed().trajectory
    assert np.linalg.norm(got.p_n - expected.p_n, axis=1).max() < 0.03
    turn = log_rotation(transpose(expected.R_nb) @ got.R_nb)
    assert np.linalg.norm(turn, axis=1).max() < 0.1 * DEG
    np.testing.assert_allclose(got.p_sd, expected.p_sd, rtol=0.02)


def told(case: Simulated, part: float) -> Config:
    """The true start and calibration, with a part of their prior uncertainty."""
    calibration = {}
    for name, true in case.dive.hidden["calibration"].items():
        entry, angular = getattr(case.config.calibration, name), TABLE[name].angular
        tail, unit = ("_deg", 1.0 / DEG) if angular else ("", 1.0)
        if entry.estimate:
            calibration[name] = {"mean" + tail: (unit * true).tolist(), "sd" + tail: part * getattr(entry, "sd" + tail)}
    start = case.config.start
    sd = {key: part * getattr(start, key) for key in ("heading_sd_deg", "tilt_sd_deg")}
    return started(case, calibration=calibration, start=sd)


def test_smoother_agrees_better_where_start_and_calibration_are_known(case):
    """The difference to the graph's is one of linearisation."""
    config = told(case, 0.1)
    expected, got = batch(case.log, config).solve().trajectory, filtered(case.log, config).smoothed().trajectory
    assert np.linalg.norm(got.p_n - expected.p_n, axis=1).max() < 0.01
    np.testing.assert_allclose(got.p_sd, expected.p_sd, rtol=0.02)


def test_filter_and_smoother_end_alike(estimator):
    a, b = estimator.solve(), estimator.smoothed()
    for name in ("p_n", "R_nb", "v_n", "cov_p", "cov_theta", "cov_v"):
        np.testing.assert_array_equal(getattr(a.trajectory, name)[-1], getattr(b.trajectory, name)[-1])
    assert a.calibration == b.calibration
    assert (a.kind, b.kind) == ("ekf", "rts")
    np.testing.assert_array_equal(a.trajectory.time, b.trajectory.time)


def test_smoother_knows_more_than_the_filter_and_errs_less(case, estimator):
    a, b = estimator.solve().trajectory, estimator.smoothed().trajectory
    n = len(a) // 2
    assert (b.p_sd[n] < a.p_sd[n]).all() and b.rpy_sd[n, 2] < a.rpy_sd[n, 2]
    assert rms(position_errors(b, case)) < rms(position_errors(a, case))


@pytest.mark.parametrize("smoothed", [False, True])
def test_covariances_are_symmetric_and_positive(estimator, smoothed):
    P = covariances(estimator, smoothed)
    np.testing.assert_allclose(P, transpose(P), atol=1e-15)
    sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    correlation = P / (sd[:, :, None] * sd[:, None, :])
    assert (np.linalg.eigvalsh(correlation) > 0.0).all()


def test_calibration_converges_to_the_truth(case, estimator):
    estimate, hidden = estimator.solve(), case.dive.hidden["calibration"]
    for name in estimator.recursion.unknowns.estimated:
        history = estimate.history[name]
        assert (np.abs(history.value[-1] - hidden[name]) < 3.5 * history.sd[-1]).all(), name
    for name, part in (("dvl_yaw", 0.5), ("dvl_compass_offset", 0.2), ("hard_iron", 0.9)):
        assert (estimate.history[name].sd[-1] < part * estimate.history[name].sd[0].max()).all(), name


def test_smoothed_constants_are_the_same_at_all_times(estimator):
    histories = estimator.smoothed().history
    for name in estimator.recursion.unknowns.estimated:
        history = histories[name]
        np.testing.assert_allclose(history.value, history.value[[-1]].repeat(len(history.value), 0), atol=2e-3)


def test_calibration_that_walks_keeps_an_uncertainty(case):
    walk = 0.5
    config = changed(case.config, calibration={"dvl_yaw": {"walk_deg": walk}})
    history = filtered(case.log, config).solve().history["dvl_yaw"]
    still = filtered(case.log, case.config).solve().history["dvl_yaw"]
    assert history.sd[-1, 0] > 1.2 * still.sd[-1, 0]
    seconds = history.time[-1] - history.time[0]
    assert history.sd[-1, 0] ** 2 < still.sd[-1, 0] ** 2 + (walk * DEG) ** 2 * seconds


def test_feeding_measurements_and_replaying_intervals_are_the_same(case, estimator):
    again = replay(batch(case.log, case.config).intervals, initialise(case.log, case.config))
    np.testing.assert_allclose(again.solve().trajectory.p_n, estimator.solve().trajectory.p_n, atol=1e-12)
    np.testing.assert_array_equal(again.latest().p_n, again.filtered[-1].state.p_n)


def spoilt_logs(case: Simulated) -> list[Log]:
    """The dive; one that ends early; one without pings for a while; one whose pings jump and come back."""
    dvl, imu = case.log["dvl"], case.log["imu"]
    data = dvl.data.copy()
    jumps = (dvl.time > 20.0) & (dvl.time < 26.0)
    data[jumps, 0] += 2.0
    return [
        case.log,
        kept(case.log, "imu", imu.time < 31.0),
        kept(case.log, "dvl", (dvl.time < 15.0) | (dvl.time > 19.0)),
        altered(case.log, "dvl", data),
    ]


def test_filters_side_by_side_are_each_as_they_are_alone(case):
    batches = [batch(log, case.config) for log in spoilt_logs(case)]
    both = [(b, reinitialise_at) for b in batches for reinitialise_at in ((), (10.0,))]
    together = [ErrorStateFilter(b.beginning, reinitialise_at) for b, reinitialise_at in both]
    replay_together(together, [b.intervals for b, _ in both])
    alone = [replay(b.intervals, b.beginning, reinitialise_at) for b, reinitialise_at in both]
    for one, other in zip(together, alone, strict=True):
        for a, b in zip(one.filtered, other.filtered, strict=True):
            np.testing.assert_array_equal(a.state.p_n, b.state.p_n)
            np.testing.assert_array_equal(a.P, b.P)
        assert one.solve().summary == other.solve().summary
    assert together[6].solve().summary["nis"]["dvl"]["rejected"] > 10
    smoothed = smoothed_together(together[::2])
    for one, other in zip(smoothed, alone[::2], strict=True):
        np.testing.assert_array_equal(one.trajectory.p_n, other.smoothed().trajectory.p_n)


def test_filters_are_alike_that_differ_in_their_start_alone(case):
    short, other = beginning(spoilt_logs(case)[1], case.config), changed(case.config, depth={"sd_m": 0.5})
    first = beginning(case.log, case.config)
    turned = first.config.model_copy(update={"start": first.config.start.model_copy(update={"heading_deg": 90.0})})
    assert alike(first, short) and alike(first, replace(first, config=turned))
    assert not alike(first, beginning(case.log, other))
    assert not alike(first, beginning(without(case.log, "depth"), case.config))


def test_innovations_are_normal_with_the_covariance_predicted(case, estimator):
    """Mean NIS over n pings is its dimension, with an sd of sqrt(2 dim / n)."""
    for sensor, nis in estimator.solve().summary["nis"].items():
        sd = np.sqrt(2.0 * nis["dim"] / nis["count"])
        assert abs(nis["mean"] - nis["dim"]) < 4.0 * sd, sensor
        assert nis["rejected"] == 0


# what goes wrong


def spoilt(case: Simulated, wrong: Array | slice, by: float = 1.0) -> Log:
    data = case.log["dvl"].data.copy()
    data[wrong, 0] += by
    return altered(case.log, "dvl", data)


def dvl_weights(estimator: ErrorStateFilter) -> dict[float, float]:
    residuals = estimator.solve().residuals
    dvl = residuals[residuals["sensor"] == "dvl"]
    return dict(zip(dvl["time"], dvl["weight"], strict=True))


def test_gross_outliers_are_kept_out_and_nothing_else(case, estimator):
    wrong = np.arange(5, 170, 20)
    gated = filtered(spoilt(case, wrong), case.config)
    assert {t for t, w in dvl_weights(gated).items() if w == 0.0} == set(case.log["dvl"].time[wrong])
    a, b = gated.smoothed().trajectory, estimator.smoothed().trajectory
    assert np.linalg.norm(a.p_n - b.p_n, axis=1).max() < 0.05
    assert gated.solve().summary["nis"]["dvl"]["rejected"] == len(wrong)


def test_a_loss_bounds_what_ungated_outliers_do(case, estimator):
    log, clean = spoilt(case, np.arange(5, 170, 10), 0.5), estimator.solve().trajectory
    off = {}
    for loss in ("none", "huber", "cauchy"):
        config = changed(case.config, dvl={"gate_sd": None, "loss": loss})
        trajectory = filtered(log, config).solve().trajectory
        off[loss] = rms(np.linalg.norm(trajectory.p_n - clean.p_n, axis=1))
    assert off["huber"] < 0.3 * off["none"]
    assert off["cauchy"] < 0.1 * off["none"]


def test_a_sensor_that_is_kept_out_for_long_is_let_in_again_and_moves_nothing_by_more_than_three_sd(case):
    begin, seconds = 100, 2.0
    config = changed(case.config, dvl={"gate_sd": 4.0, "loss": "none", "readmit_s": seconds})
    estimator = filtered(spoilt(case, slice(begin, None)), config)
    time = case.log["dvl"].time[begin:]
    weights = dvl_weights(estimator)
    back = next(t for t in time if weights[t] > 0.0)
    assert seconds < back - time[0] < seconds + 2.0
    t = estimator.solve().trajectory
    k = int(np.searchsorted(t.time, back - 1e-6))
    jump = np.linalg.norm(t.v_n[k] - t.v_n[k - 1])
    assert 0.5 < jump < 3.0 * np.linalg.norm(t.v_sd[k - 1])


def test_a_dvl_that_vanishes_and_returns_leaves_an_honest_track():
    case = simulated(falcon(), 60.0, seed=8, dvl_rate=3.0, dropouts=((25.0, 40.0),))
    estimator = filtered(case.log, case.config)
    for estimate in (estimator.solve(), estimator.smoothed()):
        t = estimate.trajectory
        assert (position_errors(t, case) < 4.5 * np.linalg.norm(t.p_sd, axis=1)).all()
    t = estimator.solve().trajectory
    speed_sd = np.linalg.norm(t.v_sd, axis=1)
    before, lost, after = (speed_sd[int(np.searchsorted(t.time, s))] for s in (24.0, 39.5, 45.0))
    assert lost > 10.0 * before and after < 1.5 * before


def test_a_compass_that_is_lost_leaves_heading_to_the_gyro(case):
    late = case.log["mag"].time > 30.0
    data = case.log["mag"].data[~late]
    stream = replace(case.log["mag"], time=case.log["mag"].time[~late], data=data, row=case.log["mag"].row[~late])
    log = Log(case.log.source, {**without(case.log, "dvl_heading").streams, "mag": stream})
    t = filtered(log, case.config).solve().trajectory
    n = int(np.searchsorted(t.time, 31.0))
    grown = t.rpy_sd[-1, 2] ** 2 - t.rpy_sd[n, 2] ** 2
    assert grown > 0.99 * case.config.imu.noise.gyr**2 * (t.time[-1] - t.time[n])
    assert (np.abs(attitude_errors(t, case)[:, 2]) < 4.5 * t.rpy_sd[:, 2]).all()


# honesty


def heading_sd_without_a_compass(case: Simulated) -> tuple[float, float]:
    """At the start and at the end, where nothing tells of heading."""
    config = started(case, heading={"sources": []}, calibration={"dvl_yaw": {"estimate": True}})
    estimator = filtered(case.log, config)
    sd = estimator.solve().trajectory.rpy_sd[:, 2]
    return float(sd[0]), float(sd[-1])


def test_a_filter_without_a_compass_never_learns_its_heading(case):
    first, last = heading_sd_without_a_compass(case)
    assert last > 0.999 * first


def test_in_plain_coordinates_it_would_believe_to(case, monkeypatch):
    monkeypatch.setattr(error_vector, "SEEN", {})
    first, last = heading_sd_without_a_compass(case)
    assert last < 0.95 * first


def one_dive(seed: int) -> Array:
    """NEES of the smoother at mid-dive, the filter at the end, and there with a boastful DVL; shape (3, 3)."""
    case, config = drawn(seed)
    estimator = filtered(case.log, config)
    smoothed, last = estimator.smoothed().trajectory, estimator.solve().trajectory
    sd = [s / OVERCONFIDENT for s in config.dvl.velocity_sd_mps]
    boastful = filtered(case.log, changed(config, dvl={"velocity_sd_mps": sd})).solve().trajectory
    return np.array([nees(smoothed, case, len(smoothed) // 2), nees(last, case, -1), nees(boastful, case, -1)])


def mean_nees(seeds: range) -> Array:
    """Over dives, shape (3 kinds, 3 quantities)."""
    with ProcessPoolExecutor(2) as pool:
        return np.asarray(np.mean(list(pool.map(one_dive, seeds)), axis=0))


def check_honesty(seeds: range) -> None:
    smoothed, last, boastful = mean_nees(seeds)
    low, high = band(len(seeds))
    assert ((smoothed > low) & (smoothed < high)).all(), smoothed
    assert ((last > low) & (last < high)).all(), last
    assert (boastful > high).any(), boastful


def test_errors_are_as_large_as_filter_and_smoother_say():
    check_honesty(range(1, 5))


@pytest.mark.slow
def test_errors_are_as_large_as_filter_and_smoother_say_over_many_dives():
    check_honesty(range(1, 25))
