"""The state at an epoch and its short propagation between two epochs.

State: pose (R_nb, p_n), velocity v_n, bias (accelerometer, gyro), and the calibration
variables. All measurement models take a `State` of many epochs at once and give the
derivatives in its tangent space: ``pose`` (6: rotation, translation), ``velocity`` (3),
``bias`` (6) and each calibration variable by name.

A measurement between two keyframes is predicted from the earlier keyframe through a
`Delta`, the IMU's preintegrated motion from the keyframe to the measurement's own time:

    R(t) = R_i dR Exp(-dt b_g')
    v(t) = v_i + g dt + R_i (dv - dt b_a')
    p(t) = p_i + v_i dt + g dt^2 / 2 + R_i (dp - dt^2 / 2 b_a')

with b' the bias beyond the one the preintegration assumed (Forster et al. 2017, IMU
preintegration on manifold, first order in the bias over a fraction of a second).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from rovgraph.geometry import Array, exp_rotation, right_jacobian, rotate, skew, transpose

POSE, VELOCITY, BIAS = "pose", "velocity", "bias"
DIMENSION = {POSE: 6, VELOCITY: 3, BIAS: 6}

Jacobians = dict[str, Array]


@dataclass(frozen=True)
class State:
    """State of n epochs.

    Attributes
    ----------
    R_nb : ndarray, shape (n, 3, 3)
    p_n, v_n : ndarray, shape (n, 3) [m, m/s]
    bias : ndarray, shape (n, 6), accelerometer [m/s^2], gyro [rad/s], body axes
    calibration : name -> ndarray, shape (n, dim) or (dim,)
    """

    R_nb: Array
    p_n: Array
    v_n: Array
    bias: Array
    calibration: Mapping[str, Array] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.p_n)

    def at(self, index: Array | slice | list[int]) -> "State":
        """The epochs ``index``; per-epoch calibration is indexed alike."""
        calibration = {k: v[index] if v.ndim == 2 else v for k, v in self.calibration.items()}
        return State(self.R_nb[index], self.p_n[index], self.v_n[index], self.bias[index], calibration)

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


@dataclass(frozen=True)
class Delta:
    """Preintegrated motion from a keyframe to a measurement's own time, n of them.

    Attributes
    ----------
    dt : ndarray, shape (n,) [s]
    dR : ndarray, shape (n, 3, 3)
    dv, dp : ndarray, shape (n, 3) [m/s, m]
    bias : ndarray, shape (n, 6), the bias the preintegration assumed
    """

    dt: Array
    dR: Array
    dv: Array
    dp: Array
    bias: Array

    @staticmethod
    def none(n: int) -> "Delta":
        """No motion: the measurement is at its keyframe."""
        zero = np.zeros((n, 3))
        return Delta(np.zeros(n), np.broadcast_to(np.eye(3), (n, 3, 3)), zero, zero, np.zeros((n, 6)))


def propagate(state: State, delta: Delta, gravity: float) -> State:
    """The state at the measurements' times (equations in the module's docstring)."""
    dt = delta.dt[:, None]
    excess = state.bias - delta.bias
    g_n = np.array([0.0, 0.0, gravity])
    dv = delta.dv - dt * excess[:, :3]
    dp = delta.dp - 0.5 * dt**2 * excess[:, :3]
    return replace(
        state,
        R_nb=state.R_nb @ delta.dR @ exp_rotation(-dt * excess[:, 3:]),
        v_n=state.v_n + g_n * dt + rotate(state.R_nb, dv),
        p_n=state.p_n + state.v_n * dt + 0.5 * g_n * dt**2 + rotate(state.R_nb, dp),
    )


def chain(H: Jacobians, state: State, delta: Delta) -> Jacobians:
    """Derivatives with respect to the keyframe from those at the measurement's time.

    Parameters
    ----------
    H : Jacobians of a model evaluated at ``propagate(state, delta, g)``
    state : State of the keyframes, n epochs
    delta : Delta, n

    Returns
    -------
    Jacobians with respect to ``state``: pose, velocity, bias and those of ``H``'s
    calibration variables.
    """
    n, dt = len(delta.dt), delta.dt[:, None, None]
    excess = state.bias - delta.bias
    turn = -delta.dt[:, None] * excess[:, 3:]
    dR_t = transpose(delta.dR @ exp_rotation(turn))  # keyframe axes to axes at t
    dv = delta.dv - delta.dt[:, None] * excess[:, :3]
    dp = delta.dp - 0.5 * delta.dt[:, None] ** 2 * excess[:, :3]

    out = {k: v for k, v in H.items() if k not in (POSE, VELOCITY, BIAS)}
    pose = np.zeros((n, next(iter(H.values())).shape[1], 6))
    velocity = np.zeros_like(pose[..., :3])
    bias = H.get(BIAS, np.zeros_like(pose)).copy()
    if POSE in H:
        H_rotation, H_translation = H[POSE][..., :3], H[POSE][..., 3:]
        pose[..., :3] += H_rotation @ dR_t - H_translation @ dR_t @ skew(dp)
        pose[..., 3:] += H_translation @ dR_t
        velocity += dt * (H_translation @ dR_t @ transpose(state.R_nb))
        bias[..., 3:] += -dt * (H_rotation @ right_jacobian(turn))
        bias[..., :3] += -0.5 * dt**2 * (H_translation @ dR_t)
    if VELOCITY in H:
        pose[..., :3] += -H[VELOCITY] @ state.R_nb @ skew(dv)
        velocity += H[VELOCITY]
        bias[..., :3] += -dt * (H[VELOCITY] @ state.R_nb)
    out.update({POSE: pose, VELOCITY: velocity, BIAS: bias})
    return out
