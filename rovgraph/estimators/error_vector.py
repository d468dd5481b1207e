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

import numpy as np

from rovgraph.calibration import TABLE
from rovgraph.geometry import Array, exp_rotation, log_rotation, rotate, transpose
from rovgraph.instruments import Instrument
from rovgraph.model_aiding import WaterVelocity
from rovgraph.sensors import SensorModel, innovation
from rovgraph.state import BIAS, DIMENSION, POSE, VELOCITY, Jacobians, State

# the variable that each instrument sees directly: its model is linear in it, and depends on none that follows
SEEN = {
    "dvl": VELOCITY,
    "mag": "hard_iron",
    "ahrs": "ahrs_offset",
    "dvl_heading": "dvl_compass_offset",
    "thruster": "current",
    "dvl_water": "current",
}
_NO_RATE = np.zeros((2, 3))


def seen_model(model: SensorModel) -> SensorModel:
    """The model that is linear in what its instrument sees: its own, but for a current, which shows in drag."""
    return WaterVelocity() if SEEN[model.sensor] == "current" else model


class ErrorVector:
    """Layout and geometry of the error of a state of one epoch.

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

    def matrix(self, H: Jacobians) -> Array:
        """Jacobians by variable as one, shape (n, dim, size); what is not estimated is left out."""
        out = np.zeros((*next(iter(H.values())).shape[:2], self.size))
        for name, jacobian in H.items():
            if name in self.columns:
                out[..., self.columns[name]] = jacobian
        return out

    def retract(self, state: State, delta: Array) -> tuple[State, Array]:
        """The state that lies ``delta`` away.

        Parameters
        ----------
        state : State of one epoch
        delta : ndarray, shape (size,)

        Returns
        -------
        state : State of one epoch
        basis : ndarray, shape (size, size), takes an error about the old state over to the new one,
            to first order in ``delta``
        """
        moved = self._straight(state, delta)
        both, basis = self._both(state, moved), self._turned(state, moved)
        for model, variable, columns in self._seen:
            z, H = model.predict(both, _NO_RATE)
            before, after = self.matrix(H)
            inverse = np.linalg.inv(after[:, columns])
            missing = innovation(model, z[0] + before @ delta, z[1])
            moved = moved.retract(variable, inverse @ missing)
            basis[columns] = _seen_alike(before, after, columns, inverse, basis)
        return moved, basis

    def local(self, state: State, other: State) -> tuple[Array, Array]:
        """The error that leads from one state to another: the inverse of `retract`.

        Parameters
        ----------
        state, other : State of one epoch each

        Returns
        -------
        delta : ndarray, shape (size,)
        basis : ndarray, shape (size, size), takes an error about ``other`` over to ``state``
        """
        delta = self._difference(state, other)
        both, basis = self._both(state, other), self._turned(other, state)
        for model, _, columns in self._seen:
            z, H = model.predict(both, _NO_RATE)
            at_state, at_other = self.matrix(H)
            inverse = np.linalg.inv(at_state[:, columns])
            missing = innovation(model, z[1], z[0]) - at_state @ delta
            delta[columns] += inverse @ missing
            basis[columns] = _seen_alike(at_other, at_state, columns, inverse, basis)
        return delta, basis

    def _straight(self, state: State, delta: Array) -> State:
        """All variables moved by themselves."""
        part = {name: delta[columns] for name, columns in self.columns.items()}
        return State(
            state.R_nb @ exp_rotation(part[POSE][None, :3]),
            state.p_n + rotate(state.R_nb, part[POSE][3:]),
            state.v_n + part[VELOCITY],
            state.bias + part[BIAS],
            {**state.calibration, **{name: state.calibration[name] + part[name] for name in self._estimated}},
        )

    def _difference(self, state: State, other: State) -> Array:
        """The inverse of `_straight`."""
        R_bn = transpose(state.R_nb)
        return np.concatenate(
            [
                log_rotation(R_bn @ other.R_nb)[0],
                rotate(R_bn, other.p_n - state.p_n)[0],
                other.v_n[0] - state.v_n[0],
                other.bias[0] - state.bias[0],
                *(other.calibration[name] - state.calibration[name] for name in self._estimated),
            ]
        )

    def _both(self, state: State, other: State) -> State:
        """Two states of one epoch as one `State`; what is not estimated stays as it is."""
        own = {name: np.array([state.calibration[name], other.calibration[name]]) for name in self._estimated}
        return State(
            np.concatenate([state.R_nb, other.R_nb]),
            np.concatenate([state.p_n, other.p_n]),
            np.concatenate([state.v_n, other.v_n]),
            np.concatenate([state.bias, other.bias]),
            {**state.calibration, **own},
        )

    def _turned(self, state: State, other: State) -> Array:
        """The change of basis from one state to another, attitude and position in n staying; no more is known yet."""
        basis = np.eye(self.size)
        basis[:3, :3] = basis[3:6, 3:6] = other.R_nb[0].T @ state.R_nb[0]
        return basis


def _seen_alike(before: Array, after: Array, columns: slice, inverse: Array, basis: Array) -> Array:
    """Rows of a basis for the variable that an instrument sees: ``after @ basis = before``.

    Parameters
    ----------
    before, after : ndarray, shape (dim, size), the instrument's Jacobians at the two states
    columns, inverse : place of the variable, and the inverse of its part of ``after``
    basis : ndarray, shape (size, size), complete for all else that the instrument depends on
    """
    others = after.copy()
    others[:, columns] = 0.0
    return np.asarray(inverse @ (before - others @ basis))
