"""Measurement models: what simulator, graph, filters and observability know of a sensor.

Every model is a frozen object with ``predict(state, rate_b) -> (z, Jacobians)`` that
broadcasts over epochs. The simulator samples it, the graph linearises it, filters update
with it and observability analysis stacks it. Calibration variables are read from
``state.calibration``; derivatives are given for all that a model depends on.

The equations and their sources stand in `rovgraph.kernels.measurements`. A model names its equation
(``kind``) and packs its own numbers for it (``packed``, which says in what order). A model may also be
written in NumPy, as `rovgraph.model_aiding` is.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import LAYOUT, MOUNT, calibration_size
from rovgraph.geometry import Array, matrix_from_rpy, wrap_angle
from rovgraph.kernels import measurements as kernels
from rovgraph.kernels.layout import MOTION
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


class CompiledModel(SensorModel, Protocol):
    """A model whose equation is one of `rovgraph.kernels.measurements`.

    Attributes
    ----------
    kind : the equation
    packed : ndarray, shape (1, k) or (n, k), the model's own numbers, for all epochs or for each
    """

    @property
    def kind(self) -> int: ...
    @property
    def packed(self) -> Array: ...


def evaluate(model: CompiledModel, by_state: tuple[str, ...], state: State, rate_b: Array) -> tuple[Array, Jacobians]:
    """Prediction and Jacobians of a compiled model, as `SensorModel.predict` gives them.

    Parameters
    ----------
    model : CompiledModel
    by_state : state variables that the Jacobians are given for; `PLACE` last

    Raises
    ------
    ValueError : arguments of different numbers of epochs
    """
    n, names, size = len(state), model.calibration, calibration_size()
    if PLACE in by_state:
        by_state, names = by_state[:-1], (*names, PLACE)
        size += PLACE_DIM
    columns, parts = _columns(by_state, names, size)
    c = _vector(state.calibration, names, size)
    given = (state.R_nb, state.p_n, state.v_n, state.bias, c, rate_b, model.packed)
    if not {len(values) for values in given} <= {1, n}:
        raise ValueError(f"{model.sensor}: cannot predict {n} epochs from arrays of {[len(v) for v in given]}")
    z, H = np.empty((n, model.dim)), np.empty((n, model.dim, len(columns)))
    kernels.predict_many(model.kind, *given, columns, z, H)
    return z, {name: H[..., own] for name, own in parts}


_STATE = {POSE: slice(0, 6), VELOCITY: slice(6, 9), BIAS: slice(9, 15)}


def _place(name: str, size: int) -> slice:
    """Of a variable in a calibration vector of some size; what is seen of places is its end."""
    return LAYOUT[name] if name != PLACE else slice(size - PLACE_DIM, size)


@cache
def _columns(
    by_state: tuple[str, ...], names: tuple[str, ...], size: int
) -> tuple[NDArray[np.int64], list[tuple[str, slice]]]:
    """Columns of all variables in a kernel's Jacobian, and the part of them that each variable has."""
    columns = [np.arange(_STATE[name].start, _STATE[name].stop) for name in by_state]
    columns += [MOTION + np.arange(own.start, own.stop) for own in (_place(name, size) for name in names)]
    ends = np.cumsum([len(own) for own in columns]).tolist()
    parts = [slice(end - len(own), end) for own, end in zip(columns, ends, strict=True)]
    return np.concatenate(columns), list(zip((*by_state, *names), parts, strict=True))


def _vector(calibration: Mapping[str, Array], names: tuple[str, ...], size: int) -> Array:
    """Calibration vectors of all epochs or of each, shape (1 or n, size); zero but for some variables."""
    values = [calibration[name] for name in names]
    c = np.zeros((max([len(value) for value in values if value.ndim == 2], default=1), size))
    for name, value in zip(names, values, strict=True):
        c[:, _place(name, size)] = value
    return c


def dvl_mounting(state: State) -> Array:
    """R_bs of the DVL for each epoch, shape (n, 3, 3)."""
    rpy = np.empty((len(state), 3))
    for k, name in enumerate(MOUNT):
        rpy[:, k] = state.calibration[name][..., 0]
    return matrix_from_rpy(rpy)


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
        return _DVL_WATER if self.sensor == "dvl_water" else _DVL

    @property
    def kind(self) -> int:
        return kernels.DVL_WATER if self.sensor == "dvl_water" else kernels.DVL

    @cached_property
    def packed(self) -> Array:
        """The lever arm."""
        return np.array(self.lever_arm_b, dtype=float, ndmin=2)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, self.state, state, rate_b)


_DVL = ("dvl_roll", "dvl_pitch", "dvl_yaw", "dvl_scale", "dvl_lever_arm")
_DVL_WATER = (*_DVL, "current")


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

    @property
    def kind(self) -> int:
        return kernels.DVL_COMPASS if self.sensor == "dvl_heading" else kernels.COMPASS

    @cached_property
    def packed(self) -> Array:
        """Declination, places of offset and curve in the calibration vector, the instrument's x axis in b."""
        declination = np.atleast_1d(self.declination)
        own = LAYOUT[self.offset].start, LAYOUT[self.curve].start, *self.R_bs[:, 0]
        return np.column_stack([declination, np.tile(own, (len(declination), 1))])

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE,), state, rate_b)


def field_direction(declination: Array | float, dip: Array | float) -> Array:
    """Unit vector of the magnetic field in n, shape (..., 3)."""
    d, i = np.broadcast_arrays(np.asarray(declination, float), np.asarray(dip, float))
    return np.stack([np.cos(i) * np.cos(d), np.cos(i) * np.sin(d), np.sin(i)], axis=-1)


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
    kind = kernels.MAGNETOMETER

    @cached_property
    def packed(self) -> Array:
        """Declination, dip, magnitude, the mounting row by row."""
        return np.array([[self.declination, self.dip, self.magnitude, *self.R_bs.ravel()]])

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE,), state, rate_b)


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
    kind = kernels.POSITION

    @property
    def dim(self) -> int:
        return len(self.axes)

    @property
    def calibration(self) -> tuple[str, ...]:
        return () if self.offset is None else (self.offset,)

    @cached_property
    def packed(self) -> Array:
        """The lever arm, the offset's place in the calibration vector or -1, the components measured."""
        offset = -1 if self.offset is None else LAYOUT[self.offset].start
        return np.array([[*self.lever_arm_b, offset, *self.axes]], dtype=float)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE,), state, rate_b)


@dataclass(frozen=True)
class PlaceOffset:
    """How far a camera or sonar is from a place that it recognises, north and east; 0 is what seeing it again says.

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
    kind = kernels.PLACE_OFFSET

    @cached_property
    def packed(self) -> Array:
        """The lever arm."""
        return np.array([self.lever_arm_b], dtype=float)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE, PLACE), state, rate_b)
