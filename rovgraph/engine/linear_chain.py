"""Whitened rows of a chain that are at hand, eliminated: for studies of the solver."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rovgraph.engine.chain_information import MeasurementRows, SquareRoot, square_root
from rovgraph.geometry import Array
from rovgraph.kernels.chain import Elimination, PlacedRows, Walks
from rovgraph.kernels.compile import Index
from rovgraph.kernels.linear_chain import LinearMotions
from rovgraph.kernels.linear_chain import eliminate as eliminate_rows


@dataclass(frozen=True)
class MotionRows:
    """Whitened rows of the motions between n keyframes, of s components that move and d - s that walk.

    Attributes
    ----------
    A : ndarray, shape (n - 1, s, 2 (s + 1)), columns of the keyframe before, right-hand sides, columns of the keyframe
        after, and one that is not read
    C, targets : ndarray, shapes (n - 1, s, e) and (e,), Jacobians by other columns (see `rovgraph.kernels.chain`)
    walk, kept, walk_r : ndarray, shape (n - 1, d - s), one over the sd of a walk, what it keeps of the value before,
        and right-hand sides
    """

    A: Array
    C: Array
    targets: Index
    walk: Array
    kept: Array
    walk_r: Array

    @staticmethod
    def of_states(A_i: Array, A_j: Array, r: Array) -> "MotionRows":
        """Rows of motions in which nothing walks and that know nothing of the border.

        Parameters
        ----------
        A_i, A_j : ndarray, shape (n - 1, s, s), Jacobians by the keyframes before and after
        r : ndarray, shape (n - 1, s), right-hand sides
        """
        count, s = r.shape
        A, none = np.concatenate([A_i, r[..., None], A_j, np.zeros((count, s, 1))], axis=2), np.zeros((count, 0))
        return MotionRows(A, np.zeros((count, s, 0)), np.zeros(0, dtype=np.int64), none, none, none)


def eliminate(
    motions: MotionRows, measurements: MeasurementRows, border_rows: Array, stops: Sequence[int] = ()
) -> SquareRoot:
    """Eliminate the keyframes in the order of time, then the border.

    Parameters
    ----------
    motions, measurements : the rows of n keyframes
    border_rows : ndarray, shape (p, c + 1), priors of the border with their right-hand sides
    stops : increasing, keyframes at which to keep what the rows up to there say (`SquareRoot.filtered`)

    Raises
    ------
    UndeterminedError : the rows do not determine some component
    """
    m, n, c = motions, len(measurements.first) - 1, border_rows.shape[1] - 1
    rows = PlacedRows(measurements.values, measurements.targets, measurements.first)
    kept_at = np.array(stops, dtype=np.int64)

    def fill(conditionals: Array, border: Array, filtered: Array, left: Array) -> int:
        own, walks = LinearMotions(m.A, m.C, m.targets), Walks(m.walk, m.kept, m.walk_r)
        return eliminate_rows(own, walks, rows, border_rows, Elimination(kept_at, conditionals, border, filtered, left))

    return square_root(n, m.A.shape[1] + m.walk.shape[1], c, len(stops), fill)
