"""Which measurements may reach an estimate."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.sensors import SENSORS


def admitted(sensor: str, values: Array, config: Config, left_out: Counter[tuple[str, str]]) -> NDArray[np.bool_]:
    """Whether measurements may enter the graph.

    Parameters
    ----------
    sensor : name of the log stream
    values : ndarray, shape (n, k), its columns
    config : effective configuration
    left_out : (sensor, reason) -> count, of those that may not

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    mask = np.ones(len(values), bool)
    for reason, bad in SENSORS[sensor].refused(values, config):
        if count := int((bad & mask).sum()):
            left_out[sensor, reason] += count
            mask &= ~bad
    return mask
