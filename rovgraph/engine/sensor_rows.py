"""Sensors and their measurements as rows of numbers for the filter's kernels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.measurements import loss_threshold
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.linearization import linearize
from rovgraph.kernels.weighting import LOSSES
from rovgraph.sensors import SENSORS

_FRAME = {"velocity": at.SEES_VELOCITY, "heading": at.SEES_HEADING, "position": at.SEES_POSITION}


def compiled(instrument: Instrument, time_offset_estimated: bool) -> bool:
    """Whether the filter's kernel knows the equation, at a time that is certain."""
    return hasattr(instrument.model, "kind") and not time_offset_estimated


def sensor_table(instruments: Mapping[str, Instrument], given: Sequence[str]) -> Array:
    """A row for each sensor, shape (s, PARAMS + k); ``given`` are linearised outside the kernel."""
    packed = {
        s: np.zeros(0) if s in given else i.model.packed[0]  # type: ignore[attr-defined]
        for s, i in instruments.items()
    }
    out = np.zeros((len(instruments), at.PARAMS + max((len(p) for p in packed.values()), default=0)))
    for row, (sensor, instrument) in zip(out, instruments.items(), strict=True):
        model, dim = instrument.model, instrument.model.dim
        row[at.KIND] = at.GIVEN if sensor in given else model.kind  # type: ignore[attr-defined]
        row[at.DIM] = dim
        row[at.LOSS], row[at.BEND] = LOSSES.index(instrument.loss), loss_threshold(instrument.loss, dim)
        row[at.GATE] = np.inf if instrument.gate_sd is None else instrument.gate_sd
        row[at.READMIT] = instrument.readmit_s
        observed = SENSORS[sensor].observes
        row[at.SEEN_FRAME], row[at.SEES : at.SEES + 3] = _FRAME[observed.frame], np.isin(np.arange(3), observed.axes)
        gain = np.zeros((3, 3))
        if dim <= 3:
            gain[:dim, :dim] = instrument.rate_gain @ instrument.rate_gain.T
        row[at.GAIN : at.GAIN + 9] = gain.ravel()
        row[at.PARAMS : at.PARAMS + len(packed[sensor])] = packed[sensor]
    return out


@dataclass(frozen=True)
class KeyframeRows:
    """Measurements of one keyframe that the kernels know.

    Attributes
    ----------
    rows, which : ndarray, shapes (m, ROW), (m,), of the measurements, and the sensor that each is of
    sensors : ndarray, of `sensor_table`
    column : ndarray of int, shape (15 + C,), place of each component in the error, -1 where it is not estimated
    size : of the error
    scale : ndarray, shape (m, 6, 6), bias by the IMU's scales, or (0, 6, 6) where these are exact
    gravity : [m/s^2]
    """

    rows: Array
    which: NDArray[np.int64]
    sensors: Array
    column: NDArray[np.int64]
    size: int
    scale: Array
    gravity: float

    @cached_property
    def count(self) -> int:
        """Components of all measurements."""
        return int(self.sensors[self.which, at.DIM].sum())

    def linearize(self, x: Array, c: Array, weighted: bool = False) -> tuple[Array, Array]:
        """Whitened innovations, shape (k,), and Jacobians, shape (k, size), on request weighted by the losses.

        Parameters
        ----------
        x, c : ndarray, shapes (21,), (C,), as of `rovgraph.engine.filter_step.Gaussian`
        """
        r = np.zeros(self.count)
        H = np.zeros((len(r), self.size))
        linearize(x, c, self.rows, self.which, self.sensors, self.column, self.scale, self.gravity, weighted, r, H)
        return r, H
