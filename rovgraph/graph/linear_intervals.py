"""The intervals of a dive as whitened rows about a point, which can be linearised again when the point has moved.

With the errors e_i, e_j of the keyframes before and after an interval and e_c of the calibration, in the order of
`rovgraph.engine.error_layout`, an interval says

    A_i e_i + A_j e_j + C e_c = r + white noise

in one row for each component of its motion, or of the prior, and of the measurements since the keyframe before.
Their equations are the compiled ones, and losses weight the rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import states_of
from rovgraph.engine.initial_conditions import StatePrior
from rovgraph.engine.problem import Index, Problem
from rovgraph.engine.scale import COLUMNS, SCALES
from rovgraph.geometry import Array, log_rotation, right_jacobian, rotate
from rovgraph.kernels.assembly import SEGMENT
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.motion_residual import motion_errors
from rovgraph.kernels.states import States

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
    filter : knows their equations
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
    """An interval with what was let in of its measurements, to be linearised at any point.

    Parameters
    ----------
    filter : knows the equations
    problem, k : the interval that ends with keyframe k
    let_in : ndarray of int, its measurements that count

    Attributes
    ----------
    problem, k : the same
    segment : of time that it lies in
    landmarks : measurements of places
    before, here : at the keyframe before, and at the one that ends the interval, where there are any
    """

    def __init__(self, filter: FilterEngine, problem: Problem, k: int, let_in: Index) -> None:
        self.problem, self.k, self.segment = problem, k, int(problem.keyframes[k, SEGMENT])
        seen = problem.number[let_in] >= 0
        self.landmarks, others = let_in[seen].tolist(), let_in[~seen]
        here = problem.keyframe[others] == k
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
    filter : knows the layout of the error
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
            here = MOTION + len(r_i)
            J = np.zeros((here + len(r_j), MOTION + self._size))
            J[:MOTION, :MOTION], J[:MOTION, MOTION : 2 * MOTION], J[:MOTION, 2 * MOTION :] = A_i, A_j, C
            J[MOTION:here, :MOTION], J[MOTION:here, 2 * MOTION :] = H_i[:, :MOTION], H_i[:, MOTION:]
            J[here:, MOTION:] = H_j
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
        own = r[first:], A_i[first:], A_j[first:]
        motion_errors(rows, States(R[:-1], p[:-1], v[:-1], b_i), States(R[1:], p[1:], v[1:], b_j), *own)
        own[0][:], own[1][:], own[2][:] = rotate(W, own[0]), W @ own[1], W @ own[2]
        if S is not None:
            by_scale = (own[1][:, :, 9:] + own[2][:, :, 9:]) @ S  # of both alike, so that it is no walk of the bias
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
