"""Compiled error coordinates: what defines them, and that differences and changes of basis agree with them."""

import numpy as np
import pytest
from test_sensors import SENSORS, random_state

from rovgraph.geometry import Array, exp_rotation
from rovgraph.inference.filter import SEEN, seen_model
from rovgraph.inference.filter import ErrorLayout as Layout
from rovgraph.inference.filter_step import states_of
from rovgraph.kernels.error_coordinates import ErrorColumns, ErrorScratch, change_basis, local, make_scratch, retract
from rovgraph.kernels.states import Epoch
from rovgraph.model.calibration import LAYOUT, SIZE, TABLE
from rovgraph.model.state import VELOCITY, State
from rovgraph.sensors import CompiledModel, innovation

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
def layout(request, instruments) -> Layout:
    return Layout(ESTIMATED[request.param], (), instruments)


@pytest.fixture
def seen(layout, instruments) -> dict[str, CompiledModel]:
    """Variable -> the model that is linear in it."""
    return {v: seen_model(instruments[s].model) for s, v in SEEN.items() if s in instruments and v in layout.columns}


def states(layout: Layout, seed: int) -> list[Epoch]:
    """Any states; what is not estimated is the same of all of them."""
    state, fixed = random_state(seed, N, per_epoch=True), random_state(0).calibration
    own = {name: value if name in layout.columns else fixed[name] for name, value in state.calibration.items()}
    return [one(State(state.R_nb, state.p_n, state.v_n, state.bias, own), k) for k in range(N)]


def one(state: State, k: int) -> Epoch:
    c = np.zeros(SIZE)
    for name, own in LAYOUT.items():
        c[own] = state.calibration[name][k] if state.calibration[name].ndim == 2 else state.calibration[name]
    return Epoch(state.R_nb[k].copy(), state.p_n[k].copy(), state.v_n[k].copy(), state.bias[k].copy(), c)


def prepared(layout: Layout) -> tuple[ErrorColumns, ErrorScratch, Array]:
    own = layout.coordinates
    return own, make_scratch(len(own.seen), SIZE), np.eye(layout.size)


def moved_by(layout: Layout, size: float = 1.0) -> list[tuple[Epoch, Array, Epoch, Array]]:
    """Each state, an error, where it leads, and the change of basis."""
    own, scratch, basis = prepared(layout)
    out = []
    for before, delta in zip(states(layout, 1), size * errors(layout), strict=True):
        after = Epoch(*(a.copy() for a in before))
        retract(after, delta, own, scratch, basis)
        out.append((before, delta, after, basis.copy()))
    return out


def errors(layout: Layout) -> Array:
    return 0.3 * np.random.default_rng(2).standard_normal((N, layout.size))


def prediction(model: CompiledModel, layout: Layout, epoch: Epoch) -> tuple[Array, Array]:
    """Measurement, shape (1, dim), and its derivative by the error, shape (dim, size)."""
    R, p, v, b, c = epoch
    state = states_of(np.concatenate([R.ravel(), p, v, b])[None], c)
    z, H = model.predict(state, np.zeros((1, 3)))
    return z, layout.matrix(H)[0]


def test_what_each_instrument_sees_moves_as_its_jacobian_says_and_all_else_by_itself(layout, seen):
    for before, delta, after, _ in moved_by(layout):
        R, p, v, b, c = before
        by_itself = dict(zip(("R", "p", "v", "b"), after[:4], strict=True))
        np.testing.assert_allclose(by_itself["R"], R @ exp_rotation(delta[:3]), atol=1e-12)
        np.testing.assert_allclose(by_itself["p"], p + R @ delta[3:6], atol=1e-12)
        np.testing.assert_allclose(by_itself["b"], b + delta[9:15], atol=1e-12)
        if VELOCITY not in seen:
            np.testing.assert_allclose(by_itself["v"], v + delta[6:9], atol=1e-12)
        for name, own in LAYOUT.items():
            if name not in seen:
                shift = delta[layout.columns[name]] if name in layout.columns else 0.0
                np.testing.assert_allclose(after[4][own], c[own] + shift, atol=1e-12)
        for model in seen.values():
            (z, H), (moved, _) = (prediction(model, layout, epoch) for epoch in (before, after))
            off = innovation(model, moved, z + H @ delta)
            np.testing.assert_allclose(off, 0.0, atol=1e-11 * max(np.abs(z).max(), 1.0))


def test_a_change_of_basis_keeps_attitude_and_position_in_n_and_what_each_instrument_sees(layout, seen):
    own, scratch, basis = prepared(layout)
    own_rows = {row for name in seen for row in np.r_[layout.columns[name]].tolist()}
    rest, delta = [k for k in range(6, layout.size) if k not in own_rows], np.empty(layout.size)
    for before, other in zip(states(layout, 1), states(layout, 3), strict=True):
        local(before, other, own, scratch, delta, basis)  # takes errors about the other to this one
        turn = np.zeros((3, layout.size))
        turn[:, :3] = before[0].T @ other[0]
        np.testing.assert_allclose(basis[:3], turn, atol=1e-12)
        np.testing.assert_allclose(basis[3:6], np.roll(turn, 3, axis=1), atol=1e-12)
        np.testing.assert_array_equal(basis[rest], np.eye(layout.size)[rest])
        for model in seen.values():
            H, there = (prediction(model, layout, epoch)[1] for epoch in (before, other))
            np.testing.assert_allclose(H @ basis, there, atol=1e-11 * np.abs(there).max())


def test_difference_undoes_the_retraction(layout):
    own, scratch, basis = prepared(layout)
    found = np.empty(layout.size)
    for before, delta, after, _ in moved_by(layout):
        local(before, after, own, scratch, found, basis)
        np.testing.assert_allclose(found, delta, atol=1e-10)


def test_the_basis_of_a_retraction_is_that_of_the_difference_back_but_for_the_second_order(layout):
    own, scratch, basis = prepared(layout)
    off, found = [], np.empty(layout.size)
    for size in (1.0, 0.1):
        off.append(0.0)
        for before, _, after, there in moved_by(layout, size):
            local(after, before, own, scratch, found, basis)
            off[-1] = max(off[-1], np.abs(basis - there).max())
    assert off[1] <= 0.02 * off[0] + 1e-12


@pytest.mark.parametrize("places", [0, 4])
def test_change_of_basis_of_a_covariance_is_the_dense_product(layout, places):
    rng = np.random.default_rng(5)
    *_, basis = moved_by(layout)[0]
    rows = layout.coordinates.rows
    whole = np.eye(layout.size + places)
    whole[: layout.size, : layout.size] = basis
    root = rng.standard_normal(whole.shape)
    P = root @ root.T
    expected = whole @ P @ whole.T
    change_basis(P, basis, rows, np.empty((len(rows), len(P))), np.empty((len(rows), layout.size + 1), np.int64))
    np.testing.assert_allclose(P, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(P, P.T)
    np.testing.assert_array_equal(np.delete(basis, rows, axis=0), np.delete(np.eye(layout.size), rows, 0))
