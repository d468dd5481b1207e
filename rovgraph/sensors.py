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
===========  =========================================================  ==================

Signs follow the corrected equations: declination is atan2(H_e, H_n), and the heading is
clockwise from north.
"""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from rovgraph.geometry import Array, cross, matrix_from_rpy, rotate, skew, transpose, wrap_angle
from rovgraph.state import BIAS, POSE, VELOCITY, Jacobians, State

_EZ = np.array([0.0, 0.0, 1.0])


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


def dvl_mount(state: State) -> tuple[Array, Jacobians]:
    """R_bs of the DVL for each epoch, and the axes (in b) its angles turn about.

    Returns
    -------
    R_bs : ndarray, shape (n, 3, 3)
    axes : variable -> ndarray, shape (n, 3)
    """
    roll, pitch, yaw = (_scalar(state, f"dvl_{angle}") for angle in ("roll", "pitch", "yaw"))
    zero = np.zeros_like(yaw)
    R_bs = matrix_from_rpy(np.stack([roll, pitch, yaw], axis=-1))
    pitch_axis = np.stack([-np.sin(yaw), np.cos(yaw), zero], axis=-1)
    axes = {"dvl_roll": R_bs[..., 0], "dvl_pitch": pitch_axis, "dvl_yaw": np.zeros_like(pitch_axis) + _EZ}
    return R_bs, axes


@dataclass(frozen=True)
class DvlVelocity:
    """Velocity of the DVL in its own axes, over ground (3.17) or relative to the water.

    Attributes
    ----------
    lever_arm_b : ndarray, shape (3,), DVL relative to the state's origin [m]
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
        n = len(state)
        R_bs, axes = dvl_mount(state)
        R_bn, v_n = transpose(state.R_nb), state.v_n.copy()
        if self.sensor == "dvl_water":
            v_n[:, :2] -= state.calibration["current"]
        body, w = rotate(R_bn, v_n), rate_b - state.bias[:, 3:]
        arm = np.broadcast_to(self.lever_arm_b + state.calibration["dvl_lever_arm"], (n, 3))
        v_b = body + cross(w, arm)
        gain = (1.0 + _scalar(state, "dvl_scale"))[:, None]
        R_sb = transpose(R_bs) * gain[..., None]

        pose, bias = np.zeros((n, 3, 6)), np.zeros((n, 3, 6))
        pose[..., :3] = R_sb @ skew(body)
        bias[..., 3:] = R_sb @ skew(arm)
        H = {POSE: pose, VELOCITY: R_sb @ R_bn, BIAS: bias, "dvl_lever_arm": R_sb @ skew(w)}
        for name, axis in axes.items():
            H[name] = -rotate(R_sb, cross(axis, v_b))[..., None]
        z = rotate(R_sb, v_b)
        H["dvl_scale"] = (z / gain)[..., None]
        if self.sensor == "dvl_water":
            H["current"] = -H[VELOCITY][..., :2]
        return z, H


def _heading(R_nb: Array, axis_b: Array) -> tuple[Array, Array]:
    """Heading of a body axis, and its derivative with respect to a rotation of the axis.

    Parameters
    ----------
    R_nb : ndarray, shape (n, 3, 3)
    axis_b : ndarray, shape (n, 3)

    Returns
    -------
    heading : ndarray, shape (n,) [rad], clockwise from north
    gradient_b : ndarray, shape (n, 3): heading changes by ``gradient_b @ dtheta_b``
    """
    u = rotate(R_nb, axis_b)
    across = np.stack([-u[:, 1], u[:, 0], np.zeros(len(u))], axis=-1) / (u[:, :1] ** 2 + u[:, 1:2] ** 2)
    # du = R_nb (dtheta x axis), dh = across . du
    gradient = cross(axis_b, rotate(transpose(R_nb), across))
    return np.arctan2(u[:, 1], u[:, 0]), gradient


def _deviation(state: State, offset: str, curve: str, heading: Array) -> tuple[Array, Array, Array]:
    """Compass deviation A + B sin h + C cos h, its slope over h, and (sin h, cos h)."""
    A = _scalar(state, offset)
    B, C = state.calibration[curve][..., 0], state.calibration[curve][..., 1]
    sine, cosine = np.sin(heading), np.cos(heading)
    return A + B * sine + C * cosine, B * cosine - C * sine, np.stack([sine, cosine], axis=-1)


@dataclass(frozen=True)
class CompassHeading:
    """Magnetic heading of an instrument's x axis with its deviation curve.

    Attributes
    ----------
    sensor : "ahrs" or "dvl_heading"
    offset, curve : names of its calibration variables
    declination : [rad], east positive
    R_bs : ndarray, shape (3, 3), mounting of the instrument; the DVL's own comes from
        the calibration variables instead
    """

    sensor: str
    offset: str
    curve: str
    declination: float
    R_bs: Array = field(default_factory=lambda: np.eye(3))
    dim = 1
    angular = True
    state = (POSE, BIAS)

    @property
    def calibration(self) -> tuple[str, ...]:
        mount = ("dvl_roll", "dvl_pitch", "dvl_yaw") if self.sensor == "dvl_heading" else ()
        return (self.offset, self.curve, *mount)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        n = len(state)
        if self.sensor == "dvl_heading":
            R_bs, axes = dvl_mount(state)
        else:
            R_bs, axes = np.tile(self.R_bs, (n, 1, 1)), {}
        heading, gradient = _heading(state.R_nb, R_bs[..., 0])
        heading = heading - self.declination
        deviation, slope, sine_cosine = _deviation(state, self.offset, self.curve, heading)
        gradient = gradient * (1.0 + slope)[:, None]

        pose = np.zeros((n, 1, 6))
        pose[:, 0, :3] = gradient
        H = {POSE: pose, self.offset: np.ones((n, 1, 1)), self.curve: sine_cosine[:, None, :]}
        for name, axis in axes.items():
            H[name] = np.einsum("ij,ij->i", gradient, axis)[:, None, None]
        return wrap_angle(heading + deviation)[:, None], H


def field_direction(declination: Array | float, dip: Array | float) -> Array:
    """Unit vector of the magnetic field in n, shape (..., 3)."""
    d, i = np.broadcast_arrays(np.asarray(declination, float), np.asarray(dip, float))
    return np.stack([np.cos(i) * np.cos(d), np.cos(i) * np.sin(d), np.sin(i)], axis=-1)


_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))  # places of a symmetric matrix's six components


def _symmetric(components: Array) -> Array:
    """Symmetric matrices of components xx, yy, zz, xy, xz, yz; shape (..., 6) to (..., 3, 3)."""
    out = np.zeros((*components.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(_PAIRS):
        out[..., i, j] = out[..., j, i] = components[..., k]
    return out


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
        n = len(state)
        heading, gradient = _heading(state.R_nb, np.tile(self.R_bs[:, 0], (n, 1)))
        heading = heading - self.declination
        deviation, slope, sine_cosine = _deviation(state, "mag_offset", "mag_deviation", heading)
        declination, dip = self.declination - deviation, self.dip + _scalar(state, "field_dip")
        u_n, dipped = field_direction(declination, dip), field_direction(declination, dip + 0.5 * np.pi)
        u_b = rotate(transpose(state.R_nb), u_n)
        turned = np.stack([-u_n[:, 1], u_n[:, 0], np.zeros(n)], axis=-1)  # du/d(declination)
        gain = self.magnitude * (1.0 + _scalar(state, "field_scale"))[:, None, None]
        softened = (np.eye(3) + _symmetric(state.calibration["soft_iron"])) @ self.R_bs.T
        R_sb = gain * softened
        by_deviation = -rotate(R_sb, rotate(transpose(state.R_nb), turned))

        pose = np.zeros((n, 3, 6))
        pose[..., :3] = R_sb @ skew(u_b) + by_deviation[..., None] * (slope[:, None] * gradient)[:, None, :]
        iron, along = state.calibration["hard_iron"], rotate(gain * self.R_bs.T, u_b)
        H = {
            POSE: pose,
            "mag_offset": by_deviation[..., None],
            "mag_deviation": by_deviation[..., None] * sine_cosine[:, None, :],
            "hard_iron": np.tile(self.magnitude * np.eye(3), (n, 1, 1)),
            "field_dip": rotate(R_sb, rotate(transpose(state.R_nb), dipped))[..., None],
            "field_scale": rotate(self.magnitude * softened, u_b)[..., None],
            "soft_iron": np.stack([_symmetric(one) @ along[..., None] for one in np.eye(6)], axis=-1)[..., 0, :],
        }
        return rotate(R_sb, u_b) + self.magnitude * iron, H


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
        z = (state.p_n + rotate(state.R_nb, self.lever_arm_b))[:, rows]
        pose = np.concatenate([-state.R_nb @ skew(self.lever_arm_b), state.R_nb], axis=-1)
        H = {POSE: pose[:, rows, :]}
        if self.offset is not None:
            z = z + state.calibration[self.offset]
            H[self.offset] = np.tile(np.eye(self.dim), (len(state), 1, 1))
        return z, H
