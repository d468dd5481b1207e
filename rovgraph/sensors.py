"""Measurement models, each written once.

Every model is a frozen object with ``predict(state, rate_b) -> (z, Jacobians)`` that
broadcasts over epochs. The simulator samples it, the graph linearises it, filters update
with it and observability analysis stacks it. Calibration variables are read from
``state.calibration``; derivatives are given for all that a model depends on.

===========  =========================================================  ==================
sensor       equation                                                   source
===========  =========================================================  ==================
dvl          z = (1 + k) R_sb (R_bn v_n + (w - b_g) x (l + dl))         (3.16), (3.17)
dvl_water    the same with v_n - c_n, c the current
dvl_heading  z = h + A + B sin h + C cos h, h = heading - declination   (3.17); deviation
ahrs         the same with the IMU's x axis                             curve: Bowditch
mag          z = |H| ((1 + s) S R_sb R_bn u(declination - A - ..., dip + d) + iron)
                                                                        (3.11), (3.14),
                                                                        S: (3.2)
depth        z = p_d + (R_nb l)_d + offset
fix          z = (p + R_nb l)_north,east
place        z = (p + R_nb l)_north,east - m, m where the place is;
             0 is what seeing it again says
===========  =========================================================  ==================

Signs follow the corrected equations: declination is atan2(H_e, H_n), and the heading is
clockwise from north.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rovgraph.calibration import MOUNT
from rovgraph.geometry import Array, cross, identities, identity, matrix_from_rpy, rotate, skew, transpose, wrap_angle
from rovgraph.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY, Jacobians, State


class SensorModel(Protocol):
    """What estimators, simulator and studies know of a sensor.

    Attributes
    ----------
    sensor : name of the log stream
    dim : number of components
    angular : components are angles, differences wrap
    state : state variables it depends on, at its own time or through the motion to it
    calibration : names of the calibration variables it depends on
    """

    @property
    def sensor(self) -> str: ...
    @property
    def dim(self) -> int: ...
    @property
    def angular(self) -> bool: ...
    @property
    def state(self) -> tuple[str, ...]: ...
    @property
    def calibration(self) -> tuple[str, ...]: ...

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        """The measurement that the state predicts, and its derivatives.

        Parameters
        ----------
        state : State of n epochs
        rate_b : ndarray, shape (n, 3), measured angular rate in body axes, its bias still
            in it [rad/s]

        Returns
        -------
        z : ndarray, shape (n, dim)
        jacobians : variable -> ndarray, shape (n, dim, dim of variable)
        """
        ...


def innovation(model: SensorModel, z: Array, predicted: Array) -> Array:
    """Measured minus predicted, angles wrapped; shape (n, dim)."""
    return wrap_angle(z - predicted) if model.angular else z - predicted


def _scalar(state: State, name: str) -> Array:
    """A scalar calibration variable for each epoch, shape (n,)."""
    return np.zeros(len(state)) + state.calibration[name][..., 0]


def dvl_mount(state: State) -> tuple[Array, Array]:
    """R_bs of the DVL for each epoch, and the axes (in b) its angles turn about.

    Returns
    -------
    R_bs : ndarray, shape (n, 3, 3)
    axes : ndarray, shape (n, 3, 3), a column each for roll, pitch, yaw
    """
    rpy, axes = np.empty((len(state), 3)), np.zeros((len(state), 3, 3))
    for k, name in enumerate(MOUNT):
        rpy[:, k] = state.calibration[name][..., 0]
    R_bs, yaw = matrix_from_rpy(rpy), rpy[:, 2]
    axes[:, :, 0] = R_bs[:, :, 0]
    axes[:, 0, 1], axes[:, 1, 1] = -np.sin(yaw), np.cos(yaw)
    axes[:, 2, 2] = 1.0
    return R_bs, axes


@dataclass(frozen=True)
class DvlVelocity:
    """Velocity of the DVL in its own axes, over ground (3.17) or relative to the water.

    Attributes
    ----------
    lever_arm_b : ndarray, shape (3,) or (n, 3), DVL relative to the state's origin [m]
    sensor : "dvl" over ground, "dvl_water" relative to the water
    """

    lever_arm_b: Array
    sensor: str = "dvl"
    dim = 3
    angular = False
    state = (POSE, VELOCITY, BIAS)

    @property
    def calibration(self) -> tuple[str, ...]:
        own = ("dvl_roll", "dvl_pitch", "dvl_yaw", "dvl_scale", "dvl_lever_arm")
        return (*own, "current") if self.sensor == "dvl_water" else own

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        R_bs, axes = dvl_mount(state)
        R_bn, v_n = transpose(state.R_nb), state.v_n
        if self.sensor == "dvl_water":
            v_n = v_n.copy()
            v_n[:, :2] -= state.calibration["current"]
        body, w = rotate(R_bn, v_n), rate_b - state.bias[:, 3:]
        arm = skew(self.lever_arm_b + state.calibration["dvl_lever_arm"])
        v_b = body - rotate(arm, w)
        gain = (1.0 + _scalar(state, "dvl_scale"))[:, None]
        R_sb = transpose(R_bs) * gain[..., None]

        pose, bias = np.zeros((len(state), 3, 6)), np.zeros((len(state), 3, 6))
        pose[..., :3] = R_sb @ skew(body)
        bias[..., 3:] = R_sb @ arm
        z, by_angle = rotate(R_sb, v_b), R_sb @ skew(v_b) @ axes
        H = {POSE: pose, VELOCITY: R_sb @ R_bn, BIAS: bias, "dvl_lever_arm": R_sb @ skew(w)}
        H |= {name: by_angle[..., k : k + 1] for k, name in enumerate(MOUNT)}
        H["dvl_scale"] = (z / gain)[..., None]
        if self.sensor == "dvl_water":
            H["current"] = -H[VELOCITY][..., :2]
        return z, H


def _heading(R_nb: Array, axis_b: Array) -> tuple[Array, Array]:
    """Heading of a body axis, and its derivative with respect to a rotation of the axis.

    Parameters
    ----------
    R_nb : ndarray, shape (n, 3, 3)
    axis_b : ndarray, shape (n, 3) or (3,)

    Returns
    -------
    heading : ndarray, shape (n,) [rad], clockwise from north
    gradient_b : ndarray, shape (n, 3): heading changes by ``gradient_b @ dtheta_b``
    """
    u = rotate(R_nb, axis_b)
    north, east = u[:, :1], u[:, 1:2]
    # du = R_nb (dtheta x axis), dh = (north de - east dn) / (north^2 + east^2)
    across_b = (north * R_nb[:, 1] - east * R_nb[:, 0]) / (north**2 + east**2)
    return np.arctan2(u[:, 1], u[:, 0]), cross(axis_b, across_b)


def _deviation(state: State, offset: str, curve: str, heading: Array) -> tuple[Array, Array, Array]:
    """Compass deviation A + B sin h + C cos h, its slope over h, and (sin h, cos h)."""
    A = _scalar(state, offset)
    B, C = state.calibration[curve][..., 0], state.calibration[curve][..., 1]
    sine, cosine = np.sin(heading), np.cos(heading)
    both = np.empty((len(heading), 2))
    both[:, 0], both[:, 1] = sine, cosine
    return A + B * sine + C * cosine, B * cosine - C * sine, both


@dataclass(frozen=True)
class CompassHeading:
    """Magnetic heading of an instrument's x axis with its deviation curve.

    Attributes
    ----------
    sensor : "ahrs" or "dvl_heading"
    offset, curve : names of its calibration variables
    declination : [rad], east positive; one for all epochs or for each
    R_bs : ndarray, shape (3, 3), mounting of the instrument; the DVL's own comes from
        the calibration variables instead
    """

    sensor: str
    offset: str
    curve: str
    declination: float | Array
    R_bs: Array = field(default_factory=lambda: np.eye(3))
    dim = 1
    angular = True
    state = (POSE, BIAS)

    @property
    def calibration(self) -> tuple[str, ...]:
        mount = MOUNT if self.sensor == "dvl_heading" else ()
        return (self.offset, self.curve, *mount)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        n = len(state)
        R_bs, axes = dvl_mount(state) if self.sensor == "dvl_heading" else (self.R_bs, None)
        heading, gradient = _heading(state.R_nb, R_bs[..., 0])
        heading = heading - self.declination
        deviation, slope, sine_cosine = _deviation(state, self.offset, self.curve, heading)
        gradient = gradient * (1.0 + slope)[:, None]

        pose = np.zeros((n, 1, 6))
        pose[:, 0, :3] = gradient
        H = {POSE: pose, self.offset: np.ones((n, 1, 1)), self.curve: sine_cosine[:, None, :]}
        if axes is not None:
            by_angle = pose[..., :3] @ axes
            H |= {name: by_angle[..., k : k + 1] for k, name in enumerate(MOUNT)}
        return wrap_angle(heading + deviation)[:, None], H


def field_direction(declination: Array | float, dip: Array | float) -> Array:
    """Unit vector of the magnetic field in n, shape (..., 3)."""
    d, i = np.broadcast_arrays(np.asarray(declination, float), np.asarray(dip, float))
    return np.stack([np.cos(i) * np.cos(d), np.cos(i) * np.sin(d), np.sin(i)], axis=-1)


def _field_turns(declination: Array, dip: Array) -> Array:
    """`field_direction`, its derivative by the dip and that by the declination as columns, shape (n, 3, 3)."""
    cos_d, sin_d, cos_i, sin_i = np.cos(declination), np.sin(declination), np.cos(dip), np.sin(dip)
    out = np.zeros((len(dip), 3, 3))
    out[:, 0, 0], out[:, 1, 0], out[:, 2, 0] = cos_i * cos_d, cos_i * sin_d, sin_i
    out[:, 0, 1], out[:, 1, 1], out[:, 2, 1] = -sin_i * cos_d, -sin_i * sin_d, cos_i
    out[:, 0, 2], out[:, 1, 2] = -out[:, 1, 0], out[:, 0, 0]
    return out


_ROW, _COLUMN = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]  # of a symmetric matrix's six components
_SYMMETRIC = np.zeros((6, 3, 3))  # the matrix of each
_SYMMETRIC[range(6), _ROW, _COLUMN] = _SYMMETRIC[range(6), _COLUMN, _ROW] = 1.0
_TIMES_VECTOR = _SYMMETRIC.transpose(2, 1, 0).reshape(3, 18)


def _symmetric(components: Array) -> Array:
    """Symmetric matrices of components xx, yy, zz, xy, xz, yz; shape (..., 6) to (..., 3, 3)."""
    return np.asarray((components @ _SYMMETRIC.reshape(6, 9)).reshape(*components.shape[:-1], 3, 3))


@dataclass(frozen=True)
class MagneticField:
    """Magnetometer vector in IMU axes (3.14), soft iron beyond its calibration (3.2) a symmetric matrix.

    Attributes
    ----------
    declination, dip : [rad], declination east positive, dip down positive
    magnitude : length of the field, in the log's unit
    R_bs : ndarray, shape (3, 3), mounting of the IMU
    """

    declination: float
    dip: float
    magnitude: float
    R_bs: Array = field(default_factory=lambda: np.eye(3))
    sensor = "mag"
    dim = 3
    angular = False
    state = (POSE, BIAS)
    calibration = ("mag_offset", "mag_deviation", "hard_iron", "soft_iron", "field_dip", "field_scale")

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        heading, gradient = _heading(state.R_nb, self.R_bs[:, 0])
        heading = heading - self.declination
        deviation, slope, sine_cosine = _deviation(state, "mag_offset", "mag_deviation", heading)
        turns_n = _field_turns(self.declination - deviation, self.dip + _scalar(state, "field_dip"))
        gain = (1.0 + _scalar(state, "field_scale"))[:, None]
        unsoftened = self.magnitude * gain[..., None] * self.R_bs.T
        R_sb = (identity(3) + _symmetric(state.calibration["soft_iron"])) @ unsoftened
        turns_b = transpose(state.R_nb) @ turns_n
        u_b, seen = turns_b[..., 0], R_sb @ turns_b
        field, by_dip, by_deviation = seen[..., 0], seen[..., 1:2], -seen[..., 2:]

        pose, iron = np.zeros((len(state), 3, 6)), np.zeros((len(state), 3, 3))
        pose[..., :3] = R_sb @ skew(u_b) + by_deviation * (slope[:, None] * gradient)[:, None, :]
        iron[...] = self.magnitude * identity(3)
        H = {
            POSE: pose,
            "mag_offset": by_deviation,
            "mag_deviation": by_deviation * sine_cosine[:, None, :],
            "hard_iron": iron,
            "soft_iron": (rotate(unsoftened, u_b) @ _TIMES_VECTOR).reshape(-1, 3, 6),
            "field_dip": by_dip,
            "field_scale": (field / gain)[..., None],
        }
        return field + self.magnitude * state.calibration["hard_iron"], H


def _point(state: State, lever_arm_b: Array) -> tuple[Array, Array]:
    """Position of a point on the vehicle, shape (n, 3), and its derivative by the pose, shape (n, 3, 6)."""
    by_pose = np.concatenate([-state.R_nb @ skew(lever_arm_b), state.R_nb], axis=-1)
    return state.p_n + rotate(state.R_nb, lever_arm_b), by_pose


@dataclass(frozen=True)
class Position:
    """Some of north, east, down of a point on the vehicle: depth sensor or position fix.

    Attributes
    ----------
    sensor : "depth" or "fix"
    lever_arm_b : ndarray, shape (3,), of the sensor relative to the state's origin [m]
    axes : indices of the components measured, (2,) for depth, (0, 1) for a fix
    offset : name of the calibration variable that is added, or None
    """

    sensor: str
    lever_arm_b: Array
    axes: tuple[int, ...]
    offset: str | None = None
    angular = False
    state = (POSE, VELOCITY, BIAS)

    @property
    def dim(self) -> int:
        return len(self.axes)

    @property
    def calibration(self) -> tuple[str, ...]:
        return () if self.offset is None else (self.offset,)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        rows = list(self.axes)
        point, pose = _point(state, self.lever_arm_b)
        z, H = point[:, rows], {POSE: pose[:, rows, :]}
        if self.offset is not None:
            z = z + state.calibration[self.offset]
            H[self.offset] = identities(len(state), self.dim)
        return z, H


@dataclass(frozen=True)
class PlaceOffset:
    """How far a camera or sonar is from a place that it recognises, north and east.

    Horizontally only: a pressure sensor knows the altitude better, and looking down from higher
    up shows the same place.

    Attributes
    ----------
    lever_arm_b : ndarray, shape (3,), of the camera relative to the state's origin [m]
    """

    lever_arm_b: Array
    sensor = "place"
    dim = PLACE_DIM
    angular = False
    state = (POSE, VELOCITY, BIAS, PLACE)
    calibration = ()

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        point, pose = _point(state, self.lever_arm_b)
        by_place = -identities(len(state), PLACE_DIM)
        return point[:, :PLACE_DIM] - state.calibration[PLACE], {POSE: pose[:, :PLACE_DIM], PLACE: by_place}
