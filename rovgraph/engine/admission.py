"""Which measurements may reach an estimate, and how sure each is of itself."""

import math
from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument

DEEPEST_M = 12e3  # no pressure sensor measures more, and a number like that overflows what comes after it
LARGEST_SD = 1e6  # of a measurement's own: more says no more, and overflows


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
    for reason, bad in _refused(sensor, values, config):
        if (bad & mask).any():
            left_out[sensor, reason] += int((bad & mask).sum())
            mask &= ~bad
    return mask


def _refused(sensor: str, values: Array, config: Config) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Reasons to leave measurements out, and whether it is one for each; the first that holds counts."""
    if sensor == "dvl":
        yield "no bottom lock", values[:, 3] == 0.0
    if sensor in ("dvl", "dvl_water"):
        yield "faster than dvl.max_speed_mps", np.abs(values[:, :3]).max(axis=1) > config.dvl.max_speed_mps
    elif sensor == "mag":
        yield "exactly zero", (values == 0.0).all(axis=1)
    elif sensor == "depth":
        yield "deeper than any sea", np.abs(values[:, 0]) > DEEPEST_M


def standard_deviation(sensor: str, values: Array, instrument: Instrument, config: Config) -> Array:
    """Of one measurement, shape (dim,): its own where it has one, else the instrument's.

    Parameters
    ----------
    sensor : name of the log stream
    values : ndarray, shape (k,), its columns
    instrument : the sensor's
    config : effective configuration
    """
    sd = instrument.sd
    if sensor == "dvl":
        if values[4] > 0.0:
            sd = np.maximum(sd, min(values[4], LARGEST_SD))
        if config.dvl.scale_sd:
            sd = np.hypot(sd, config.dvl.scale_sd * np.linalg.norm(values[:3]))
    elif sensor == "thruster":  # a mean over values[3] seconds
        sd = sd / math.sqrt(values[3])
    elif sensor == "fix" and values[2] > 0.0:  # 0 is how receivers say that they do not know
        sd = np.full(len(sd), min(values[2], LARGEST_SD))
    elif sensor == "place" and values[1] > 0.0:
        sd = np.full(len(sd), min(values[1], LARGEST_SD))
    return sd
