"""Measurements of a dive, linearised about states of its keyframes.

The equations are compiled (`rovgraph.kernels.linearization`): the state at a measurement's own time, the prediction
there, whitening. A model without a kernel takes the states at all its measurements' times at once, and returns
predictions and Jacobians there.

Robust losses are applied by reweighting: the weight of a measurement is
rho'(d) / d at its normalised length d (Huber 1964; Zhang 1997), times zero where it is
gated. The thresholds are where a good measurement of that dimension lies with 95 %.

A long dive is linearised in pieces, so that the Jacobians of a piece only are in memory.
"""

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.distributions import chi_square_quantile
from rovgraph.geometry import Array, rotate
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.linearization import linearize, place_measurements
from rovgraph.kernels.measurement_row import MeasuredRows
from rovgraph.kernels.states import States
from rovgraph.kernels.weighting import LOSSES, weight_many, whiten_many
from rovgraph.model.calibration import LAYOUT, TABLE, calibration_size
from rovgraph.model.state import BIAS, DIMENSION, PLACE, POSE, VELOCITY, Jacobians, State
from rovgraph.problem.calibration_roles import CalibrationRoles
from rovgraph.problem.motion import COLUMNS, SCALES
from rovgraph.problem.problem import Index, Problem
from rovgraph.sensors import SENSORS, AcousticExchange, DvlBeam, SensorModel, WaterLayer, innovation
from rovgraph.sensors.instruments import Instrument

Gates = dict[str, NDArray[np.bool_]]  # sensor -> which of its measurements are admitted
_COLUMNS = {POSE: slice(0, 6), VELOCITY: slice(6, 9), BIAS: slice(9, 15)}
_STATE = slice(9, 12), slice(12, 15), slice(15, 21)  # position, velocity and bias in a state vector
_FRAME = {"velocity": at.SEES_VELOCITY, "heading": at.SEES_HEADING, "position": at.SEES_POSITION}


def compiled(instrument: Instrument) -> bool:
    """Whether kernels have an instrument's equation."""
    return hasattr(instrument.model, "kind")


def sensor_table(instruments: Mapping[str, Instrument], given: Sequence[str]) -> Array:
    """A row for each sensor, shape (s, PARAMS + k); ``given`` are linearised outside the kernels."""
    packed = {
        s: np.zeros(0) if s in given else i.model.packed[0]  # type: ignore[attr-defined]
        for s, i in instruments.items()
    }
    out = np.zeros((len(instruments), at.PARAMS + max((len(p) for p in packed.values()), default=0)))
    for row, (sensor, instrument) in zip(out, instruments.items(), strict=True):
        model, dim, offset = instrument.model, instrument.model.dim, instrument.time_offset
        row[at.KIND] = at.PRELINEARISED if sensor in given else model.kind  # type: ignore[attr-defined]
        row[at.DIM] = dim
        row[at.LOSS], row[at.LOSS_THRESHOLD] = LOSSES.index(instrument.loss), loss_threshold(instrument.loss, dim)
        row[at.GATE] = np.inf if instrument.gate_sd is None else instrument.gate_sd
        row[at.READMIT] = instrument.readmit_s
        observed = SENSORS[sensor].observes
        row[at.SEEN_FRAME], row[at.SEES : at.SEES + 3] = _FRAME[observed.frame], np.isin(np.arange(3), observed.axes)
        gain = np.zeros((3, 3))
        if dim <= 3:
            gain[:dim, :dim] = instrument.rate_gain @ instrument.rate_gain.T
        row[at.GAIN : at.GAIN + 9] = gain.ravel()
        row[at.OFFSET] = -1.0 if offset is None else LAYOUT[offset].start
        row[at.PARAMS : at.PARAMS + len(packed[sensor])] = packed[sensor]
    return out


def kernel_states(state: State) -> States:
    """A state of n epochs as kernels take it."""
    walked = any(value.ndim > 1 for name, value in state.calibration.items() if name != PLACE)
    c = np.empty((len(state) if walked else 1, calibration_size()))
    for name, part in LAYOUT.items():
        c[:, part] = state.calibration[name]
    R, p, v, b = (np.require(a, float, ("C", "W")) for a in (state.R_nb, state.p_n, state.v_n, state.bias))
    return States(R, p, v, b, c)


@dataclass(frozen=True)
class KeyframeRows:
    """Measurements of one keyframe whose equations the kernels have.

    Attributes
    ----------
    measured : they
    sensors : ndarray, of `sensor_table`
    column : ndarray of int, shape (15 + C,), place of each component in the error, -1 where it is not estimated
    size : of the error
    gravity : [m/s^2]
    """

    measured: MeasuredRows
    sensors: Array
    column: Index
    size: int
    gravity: float

    def linearize(self, x: Array, c: Array, weighted: bool = False) -> tuple[Array, Array]:
        """Whitened innovations, shape (k,), and Jacobians, shape (k, size), on request weighted by the losses.

        Parameters
        ----------
        x, c : ndarray, shapes (21,), (C,), as of `rovgraph.inference.filter_step.Gaussian`
        """
        r = np.zeros(int(self.sensors[self.measured.which, at.DIM].sum()))
        H = np.zeros((len(r), self.size))
        p, v, b = (x[None, part].copy() for part in _STATE)
        states = States(x[:9].reshape(1, 3, 3), p, v, b, c[None])
        linearize(states, self.measured, self.sensors, self.column, self.gravity, weighted, r, H)
        return r, H


@dataclass(frozen=True)
class Measurements:
    """n measurements of one sensor.

    Attributes
    ----------
    problem, index : the dive, and ndarray of int, shape (n,), which of its measurements
    instrument : model, noise and loss
    gravity : [m/s^2]
    of_graph : the calibration variables of the whole graph
    """

    problem: Problem
    index: Index
    instrument: Instrument
    gravity: float
    of_graph: CalibrationRoles

    def __len__(self) -> int:
        return len(self.index)

    @property
    def keyframe(self) -> Index:
        """That each belongs to, shape (n,)."""
        return self.problem.keyframe[self.index]

    @property
    def line(self) -> Index:
        """Of each in the log, shape (n,)."""
        return self.problem.line[self.index]

    @property
    def place(self) -> Index:
        """Number of the place that is seen, -1 where none is, shape (n,)."""
        return self.problem.number[self.index]

    @property
    def believed(self) -> NDArray[np.bool_]:
        """False where the vehicle cannot have been: rejected unless the optimum fits them, shape (n,)."""
        return self.problem.believed[self.index]

    @property
    def time(self) -> Array:
        """Shape (n,) [s]."""
        return np.asarray(self.problem.rows[self.index, at.TIME])

    @property
    def z(self) -> Array:
        """Components, shape (n, dim)."""
        return self.problem.z(self.index, self.instrument.model.dim)

    @property
    def rate_b(self) -> Array:
        """Measured rate, bias still in it, shape (n, 3) [rad/s]."""
        return self.problem.rows[self.index, at.RATE : at.RATE + 3]

    @property
    def rate_sd(self) -> Array:
        """Its noise, shape (n,) [rad/s]."""
        return np.asarray(self.problem.rows[self.index, at.RATE_SD])

    @property
    def dt(self) -> Array:
        """Since the keyframe, shape (n,) [s]."""
        return np.asarray(self.problem.rows[self.index, at.DT])

    @cached_property
    def W(self) -> Array:
        """Square-root information, shape (n, dim, dim), lower triangular."""
        return whitening(self.instrument, self.problem.noise(self.index, self.instrument.model.dim), self.rate_sd)

    @property
    def may_be_late(self) -> bool:
        """Whether how late their stamps are is a variable, for which they have windows."""
        return self.problem.sensors[self.problem.which[self.index[0]]] in self.problem.lags if len(self) else False

    @cached_property
    def unknowns(self) -> CalibrationRoles:
        """The calibration variables that are estimated, of those that they depend on."""
        scales = SCALES if len(self.problem.row_scales) else ()
        return self.of_graph.of((*self.instrument.calibration, *scales))

    @property
    def variables(self) -> tuple[str, ...]:
        """Variables that the factors touch, in the order of their keys."""
        return (*self.instrument.model.state, *self.unknowns.estimated)

    def at(self, index: slice | Index) -> "Measurements":
        """Some of the measurements."""
        return replace(self, index=self.index[index])

    @property
    def model(self) -> SensorModel:
        """Their model, with what was known of the other ends, or of the beams."""
        model = self.instrument.model
        if isinstance(model, AcousticExchange | DvlBeam | WaterLayer):
            return model.of(self.problem.contexts(self.index))
        return model

    # predictions

    def predicted(self, state: State) -> Array:
        """Predicted measurements, shape (n, dim); ``state`` is at each one's keyframe."""
        there, rate_b, _ = self._placed(state, False)
        return self.model.predict(there, rate_b)[0]

    def innovations(self, state: State) -> Array:
        """Measured minus predicted, shape (n, dim)."""
        return innovation(self.model, self.z, self.predicted(state))

    def normalised(self, state: State) -> Array:
        """Whitened innovations, shape (n, dim)."""
        if not self._compiled:
            return rotate(self.W, self.innovations(state))
        return self._by_kernel(state, {})[0]

    def linearize(self, state: State) -> tuple[Array, Jacobians]:
        """Whitened innovations and Jacobians at ``state`` (that of each keyframe).

        Returns
        -------
        r : ndarray, shape (n, dim)
        H : variable -> ndarray, shape (n, dim, dim of variable)
        """
        if self._compiled:
            return self._by_kernel(state, self.variables)
        predicted, H = self.predict(state)
        r = rotate(self.W, innovation(self.instrument.model, self.z, predicted))
        zeros = (*predicted.shape, 0)
        return r, {v: self.W @ H[v] if v in H else np.zeros((*zeros[:2], DIMENSION[v])) for v in self.variables}

    def weighted(self, state: State, gate: NDArray[np.bool_]) -> tuple[Array, Jacobians]:
        """As `linearize`, weighted by the loss; zero beyond the gate."""
        r, H = self.linearize(state)
        root = np.sqrt(loss_and_weight(r, self.instrument.loss)[1] * gate)[:, None]
        return r * root, {v: h * root[..., None] for v, h in H.items()}

    def by_calibration(self, state: State, name: str) -> Array:
        """Whitened Jacobian by a calibration variable, estimated or not, shape (n, dim, dim of the variable)."""
        if self._compiled:
            return self._by_kernel(state, (name,))[1][name]
        return np.asarray(self.W @ self.predict(state)[1][name])

    def predict(self, state: State) -> tuple[Array, Jacobians]:
        """Predictions of a model without a kernel, shape (n, dim), and Jacobians by the keyframes' variables."""
        there, rate_b, F = self._placed(state, True)
        predicted, H = self.model.predict(there, rate_b)
        n, stacked = len(self), np.zeros((len(self), predicted.shape[1], MOTION))
        for variable, columns in _COLUMNS.items():
            if variable in H:
                stacked[..., columns] = H[variable]
        if self.may_be_late and self.instrument.time_offset is not None:
            slope, rate_slope = np.split(F[1].reshape(n, 12), [9], axis=1)
            by = rotate(stacked[..., :9], slope) - rotate(stacked[..., 12:], rate_slope)
            H = H | {self.instrument.time_offset: by[..., None]}
        stacked = stacked @ F[0]
        H = H | {variable: stacked[..., columns] for variable, columns in _COLUMNS.items()}
        if len(self.problem.row_scales):
            by_bias = H[BIAS] @ self.problem.row_scales[self.index]
            H |= {name: by_bias[..., COLUMNS[name]] for name in SCALES}
        return predicted, H

    def with_places(self, state: State, places: Mapping[int, Array]) -> State:
        """The state of each measurement's keyframe together with the place that is seen, where one is."""
        if PLACE not in self.instrument.model.state:
            return state
        return state.seeing(np.array([places[number] for number in self.place.tolist()]))

    @property
    def _compiled(self) -> bool:
        return compiled(self.instrument) and PLACE not in self.instrument.model.state

    @property
    def _for_kernels(self) -> tuple[MeasuredRows, Array]:
        """The measurements, and their sensor alone."""
        measured = self.problem.measured(self.index)._replace(which=np.zeros(len(self), np.int64))
        sensor = self.problem.sensors[self.problem.which[self.index[0]]] if len(self) else next(iter(SENSORS))
        return measured, sensor_table({sensor: self.instrument}, [] if self._compiled else [sensor])

    def _by_kernel(self, state: State, variables: Iterable[str]) -> tuple[Array, Jacobians]:
        """Whitened innovations and Jacobians by some variables."""
        n, dim = len(self), self.instrument.model.dim
        sizes = {v: DIMENSION[v] if v in DIMENSION else TABLE[v].dim for v in variables}
        ends = np.cumsum([*sizes.values()], dtype=np.int64).tolist()
        parts = {v: slice(end - sizes[v], end) for v, end in zip(sizes, ends, strict=True)}
        column = np.full(MOTION + calibration_size(), -1)
        for v, part in parts.items():
            columns = _COLUMNS[v] if v in _COLUMNS else slice(MOTION + LAYOUT[v].start, MOTION + LAYOUT[v].stop)
            column[columns] = np.arange(part.start, part.stop)
        width = ends[-1] if ends else 0
        r, H = np.zeros(n * dim), np.zeros((n * dim if width else 0, width))
        states = kernel_states(state)
        linearize(states, *self._for_kernels, column, self.gravity, False, r, H)
        return r.reshape(n, dim), {v: H[:, part].reshape(n, dim, -1) for v, part in parts.items()}

    def _placed(self, state: State, derive: bool) -> tuple[State, Array, tuple[Array, Array]]:
        """States at the measurements' own times, the rate there, and derivatives as of `place_measurements`."""
        n, states = len(self), kernel_states(state)
        shapes = (n, 3, 3), (n, 3), (n, 3), (n, 6), (n, 12)
        out, rate_b, F = States(*map(np.empty, shapes)), np.empty((n, 3)), np.zeros((n * derive, MOTION, MOTION))
        place_measurements(states, *self._for_kernels, self.gravity, out, rate_b, F)
        return State(out.R, out.p, out.v, out.b, state.calibration), rate_b, (F, out.c)


def whitening(instrument: Instrument, noise: Array, rate_sd: Array) -> Array:
    """Square-root information of measurements, the noise of the rate included.

    Parameters
    ----------
    instrument : Instrument
    noise : ndarray, shape (n, dim), sds of the components, of two (n, 3), with their covariance
    rate_sd : ndarray, shape (n,) [rad/s]

    Returns
    -------
    ndarray, shape (n, dim, dim), lower triangular
    """
    W = np.empty((len(noise), instrument.model.dim, instrument.model.dim))
    whiten_many(noise, instrument.rate_gain @ instrument.rate_gain.T, rate_sd, W)
    return W


@cache
def loss_threshold(loss: str, dim: int) -> float:
    """Normalised length at which a loss bends: where 95 % of good measurements lie below."""
    return float("inf") if loss == "none" else float(np.sqrt(chi_square_quantile(dim, 0.05)))


def loss_and_weight(r: Array, loss: str) -> tuple[Array, Array]:
    """Robust cost rho and weight rho'(d)/d of whitened innovations.

    Parameters
    ----------
    r : ndarray, shape (n, dim)
    loss : "none", "huber" or "cauchy"

    Returns
    -------
    rho, weight : ndarray, shape (n,); for "none" rho = d^2 / 2
    """
    return _cost_and_weight(np.sum(r**2, axis=1), loss, r.shape[1])


def loss_weight(d2: Array, loss: str, dim: int) -> Array:
    """Weight rho'(d)/d of innovations of ``dim`` components and squared length ``d2``, of any shape."""
    return _cost_and_weight(d2.ravel(), loss, dim)[1].reshape(d2.shape)


def _cost_and_weight(d2: Array, loss: str, dim: int) -> tuple[Array, Array]:
    rho, weight = np.empty(len(d2)), np.empty(len(d2))
    weight_many(d2, LOSSES.index(loss), loss_threshold(loss, dim), rho, weight)
    return rho, weight


Seen = Iterable[tuple[str, Measurements, State]]  # every sensor's, with the state of each measurement's keyframe


def gates_of(seen: Seen) -> Gates:
    """Which measurements lie within their gate."""
    out = {}
    for sensor, measured, state in seen:
        gate = measured.instrument.gate_sd or np.inf
        out[sensor] = np.linalg.norm(measured.normalised(state), axis=1) <= gate
    return out


def cost_at_gate(instrument: Instrument) -> float:
    """Robust cost of a measurement at its gate; infinite without a gate."""
    if instrument.gate_sd is None:
        return np.inf
    return float(_cost_and_weight(np.array([instrument.gate_sd**2]), instrument.loss, instrument.model.dim)[0][0])


def weights_of(seen: Seen, gates: Gates) -> dict[str, Array]:
    """Weight of every measurement, shape (n,) for each sensor."""
    return {
        sensor: loss_and_weight(measured.normalised(state), measured.instrument.loss)[1] * gates[sensor]
        for sensor, measured, state in seen
    }


def measurement_cost(seen: Seen, gates: Gates) -> float:
    """Robust cost of the admitted measurements."""
    return sum(
        float(loss_and_weight(measured.normalised(state), measured.instrument.loss)[0] @ gates[sensor])
        for sensor, measured, state in seen
    )


def measurements_of(
    problem: Problem,
    sensors: Container[str],
    instruments: Mapping[str, Instrument],
    gravity: float,
    unknowns: CalibrationRoles,
) -> dict[str, Measurements]:
    """The measurements of a dive, by sensor, of some sensors."""
    return {
        sensor: Measurements(problem, problem.of_sensor(sensor), instruments[sensor], gravity, unknowns)
        for sensor in problem.used
        if sensor in sensors
    }


LENGTH = 8192  # keyframes or measurements: their Jacobians by everything take a few kB each


def pieces(begin: int, end: int) -> Iterator[slice]:
    """The rows from ``begin`` to before ``end``, a piece after the other."""
    for first in range(begin, end, LENGTH):
        yield slice(first, min(first + LENGTH, end))
