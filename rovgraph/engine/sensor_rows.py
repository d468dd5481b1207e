"""Sensors and their measurements as rows of numbers for the filter's kernels."""

from collections.abc import Mapping, Sequence

import numpy as np

from rovgraph.engine.keyframes import KeyframeMeasurement
from rovgraph.engine.measurements import loss_threshold
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.kernels import measurement_row as at
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


def measurement_row(m: KeyframeMeasurement) -> Array:
    """A measurement of at most three components, shape (ROW,)."""
    row = np.zeros(at.ROW)
    dim = len(m.z)
    row[at.TIME] = m.time
    if dim <= 3:
        row[at.Z : at.Z + dim], row[at.SD : at.SD + dim] = m.z, m.sd
    row[at.RATE : at.RATE + 3], row[at.RATE_SD] = m.rate_b, m.rate_sd
    row[at.DT] = m.motion.dt
    row[at.DR : at.DR + 9] = m.motion.dR.ravel()
    row[at.DV : at.DV + 3], row[at.DP : at.DP + 3] = m.motion.dv, m.motion.dp
    row[at.ASSUMED : at.ASSUMED + 6] = m.bias
    return row
