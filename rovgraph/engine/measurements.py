"""The measurements of one sensor as arrays, linearised for all of them at once.

Robust losses are applied by reweighting: the weight of a measurement is
rho'(d) / d at its normalised length d (Huber 1964; Zhang 1997), times zero where it is
gated. The thresholds are where a good measurement of that dimension lies with 95 %.
"""

from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from rovgraph.engine.gauss_newton import Gates
from rovgraph.engine.late_stamp_window import LateStampWindow
from rovgraph.engine.problem import Problem, sd_of
from rovgraph.engine.scale import COLUMNS, SCALES, biased
from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array, rotate
from rovgraph.instruments import Instrument
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.weighting import LOSSES, weight_many, whiten_many
from rovgraph.sensors import innovation
from rovgraph.state import (
    BIAS,
    DIMENSION,
    PLACE,
    POSE,
    VELOCITY,
    Delta,
    Jacobians,
    State,
    propagate,
    propagate_with_jacobian,
)

_COLUMNS = {POSE: slice(0, 6), VELOCITY: slice(6, 9), BIAS: slice(9, 15)}


@dataclass(frozen=True)
class Block:
    """n measurements of one sensor.

    Attributes
    ----------
    instrument : model, noise and loss
    keyframe : ndarray of int, shape (n,)
    time, line : ndarray, shape (n,), and in the log
    z : ndarray, shape (n, dim)
    W : ndarray, shape (n, dim, dim), square-root information, lower triangular
    rate_b : ndarray, shape (n, 3), measured rate, bias still in it [rad/s]
    rate_sd : ndarray, shape (n,), its noise [rad/s]
    motion : Delta, n, from the keyframe to the measurement
    gravity : [m/s^2]
    unknowns : the calibration variables that are estimated, of those that the instrument has
    window : along which the motion goes on to where a stamp that may be late belongs, or None
    scale_to_bias : ndarray, shape (n, 6, 6), of `rovgraph.engine.scale`, or None where the IMU's scale is exact
    place, believed : ndarray of int and of bool, shape (n,), number of the place that is seen, -1 where none is, and
        False where the vehicle cannot have been there: it is not let in unless the optimum says otherwise
    """

    instrument: Instrument
    keyframe: NDArray[np.int64]
    time: Array
    line: NDArray[np.int64]
    z: Array
    W: Array
    rate_b: Array
    rate_sd: Array
    motion: Delta
    gravity: float
    unknowns: Unknowns
    place: NDArray[np.int64]
    believed: NDArray[np.bool_]
    window: LateStampWindow | None = None
    scale_to_bias: Array | None = None

    def __len__(self) -> int:
        return len(self.z)

    @property
    def variables(self) -> tuple[str, ...]:
        """Variables that the factors touch, in the order of their keys."""
        return (*self.instrument.model.state, *self.unknowns.estimated)

    @cached_property
    def at_keyframes(self) -> bool:
        """All measurements are at their keyframes: there is no motion to reckon with."""
        return self.window is None and not self.motion.dt.any()

    def predict(self, state: State) -> tuple[Array, Jacobians]:
        """Predicted measurements, shape (n, dim), and Jacobians by the keyframes' variables."""
        if self.scale_to_bias is not None:
            predicted, H = self._predict(biased(state, self.scale_to_bias))
            by_bias = H[BIAS] @ self.scale_to_bias if BIAS in H else np.zeros((*predicted.shape, 6))
            return predicted, H | {name: by_bias[..., COLUMNS[name]] for name in SCALES}
        return self._predict(state)

    def _predict(self, state: State) -> tuple[Array, Jacobians]:
        """The same, for an IMU without scale errors."""
        model = self.instrument.model
        if self.at_keyframes:
            return model.predict(state, self.rate_b)
        motion, rate_b = self._placed(state)
        there, F = propagate_with_jacobian(state, motion, self.gravity)
        predicted, H = model.predict(there, rate_b)
        if self.window is not None and self.instrument.time_offset is not None:
            by = self.window.by_time_offset(self._late(state), state, there, H, self.gravity)
            H = H | {self.instrument.time_offset: by}
        stacked = np.zeros((len(self), predicted.shape[1], 15))
        for variable, columns in _COLUMNS.items():
            if variable in H:
                stacked[..., columns] = H[variable]
        stacked = stacked @ F
        return predicted, H | {variable: stacked[..., columns] for variable, columns in _COLUMNS.items()}

    def predicted(self, state: State) -> Array:
        """Predicted measurements alone, shape (n, dim)."""
        if self.scale_to_bias is not None:
            state = biased(state, self.scale_to_bias)
        motion, rate_b = self._placed(state)
        there = state if self.at_keyframes else propagate(state, motion, self.gravity)
        return self.instrument.model.predict(there, rate_b)[0]

    def innovations(self, state: State) -> Array:
        """Measured minus predicted, shape (n, dim); ``state`` is at each one's keyframe."""
        return innovation(self.instrument.model, self.z, self.predicted(state))

    def by_calibration(self, state: State, name: str) -> Array:
        """Whitened Jacobian by a calibration variable, estimated or not, shape (n, dim, dim of the variable)."""
        there = state if self.at_keyframes else propagate(state, self._placed(state)[0], self.gravity)
        return np.asarray(self.W @ self.instrument.model.predict(there, self.rate_b)[1][name])

    def _placed(self, state: State) -> tuple[Delta, Array]:
        """The motion to where each measurement was valid, and the rate there."""
        return (self.motion, self.rate_b) if self.window is None else self.window.placed(self._late(state))

    def _late(self, state: State) -> Array:
        """How late each stamp is, shape (n,) [s]."""
        assert self.instrument.time_offset is not None
        return np.broadcast_to(state.calibration[self.instrument.time_offset][..., 0], len(self))

    def linearize(self, state: State) -> tuple[Array, Jacobians]:
        """Whitened innovations and Jacobians at ``state`` (that of each keyframe).

        Returns
        -------
        r : ndarray, shape (n, dim)
        H : variable -> ndarray, shape (n, dim, dim of variable)
        """
        predicted, H = self.predict(state)
        r = rotate(self.W, innovation(self.instrument.model, self.z, predicted))
        return r, {v: self.W @ H[v] if v in H else self._zeros(v) for v in self.variables}

    def _zeros(self, variable: str) -> Array:
        return np.zeros((*self.z.shape, DIMENSION[variable]))

    def normalised(self, state: State) -> Array:
        """Whitened innovations alone, shape (n, dim)."""
        return rotate(self.W, self.innovations(state))

    def weighted(self, state: State, gate: NDArray[np.bool_]) -> tuple[Array, Jacobians]:
        """As `linearize`, weighted by the loss; zero beyond the gate."""
        r, H = self.linearize(state)
        root = np.sqrt(loss_and_weight(r, self.instrument.loss)[1] * gate)[:, None]
        return r * root, {v: h * root[..., None] for v, h in H.items()}

    def with_places(self, state: State, places: Mapping[int, Array]) -> State:
        """The state of each measurement's keyframe together with the place that is seen, where one is."""
        if PLACE not in self.instrument.model.state:
            return state
        return state.seeing(np.array([places[number] for number in self.place.tolist()]))

    def at(self, index: slice | Array) -> "Block":
        """Some of the measurements."""
        arrays = {f.name: getattr(self, f.name)[index] for f in fields(self) if f.name in _PER_MEASUREMENT}
        motion = Delta(*(getattr(self.motion, f.name)[index] for f in fields(Delta)))
        window, scale_to_bias = (
            self.window and self.window.at(index),
            None if self.scale_to_bias is None else self.scale_to_bias[index],
        )
        return replace(self, **arrays, motion=motion, window=window, scale_to_bias=scale_to_bias)


_PER_MEASUREMENT = ("keyframe", "time", "line", "z", "W", "rate_b", "rate_sd", "place", "believed")


def make_block(
    problem: Problem, index: NDArray[np.int64], instrument: Instrument, gravity: float, unknowns: Unknowns
) -> Block:
    """Some measurements of one sensor; ``unknowns`` are those of the whole graph."""
    dim, rows, sensor = instrument.model.dim, problem.rows[index], problem.sensors[problem.which[index[0]]]
    sd, rate_sd = rows[:, sd_of(dim) : sd_of(dim) + dim], rows[:, at.RATE_SD]
    window, scales = None, problem.row_scales[index] if len(problem.row_scales) else None
    if sensor in problem.lags:
        knots = problem.windows[problem.window[index]]
        window = LateStampWindow.of(problem.lags[sensor], knots, problem.bias)
    return Block(
        instrument,
        problem.keyframe[index],
        rows[:, at.TIME],
        problem.line[index],
        rows[:, at.Z : at.Z + dim],
        whitening(instrument, sd, rate_sd),
        rows[:, at.RATE : at.RATE + 3],
        rate_sd,
        motions_of(rows),
        gravity,
        unknowns.of((*instrument.calibration, *(() if scales is None else SCALES))),
        problem.number[index],
        problem.believed[index],
        window,
        scales,
    )


def motions_of(rows: Array) -> Delta:
    """From their keyframes to n measurements, of rows of `rovgraph.kernels.measurement_row`, shape (n, ROW)."""
    dR, dv, dp = rows[:, at.DR : at.DV].reshape(-1, 3, 3), rows[:, at.DV : at.DP], rows[:, at.DP : at.ASSUMED]
    return Delta(rows[:, at.DT], dR, dv, dp, rows[:, at.ASSUMED : at.ASSUMED + 6])


def whitening(instrument: Instrument, sd: Array, rate_sd: Array) -> Array:
    """Square-root information of measurements, the noise of the rate included.

    Parameters
    ----------
    instrument : Instrument
    sd : ndarray, shape (n, dim)
    rate_sd : ndarray, shape (n,) [rad/s]

    Returns
    -------
    ndarray, shape (n, dim, dim), lower triangular
    """
    W = np.empty((*sd.shape, sd.shape[1]))
    whiten_many(sd, instrument.rate_gain @ instrument.rate_gain.T, rate_sd, W)
    return W


@cache
def loss_threshold(loss: str, dim: int) -> float:
    """Normalised length at which a loss bends: where 95 % of good measurements lie below."""
    return float("inf") if loss == "none" else float(np.sqrt(chdtri(dim, 0.05)))


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


Seen = Iterable[tuple[str, Block, State]]  # every sensor's block, with the state of each measurement's keyframe


def gates_of(seen: Seen) -> Gates:
    """Which measurements lie within their gate."""
    out = {}
    for sensor, block, state in seen:
        gate = block.instrument.gate_sd or np.inf
        out[sensor] = np.linalg.norm(block.normalised(state), axis=1) <= gate
    return out


def cost_at_gate(instrument: Instrument) -> float:
    """Robust cost of a measurement at its gate; infinite where there is none."""
    if instrument.gate_sd is None:
        return np.inf
    return float(_cost_and_weight(np.array([instrument.gate_sd**2]), instrument.loss, instrument.model.dim)[0][0])


def weights_of(seen: Seen, gates: Gates) -> dict[str, Array]:
    """Weight of every measurement, shape (n,) for each sensor."""
    return {
        sensor: loss_and_weight(block.normalised(state), block.instrument.loss)[1] * gates[sensor]
        for sensor, block, state in seen
    }


def measurement_cost(seen: Seen, gates: Gates) -> float:
    """Robust cost of the measurements that are let in."""
    return sum(
        float(loss_and_weight(block.normalised(state), block.instrument.loss)[0] @ gates[sensor])
        for sensor, block, state in seen
    )


def blocks_of(
    problem: Problem,
    sensors: Container[str],
    instruments: Mapping[str, Instrument],
    gravity: float,
    unknowns: Unknowns,
) -> dict[str, Block]:
    """The measurements of a dive, by sensor, of some sensors."""
    return {
        sensor: make_block(problem, problem.of_sensor(sensor), instruments[sensor], gravity, unknowns)
        for sensor in problem.used
        if sensor in sensors
    }
