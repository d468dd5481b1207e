"""What the data up to a time say of the calibration, from the graph's own information matrix.

The dive is eliminated piece by piece in the order of time, by QR. What is left of a piece are
conditionals of its last keyframe and of the calibration; they go into the next piece as factors.
So every piece ends with the exact joint covariance given all data so far, every factor
linearised at the same values, and the whole costs one elimination.
"""

from collections.abc import Sequence

import gtsam
import numpy as np

from rovgraph.engine.gauss_newton import Gates
from rovgraph.engine.optimum import Knowledge
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.graph.batch import DiveGraph, indeterminate
from rovgraph.graph.keys import calibration_key, is_place, key, key_index
from rovgraph.state import BIAS, DIMENSION, PLACE, PLACE_DIM, POSE, VELOCITY


def knowledge(graph: DiveGraph, values: gtsam.Values, gates: Gates, keyframes: Sequence[int]) -> Knowledge:
    """What is known from the data up to each of some keyframes.

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
        own = len(root) - PLACE_DIM * len(open_places)
        joint.append((root @ root.T)[:own, :own])
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
    """A draw of the error that the data's noise leaves in the states, calibration held.

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
    """How the optimum of all else moves with calibration variables that are given.

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
    for unit in R.T:  # what the given variables' own rows say where one component is 1, all others 0
        rhs = gtsam.VectorValues()
        for i in range(others):
            rhs.insert(net.at(i).firstFrontalKey(), np.zeros(net.at(i).rows()))
        for one, own in zip(given, np.split(unit, ends), strict=True):
            rhs.insert(one, own)
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
        own = [key_index(one) for one in keys if not is_place(one)]
        newest.append(max((i if state else begun[i] for state, i in own), default=first_seen.get(keys[0], 0)))
    for k, piece in enumerate(np.searchsorted(ends, newest).tolist()):
        if piece < len(pieces):
            pieces[piece].push_back(linear.at(k))
    return pieces
