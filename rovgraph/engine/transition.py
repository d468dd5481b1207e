"""The IMU's motion over intervals between states: prediction, linear transition, residual."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.scale import biased
from rovgraph.geometry import Array
from rovgraph.kernels.motion import transitions as motion_transitions
from rovgraph.kernels.motion_residual import motion_errors, motion_weights
from rovgraph.state import State


def predict(interval: KeyframeInterval, state: State) -> State:
    """The state at the end of an interval, from the IMU alone, or from nothing while it is silent.

    Parameters
    ----------
    interval : with motion
    state : State of one epoch, of the keyframe before
    """
    return transitions([interval], [state])[0][0]


def transitions(intervals: Sequence[KeyframeInterval], before: Sequence[State]) -> tuple[list[State], Array, Array]:
    """Predicted states, transition matrices and process noise of n intervals, first order.

    The residual's derivatives A_i, A_j by the two keyframes say A_i e_i + A_j e_j = noise of the
    residual's covariance S, so e_j = F e_i + w with F = -A_j^-1 A_i and cov w = A_j^-1 S A_j^-T.

    Parameters
    ----------
    intervals : with motion
    before : State of one epoch each

    Returns
    -------
    after : list of State
    F, Q : ndarray, shape (n, 15, 15), pose, velocity, bias, in the tangent space of `State`
    """
    n = len(intervals)
    R, p, v, F, Q = (np.empty((n, *shape)) for shape in ((3, 3), (3,), (3,), (15, 15), (15, 15)))
    motion_transitions(_rows(intervals), *_arrays(list(zip(intervals, before, strict=True))), R, p, v, F, Q)
    after = [replace(state, R_nb=R[k : k + 1], p_n=p[k : k + 1], v_n=v[k : k + 1]) for k, state in enumerate(before)]
    return after, F, Q


def residual(interval: KeyframeInterval, before: State, after: State) -> tuple[Array, Array, Array]:
    """How two states disagree with an interval.

    Parameters
    ----------
    interval : between them
    before, after : State of one epoch each

    Returns
    -------
    r : ndarray, shape (15,), of `rovgraph.kernels.motion_residual`
    A_i, A_j : ndarray, shape (15, 15), its derivatives by the two states, in the tangent space of `State`
    """
    r, A_i, A_j = np.empty((1, 15)), np.empty((1, 15, 15)), np.empty((1, 15, 15))
    ends = _arrays([(interval, before)]), _arrays([(interval, after)])
    motion_errors(_rows([interval]), *ends[0], *ends[1], r, A_i, A_j)
    return r[0], A_i[0], A_j[0]


def whitening(interval: KeyframeInterval) -> Array:
    """W of `rovgraph.kernels.motion_residual.motion_weights`, shape (15, 15)."""
    W = np.empty((1, 15, 15))
    motion_weights(_rows([interval]), W)
    return np.asarray(W[0])


def _rows(intervals: Sequence[KeyframeInterval]) -> Array:
    return np.array([interval.motion.row for interval in intervals if interval.motion is not None])


def _arrays(states: Sequence[tuple[KeyframeInterval, State]]) -> tuple[Array, Array, Array, Array]:
    """Attitude, position, velocity, and the bias that is seen, of n states of one epoch, to be given to kernels."""
    seen = [s if i.scale_to_bias is None else biased(s, i.scale_to_bias[None]) for i, s in states]
    R, p, v, bias = (
        np.array([getattr(s, name)[0] for s in seen], float, order="C") for name in ("R_nb", "p_n", "v_n", "bias")
    )
    return R, p, v, bias
