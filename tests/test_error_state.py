"""The error-state filter and its smoother: linearisation, recovery, gates, agreement with the graph, honesty."""

from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest
from dives import (
    RecordingFilter,
    Simulated,
    altered,
    attitude_errors,
    batch,
    changed,
    falcon,
    fed,
    position_errors,
    rms,
    simulated,
    started,
    without,
)
from motions import predict, transition
from scipy.optimize import minimize
from test_consistency import OVERCONFIDENT, band, drawn, nees

from rovgraph.geometry import Array, log_rotation, matrix_from_rpy, transpose
from rovgraph.inference import filter
from rovgraph.inference.error_state import ErrorStateFilter, replay
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.filter_step import Gaussian, Met
from rovgraph.inference.initialise import initialise
from rovgraph.kernels import measurement_row
from rovgraph.kernels.correction import (
    DISTRUSTED_S,
    MAX_REWEIGHTINGS,
    RETURN_SD,
    SETTLED,
    Innovations,
    Weights,
    admit,
    innovation_covariance,
    joseph,
    observed_directions,
    reweight,
)
from rovgraph.kernels.error_coordinates import ErrorColumns as Coordinates
from rovgraph.kernels.filter_state import FilterModel, FilterState
from rovgraph.kernels.filtering import predict_filter
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.motion_row import DURATION, ROW
from rovgraph.kernels.weighting import LOSSES
from rovgraph.log import Log
from rovgraph.model.calibration import LAYERS, LAYOUT, TABLE, calibration_size
from rovgraph.model.config import Config, beliefs
from rovgraph.model.state import DIMENSION, VELOCITY, State
from rovgraph.problem.initial_conditions import InitialConditions, StatePrior
from rovgraph.problem.measurements import loss_and_weight, loss_threshold
from rovgraph.problem.motion import INTEGRATION_SD, preintegrate, preintegration_params
from rovgraph.problem.problem import Index, Problem
from rovgraph.sensors import innovation
from rovgraph.sensors.instruments import instruments
from rovgraph.simulate import Style

DEG = np.deg2rad(1.0)


def filtered(log: Log, config: Config) -> RecordingFilter:
    return fed(RecordingFilter(initialise(log, config)), log)


def covariances(estimator: RecordingFilter, smoothed: bool = False) -> Array:
    """Of every keyframe, shape (n, size, size)."""
    return np.array([k.P for k in (estimator.backward() if smoothed else estimator.filtered)])


@pytest.fixture(scope="session")
def case() -> Simulated:
    return simulated(falcon(), 60.0, seed=6, dvl_rate=3.0)


@pytest.fixture(scope="session")
def estimator(case) -> RecordingFilter:
    return filtered(case.log, case.config)


def measuring(dive: Problem, row: int, z: Array) -> Problem:
    """The same dive, with other components of one measurement."""
    rows = dive.rows.copy()
    rows[row, measurement_row.Z : measurement_row.Z + len(z)] = z
    return replace(dive, rows=rows)


def between(dive: Problem, k: int) -> slice:
    """Measurements from the keyframe before keyframe k to it."""
    return slice(dive.measured_in(k)[0], int(dive.first[k]))


def here(dive: Problem, k: int) -> slice:
    """Measurements at keyframe k, of the interval that ends with it."""
    return slice(int(dive.first[k]), dive.measured_in(k)[1])


# motion


def moving(seconds: float, rate: float = 100.0) -> tuple[State, Array]:
    """A state and IMU samples, time, specific force, rate, of a vehicle that turns and accelerates."""
    t = np.arange(0.0, seconds + 1.5 / rate, 1.0 / rate)
    f = np.column_stack([0.3 * np.sin(2 * t), 0.2 + 0 * t, -9.7 + 0.1 * np.cos(t)])
    w = np.column_stack([0.1 * np.cos(3 * t), 0.05 + 0 * t, 0.3 * np.sin(t)])
    bias = np.array([[0.02, -0.01, 0.03, 0.002, -0.003, 0.001]])
    attitude = matrix_from_rpy([[0.1, -0.2, 2.0]])
    return State(attitude, np.array([[3.0, -2.0, 5.0]]), np.array([[0.4, -0.2, 0.1]]), bias), np.column_stack([t, f, w])


def motion_of(samples: Array, seconds: float, bias: Array, config: Config) -> tuple[Array, Array]:
    """The motion, and the covariance of its residual."""
    motion, covariance, _ = preintegrate(preintegration_params(config), bias, samples, 0.0, np.empty(0), seconds)
    return motion, covariance


def difference(state: State, other: State) -> Array:
    """In the tangent space of `State`, shape (15,)."""
    R_bn = transpose(state.R_nb[0])
    turn = log_rotation(R_bn @ other.R_nb[0])
    change = (R_bn @ (other.p_n - state.p_n)[0], (other.v_n - state.v_n)[0], (other.bias - state.bias)[0])
    return np.concatenate([turn, *change])


def test_transition_is_the_derivative_of_the_prediction():
    state, samples = moving(0.5)
    motion, covariance = motion_of(samples, 0.5, np.zeros(6), falcon())
    after, F, _ = transition(motion, covariance, state)
    step, columns = 1e-5, []
    for variable, size in DIMENSION.items():
        for k in range(size):
            ends = [predict(motion, state.retract(variable, sign * step * np.eye(size)[k])) for sign in (1, -1)]
            columns.append((difference(after, ends[0]) - difference(after, ends[1])) / (2 * step))
    np.testing.assert_allclose(F, np.column_stack(columns), atol=1e-6)


def test_process_noise_is_that_of_noisy_samples():
    """Errors of many predictions, whitened with Q, have the covariance of a Wishart matrix over its count."""
    count, seconds, rate = 400, 1.0, 100.0
    config, rng = falcon(), np.random.default_rng(4)
    noise = config.imu.noise
    state, samples = moving(seconds)
    state = replace(state, bias=np.zeros((1, 6)))
    exact, _, Q = transition(*motion_of(samples, seconds, np.zeros(6), config), state)
    densities = np.repeat([noise.acc, noise.gyr], 3)
    walks = np.repeat([noise.acc_walk, noise.gyr_walk], 3)
    errors = []
    for _ in range(count):
        drift = np.cumsum(walks / np.sqrt(rate) * rng.standard_normal((len(samples), 6)), axis=0)
        noisy = samples.copy()
        noisy[:, 1:] += drift + densities * np.sqrt(rate) * rng.standard_normal((len(samples), 6))
        predicted = predict(motion_of(noisy, seconds, np.zeros(6), config)[0], state)
        integration = INTEGRATION_SD * np.sqrt(seconds) * rng.standard_normal((1, 3))
        truth = replace(exact, p_n=exact.p_n + integration, bias=drift[[int(seconds * rate)]])
        errors.append(difference(predicted, truth))
    whitened = np.linalg.solve(np.linalg.cholesky(Q), np.array(errors).T)
    found = whitened @ whitened.T / count
    sd = np.sqrt((1.0 + np.eye(15)) / count)
    assert (np.abs(found - np.eye(15)) < 4.5 * sd).all()


def test_all_measurements_of_a_keyframe_together_are_linearised_as_each_alone(estimator):
    """By the filter's kernel as by the models that the smoother uses."""
    engine, dive = estimator.engine, estimator.problem
    k = max(range(len(dive)), key=lambda k: len(set(dive.which[slice(*dive.measured_in(k))].tolist())))
    known, index = estimator.filtered[k], np.arange(*dive.measured_in(k))
    assert len(index) > 2
    assert dive.rows[index, measurement_row.DT].any()
    r, H = engine.linearize(known, dive, index)
    for row, part in zip(index, parts_of(dive, index), strict=True):
        alone, jacobians = engine.measurements(dive, np.array([row])).linearize(known.state)
        np.testing.assert_allclose(r[part], alone[0], atol=1e-9)
        np.testing.assert_allclose(H[part], engine.layout.matrix(jacobians)[0], atol=1e-9)


def parts_of(dive: Problem, index: Index) -> list[slice]:
    """The rows of each measurement, of all their rows."""
    ends = np.cumsum([0, *(dive.dims[sensor] for sensor in dive.which[index])]).tolist()
    return [slice(*pair) for pair in pairwise(ends)]


# coordinates of the error


def engine_and_estimate(rng: np.random.Generator) -> tuple[FilterEngine, Gaussian]:
    """A filter that estimates all calibration, and an estimate with any covariance."""
    environment = {"field_norm": 48.0}
    names = [n for i in instruments(falcon(environment=environment)).values() for n in i.model.calibration]
    stated = {*names, *(n for n, v in TABLE.items() if v.considered)} - {*LAYERS}
    estimated = {n: {"estimate": n in names} for n in stated}
    config = falcon(calibration=estimated, environment=environment)
    calibration = {
        n: 0.05 * rng.standard_normal(TABLE[n].dim) if n in names else np.zeros(v.dim) for n, v in TABLE.items()
    }
    state = replace(moving(0.1)[0], calibration=calibration)
    prior = StatePrior(state, np.ones(3), np.ones(3), np.ones(3), np.ones(6))
    engine = FilterEngine(InitialConditions(config, instruments(config), prior, []))
    assert engine.layout.size == 15 + sum(TABLE[n].dim for n in set(names))
    root = rng.standard_normal((engine.layout.size, engine.layout.size))
    return engine, Gaussian.of(state, root @ root.T)


def test_the_local_error_is_the_inverse_of_the_retraction():
    rng = np.random.default_rng(1)
    engine, known = engine_and_estimate(rng)
    delta = 0.2 * rng.standard_normal(engine.layout.size)
    moved = engine.retract(known, delta, known.P)
    np.testing.assert_allclose(engine.local(known, moved)[0], delta, atol=1e-9)


def test_a_change_of_basis_carries_errors_from_one_state_to_another():
    """What lies at delta + e about a state lies at basis e about where delta leads."""
    rng = np.random.default_rng(2)
    engine, known = engine_and_estimate(rng)
    delta, e = (size * rng.standard_normal(engine.layout.size) for size in (1e-4, 1e-6))
    moved = engine.retract(known, delta, known.P)
    basis = engine.local(moved, known)[1]
    about_moved = engine.local(moved, engine.retract(known, delta + e, known.P))[0]
    np.testing.assert_allclose(about_moved, basis @ e, atol=1e-9)
    np.testing.assert_allclose(engine.local(known, moved)[1] @ basis, np.eye(len(basis)), atol=1e-6)
    np.testing.assert_allclose(moved.P, basis @ known.P @ basis.T, rtol=1e-6, atol=1e-6 * np.abs(known.P).max())


def test_a_change_of_basis_is_the_derivative_of_the_retraction_in_coordinates_of_where_it_leads():
    """By finite differences; turns along the way do not add up, but each instrument sees them as its Jacobians say."""
    rng = np.random.default_rng(4)
    engine, known = engine_and_estimate(rng)
    size, step = engine.layout.size, 1e-6
    delta = 0.2 * rng.standard_normal(size)
    moved = engine.retract(known, delta, known.P)
    columns = []
    for e in step * np.eye(size):
        ends = [engine.local(moved, engine.retract(known, delta + s * e, known.P))[0] for s in (1.0, -1.0)]
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    derivative, basis = np.column_stack(columns), engine.local(moved, known)[1]
    assert np.abs(basis - np.eye(size)).max() > 0.1
    np.testing.assert_allclose(derivative[:, 3:], basis[:, 3:], atol=1e-6)
    for sensor in filter.SEEN:
        model = filter.seen_model(engine.initial.instruments[sensor].model)
        H, there = (engine.layout.matrix(model.predict(k.state, np.zeros((1, 3)))[1])[0] for k in (known, moved))
        np.testing.assert_allclose(there @ derivative, H, atol=1e-6 * np.abs(H).max())


@pytest.mark.parametrize("sensor", filter.SEEN)
def test_what_an_instrument_sees_is_linear_in_the_error(sensor):
    """At the size of an unknown heading and mounting, where the first order of `State` is off by per cents."""
    rng = np.random.default_rng(3)
    engine, known = engine_and_estimate(rng)
    model = filter.seen_model(instruments(falcon(environment={"field_norm": 48.0}))[sensor].model)
    delta = 0.1 * rng.standard_normal(engine.layout.size)
    z, H = model.predict(known.state, np.zeros((1, 3)))
    moved = model.predict(engine.retract(known, delta, known.P).state, np.zeros((1, 3)))[0]
    linear = (engine.layout.matrix(H) @ delta)[0]
    np.testing.assert_allclose(innovation(model, moved, z)[0], linear, atol=1e-9 * max(np.abs(z).max(), 1.0))


# prediction


def test_an_error_that_lasts_keeps_its_stationary_variance_and_what_walks_gains_by_time():
    """A fix_error of sd 0.7 m and 30 s, and a scale that walks, over 8 s without motion."""
    names, seconds, sd, walk = ("fix_error", "dvl_scale"), 8.0, 0.7, 0.02
    column, n = np.full(MOTION + calibration_size(), -1), MOTION + 3
    column[:MOTION] = np.arange(MOTION)
    own = [MOTION + k for name in names for k in range(LAYOUT[name].start, LAYOUT[name].stop)]
    column[own] = np.arange(MOTION, n)
    x, c, P = np.zeros(21), np.zeros(calibration_size()), np.zeros((n, n))
    x[:9] = np.eye(3).ravel()
    c[LAYOUT["fix_error"]] = 1.0
    P[MOTION:, MOTION:] = np.diag([sd**2, sd**2, 0.5**2])
    walks = np.zeros((3, n))
    walks[0, MOTION:], walks[1, MOTION : MOTION + 2] = [2.0 / 30.0 * sd**2] * 2 + [walk**2], 1.0 / 30.0
    motion, nothing = np.zeros(ROW), np.zeros((0, 0))
    motion[DURATION] = seconds
    known = FilterState(x, c, P, np.zeros((n, 0)), nothing)
    layout = Coordinates(np.arange(n), np.zeros((0, 3), np.int64), nothing, np.zeros(0, np.int64))
    model = FilterModel(np.zeros((0, measurement_row.PARAMS)), column, layout, walks, 0.0)
    predict_filter(known, motion, np.zeros((MOTION, MOTION)), nothing, model, P.copy(), P.copy())
    np.testing.assert_allclose(np.diag(P)[MOTION:], [sd**2, sd**2, 0.5**2 + walk**2 * seconds])
    np.testing.assert_allclose(c[LAYOUT["fix_error"]], np.exp(-seconds / 30.0))


# admission


def admitted(nis: float, time: float, since: float, gate: float = 4.0, readmit: float = 20.0) -> tuple[bool, float]:
    """Whether a measurement is let in, and since when its sensor is left out after it."""
    sensor, out = np.zeros(measurement_row.PARAMS), np.array([since])
    sensor[measurement_row.GATE], sensor[measurement_row.READMIT] = gate, readmit
    return admit(nis, time, sensor, out, 0), out[0]


def test_a_gate_lets_in_what_lies_within_it_and_remembers_since_when_a_sensor_is_out():
    assert admitted(3.99**2, 7.0, np.nan) == (True, pytest.approx(np.nan, nan_ok=True))
    assert admitted(4.01**2, 7.0, np.nan) == (False, 7.0)
    assert admitted(4.01**2, 8.0, 7.0) == (False, 7.0)
    assert admitted(3.99**2, 7.0 + 0.99 * DISTRUSTED_S, 7.0)[0]


def test_after_two_seconds_of_being_left_out_a_sensor_returns_within_three_sd():
    late = 7.0 + 1.01 * DISTRUSTED_S
    assert (DISTRUSTED_S, RETURN_SD) == (2.0, 3.0)
    assert admitted(3.01**2, late, 7.0) == (False, 7.0)
    assert admitted(2.99**2, late, 7.0)[0]
    assert not admitted(3.01**2, 7.0 + 1.01, 7.0, readmit=1.0)[0]  # sooner where the sensor's own time is shorter


def test_a_knock_at_any_time_since_has_the_moments_of_a_uniform_time():
    """The way t v of a velocity v since t, uniform from 0 to T: T/2 v in the mean, T^2/3 in the square."""
    T, x, sensor = 6.0, np.zeros(21), np.zeros(measurement_row.PARAMS)
    x[:9] = matrix_from_rpy(np.array([0.3, -0.2, 1.0])).ravel()
    sensor[measurement_row.SEES : measurement_row.SEES + 3] = 1.0
    sensor[measurement_row.SEEN_FRAME] = measurement_row.SEES_VELOCITY
    seen, spread = observed_directions(x, sensor, MOTION, T)
    R_nb, second = x[:9].reshape(3, 3), seen @ seen.T + spread @ spread.T
    np.testing.assert_allclose(second[6:9, 6:9], np.eye(3))
    np.testing.assert_allclose(second[6:9, 3:6], 0.5 * T * R_nb, atol=1e-12)
    np.testing.assert_allclose(second[3:6, 3:6], T**2 / 3.0 * np.eye(3), atol=1e-12)


def test_an_update_carries_what_is_considered_as_its_estimate_would_move():
    """Schmidt's: of an error B y the correction leaves (B - K (H B + H_y)) y."""
    rng = np.random.default_rng(4)
    P, r, H = problem(rng)
    J, innovation_, B, H_y = np.vstack(H), np.concatenate(r), rng.standard_normal((5, 2)), rng.standard_normal((6, 2))
    K = P @ J.T @ np.linalg.inv(J @ P @ J.T + np.eye(6))
    expected = B - K @ (J @ B + H_y)
    found, delta = Innovations(np.array([0, 6]), innovation_, J, H_y, np.empty((6, 5)), np.empty((6, 6))), np.empty(5)
    innovation_covariance(P, found)
    weights = Weights(np.zeros(1, np.int64), np.zeros(1), np.ones(1), np.ones(6), np.linalg.inv(found.S + np.eye(6)))
    joseph(P, B, found, weights, delta)
    np.testing.assert_allclose(B, expected, atol=1e-12)
    np.testing.assert_allclose(delta, K @ innovation_, atol=1e-12)


# update


def problem(rng: np.random.Generator, spoilt: float = 0.0) -> tuple[Array, list[Array], list[Array]]:
    root = rng.standard_normal((5, 5))
    H = [rng.standard_normal((n, 5)) for n in (3, 1, 2)]
    r = [h @ (0.5 * rng.standard_normal(5)) + rng.standard_normal(len(h)) for h in H]
    r[0][0] += spoilt
    return root @ root.T + 0.1 * np.eye(5), r, H


def updated(P: Array, r: list[Array], H: list[Array], loss: str) -> tuple[Array, Array, Array]:
    """The kernels' correction, covariance after it and weights."""
    first, P = np.cumsum([0, *map(len, r)]), P.copy()
    rows, J = np.concatenate(r), np.vstack(H)
    m, n = J.shape
    found, delta = Innovations(first, rows, J, np.zeros((m, 0)), np.empty((m, n)), np.empty((m, m))), np.empty(n)
    innovation_covariance(P, found)
    bends = np.array([loss_threshold(loss, len(own)) for own in r])
    losses = np.full(len(r), LOSSES.index(loss))
    weights = Weights(losses, bends, np.empty(len(r)), np.empty(m), np.empty((m, m)))
    reweight(found, weights)
    joseph(P, np.zeros((n, 0)), found, weights, delta)
    return delta, P, weights.weight


def test_an_update_without_losses_is_kalmans():
    P, r, H = problem(np.random.default_rng(1))
    delta, posterior, weights = updated(P, r, H, "none")
    J = np.vstack(H)
    information = np.linalg.inv(P) + J.T @ J
    np.testing.assert_allclose(posterior, np.linalg.inv(information), atol=1e-9)
    np.testing.assert_allclose(delta, np.linalg.solve(information, J.T @ np.concatenate(r)), atol=1e-9)
    np.testing.assert_array_equal(weights, 1.0)


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


def kalman(P: Array, r: Array, H: Array, parts: list[slice], losses: list[str]) -> tuple[Array, Array, Array]:
    """A Kalman filter's update, iterated with the weights of losses, and Joseph's covariance: a textbook's."""
    weights, eye = np.ones(len(parts)), np.eye(len(P))
    for _ in range(MAX_REWEIGHTINGS):
        noise = np.concatenate([np.full(len(r[part]), 1.0 / w) for part, w in zip(parts, weights, strict=True)])
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(noise))
        left = r - H @ K @ r
        last, weights = (
            weights,
            np.array([loss_and_weight(left[None, part], loss)[1][0] for part, loss in zip(parts, losses, strict=True)]),
        )
        if np.abs(weights - last).max() < SETTLED:
            break
    return K @ r, (eye - K @ H) @ P @ (eye - K @ H).T + K @ np.diag(noise) @ K.T, weights


def test_intervals_in_a_row_come_out_as_one_by_one(case):
    data = case.log["dvl"].data.copy()
    data[20::17, 0] += 1.0  # some that the gate leaves out
    dive = batch(altered(case.log, "dvl", data), case.config)
    alone = ErrorStateFilter(dive.initial, (10.0,))
    alone.problem = dive.problem
    for _ in range(len(dive.problem)):
        alone.step()
    together = replay(dive.problem, dive.initial, (10.0,))
    np.testing.assert_array_equal(together.known.P, alone.known.P)
    np.testing.assert_array_equal(together.states().p_n, alone.states().p_n)
    assert together.gates == alone.gates
    a, b = together.solve(), alone.solve()
    assert (a.residuals["weight"] == 0.0).any()
    pd.testing.assert_frame_equal(a.residuals, b.residuals)
    np.testing.assert_array_equal(a.trajectory.p_sd, b.trajectory.p_sd)


@pytest.mark.parametrize("where", [between, here])
@pytest.mark.parametrize("loss", LOSSES)
def test_a_correction_is_a_textbooks_kalman_update_moved_along_the_coordinates(estimator, where, loss):
    initial = estimator.initial
    lossy = {sensor: replace(instrument, loss=loss) for sensor, instrument in initial.instruments.items()}
    engine = FilterEngine(replace(initial, instruments=lossy))
    dive = estimator.problem
    k = max(range(60, len(dive)), key=lambda k: where(dive, k).stop - where(dive, k).start)
    known, some = estimator.filtered[k - 1], where(dive, k)
    if where is here:
        known = engine.predict(dive, k, known).predicted
    index, sensors = np.arange(some.start, some.stop), [dive.sensors[sensor] for sensor in dive.which[some]]
    last, dim = index[-1:], dive.dims[dive.which[index[-1]]]
    dive = measuring(dive, index[-1], (dive.z(last, dim) + 10.0 * dive.sd(last, dim))[0])
    met = Met.of(dive, k, len(known.c))
    after = engine.correct(known, dive, some, None, met)
    (r, H), parts = engine.linearize(known, dive, index), parts_of(dive, index)
    losses = [engine.initial.instruments[sensor].loss for sensor in sensors]
    delta, P, weights = kalman(known.P, r, H, parts, losses)
    expected = engine.retract(known, delta, P)
    np.testing.assert_allclose(after.x, expected.x, atol=1e-9)
    np.testing.assert_allclose(after.c, expected.c, atol=1e-9)
    np.testing.assert_allclose(after.P, expected.P, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(met.weight[index - met.begin], weights, atol=1e-9)
    assert (min(weights) < 1.0) == (loss != "none")
    for nis, part in zip(met.nis[index - met.begin], parts, strict=True):
        S = H[part] @ known.P @ H[part].T + np.eye(len(r[part]))
        assert nis == pytest.approx(r[part] @ np.linalg.solve(S, r[part]))


def test_a_step_is_a_correction_a_prediction_and_a_correction(estimator):
    engine = estimator.engine
    dive = estimator.problem
    k = next(k for k in range(40, len(dive)) if dive.measured_in(k)[0] < dive.first[k] < dive.measured_in(k)[1])
    before = estimator.filtered[k - 1]
    step = engine.step(dive, k, before, {}, wholly=True)
    departed = engine.correct(before, dive, between(dive, k), {})
    transition = engine.predict(dive, k, departed)
    filtered = engine.correct(transition.predicted, dive, here(dive, k), {})
    for one, other in (
        (step.departed, departed),
        (step.transition.predicted, transition.predicted),
        (step.filtered, filtered),
    ):
        np.testing.assert_array_equal(one.x, other.x)
        np.testing.assert_array_equal(one.c, other.c)
        np.testing.assert_array_equal(one.P, other.P)
    F, Q = transition.F, transition.Q
    np.testing.assert_allclose(transition.predicted.P, F @ departed.P @ F.T + Q, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(step.transition.F, F)
    np.testing.assert_array_equal(step.met.index, np.arange(between(dive, k).start, here(dive, k).stop))
    at_keyframe = dive.keyframe[step.met.index] == k
    np.testing.assert_array_equal(step.met.x, np.where(at_keyframe[:, None], transition.predicted.x, before.x))
    assert step.met.nis.all()
    np.testing.assert_array_equal(before.x, estimator.filtered[k - 1].x)


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
        belief, angular = beliefs(case.config)[name], TABLE[name].angular
        tail, unit = ("_deg", 1.0 / DEG) if angular else ("", 1.0)
        if name not in LAYERS and (belief.estimate or belief.considered):
            calibration[name] = {"mean" + tail: (unit * true).tolist(), "sd" + tail: unit * part * belief.sd}
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
    for name in estimator.engine.unknowns.estimated:
        history = estimate.history[name]
        assert (np.abs(history.value[-1] - hidden[name]) < 3.5 * history.sd[-1]).all(), name
    for name, part in (("dvl_yaw", 0.5), ("dvl_compass_offset", 0.2), ("hard_iron", 0.9)):
        assert (estimate.history[name].sd[-1] < part * estimate.history[name].sd[0].max()).all(), name


def test_smoothed_constants_are_the_same_at_all_times(estimator):
    histories = estimator.smoothed().history
    for name in estimator.engine.unknowns.estimated:
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
    again = replay(batch(case.log, case.config).problem, initialise(case.log, case.config))
    np.testing.assert_allclose(again.solve().trajectory.p_n, estimator.solve().trajectory.p_n, atol=1e-12)
    np.testing.assert_array_equal(again.latest().p_n, again.known.state.p_n)


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


def dvl_weights(estimator: RecordingFilter) -> dict[float, float]:
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


def left_out(estimator: RecordingFilter, off: float, since: float) -> tuple[Gaussian, Gaussian, bool, dict[str, float]]:
    """A keyframe before and after a ping that is off by some sd, its sensor left out for some time.

    Also whether the ping was let in, and the gates after it.
    """
    engine, dive, k = estimator.engine, estimator.problem, 100
    known = engine.predict(dive, k, estimator.departed[k - 1]).predicted
    [ping] = np.intersect1d(dive.of_sensor("dvl"), np.arange(len(dive.rows))[here(dive, k)])
    own = np.array([ping])
    _, H = engine.linearize(known, dive, own)
    along = np.linalg.cholesky(H @ known.P @ H.T + np.eye(3))[:, 0]
    aside = measuring(dive, ping, dive.z(own, 3)[0] - engine.measurements(dive, own).innovations(known.state)[0])
    r, _ = engine.linearize(known, aside, own)
    np.testing.assert_allclose(r, 0.0, atol=1e-9)
    shift = np.linalg.solve(engine.measurements(dive, own).W[0], along * off)
    shifted = measuring(aside, ping, aside.z(own, 3)[0] + shift)
    met = Met.of(shifted, k, len(known.c))
    gates = {} if since == 0.0 else {"dvl": float(dive.rows[ping, measurement_row.TIME]) - since}
    after = engine.correct(known, shifted, slice(ping, ping + 1), gates, met)
    assert np.sqrt(met.nis[ping - met.begin]) == pytest.approx(off)
    return known, after, bool(met.weight[ping - met.begin] > 0.0), gates


def test_a_measurement_beyond_its_gate_changes_nothing_and_is_remembered(estimator):
    gate = estimator.initial.instruments["dvl"].gate_sd
    known, after, let_in, gates = left_out(estimator, 1.01 * gate, 0.0)
    assert not let_in and list(gates) == ["dvl"]
    np.testing.assert_array_equal(after.x, known.x)
    np.testing.assert_array_equal(after.P, known.P)
    *_, let_in, gates = left_out(estimator, 0.99 * gate, 0.0)
    assert let_in and not gates


def test_a_sensor_that_was_left_out_for_long_returns_within_three_sd(estimator):
    long = 1.01 * estimator.initial.instruments["dvl"].readmit_s
    assert not left_out(estimator, 1.01 * RETURN_SD, long)[2]
    *_, let_in, gates = left_out(estimator, 0.99 * RETURN_SD, long)
    assert let_in and not gates


def test_a_sensor_that_was_left_out_for_long_inflates_what_it_sees_and_what_follows_from_it(estimator):
    """As a knock at any time since would have to have moved velocity and position, for the ping to be as it is.

    Moments of the way t v, t even between 0 and T: T/2 v in the mean, T^2/3 v^2.
    """
    engine, long = estimator.engine, 1.01 * estimator.initial.instruments["dvl"].readmit_s
    known, after, let_in, gates = left_out(estimator, 50.0, long)
    assert not let_in and list(gates) == ["dvl"]
    np.testing.assert_array_equal(after.x, known.x)
    own = engine.layout.columns[VELOCITY]
    grown, R_nb = after.P - known.P, known.state.R_nb[0]
    square = grown[own, own][0, 0]
    assert square > 0.0
    expected = np.zeros_like(grown)
    expected[own, own] = square * np.eye(3)
    expected[own, 3:6] = 0.5 * long * square * R_nb
    expected[3:6, own] = expected[own, 3:6].T
    expected[3:6, 3:6] = long**2 / 3.0 * square * np.eye(3)
    np.testing.assert_allclose(grown, expected, atol=1e-12)


def test_a_dvl_that_vanishes_and_returns_leaves_an_honest_track():
    case = simulated(falcon(), 60.0, seed=8, dvl_rate=3.0, dropouts=((25.0, 40.0),))
    estimator = filtered(case.log, case.config)
    for estimate in (estimator.solve(), estimator.smoothed()):
        t = estimate.trajectory
        assert (position_errors(t, case) < 4.5 * np.linalg.norm(t.p_sd, axis=1)).all()
    t = estimator.solve().trajectory
    speed_sd = np.linalg.norm(t.v_sd, axis=1)
    before, back, after = (int(np.searchsorted(t.time, s)) for s in (24.0, 40.0, 45.0))
    before, lost, after = speed_sd[[before, back - 1, after]]
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
    monkeypatch.setattr(filter, "SEEN", {})
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
