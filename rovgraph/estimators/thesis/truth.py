"""The true motion as a place to linearise at, for studies of what linearisation costs."""

import numpy as np

from rovgraph.estimators.thesis.processes import Layout
from rovgraph.estimators.thesis.quaternion import from_matrix, unit
from rovgraph.geometry import Array, log_rotation, rotate, transpose
from rovgraph.trajectory import Trajectory


class TrueMotion:
    """Acceleration, velocity, position, rate and attitude of a dense true trajectory.

    Parameters
    ----------
    places : layout of the filter's state
    body : its acceleration and velocity are in b; False = in n
    truth : Trajectory, at the IMU's epochs or denser
    """

    def __init__(self, places: Layout, body: bool, truth: Trajectory) -> None:
        self._time, self._q = truth.time, places["q"]
        a_n = np.gradient(truth.v_n, truth.time, axis=0)
        turn = log_rotation(transpose(truth.R_nb[:-1]) @ truth.R_nb[1:]) / np.diff(truth.time)[:, None]
        w_b = np.vstack([turn[:1], 0.5 * (turn[1:] + turn[:-1]), turn[-1:]])
        to_own = transpose(truth.R_nb) if body else np.eye(3)
        q = from_matrix(truth.R_nb)
        q = q * np.cumprod(np.sign(np.concatenate([[1.0], (q[1:] * q[:-1]).sum(axis=1)])))[:, None]
        self._states = np.hstack([rotate(to_own, a_n), rotate(to_own, truth.v_n), truth.p_n, w_b, q])

    def state(self, time: float, x: Array) -> Array:
        """The true motion at ``time``, with the rest of the state as in ``x``."""
        k = int(np.clip(np.searchsorted(self._time, time), 1, len(self._time) - 1))
        share = (time - self._time[k - 1]) / (self._time[k] - self._time[k - 1])
        there = x.copy()
        there[: self._states.shape[1]] = self._states[k - 1] + share * (self._states[k] - self._states[k - 1])
        q = unit(there[self._q])
        there[self._q] = q if q @ x[self._q] >= 0.0 else -q
        return there
