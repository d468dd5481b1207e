"""The error of a state as one vector, and how it moves from one estimate to another.

The vector is the tangent space of `State`: pose, velocity, bias, then the calibration that
is estimated. A Kalman filter linearises at an estimate which it then corrects. Measured in
coordinates that turn with the correction, its errors become smaller than they are: it
takes its own corrections of heading, misalignment and hard iron for knowledge (Huang,
Mourikis and Roumeliotis 2010). An invariant filter chooses coordinates that stay (Barrau
and Bonnabel 2017). Here these are attitude and position in n, and for one variable of each
instrument the error of **what that instrument sees**: of velocity as the DVL sees it, of
hard iron as the field that the magnetometer sees, of a compass offset as the heading it
shows, of a current as the water's velocity along the vehicle's axes, which drag shows. A
measurement of it is linear in them whatever heading and mounting are, so correcting it
teaches nothing about those. `ErrorVector.retract` and `ErrorVector.local` move along these
coordinates and give the change of basis of the tangent space.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from rovgraph.calibration import LAYOUT, TABLE
from rovgraph.geometry import Array, exp_rotation, identities, log_rotation, rotate, transpose
from rovgraph.instruments import Instrument
from rovgraph.kernels.error_coordinates import ErrorLayout
from rovgraph.sensors import SENSORS, SensorModel, WaterVelocity, innovation
from rovgraph.state import BIAS, DIMENSION, POSE, VELOCITY, Jacobians, State

# the variable that each instrument sees directly: its model is linear in it, and depends on none that follows
SEEN = {s.name: s.linear_in for s in SENSORS.values() if s.linear_in is not None}


def seen_model(model: SensorModel) -> SensorModel:
    """The model that is linear in what its instrument sees: its own, but for a current, which shows in drag."""
    return WaterVelocity() if SEEN[model.sensor] == "current" else model


class ErrorVector:
    """Layout and geometry of the error of a state.

    Parameters
    ----------
    estimated : names of the calibration variables that are estimated
    instruments : the sensors in use, by stream

    Attributes
    ----------
    columns : variable -> slice of the vector
    size : length of the vector
    """

    def __init__(self, estimated: Iterable[str], instruments: Mapping[str, Instrument]) -> None:
        self._estimated = tuple(estimated)
        sizes = DIMENSION | {name: TABLE[name].dim for name in self._estimated}
        ends = np.cumsum(list(sizes.values())).tolist()
        self.columns = {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
        self.size: int = ends[-1]
        shown = {v: instruments[s] for s, v in SEEN.items() if s in instruments and v in self.columns}
        self._seen = [(seen_model(i.model), variable, self.columns[variable]) for variable, i in shown.items()]

    def layout(self) -> ErrorLayout:
        """What `rovgraph.kernels.error_coordinates` needs to know."""
        columns = [np.arange(15), *(15 + np.arange(LAYOUT[n].start, LAYOUT[n].stop) for n in self._estimated)]
        models: list[Any] = [model for model, _, _ in self._seen]  # all of them are compiled ones
        seen = [(model.kind, model.dim, own.start) for model, (_, _, own) in zip(models, self._seen, strict=True)]
        params = np.zeros((len(models), max((model.packed.shape[1] for model in models), default=0)))
        for row, model in zip(params, models, strict=True):
            row[: model.packed.shape[1]] = model.packed[0]
        rows = [np.arange(6), *(np.arange(own.start, own.stop) for _, _, own in self._seen)]
        return ErrorLayout(
            np.concatenate(columns), np.array(seen, np.int64).reshape(-1, 3), params, np.concatenate(rows)
        )

    def matrix(self, H: Jacobians) -> Array:
        """Jacobians by variable as one, shape (n, dim, size); what is not estimated is left out."""
        out = np.zeros((*next(iter(H.values())).shape[:2], self.size))
        for name, jacobian in H.items():
            if name in self.columns:
                out[..., self.columns[name]] = jacobian
        return out

    def retract(self, state: State, delta: Array) -> tuple[State, Array]:
        """The states that lie ``delta`` away.

        Parameters
        ----------
        state : State of n epochs
        delta : ndarray, shape (n, size)

        Returns
        -------
        state : State of n epochs
        basis : ndarray, shape (n, size, size), takes an error about the old state over to the new one,
            to first order in ``delta``
        """
        n, moved = len(state), self._straight(state, delta)
        both, basis = self._both(state, moved), self._turned(state, moved)
        for model, variable, columns in self._seen:
            z, H = model.predict(both, np.zeros((2 * n, 3)))
            jacobian = self.matrix(H)
            before, after = jacobian[:n], jacobian[n:]
            inverse = _inverse(after[..., columns])
            missing = innovation(model, z[:n] + rotate(before, delta), z[n:])
            moved = moved.retract(variable, rotate(inverse, missing))
            basis[:, columns] = _seen_alike(before, after, columns, inverse, basis)
        return moved, basis

    def local(self, state: State, other: State) -> tuple[Array, Array]:
        """The errors that lead from some states to others: the inverse of `retract`.

        Parameters
        ----------
        state, other : State of n epochs each

        Returns
        -------
        delta : ndarray, shape (n, size)
        basis : ndarray, shape (n, size, size), takes an error about ``other`` over to ``state``
        """
        n, delta = len(state), self._difference(state, other)
        both, basis = self._both(state, other), self._turned(other, state)
        for model, _, columns in self._seen:
            z, H = model.predict(both, np.zeros((2 * n, 3)))
            jacobian = self.matrix(H)
            at_state, at_other = jacobian[:n], jacobian[n:]
            inverse = _inverse(at_state[..., columns])
            missing = innovation(model, z[n:], z[:n]) - rotate(at_state, delta)
            delta[:, columns] += rotate(inverse, missing)
            basis[:, columns] = _seen_alike(at_other, at_state, columns, inverse, basis)
        return delta, basis

    def _straight(self, state: State, delta: Array) -> State:
        """All variables moved by themselves."""
        part = {name: delta[:, columns] for name, columns in self.columns.items()}
        return State(
            state.R_nb @ exp_rotation(part[POSE][:, :3]),
            state.p_n + rotate(state.R_nb, part[POSE][:, 3:]),
            state.v_n + part[VELOCITY],
            state.bias + part[BIAS],
            {**state.calibration, **{name: state.calibration[name] + part[name] for name in self._estimated}},
        )

    def _difference(self, state: State, other: State) -> Array:
        """The inverse of `_straight`."""
        R_bn = transpose(state.R_nb)
        of_motion = (
            log_rotation(R_bn @ other.R_nb),
            rotate(R_bn, other.p_n - state.p_n),
            other.v_n - state.v_n,
            other.bias - state.bias,
        )
        own = [_of_each(other, name) - _of_each(state, name) for name in self._estimated]
        return np.concatenate([*of_motion, *own], axis=1)

    def _both(self, state: State, other: State) -> State:
        """The states of n epochs after those of n others; what is not estimated stays as it is."""
        own = {name: np.concatenate([_of_each(state, name), _of_each(other, name)]) for name in self._estimated}
        return State(
            np.concatenate([state.R_nb, other.R_nb]),
            np.concatenate([state.p_n, other.p_n]),
            np.concatenate([state.v_n, other.v_n]),
            np.concatenate([state.bias, other.bias]),
            {**state.calibration, **own},
        )

    def _turned(self, state: State, other: State) -> Array:
        """The change of basis from one state to another, attitude and position in n staying; no more is known yet."""
        basis = identities(len(state), self.size)
        basis[:, :3, :3] = basis[:, 3:6, 3:6] = transpose(other.R_nb) @ state.R_nb
        return basis


def _of_each(state: State, name: str) -> Array:
    """A calibration variable of every epoch, shape (n, dim)."""
    value = state.calibration[name]
    return value if value.ndim == 2 else np.tile(value, (len(state), 1))


def _inverse(matrices: Array) -> Array:
    """Of shape (n, d, d); a reciprocal where d is 1."""
    return np.asarray(1.0 / matrices if matrices.shape[-1] == 1 else np.linalg.inv(matrices))


def _seen_alike(before: Array, after: Array, columns: slice, inverse: Array, basis: Array) -> Array:
    """Rows of a basis for the variable that an instrument sees: ``after @ basis = before``.

    Parameters
    ----------
    before, after : ndarray, shape (n, dim, size), the instrument's Jacobians at the two states
    columns, inverse : place of the variable, and the inverse of its part of ``after``
    basis : ndarray, shape (n, size, size), complete for all else that the instrument depends on
    """
    others = after.copy()
    others[..., columns] = 0.0
    return np.asarray(inverse @ (before - others @ basis))
