"""The smoother of a dive that closes no loop: a chain of keyframes with a border of constants.

Each iteration linearises all factors and eliminates them in the order of time, in one compiled pass
(`rovgraph.kernels.elimination`). Calibration that walks is a part of each keyframe's block, constants are the border:
`ChainLayout` has the index of every variable. The factors are those of the graph that `rovgraph.inference.graph` gives
to GTSAM, and a test holds both optima equal.
"""

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from weakref import ReferenceType, ref

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array, exp_rotation, log_rotation, right_jacobian, rotate
from rovgraph.inference.chain_information import MeasurementRows, SquareRoot, UndeterminedError, square_root
from rovgraph.inference.gauss_newton import GatedMeasurements, Gates
from rovgraph.kernels.chain import Elimination, PlacedRows, Walks
from rovgraph.kernels.elimination import DiveFactors, eliminate_dive, robust_costs, squared_lengths
from rovgraph.kernels.measurement_row import GATE, TIME
from rovgraph.model.calibration import LAYOUT, TABLE, WATER_LAYER, Belief, calibration_size
from rovgraph.model.state import COLUMNS, State
from rovgraph.problem.calibration_roles import CalibrationRoles
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.layers import OUT_OF_SIGHT, NewKnot, new_knots, window_changes
from rovgraph.problem.measurements import (
    Measurements,
    Seen,
    compiled,
    cost_at_gate,
    gates_of,
    kernel_states,
    loss_and_weight,
    measurement_cost,
    measurements_of,
    pieces,
    sensor_table,
)
from rovgraph.problem.problem import Problem

MOTION = 15  # components of a keyframe before what walks
NOTHING = np.empty(0, np.int64)


@dataclass(frozen=True)
class ChainLayout:
    """Layout of a chain of blocks of d components with a border of c.

    Attributes
    ----------
    walks : calibration variable that is estimated -> its random walk, 0 = constant
    """

    walks: Mapping[str, float]

    @cached_property
    def places(self) -> dict[str, tuple[bool, slice]]:
        """Calibration variable -> whether it is in the border, and its place there or in a keyframe's block."""
        out, d, c = {}, MOTION, 0
        for name, walk in self.walks.items():
            dim = TABLE[name].dim
            out[name] = (False, slice(d, d + dim)) if walk else (True, slice(c, c + dim))
            d, c = (d + dim, c) if walk else (d, c + dim)
        return out

    @cached_property
    def walking(self) -> list[str]:
        """Variables that walk."""
        return [name for name, (border, _) in self.places.items() if not border]

    @cached_property
    def d(self) -> int:
        """Components of a keyframe's block."""
        return MOTION + sum(TABLE[name].dim for name in self.walking)

    @cached_property
    def c(self) -> int:
        """Components of the border."""
        return sum(TABLE[name].dim for name, (border, _) in self.places.items() if border)

    def target(self, name: str) -> NDArray[np.int64]:
        """Targets of a calibration variable's components, as `rovgraph.kernels.chain` counts them."""
        border, part = self.places[name]
        return np.arange(part.start, part.stop) + (self.d if border else 0)

    @cached_property
    def column(self) -> NDArray[np.int64]:
        """Target of each component of state and calibration vector, shape (15 + C,), -1 where it is not estimated."""
        out = np.full(MOTION + calibration_size(), -1)
        out[:MOTION] = np.arange(MOTION)
        for name in self.places:
            part = LAYOUT[name]
            out[MOTION + part.start : MOTION + part.stop] = self.target(name)
        return out

    def indeterminate(self, keyframe: int | None, component: int) -> str:
        """One line on a system that cannot be solved."""
        if keyframe is not None and component < MOTION:
            variable = next(v for v, columns in COLUMNS.items() if columns.start <= component < columns.stop)
            what = f"{variable} of keyframe {keyframe}"
        else:
            place = (keyframe is None, component)
            parts = self.places.items()
            names = (n for n, (border, p) in parts if border == place[0] and p.start <= place[1] < p.stop)
            what = next(names, "some variable")
        return (
            f"the data do not determine {what}: check the log (rovgraph check), "
            "tighten its prior sd, or hold it fixed in the configuration"
        )


CLONED = 3  # of the first keyframe, its attitude, that a border ends with where its covariance is asked for
CONDITIONALS = 3  # place of rows of new knots, after those at the first keyframe: two priors, and its clone's tie
PRIORS = 4  # such rows that are no measurements
STIFF = 1e8  # square-root information that ties the clone to it [1/rad]

NEWEST = 2  # points whose costs are kept: the last, and the one before it if that was better

_ONE = np.ones(1)


@dataclass(frozen=True)
class ChainStep:
    """A step of all variables.

    Attributes
    ----------
    x, y : ndarray, shapes (n, d), (c,), keyframes and border
    promised : by how much the cost of the linear problem falls
    """

    x: Array
    y: Array
    promised: float = 0.0


@dataclass(frozen=True)
class _PointCosts:
    """A point, what its motions, walks and priors cost, and squared lengths of whitened innovations, shape (m,)."""

    point: ReferenceType[State]
    cost: float
    squares: Array


@dataclass(frozen=True)
class Chain:
    """A dive as a chain of n keyframes: block size d, border of c constants.

    Attributes
    ----------
    problem, initial, beliefs, unknowns : the dive
    """

    problem: Problem
    initial: InitialConditions
    beliefs: Mapping[str, Belief]
    unknowns: CalibrationRoles

    @cached_property
    def layout(self) -> ChainLayout:
        """Where each variable stands."""
        return ChainLayout(self.unknowns.walks)

    @cached_property
    def walk(self) -> tuple[Array, Array]:
        """Square-root information of the walks, and what they keep of a deviation; shape (n - 1, d - 15) each."""
        seconds = np.diff(self.problem.time)
        kept, sd = np.empty((2, len(seconds), self.layout.d - MOTION))
        for name in self.layout.walking:
            of_walk = self.unknowns.walked(name, seconds[:, None])
            kept[:, self._walking(name)], sd[:, self._walking(name)] = of_walk
            ends = self.problem.time.searchsorted(self.beliefs[name].changes)  # of the intervals that hold changes
            sd[ends[(ends > 0) & (ends < len(self.problem.time))] - 1, self._walking(name)] = self.beliefs[name].sd
        for k, knots in self._windows:
            for knot in knots:
                at = k - 1, self._walking(knot.name)
                if knot.neighbour == knot.name:
                    sd[at] = np.hypot(kept[at] * knot.sd, sd[at])
                    kept[at] *= knot.kept
                else:
                    sd[at] = OUT_OF_SIGHT
        return 1.0 / sd, kept

    @cached_property
    def _windows(self) -> list[tuple[int, list[NewKnot]]]:
        """Keyframes at which knots of the water's current are new, and these."""
        if WATER_LAYER not in self.initial.instruments:
            return []
        water, changed = self.initial.config.water, window_changes(self.problem).tolist()
        changes = [(k, new_knots(self.problem, k, water)) for k in changed]
        return [(k, [knot for knot in knots if knot.name in self.layout.places]) for k, knots in changes]

    @cached_property
    def _conditionals(self) -> tuple[NDArray[np.int64], Array]:
        """Whitened rows by which new knots follow from their neighbours: keyframe, Jacobian by what walks.

        Shapes (r,), (r, d - 15); their residual is the Jacobian times what walks.
        """
        keyframe, rows = [], [np.empty((0, self.layout.d - MOTION))]
        for k, knots in self._windows:
            for name, neighbour, kept, sd in knots:
                if neighbour == name:  # that is its walk
                    continue
                row = np.zeros((2, self.layout.d - MOTION))
                row[:, self._walking(name)] = np.eye(2) / sd
                if neighbour is not None:
                    row[:, self._walking(neighbour)] = -kept * np.eye(2) / sd
                rows.append(row)
                keyframe += [k, k]
        return np.array(keyframe, np.int64), np.concatenate(rows)

    def _conditional_residuals(self, point: State) -> Array:
        """Whitened residuals of new knots, shape (r,)."""
        keyframe, rows = self._conditionals
        if not len(keyframe):
            return np.empty(0)
        walking = np.concatenate([point.calibration[name][keyframe] for name in self.layout.walking], axis=1)
        return np.asarray(np.sum(rows * walking, axis=1))

    def _put_conditionals(self, rows: MeasurementRows, place: int, point: State) -> None:
        keyframe, by = self._conditionals
        if len(keyframe):
            targets = np.concatenate([self.layout.target(name) for name in self.layout.walking])
            r, J = -self._conditional_residuals(point)[:, None], np.zeros((len(keyframe), 1, MOTION))
            rows.put(place, r, J, by[:, None], targets, np.ones(len(keyframe)))

    def _walking(self, name: str) -> slice:
        part = self.layout.places[name][1]
        return slice(part.start - MOTION, part.stop - MOTION)

    def walk_residuals(self, point: State) -> Array:
        """Whitened residuals of the walks, shape (n - 1, d - 15)."""
        weight, kept = self.walk
        away = np.empty((len(weight) + 1, weight.shape[1]))
        for name in self.layout.walking:
            away[:, self._walking(name)] = point.calibration[name] - self.unknowns.fixed[name]
        return np.asarray(weight * (away[1:] - kept * away[:-1]))

    @cached_property
    def blocks(self) -> dict[str, Measurements]:
        """Sensor -> its measurements."""
        return self._blocks({*self.initial.instruments})

    @cached_property
    def given(self) -> dict[str, Measurements]:
        """The same of sensors without a kernel."""
        return self._blocks(self._unknown_to_kernels) if self._unknown_to_kernels else {}

    def _blocks(self, sensors: set[str]) -> dict[str, Measurements]:
        gravity = self.initial.gravity
        return measurements_of(self.problem, sensors, self.initial.instruments, gravity, self.unknowns)

    @cached_property
    def _unknown_to_kernels(self) -> set[str]:
        return {s for s, i in self.initial.instruments.items() if not compiled(i)}

    @cached_property
    def _sensors(self) -> Array:
        return sensor_table(self.initial.instruments, sorted(self._unknown_to_kernels))

    @cached_property
    def _places(self) -> dict[str, NDArray[np.int64]]:
        """Sensor with a kernel -> indices of its measurements among all."""
        names = [s for s in self.initial.instruments if s not in self._unknown_to_kernels]
        places = {name: self.problem.of_sensor(name) for name in names}
        return {name: found for name, found in places.items() if len(found)}

    def __getstate__(self) -> dict[str, object]:
        """For pickle: without the costs of the newest points, whose points it cannot refer to."""
        return {name: value for name, value in self.__dict__.items() if name != "_newest"}

    # what `rovgraph.inference.gauss_newton` asks

    def seen(self, state: State, blocks: Mapping[str, Measurements]) -> Seen:
        """Sensors' blocks, with the state of each measurement's keyframe."""
        return ((sensor, block, state.at(block.keyframe)) for sensor, block in blocks.items())

    def measured(self) -> dict[str, GatedMeasurements]:
        """As `rovgraph.inference.gauss_newton.Linearizable`."""
        times = {sensor: self.problem.rows[places, TIME] for sensor, places in self._places.items()}
        times |= {sensor: block.time for sensor, block in self.given.items()}
        used = {sensor: self.initial.instruments[sensor] for sensor in times}
        return {s: GatedMeasurements(times[s], i.model.dim, cost_at_gate(i)) for s, i in used.items()}

    def initial_gates(self) -> Gates:
        """As `rovgraph.inference.gauss_newton.Linearizable`."""
        known = {sensor: np.full(len(places), True) for sensor, places in self._places.items()}
        return {**known, **{sensor: block.believed.copy() for sensor, block in self.given.items()}}

    def gates(self, point: State) -> Gates:
        """As `rovgraph.inference.gauss_newton.Linearizable`."""
        within = self._at(point).squares <= self._sensors[self.problem.which, GATE] ** 2
        known = {sensor: within[places] for sensor, places in self._places.items()}
        return {**known, **gates_of(self.seen(point, self.given))}

    def cost(self, point: State, gates: Gates) -> float:
        """As `rovgraph.inference.gauss_newton.Linearizable`."""
        here = self._at(point)
        total = here.cost + robust_costs(here.squares, self.problem.which, self._sensors, self._entered(gates))
        return total + measurement_cost(self.seen(point, self.given), gates)

    def _at(self, point: State) -> "_PointCosts":
        """What does not depend on gates; kept of the newest points, which are asked for with other gates next."""
        known = next((one for one in self._newest if one.point() is point), None)
        if known is None:
            motions = self.problem.motion_residuals(point)
            cost = 0.5 * float(np.vdot(motions, motions))
            cost += 0.5 * sum(float(np.sum(p**2)) for p in self.prior_residuals(point))
            cost += 0.5 * float(np.sum(self.walk_residuals(point) ** 2))
            cost += 0.5 * float(np.sum(self._conditional_residuals(point) ** 2))
            cost -= self._lacking(point)
            known = _PointCosts(ref(point), cost, self._squared_lengths(point))
            self._newest.append(known)
        return known

    @cached_property
    def _newest(self) -> "deque[_PointCosts]":
        return deque(maxlen=NEWEST)

    def _squared_lengths(self, point: State) -> Array:
        """Of the whitened innovations of sensors with a kernel, shape (m,)."""
        out = np.empty(len(self.problem.rows))
        squared_lengths(self._factors, kernel_states(point), out)
        return out

    @property
    def _factors(self) -> DiveFactors:
        r = self.problem
        return DiveFactors(
            motions=r.motions,
            W=r.weights,
            scales=r.scales,
            measured=r.measured(),
            first=r.first,
            sensors=self._sensors,
            gravity=self.initial.gravity,
        )

    def _entered(self, gates: Gates) -> NDArray[np.bool_]:
        """Gates of sensors with a kernel, shape (m,)."""
        out = np.zeros(len(self.problem.rows), bool)
        for sensor, places in self._places.items():
            out[places] = gates[sensor]
        return out

    def step(self, point: State, gates: Gates) -> ChainStep:
        """As `rovgraph.inference.gauss_newton.Linearizable`."""
        root = self.eliminate(point, gates)
        return ChainStep(*root.solve(), root.explained())

    def promised(self, step: ChainStep) -> float:
        """As `rovgraph.inference.gauss_newton.Linearizable`."""
        return step.promised

    def moved(self, point: State, step: ChainStep, share: float) -> State:
        """As `rovgraph.inference.gauss_newton.Linearizable`."""
        x, y = share * step.x, share * step.y
        calibration = dict(point.calibration)
        for name, (border, part) in self.layout.places.items():
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
        for name in self.layout.walking:
            known[name] = np.tile(known[name], (len(self.problem), 1))
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
        of_calibration = [
            (np.atleast_2d(point.calibration[name])[0] - self.beliefs[name].mean) / self.beliefs[name].first_sd
            for name in self.unknowns.estimated
        ]
        return self._prior_weight @ np.concatenate(parts), np.concatenate([np.empty(0), *of_calibration])

    def _lacking(self, point: State) -> float:
        """Log likelihood that noise has taken from the border's constants, by `Belief.score`."""
        return sum(
            float(np.sum(self.beliefs[name].score * (point.calibration[name] - self.beliefs[name].mean)))
            for name, (border, _) in self.layout.places.items()
            if border
        )

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

    def eliminate(
        self,
        point: State,
        gates: Gates,
        stops: Sequence[int] = (),
        kept: int | None = None,
        diagonal: bool = False,
    ) -> SquareRoot:
        """All factors linearised at a point and eliminated; with ``stops`` the border ends with the first attitude.

        ``kept`` and ``diagonal`` are as of `rovgraph.inference.chain_information.square_root`.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        given, clones = (self._rows_with_clone, CLONED) if len(stops) else (self._rows, 0)
        self._put_priors(given, point, clones)
        self._put_conditionals(given, CONDITIONALS, point)
        for place, (sensor, block) in enumerate(self.given.items(), PRIORS):
            self._put_block(given, place, block, point, gates[sensor])
        n, d, c = len(self.problem), self.layout.d, self.layout.c + clones
        entered, at, walks = self._entered(gates), kernel_states(point), Walks(*self.walk, -self.walk_residuals(point))
        others, border_rows = PlacedRows(given.values, given.targets, given.first), self._border_rows(point, clones)
        kept_at, column = np.array(stops, np.int64), self.layout.column

        def fill(conditionals: Array, border: Array, filtered: Array, left: Array) -> int:
            out = Elimination(kept_at, conditionals, border, filtered, left)
            return eliminate_dive(self._factors, entered, at, column, walks, others, border_rows, out)

        try:
            return square_root(n, d, c, len(stops), fill, kept, diagonal)
        except UndeterminedError as error:
            raise InputError(self.layout.indeterminate(error.keyframe, error.component)) from None

    @cached_property
    def _rows(self) -> MeasurementRows:
        return self._room(0)

    @cached_property
    def _rows_with_clone(self) -> MeasurementRows:
        return self._room(CLONED)

    def _room(self, clones: int) -> MeasurementRows:
        """Buffers for the rows of priors, of the clone's tie and of sensors without a kernel, in this order."""
        blocks, first = self.given.values(), np.zeros(1, np.int64)
        walking = self.layout.d - MOTION
        keyframes = [first, first, first, self._conditionals[0], *(b.keyframe.astype(np.int64) for b in blocks)]
        dims = [MOTION, walking, clones, 1, *(b.z.shape[1] for b in blocks)]
        others = [sum(TABLE[n].dim for n in self._columns_of(b)) for b in blocks]
        return MeasurementRows(len(self.problem), MOTION, keyframes, dims, max([walking, clones, *others]))

    def _put_priors(self, rows: MeasurementRows, point: State, clones: int) -> None:
        """The prior of the first keyframe, that of what walks, and the tie of the first attitude's clone."""
        r, _ = self.prior_residuals(point)
        rows.put(0, -r[None], self._prior_jacobian(point)[None], np.empty((1, MOTION, 0)), NOTHING, _ONE)
        sd = [np.full(TABLE[n].dim, self.beliefs[n].first_sd) for n in self.layout.walking]
        off = [self.beliefs[n].mean - point.calibration[n][0] for n in self.layout.walking]
        weight = 1.0 / np.concatenate([np.empty(0), *sd])
        targets = np.concatenate([NOTHING, *(self.layout.target(n) for n in self.layout.walking)])
        values = np.concatenate([np.empty(0), *off]) * weight
        rows.put(1, values[None], np.zeros((1, len(targets), MOTION)), np.diag(weight)[None], targets, _ONE)
        tie = np.zeros((1, clones, MOTION))
        tie[0, :, :clones] = STIFF * np.eye(clones)
        clone = self.layout.d + self.layout.c + np.arange(clones)
        rows.put(2, np.zeros((1, clones)), tie, -STIFF * np.eye(clones)[None], clone, _ONE)

    def _put_block(
        self, rows: MeasurementRows, place: int, block: Measurements, point: State, gate: NDArray[np.bool_]
    ) -> None:
        """The measurements of one sensor, weighted."""
        names = self._columns_of(block)
        targets = np.concatenate([NOTHING, *(self.layout.target(n) for n in names)])
        for part in pieces(0, len(block)):
            some = block.at(part)
            r, H = some.linearize(point.at(some.keyframe))
            weight = loss_and_weight(r, block.instrument.loss)[1] * gate[part]
            J = np.zeros((*r.shape, MOTION))
            for variable, columns in COLUMNS.items():
                if variable in H:
                    J[..., columns] = H[variable]
            C = np.concatenate([np.empty((*r.shape, 0)), *(H[n] for n in names)], axis=2)
            rows.put(place, r, J, C, targets, weight, part)

    def _columns_of(self, block: Measurements) -> list[str]:
        """Calibration that a sensor's measurements depend on, of what is estimated."""
        return [name for name in block.unknowns.estimated if name in self.layout.places]

    def _border_rows(self, point: State, clones: int) -> Array:
        """Priors of the border's constants, shape (c, c + clones + 1)."""
        out = np.zeros((self.layout.c, self.layout.c + clones + 1))
        for name, (border, part) in self.layout.places.items():
            if border:
                belief = self.beliefs[name]
                out[part, part] = np.eye(belief.variable.dim) / belief.sd
                out[part, -1] = (belief.mean - point.calibration[name]) / belief.sd + belief.score * belief.sd
        return out
