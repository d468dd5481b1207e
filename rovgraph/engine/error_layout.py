"""Where each variable stands in the error of a state: pose, velocity, bias, then the calibration that is estimated."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import LAYOUT, TABLE, calibration_size
from rovgraph.geometry import Array
from rovgraph.state import DIMENSION, Jacobians

MOTION = 15  # components before the calibration


class ErrorLayout:
    """Layout of the error of a state.

    Parameters
    ----------
    estimated : names of the calibration variables that are estimated

    Attributes
    ----------
    columns : variable -> slice of the error
    size : length of the error
    column : ndarray of int, shape (15 + C,), place of each component of state and calibration vector in the
        error, -1 where it is not estimated
    """

    def __init__(self, estimated: Iterable[str]) -> None:
        sizes = DIMENSION | {name: TABLE[name].dim for name in estimated}
        ends = np.cumsum(list(sizes.values())).tolist()
        self.columns = {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
        self.size: int = ends[-1]
        self.column: NDArray[np.int64] = np.full(MOTION + calibration_size(), -1)
        self.column[:MOTION] = np.arange(MOTION)
        for name, part in LAYOUT.items():
            if name in self.columns:
                own = self.columns[name]
                self.column[MOTION + part.start : MOTION + part.stop] = np.arange(own.start, own.stop)

    def matrix(self, H: Jacobians) -> Array:
        """Jacobians by variable as one, shape (n, dim, size); what is not estimated is left out."""
        out = np.zeros((*next(iter(H.values())).shape[:2], self.size))
        for name, jacobian in H.items():
            if name in self.columns:
                out[..., self.columns[name]] = jacobian
        return out
