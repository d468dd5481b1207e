"""Motion while the IMU says nothing.

Integrating an interpolated specific force needs the attitude, and an attitude that nobody
measures would turn gravity into motion: after five seconds, by tens of metres, of which no
linear filter recovers. A vehicle that is heavy below and light above does not roll over
meanwhile. So it is taken to go on as it went, with a velocity that walks, a heading that
walks, and a tilt that rights itself, a first-order Gauss-Markov process (Gelb 1974):

    tilt_j = a tilt_i + w,  a = exp(-dt / RIGHTS_ITSELF_S),  var w = (1 - a^2) TILT_SD^2
    yaw_j = yaw_i + dyaw + w,  p_j = p_i + dt v_i + w,  v_j = v_i + w,  bias_j = bias_i + w

with dyaw from the interpolated gyro, and p and v driven by one white acceleration. Graph and
filters have it from here alike.
"""

from dataclasses import replace

import gtsam
import numpy as np

from rovgraph.geometry import Array, matrix_from_rpy, rpy_from_matrix, rpy_jacobian, wrap_angle
from rovgraph.graph.assembly import KeyframeInterval
from rovgraph.graph.keys import key
from rovgraph.graph.preintegration import BRIDGE_ACC, BRIDGE_GYR, INTEGRATION_SD
from rovgraph.state import BIAS, POSE, VELOCITY, State

OUTAGE_S = 0.75  # intervals in a gap of the IMU that is longer are coasted through
TILT_SD = np.deg2rad(8.0)  # of a vehicle that rights itself
RIGHTS_ITSELF_S = 2.0 * TILT_SD**2 / BRIDGE_GYR**2  # so that at first it tilts as any ROV turns
_ENDS = [6, 9, 15, 21, 24]  # of pose, velocity, bias of two keyframes side by side


def in_outage(interval: KeyframeInterval) -> bool:
    """Whether an interval with motion is coasted through."""
    return interval.gap_s > OUTAGE_S


def coasted(interval: KeyframeInterval, before: State) -> State:
    """The state at the end of a in_outage interval; ``before`` is of one epoch."""
    rpy, p_n, _ = _predicted(interval, before)
    return replace(before, R_nb=matrix_from_rpy(rpy)[None], p_n=p_n[None], v_n=before.v_n.copy())


def coasting(interval: KeyframeInterval, before: State, after: State) -> tuple[Array, Array, Array, Array]:
    """How two states disagree with a in_outage interval.

    Parameters
    ----------
    interval : between them
    before, after : State of one epoch each

    Returns
    -------
    residual : ndarray, shape (15,), roll, pitch, yaw, position, velocity, bias
    A_i, A_j : ndarray, shape (15, 15), its derivatives by the two states, in the tangent space of `State`
    S : ndarray, shape (15, 15), covariance of its noise
    """
    assert interval.pim is not None
    rpy, p_n, kept = _predicted(interval, before)
    duration = interval.pim.deltaTij()
    rpy_i, rpy_j = rpy_from_matrix(before.R_nb[0]), rpy_from_matrix(after.R_nb[0])
    residual = np.concatenate(
        [
            wrap_angle(rpy_j - rpy),
            after.p_n[0] - p_n,
            after.v_n[0] - before.v_n[0],
            after.bias[0] - before.bias[0],
        ]
    )
    A_i, A_j, S = -np.eye(15), np.eye(15), np.zeros((15, 15))
    A_i[:3, :3] = -kept[:, None] * (rpy_jacobian(rpy_i) @ before.R_nb[0])
    A_j[:3, :3] = rpy_jacobian(rpy_j) @ after.R_nb[0]
    A_i[3:6, 3:6], A_j[3:6, 3:6] = -before.R_nb[0], after.R_nb[0]
    A_i[3:6, 6:9] = -duration * np.eye(3)
    tilt, heading = (1.0 - kept[0] ** 2) * TILT_SD**2, BRIDGE_GYR**2 * duration
    walk = BRIDGE_ACC**2 * np.array([[duration**3 / 3.0, duration**2 / 2.0], [duration**2 / 2.0, duration]])
    walk[0, 0] += INTEGRATION_SD**2 * duration
    S[:3, :3], S[3:9, 3:9] = np.diag([tilt, tilt, heading]), np.kron(walk, np.eye(3))
    S[9:, 9:] = interval.pim.residualCovariance()[9:, 9:]
    return residual, A_i, A_j, S


def coasting_factor(interval: KeyframeInterval) -> gtsam.CustomFactor:
    """A in_outage interval as a factor between its keyframes."""
    i, j = interval.index - 1, interval.index
    keys = [key(POSE, i), key(VELOCITY, i), key(POSE, j), key(VELOCITY, j), key(BIAS, i), key(BIAS, j)]

    def state(values: gtsam.Values, pose: int, velocity: int, bias: int) -> State:
        at, v_n, b = values.atPose3(pose), values.atVector(velocity), values.atConstantBias(bias).vector()
        return State(at.rotation().matrix()[None], at.translation()[None], v_n[None], b[None])

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        before, after = state(values, keys[0], keys[1], keys[4]), state(values, keys[2], keys[3], keys[5])
        residual, A_i, A_j = coasting(interval, before, after)[:3]
        if H is not None:
            pose_i, velocity_i, bias_i, pose_j, velocity_j, bias_j = np.split(np.hstack([A_i, A_j]), _ENDS, axis=1)
            for place, part in enumerate((pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j)):
                H[place] = part
        return residual

    nowhere = State(np.eye(3)[None], np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 6)))
    S = coasting(interval, nowhere, nowhere)[3]
    return gtsam.CustomFactor(gtsam.noiseModel.Gaussian.Covariance(S), keys, error)


def _predicted(interval: KeyframeInterval, before: State) -> tuple[Array, Array, Array]:
    """Roll, pitch, yaw and position after a in_outage interval, and what is kept of each angle."""
    assert interval.pim is not None
    duration = interval.pim.deltaTij()
    left = np.exp(-duration / RIGHTS_ITSELF_S)
    kept = np.array([left, left, 1.0])
    turned = rpy_from_matrix(interval.pim.deltaRij().matrix())[2]
    rpy = kept * rpy_from_matrix(before.R_nb[0]) + np.array([0.0, 0.0, turned])
    return rpy, before.p_n[0] + duration * before.v_n[0], kept
