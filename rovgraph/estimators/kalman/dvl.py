"""The DVL's pings: velocity and compass heading at once (3.17).

The models are `rovgraph.sensors.DvlVelocity` and `rovgraph.sensors.CompassHeading`, whose
derivatives by a rotation in b are chained to the quaternion: a change dq of a unit
quaternion is a rotation of ``2 T(q)' dq``.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.calibration import Belief
from rovgraph.config import Config
from rovgraph.estimators.kalman.core import Linearized
from rovgraph.estimators.kalman.known import KnownMotion
from rovgraph.estimators.kalman.processes import Layout
from rovgraph.estimators.kalman.quaternion import matrix, rate_matrix, unit
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.log import Log
from rovgraph.state import BIAS, POSE, VELOCITY, State

MOUNT = ("dvl_roll", "dvl_pitch", "dvl_yaw")
HEADING = 3  # its place among x, y, z, heading
_NO_BIAS, _ANYWHERE = np.zeros((1, 6)), np.zeros((1, 3))


@dataclass(frozen=True)
class Ping:
    """What came from the DVL at one time.

    Attributes
    ----------
    time : [s]
    z : ndarray, shape (k,)
    rows : tuple of k of 0, 1, 2 (velocity) and 3 (heading): what z holds
    line : of the log
    """

    time: float
    z: Array
    rows: tuple[int, ...]
    line: int


def pings(log: Log, config: Config, compass: bool) -> list[Ping]:
    """Velocities with bottom lock and, if wanted, headings, in the order of time.

    Those before the first and after the last IMU sample are left out; a velocity beyond
    ``dvl.max_speed_mps`` is left out.
    """
    dvl, begin, end = log["dvl"], log["imu"].time[0], log["imu"].time[-1]
    good = (dvl["dvl_valid"] != 0) & (np.abs(dvl.data[:, :3]).max(axis=1) <= config.dvl.max_speed_mps)
    found: dict[float, Ping] = {}
    for t, z, line in zip(dvl.time[good].tolist(), dvl.data[good, :3], dvl.row[good].tolist(), strict=True):
        found[t] = Ping(t, z, (0, 1, 2), line)
    if compass:
        heading = log["dvl_heading"]
        for t, z, line in zip(heading.time.tolist(), heading.data[:, :1], heading.row.tolist(), strict=True):
            same = found.get(t)
            if same is None:
                found[t] = Ping(t, z, (HEADING,), line)
            else:
                found[t] = Ping(t, np.concatenate([same.z, z]), (0, 1, 2, HEADING), same.line)
    return [found[t] for t in sorted(found) if begin <= t <= end]


class DvlModel:
    """Velocity and heading that a filter's state predicts.

    Parameters
    ----------
    places : layout of the state
    body : velocity of the state is in b; False = in n
    sensors : of `rovgraph.instruments.instruments`, at the body's origin
    beliefs : of the calibration variables, which stand at their means
    known : attitude and rate where the state has none
    mount_in_heading : the angles that are states enter the heading too; False = their means do
    """

    def __init__(
        self,
        places: Layout,
        body: bool,
        sensors: dict[str, Instrument],
        beliefs: dict[str, Belief],
        known: KnownMotion | None,
        mount_in_heading: bool = True,
    ) -> None:
        self._places, self._body, self._known = places, body, known
        self._velocity, self._compass = sensors["dvl"].model, sensors["dvl_heading"].model
        self._mount_in_heading = mount_in_heading
        self._means = {name: belief.mean for name, belief in beliefs.items()}

    def __call__(self, x: Array, epoch: int, heading: bool) -> Linearized:
        """Predicted velocity and heading, shape (4,), and H, shape (4, n); heading 0 where not wanted."""
        s = self._places
        R_nb, w_b = self._attitude(x, epoch)
        v_n = R_nb @ x[s["v"]] if self._body else x[s["v"]]
        state = State(R_nb[None], _ANYWHERE, v_n[None], _NO_BIAS, self._calibration(x))
        z, J = self._velocity.predict(state, w_b[None])
        h, H = np.zeros(4), np.zeros((4, len(x)))
        h[:3] = z[0]
        H[:3, s["v"]] = J[VELOCITY][0] @ R_nb if self._body else J[VELOCITY][0]
        slopes = [(slice(0, 3), J)]
        if heading:
            if not self._mount_in_heading:
                state = State(state.R_nb, state.p_n, state.v_n, state.bias, self._means)
            z, J = self._compass.predict(state, w_b[None])
            h[HEADING] = z[0, 0]
            slopes.append((slice(HEADING, 4), J))
        if "q" in s:
            H[:3, s["w"]] = -slopes[0][1][BIAS][0, :, 3:]  # the rate enters as rate less bias
            by_q = 2.0 * rate_matrix(unit(x[s["q"]])).T
            for rows, J in slopes[int(self._body) :]:  # a velocity in b is seen alike at any attitude
                H[rows, s["q"]] = J[POSE][0, :, :3] @ by_q
        if "mount" in s:
            for rows, J in slopes if self._mount_in_heading else slopes[:1]:
                H[rows, s["mount"]] = np.column_stack([J[name][0, :, 0] for name in MOUNT])
        return h, H

    def _attitude(self, x: Array, epoch: int) -> tuple[Array, Array]:
        if self._known is not None:
            return self._known.R_nb[epoch], self._known.w_b[epoch]
        return matrix(unit(x[self._places["q"]])), x[self._places["w"]]

    def _calibration(self, x: Array) -> dict[str, Array]:
        if "mount" not in self._places:
            return self._means
        return self._means | {name: angle for name, angle in zip(MOUNT, x[self._places["mount"], None], strict=True)}
