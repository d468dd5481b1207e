"""Measurements of the thesis's filters: the MTi (3.14) and the DVL's pings (3.17).

The MTi measures specific force, angular rate and magnetic field at one epoch:

    y = [R_sb (a_b + w x (w x l) - R_bn g) ; R_sb w ; R_sb R_bn H] + b

with the sign of gravity corrected, the field as a fraction of its length, and the nine
biases in the MTi's axes. ``rovgraph.sensors.MagneticField`` has the same equation for many epochs at
once; at 100 Hz that costs more than the filter itself. A test compares the two.

A ping of the DVL has velocity and compass heading at once. Its models are `rovgraph.sensors.DvlVelocity` and
`rovgraph.sensors.CompassHeading`, whose derivatives by a rotation in b are chained to the quaternion: a change dq of a
unit quaternion is a rotation of ``2 T(q)' dq``.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from rovgraph.geometry import Array, rotate, transpose
from rovgraph.lab.thesis.core import (
    ConstantTurn,
    Epochs,
    Index,
    Linearized,
    Polynomials,
    matrix,
    rate_matrix,
    times,
    unit,
)
from rovgraph.lab.thesis.processes import KnownMotion, Layout, centripetal, length
from rovgraph.log import Log
from rovgraph.model.calibration import MOUNT, Belief
from rovgraph.model.config import Config
from rovgraph.model.state import BIAS, POSE, VELOCITY, State
from rovgraph.sensors import CompassHeading, DvlVelocity, MagneticField, field_direction
from rovgraph.sensors.instruments import Instrument

BIASES = ("acc_bias", "gyr_bias", "mag_bias")
_EYE = np.eye(3)


def reference_field(instrument: Instrument, beliefs: dict[str, Belief]) -> Array:
    """Direction of the field in n that the thesis's filters hold fixed, shape (3,)."""
    model = instrument.model
    assert isinstance(model, MagneticField)
    offset, dip = beliefs["mag_offset"].mean[0], beliefs["field_dip"].mean[0]
    return field_direction(model.declination - offset, model.dip + dip)


class ImuModel(Protocol):
    """Measurement model of the inertial unit.

    Attributes
    ----------
    dim : number of components
    """

    @property
    def dim(self) -> int: ...

    def __call__(self, x: Array, epoch: Index) -> Linearized:
        """Predicted samples, shape (..., m), and H, shape (..., m, n)."""
        ...

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        """The model of several filters side by side."""
        ...


class Mti:
    """All of (3.14) for a state with attitude and rate.

    Parameters
    ----------
    body : acceleration in b; False = in n
    places : layout of the state
    R_bs : ndarray, shape (3, 3), mounting
    lever_arm_b : ndarray, shape (3,) [m]
    gravity : [m/s^2]
    field_n : ndarray, shape (3,), reference field as a fraction of its length
    """

    dim = 9

    def __init__(
        self, body: bool, places: Layout, R_bs: Array, lever_arm_b: Array, gravity: float, field_n: Array
    ) -> None:
        R_sb, a, w, q = R_bs.T, places["a"], places["w"], places["q"]
        turn = 0.5 * ConstantTurn(inverse=True, left=R_sb).second  # R_sn = R_sb + q' turn q
        g_n = np.array([0.0, 0.0, gravity])
        force, rate, field = slice(0, 3), slice(3, 6), slice(6, 9)
        self._samples = samples = Polynomials(self.dim, length(places))
        for rows, bias in zip((force, rate, field), BIASES, strict=True):
            samples.add(rows, _EYE, places[bias])
        samples.add(rate, R_sb, w)
        samples.add(field, R_sb @ field_n)
        samples.add(field, np.einsum("ijkl,j->ikl", turn, field_n), q, q)
        samples.add(force, np.einsum("ij,jkl->ikl", R_sb, _swing(lever_arm_b)), w, w)
        samples.add(force, -R_sb @ g_n)
        samples.add(force, -np.einsum("ijkl,j->ikl", turn, g_n), q, q)
        samples.add(force, R_sb, a)
        if not body:
            samples.add(force, turn, a, q, q)

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        whole._samples = Polynomials.together([m._samples for m in members])
        return whole

    def __call__(self, x: Array, epoch: Index) -> Linearized:
        """Predicted samples, shape (..., 9), and H, shape (..., 9, n)."""
        return self._samples(x)


def _swing(lever_arm_b: Array) -> Array:
    """w x (w x l) = w (w.l) - l (w.w) as a quadratic form of w, shape (3, 3, 3)."""
    along = np.einsum("ij,k->ijk", _EYE, lever_arm_b)
    return np.asarray(along - np.einsum("i,jk->ijk", lever_arm_b, _EYE))


class Accelerometer:
    """The first three of (3.14) where attitude and rate are given (4.1).

    Parameters
    ----------
    places : layout of the state
    R_bs, lever_arm_b, gravity : as of `Mti`
    known : attitude and rate at the IMU's epochs
    """

    dim = 3

    def __init__(self, places: Layout, R_bs: Array, lever_arm_b: Array, gravity: float, known: KnownMotion) -> None:
        g_n = np.array([0.0, 0.0, gravity])
        self._H = np.zeros((3, length(places)))
        self._H[:, places["a"]], self._H[:, places["acc_bias"]] = R_bs.T, _EYE
        force_b = centripetal(known.w_b, lever_arm_b) - rotate(transpose(known.R_nb), g_n)
        self._offset = Epochs(rotate(R_bs.T, force_b))

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        whole._H = np.stack([m._H for m in members])
        whole._offset = Epochs.together([m._offset for m in members])
        return whole

    def __call__(self, x: Array, epoch: Index) -> Linearized:
        """Predicted specific force, shape (..., 3), and H, shape (..., 3, n)."""
        return self._offset.at(epoch) + times(self._H, x), self._H


HEADING = 3  # its place among x, y, z, heading


@dataclass(frozen=True)
class Ping:
    """The DVL's measurements at one time.

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


def ping_rows(pings: Sequence[Ping]) -> Array:
    """Velocity and heading of each ping, NaN where it has none, and a last row of NaN; shape (n + 1, 4)."""
    rows = np.full((len(pings) + 1, HEADING + 1), np.nan)
    for row, ping in zip(rows, pings, strict=False):
        row[list(ping.rows)] = ping.z
    return rows


class DvlModel:
    """Velocity and heading that a filter's state predicts.

    Parameters
    ----------
    places : layout of the state
    body : velocity of the state is in b; False = in n
    sensors : of `rovgraph.sensors.instruments.instruments`, at the body's origin
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
        velocity, compass = sensors["dvl"].model, sensors["dvl_heading"].model
        assert isinstance(velocity, DvlVelocity) and isinstance(compass, CompassHeading)
        self._velocity, self._compass = velocity, compass
        self._places, self._body = places, body
        self._known = None if known is None else (Epochs(known.R_nb), Epochs(known.w_b))
        self._mount_in_heading = mount_in_heading
        self._means = {name: belief.mean for name, belief in beliefs.items()}

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        """Those of several filters side by side."""
        whole = copy.copy(members[0])
        arms, declinations = zip(*((m._velocity.lever_arm_b, m._compass.declination) for m in members), strict=True)
        whole._velocity = replace(whole._velocity, lever_arm_b=np.stack(arms))
        whole._compass = replace(whole._compass, declination=np.stack(declinations))
        whole._means = {name: np.stack([m._means[name] for m in members]) for name in whole._means}
        if whole._known is not None:
            R_nb, w_b = (Epochs.together(rows) for rows in zip(*(m._known or () for m in members), strict=True))
            whole._known = R_nb, w_b
        return whole

    def __call__(self, x: Array, epoch: Index, heading: bool) -> Linearized:
        """Predicted velocity and heading, shape (..., 4), and H, shape (..., 4, n); heading 0 where not wanted."""
        if x.ndim == 1:
            h, H = self(x[None], epoch, heading)
            return h[0], H[0]
        s = self._places
        R_nb, w_b = self._attitude(x, epoch)
        v_n = times(R_nb, x[:, s["v"]]) if self._body else x[:, s["v"]]
        nowhere = np.zeros((len(x), 6))
        state = State(R_nb, nowhere[:, :3], v_n, nowhere, self._calibration(x))
        h, H = np.zeros((len(x), HEADING + 1)), np.zeros((len(x), HEADING + 1, x.shape[1]))
        h[:, :HEADING], J = self._velocity.predict(state, w_b)
        H[:, :HEADING, s["v"]] = J[VELOCITY] @ R_nb if self._body else J[VELOCITY]
        slopes = [(slice(0, HEADING), J)]
        if heading:
            if not self._mount_in_heading:
                state = replace(state, calibration=self._means)
            h[:, HEADING:], J = self._compass.predict(state, w_b)
            slopes.append((slice(HEADING, None), J))
        if "q" in s:
            H[:, :HEADING, s["w"]] = -slopes[0][1][BIAS][..., 3:]  # the rate enters as rate less bias
            by_q = 2.0 * transpose(rate_matrix(unit(x[:, s["q"]])))
            for rows, J in slopes[int(self._body) :]:  # a velocity in b is seen alike at any attitude
                H[:, rows, s["q"]] = J[POSE][..., :3] @ by_q
        if "mount" in s:
            for rows, J in slopes if self._mount_in_heading else slopes[:1]:
                H[:, rows, s["mount"]] = np.concatenate([J[name] for name in MOUNT], axis=-1)
        return h, H

    def _attitude(self, x: Array, epoch: Index) -> tuple[Array, Array]:
        if self._known is not None:
            R_nb, w_b = (given.at(epoch) for given in self._known)
            return R_nb.reshape(-1, 3, 3), w_b.reshape(-1, 3)
        return matrix(unit(x[:, self._places["q"]])), x[:, self._places["w"]]

    def _calibration(self, x: Array) -> dict[str, Array]:
        if "mount" not in self._places:
            return self._means
        angles = x[:, self._places["mount"]]
        return self._means | {name: angles[:, k : k + 1] for k, name in enumerate(MOUNT)}
