"""Compiled measurement equations, propagation and weights: derivatives, and one epoch as many."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from motions import Delta
from motions import propagate as propagate_all

from rovgraph.geometry import exp_rotation, matrix_from_rpy, wrap_angle
from rovgraph.kernels import layout
from rovgraph.kernels import measurements as kernels
from rovgraph.kernels.linearization import WORK, Snapshot, chain, propagate, propagation_jacobian
from rovgraph.kernels.states import Epoch, States
from rovgraph.kernels.weighting import LOSSES, loss_weight, robust_cost, weight_many, whiten_many
from rovgraph.model.calibration import LAYOUT, SIZE, TABLE, Variable, calibration_size, register
from rovgraph.model.state import PLACE_DIM, State
from rovgraph.sensors import CompassHeading, Position

N, STEP = 5, 1e-6
RNG = np.random.default_rng(0)
TURN = matrix_from_rpy([3.0, 0.2, -0.7])
ARM = [0.3, -0.2, 0.5]
AHRS = [layout.AHRS_OFFSET, layout.AHRS_DEVIATION]
DVL_COMPASS = [layout.DVL_COMPASS_OFFSET, layout.DVL_COMPASS_DEVIATION]

BEAM = np.array([-0.6, 0.0, 0.8])  # and how it goes with its angle

# name -> equation, number of components, the model's own numbers
CASES = {
    "dvl": (kernels.DVL, 3, ARM),
    "dvl_water": (kernels.DVL_WATER, 3, ARM),
    "dvl_compass": (kernels.DVL_COMPASS, 1, [0.1, *DVL_COMPASS, layout.DVL_COMPASS_ERROR, *[0.0] * 5]),
    "compass": (kernels.COMPASS, 1, [0.1, *AHRS, layout.AHRS_ERROR, *TURN[:, 0], 0.0, 0.0]),
    "magnetometer": (kernels.MAGNETOMETER, 3, [0.1, 1.2, 0.5, *TURN.ravel(), 0.0, 0.0]),
    "depth": (kernels.POSITION, 1, [*ARM, layout.DEPTH_OFFSET, layout.DEPTH_SCALE, layout.DEPTH_ERROR, np.nan, 2]),
    "fix": (kernels.POSITION, 2, [*ARM, -1, -1, layout.FIX_ERROR, np.nan, 0, 1]),
    "place": (kernels.PLACE_OFFSET, 2, [*ARM, np.nan]),
    "water_velocity": (kernels.WATER_VELOCITY, 2, []),
    "tilt": (kernels.TILT, 2, []),
    "dvl_beam": (kernels.DVL_BEAM, 1, [*ARM, *BEAM, -0.8, 0.0, -0.6, 1.7, layout.DVL_BEAM_2_ANGLE]),
}


def epochs(name: str, n: int = N, seed: int = 0) -> list[np.ndarray]:
    """R, p, v, b, c, rate of any states, every variable well away from zero."""
    rng = np.random.default_rng(seed)
    rpy = np.column_stack([rng.uniform(-0.9, 0.9, n), rng.uniform(-0.9, 0.9, n), rng.uniform(-np.pi, np.pi, n)])
    c = 0.3 * rng.standard_normal((n, SIZE + (PLACE_DIM if name == "place" else 0)))
    c[:, layout.DVL_ROLL] += np.pi
    R, draws = matrix_from_rpy(rpy), [rng.standard_normal((n, dim)) for dim in (3, 3, 6)]
    return [R, *draws, c, rng.standard_normal((n, 3))]


def predict(name: str, given: list[np.ndarray], columns=None) -> tuple[np.ndarray, np.ndarray]:
    """Predictions, and some columns of the Jacobians or all of them."""
    (kind, dim, params), n = CASES[name], len(given[1])
    columns = np.arange(layout.MOTION + given[4].shape[1]) if columns is None else np.array(columns)
    z, H = np.full((n, dim), np.nan), np.full((n, dim, len(columns)), np.nan)
    kernels.predict_many(kind, States(*given[:5]), given[5], np.array([params], float), columns, z, H)
    return z, H


def moved(given: list[np.ndarray], component: int, step: float) -> list[np.ndarray]:
    """States perturbed by one component of their error."""
    R, p, v, b, c, rate = given
    d = np.zeros(layout.MOTION + c.shape[1])
    d[component] = step
    return [R @ exp_rotation(d[:3]), p + R @ d[3:6], v + d[6:9], b + d[9:15], c + d[15:], rate]


@pytest.mark.parametrize("name", CASES)
def test_derivative_by_every_component_is_the_finite_difference(name):
    given = epochs(name)
    z, H = predict(name, given)
    assert np.isfinite(z).all()
    for k in range(H.shape[2]):
        change = predict(name, moved(given, k, STEP))[0] - predict(name, moved(given, k, -STEP))[0]
        if kernels.is_angular(CASES[name][0]):
            change = wrap_angle(change)
        np.testing.assert_allclose(H[..., k], change / (2 * STEP), atol=3e-9, err_msg=f"component {k}")


@pytest.mark.parametrize("name", CASES)
def test_one_epoch_is_predicted_as_many(name):
    kind, dim, params = CASES[name]
    given = epochs(name)
    z, H = predict(name, given)
    work = np.empty((kernels.WORK, 3, 3))
    for k in range(N):
        one_z, one_H = np.empty(dim), np.zeros(H.shape[1:])
        *state, rate = (values[k] for values in given)
        kernels.predict(kind, Epoch(*state), rate, np.array(params, float), one_z, one_H, work)
        np.testing.assert_allclose(one_z, z[k], rtol=0, atol=1e-15)
        np.testing.assert_allclose(one_H, H[k], rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", CASES)
def test_a_buffer_of_jacobians_that_was_used_before_serves_again(name):
    (kind, dim, params), given = CASES[name], epochs(name)
    H = predict(name, given)[1]
    z, buffer, work = np.empty(dim), np.zeros(H.shape[1:]), np.empty((kernels.WORK, 3, 3))
    for k in range(N):
        *state, rate = (values[k] for values in given)
        kernels.predict(kind, Epoch(*state), rate, np.array(params, float), z, buffer, work)
        np.testing.assert_allclose(buffer, H[k], rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", CASES)
def test_some_columns_are_those_of_the_whole_jacobian(name):
    given, some = epochs(name), [20, 0, 7, 14]
    np.testing.assert_array_equal(predict(name, given, some)[1], predict(name, given)[1][..., some])


@pytest.mark.parametrize("name", CASES)
def test_one_row_stands_for_all_epochs(name):
    given = epochs(name)
    whole = [np.repeat(values[:1], N, axis=0) for values in given]
    z, H = predict(name, whole)
    for shared in (0, 2, 3, 4, 5):  # the positions tell how many epochs there are
        again_z, again_H = predict(name, [v[:1] if k == shared else v for k, v in enumerate(whole)])
        np.testing.assert_array_equal(again_z, z)
        np.testing.assert_array_equal(again_H, H)


def test_states_that_a_model_is_given_may_be_strided_and_read_only():
    R, p, v, b, _, rate = epochs("depth")
    model, known = Position("depth", np.array(ARM), (2,), "depth_offset"), {"depth_offset": np.full((N, 1), 0.3)}
    backwards = [values[::-1].copy()[::-1] for values in (R, p, v, b, rate)]
    backwards[0] = np.broadcast_to(R[0], (N, 3, 3))
    for values in backwards:
        values.flags.writeable = False
    z, H = model.predict(State(*backwards[:4], known), backwards[4])
    expected, J = model.predict(State(np.repeat(R[:1], N, axis=0), p, v, b, known), rate)
    np.testing.assert_array_equal(z, expected)
    for name in J:
        np.testing.assert_array_equal(H[name], J[name])


def test_kernels_have_the_layout_of_the_table():
    names = {name: value for name, value in vars(layout).items() if name.lower() in TABLE}
    assert names == {name.upper(): LAYOUT[name].start for name in TABLE}
    assert layout.SIZE == SIZE == calibration_size()
    ends = np.cumsum([variable.dim for variable in TABLE.values()])
    assert [own.stop for own in LAYOUT.values()] == ends.tolist()


@pytest.fixture
def registered():
    """Calibration of two sensors that the package does not know."""
    about = ("a deviation", "turning")
    variables = (
        Variable("buoy_offset", "P", ("",), "m", 0.1, ("buoy",), *about),
        Variable("buoy_deviation", "Q", ("_sin", "_cos"), "rad", 0.1, ("buoy",), *about),
    )
    for variable in variables:
        register(variable)
    yield
    for variable in variables:
        del TABLE[variable.name], LAYOUT[variable.name]


def test_registered_variables_follow_the_built_in_ones(registered):
    assert LAYOUT["buoy_offset"] == slice(SIZE, SIZE + 1) and LAYOUT["buoy_deviation"] == slice(SIZE + 1, SIZE + 3)
    assert calibration_size() == SIZE + 3
    assert SIZE == layout.SIZE
    for name, letter in (("buoy_offset", "C"), ("other", "P"), ("other", "z")):
        with pytest.raises(ValueError, match=name):
            register(Variable(name, letter, ("",), "m", 0.1, ("buoy",), "", ""))
    assert calibration_size() == SIZE + 3


def test_built_in_models_take_registered_variables(registered):
    R, p, v, b, _, rate = epochs("depth")
    values = {"buoy_offset": np.array([0.4]), "buoy_deviation": np.array([0.1, -0.2])}
    known = {"depth_offset": values["buoy_offset"], "ahrs_offset": np.zeros(1), "ahrs_deviation": np.array([0.1, -0.2])}
    here, there = State(R, p, v, b, values), State(R, p, v, b, known)
    pairs = [(Position("buoy", np.array(ARM), (2,), own), own) for own in ("buoy_offset", "depth_offset")]
    (z, H), (expected, J) = (model.predict(s, rate) for (model, _), s in zip(pairs, (here, there), strict=True))
    np.testing.assert_array_equal(z, expected)
    np.testing.assert_array_equal(H["buoy_offset"], J["depth_offset"])
    heading = CompassHeading("buoy", "buoy_offset", "buoy_deviation", 0.1, TURN)
    same = CompassHeading("ahrs", "ahrs_offset", "ahrs_deviation", 0.1, TURN)
    z, H = heading.predict(State(R, p, v, b, values | {"buoy_offset": np.zeros(1)}), rate)
    expected, J = same.predict(there, rate)
    np.testing.assert_array_equal(z, expected)
    np.testing.assert_array_equal(H["buoy_deviation"], J["ahrs_deviation"])


def test_arrays_of_different_numbers_of_epochs_are_refused():
    R, p, v, b, _, rate = epochs("depth")
    calibration = {"depth_offset": np.zeros((N, 1))}
    model = Position("depth", np.array(ARM), (2,), "depth_offset")
    with pytest.raises(ValueError, match=f"depth: cannot predict {N} epochs"):
        model.predict(State(R, p, v[1:], b, calibration), rate)
    with pytest.raises(ValueError, match=f"depth: cannot predict {N} epochs"):
        model.predict(State(R, p, v, b, {"depth_offset": np.zeros((N + 1, 1))}), rate)


def motions() -> tuple[list[np.ndarray], list[np.ndarray]]:
    """States, and motions large enough that every term of the propagation shows."""
    R, p, v, b, _, _ = epochs("dvl", seed=3)
    rng = np.random.default_rng(4)
    dR, (dv, dp) = exp_rotation(0.5 * rng.standard_normal((N, 3))), rng.standard_normal((2, N, 3))
    return [R, p, v, b], [rng.uniform(0.1, 0.6, N), dR, dv, dp, b + 0.1 * rng.standard_normal((N, 6))]


def test_one_epoch_is_propagated_as_many():
    state, motion = motions()
    there, F = propagate_all(State(*state), Delta(*motion), 9.81)
    out, nothing = (there.R_nb, there.p_n, there.v_n), np.empty(0)
    work, one, one_F = np.empty((WORK, 3, 3)), [np.empty((3, 3)), np.empty(3), np.empty(3)], np.zeros((15, 15))
    for k in range(N):
        before, moved = Epoch(*(values[k] for values in state), nothing), Snapshot(*(values[k] for values in motion))
        propagate(before, moved, 9.81, Epoch(*one, before.b, nothing), work)
        propagation_jacobian(state[0][k], motion[0][k], one_F, work)  # of an F before it, from the second on
        for mine, theirs in zip((*one, one_F), (*out, F), strict=True):
            np.testing.assert_allclose(mine, theirs[k], rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", CASES)
def test_chained_jacobian_is_the_product_with_that_of_the_propagation(name):
    state, motion = motions()
    _, F = propagate_all(State(*state), Delta(*motion), 9.81)
    for H in (predict(name, epochs(name))[1], RNG.standard_normal((N, 3, 20))):
        for k in range(N):
            expected = np.hstack([H[k, :, :15] @ F[k], H[k, :, 15:]])
            chain(H[k], F[k])
            np.testing.assert_allclose(H[k], expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("dim", [1, 2, 3, 4])
def test_whitening_is_the_inverse_of_the_cholesky_factor(dim):
    gain, sd, rate_sd = RNG.standard_normal((dim, 3)), RNG.uniform(0.01, 1.0, (N, dim)), RNG.uniform(0.0, 1.0, N)
    covariance = np.eye(dim) * sd[:, None] ** 2 + gain @ gain.T * rate_sd[:, None, None] ** 2
    if dim == 2:  # the third is their covariance
        sd = np.column_stack([sd, RNG.uniform(-0.99, 0.99, N) * sd.prod(axis=1)])
        covariance[:, [0, 1], [1, 0]] += sd[:, 2:]
    W = np.full((N, dim, dim), np.nan)
    whiten_many(sd, gain @ gain.T, rate_sd, W)
    expected = np.linalg.inv(np.linalg.cholesky(covariance))
    np.testing.assert_allclose(W, expected, rtol=1e-10, atol=1e-12)
    np.testing.assert_array_equal(np.triu(W, 1), 0.0)


@pytest.mark.parametrize("loss", range(len(LOSSES)), ids=LOSSES)
def test_weight_is_the_slope_of_the_robust_cost(loss):
    d2 = np.array([0.0, 0.3, 7.0, 8.5, 100.0])
    rho, weight = np.empty_like(d2), np.empty_like(d2)
    weight_many(d2, loss, 2.8, rho, weight)
    for k, square in enumerate(d2):
        assert (robust_cost(square, loss, 2.8), loss_weight(square, loss, 2.8)) == (rho[k], weight[k])
        if square:  # d rho / d (d^2) = rho' / (2 d)
            slope = (robust_cost(square + 1e-4, loss, 2.8) - robust_cost(square - 1e-4, loss, 2.8)) / 2e-4
            assert 2.0 * slope == pytest.approx(weight[k], rel=1e-7)
    assert weight[0] == 1.0 and rho[0] == 0.0
    assert (weight[-1] < 0.5) == (LOSSES[loss] != "none")


@pytest.mark.slow
@pytest.mark.parametrize("file", ["test_kernel_measurements.py", "test_kernel_error_coordinates.py"])
def test_kernels_hold_uncompiled_too(file):
    if os.environ.get("NUMBA_DISABLE_JIT") == "1":
        pytest.skip("this is the run that is meant")
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(Path(__file__).with_name(file))],
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "NUMBA_DISABLE_JIT": "1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
