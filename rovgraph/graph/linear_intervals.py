"""The intervals of a dive as whitened rows about a point, which can be linearised again when the point has moved.

With the errors e_i, e_j of the keyframes before and after an interval and e_c of the calibration, in the order of
`rovgraph.engine.error_layout`, an interval says

    A_i e_i + A_j e_j + C e_c = r + white noise

in one row for each component of its motion, or of the prior, and of the measurements since the keyframe before.
Their equations are the compiled ones. Losses and gates weight the rows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import states_of
from rovgraph.engine.initial_conditions import StatePrior
from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement
from rovgraph.engine.measurements import loss_weight
from rovgraph.engine.scale import COLUMNS, SCALES
from rovgraph.geometry import Array, log_rotation, right_jacobian
from rovgraph.instruments import Instrument
from rovgraph.kernels.layout import ACC_SCALE, MOTION
from rovgraph.kernels.motion_residual import motion_errors, motion_weights, whiten_motions

_SCALE = slice(ACC_SCALE, ACC_SCALE + 6)  # of the calibration vector


@dataclass(frozen=True)
class LinearInterval:
    """The rows of one interval, of which there are m; of the first keyframe A_i is zero."""

    A_i: Array
    A_j: Array
    C: Array
    r: Array


class MeasurementGroup:
    """Measurements that belong to one keyframe, without those of places.

    Parameters
    ----------
    filter : knows their equations
    measurements : at least one

    Attributes
    ----------
    measurements : in the order of the rows
    dims : ndarray of int, components of each
    """

    def __init__(self, filter: FilterEngine, measurements: Sequence[KeyframeMeasurement]) -> None:
        known = [m for m in measurements if filter.knows(m.sensor)]
        given = [m for m in measurements if not filter.knows(m.sensor)]
        self.measurements = [*known, *given]
        self.dims = np.array([len(m.z) for m in self.measurements])
        self._rows = filter.rows(known) if known else None
        self._blocks = [filter.block([m]) for m in given]
        self._matrix = filter.layout.matrix

    def linearize(self, x: Array, c: Array) -> tuple[Array, Array]:
        """Whitened innovations, shape (m,), and Jacobians, shape (m, size), at a state as of `Gaussian`."""
        if self._rows is not None and not self._blocks:
            return self._rows.linearize(x, c)
        r, H = [], []
        if self._rows is not None:
            own_r, own_H = self._rows.linearize(x, c)
            r, H = [own_r], [own_H]
        state = states_of(x[None], c)
        for block in self._blocks:
            own, jacobians = block.linearize(state)
            r.append(own[0])
            H.append(self._matrix(jacobians)[0])
        return np.concatenate(r), np.vstack(H)


class IntervalTerms:
    """An interval with what was measured in it, to be linearised at any point.

    Parameters
    ----------
    filter : knows the equations
    interval : the interval

    Attributes
    ----------
    interval : the interval
    groups : (whether it belongs to the keyframe that ends the interval, measurements)
    """

    def __init__(self, filter: FilterEngine, interval: KeyframeInterval) -> None:
        self.interval = interval
        parts = (False, interval.between), (True, interval.here)
        kept = [(here, [m for m in own if m.landmark is None]) for here, own in parts]
        self.groups = [(here, MeasurementGroup(filter, own)) for here, own in kept if own]

    @property
    def measurements(self) -> list[KeyframeMeasurement]:
        """In the order of the rows."""
        return [m for _, group in self.groups for m in group.measurements]


class Linearization:
    """How the intervals of a dive are linearised.

    Parameters
    ----------
    filter : knows the measurements' equations, and the layout of the error
    prior : of the first keyframe
    """

    def __init__(self, filter: FilterEngine, prior: StatePrior) -> None:
        self._prior = prior
        self._prior_weight = np.linalg.inv(np.linalg.cholesky(prior.covariance()))
        self._instruments: Mapping[str, Instrument] = filter.initial.instruments
        self.size = filter.layout.size
        self._scales = [(name, filter.layout.columns[name]) for name in SCALES if name in filter.layout.columns]

    def linearize(
        self, terms: Sequence[IntervalTerms], x: Array, c: Array, admitted: NDArray[np.bool_] | None = None
    ) -> list[LinearInterval]:
        """Rows of n intervals that follow each other.

        Parameters
        ----------
        terms : the intervals
        x : ndarray, shape (n + 1, 21), of the keyframe before the first (any before the dive), and of each
        c : ndarray, shape (n, C), calibration vectors
        admitted : of all measurements in the order of the rows; None = those within their gate
        """
        r, A_i, A_j, C = self._motions(terms, x, c)
        own_r, own_H, counts = self._measured(terms, x, c, admitted)
        out, at = [], 0
        for k, term in enumerate(terms):
            m = MOTION + sum(counts[at_group] for at_group in range(at, at + len(term.groups)))
            one = LinearInterval(np.zeros((m, MOTION)), np.zeros((m, MOTION)), np.zeros((m, C.shape[2])), np.empty(m))
            one.A_i[:MOTION], one.A_j[:MOTION], one.C[:MOTION], one.r[:MOTION] = A_i[k], A_j[k], C[k], r[k]
            row = MOTION
            for here, _ in term.groups:
                rows = slice(row, row + counts[at])
                (one.A_j if here else one.A_i)[rows] = own_H[at][:, :MOTION]
                one.C[rows], one.r[rows] = own_H[at][:, MOTION:], own_r[at]
                row, at = rows.stop, at + 1
            out.append(one)
        return out

    def _measured(
        self, terms: Sequence[IntervalTerms], x: Array, c: Array, admitted: NDArray[np.bool_] | None
    ) -> tuple[list[Array], list[Array], list[int]]:
        """Innovations and Jacobians of each group of measurements, weighted, and how many rows they are."""
        groups = [group for term in terms for _, group in term.groups]
        if not groups:
            return [], [], []
        linear = [
            group.linearize(x[k + here], c[k]) for k, term in enumerate(terms) for here, group in term.groups
        ]
        r = np.concatenate([own for own, _ in linear])
        dims = np.concatenate([group.dims for group in groups])
        d2 = np.add.reduceat(r * r, np.cumsum(dims) - dims)
        root = np.repeat(np.sqrt(self._weights([m for group in groups for m in group.measurements], d2, admitted)), dims)
        counts = [len(own) for own, _ in linear]
        roots = np.split(root, np.cumsum(counts)[:-1])
        pairs = list(zip(linear, roots, strict=True))
        return [own * w for (own, _), w in pairs], [H * w[:, None] for (_, H), w in pairs], counts

    def _weights(
        self, measurements: Sequence[KeyframeMeasurement], d2: Array, admitted: NDArray[np.bool_] | None
    ) -> Array:
        """Weights of measurements by their losses, 0 where they are not let in."""
        weight, sensors = np.empty(len(d2)), np.array([m.sensor for m in measurements])
        for sensor in dict.fromkeys(m.sensor for m in measurements):
            instrument, own = self._instruments[sensor], sensors == sensor
            weight[own] = loss_weight(d2[own], instrument.loss, instrument.model.dim)
            if admitted is None:
                weight[own] *= d2[own] <= (instrument.gate_sd or np.inf) ** 2
        return weight if admitted is None else weight * admitted

    def _motions(self, terms: Sequence[IntervalTerms], x: Array, c: Array) -> tuple[Array, Array, Array, Array]:
        """Rows of the motions, or at the first keyframe of its prior: r, A_i, A_j, C."""
        n, first = len(terms), int(terms[0].interval.motion is None)
        r, A_i, A_j = np.zeros((n, MOTION)), np.zeros((n, MOTION, MOTION)), np.zeros((n, MOTION, MOTION))
        C = np.zeros((n, MOTION, self.size - MOTION))
        if first:
            r[0], A_j[0] = self._of_prior(x[1])
        intervals = [term.interval for term in terms[first:]]
        if not intervals:
            return r, A_i, A_j, C
        rows = np.array([interval.motion.row for interval in intervals if interval.motion is not None])
        W = np.empty((len(rows), MOTION, MOTION))
        motion_weights(rows, W)
        bias = x[first:, 15:21].copy()
        b_i, b_j, S = bias[:-1], bias[1:], None
        if intervals[0].scale_to_bias is not None:
            S = np.array([interval.scale_to_bias for interval in intervals])
            shift = np.einsum("nij,nj->ni", S, c[first:, _SCALE])
            b_i, b_j = b_i + shift, b_j + shift
        R, p, v = x[first:, :9].reshape(-1, 3, 3).copy(), x[first:, 9:12].copy(), x[first:, 12:15].copy()
        own = r[first:], A_i[first:], A_j[first:]
        motion_errors(rows, R[:-1], p[:-1], v[:-1], b_i, R[1:], p[1:], v[1:], b_j, *own)
        whiten_motions(W, *own)
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
