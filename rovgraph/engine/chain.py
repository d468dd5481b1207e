"""The smoother of a dive that closes no loop: a chain of keyframes with a border of constants.

Each iteration linearises all motions and measurements in compiled kernels and eliminates them in the order of time
(`rovgraph.kernels.chain`). Calibration that walks is a part of each keyframe, what is constant is the border. The
factors are those of the graph that `rovgraph.graph` gives to GTSAM, and a test holds both optima equal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import TABLE, Belief
from rovgraph.engine.chain_information import MeasurementRows, MotionRows, SquareRoot, UndeterminedError, eliminate
from rovgraph.engine.gauss_newton import Gates
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.measurements import Block, gates_of, loss_and_weight, measurement_cost
from rovgraph.engine.scale import SCALES
from rovgraph.engine.unknowns import Unknowns
from rovgraph.errors import InputError
from rovgraph.geometry import Array, exp_rotation, log_rotation, right_jacobian, rotate
from rovgraph.kernels.motion_residual import motion_cost, motion_errors, motion_weights, whiten_motions
from rovgraph.state import BIAS, POSE, VELOCITY, State

MOTION = 15  # components of a keyframe before what walks
CLONED = 3  # of the first keyframe, its attitude, that a border ends with where its covariance is asked for
PRIORS = 3  # rows at the first keyframe that are no measurements: two priors, and the tie of its clone
STIFF = 1e8  # square-root information that ties the clone to it [1/rad]
COLUMNS = {POSE: slice(0, 6), VELOCITY: slice(6, 9), BIAS: slice(9, 15)}

_NOTHING, _ONE = np.empty(0, np.int64), np.ones(1)


@dataclass(frozen=True)
class ChainStep:
    """A step of all variables: keyframes, shape (n, d), and border, shape (c,)."""

    x: Array
    y: Array


@dataclass(frozen=True)
class Chain:
    """A dive as a chain of n keyframes: block size d, border of c constants.

    Attributes
    ----------
    intervals, initial, beliefs, unknowns : the dive
    blocks : sensor -> its measurements
    """

    intervals: list[KeyframeInterval]
    initial: InitialConditions
    beliefs: Mapping[str, Belief]
    unknowns: Unknowns
    blocks: dict[str, Block]

    @cached_property
    def layout(self) -> dict[str, tuple[bool, slice]]:
        """Calibration variable -> whether it is in the border, and its place there or in a keyframe's block."""
        out, d, c = {}, MOTION, 0
        for name, walk in self.unknowns.walks.items():
            dim = TABLE[name].dim
            out[name] = (False, slice(d, d + dim)) if walk else (True, slice(c, c + dim))
            d, c = (d + dim, c) if walk else (d, c + dim)
        return out

    @cached_property
    def d(self) -> int:
        """Components of a keyframe's block."""
        return MOTION + sum(TABLE[name].dim for name, (border, _) in self.layout.items() if not border)

    @cached_property
    def c(self) -> int:
        """Components of the border."""
        return sum(TABLE[name].dim for name, (border, _) in self.layout.items() if border)

    def target(self, name: str) -> NDArray[np.int64]:
        """Targets of a calibration variable's components, as `rovgraph.kernels.chain` counts them."""
        border, part = self.layout[name]
        return np.arange(part.start, part.stop) + (self.d if border else 0)

    @cached_property
    def time(self) -> Array:
        return np.array([i.time for i in self.intervals])

    @cached_property
    def motions(self) -> Array:
        """Rows of the motions between keyframes, shape (n - 1, ROW)."""
        return np.array([i.motion.row for i in self.intervals[1:] if i.motion is not None]).reshape(
            len(self.intervals) - 1, -1
        )

    @cached_property
    def motion_weights(self) -> Array:
        """Square-root information of the motions, shape (n - 1, 15, 15)."""
        W = np.empty((len(self.motions), MOTION, MOTION))
        motion_weights(self.motions, W)
        return W

    @cached_property
    def scale_to_bias(self) -> Array | None:
        """Bias by the IMU's scales of each interval, shape (n - 1, 6, 6), or None where these are exact."""
        if len(self.intervals) < 2 or self.intervals[1].scale_to_bias is None:
            return None
        return np.array([i.scale_to_bias for i in self.intervals[1:]])

    @cached_property
    def walk(self) -> Array:
        """Square-root information of the walks, shape (n - 1, d - 15)."""
        rates = [np.full(TABLE[n].dim, walk) for n, walk in self.unknowns.walks.items() if walk]
        rate = np.concatenate([np.empty(0), *rates])
        return np.asarray(1.0 / (rate * np.sqrt(np.diff(self.time))[:, None]))

    # what `rovgraph.engine.gauss_newton` asks

    def seen(self, state: State) -> list[tuple[str, Block, State]]:
        """Every sensor's block, with the state of each measurement's keyframe."""
        return [(sensor, block, state.at(block.keyframe)) for sensor, block in self.blocks.items()]

    def initial_gates(self) -> Gates:
        return {sensor: block.believed.copy() for sensor, block in self.blocks.items()}

    def gates(self, point: State) -> Gates:
        return gates_of(self.seen(point))

    def cost(self, point: State, gates: Gates) -> float:
        shift = np.empty((0, 6)) if self.scale_to_bias is None else self._scale_shift(point)
        R, p, v, b = (np.ascontiguousarray(a) for a in (point.R_nb, point.p_n, point.v_n, point.bias))
        total = motion_cost(self.motions, self.motion_weights, R, p, v, b, shift)
        total += 0.5 * sum(float(np.sum(p**2)) for p in self.prior_residuals(point))
        for name in self._walking:
            total += 0.5 * float(np.sum((np.diff(point.calibration[name], axis=0) * self._walk_of(name)) ** 2))
        return total + measurement_cost(self.seen(point), gates)

    def step(self, point: State, gates: Gates) -> ChainStep:
        return ChainStep(*self.eliminate(point, gates).solve())

    def moved(self, point: State, step: ChainStep, share: float) -> State:
        x, y = share * step.x, share * step.y
        calibration = dict(point.calibration)
        for name, (border, part) in self.layout.items():
            calibration[name] = point.calibration[name] + (y[part] if border else x[:, part])
        return State(
            point.R_nb @ exp_rotation(x[:, :3]),
            point.p_n + rotate(point.R_nb, x[:, 3:6]),
            point.v_n + x[:, 6:9],
            point.bias + x[:, 9:15],
            calibration,
        )

    def start(self, states: State, calibration: Mapping[str, Array] | None) -> State:
        """The point to begin with: calibration constant over the dive, its prior means where none is given."""
        values = {name: np.asarray(v, float).ravel() for name, v in (calibration or self.unknowns.fixed).items()}
        known = {**self.unknowns.fixed, **{name: values[name] for name in self.unknowns.estimated}}
        for name in self._walking:
            known[name] = np.tile(known[name], (len(self.intervals), 1))
        return State(states.R_nb, states.p_n, states.v_n, states.bias, known)

    # factors

    def prior_residuals(self, point: State) -> tuple[Array, Array]:
        """Whitened residuals of the first keyframe, shape (15,), and of the calibration, shape (k,)."""
        prior = self.initial.prior
        theta = log_rotation(prior.state.R_nb[0].T @ point.R_nb[0])
        parts = [
            theta,
            prior.state.R_nb[0].T @ (point.p_n[0] - prior.state.p_n[0]),
            point.v_n[0] - prior.state.v_n[0],
            point.bias[0] - prior.state.bias[0],
        ]
        own = [
            (np.atleast_2d(point.calibration[name])[0] - self.beliefs[name].mean) / self.beliefs[name].sd
            for name in self.unknowns.estimated
        ]
        return self._prior_weight @ np.concatenate(parts), np.concatenate([np.empty(0), *own])

    @cached_property
    def _prior_weight(self) -> Array:
        return np.linalg.inv(np.linalg.cholesky(self.initial.prior.covariance()))

    def _prior_jacobian(self, point: State) -> Array:
        """Of the first keyframe's residual, shape (15, 15)."""
        J = np.eye(MOTION)
        R = self.initial.prior.state.R_nb[0].T @ point.R_nb[0]
        J[:3, :3] = np.linalg.inv(right_jacobian(log_rotation(R)))
        J[3:6, 3:6] = R
        return self._prior_weight @ J

    def motion_residuals(self, point: State) -> tuple[Array, Array, Array]:
        """Whitened residuals of the motions, and their derivatives by the keyframes before and after."""
        n = len(self.motions)
        r, A_i, A_j = np.empty((n, MOTION)), np.empty((n, MOTION, MOTION)), np.empty((n, MOTION, MOTION))
        R, p, v, b = (np.ascontiguousarray(a) for a in (point.R_nb, point.p_n, point.v_n, point.bias))
        b_i, b_j = b[:-1], b[1:]
        if self.scale_to_bias is not None:
            shift = self._scale_shift(point)
            b_i, b_j = b_i + shift, b_j + shift
        motion_errors(self.motions, R[:-1], p[:-1], v[:-1], b_i, R[1:], p[1:], v[1:], b_j, r, A_i, A_j)
        whiten_motions(self.motion_weights, r, A_i, A_j)
        return r, A_i, A_j

    def _scale_shift(self, point: State) -> Array:
        """Bias that errors of the IMU's scale make in each interval, shape (n - 1, 6)."""
        assert self.scale_to_bias is not None
        k = [np.broadcast_to(np.atleast_2d(point.calibration[s]), (len(self.intervals), 3))[1:] for s in SCALES]
        return rotate(self.scale_to_bias, np.concatenate(k, axis=1))

    def eliminate(self, point: State, gates: Gates, stops: Sequence[int] = ()) -> SquareRoot:
        """All factors linearised at a point and eliminated; with ``stops`` the border ends with the first attitude.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        r, A_i, A_j = self.motion_residuals(point)
        C, targets = self._scale_columns(A_i, A_j)
        walks = [np.diff(point.calibration[name], axis=0) * self._walk_of(name) for name in self._walking]
        walk_r = np.concatenate([np.empty((len(r), 0)), *walks], axis=1)
        rows, clones = (self._rows_with_clone, CLONED) if len(stops) else (self._rows, 0)
        self._put_priors(rows, point, clones)
        for place, (sensor, block, state) in enumerate(self.seen(point), PRIORS):
            self._put_block(rows, place, block, state, gates[sensor])
        try:
            motions = MotionRows(A_i, A_j, -r, C, targets, self.walk, -walk_r)
            return eliminate(motions, rows, self._border_rows(point, clones), stops)
        except UndeterminedError as error:
            raise InputError(self._indeterminate(error.keyframe, error.component)) from None

    @cached_property
    def _rows(self) -> MeasurementRows:
        return self._room(0)

    @cached_property
    def _rows_with_clone(self) -> MeasurementRows:
        return self._room(CLONED)

    def _room(self, clones: int) -> MeasurementRows:
        """Room for the rows of priors, of the clone's tie and of all measurements, in this order."""
        blocks, first = self.blocks.values(), np.zeros(1, np.int64)
        walking = self.d - MOTION
        keyframes = [first, first, first, *(b.keyframe.astype(np.int64) for b in blocks)]
        dims = [MOTION, walking, clones, *(b.z.shape[1] for b in blocks)]
        others = [sum(TABLE[n].dim for n in self._columns_of(b)) for b in blocks]
        return MeasurementRows(len(self.intervals), MOTION, keyframes, dims, max([walking, clones, *others]))

    def _put_priors(self, rows: MeasurementRows, point: State, clones: int) -> None:
        """The prior of the first keyframe, that of what walks, and the tie of the first attitude's clone."""
        r, _ = self.prior_residuals(point)
        rows.put(0, -r[None], self._prior_jacobian(point)[None], np.empty((1, MOTION, 0)), _NOTHING, _ONE)
        sd = [np.full(TABLE[n].dim, self.beliefs[n].sd) for n in self._walking]
        off = [self.beliefs[n].mean - point.calibration[n][0] for n in self._walking]
        weight = 1.0 / np.concatenate([np.empty(0), *sd])
        own = np.concatenate([_NOTHING, *(self.target(n) for n in self._walking)])
        values = np.concatenate([np.empty(0), *off]) * weight
        rows.put(1, values[None], np.zeros((1, len(own), MOTION)), np.diag(weight)[None], own, _ONE)
        tie = np.zeros((1, clones, MOTION))
        tie[0, :, :clones] = STIFF * np.eye(clones)
        clone = self.d + self.c + np.arange(clones)
        rows.put(2, np.zeros((1, clones)), tie, -STIFF * np.eye(clones)[None], clone, _ONE)

    def _put_block(
        self, rows: MeasurementRows, place: int, block: Block, state: State, gate: NDArray[np.bool_]
    ) -> None:
        """The measurements of one sensor, weighted."""
        r, H = block.linearize(state)
        weight = loss_and_weight(r, block.instrument.loss)[1] * gate
        J = np.zeros((*r.shape, MOTION))
        for variable, columns in COLUMNS.items():
            if variable in H:
                J[..., columns] = H[variable]
        names = self._columns_of(block)
        C = np.concatenate([np.empty((*r.shape, 0)), *(H[n] for n in names)], axis=2)
        targets = np.concatenate([_NOTHING, *(self.target(n) for n in names)])
        rows.put(place, r, J, C, targets, weight)

    def _columns_of(self, block: Block) -> list[str]:
        """Calibration that a sensor's measurements depend on, of what is estimated."""
        return [name for name in block.unknowns.estimated if name in self.layout]

    def _border_rows(self, point: State, clones: int) -> Array:
        """Priors of the border's constants, shape (c, c + clones + 1)."""
        out = np.zeros((self.c, self.c + clones + 1))
        for name, (border, part) in self.layout.items():
            if border:
                belief = self.beliefs[name]
                out[part, part] = np.eye(belief.variable.dim) / belief.sd
                out[part, -1] = (belief.mean - point.calibration[name]) / belief.sd
        return out

    @cached_property
    def _walking(self) -> list[str]:
        return [name for name, (border, _) in self.layout.items() if not border]

    def _walk_of(self, name: str) -> Array:
        part = self.layout[name][1]
        return self.walk[:, part.start - MOTION : part.stop - MOTION]

    def _scale_columns(self, A_i: Array, A_j: Array) -> tuple[Array, NDArray[np.int64]]:
        """Derivatives of the motions by the IMU's scales that are estimated, and their targets."""
        names = [name for name in SCALES if name in self.layout]
        if not names or self.scale_to_bias is None:
            return np.empty((len(A_i), MOTION, 0)), np.empty(0, np.int64)
        by_bias = A_i[:, :, 9:15] + A_j[:, :, 9:15]  # of both alike, which leaves the bias's walk out of it
        by_scale = by_bias @ self.scale_to_bias
        parts = {"acc_scale": slice(0, 3), "gyr_scale": slice(3, 6)}
        C = np.concatenate([by_scale[:, :, parts[name]] for name in names], axis=2)
        return np.ascontiguousarray(C), np.concatenate([self.target(name) for name in names])

    def _indeterminate(self, keyframe: int | None, component: int) -> str:
        """One line on a system that cannot be solved."""
        if keyframe is not None and component < MOTION:
            variable = next(v for v, columns in COLUMNS.items() if columns.start <= component < columns.stop)
            what = f"{variable} of keyframe {keyframe}"
        else:
            place = (keyframe is None, component)
            parts = self.layout.items()
            own = (n for n, (border, p) in parts if border == place[0] and p.start <= place[1] < p.stop)
            what = next(own, "some variable")
        return (
            f"the data do not determine {what}: check the log (rovgraph check), "
            "tighten its prior sd, or hold it fixed in the configuration"
        )
