"""Which measurements a filter lets in, and what a sensor that was left out may have seen meanwhile.

A sensor that was left out for longer than `DISTRUSTED_S` returns only within `RETURN_SD` of what the filter, whose
uncertainty grows without it, holds possible. Left out for longer than its `READMIT`, it is believed to see something
that no model knows, and inflates the covariance of what it sees.
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper
from rovgraph.kernels.layout import TRANSLATION, VELOCITY
from rovgraph.kernels.measurement_row import GATE, READMIT, SEEN_FRAME, SEES, SEES_HEADING, SEES_VELOCITY

DISTRUSTED_S = 2.0  # of being left out after which a sensor may be wrong for longer than single measurements [s]
RETURN_SD = 3.0  # a sensor that was left out for long returns with an innovation within this many sd


@helper
def directions_seen(x: Array, sensor: Array, n: int, elapsed: float) -> tuple[Array, Array]:
    """Directions of the error in which something unknown has moved a state by one in what a sensor sees.

    Parameters
    ----------
    x, sensor : state (21,) and row of the sensor
    n : length of the error
    elapsed : time within which it happened [s]

    Returns
    -------
    seen : shape (n, s), velocity in n, or turn or shift along n's axes; a velocity with the way since, half of the
        time in the mean
    spread : shape (n, s), sd of that way, since a knock may have come at any time: elapsed / sqrt(12)
    """
    count = 0
    for k in range(3):
        count += sensor[SEES + k] != 0.0
    seen, spread, j = np.zeros((n, count)), np.zeros((n, count)), 0
    frame = int(sensor[SEEN_FRAME])
    for k in range(3):
        if sensor[SEES + k] == 0.0:
            continue
        if frame == SEES_VELOCITY:
            seen[VELOCITY + k, j] = 1.0
            for i in range(3):
                seen[TRANSLATION + i, j] = 0.5 * elapsed * x[3 * k + i]  # column k of R_bn
                spread[TRANSLATION + i, j] = elapsed / math.sqrt(12.0) * x[3 * k + i]
        else:
            begin = 0 if frame == SEES_HEADING else TRANSLATION
            for i in range(3):
                seen[begin + i, j] = x[3 * k + i]
        j += 1
    return seen, spread


@helper
def admit(nis: float, time: float, sensor: Array, since: Array, index: int) -> bool:
    """Whether a measurement lies within its gate; keeps in ``since`` since when its sensor is left out."""
    gate = sensor[GATE]
    if time - since[index] > min(DISTRUSTED_S, sensor[READMIT]):  # never where that is nan
        gate = RETURN_SD
    if nis > gate * gate:
        if math.isnan(since[index]):
            since[index] = time
        return False
    since[index] = math.nan
    return True
