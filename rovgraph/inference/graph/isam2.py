"""iSAM2 over a whole dive: an incremental graph that is a filter at its newest keyframe and a smoother behind it.

Each interval is predicted with the IMU from the graph's own newest keyframe, and measurements are gated by their
innovations against the graph's own joint covariance there (`FilterEngine.step`, with iSAM2's covariance); admitted
measurements become a factor, and after the update the newest keyframe is the filtered estimate. In the end all
keyframes are smoothed: the smoother's Gauss-Newton continues from iSAM2's estimate until it converges.

`Linearization` holds the intervals of a dive as whitened rows about a point. With the errors e_i, e_j of the keyframes
before and after an interval and e_c of the calibration, in the order of `rovgraph.inference.filter`, the rows are

    A_i e_i + A_j e_j + C e_c = r + white noise

one for each component of its motion, or of the prior, and of the measurements since the keyframe before. Their
equations are the compiled ones, and losses weight the rows.

`Incremental` is iSAM2 (Kaess et al. 2012) of that linearised graph. Its variables are errors about the point: one for
each keyframe, one for the calibration of each segment of time, and one for each place. An interval is one factor,
linearised in compiled code, so that an update needs no callback and eliminates two cliques. Elimination is by QR, as
Cholesky squares the rows of precise motions. A constant that all keyframes share would make every update touch the
whole tree, so each segment has its own, tied to the one before by a walk of nearly zero sd.

Factors that were linearised at different headings and mountings bring spurious information (Huang, Mourikis and
Roumeliotis 2010). So from time to time iSAM2's estimate is compared with the point of linearisation. Where attitude or
calibration are off by a part of their sd, `relinearize` moves the point to the estimate from some segment on and
replaces the factors from there, which is the part of the Bayes tree that a change of these variables affects anyway.
iSAM2 does not relinearise by itself.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import gtsam
import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, exp_rotation, log_rotation, right_jacobian, rotate
from rovgraph.inference.error_state import FilterHistory
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.faulty_intervals import Searches
from rovgraph.inference.filter import ORIGIN, FilterEngine
from rovgraph.inference.filter_step import FilterGates, FilterStep, Gaussian, Met, states_of
from rovgraph.inference.gauss_newton import Gates
from rovgraph.inference.graph.batch import ANYWHERE_M, indeterminate
from rovgraph.inference.graph.places import associated_optimum, resolved
from rovgraph.inference.graph.values import CALIBRATION, key
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.rate_noise import without_rate_noise
from rovgraph.inference.smoother import newest_calibration, optimum, smoothed
from rovgraph.kernels.assembly import SEGMENT
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.motion_residual import motion_errors
from rovgraph.kernels.states import States
from rovgraph.log import Measurement
from rovgraph.model.calibration import LAYOUT, TABLE, WATER_LAYER, Belief
from rovgraph.model.gauss_markov import walked
from rovgraph.model.state import PLACE, PLACE_DIM, POSE, State
from rovgraph.problem.assembly import assembly_of
from rovgraph.problem.initial_conditions import InitialConditions, StatePrior
from rovgraph.problem.measurements import loss_and_weight
from rovgraph.problem.motion import COLUMNS, SCALES
from rovgraph.problem.problem import Index, Problem

_LET_IN = np.ones(1, bool)
_SCALE = slice(ACC_SCALE, ACC_SCALE + 6)  # of the calibration vector


@dataclass(frozen=True)
class LinearInterval:
    """The rows of one interval, of which there are m; of the first keyframe A_i is zero."""

    A_i: Array
    A_j: Array
    C: Array
    r: Array


class KeyframeTerms:
    """Measurements that belong to one keyframe, without those of places.

    Parameters
    ----------
    filter : with their equations
    problem, index : the dive, and which of its measurements; at least one
    """

    def __init__(self, filter: FilterEngine, problem: Problem, index: Index) -> None:
        known = np.array([filter.knows(problem.sensors[k]) for k in problem.which[index].tolist()])
        self._rows = filter.rows(problem, index[known]) if known.any() else None
        self._blocks = [filter.measurements(problem, np.array([row])) for row in index[~known].tolist()]
        self._matrix = filter.layout.matrix

    def linearize(self, x: Array, c: Array) -> tuple[Array, Array]:
        """Weighted innovations, shape (m,), and Jacobians, shape (m, size), at a state as of `Gaussian`."""
        if self._rows is not None and not self._blocks:
            return self._rows.linearize(x, c, weighted=True)
        linear = [] if self._rows is None else [self._rows.linearize(x, c, weighted=True)]
        state = states_of(x[None], c)
        for block in self._blocks:
            r, H = block.weighted(state, _LET_IN)
            linear.append((r[0], self._matrix(H)[0]))
        return np.concatenate([r for r, _ in linear]), np.vstack([H for _, H in linear])


class IntervalTerms:
    """An interval with its admitted measurements, which can be linearised at any point.

    Parameters
    ----------
    filter : with the equations
    problem, k : the interval that ends with keyframe k
    let_in : ndarray of int, its measurements that count
    segment : of time that it lies in

    Attributes
    ----------
    problem, k, segment : the same
    landmarks : measurements of places
    before, here : at the keyframe before, and at the one that ends the interval, where there are any
    """

    def __init__(self, filter: FilterEngine, problem: Problem, k: int, let_in: Index, segment: int) -> None:
        self.problem, self.k, self.segment = problem, k, segment
        seen = problem.number[let_in] >= 0
        self.landmarks, others = let_in[seen].tolist(), let_in[~seen]
        here = problem.keyframe[others] == k
        if any(knot.name != knot.neighbour for knot in filter.new_knots(problem, k)):  # those before do not know them
            known = here | (problem.which[others] != problem.sensors.index(WATER_LAYER))
            others, here = others[known], here[known]
        self.before = KeyframeTerms(filter, problem, others[~here]) if not here.all() else None
        self.here = KeyframeTerms(filter, problem, others[here]) if here.any() else None

    @property
    def time(self) -> float:
        """Of the keyframe [s]."""
        return float(self.problem.time[self.k])


class Linearization:
    """How the intervals of a dive are linearised.

    Parameters
    ----------
    filter : with the layout of the error
    prior : of the first keyframe
    """

    def __init__(self, filter: FilterEngine, prior: StatePrior) -> None:
        self._prior = prior
        self._prior_weight = np.linalg.inv(np.linalg.cholesky(prior.covariance()))
        self._size = filter.layout.size
        self._scales = [(name, filter.layout.columns[name]) for name in SCALES if name in filter.layout.columns]

    def linearize(self, terms: Sequence[IntervalTerms], x: Array, c: Array) -> list[LinearInterval]:
        """Rows of n intervals that follow each other.

        Parameters
        ----------
        terms : the intervals
        x : ndarray, shape (n + 1, 21), of the keyframe before the first (any before the dive), and of each
        c : ndarray, shape (n, C), calibration vectors
        """
        nothing = np.empty(0), np.empty((0, self._size))
        out = []
        for k, (term, r, A_i, A_j, C) in enumerate(zip(terms, *self._motions(terms, x, c), strict=True)):
            r_i, H_i = nothing if term.before is None else term.before.linearize(x[k], c[k])
            r_j, H_j = nothing if term.here is None else term.here.linearize(x[k + 1], c[k])
            end = MOTION + len(r_i)
            J = np.zeros((end + len(r_j), MOTION + self._size))
            J[:MOTION, :MOTION], J[:MOTION, MOTION : 2 * MOTION], J[:MOTION, 2 * MOTION :] = A_i, A_j, C
            J[MOTION:end, :MOTION], J[MOTION:end, 2 * MOTION :] = H_i[:, :MOTION], H_i[:, MOTION:]
            J[end:, MOTION:] = H_j
            blocks = J[:, :MOTION], J[:, MOTION : 2 * MOTION], J[:, 2 * MOTION :]
            out.append(LinearInterval(*blocks, np.concatenate([r, r_i, r_j])))
        return out

    def _motions(self, terms: Sequence[IntervalTerms], x: Array, c: Array) -> tuple[Array, Array, Array, Array]:
        """Rows of the motions, or at the first keyframe of its prior: r, A_i, A_j, C."""
        n, first = len(terms), int(terms[0].k == 0)
        r, A_i, A_j = np.zeros((n, MOTION)), np.zeros((n, MOTION, MOTION)), np.zeros((n, MOTION, MOTION))
        C = np.zeros((n, MOTION, self._size - MOTION))
        if first:
            r[0], A_j[0] = self._of_prior(x[1])
        if not terms[first:]:
            return r, A_i, A_j, C
        problem, some = terms[-1].problem, slice(terms[first].k - 1, terms[-1].k)
        rows, W = problem.motions[some], problem.weights[some]
        bias = x[first:, 15:21].copy()
        b_i, b_j, S = bias[:-1], bias[1:], None
        if len(problem.scales):
            S = problem.scales[some]
            shift = np.einsum("nij,nj->ni", S, c[first:, _SCALE])
            b_i, b_j = b_i + shift, b_j + shift
        R, p, v = x[first:, :9].reshape(-1, 3, 3).copy(), x[first:, 9:12].copy(), x[first:, 12:15].copy()
        views = r[first:], A_i[first:], A_j[first:]
        motion_errors(rows, States(R[:-1], p[:-1], v[:-1], b_i), States(R[1:], p[1:], v[1:], b_j), *views)
        views[0][:], views[1][:], views[2][:] = rotate(W, views[0]), W @ views[1], W @ views[2]
        if S is not None:
            by_scale = (views[1][:, :, 9:] + views[2][:, :, 9:]) @ S  # of both alike, so that it is no walk of the bias
            for name, part in self._scales:
                C[first:, :, part.start - MOTION : part.stop - MOTION] = by_scale[:, :, COLUMNS[name]]
        r[first:] *= -1.0
        return r, A_i, A_j, C

    def _of_prior(self, x: Array) -> tuple[Array, Array]:
        """Rows of the first keyframe's prior: right-hand side and Jacobian."""
        believed, J = self._prior.state, np.eye(MOTION)
        R = believed.R_nb[0].T @ x[:9].reshape(3, 3)
        turn = log_rotation(R)
        J[:3, :3], J[3:6, 3:6] = np.linalg.inv(right_jacobian(turn)), R
        position = believed.R_nb[0].T @ (x[9:12] - believed.p_n[0])
        off = np.concatenate([turn, position, x[12:15] - believed.v_n[0], x[15:21] - believed.bias[0]])
        return -self._prior_weight @ off, self._prior_weight @ J


WILDFIRE = 1e-3  # change of an estimate below which it is not propagated [rad, m, m/s...]

_unit = cache(gtsam.noiseModel.Unit.Create)


def isam2_params() -> gtsam.ISAM2Params:
    """Parameters of the engine."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.enableRelinearization = False
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(WILDFIRE))
    return params


class Incremental:
    """The graph of a dive that grows.

    Parameters
    ----------
    filter : with equations, prior and the layout of the error
    beliefs : of the calibration, all of which walks

    Attributes
    ----------
    updated : newest keyframe that iSAM2 has, -1 = none
    """

    def __init__(self, filter: FilterEngine, beliefs: Mapping[str, Belief]) -> None:
        estimated = [beliefs[name] for name in filter.unknowns.estimated]
        self._filter = filter
        self._linearization = Linearization(filter, filter.initial.prior)
        self._parts = np.concatenate([np.empty(0, int), *(np.r_[LAYOUT[b.variable.name]] for b in estimated)])
        self._mean = np.concatenate([np.empty(0), *(b.mean for b in estimated)])
        self._sd, self._walk, self._time_constant = (
            np.concatenate([np.empty(0), *(np.full(b.variable.dim, getattr(b, of)) for b in estimated)])
            for of in ("sd", "walk", "time_constant")
        )
        self._terms: list[IntervalTerms] = []
        self._x: list[Array] = []  # the point: states of the keyframes, calibration of the segments, places
        self._c: list[Array] = []
        self._places: dict[int, Array] = {}
        self._begun: list[int] = []  # first keyframe of each segment
        self._slots: list[list[int]] = []  # of each interval's factors in iSAM2
        self.updated = -1
        self._numbers = np.empty(0, np.int64)
        self._engine = gtsam.ISAM2(isam2_params())
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()  # what waits for the next update
        self._owners: list[int] = []  # interval of each factor that waits
        self._removed: list[int] = []
        self._order: gtsam.KeyGroupMap | None = None

    def __len__(self) -> int:
        """Count of intervals, with those that wait."""
        return len(self._terms)

    def add(self, problem: Problem, k: int, known: Gaussian, let_in: Index, numbers: Index) -> None:
        """Have an interval wait for the next update.

        Parameters
        ----------
        problem, k : the next one, which ends with keyframe k
        known : where to linearise it at first
        let_in : of its measurements, those that count
        numbers : of the places that all measurements so far are of, -1 where they are of none
        """
        term = IntervalTerms(self._filter, problem, k, let_in, self._segment(problem, k))
        if term.segment == len(self._c):
            self._c.append(known.c)
            self._begun.append(k)
        self._terms.append(term)
        self._x.append(known.x)
        self._numbers = numbers
        self._push(k)

    def _segment(self, problem: Problem, k: int) -> int:
        """Of time, that an interval lies in: one begins where knots of the current are new, too."""
        if k == 0:
            return 0
        before, here = problem.keyframes[k - 1 : k + 1, SEGMENT].tolist()
        return self._terms[k - 1].segment + int(here != before or bool(self._filter.new_knots(problem, k)))

    def update(self) -> None:
        """Take what has been added.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        graph, values, removed = self._graph, self._values, self._removed
        self._graph, self._values, self._removed = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
        try:
            result = self._engine.update(graph, values, removed, self._order)
        except RuntimeError as error:
            raise InputError(indeterminate(error)) from None
        slots, at = result.getNewFactorsIndices(), len(self._slots)
        self._slots += [[] for _ in range(len(self) - at)]
        for owner, slot in zip(self._owners, slots, strict=True):
            self._slots[owner].append(slot)
        self._owners, self._order, self.updated = [], None, len(self) - 1

    def newest(self, places: Sequence[int] = ()) -> tuple[Array, Array, Array, list[Array]]:
        """The newest keyframe that iSAM2 has, the calibration there, and places.

        Parameters
        ----------
        places : numbers of places

        Returns
        -------
        x, c : ndarray, as of `Gaussian`
        P : ndarray, shape (size + 2 m, size + 2 m), joint covariance
        positions : ndarray, shape (2,), of each place
        """
        k, s = self.updated, self._terms[self.updated].segment
        keys = [key(POSE, k), key(CALIBRATION, s), *(key(PLACE, number) for number in places)]
        R, d = self._engine.jointBayesNet(keys).matrix()  # of the root, in the order of the keys
        root = np.linalg.inv(R)
        P, delta = root @ root.T, root @ d
        c = self._c[s].copy()
        end = MOTION + len(self._parts)
        c[self._parts] += delta[MOTION:end]
        of_places = delta[end:].reshape(-1, PLACE_DIM)
        positions = [self._places[n] + by for n, by in zip(places, of_places, strict=True)]
        return moved(self._x[k][None], delta[None, :MOTION])[0], c, P, positions

    def estimate(self) -> tuple[Array, Array]:
        """All keyframes that iSAM2 has, and the calibration at each: shapes (n, 21), (n, C)."""
        n, segments = self.updated + 1, self._terms[self.updated].segment + 1
        delta = self._engine.getDelta().vector()  # in the order of keys
        c = np.array(self._c[:segments])
        c[:, self._parts] += delta[: segments * len(self._parts)].reshape(segments, -1)
        x = moved(np.array(self._x[:n]), delta[len(delta) - n * MOTION :].reshape(n, MOTION))
        return x, c[[term.segment for term in self._terms[:n]]]

    def knows(self, place: int) -> bool:
        """Whether a place of that number is part of the graph."""
        return place in self._places

    def off(self, turn: float, calibration: Array, within: int) -> int | None:
        """The first segment that is linearised too far from the estimate, or None.

        Parameters
        ----------
        turn : of the attitude with which it begins [rad]
        calibration : ndarray, shape (nc,), of its calibration
        within : so many newest keyframes are looked at
        """
        for s, begun in enumerate(self._begun):
            if begun <= self.updated - within:
                continue
            by = self._engine.calculateEstimateVector(key(CALIBRATION, s))
            turned = self._engine.calculateEstimateVector(key(POSE, begun))[:3]
            if (np.abs(by) > calibration).any() or (np.abs(turned) > turn).any():
                return s
        return None

    def relinearize(self, segment: int) -> None:
        """Move the point to the estimate from a segment on."""
        first, (x, c) = self._begun[segment], self.estimate()
        self._x[first:] = list(x[first:])
        self._c[segment:] = [c[begun] for begun in self._begun[segment:]]
        if segment > 0:
            self._removed = [slot for slots in self._slots[first:] for slot in slots]
        else:
            self._restart()
        self._replace(segment)

    def restart(self, problem: Problem, let_in: Gates, x: Array, c: Array) -> None:
        """Continue from another point, and with other measurements.

        Parameters
        ----------
        problem : what has been added, landmarks perhaps given to other places
        let_in : which of their measurements count, as an optimum has it
        x, c : ndarray, shapes (n, 21), (n, C), of their keyframes
        """
        kept = np.empty(len(problem.rows), bool)
        for sensor, admitted in let_in.items():
            kept[problem.of_sensor(sensor)] = admitted
        every = (np.arange(*problem.measured_in(k)) for k in range(len(problem)))
        self._terms = [
            IntervalTerms(self._filter, problem, k, rows[kept[rows]], term.segment)
            for k, (rows, term) in enumerate(zip(every, self._terms, strict=True))
        ]
        self._numbers = problem.number
        self._x, self._c, self._places = list(x), [c[begun] for begun in self._begun], {}
        self._restart()
        self._replace(0)

    def _replace(self, segment: int) -> None:
        """Have iSAM2 take the factors from a segment on, of which it has none, in the order of time."""
        first = self._begun[segment]
        del self._slots[first:]
        self._push(first)
        order = self._order = gtsam.KeyGroupMap()  # so that the newest keyframe is in the root
        for s, begun, end in self._spans(segment):
            for k in range(begun, end):
                order.insert2(key(POSE, k), k - first + s - segment)
            order.insert2(key(CALIBRATION, s), end - first + s - segment)
        self.update()

    def _spans(self, segment: int) -> list[tuple[int, int, int]]:
        """Segments from one on: number, first keyframe, and the one after the last."""
        begun = [*self._begun[segment:], len(self)]
        return [(segment + k, *ends) for k, ends in enumerate(pairwise(begun))]

    def _restart(self) -> None:
        """An empty tree."""
        self._engine = gtsam.ISAM2(isam2_params())
        self._graph, self._values, self._owners = gtsam.NonlinearFactorGraph(), gtsam.Values(), []

    def _push(self, first: int) -> None:
        """Have the factors from a keyframe on wait for the next update."""
        terms, segments = self._terms[first:], [term.segment for term in self._terms[first:]]
        x, c = np.array(self._x[max(first - 1, 0) :]), np.array([self._c[s] for s in segments])
        if first == 0:
            x = np.concatenate([x[:1], x])
        for k, (term, rows) in enumerate(zip(terms, self._linearization.linearize(terms, x, c), strict=True)):
            index, s = term.k, segments[k]
            factors = [_interval_factor(index, s, rows), *self._landmarks(term, x[k : k + 2], c[k])]
            if self._begun[s] == index:
                factors.append(self._calibration_factor(s, term))
                self._insert(key(CALIBRATION, s), len(self._parts))
            self._insert(key(POSE, index), MOTION)
            for factor in factors:
                self._graph.push_back(gtsam.LinearContainerFactor(factor))
            self._owners += [index] * len(factors)

    def _insert(self, name: int, dim: int) -> None:
        """A new variable of iSAM2; the error is zero at the point."""
        if not self._engine.valueExists(name):
            self._values.insert(name, np.zeros(dim))

    def _calibration_factor(self, s: int, first: IntervalTerms) -> gtsam.JacobianFactor:
        """The prior of the first segment's calibration, or the walk to a segment from the one before.

        ``first`` is the segment's first interval, with which knots of the current may be new.
        """
        calibration_key, here = key(CALIBRATION, s), self._c[s][self._parts]
        if s == 0:
            return gtsam.JacobianFactor(
                calibration_key, np.diag(1.0 / self._sd), (self._mean - here) / self._sd, _unit(len(here))
            )
        kept, sd = walked(self._walk, self._time_constant, first.time - self._terms[self._begun[s - 1]].time)
        before, own = np.diag(kept), np.eye(len(here))  # own x' = before x + w, in deviations from the means
        for name, neighbour, of_neighbour, added in self._filter.new_knots(first.problem, first.k):
            place = self._part(name)
            if neighbour == name:
                before[place] *= of_neighbour
                sd[place] = np.hypot(kept[place] * added, sd[place])
                continue
            before[place], sd[place] = 0.0, added
            if neighbour is not None:
                own[place, self._part(neighbour)] = -of_neighbour * np.eye(place.stop - place.start)
        off = before @ (self._c[s - 1][self._parts] - self._mean) - own @ (here - self._mean)
        before, own = before / sd[:, None], own / sd[:, None]
        return gtsam.JacobianFactor(key(CALIBRATION, s - 1), -before, calibration_key, own, off / sd, _unit(len(here)))

    def _part(self, name: str) -> slice:
        """Place of an estimated variable among these."""
        columns = self._filter.layout.columns[name]
        return slice(columns.start - MOTION, columns.stop - MOTION)

    def _landmarks(self, term: IntervalTerms, x: Array, c: Array) -> list[gtsam.JacobianFactor]:
        """Factors of the places that are seen in an interval, and priors of those that are new; ``x`` of its ends."""
        factors = []
        for row in term.landmarks:
            number, keyframe = int(self._numbers[row]), int(term.problem.keyframe[row])
            segment = self._terms[keyframe].segment
            block, here = self._filter.measurements(term.problem, np.array([row])), keyframe == term.k
            state = Gaussian(x[int(here)], c, np.empty((0, 0))).state
            name = key(PLACE, number)
            if number not in self._places:
                self._places[number] = block.predicted(state.seeing(ORIGIN))[0]
            if not self._engine.valueExists(name) and not self._values.exists(name):
                self._values.insert(name, np.zeros(PLACE_DIM))
                prior = np.eye(PLACE_DIM) / ANYWHERE_M
                factors.append(gtsam.JacobianFactor(name, prior, -prior @ self._places[number], _unit(PLACE_DIM)))
            r, jacobians = block.linearize(state.seeing(self._places[number]))
            H = self._filter.layout.matrix(jacobians)[0]
            root = np.sqrt(loss_and_weight(r, block.instrument.loss)[1][0])
            states = key(POSE, keyframe), root * H[:, :MOTION], key(CALIBRATION, segment), root * H[:, MOTION:]
            factors.append(
                gtsam.JacobianFactor(*states, name, root * jacobians[PLACE][0], root * r[0], _unit(len(r[0])))
            )
        return factors


def _interval_factor(index: int, segment: int, rows: LinearInterval) -> gtsam.JacobianFactor:
    terms, unit = (key(POSE, index), rows.A_j, key(CALIBRATION, segment), rows.C), _unit(len(rows.r))
    if index == 0:
        return gtsam.JacobianFactor(*terms, rows.r, unit)
    return gtsam.JacobianFactor(key(POSE, index - 1), rows.A_i, *terms, rows.r, unit)


def moved(x: Array, delta: Array) -> Array:
    """States, shape (n, 21), after errors, shape (n, 15)."""
    R, out = x[:, :9].reshape(-1, 3, 3), np.empty_like(x)
    out[:, :9] = (R @ exp_rotation(delta[:, :3])).reshape(-1, 9)
    out[:, 9:12] = x[:, 9:12] + rotate(R, delta[:, 3:6])
    out[:, 12:] = x[:, 12:] + delta[:, 6:]
    return out


UPDATE_S = 1.0  # of the dive, between updates of iSAM2, where not every keyframe is needed
# since the start, when the dive so far is solved with all its measurements: a gate may have been wrong before [s]
OPTIMUM_AT_S = (5.0, 10.0, 20.0, 40.0, 80.0)
CHECK_S = 1.0  # of the dive, at least, between looks for what is linearised too far from the estimate
CHECK_SHARE = 0.03  # and as a part of the dive so far
ANGLE_TOLERANCE = 0.01  # how far that may be [rad]
TOLERANCE = 0.02  # of what is no angle [1, m, s...]
SHARE = 0.2  # or as a part of its sd: less than that is not worth it while little is known
RELINEARISATIONS = 2  # at a time
MOST = 1000  # newest keyframes that are relinearised, which bounds what an update takes
STIFF = 2e-4  # walk of a constant, as a part of its prior's sd per root second


@dataclass
class IncrementalEstimator:
    """iSAM2 over the whole dive, fed measurement by measurement or interval by interval.

    Attributes
    ----------
    initial : of `rovgraph.inference.initialise.initialise`
    update_s : of the dive, between updates of iSAM2; in between, the filter goes on from it [s]
    searches : of other solutions of the dive, as configured the same
    problem : the dive, as far as it has been taken
    known : Gaussian of the newest keyframe
    history : the filtered estimate of every keyframe
    """

    initial: InitialConditions
    update_s: float = 0.0
    searches: Searches | None = None

    def __post_init__(self) -> None:
        b = self.initial
        self.filter = FilterEngine(b, considers=False)
        self.known = self.filter.start()
        self.history = FilterHistory(self.filter)
        self.gates: FilterGates = {}
        self.engine = Incremental(self.filter, {name: _stiff(belief) for name, belief in b.beliefs.items()})
        self.assembly = assembly_of(b)
        self.problem = self.assembly.problem
        self._count = 0  # keyframes that have been taken
        self._numbers = np.empty(0, np.int64)  # of the places that measurements are of, as the filter has it
        names = self.filter.unknowns.estimated
        tolerance = [np.full(v.dim, ANGLE_TOLERANCE if v.angular else TOLERANCE) for v in (TABLE[n] for n in names)]
        self._tolerance = np.concatenate([np.empty(0), *tolerance])
        self._optima = list(OPTIMUM_AT_S)
        self._due = -np.inf  # when to look for what is linearised too far from the estimate [s]

    @property
    def updated(self) -> int:
        """Newest keyframe that iSAM2 has, -1 = none."""
        return self.engine.updated

    def add(self, measurement: Measurement) -> int:
        """Take a measurement, whose time is not before that of others; how many keyframes it completes."""
        self.assembly.insert(measurement)
        return self._take(self.assembly.extend())

    def finish(self) -> int:
        """Close the last interval; how many keyframes that completes."""
        made = self._take(self.assembly.extend(finish=True))
        self.update()
        return made

    def step(self, problem: Problem, k: int) -> FilterStep:
        """Take an interval: predicted and gated from iSAM2's estimate of the keyframe before, then added."""
        done = self.filter.step(problem, k, self.known, self.gates)
        self.take(problem, k, done.filtered, done.met)
        self.history.append(self.known, done.met, problem.keyframes)
        return done

    def take(self, problem: Problem, k: int, known: Gaussian, met: Met) -> None:
        """Take a keyframe with its admitted measurements.

        Parameters
        ----------
        problem, k : the dive so far, and its keyframe
        known : where to linearise it at first
        met : its measurements
        """
        self.known, self.problem, self._count = known, problem, k + 1
        self._numbers = np.append(self._numbers, met.number)
        let_in = (met.weight > 0.0) | (met.number >= 0)
        self.engine.add(problem, k, known, met.index[let_in], self._numbers)
        if problem.time[k] - problem.time[max(self.updated, 0)] >= self.update_s:
            self.update()

    def update(self) -> None:
        """Update iSAM2 with the intervals since; the filter continues from its newest keyframe."""
        if self.updated == self._count - 1:
            return
        self.engine.update()
        self._know()
        now = float(self.problem.time[self._count - 1])
        since = now - float(self.problem.time[0])
        if self._optima and since >= self._optima[0]:
            self._optima.pop(0)
            self._restart()
        elif now >= self._due:
            self._due = now + max(CHECK_S, CHECK_SHARE * since)
            self._relinearise()

    def _relinearise(self) -> None:
        """Move the point to the estimate as far back as it is off."""
        for _ in range(RELINEARISATIONS):
            sd = np.sqrt(np.diagonal(self.known.P)[: self.filter.layout.size])
            turn = max(ANGLE_TOLERANCE, SHARE * float(sd[:3].max()))
            off = self.engine.off(turn, np.maximum(self._tolerance, SHARE * sd[MOTION:]), MOST)
            if off is None:
                return
            self.engine.relinearize(off)
            self._know()

    def _restart(self) -> None:
        """Continue from the optimum of the dive so far, with its admitted measurements."""
        best = self._optimum()
        n, state = self._count, best.state
        calibration = {name: np.broadcast_to(value, (n, value.shape[-1])) for name, value in state.calibration.items()}
        x = np.concatenate([state.R_nb.reshape(n, 9), state.p_n, state.v_n, state.bias], axis=1)
        c = np.concatenate([calibration[name] for name in LAYOUT], axis=1)
        self.engine.restart(best.problem, best.solution.gates, x, c)
        self._know()

    def _know(self) -> None:
        """The newest keyframe as iSAM2 has it."""
        places = [place for place in self.known.places if self.engine.knows(place.number)]
        x, c, P, positions = self.engine.newest([place.number for place in places])
        remembered = (replace(p, position=q) for p, q in zip(places, positions, strict=True))
        self.known = Gaussian(x, c, P, tuple(remembered))

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self.known.state

    def states(self) -> State:
        """Of each keyframe that iSAM2 has taken, from all data so far; calibration has shape (n, dim)."""
        return states_of(*self.engine.estimate())

    def filtered(self) -> Estimate:
        """The filtered estimate of each keyframe, from when it was the newest."""
        return self.history.estimate(self.problem, "filtered")

    def solve(self) -> Estimate:
        """The smoothed trajectory with its uncertainty."""
        return smoothed(self.optimum(), self.initial)

    def optimum(self) -> Optimum:
        """The optimum of all that was taken, which is where the smoothed trajectory comes from."""
        self.update()
        return self._optimum()

    def _optimum(self) -> Optimum:
        """The dive so far, solved from iSAM2's estimate; a landmark beyond its gate there gets a place of its own."""
        states, problem = self.states(), self.problem.upto(self._count)
        given = self.initial, states, newest_calibration(states.calibration)
        seen = problem.of_sensor(PLACE)
        if not len(seen):
            return optimum(problem, *given, searches=self.searches)
        best = associated_optimum(resolved(problem, self._numbers[seen]), *given)
        out = best.blocks[PLACE].believed & ~best.solution.gates[PLACE]
        if not out.any():
            return without_rate_noise(best)
        apart = np.where(out, problem.number[seen], self._numbers[seen])
        return without_rate_noise(associated_optimum(resolved(problem, apart), *given))

    def _take(self, count: int) -> int:
        """Take the newest keyframes of the assembly."""
        problem = self.assembly.problem
        for k in range(len(problem) - count, len(problem)):
            self.step(problem, k)
        return count


def run_isam2(
    problem: Problem,
    initial: InitialConditions,
    progress: Callable[[float], None] = lambda done: None,
    update_s: float = 0.0,
    searches: Searches | None = None,
) -> IncrementalEstimator:
    """iSAM2 that has taken the keyframes of a dive; ``progress`` receives 0 to 1 now and then."""
    estimator = IncrementalEstimator(initial, update_s, searches)
    for k in range(len(problem)):
        estimator.step(problem, k)
        if k % 50 == 0:
            progress(k / len(problem))
    estimator.update()
    return estimator


def _stiff(belief: Belief) -> Belief:
    """What is constant, as something that hardly walks."""
    return belief if belief.walk else replace(belief, walk=STIFF * belief.sd)
