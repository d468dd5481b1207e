"""Incremental smoothing over a whole dive: iSAM2 (Kaess et al. 2012) of a linearised graph.

iSAM2 holds the errors about a point: one variable for each keyframe, one for the calibration of each segment of
time, and one for each place. An interval is one factor, linearised by the compiled equations
(`rovgraph.graph.linear_intervals`), so that an update calls nothing back and eliminates two cliques. iSAM2 does not
relinearise by itself: `relinearize` moves the point to the estimate from some segment on and replaces the factors
from there, which is the part of the Bayes tree that a change of these variables would take up anyway.

By QR, as Cholesky squares the rows of precise motions. A constant that all keyframes share would make every update
touch the whole tree, so each segment has its own, tied to the one before by a walk that hardly moves.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise

import gtsam
import numpy as np

from rovgraph.calibration import LAYOUT, Belief
from rovgraph.engine.filter import ORIGIN, FilterEngine
from rovgraph.engine.filter_step import Gaussian
from rovgraph.engine.gauss_newton import Gates
from rovgraph.engine.measurements import loss_and_weight
from rovgraph.engine.problem import Index, Problem
from rovgraph.errors import InputError
from rovgraph.gauss_markov import walked
from rovgraph.geometry import Array, exp_rotation, rotate
from rovgraph.graph.batch import indeterminate
from rovgraph.graph.factors import ANYWHERE_M
from rovgraph.graph.keys import CALIBRATION, key
from rovgraph.graph.linear_intervals import IntervalTerms, LinearInterval, Linearization
from rovgraph.kernels.assembly import SEGMENT
from rovgraph.kernels.layout import MOTION
from rovgraph.state import PLACE, PLACE_DIM, POSE

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
    filter : knows equations, prior and the layout of the error
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
        term = IntervalTerms(self._filter, problem, k, let_in)
        if term.segment == len(self._c):
            self._c.append(known.c)
            self._begun.append(k)
        self._terms.append(term)
        self._x.append(known.x)
        self._numbers = numbers
        self._push(k)

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
        own = MOTION + len(self._parts)
        c[self._parts] += delta[MOTION:own]
        of_places = delta[own:].reshape(-1, PLACE_DIM)
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
            self._removed = [slot for own in self._slots[first:] for slot in own]
        else:
            self._restart()
        self._replace(segment)

    def restart(self, problem: Problem, let_in: Gates, x: Array, c: Array) -> None:
        """Go on from another point, and with other measurements.

        Parameters
        ----------
        problem : what has been added, landmarks perhaps given to other places
        let_in : which of their measurements count, as an optimum has it
        x, c : ndarray, shapes (n, 21), (n, C), of their keyframes
        """
        kept = np.empty(len(problem.rows), bool)
        for sensor, own in let_in.items():
            kept[problem.of_sensor(sensor)] = own
        every = (np.arange(*problem.measured_in(k)) for k in range(len(problem)))
        self._terms = [IntervalTerms(self._filter, problem, k, own[kept[own]]) for k, own in enumerate(every)]
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
                factors.append(self._calibration_factor(s, term.time))
                self._insert(key(CALIBRATION, s), len(self._parts))
            self._insert(key(POSE, index), MOTION)
            for factor in factors:
                self._graph.push_back(gtsam.LinearContainerFactor(factor))
            self._owners += [index] * len(factors)

    def _insert(self, name: int, dim: int) -> None:
        """A variable that iSAM2 does not know yet; the error is zero at the point."""
        if not self._engine.valueExists(name):
            self._values.insert(name, np.zeros(dim))

    def _calibration_factor(self, s: int, time: float) -> gtsam.JacobianFactor:
        """The prior of the first segment's calibration, or the walk to a segment from the one before."""
        own, here = key(CALIBRATION, s), self._c[s][self._parts]
        if s == 0:
            return gtsam.JacobianFactor(own, np.diag(1.0 / self._sd), (self._mean - here) / self._sd, _unit(len(here)))
        duration = time - self._terms[self._begun[s - 1]].time
        kept, sd = walked(self._walk, self._time_constant, duration)
        off = (self._mean + kept * (self._c[s - 1][self._parts] - self._mean) - here) / sd
        return gtsam.JacobianFactor(
            key(CALIBRATION, s - 1), -np.diag(kept / sd), own, np.diag(1.0 / sd), off, _unit(len(here))
        )

    def _landmarks(self, term: IntervalTerms, x: Array, c: Array) -> list[gtsam.JacobianFactor]:
        """Factors of the places that are seen in an interval, and priors of those that are new; ``x`` of its ends."""
        factors = []
        for row in term.landmarks:
            number, keyframe = int(self._numbers[row]), int(term.problem.keyframe[row])
            segment = int(term.problem.keyframes[keyframe, SEGMENT])
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
    own, unit = (key(POSE, index), rows.A_j, key(CALIBRATION, segment), rows.C), _unit(len(rows.r))
    if index == 0:
        return gtsam.JacobianFactor(*own, rows.r, unit)
    return gtsam.JacobianFactor(key(POSE, index - 1), rows.A_i, *own, rows.r, unit)


def moved(x: Array, delta: Array) -> Array:
    """States, shape (n, 21), after errors, shape (n, 15)."""
    R, out = x[:, :9].reshape(-1, 3, 3), np.empty_like(x)
    out[:, :9] = (R @ exp_rotation(delta[:, :3])).reshape(-1, 9)
    out[:, 9:12] = x[:, 9:12] + rotate(R, delta[:, 3:6])
    out[:, 12:] = x[:, 12:] + delta[:, 6:]
    return out
