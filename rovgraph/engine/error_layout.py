"""Where each variable stands in the error of a state: pose, velocity, bias, then the calibration that is estimated."""

from collections.abc import Iterable, Mapping
from typing import cast

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import LAYOUT, TABLE, calibration_size
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.kernels.layout import MOTION
from rovgraph.sensors import SENSORS, CompiledModel, SensorModel, WaterVelocity
from rovgraph.state import DIMENSION, Jacobians

Index = NDArray[np.int64]

# the variable that each instrument sees directly: its model is linear in it, and depends on none that follows
SEEN = {s.name: s.linear_in for s in SENSORS.values() if s.linear_in is not None}


def seen_model(model: SensorModel) -> CompiledModel:
    """The model that is linear in what its instrument sees: its own, but for a current, which shows in drag."""
    return WaterVelocity() if SEEN[model.sensor] == "current" else cast(CompiledModel, model)


class ErrorLayout:
    """Layout of the error of a state.

    Parameters
    ----------
    estimated : names of the calibration variables that are estimated
    instruments : the sensors in use, by stream

    Attributes
    ----------
    columns : variable -> slice of the error
    size : length of the error
    column : ndarray of int, shape (15 + C,), place of each component of state and calibration vector in the
        error, -1 where it is not estimated
    coordinates : what `rovgraph.kernels.error_coordinates.ErrorLayout` holds, one by one
    """

    def __init__(self, estimated: Iterable[str], instruments: Mapping[str, Instrument]) -> None:
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

        self.coordinates = self._coordinates(instruments)

    def _coordinates(self, instruments: Mapping[str, Instrument]) -> tuple[Index, Index, Array, Index]:
        """Columns of a full Jacobian, instruments and what they see, their numbers, rows of a basis."""
        estimated = np.flatnonzero(self.column >= 0)
        columns = estimated[np.argsort(self.column[estimated])]
        shown = {v: seen_model(instruments[s].model) for s, v in SEEN.items() if s in instruments and v in self.columns}
        models = [(model, self.columns[variable]) for variable, model in shown.items()]
        seen = [(model.kind, model.dim, part.start) for model, part in models]
        params = np.zeros((len(models), max((model.packed.shape[1] for model, _ in models), default=0)))
        for row, (model, _) in zip(params, models, strict=True):
            row[: model.packed.shape[1]] = model.packed[0]
        rows = np.concatenate([np.arange(6), *(np.r_[part] for _, part in models)]).astype(np.int64)
        return columns, np.array(seen, np.int64).reshape(-1, 3), params, rows

    def matrix(self, H: Jacobians) -> Array:
        """Jacobians by variable as one, shape (n, dim, size); what is not estimated is left out."""
        out = np.zeros((*next(iter(H.values())).shape[:2], self.size))
        for name, jacobian in H.items():
            if name in self.columns:
                out[..., self.columns[name]] = jacobian
        return out
