"""The optimum of a dive without closed loops, with the interface of `rovgraph.inference.optimum`.

`window` makes a part of a chain that is solved by itself. The keyframes before the part are eliminated at the point
where the chain stands; their information about the part's first keyframe and the border stays as rows, its prior. The
keyframes after the part are left out.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, partial

import numpy as np

from rovgraph.geometry import Array, log_rotation, right_jacobian
from rovgraph.inference import gauss_newton
from rovgraph.inference.chain import CLONED, CONDITIONALS, MOTION, NOTHING, Chain, ChainStep
from rovgraph.inference.chain_information import MeasurementRows, SquareRoot
from rovgraph.inference.faulty_intervals import Searches, converged, resume, solve
from rovgraph.inference.gauss_newton import Gates, GaussNewtonResult, left_after, whole_share
from rovgraph.inference.optimum import Knowledge
from rovgraph.inference.widened_chain import widened
from rovgraph.kernels.chain_posterior import back_substitute
from rovgraph.model.calibration import Belief
from rovgraph.model.state import COLUMNS, MOTION_STATE, State
from rovgraph.problem.calibration_roles import CalibrationRoles, unknowns
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.measurements import Measurements, weights_of
from rovgraph.problem.problem import Problem

_ONE = np.ones(1)


@dataclass(frozen=True)
class ChainWindow:
    """Some keyframes of a chain, as `rovgraph.inference.faulty_intervals.SubProblem`.

    Attributes
    ----------
    problem : they as a chain
    keyframes : which of the dive's
    within : sensor -> which of its measurements lie in the window
    """

    problem: Chain
    keyframes: slice
    within: dict[str, slice]

    def point(self, whole: State) -> State:
        """As `rovgraph.inference.faulty_intervals.SubProblem`."""
        return whole.at(self.keyframes)

    def gates(self, whole: Gates) -> Gates:
        """As `rovgraph.inference.faulty_intervals.SubProblem`."""
        return {sensor: whole[sensor][part] for sensor, part in self.within.items()}

    def with_gates(self, whole: Gates, own: Gates) -> Gates:
        """As `rovgraph.inference.faulty_intervals.SubProblem`."""
        out = {sensor: gate.copy() for sensor, gate in whole.items()}
        for sensor, part in self.within.items():
            out[sensor][part] = own[sensor]
        return out


def window(chain: Chain, solution: GaussNewtonResult[State], begin: float, end: float) -> ChainWindow | None:
    """The keyframes between two times; None = they are half of the dive, or a sensor has no kernel.

    Parameters
    ----------
    chain, solution : the dive, and where what lies before the window is linearised
    begin, end : [s]
    """
    rows = chain.problem
    first, last = (int(k) for k in np.searchsorted(rows.time, (begin, end)))
    if 2 * (last - first) > len(rows) or chain.given:
        return None
    m = int(rows.first[first + (first > 0)]), int(rows.first[last])  # the head has those of the first keyframe
    here = replace(chain, problem=rows.part(first, last, *m))
    if first > 0:
        own = {f.name: getattr(here, f.name) for f in fields(Chain)}
        head = _known_before(chain, solution, first)
        here = _HeadedChain(**own, head=head, at=solution.point.at(slice(first, first + 1)))
    places = {sensor: rows.of_sensor(sensor).searchsorted(m).tolist() for sensor in rows.sensors}
    within = {sensor: slice(*place) for sensor, place in places.items() if place[0] < place[1]}
    return ChainWindow(here, slice(first, last), within)


def _known_before(chain: Chain, solution: GaussNewtonResult[State], keyframe: int) -> Array:
    """Rows of a keyframe and the border with their right-hand sides, of the data up to it, shape (d + c, d + c + 1)."""
    (rows,) = chain.eliminate(solution.point, solution.gates, [keyframe], kept=1).filtered
    known = len(rows) - CLONED  # the clone of the first attitude stands last, and is eliminated first here
    order = np.r_[known : known + CLONED, :known, known + CLONED]
    R: Array = np.asarray(np.linalg.qr(rows[:, order], mode="r"))
    return R[CLONED:, CLONED:]


@dataclass(frozen=True)
class _HeadedChain(Chain):
    """A chain that begins with rows of its first keyframe and the border.

    Attributes
    ----------
    head : ndarray, shape (d + c, d + c + 1), with their right-hand sides, linearised at ``at``
    at : State of one epoch
    """

    head: Array
    at: State

    def prior_residuals(self, point: State) -> tuple[Array, Array]:
        """Whitened residuals of the head, shape (d + c,), and of nothing else."""
        return self.head[:, :-1] @ self._moved_from(point) - self.head[:, -1], np.empty(0)

    def _moved_from(self, point: State) -> Array:
        """The step that leads to a point, shape (d + c,)."""
        R_nb, layout = self.at.R_nb[0], self.layout
        step = np.empty(layout.d + layout.c)
        step[:3] = log_rotation(R_nb.T @ point.R_nb[0])
        step[3:6] = R_nb.T @ (point.p_n[0] - self.at.p_n[0])
        step[6:9] = point.v_n[0] - self.at.v_n[0]
        step[9:MOTION] = point.bias[0] - self.at.bias[0]
        for name in layout.places:
            now, then = (np.atleast_2d(s.calibration[name])[0] for s in (point, self.at))
            step[layout.target(name)] = now - then
        return step

    def _room(self, clones: int) -> MeasurementRows:
        size = len(self.head)
        keyframes = [np.zeros(1, np.int64), *(np.empty(0, np.int64),) * (CONDITIONALS - 1), self._conditionals[0]]
        return MeasurementRows(len(self.problem), MOTION, keyframes, [size, 0, 0, 1], size - MOTION)

    def _put_priors(self, rows: MeasurementRows, point: State, clones: int) -> None:
        r, _ = self.prior_residuals(point)
        R = self.at.R_nb[0].T @ point.R_nb[0]
        J = self.head[:, :MOTION].copy()
        J[:, :3] = J[:, :3] @ np.linalg.inv(right_jacobian(log_rotation(R)))
        J[:, 3:6] = J[:, 3:6] @ R
        rest = np.arange(MOTION, len(self.head))
        rows.put(0, -r[None], J[None], self.head[None, :, MOTION:-1], rest, _ONE)

    def _border_rows(self, point: State, clones: int) -> Array:
        return np.zeros((0, self.layout.c + clones + 1))


SHORT = 6000  # keyframes whose conditionals take 40 MB


@dataclass(eq=False)
class ChainOptimum:
    """A chain and where its robust cost is least.

    Constants that are considered stand last in the border of what is eliminated here: all of them are known to their
    priors and to nothing better, which is in every covariance.

    Attributes
    ----------
    chain, solution : the dive, and its optimum
    begun : where the last step to it began, of the elimination that all covariances come of; None = there was none
    at_hand : what it is eliminated to, if it has been
    """

    chain: Chain
    solution: GaussNewtonResult[State]
    begun: State | None = None
    at_hand: SquareRoot | None = None

    @property
    def problem(self) -> Problem:
        return self.chain.problem

    @property
    def initial(self) -> InitialConditions:
        return self.chain.initial

    @property
    def beliefs(self) -> Mapping[str, Belief]:
        return self.chain.beliefs

    @property
    def unknowns(self) -> CalibrationRoles:
        return self.chain.unknowns

    @property
    def blocks(self) -> Mapping[str, Measurements]:
        return self.chain.blocks

    @property
    def state(self) -> State:
        return self.solution.point

    @cached_property
    def weights(self) -> Mapping[str, Array]:
        return weights_of(self.chain.seen(self.state, self.blocks), self.solution.gates)

    @property
    def places(self) -> Mapping[int, Array]:
        return {}

    @cached_property
    def wide(self) -> Chain:
        """The chain with what is considered in its border."""
        names = self.unknowns.considered
        return widened(self.chain, self.state, names) if names else self.chain

    @cached_property
    def believed(self) -> Array:
        """Covariance of what is considered, shape (h, h)."""
        beliefs = [self.beliefs[name] for name in self.unknowns.considered]
        return np.diag(np.concatenate([np.empty(0), *(np.full(b.variable.dim, b.sd**2) for b in beliefs)]))

    @property
    def linearised_at(self) -> State:
        """Where all factors are linearised."""
        return self.solution.point if self.begun is None else self.begun

    def eliminated(self) -> SquareRoot:
        """All factors linearised and eliminated, what is considered last in the border; errors count from `state`.

        A long dive has no room for two: the caches are freed.
        """
        root = self.at_hand
        if root is None:
            root = self.wide.eliminate(self.linearised_at, self.solution.gates)
            if self.begun is not None:
                root.move_to(root.solve(len(self.believed))[1])
        self.at_hand = root
        _ = self._end, self.linear  # they need little of it
        if len(self.problem) > SHORT:
            self.at_hand = None
        return root

    @cached_property
    def _end(self) -> SquareRoot:
        """The same, of the newest keyframe and the border."""
        if self.at_hand is None:
            return self.wide.eliminate(self.linearised_at, self.solution.gates, kept=1)
        at_hand = self.at_hand
        return replace(at_hand, conditionals=at_hand.conditionals[-1:].copy(), border=at_hand.border.copy())

    @cached_property
    def linear(self) -> tuple[float, float]:
        """Log determinant of the information of what is estimated, and its least sum of squares."""
        held, gates = len(self.believed), self.solution.gates
        root = self.at_hand or self.wide.eliminate(self.linearised_at, gates, diagonal=True)
        return root.log_determinant(held), root.least(held)

    def with_final_step(self) -> "ChainOptimum":
        """The optimum after a final step, from the elimination that gives its covariances.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        known = self.solution
        if not known.converged:
            return self
        promised, decrease, step, there = self._last_step()
        if there is not None:
            return there
        point = self.wide.moved(self.state, step, 1.0)
        further = self.wide.moved(self.state, step, whole_share(promised, decrease))
        some = [one for one in (converged(self.chain, at, known) for at in (further, point)) if one]
        ahead = min(some, key=lambda one: one.cost, default=known)
        if ahead.cost < known.cost and known.iterations < gauss_newton.MAX_ITERATIONS:
            return ChainOptimum(self.chain, replace(ahead, iterations=known.iterations + 1)).with_final_step()
        again = resume(self.chain, self.state, known)
        return ChainOptimum(self.chain, replace(again, iterations=known.iterations + again.iterations))

    def _last_step(self) -> "tuple[float, float, ChainStep, ChainOptimum | None]":
        """Predicted and actual decrease of the step from here, the step, and the optimum there if it has converged."""
        root, held, known = self.eliminated(), len(self.believed), self.solution
        promised, (x, y) = root.explained(held), root.solve(held)
        step = ChainStep(x, y)
        point = self.wide.moved(self.state, step, 1.0)
        decrease = self.chain.cost(self.state, known.gates) - self.chain.cost(point, known.gates)
        if promised > gauss_newton.FINAL_TOLERANCE or left_after(promised, decrease) > gauss_newton.FINE:
            return promised, decrease, step, None
        there = replace(known, point=point, cost=known.cost - decrease, iterations=known.iterations + 1)
        root.move_to(y)
        self.at_hand = None  # errors count from there now
        after = ChainOptimum(self.chain, there, self.state, root)
        after.wide = self.wide
        return promised, decrease, step, after

    def _other(self, chain: Chain, moved: Mapping[str, Array], score: Array | None = None) -> "ChainOptimum":
        """The optimum of a chain with other unknowns of these, from where its linear problem has it.

        Parameters
        ----------
        moved : constants that are held now, and by how much they move for it
        score : ndarray, shape (c,), as `SquareRoot.border_with`
        """
        begin = self._moved_to(chain.unknowns.estimated, moved, score)
        known = converged(chain, begin, self.solution) or resume(
            chain, begin, self.solution, gauss_newton.FINAL_TOLERANCE
        )
        return ChainOptimum(chain, known).with_final_step()

    def _moved_to(self, estimated: Sequence[str], moved: Mapping[str, Array], score: Array | None) -> State:
        """Where the linear problem has its least sum with these estimated, and the rest as in `_other`."""
        root, places, y = self.eliminated(), self.wide.layout.places, np.zeros(self.wide.layout.c)
        for name, by in moved.items():
            y[places[name][1]] = by
        free = [places[name] for name in estimated]
        y = root.border_with(np.concatenate([NOTHING, *(np.r_[part] for border, part in free if border)]), y, score)
        return self.wide.moved(self.state, ChainStep(root.followed(y), y), 1.0)

    def sd_of_noise(self) -> dict[str, Array]:
        """The sd of estimated constants if all considered ones were known: name -> ndarray, shape (dim,)."""
        P, places = self._end.border_covariance(0.0 * self.believed), self.wide.layout.places
        border = [name for name in self.unknowns.estimated if places[name][0]]
        return {name: np.sqrt(np.diagonal(P[places[name][1], places[name][1]])) for name in border}

    def moved_by_considered(self) -> Iterator[State]:
        """The optimum with each considered component one sd away, and the estimated variables following it."""
        root, held = self.eliminated(), len(self.believed)
        for k in range(held):
            y = np.zeros(len(root.border))
            y[len(y) - held + k] = np.sqrt(self.believed[k, k])
            y = root.border_with(np.arange(len(y) - held), y, unforced=True)
            x = np.zeros_like(root.conditionals[:, :, -1:])
            back_substitute(root.conditionals, y[:, None], x)
            yield self.wide.moved(self.state, ChainStep(x[..., 0], y), 1.0)

    def relative_sd(self) -> dict[str, Array]:
        """As `rovgraph.inference.optimum.Optimum`."""
        P, places = self._end.border_covariance(), self.wide.layout.places
        names = self.unknowns.considered
        return {
            name: np.sqrt(np.diagonal(P[places[name][1], places[name][1]])) / self.beliefs[name].sd for name in names
        }

    def estimating(self, names: Sequence[str]) -> "ChainOptimum":
        """As `rovgraph.inference.optimum.Optimum`."""
        return self._other(replace(self.chain, unknowns=self.unknowns.estimating(names)), {})

    def covariances(self) -> dict[str, Array]:
        """As `rovgraph.inference.optimum.Optimum`."""
        P, P_y = self._marginals()
        out = {name: P[:, own, own] for name, own in COLUMNS.items()} | {MOTION_STATE: P[:, :MOTION, :MOTION]}
        for name, (border, own) in self.wide.layout.places.items():
            out[name] = np.broadcast_to(P_y[own, own], (len(P), *P_y[own, own].shape)) if border else P[:, own, own]
        return out

    def _marginals(self) -> tuple[Array, Array]:
        """Covariances of the keyframes, shape (n, d, d), and of the border."""
        root, P_y = self.eliminated(), self._end.border_covariance(self.believed)
        return (root.covariances(P_y) if len(self.problem) <= SHORT else root.turn_into_covariances(P_y)), P_y

    def newest_covariance(self, places: Sequence[int] = ()) -> Array:
        """As `rovgraph.inference.optimum.Optimum`."""
        layout, names = self.wide.layout, (*self.unknowns.estimated, *self.unknowns.considered)
        chosen = np.concatenate([np.arange(MOTION), *(layout.target(name) for name in names)])
        newest = self._end.newest_covariance(self._end.border_covariance(self.believed))
        return np.asarray(self.given(newest, [len(self.problem) - 1])[np.ix_(chosen, chosen)])

    def given(self, P: Array, keyframes: Sequence[int], root: SquareRoot | None = None) -> Array:
        """Joint covariance of q keyframes and the border about `state`, shape (q d + c, q d + c), from the chain's own.

        Parameters
        ----------
        root : of `eliminated`; None = the newest keyframe alone, which needs none
        """
        return P

    def drawn(self, x: Array, y: Array, root: SquareRoot, rng: np.random.Generator) -> Iterator[State]:
        """States of m draws of the chain's errors, shapes (n, d, m) and (c, m)."""
        for j in range(x.shape[2]):
            yield self.wide.moved(self.solution.point, ChainStep(x[..., j], y[:, j]), 1.0)

    @cached_property
    def newest_of_known_constants(self) -> Array:
        """Covariance of the newest keyframe, were the border's constants known, shape (15, 15)."""
        none = np.zeros((len(self._end.border),) * 2)
        return self._end.newest_covariance(none)[:MOTION, :MOTION]

    def knowledge(self, keyframes: Sequence[int]) -> Knowledge:
        """As `rovgraph.inference.optimum.Optimum`."""
        return self._knowledge_at(self.linearised_at, keyframes)

    def noisier(self, keyframes: Sequence[int], seed: int = 1) -> tuple[Knowledge, Knowledge]:
        """As `rovgraph.inference.optimum.Optimum`."""
        held = replace(self.chain, unknowns=self.unknowns.of(()))
        white = np.random.default_rng(seed).standard_normal((len(self.problem), MOTION))
        # the border does not touch what the keyframes' own columns are eliminated to
        own = held.eliminate(self.linearised_at, self.solution.gates) if self.wide.layout.walking else self.eliminated()
        noise = own.draw(white)
        more, less = (
            self._knowledge_at(held.moved(self.linearised_at, ChainStep(sign * noise, np.empty(0)), 1.0), keyframes)
            for sign in (1.0, -1.0)
        )
        return more, less

    def considering(self, names: Sequence[str]) -> "ChainOptimum":
        """As `rovgraph.inference.optimum.Optimum`."""
        held = {name: replace(self.beliefs[name], score=0.0) for name in names}
        unknowns = self.unknowns.considering(names)
        without = replace(self.chain, unknowns=unknowns, beliefs={**self.beliefs, **held})
        return self._other(without, {n: self.beliefs[n].mean - self.state.calibration[n] for n in names})

    def with_score(self, name: str, score: Array) -> "ChainOptimum":
        """The optimum with another `Belief.score` of an estimated constant."""
        more, own = np.zeros(self.wide.layout.c), replace(self.beliefs[name], score=score)
        more[self.wide.layout.places[name][1]] = score - self.beliefs[name].score
        return self._other(replace(self.chain, beliefs={**self.beliefs, name: own}), {}, more)

    def _knowledge_at(self, point: State, keyframes: Sequence[int]) -> Knowledge:
        wide = self.wide
        root, layout = wide.eliminate(point, self.solution.gates, keyframes, kept=1), wide.layout
        held = [int(k) for name in self.unknowns.considered for k in layout.target(name)]
        P = root.filtered_covariances(held, self.believed)
        attitude = layout.d + layout.c + np.arange(3)
        calibration = [layout.target(name) for name in self.unknowns.estimated]
        chosen = np.concatenate([np.arange(9, MOTION), attitude, *calibration])
        return Knowledge(np.array(keyframes), P[:, chosen[:, None], chosen])


def smooth_chain(
    problem: Problem,
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
    searches: Searches | None = None,
    freed: bool = False,
) -> ChainOptimum:
    """Solve a dive that closes no loop.

    Parameters
    ----------
    problem, initial : the dive
    states : State of its keyframes to begin with
    calibration : to begin with, its prior means where it is None
    searches : of other solutions of the dive, as configured the same
    freed : what is considered is estimated

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    beliefs = initial.beliefs
    wanted = unknowns(beliefs, problem.used)
    chain = Chain(problem, initial, beliefs, wanted.estimating(wanted.considered) if freed else wanted)
    held = [name for name in chain.unknowns.considered if not beliefs[name].variable.time_offset]
    free = partial(widened, chain, names=tuple(held)) if held else None
    solution = solve(chain, chain.start(states, calibration), free, window, searches, gauss_newton.FINAL_TOLERANCE)
    return ChainOptimum(chain, solution).with_final_step()
