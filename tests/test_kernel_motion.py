"""The kernels of the IMU's motion say what GTSAM's factor says, and their derivatives are those of their values."""

import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import gtsam
import numpy as np
import pytest

from rovgraph.geometry import Array, exp_rotation, log_rotation, matrix_from_rpy, rpy_from_matrix, wrap_angle
from rovgraph.kernels.earth import radii
from rovgraph.kernels.motion import BRIDGE_ACC, BRIDGE_GYR, RIGHTING_S, TILT_SD, transitions
from rovgraph.kernels.motion_residual import (
    motion_covariance,
    motion_errors,
    motion_residuals,
    motion_weights,
    whiten_motion,
)
from rovgraph.kernels.motion_row import (
    BIAS,
    BY_BIAS,
    DURATION,
    EARTH_RATE,
    GAP,
    GRAVITY,
    LATITUDE,
    NO_IMU,
    NOISE,
    ROW,
    TANGENT,
)
from rovgraph.kernels.preintegration import SNAPSHOT, integrated_steps, preintegrate
from rovgraph.kernels.states import States

DENSITIES = np.array([8e-4, 7e-4, 1.6e-3, 8.7e-5, 1e-3])
STILL, EARTH, SPUN = np.zeros(3), np.array([3.8e-5, 0.0, -6.2e-5]), np.array([0.3, -0.2, 0.4])


class Motion(NamedTuple):
    """A row and its covariance."""

    row: Array
    covariance: Array


@dataclass
class Case:
    """An interval of samples and what is assumed of them."""

    imu: Array
    start: float
    stops: Array
    end: float
    bias: Array
    densities: Array
    earth_rate: Array

    def integrated(self, gap: float = 0.0) -> tuple["Motion", Array]:
        """The motion, and snapshots of it."""
        row, snapshots = np.full(ROW, np.nan), np.full((len(self.stops), SNAPSHOT), np.nan)
        covariance = np.full((15, 15), np.nan)
        row[GAP], row[GRAVITY] = gap, 9.81
        row[BIAS : BIAS + 6], row[NOISE : NOISE + 5] = self.bias, self.densities
        row[EARTH_RATE : EARTH_RATE + 3] = self.earth_rate
        preintegrate(self.imu, self.start, self.end, self.stops, row, covariance, snapshots)
        return Motion(row, covariance), snapshots

    def pim(self, end: float = np.inf) -> gtsam.PreintegratedCombinedMeasurements:
        """GTSAM's, of the same steps up to a time."""
        params = gtsam.PreintegrationCombinedParams.MakeSharedD(9.81)
        names = ("Accelerometer", "Gyroscope", "BiasAcc", "BiasOmega", "Integration")
        for name, density in zip(names, self.densities, strict=True):
            getattr(params, f"set{name}Covariance")(np.eye(3) * density**2)
        if self.earth_rate.any():
            params.setOmegaCoriolis(self.earth_rate)
        pim = gtsam.PreintegratedCombinedMeasurements(params, constant_bias(self.bias))
        for step in integrated_steps(self.imu, self.start, self.stops, self.end, self.bias):
            if step[0] <= end:
                pim.integrateMeasurement(step[2:5], step[5:8], step[1])
        return pim


def constant_bias(bias: Array) -> gtsam.imuBias.ConstantBias:
    return gtsam.imuBias.ConstantBias(bias[:3], bias[3:])


def lively(seed: int, earth_rate: Array = STILL, length: float = 0.3) -> Case:
    """A vehicle far livelier than any."""
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.005, 0.015, 120)) - 0.2
    imu = np.column_stack([time, rng.normal(size=(120, 3)) * 4.0, rng.normal(size=(120, 3)) * 1.5])
    stops = np.sort(rng.uniform(0.0, length, 4))
    return Case(imu, 0.0, stops, length, 0.1 * rng.normal(size=6), DENSITIES * rng.uniform(0.3, 3.0, 5), earth_rate)


def calm(seed: int, earth_rate: Array = STILL) -> Case:
    """As ROVs move, at 100 Hz, samples and keyframes at round times."""
    rng = np.random.default_rng(seed)
    time = np.arange(40) * 0.01
    force = np.array([0.2, -0.1, -9.8]) + 0.05 * rng.normal(size=(40, 3))
    imu = np.column_stack([time, force, 0.1 * rng.normal(size=3) + 0.01 * rng.normal(size=(40, 3))])
    bias = rng.normal(size=6) * [0.02, 0.02, 0.02, 1e-3, 1e-3, 1e-3]
    return Case(imu, 0.1, np.array([0.1, 0.153, 0.16, 0.279]), 0.279, bias, DENSITIES, earth_rate)


CASES = [
    *(lively(seed, rate) for seed in range(4) for rate in (STILL, SPUN)),
    *(calm(seed, rate) for seed in range(4) for rate in (STILL, EARTH)),
]
NAMES = [f"{kind}-{seed}-{rate}" for kind in ("lively", "calm") for seed in range(4) for rate in ("still", "turning")]
cases = pytest.mark.parametrize("case", CASES, ids=NAMES)


@dataclass(frozen=True)
class Ends:
    """States of n epochs."""

    R: Array
    p: Array
    v: Array
    bias: Array

    def moved(self, delta: Array) -> "Ends":
        """Perturbed in the package's tangent space."""
        return Ends(
            self.R @ exp_rotation(delta[:, :3]),
            self.p + np.einsum("nij,nj->ni", self.R, delta[:, 3:6]),
            self.v + delta[:, 6:9],
            self.bias + delta[:, 9:],
        )

    @property
    def all(self) -> States:
        return States(self.R, self.p, self.v, self.bias)


def ends(seed: int, bias: Array, n: int = 1) -> Ends:
    rng = np.random.default_rng(seed)
    R = matrix_from_rpy(rng.normal(size=(n, 3)) * [0.3, 0.3, 2.0])
    return Ends(R, 20 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), bias + 0.03 * rng.normal(size=(n, 6)))


def predict(motion: Motion, state: Ends) -> Ends:
    return transition(motion, state)[0]


def error(motion: Motion, before: Ends, after: Ends) -> tuple[Array, Array, Array]:
    r, A_i, A_j = np.empty((1, 15)), np.empty((1, 15, 15)), np.empty((1, 15, 15))
    motion_errors(motion.row[None], before.all, after.all, r, A_i, A_j)
    return r[0], A_i[0], A_j[0]


def transition(motion: Motion, before: Ends) -> tuple[Ends, Array, Array]:
    R, p, v = np.empty((1, 3, 3)), np.empty((1, 3)), np.empty((1, 3))
    F, Q = np.empty((1, 15, 15)), np.empty((1, 15, 15))
    transitions(motion.row[None], motion.covariance[None], before.all, States(R, p, v, before.bias), F, Q)
    return Ends(R, p, v, before.bias), F[0], Q[0]


def gtsam_error(case: Case, before: Ends, after: Ends) -> tuple[Array, Array, Array]:
    factor = gtsam.CombinedImuFactor(0, 1, 2, 3, 4, 5, case.pim())
    A = np.zeros((2, 15, 15)).swapaxes(1, 2)
    of_i, of_j = ([own[:, columns] for columns in (slice(0, 6), slice(6, 9), slice(9, 15))] for own in A)

    def apart(s: Ends) -> tuple[gtsam.Pose3, Array, gtsam.imuBias.ConstantBias]:
        return gtsam.Pose3(gtsam.Rot3(s.R[0]), s.p[0]), s.v[0], constant_bias(s.bias[0])

    (pose_i, v_i, bias_i), (pose_j, v_j, bias_j) = apart(before), apart(after)
    r = factor.evaluateError(pose_i, v_i, pose_j, v_j, bias_i, bias_j, *of_i[:2], *of_j[:2], of_i[2], of_j[2])
    return r, A[0], A[1]


def derivative(value: Callable[[Array], Array], h: float = 1e-5) -> Array:
    """Of a vector by a perturbation of 15 components, central and of fourth order."""
    columns = []
    for step in h * np.eye(15)[:, None]:
        near, far = value(step) - value(-step), value(2 * step) - value(-2 * step)
        columns.append((8.0 * near - far) / (12.0 * h))
    return np.column_stack(columns)


def close(got: Array, expected: Array, relative: float = 1e-9) -> None:
    np.testing.assert_allclose(got, expected, rtol=0.0, atol=relative * max(float(np.abs(expected).max()), 1e-3))


@cases
def test_motion_is_that_of_gtsam(case):
    (row, _), _ = case.integrated()
    pim = case.pim()
    assert row[DURATION] == pytest.approx(pim.deltaTij(), rel=1e-15)
    assert row[DURATION] == pytest.approx(case.end - case.start, rel=1e-12)
    close(exp_rotation(row[TANGENT : TANGENT + 3]), pim.deltaRij().matrix())
    close(row[TANGENT + 3 : TANGENT + 6], pim.deltaPij())
    close(row[TANGENT + 6 : TANGENT + 9], pim.deltaVij())


@cases
def test_covariance_is_that_of_gtsams_residual(case):
    (_, got), _ = case.integrated()
    expected = case.pim().residualCovariance()
    sd = np.sqrt(np.diag(expected))
    close(got / np.outer(sd, sd), expected / np.outer(sd, sd))
    np.testing.assert_array_equal(got, got.T)


@cases
def test_a_turning_earth_is_that_of_the_factors_noise(case):
    """What the factor itself whitens with."""
    (_, covariance), _ = case.integrated()
    noise = gtsam.CombinedImuFactor(0, 1, 2, 3, 4, 5, case.pim()).noiseModel().covariance()
    sd = np.sqrt(np.diag(noise))
    close(covariance / np.outer(sd, sd), noise / np.outer(sd, sd), 1e-7)


@cases
def test_derivative_by_the_bias_is_that_of_gtsams_prediction(case):
    """From rest at the origin, where prediction is the motion alone but for gravity."""
    (row, _), _ = case.integrated()
    H = row[BY_BIAS:].reshape(9, 6)
    still = replace(case, earth_rate=STILL).pim()
    by_bias = np.zeros((9, 6), order="F")
    there = still.predict(gtsam.NavState(), constant_bias(case.bias), np.zeros((9, 9), order="F"), by_bias)
    R = there.attitude().matrix()
    step = 1e-6 * np.eye(6)
    turned = np.array(
        [
            log_rotation(R.T @ exp_rotation(row[TANGENT : TANGENT + 3] + H[:3] @ d)) / 1e-6
            - log_rotation(R.T @ exp_rotation(row[TANGENT : TANGENT + 3] - H[:3] @ d)) / 1e-6
            for d in step
        ]
    ).T
    close(turned / 2.0, by_bias[:3], 1e-7)
    close(R.T @ H[3:6], by_bias[3:6])
    close(R.T @ H[6:9], by_bias[6:9])


@cases
def test_snapshots_are_motions_up_to_their_times(case):
    _, snapshots = case.integrated()
    for stop, snapshot in zip(case.stops, snapshots, strict=True):
        pim = case.pim(stop)
        assert snapshot[0] == pytest.approx(stop - case.start, abs=1e-15)
        close(snapshot[1:10].reshape(3, 3), pim.deltaRij().matrix())
        np.testing.assert_allclose(snapshot[10:13], pim.deltaVij(), atol=1e-12)
        np.testing.assert_allclose(snapshot[13:16], pim.deltaPij(), atol=1e-12)


def test_steps_reach_from_sample_to_sample_and_stop():
    case = calm(0)
    steps = integrated_steps(case.imu, case.start, case.stops, case.end, case.bias)
    inside = case.imu[(case.imu[:, 0] > case.start) & (case.imu[:, 0] < case.end), 0]
    np.testing.assert_array_equal(steps[:, 0], np.unique([*inside, *case.stops[1:], case.end]))
    np.testing.assert_array_equal(np.diff(steps[:, 0], prepend=case.start), steps[:, 1])


def test_signals_are_linear_between_samples_and_held_beyond_them():
    time = np.array([0.0, 0.1, 0.2])
    imu = np.column_stack([time, np.zeros((3, 3)), [[1.0, 0, 0], [3.0, 0, 0], [2.0, 0, 0]]])
    steps = integrated_steps(imu, -0.2, np.array([0.05]), 0.4, np.zeros(6))
    np.testing.assert_allclose(steps[:, 5], [1.0, 1.5, 2.5, 2.5, 2.0])


def test_an_interval_without_time_has_no_motion():
    (row, covariance), _ = replace(calm(0), end=0.1, stops=np.empty(0)).integrated()
    assert row[DURATION] == 0.0
    assert not row[TANGENT : TANGENT + 9].any() and not covariance.any()


@cases
def test_prediction_is_that_of_gtsam(case):
    motion, _ = case.integrated()
    before = ends(1, case.bias)
    got = predict(motion, before)
    state = gtsam.NavState(gtsam.Rot3(before.R[0]), before.p[0], before.v[0])
    there = case.pim().predict(state, constant_bias(before.bias[0]))
    close(got.R[0], there.attitude().matrix())
    close(got.p[0], there.position())
    close(got.v[0], there.velocity())


@cases
@pytest.mark.parametrize("apart", [0.0, 1e-3, 0.7], ids=["on", "near", "far"])
def test_residual_and_its_derivatives_are_those_of_gtsam(case, apart):
    motion, _ = case.integrated()
    before = ends(2, case.bias)
    delta = apart * np.random.default_rng(3).normal(size=(1, 15))
    after = predict(motion, before).moved(delta)
    for got, expected in zip(error(motion, before, after), gtsam_error(case, before, after), strict=True):
        close(got, expected)


@pytest.mark.parametrize("gap", [0.0, 2.0, NO_IMU], ids=["whole", "coasted", "cruised"])
@cases
def test_derivatives_of_the_residual_are_those_of_its_values(case, gap):
    motion, _ = case.integrated(gap)
    before = ends(4, case.bias)
    after = predict(motion, before).moved(0.2 * np.random.default_rng(5).normal(size=(1, 15)))
    _, A_i, A_j = error(motion, before, after)
    close(A_i, derivative(lambda d: error(motion, before.moved(d), after)[0]), 1e-8)
    close(A_j, derivative(lambda d: error(motion, before, after.moved(d))[0]), 1e-8)


@pytest.mark.parametrize("gap", [0.0, 2.0, NO_IMU], ids=["whole", "coasted", "cruised"])
@cases
def test_transition_solves_the_linear_residual_at_the_prediction(case, gap):
    motion, _ = case.integrated(gap)
    before = ends(6, case.bias)
    after, F, Q = transition(motion, before)
    r, A_i, A_j = error(motion, before, after)
    np.testing.assert_allclose(r, 0.0, atol=1e-12)
    S = np.linalg.inv(weight(motion).T @ weight(motion))
    inverse = np.linalg.inv(A_j)
    close(F, -inverse @ A_i)
    close(Q, inverse @ S @ inverse.T, 1e-7)


def weight(motion: Motion) -> Array:
    W = np.empty((1, 15, 15))
    motion_weights(motion.row[None], motion.covariance[None], W)
    return W[0]


@pytest.mark.parametrize("gap", [0.0, 2.0, NO_IMU], ids=["whole", "coasted", "cruised"])
@cases
def test_transition_carries_small_errors(case, gap):
    motion, _ = case.integrated(gap)
    before = ends(7, case.bias)
    after, F, _ = transition(motion, before)

    def moved(delta: Array) -> Array:
        there = predict(motion, before.moved(delta))
        turn = log_rotation(after.R[0].T @ there.R[0])
        shift = after.R[0].T @ (there.p[0] - after.p[0])
        return np.concatenate([turn, shift, there.v[0] - after.v[0], there.bias[0] - after.bias[0]])

    close(F, derivative(moved), 1e-8)


@pytest.mark.parametrize("gap", [0.0, 2.0, NO_IMU], ids=["whole", "coasted", "cruised"])
@cases
def test_weights_whiten_biases_first(case, gap):
    """So that the rows of biases are those of their walks, exactly."""
    motion, _ = case.integrated(gap)
    W, S = weight(motion), np.empty((15, 15))
    motion_covariance(*motion, S)
    biases_first = np.roll(np.arange(15), 6)
    ordered = W[np.ix_(biases_first, biases_first)]
    np.testing.assert_array_equal(ordered, np.tril(ordered))
    np.testing.assert_allclose(W @ S @ W.T, np.eye(15), atol=1e-6)
    before = ends(8, case.bias)
    after = predict(motion, before).moved(0.01 * np.random.default_rng(5).normal(size=(1, 15)))
    r, A_i, A_j = error(motion, before, after)
    rows = np.column_stack([A_i, r, A_j, np.zeros(15)])
    whitened = np.empty_like(rows)
    whiten_motion(W, rows, whitened)
    close(whitened, W @ rows)
    for of_keyframe in (whitened[9:, :15], whitened[9:, 16:31]):
        np.testing.assert_array_equal(np.delete(of_keyframe, np.s_[9:15], axis=1), 0.0)
        np.testing.assert_array_equal(of_keyframe[:, 9:], np.diag(np.diagonal(of_keyframe[:, 9:])))
    alone = np.empty((1, 15))
    two = States(*(np.concatenate(both) for both in zip(before.all[:4], after.all[:4], strict=True)))
    motion_residuals(motion.row[None], W[None], two, np.empty((0, 6)), alone)
    close(alone[0], W @ r)


def test_many_intervals_are_each_alone():
    motions = [case.integrated(gap)[0] for case in CASES for gap in (0.0, 2.0, NO_IMU)]
    rows, covariances, n = *map(np.array, zip(*motions, strict=True)), len(motions)
    before = ends(9, np.zeros(6), n)
    R, p, v, F, Q = (np.empty((n, *shape)) for shape in ((3, 3), (3,), (3,), (15, 15), (15, 15)))
    transitions(rows, covariances, before.all, States(R, p, v, before.bias), F, Q)
    after = Ends(R, p, v, before.bias).moved(0.1 * np.random.default_rng(1).normal(size=(n, 15)))
    r, A_i, A_j = np.empty((n, 15)), np.empty((n, 15, 15)), np.empty((n, 15, 15))
    motion_errors(rows, before.all, after.all, r, A_i, A_j)
    for k in range(n):
        one = Ends(*(a[k : k + 1] for a in before.all[:4]))
        there, F_k, Q_k = transition(motions[k], one)
        np.testing.assert_array_equal(there.R[0], R[k])
        np.testing.assert_array_equal(F_k, F[k])
        np.testing.assert_array_equal(Q_k, Q[k])
        alone = error(motions[k], one, Ends(*(a[k : k + 1] for a in after.all[:4])))
        for got, expected in zip(alone, (r[k], A_i[k], A_j[k]), strict=True):
            np.testing.assert_array_equal(got, expected)


def test_a_coasting_vehicle_goes_on_and_rights_itself():
    case = replace(calm(0), densities=np.array([0.3, 0.3, 1.6e-3, 8.7e-5, 1e-3]))
    motion, _ = case.integrated(2.0)
    row, before = motion.row, ends(10, case.bias)
    after, t = predict(motion, before), row[DURATION]
    kept = np.exp(-t / RIGHTING_S)
    rpy = rpy_from_matrix(before.R[0]) * [kept, kept, 1.0]
    rpy[2] += rpy_from_matrix(exp_rotation(row[TANGENT : TANGENT + 3]))[2]
    np.testing.assert_allclose(wrap_angle(rpy_from_matrix(after.R[0]) - rpy), 0.0, atol=1e-12)
    np.testing.assert_allclose(after.p, before.p + t * before.v)
    np.testing.assert_array_equal(after.v, before.v)
    S = np.linalg.inv(weight(motion).T @ weight(motion))
    assert S[0, 0] == pytest.approx((1.0 - kept**2) * TILT_SD**2)
    assert S[2, 2] == pytest.approx(BRIDGE_GYR**2 * t)
    assert S[6, 6] == pytest.approx(BRIDGE_ACC**2 * t)
    assert S[3, 6] == pytest.approx(BRIDGE_ACC**2 * t**2 / 2.0)
    np.testing.assert_allclose(np.diag(S)[9:], np.repeat(case.densities[2:4] ** 2 * t, 3))


@pytest.mark.slow
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="this is that run")
def test_kernels_are_plain_python_without_the_compiler():
    environment = {**os.environ, "NUMBA_DISABLE_JIT": "1"}
    some = "that_of_gtsam or those_of_gtsam or many_intervals or weights_whiten or coasting"
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-k", some, str(Path(__file__))]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-2000:]


@pytest.mark.parametrize("gap", [0.0, 2.0, NO_IMU], ids=["whole", "coasted", "cruised"])
@pytest.mark.parametrize("latitude", [0.0, 45.0, 70.0, -60.0, 84.0])
@pytest.mark.parametrize("seed", range(2))
def test_on_earth_derivatives_are_those_of_the_values(seed, latitude, gap):
    """100 km from the origin; what latitude changes of rates and radii in one interval is left out."""
    case = calm(seed, EARTH)
    motion, _ = case.integrated(gap)
    motion.row[LATITUDE] = np.deg2rad(latitude)
    before = ends(4, case.bias)
    before = replace(before, p=before.p + np.array([1e5, -2e4, 30.0]), v=before.v + np.array([2.0, 1.0, 0.0]))
    there, F, _ = transition(motion, before)
    after = there.moved(0.2 * np.random.default_rng(5).normal(size=(1, 15)))
    _, A_i, A_j = error(motion, before, after)
    close(A_i, derivative(lambda d: error(motion, before.moved(d), after)[0], 1e-3), 1e-7)
    close(A_j, derivative(lambda d: error(motion, before, after.moved(d))[0], 1e-3), 1e-7)
    r, A_i, A_j = error(motion, before, there)
    np.testing.assert_allclose(r, 0.0, atol=1e-9)
    close(F, -np.linalg.inv(A_j) @ A_i, 1e-8)


@pytest.mark.parametrize("gap", [0.0, 2.0, NO_IMU], ids=["whole", "coasted", "cruised"])
def test_on_earth_a_degree_is_a_degree(gap):
    """The way over ground, against radii of curvature where the vehicle is; the axes follow the meridian."""
    case = replace(calm(0, EARTH), bias=np.zeros(6))
    motion, _ = case.integrated(gap)
    motion.row[LATITUDE] = np.deg2rad(60.0)
    before = ends(4, case.bias)
    before = replace(before, p=np.array([[1e5, 5e4, 0.0]]), v=np.array([[2.0, 3.0, 0.0]]), bias=np.zeros((1, 6)))
    there = predict(motion, before)
    M_0, N_0 = radii(np.deg2rad(60.0))
    latitude = np.deg2rad(60.0) + 1e5 / M_0
    M, N = radii(latitude)
    way = 0.5 * motion.row[DURATION] * (before.v + there.v)[0]
    scale = np.array([M_0 / M, N_0 * 0.5 / (N * np.cos(latitude)), 1.0])
    np.testing.assert_allclose((there.p - before.p)[0, :2], (scale * way)[:2], rtol=2e-3 if gap == 0.0 else 1e-6)
    assert scale[1] > 1.02
