"""The optimum of a graph and its covariances, with the interface of `rovgraph.inference.optimum`.

Marginal covariances come from the Bayes tree. `knowledge` gives the information that the data up to a time hold about
the calibration: the dive is eliminated piece by piece in the order of time, by QR. From each piece remain conditionals
of its last keyframe and of the calibration, which are factors of the next piece. So every piece ends with the exact
joint covariance given all data so far, every factor linearised at the same values, and the whole costs one elimination.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import gtsam
import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, transpose
from rovgraph.inference.gauss_newton import Gates, GaussNewtonResult
from rovgraph.inference.graph.batch import DiveGraph, indeterminate, make_graph, solve
from rovgraph.inference.graph.values import calibration_key, dimension, is_place, key, key_index
from rovgraph.inference.optimum import Knowledge
from rovgraph.model.calibration import TABLE, Belief
from rovgraph.model.state import BIAS, COLUMNS, DIMENSION, MOTION_STATE, PLACE, PLACE_DIM, POSE, VELOCITY, State
from rovgraph.problem.calibration_roles import CalibrationRoles
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.measurements import Measurements
from rovgraph.problem.problem import Problem


def knowledge(graph: DiveGraph, values: gtsam.Values, gates: Gates, keyframes: Sequence[int]) -> Knowledge:
    """Estimates of the calibration from the data up to each of some keyframes.

    Parameters
    ----------
    graph, values, gates : the dive, and where to linearise it
    keyframes : increasing, the first beyond 0

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    left, joint = gtsam.GaussianFactorGraph(), []
    for end, piece in zip(keyframes, _pieces(graph, graph.linearize(values, gates), keyframes), strict=True):
        piece.push_back(left)
        last = [key(v, end) for v in (POSE, VELOCITY, BIAS)]
        last += [key(POSE, 0), *_calibration(graph, int(graph.index[end]))]
        open_places = _seen_again(graph, end)
        left, root = eliminate(piece, last + open_places)
        size = len(root) - PLACE_DIM * len(open_places)
        joint.append((root @ root.T)[:size, :size])
    P = np.array(joint)
    begin = DIMENSION[POSE] + DIMENSION[VELOCITY]
    rows = np.r_[begin : begin + 9, begin + 12 : P.shape[1]]  # without the first position
    return Knowledge(np.array(keyframes), P[:, rows[:, None], rows])


def eliminate(linear: gtsam.GaussianFactorGraph, last: Sequence[int]) -> tuple[gtsam.GaussianFactorGraph, Array]:
    """All but the last keys eliminated.

    Returns
    -------
    left : what is known of the last keys, as factors
    root : ndarray, shape (d, d), square root of their joint covariance, in their order
    """
    net = _sequential(linear, last)
    left, order = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    for i, one in enumerate(last, net.size() - len(last)):
        left.push_back(net.at(i))
        order.push_back(one)
    return left, np.linalg.inv(np.linalg.qr(left.jacobian(order)[0], mode="r"))


def noise_of_states(graph: DiveGraph, values: gtsam.Values, gates: Gates, seed: int = 1) -> gtsam.VectorValues:
    """A draw of the states' error from their posterior, calibration held.

    Parameters
    ----------
    graph, values, gates : the dive, and where to linearise it
    seed : of the draw
    """
    held = list(dict.fromkeys(one for k in range(int(graph.index[-1]) + 1) for one in _calibration(graph, k)))
    net, rng = _sequential(graph.linearize(values, gates), held), np.random.default_rng(seed)
    white, first_held = gtsam.VectorValues(), net.size() - len(held)
    for i in range(net.size()):
        rows = net.at(i).rows()
        white.insert(net.at(i).firstFrontalKey(), rng.standard_normal(rows) if i < first_held else np.zeros(rows))
    return net.backSubstitute(white)


def sensitivity(graph: DiveGraph, values: gtsam.Values, gates: Gates, names: Sequence[str]) -> dict[int, Array]:
    """Derivative of the optimum of all else by given calibration variables.

    Parameters
    ----------
    graph, values, gates : the dive, the variables in it, and where to linearise
    names : of constant variables, k components together

    Returns
    -------
    dict : key -> ndarray, shape (dim, k), derivative of the optimum
    """
    given = [key(name) for name in names]
    net = _sequential(graph.linearize(values, gates), given)
    others = net.size() - len(given)
    root, order = gtsam.GaussianFactorGraph(), gtsam.Ordering()
    for i, one in enumerate(given, others):
        root.push_back(net.at(i))
        order.push_back(one)
    R, ends = root.jacobian(order)[0], np.cumsum([net.at(i).rows() for i in range(others, net.size())])[:-1]
    columns: dict[int, list[Array]] = {net.at(i).firstFrontalKey(): [] for i in range(others)}
    for unit in R.T:  # the given variables' own rows where one component is 1, all others 0
        rhs = gtsam.VectorValues()
        for i in range(others):
            rhs.insert(net.at(i).firstFrontalKey(), np.zeros(net.at(i).rows()))
        for one, component in zip(given, np.split(unit, ends), strict=True):
            rhs.insert(one, component)
        moved = net.backSubstitute(rhs)
        for one, column in columns.items():
            column.append(moved.at(one))
    return {one: np.column_stack(column) for one, column in columns.items()}


def _sequential(linear: gtsam.GaussianFactorGraph, last: Sequence[int]) -> gtsam.GaussianBayesNet:
    """All eliminated one by one, by QR, the last keys at the end in their order."""
    ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, list(last), True)
    try:
        return linear.eliminateSequential(ordering, gtsam.EliminateQR)
    except RuntimeError as error:
        raise InputError(indeterminate(error)) from None


def _calibration(graph: DiveGraph, index: int) -> list[int]:
    return [calibration_key(graph.unknowns, name, index) for name in graph.unknowns.estimated]


def _seen_again(graph: DiveGraph, end: int) -> list[int]:
    """Keys of the places that are seen up to a keyframe and after it."""
    block = graph.blocks.get("place")
    if block is None:
        return []
    before = np.unique(block.place[block.keyframe <= end])
    return [key(PLACE, int(number)) for number in np.intersect1d(before, block.place[block.keyframe > end])]


def _pieces(
    graph: DiveGraph, linear: gtsam.GaussianFactorGraph, ends: Sequence[int]
) -> list[gtsam.GaussianFactorGraph]:
    """Factors by the piece of the dive that they complete; ``ends`` are the last keyframes of each."""
    begun = np.searchsorted(graph.index, np.arange(int(graph.index[-1]) + 1))  # first keyframe of a value
    first_seen = {}
    if "place" in graph.blocks:
        block = graph.blocks["place"]
        first_seen = {key(PLACE, p): k for p, k in zip(block.place[::-1], block.keyframe[::-1], strict=True)}
    pieces = [gtsam.GaussianFactorGraph() for _ in ends]
    newest = []
    for k in range(linear.size()):
        keys = linear.at(k).keys()
        indices = [key_index(one) for one in keys if not is_place(one)]
        newest.append(max((i if state else begun[i] for state, i in indices), default=first_seen.get(keys[0], 0)))
    for k, piece in enumerate(np.searchsorted(ends, newest).tolist()):
        if piece < len(pieces):
            pieces[piece].push_back(linear.at(k))
    return pieces


def marginals(graph: DiveGraph, values: gtsam.Values, gates: Gates) -> gtsam.GaussianBayesTree:
    """The optimum's Bayes tree, which gives marginal covariances.

    By QR, since small covariances come of large and nearly dependent rows; calibration
    is eliminated last, since all keyframes share it.
    """
    linear = graph.linearize(values, gates)
    last = [key(name) for name, walk in graph.unknowns.walks.items() if not walk]
    ordering = gtsam.Ordering.ColamdConstrainedLastGaussianFactorGraph(linear, last)
    try:
        return linear.eliminateMultifrontal(ordering, gtsam.EliminateQR)
    except RuntimeError as error:
        raise InputError(indeterminate(error)) from None


def newest_covariance(graph: DiveGraph, values: gtsam.Values, gates: Gates, places: Sequence[int] = ()) -> Array:
    """Joint covariance of the newest keyframe, of the calibration there, and of places.

    Returns
    -------
    ndarray, shape (d, d), pose, velocity, bias, then the calibration in the order of `DiveGraph.unknowns`,
        then the places in the order of their numbers as given
    """
    linear, last = graph.linearize(values, gates), newest_keys(graph, places)
    before, order = set(linear.keyVector()) - set(last), gtsam.Ordering()
    for one in last:
        order.push_back(one)
    try:
        _, ends = linear.eliminatePartialMultifrontal(sorted(before), gtsam.EliminateQR)
    except RuntimeError as error:
        raise InputError(indeterminate(error)) from None
    root = np.linalg.inv(np.linalg.qr(ends.jacobian(order)[0], mode="r"))
    return np.asarray(root @ root.T)


def newest_keys(graph: DiveGraph, places: Sequence[int] = ()) -> list[int]:
    """Keys of the newest keyframe, of the calibration there, and of places."""
    last = [key(v, graph.count - 1) for v in DIMENSION]
    last += [calibration_key(graph.unknowns, name, int(graph.index[-1])) for name in graph.unknowns.estimated]
    return last + [key(PLACE, number) for number in places]


def covariances(tree: gtsam.GaussianBayesTree) -> dict[int, Array]:
    """Marginal covariances of all variables, by key, shape (d, d)."""
    return joint_covariances(tree, ())[0]


def joint_covariances(
    tree: gtsam.GaussianBayesTree, groups: Iterable[tuple[int, ...]]
) -> tuple[dict[int, Array], list[Array]]:
    """Marginal covariances of all variables, by key, shape (d, d), and joint ones of groups of neighbours.

    Variables that one factor ties stand together in a clique, that of the one which is eliminated first.

    From the roots down, as a clique's separator lies in its parent: with R x_f + S x_s = noise of unit
    variance, P_ff = R^-1 (1 + S P_ss S') R^-T and P_fs = -R^-1 S P_ss.
    """
    out: dict[int, Array] = {}
    group_of = {k: group for group in groups for k in group}
    joint: dict[tuple[int, ...], Array] = {}
    todo: list[tuple[gtsam.GaussianBayesTreeClique, dict[int, slice], Array]] = [
        (root, {}, np.empty((0, 0))) for root in tree.roots()
    ]
    while todo:
        clique, above, P_above = todo.pop()
        conditional = clique.conditional()
        keys, RS = conditional.keys(), conditional.jacobian()[0]
        ends = list(accumulate(map(dimension, keys)))
        parts = {k: slice(end - dimension(k), end) for k, end in zip(keys, ends, strict=True)}
        m, size = RS.shape
        shared = np.concatenate([np.r_[above[k]] for k in keys if parts[k].start >= m] or [np.empty(0, int)])
        root = np.linalg.inv(RS[:, :m])
        gain = root @ RS[:, m:]
        P = np.empty((size, size))
        P[m:, m:] = P_above[np.ix_(shared, shared)]
        P[:m, m:] = -gain @ P[m:, m:]
        P[m:, :m] = P[:m, m:].T
        P[:m, :m] = root @ root.T - P[:m, m:] @ gain.T
        frontal = {k: part for k, part in parts.items() if part.stop <= m}
        out |= {k: P[part, part] for k, part in frontal.items()}
        for group in {group_of[k] for k in frontal.keys() & group_of.keys()}:
            if parts.keys() >= {*group}:
                own = np.concatenate([np.r_[parts[k]] for k in group])
                joint[group] = P[np.ix_(own, own)]
        todo += [(clique[child], parts, P) for child in range(clique.nrChildren())]
    return out, [joint[group] for group in groups]


@dataclass(frozen=True)
class GraphOptimum:
    """A graph and where its robust cost is least."""

    problem: Problem
    initial: InitialConditions
    beliefs: Mapping[str, Belief]
    graph: DiveGraph
    solution: GaussNewtonResult[gtsam.Values]

    @property
    def unknowns(self) -> CalibrationRoles:
        return self.graph.unknowns

    @property
    def blocks(self) -> Mapping[str, Measurements]:
        return self.graph.blocks

    @cached_property
    def state(self) -> State:
        return self.graph.states(self.solution.point)

    @cached_property
    def weights(self) -> Mapping[str, Array]:
        return self.graph.weights(self.solution.point, self.solution.gates)

    @cached_property
    def places(self) -> Mapping[int, Array]:
        block = self.graph.blocks.get("place")
        numbers = set() if block is None else set(block.place.tolist())
        return {number: self.solution.point.atVector(key(PLACE, number)) for number in numbers}

    @cached_property
    def _wide(self) -> tuple[DiveGraph, gtsam.Values]:
        """The graph in which what is considered is estimated, and where it is linearised."""
        names = self.unknowns.considered
        return self._graph(self.unknowns.estimating(names)), self._with_means(self.solution.point, names)

    @cached_property
    def _sensitivity(self) -> dict[int, Array]:
        """Derivatives of the optimum by considered variables times their prior sd, by key, shape (dim, h)."""
        moves = sensitivity(*self._wide, self.solution.gates, self.unknowns.considered)
        beliefs = [self.beliefs[name] for name in self.unknowns.considered]
        sd = np.concatenate([np.full(b.variable.dim, b.sd) for b in beliefs])
        return {one: K * sd for one, K in moves.items()}

    def covariances(self) -> dict[str, Array]:
        """As `rovgraph.inference.optimum.Optimum`."""
        keyframes = [*zip(*(self._keys(variable) for variable in (POSE, VELOCITY, BIAS)), strict=True)]
        tree = marginals(self.graph, self.solution.point, self.solution.gates)
        known, together = joint_covariances(tree, keyframes)
        out = {MOTION_STATE: self._with_considered(np.array(together), keyframes)}
        out |= {variable: out[MOTION_STATE][:, own, own] for variable, own in COLUMNS.items()}
        for variable in self.unknowns.estimated:
            keys = self._keys(variable)
            out[variable] = self._with_considered(np.array([known[one] for one in keys]), [(one,) for one in keys])
        for variable in self.unknowns.considered:
            belief = self.beliefs[variable]
            prior = np.eye(belief.variable.dim) * belief.sd**2
            out[variable] = np.broadcast_to(prior, (self.graph.count, *prior.shape))
        return out

    def _with_considered(self, P: Array, keys: Sequence[tuple[int, ...]]) -> Array:
        """With the part of considered variables, shape as that of P: (n, d, d), each of variables with some keys."""
        if not self.unknowns.considered:
            return P
        K = np.array([np.vstack([self._sensitivity[one] for one in group]) for group in keys])
        return P + K @ transpose(K)

    def newest_covariance(self, places: Sequence[int] = ()) -> Array:
        """As `rovgraph.inference.optimum.Optimum`."""
        known = newest_covariance(self.graph, self.solution.point, self.solution.gates, places)
        names = self.unknowns.considered
        if not names:
            return known
        K = np.vstack([self._sensitivity[one] for one in newest_keys(self.graph, places)])
        beliefs = [self.beliefs[name] for name in names]
        sd = np.concatenate([np.full(b.variable.dim, b.sd) for b in beliefs])
        count, end = K.shape[1], len(K) - PLACE_DIM * len(places)
        P, K = np.zeros((len(K) + count, len(K) + count)), np.insert(K, end, np.diag(sd), axis=0)
        others = np.r_[:end, end + count : len(P)]
        P[np.ix_(others, others)] = known
        return np.asarray(P + K @ K.T)

    def knowledge(self, keyframes: Sequence[int]) -> Knowledge:
        """As `rovgraph.inference.optimum.Optimum`."""
        return knowledge(self.graph, self.solution.point, self.solution.gates, keyframes)

    def noisier(self, keyframes: Sequence[int], seed: int = 1) -> tuple[Knowledge, Knowledge]:
        """As `rovgraph.inference.optimum.Optimum`."""
        noise = noise_of_states(self.graph, self.solution.point, self.solution.gates, seed)
        more, less = (self.solution.point.retract(noise.scale(sign)) for sign in (1.0, -1.0))
        return (
            knowledge(self.graph, more, self.solution.gates, keyframes),
            knowledge(self.graph, less, self.solution.gates, keyframes),
        )

    def considering(self, names: Sequence[str]) -> "GraphOptimum":
        """As `rovgraph.inference.optimum.Optimum`."""
        values = gtsam.Values(self.solution.point)
        for name in names:
            values.erase(key(name))
        return self._solved(self.unknowns.considering(names), values)

    def relative_sd(self) -> dict[str, Array]:
        """As `rovgraph.inference.optimum.Optimum`."""
        names, (wide, values) = self.unknowns.considered, self._wide
        tree = marginals(wide, values, self.solution.gates)
        P = covariances(tree)
        return {name: np.sqrt(np.diagonal(P[key(name)])) / self.beliefs[name].sd for name in names}

    def estimating(self, names: Sequence[str]) -> "GraphOptimum":
        """As `rovgraph.inference.optimum.Optimum`."""
        return self._solved(self.unknowns.estimating(names), self._with_means(self.solution.point, names))

    def _solved(self, unknowns: CalibrationRoles, values: gtsam.Values) -> "GraphOptimum":
        """The optimum with other unknowns, close by."""
        graph = self._graph(unknowns)
        return GraphOptimum(self.problem, self.initial, self.beliefs, graph, solve(graph, values, self.solution))

    def _graph(self, unknowns: CalibrationRoles) -> DiveGraph:
        initial = self.initial
        return make_graph(self.problem, initial.prior, initial.config, self.beliefs, initial.instruments, unknowns)

    def _with_means(self, values: gtsam.Values, names: Sequence[str]) -> gtsam.Values:
        """The values with those of some constants at their means."""
        more = gtsam.Values(values)
        for name in names:
            more.insert(key(name), np.array(self.beliefs[name].mean, dtype=float))
        return more

    def _keys(self, variable: str) -> list[int]:
        """Keys of a variable at every keyframe."""
        if variable in TABLE:
            return [calibration_key(self.unknowns, variable, k) for k in self.graph.index.tolist()]
        return [key(variable, k) for k in range(self.graph.count)]
