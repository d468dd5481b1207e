"""Where each variable stands in the error of a state: pose, velocity, bias, then the calibration that is estimated.

In Jacobians, what is considered has columns behind those of the error.
"""

from collections.abc import Mapping, Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import LAYOUT, TABLE, calibration_size
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.kernels.error_coordinates import ErrorLayout as Coordinates
from rovgraph.kernels.layout import MOTION
from rovgraph.sensors import SENSORS, CompiledModel, SensorModel, WaterVelocity
from rovgraph.state import DIMENSION, Jacobians

# the variable that each instrument sees directly: its model is linear in it, and depends on none that follows
SEEN = {s.name: s.linear_in for s in SENSORS.values() if s.linear_in is not None}


def seen_model(model: SensorModel) -> CompiledModel:
    """The model that is linear in what its instrument sees: its own, but for a current, which shows in drag."""
    return WaterVelocity() if SEEN[model.sensor] == "current" else cast(CompiledModel, model)


class ErrorLayout:
    """Layout of the error of a state.

    Parameters
    ----------
    estimated, considered : names of calibration variables
    instruments : the sensors in use, by stream

    Attributes
    ----------
    columns : variable -> slice of the error, or of a Jacobian's columns
    size, width : length of the error, and columns of a Jacobian
    column : ndarray of int, shape (15 + C,), place of each component of state and calibration vector in the
        Jacobian, -1 where it has none
    coordinates : as kernels take them
    """

    def __init__(
        self, estimated: Sequence[str], considered: Sequence[str], instruments: Mapping[str, Instrument]
    ) -> None:
        sizes = DIMENSION | {name: TABLE[name].dim for name in (*estimated, *considered)}
        ends = np.cumsum(list(sizes.values())).tolist()
        self.columns = {name: slice(end - sizes[name], end) for name, end in zip(sizes, ends, strict=True)}
        self.width: int = ends[-1]
        self.size: int = self.width - sum(TABLE[name].dim for name in considered)
        self.column: NDArray[np.int64] = np.full(MOTION + calibration_size(), -1)
        self.column[:MOTION] = np.arange(MOTION)
        for name, part in LAYOUT.items():
            if name in self.columns:
                own = self.columns[name]
                self.column[MOTION + part.start : MOTION + part.stop] = np.arange(own.start, own.stop)

        self.coordinates = self._coordinates(instruments)

    def _coordinates(self, instruments: Mapping[str, Instrument]) -> Coordinates:
        """Columns of a full Jacobian, instruments and what they see, their numbers, rows of a basis."""
        estimated = np.flatnonzero((self.column >= 0) & (self.column < self.size))
        columns = estimated[np.argsort(self.column[estimated])]
        own = {name for name, part in self.columns.items() if part.stop <= self.size}
        shown = {v: seen_model(instruments[s].model) for s, v in SEEN.items() if s in instruments and v in own}
        models = [(model, self.columns[variable]) for variable, model in shown.items()]
        seen = [(model.kind, model.dim, part.start) for model, part in models]
        params = np.zeros((len(models), max((model.packed.shape[1] for model, _ in models), default=0)))
        for row, (model, _) in zip(params, models, strict=True):
            row[: model.packed.shape[1]] = model.packed[0]
        rows = np.concatenate([np.arange(6), *(np.r_[part] for _, part in models)]).astype(np.int64)
        return Coordinates(columns, np.array(seen, np.int64).reshape(-1, 3), params, rows)

    def matrix(self, H: Jacobians) -> Array:
        """Jacobians by variable as one, shape (n, dim, width); what is neither estimated nor considered is left out."""
        out = np.zeros((*next(iter(H.values())).shape[:2], self.width))
        for name, jacobian in H.items():
            if name in self.columns:
                out[..., self.columns[name]] = jacobian
        return out
