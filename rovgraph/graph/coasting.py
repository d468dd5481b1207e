"""Motion while the IMU says nothing.

Integrating an interpolated specific force needs the attitude, and an attitude that nobody
measures would turn gravity into motion: after five seconds, by tens of metres, of which no
linear filter recovers. A vehicle that is heavy below and light above does not roll over
meanwhile. So it is taken to go on as it went, with a velocity that walks, a heading that
walks, and a tilt that stays within bounds.
"""

import numpy as np

from rovgraph.geometry import Array, matrix_from_rpy, rpy_from_matrix, transpose
from rovgraph.graph.preintegration import BRIDGE_ACC, BRIDGE_GYR
from rovgraph.state import State

BLIND_S = 0.75  # intervals in a gap of the IMU that is longer are coasted through
TILT_SD = np.deg2rad(8.0)  # of a vehicle that rights itself, against its tilt before


def coasted(before: State, integrated: State, duration: float) -> State:
    """The state after a time without measurements.

    Parameters
    ----------
    before : State of one epoch
    integrated : as the IMU's interpolated signals have it; its heading is taken
    duration : [s]
    """
    tilted, turned = rpy_from_matrix(before.R_nb), rpy_from_matrix(integrated.R_nb)
    R_nb = matrix_from_rpy(np.column_stack([tilted[:, :2], turned[:, 2]]))
    return State(R_nb, before.p_n + duration * before.v_n, before.v_n, before.bias, before.calibration)


def coasting(before: State, after: State, duration: float, P: Array) -> tuple[Array, Array]:
    """Transition matrix and process noise of that, shape (15, 15), in the tangent space of `State`.

    Parameters
    ----------
    before, after : State of one epoch each
    duration : [s]
    P : ndarray, of the error before; tilt that is less sure than `TILT_SD` gets no less so
    """
    R, R_after = before.R_nb[0], after.R_nb[0]
    F, Q = np.eye(15), np.zeros((15, 15))
    F[:3, :3] = F[3:6, 3:6] = transpose(R_after) @ R
    F[3:6, 6:9] = duration * transpose(R_after)
    tilt = np.clip(TILT_SD**2 - np.diag(R @ P[:3, :3] @ transpose(R))[:2], 0.0, BRIDGE_GYR**2 * duration)
    Q[:3, :3] = transpose(R_after) @ np.diag([*tilt, BRIDGE_GYR**2 * duration]) @ R_after
    walk = BRIDGE_ACC**2 * np.array([[duration**3 / 3.0, duration**2 / 2.0], [duration**2 / 2.0, duration]])
    Q[3:6, 3:6] = walk[0, 0] * np.eye(3)
    Q[3:6, 6:9] = walk[0, 1] * transpose(R_after)
    Q[6:9, 3:6] = Q[3:6, 6:9].T
    Q[6:9, 6:9] = walk[1, 1] * np.eye(3)
    return F, Q
