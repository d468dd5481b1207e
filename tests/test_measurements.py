"""Blocks of measurements: their factors are the finite differences of their innovations."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from dives import batch, simulated
from motions import Delta, problem_of, propagate
from scipy.stats import chi2
from test_sensors import CONFIG, SENSORS, random_state

from rovgraph.geometry import Array, exp_rotation, matrix_from_rpy
from rovgraph.inference.graph.batch import RowPlaces, measurement_factor, measurement_keys, robust_noise
from rovgraph.inference.graph.values import insert_calibration, insert_state, key
from rovgraph.kernels import assembly, motion_row
from rovgraph.kernels import measurement_row as at
from rovgraph.model.calibration import TABLE, calibration_size
from rovgraph.model.config import Config
from rovgraph.model.state import DIMENSION, PLACE, PLACE_DIM, State
from rovgraph.problem.calibration_roles import CalibrationRoles
from rovgraph.problem.measurements import (
    KeyframeRows,
    Measurements,
    loss_and_weight,
    loss_threshold,
    sensor_table,
    whitening,
)
from rovgraph.problem.motion import scale_to_bias
from rovgraph.problem.problem import sd_of
from rovgraph.sensors.instruments import instruments

N, STEP = 4, 1e-6
SEGMENTS = np.arange(N) // 2
SIZES = DIMENSION | {PLACE: PLACE_DIM} | {name: variable.dim for name, variable in TABLE.items()}
LAG = at.KNOT_S * np.arange(-60, 61)  # of knots around a stamp that may be late [s]
WALKS = {name: 0.1 if name in {"hard_iron", "field_scale", "dvl_yaw"} else 0.0 for name in TABLE}


def block_of(sensor: str, moving: bool = True, loss: str = "none") -> tuple[Measurements, State]:
    """A block with motion to each measurement, and the state of its keyframes."""
    rng, instrument = np.random.default_rng(3), replace(SENSORS[sensor], loss=loss)
    state, dim = random_state(5, N), instrument.model.dim
    blank = problem_of(np.zeros(N), np.empty((0, motion_row.ROW)), np.empty((0, 15, 15)))
    rows, scales, windows = np.zeros((N, at.Z + 2 * max(dim, at.MOST))), np.empty((N, 6, 6)), []
    for k in range(N):
        bias = state.bias[k] + 0.05 * rng.standard_normal(6)
        turn = exp_rotation(0.2 * rng.standard_normal(3))
        motion = snapshot(0.1 + 0.05 * k, turn, 0.3 * rng.standard_normal(3), 0.1 * rng.standard_normal(3))
        motion = motion if moving else snapshot(0.0, np.eye(3), np.zeros(3), np.zeros(3))
        rate, z = rng.standard_normal(3), rng.standard_normal(dim)
        sd = instrument.sd * rng.uniform(0.5, 2.0, dim)
        if instrument.time_offset:
            windows.append(track_of(motion, rng))
        scales[k] = scale_to_bias(rng.standard_normal(6), exp_rotation(rng.standard_normal(3)))
        rows[k, at.TIME], rows[k, at.SNAPSHOT : at.ASSUMED], rows[k, at.ASSUMED : at.Z] = 0.2 * k, motion, bias
        rows[k, at.RATE : at.RATE_SD], rows[k, at.RATE_SD] = rate, 0.01
        rows[k, at.Z : at.Z + dim], rows[k, sd_of(dim) : sd_of(dim) + dim] = z, sd
    of = np.zeros((assembly.OF, N), np.int64)
    of[[assembly.KEYFRAME_OF, assembly.INTERVAL_OF]] = np.arange(N)
    of[assembly.WINDOW_OF] = np.arange(N) if instrument.time_offset else -1
    of[assembly.LINE_OF], of[assembly.NUMBER_OF] = 10 + np.arange(N), 7 if sensor == PLACE else -1
    problem = replace(blank, sensors=(sensor,), dims=(dim,), rows=rows, row_scales=scales, of=of, names=np.ones(N))
    if windows:
        problem = replace(problem, windows=np.array(windows), lags={sensor: LAG}, bias=state.bias.mean(axis=0))
    return Measurements(problem, np.arange(N), instrument, 9.81, CalibrationRoles(state.calibration, WALKS)), state


def snapshot(dt: float, dR: Array, dv: Array, dp: Array) -> Array:
    """As `rovgraph.kernels.preintegration` lays it out."""
    return np.concatenate([[dt], dR.ravel(), dv, dp])


def track_of(motion: Array, rng: np.random.Generator) -> Array:
    """A lively motion around a stamp, at knots."""
    turn, dv, dp, rate = (wave(LAG, rng) for _ in range(4))
    dR = motion[1:10].reshape(3, 3) @ exp_rotation(turn)
    return np.column_stack([motion[0] - LAG, dR.reshape(-1, 9), motion[10:13] + dv, motion[13:16] + dp, rate, LAG])


def wave(time: Array, rng: np.random.Generator) -> Array:
    return np.sin(2.0 * time[:, None] + rng.uniform(0, 6, 3)) * rng.standard_normal(3)


def factor_of(block: Measurements, k: int) -> gtsam.CustomFactor:
    return measurement_factor(block.at([k]), int(SEGMENTS[k]))


def values_of(state: State, unknowns: CalibrationRoles) -> gtsam.Values:
    values = gtsam.Values()
    for k in range(len(state)):
        insert_state(values, k, state.at([k]))
    for segment in range(len(state) // 2 + 1):
        insert_calibration(values, state.calibration, unknowns, segment)
    values.insert(key(PLACE, 7), state.calibration[PLACE])
    return values


@pytest.mark.parametrize("moving", [True, False], ids=["between keyframes", "at the keyframe"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_linearised_block_is_the_finite_difference_of_its_innovations(sensor, moving):
    block, state = block_of(sensor, moving)
    r, H = block.linearize(state)
    np.testing.assert_allclose(r, block.normalised(state), atol=1e-9)
    assert set(H) == set(block.variables)
    for variable, J in H.items():
        numeric = np.empty_like(J)
        for k in range(J.shape[2]):
            d = STEP * np.eye(J.shape[2])[k]
            ahead, behind = (block.normalised(state.retract(variable, s * d)) for s in (1, -1))
            numeric[..., k] = -(ahead - behind) / (2 * STEP)  # innovations fall where predictions rise
        scale = max(np.abs(J).max(), 1.0)
        np.testing.assert_allclose(J / scale, numeric / scale, atol=1e-6, err_msg=variable)


def test_a_heading_across_the_wrap_has_a_small_innovation():
    """Where headings wrap, as a filter's kernel linearises it: 179 degrees are measured as -179."""
    instrument, degree = instruments(Config())["ahrs"], np.deg2rad(1.0)
    x, row = np.zeros(21), np.zeros(at.ROW)
    x[:9] = matrix_from_rpy(np.array([0.0, 0.0, np.pi - degree])).ravel()
    row[at.DR : at.DV], row[at.Z], row[at.SD] = np.eye(3).ravel(), -np.pi + degree, 1.0
    column, table = np.full(15 + calibration_size(), -1), sensor_table({"ahrs": instrument}, [])
    which, window, exact = np.zeros(1, np.int64), np.full(1, -1), np.zeros((0, 6, 6))
    measured = at.MeasuredRows(row[None], which, exact, window, np.zeros((0, 0, at.KNOT)))
    rows = KeyframeRows(measured, table, column, 1, 9.81)
    r, _ = rows.linearize(x, np.zeros(calibration_size()))
    np.testing.assert_allclose(r, [2.0 * degree])


@pytest.mark.parametrize("sensor", SENSORS)
def test_custom_factor_is_linearised_by_gtsam_as_its_own_error_moves(sensor):
    block, state = block_of(sensor)
    values, k = values_of(state, block.unknowns), 2
    factor = factor_of(block, k)
    linear = factor.linearize(values)
    A, b = linear.jacobian()
    np.testing.assert_allclose(b, -factor.unwhitenedError(values), atol=1e-9)
    names = dict(zip(measurement_keys(block, SEGMENTS)[k], block.variables, strict=True))
    column = 0
    for j in list(linear.keys()):
        dim = SIZES[names[j]]
        for c in range(dim):
            moved = []
            for sign in (1, -1):
                delta = gtsam.VectorValues()
                delta.insert(j, sign * STEP * np.eye(dim)[c])
                moved.append(factor.unwhitenedError(values.retract(delta)))
            numeric = (moved[0] - moved[1]) / (2 * STEP)
            scale = max(np.abs(A).max(), 1.0)
            np.testing.assert_allclose(A[:, column] / scale, numeric / scale, atol=1e-6, err_msg=names[j])
            column += 1


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
@pytest.mark.parametrize("sensor", SENSORS)
def test_bulk_and_custom_factors_are_the_same_system(sensor, loss):
    block, state = block_of(sensor, loss=loss)
    values = values_of(state, block.unknowns)
    pushed, custom = (gtsam.GaussianFactorGraph() for _ in range(2))
    RowPlaces({sensor: block}, SEGMENTS).push(pushed, {sensor: block.weighted(state, np.ones(N, dtype=bool))})
    for k in range(N):
        custom.push_back(factor_of(block, k).linearize(values))
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(pushed)
    expected = custom.hessian(ordering)
    for mine, gtsams in zip(pushed.hessian(ordering), expected, strict=True):
        scale = np.abs(gtsams).max()
        np.testing.assert_allclose(mine / scale, gtsams / scale, atol=1e-9)


def test_all_sensors_of_a_keyframe_as_one_factor_are_the_same_system_without_what_is_gated():
    made = {sensor: block_of(sensor, loss="cauchy") for sensor in SENSORS if sensor != "place"}
    blocks, state = {sensor: block for sensor, (block, _) in made.items()}, made["dvl"][1]
    values = values_of(state, CalibrationRoles(state.calibration, WALKS))
    rng = np.random.default_rng(1)
    gates = {sensor: rng.random(N) < 0.7 for sensor in blocks}
    together, apart = (gtsam.GaussianFactorGraph() for _ in range(2))
    RowPlaces(blocks, SEGMENTS).push(
        together, {sensor: block.weighted(state, gates[sensor]) for sensor, block in blocks.items()}
    )
    for sensor, block in blocks.items():
        for k in np.flatnonzero(gates[sensor]):
            apart.push_back(factor_of(block, int(k)).linearize(values))
    assert together.size() == N
    ordering = gtsam.Ordering.ColamdGaussianFactorGraph(together)
    for mine, gtsams in zip(together.hessian(ordering), apart.hessian(ordering), strict=True):
        scale = np.abs(gtsams).max()
        np.testing.assert_allclose(mine / scale, gtsams / scale, atol=1e-9)


@pytest.mark.parametrize("loss", ["none", "huber", "cauchy"])
def test_losses_are_gtsams(loss):
    block, _ = block_of("dvl", loss=loss)
    noise = robust_noise(block.instrument)
    for length in (0.0, 0.5, 2.0, 2.7, 2.9, 10.0, 100.0):
        r = np.array([[0.6, 0.0, -0.8]]) * length
        rho, weight = loss_and_weight(r, loss)
        if loss == "none":
            np.testing.assert_allclose([rho[0], weight[0]], [0.5 * length**2, 1.0], atol=1e-12)
        else:
            np.testing.assert_allclose(weight[0], noise.robust().weight(length), atol=1e-12)
            np.testing.assert_allclose(rho[0], noise.robust().loss(length), atol=1e-9)


@pytest.mark.parametrize("dim", [1, 2, 3])
def test_losses_leave_nineteen_of_twenty_good_measurements_alone(dim):
    r = np.random.default_rng(0).standard_normal((40_000, dim))
    inside = np.linalg.norm(r, axis=1) <= loss_threshold("huber", dim)
    assert abs(inside.mean() - 0.95) < 0.005
    assert loss_threshold("huber", dim) == pytest.approx(np.sqrt(chi2.ppf(0.95, dim)))
    np.testing.assert_array_equal(loss_and_weight(r, "huber")[1][inside], 1.0)


def test_weight_is_the_slope_of_the_loss_over_the_length():
    for loss in ("huber", "cauchy"):
        for length in (0.5, 2.0, 4.0, 20.0):
            rho = [loss_and_weight(np.array([[d, 0.0, 0.0]]), loss)[0][0] for d in (length - 1e-5, length + 1e-5)]
            weight = loss_and_weight(np.array([[length, 0.0, 0.0]]), loss)[1][0]
            assert weight * length == pytest.approx((rho[1] - rho[0]) / 2e-5, rel=1e-6)


def test_whitening_takes_in_the_noise_of_the_rate_at_the_lever_arm():
    instrument = SENSORS["dvl"]
    sd, rate_sd = np.array([[0.004, 0.005, 0.002]]), np.array([0.02])
    W = whitening(instrument, sd, rate_sd)[0]
    expected = np.diag(sd[0] ** 2) + instrument.rate_gain @ instrument.rate_gain.T * rate_sd[0] ** 2
    np.testing.assert_allclose(np.linalg.inv(W.T @ W), expected, rtol=1e-9)
    rng = np.random.default_rng(1)
    noise = rng.standard_normal((50_000, 3)) * sd + rng.standard_normal((50_000, 3)) * rate_sd @ instrument.rate_gain.T
    np.testing.assert_allclose(np.cov((noise @ W.T).T), np.eye(3), atol=0.03)


def test_two_components_are_weighed_by_their_covariance_too():
    block, state = block_of("fix")
    sd, covariance = block.problem.sd(block.index, 2), np.array([0.9, -0.5, 0.0, 0.3])
    covariance *= sd.prod(axis=1)
    block.problem.rows[:, at.SD + 2] = covariance
    e = block.innovations(state)
    for k in range(N):
        S = np.diag(sd[k] ** 2) + covariance[k] * np.fliplr(np.eye(2))
        assert np.sum(block.normalised(state)[k] ** 2) == pytest.approx(e[k] @ np.linalg.solve(S, e[k]))
        np.testing.assert_allclose(np.linalg.inv(block.W[k].T @ block.W[k]), S, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("sensor", SENSORS)
def test_block_predicts_at_the_measurements_own_time(sensor):
    block, state = block_of(sensor)
    of = block.problem.of.copy()
    of[assembly.WINDOW_OF] = -1
    block = replace(block, problem=replace(block.problem, row_scales=np.zeros((0, 6, 6)), of=of, lags={}))
    rows = block.problem.rows[block.index]
    dR, dv, dp = rows[:, at.DR : at.DV].reshape(-1, 3, 3), rows[:, at.DV : at.DP], rows[:, at.DP : at.ASSUMED]
    there, _ = propagate(state, Delta(rows[:, at.DT], dR, dv, dp, rows[:, at.ASSUMED : at.Z]), block.gravity)
    expected = block.instrument.model.predict(there, block.rate_b)[0]
    np.testing.assert_allclose(block.predicted(state), expected, atol=1e-12)
    np.testing.assert_allclose(block.predict(state)[0], expected, atol=1e-12)


def test_some_of_a_block_are_its_own_measurements():
    block, state = block_of("dvl")
    some = block.at(np.array([2, 0]))
    np.testing.assert_allclose(some.normalised(state.at([2, 0])), block.normalised(state)[[2, 0]])
    assert [row[0] for row in measurement_keys(some, SEGMENTS[[2, 0]])] == [key("pose", 2), key("pose", 0)]


def problem_zeros() -> dict[str, np.ndarray]:
    """All calibration, which kernels take whole."""
    return {name: np.zeros(variable.dim) for name, variable in TABLE.items()}


def test_measurements_of_a_true_dive_have_unit_innovations_at_the_truth():
    """The simulator and the blocks agree about time, motion, lever arms and noise."""
    case = simulated(CONFIG, 40.0, seed=4, ahrs_rate=5.0, fix_interval=1.0, bias=np.zeros(6))
    config = case.config.model_copy(
        update={"heading": case.config.heading.model_copy(update={"sources": ("mag", "dvl", "ahrs")})}
    )
    smoother = batch(case.log, config)
    problem = smoother.problem
    motion = case.dive.path.motion(np.minimum(problem.time, case.dive.path.duration))
    arm = np.array(config.imu.lever_arm_m)
    swing = np.einsum("nij,nj->ni", motion.R_nb, np.cross(motion.w_b, arm))
    p_n, zero = motion.p_n + motion.R_nb @ arm, np.zeros((len(motion), 6))
    truth = State(motion.R_nb, p_n, motion.v_n + swing, zero, {**problem_zeros(), **case.dive.hidden["calibration"]})
    assert set(problem.used) == {"dvl", "dvl_heading", "ahrs", "mag", "depth", "fix"}
    for sensor in problem.used:
        instrument = smoother.initial.instruments[sensor]
        gravity, unknowns = config.environment.gravity, CalibrationRoles(truth.calibration, {})
        block = Measurements(problem, problem.of_sensor(sensor), instrument, gravity, unknowns)
        r = block.normalised(truth.at(block.keyframe))
        # motion from the keyframe is integrated from noisy samples, which adds little
        low, high = chi2.ppf([0.0005, 0.9995], r.size) / r.size
        assert low < np.mean(r**2) < 1.1 * high, sensor
