"""Measurement models, which simulator, graph, filters and observability share.

Every model is a frozen object with ``predict(state, rate_b) -> (z, Jacobians)`` that
broadcasts over epochs. The simulator samples it, the graph linearises it, filters update
with it and observability analysis stacks it. Calibration variables are read from
``state.calibration``; derivatives are given for all that a model depends on.

The equations and their sources are in `rovgraph.kernels.measurements`. A model names its equation
(``kind``) and packs its own numbers for it (``packed``, whose docstring has the order). A model may also be
written in NumPy, as `rovgraph.sensors.thruster.ModelAiding` is.
"""

from collections.abc import Mapping
from functools import cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, wrap_angle
from rovgraph.kernels import measurements as kernels
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.states import States
from rovgraph.model.calibration import LAYOUT, calibration_size
from rovgraph.model.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY, Jacobians, State


class SensorModel(Protocol):
    """Measurement model of a sensor, for estimators, simulator and studies.

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
    R, p, v, b, c, rate, packed = (np.require(values, float, ("C", "W")) for values in given)
    kernels.predict_many(model.kind, States(R, p, v, b, c), rate, packed, columns, z, H)
    return z, {name: H[..., part] for name, part in parts}


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
    columns += [MOTION + np.arange(place.start, place.stop) for place in (_place(name, size) for name in names)]
    ends = np.cumsum([len(of_variable) for of_variable in columns]).tolist()
    parts = [slice(end - len(of_variable), end) for of_variable, end in zip(columns, ends, strict=True)]
    return np.concatenate(columns), list(zip((*by_state, *names), parts, strict=True))


def _vector(calibration: Mapping[str, Array], names: tuple[str, ...], size: int) -> Array:
    """Calibration vectors of all epochs or of each, shape (1 or n, size); zero but for some variables."""
    values = [calibration[name] for name in names]
    c = np.zeros((max([len(value) for value in values if value.ndim == 2], default=1), size))
    for name, value in zip(names, values, strict=True):
        c[:, _place(name, size)] = value
    return c
