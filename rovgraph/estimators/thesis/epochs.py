"""Rows that belong to the epochs of a log, or of the logs of a batch."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

Index = int | NDArray[np.int64]  # of an epoch, or of one for each member of a batch


class Epochs:
    """What is given at each epoch; those of several logs lie one after the other.

    Parameters
    ----------
    rows : ndarray, shape (n, ...)
    first : where each member's begin, shape (members,); 0 of a single log
    """

    def __init__(self, rows: Array, first: Index = 0) -> None:
        self._rows, self._first = rows, first

    def at(self, epoch: Index) -> Array:
        """The row at an epoch, or that of each member at its own."""
        return np.asarray(self._rows[self._first + epoch])

    @classmethod
    def together(cls, members: Sequence["Epochs"]) -> "Epochs":
        """Those of single logs as one."""
        ends = np.cumsum([len(m._rows) for m in members])
        return cls(np.concatenate([m._rows for m in members]), np.concatenate([[0], ends[:-1]]))


def widened(rows: Array, width: int) -> Array:
    """Rows with columns of NaN added, shape (n, width)."""
    return np.pad(rows, ((0, 0), (0, width - rows.shape[1])), constant_values=np.nan)
