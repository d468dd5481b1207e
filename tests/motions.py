"""Motions by themselves, rows of `rovgraph.kernels.motion_row`, and small problems for the tests."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels import assembly as at
from rovgraph.kernels import measurement_row, motion_row
from rovgraph.kernels.linearization import place_measurements
from rovgraph.kernels.motion import transitions
from rovgraph.kernels.motion_residual import motion_errors, motion_weights
from rovgraph.kernels.states import States
from rovgraph.model.calibration import TABLE
from rovgraph.model.state import State
from rovgraph.problem.measurements import kernel_states
from rovgraph.problem.motion import biased
from rovgraph.problem.problem import Problem


def predict(motion: Array, before: State, scale: Array | None = None) -> State:
    """The state at the end of a motion, shape (ROW,); ``scale``, shape (6, 6), is that of `rovgraph.problem.motion`."""
    return transition(motion, np.zeros((15, 15)), before, scale)[0]


def transition(
    motion: Array, covariance: Array, before: State, scale: Array | None = None
) -> tuple[State, Array, Array]:
    """The same with the transition F and process noise Q, shape (15, 15), of a residual of that covariance."""
    R, p, v, b, F, Q = (np.empty((1, *shape)) for shape in ((3, 3), (3,), (3,), (6,), (15, 15), (15, 15)))
    transitions(motion[None], covariance[None], _states(before, scale), States(R, p, v, b), F, Q)
    return replace(before, R_nb=R, p_n=p, v_n=v), F[0], Q[0]


def residual(motion: Array, before: State, after: State) -> tuple[Array, Array, Array]:
    """How two states disagree with a motion, shape (15,), and the derivatives by both, shape (15, 15)."""
    r, A_i, A_j = np.empty((1, 15)), np.empty((1, 15, 15)), np.empty((1, 15, 15))
    motion_errors(motion[None], _states(before), _states(after), r, A_i, A_j)
    return r[0], A_i[0], A_j[0]


def weights(motions: Array, covariances: Array) -> Array:
    """Square-root information of motions, shape (n, 15, 15), as the covariances of their residuals."""
    W = np.empty((len(motions), 15, 15))
    motion_weights(motions, covariances, W)
    return W


def problem_of(time: Array, motions: Array, covariances: Array) -> Problem:
    """Keyframes at n times and the motions between them, shape (n - 1, ROW), without samples and measurements."""
    keyframes = np.zeros((len(time), at.KEYFRAME))
    keyframes[:, at.TIME] = time
    return Problem(
        sensors=(),
        dims=(),
        keyframes=keyframes,
        motions=motions,
        covariances=covariances,
        weights=weights(motions, covariances),
        scales=np.empty((0, 6, 6)),
        rows=np.empty((0, measurement_row.ROW)),
        row_scales=np.empty((0, 6, 6)),
        of=np.empty((at.OF, 0), np.int64),
        windows=np.empty((0, 0, measurement_row.KNOT)),
        names=np.empty(0),
        lags={},
        bias=motions[0, motion_row.BIAS : motion_row.BIAS + 6] if len(motions) else np.zeros(6),
        imu=np.empty((0, 7)),
        forgotten=0,
    )


def _states(state: State, scale: Array | None = None) -> States:
    """Of one epoch, with the bias that is seen, as kernels take it."""
    seen = state if scale is None else biased(state, scale[None])
    return States(*(np.ascontiguousarray(a, float) for a in (seen.R_nb, seen.p_n, seen.v_n, seen.bias)))


class Delta(NamedTuple):
    """Motion from n keyframes to measurements: see `rovgraph.kernels.linearization`."""

    dt: Array
    dR: Array
    dv: Array
    dp: Array
    bias: Array

    @staticmethod
    def none(n: int) -> "Delta":
        zero = np.zeros((n, 3))
        return Delta(np.zeros(n), np.tile(np.eye(3), (n, 1, 1)), zero, zero, np.zeros((n, 6)))


def propagate(state: State, delta: Delta, gravity: float) -> tuple[State, Array]:
    """The states at the measurements' own times, and their derivatives by those of the keyframes, (n, 15, 15)."""
    n, row = len(state), measurement_row
    rows = np.zeros((n, row.ROW))
    rows[:, row.DT], rows[:, row.DR : row.DV] = delta.dt, delta.dR.reshape(n, 9)
    rows[:, row.DV : row.DP], rows[:, row.DP : row.ASSUMED], rows[:, row.ASSUMED : row.Z] = delta[2:]
    none = np.zeros((0, 6, 6)), np.full(n, -1), np.zeros((0, 0, row.KNOT))
    measured = row.MeasuredRows(rows, np.zeros(n, np.int64), *none)
    calibration = {name: np.zeros(variable.dim) for name, variable in TABLE.items()}
    known = replace(state, calibration={**calibration, **state.calibration})
    out = States(*(np.empty((n, *shape)) for shape in ((3, 3), (3,), (3,), (6,), (12,))))
    F = np.zeros((n, 15, 15))
    place_measurements(kernel_states(known), measured, np.zeros((1, row.PARAMS)), gravity, out, np.empty((n, 3)), F)
    return State(out.R, out.p, out.v, out.b, state.calibration), F
