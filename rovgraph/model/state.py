"""The state at an epoch and its short propagation between two epochs.

State: pose (R_nb, p_n), velocity v_n, bias (accelerometer, gyro), and the calibration
variables. All measurement models take a `State` of many epochs at once and give the
derivatives in its tangent space: ``pose`` (6: rotation, translation), ``velocity`` (3),
``bias`` (6) and each calibration variable by name.

A measurement between two keyframes is predicted from the earlier keyframe through a
`Delta`, the IMU's preintegrated motion from the keyframe to the measurement's own time, by the equations
of `rovgraph.kernels.linearization`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, exp_rotation, rotate

POSE, VELOCITY, BIAS = "pose", "velocity", "bias"
MOTION_STATE = "motion"  # the three in this order, 15 components
COLUMNS = {POSE: slice(0, 6), VELOCITY: slice(6, 9), BIAS: slice(9, 15)}  # of it
DIMENSION = {POSE: 6, VELOCITY: 3, BIAS: 6}
PLACE, PLACE_DIM = "place", 2  # where a place that is recognised lies, north and east: no part of a keyframe

Jacobians = dict[str, Array]


@dataclass(frozen=True)
class State:
    """State of n epochs.

    Attributes
    ----------
    R_nb : ndarray, shape (n, 3, 3)
    p_n, v_n : ndarray, shape (n, 3) [m, m/s]
    bias : ndarray, shape (n, 6), accelerometer [m/s^2], gyro [rad/s], body axes
    calibration : name -> ndarray, shape (n, dim) or (dim,); `PLACE` too, for those who see one
    """

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    calibration: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.p_n)

    def at(self, index: NDArray[np.int64] | slice | list[int]) -> "State":
        """The epochs ``index``; per-epoch calibration is indexed alike."""
        calibration = {k: v[index] if v.ndim == 2 else v for k, v in self.calibration.items()}
        return State(self.R_nb[index], self.p_n[index], self.v_n[index], self.bias[index], calibration)

    def seeing(self, places: Array) -> "State":
        """The state together with the places that are seen, shape (n, 2) or (2,), north and east [m]."""
        return replace(self, calibration={**self.calibration, PLACE: places})

    def retract(self, variable: str, delta: Array) -> "State":
        """The state perturbed by ``delta`` in the tangent space of one variable."""
        if variable == POSE:
            return replace(
                self,
                R_nb=self.R_nb @ exp_rotation(np.broadcast_to(delta[:3], self.p_n.shape)),
                p_n=self.p_n + rotate(self.R_nb, delta[3:]),
            )
        if variable == VELOCITY:
            return replace(self, v_n=self.v_n + delta)
        if variable == BIAS:
            return replace(self, bias=self.bias + delta)
        return replace(self, calibration={**self.calibration, variable: self.calibration[variable] + delta})


def stack_states(states: Sequence[State]) -> State:
    """Many states of one epoch as one `State`; calibration becomes per epoch, shape (n, dim)."""
    names = states[0].calibration
    return State(
        np.concatenate([s.R_nb for s in states]),
        np.concatenate([s.p_n for s in states]),
        np.concatenate([s.v_n for s in states]),
        np.concatenate([s.bias for s in states]),
        {name: _stacked([s.calibration[name] for s in states]) for name in names},
    )


def _stacked(values: list[Array]) -> Array:
    """One after the other, shape (n, dim); at no cost where it is one and the same."""
    if len(values) == 1:
        return values[0][None]
    if all(value is values[0] for value in values):
        return np.broadcast_to(values[0], (len(values), *values[0].shape))
    return np.array(values)
