"""How certain the optimum of a dive is: marginal covariances from its Bayes tree."""

from collections.abc import Sequence
from itertools import accumulate

import gtsam
import numpy as np

from rovgraph.engine.gauss_newton import Gates
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.graph.batch import DiveGraph, indeterminate
from rovgraph.graph.keys import calibration_key, dimension, key
from rovgraph.state import DIMENSION, PLACE


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
    """Marginal covariances of all variables, by key, shape (d, d).

    From the roots down, as a clique's separator lies in its parent: with R x_f + S x_s = noise of unit
    variance, P_ff = R^-1 (1 + S P_ss S') R^-T and P_fs = -R^-1 S P_ss.
    """
    out: dict[int, Array] = {}
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
        out |= {k: P[part, part] for k, part in parts.items() if part.stop <= m}
        todo += [(clique[child], parts, P) for child in range(clique.nrChildren())]
    return out
