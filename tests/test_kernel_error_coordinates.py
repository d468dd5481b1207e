"""Compiled error coordinates: those of `ErrorVector`, one epoch at a time."""

import numpy as np
import pytest
from test_sensors import SENSORS, random_state

from rovgraph.calibration import LAYOUT, SIZE, TABLE
from rovgraph.estimators.error_vector import ErrorVector
from rovgraph.kernels.change_of_basis import change_basis
from rovgraph.kernels.error_coordinates import local, make_scratch, retract
from rovgraph.state import State

N = 8
COMPASSES = ("dvl_compass_offset", "dvl_compass_deviation", "ahrs_offset", "ahrs_deviation")
ESTIMATED = {
    "nothing": (),
    "the DVL's mounting": ("dvl_yaw", "dvl_scale"),
    "compasses and iron": ("dvl_yaw", *COMPASSES, "hard_iron", "field_dip", "current"),
    "everything": tuple(TABLE),
}
SETS = {
    "all sensors": tuple(SENSORS),
    "DVL, magnetometer and depth": ("dvl", "mag", "depth"),
    "water track and compasses": ("dvl_water", "ahrs", "dvl_heading", "fix"),
    "fixes alone": ("fix",),
}


@pytest.fixture(params=SETS)
def instruments(request):
    return {name: SENSORS[name] for name in SETS[request.param]}


@pytest.fixture(params=ESTIMATED)
def error(request, instruments):
    return ErrorVector(ESTIMATED[request.param], instruments)


def states(error: ErrorVector, seed: int) -> State:
    """Any states; what is not estimated is the same of all of them."""
    state, fixed = random_state(seed, N, per_epoch=True), random_state(0).calibration
    own = {name: value if name in error.columns else fixed[name] for name, value in state.calibration.items()}
    return State(state.R_nb, state.p_n, state.v_n, state.bias, own)


def one(state: State, k: int) -> list[np.ndarray]:
    """R, p, v, b, c of one epoch, to be written to."""
    c = np.zeros(SIZE)
    for name, own in LAYOUT.items():
        c[own] = state.calibration[name][k] if state.calibration[name].ndim == 2 else state.calibration[name]
    return [state.R_nb[k].copy(), state.p_n[k].copy(), state.v_n[k].copy(), state.bias[k].copy(), c]


def same(mine, theirs):
    np.testing.assert_allclose(mine, theirs, rtol=1e-12, atol=1e-12)


def test_retraction_is_that_of_the_error_vector(error):
    state, delta = states(error, 1), 0.3 * np.random.default_rng(2).standard_normal((N, error.size))
    expected, bases = error.retract(state, delta)
    layout, basis = error.layout(), np.eye(error.size)
    scratch = make_scratch(len(layout.seen), SIZE)
    for k in range(N):
        here = one(state, k)
        retract(*here, delta[k], layout, scratch, basis)
        for mine, theirs in zip(here, one(expected, k), strict=True):
            same(mine, theirs)
        same(basis, bases[k])


def test_difference_is_that_of_the_error_vector(error):
    state, other = states(error, 1), states(error, 3)
    deltas, bases = error.local(state, other)
    layout, basis, delta = error.layout(), np.eye(error.size), np.empty(error.size)
    scratch = make_scratch(len(layout.seen), SIZE)
    for k in range(N):
        local(*one(state, k), tuple(one(other, k)), layout, scratch, delta, basis)
        same(delta, deltas[k])
        same(basis, bases[k])


def test_difference_undoes_the_retraction(error):
    state, delta = states(error, 1), 0.3 * np.random.default_rng(2).standard_normal((N, error.size))
    layout, basis, found = error.layout(), np.eye(error.size), np.empty(error.size)
    scratch = make_scratch(len(layout.seen), SIZE)
    for k in range(N):
        here = one(state, k)
        retract(*here, delta[k], layout, scratch, basis)
        local(*one(state, k), tuple(here), layout, scratch, found, basis)
        np.testing.assert_allclose(found, delta[k], atol=1e-10)


@pytest.mark.parametrize("places", [0, 4])
def test_change_of_basis_of_a_covariance_is_the_dense_product(error, places):
    rng = np.random.default_rng(5)
    state, layout, basis = states(error, 1), error.layout(), np.eye(error.size)
    retract(*one(state, 0), 0.3 * rng.standard_normal(error.size), layout, make_scratch(len(layout.seen), SIZE), basis)
    whole = np.eye(error.size + places)
    whole[: error.size, : error.size] = basis
    root = rng.standard_normal(whole.shape)
    P = root @ root.T
    expected, rows = whole @ P @ whole.T, len(layout.rows)
    change_basis(P, basis, layout.rows, np.empty((rows, len(P))), np.empty((rows, error.size + 1), np.int64))
    np.testing.assert_allclose(P, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(P, P.T)
    np.testing.assert_array_equal(np.delete(basis, layout.rows, axis=0), np.delete(np.eye(error.size), layout.rows, 0))
