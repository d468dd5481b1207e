"""Acoustic positioning: the exchange's equation, its context, and dives whose truth is known."""

import numpy as np
import pytest

from rovgraph.geometry import exp_rotation, matrix_from_rpy
from rovgraph.kernels import measurement_row as at
from rovgraph.model.calibration import LAYOUT, TABLE, USBL_MOUNT
from rovgraph.model.state import State
from rovgraph.sensors import AcousticExchange

VARIABLES = (
    *USBL_MOUNT, "usbl_arm", "sound_speed_scale", "usbl_range_offset", "usbl_direction_error", "usbl_range_error",
    "range_clock", "range_clock_drift", "beacon_1", "beacon_1_down", "usbl_time_offset",
)  # fmt: skip


def context(rng: np.random.Generator, n: int, inverted: bool, ways: float, beacon: bool) -> np.ndarray:
    x = np.zeros((n, at.WIDTH))
    x[:, at.ARM : at.ARM + 3] = rng.normal(0, 0.3, (n, 3))
    x[:, at.ASKED : at.ASKED + 3] = rng.normal(0, 20, (n, 3))
    x[:, at.HEARD : at.HEARD + 3] = x[:, at.ASKED : at.ASKED + 3] + rng.normal(0, 1, (n, 3))
    x[:, at.FRAME : at.FRAME + 9] = matrix_from_rpy(rng.normal(0, 0.5, (n, 3))).reshape(n, 9)
    x[:, at.MOVES : at.MOVES + 3] = rng.normal(0, 1, (n, 3))
    x[:, at.TURNS : at.TURNS + 3] = rng.normal(0, 0.1, (n, 3))
    seen = rng.normal(0, 1, (n, 3))
    seen[0] = 0, 0, 1  # below the ship
    x[:, at.SEEN : at.SEEN + 3] = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    x[:, at.WAIT : at.WAIT + 2] = rng.normal(0, 0.1, (n, 2))
    x[:, at.STATED], x[:, at.SINCE], x[:, at.WAYS], x[:, at.INVERTED] = 0.1, 7.0, ways, inverted
    x[:, at.MOUNT_AT : at.WIDTH] = [
        LAYOUT[name].start
        for name in (
            "usbl_roll", "usbl_arm", "beacon_1", "beacon_1_down", "sound_speed_scale", "usbl_range_offset",
            "range_clock", "range_clock_drift", "usbl_direction_error", "usbl_range_error", "usbl_time_offset",
        )
    ]  # fmt: skip
    if not beacon:
        x[:, [at.BEACON_AT, at.DOWN_AT]] = -1
    return x


def state(rng: np.random.Generator, n: int) -> State:
    return State(
        matrix_from_rpy(rng.normal(0, 0.5, (n, 3))), rng.normal((0, 0, 60), 30, (n, 3)), rng.normal(0, 1, (n, 3)),
        np.zeros((n, 6)), {name: rng.normal(0, 0.1, TABLE[name].dim) for name in VARIABLES},
    )  # fmt: skip


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("ways", [1.0, 2.0])
@pytest.mark.parametrize("dim", [1, 3])
def test_derivatives_of_an_exchange_are_those_of_finite_differences(inverted: bool, ways: float, dim: int) -> None:
    rng, n, step = np.random.default_rng(3), 20, 1e-6
    model = AcousticExchange("usbl", dim, np.zeros(3), VARIABLES, context(rng, n, inverted, ways, dim == 1))
    at_state, still = state(rng, n), np.zeros((n, 3))
    _, H = model.predict(at_state, still)
    for variable, jacobian in H.items():
        for k in range(jacobian.shape[2]):
            d = np.zeros(jacobian.shape[2])
            d[k] = step
            moved = [_moved(at_state, variable, sign * d) for sign in (1.0, -1.0)]
            slope = (model.predict(moved[0], still)[0] - model.predict(moved[1], still)[0]) / (2 * step)
            np.testing.assert_allclose(jacobian[:, :, k], slope, atol=2e-5 * max(1.0, np.abs(slope).max()))


def _moved(s: State, variable: str, d: np.ndarray) -> State:
    if variable == "pose":
        R = s.R_nb @ exp_rotation(np.tile(d[:3], (len(s), 1)))
        return State(R, s.p_n + s.R_nb @ d[3:], s.v_n, s.bias, s.calibration)
    if variable == "velocity":
        return State(s.R_nb, s.p_n, s.v_n + d, s.bias, s.calibration)
    return State(s.R_nb, s.p_n, s.v_n, s.bias, {**s.calibration, variable: s.calibration[variable] + d})
