"""How far apart the clocks of two recordings are that share no time: by the motion that both show.

The stream is first put where its start meets that of the IMU; what is left, up to minutes, is searched for as between
clocks of one epoch. So clocks may be any time apart, if the recordings are of one dive.
"""

from dataclasses import replace

import numpy as np

from rovgraph.check.agreement import heading_lag
from rovgraph.check.jumps import compare
from rovgraph.check.lags import ORIENTATIONS
from rovgraph.config import Config
from rovgraph.log import Log
from rovgraph.rules import ACCELERATION, EPOCH_SD_S


def shift_of_epoch(log: Log, config: Config, sensor: str) -> tuple[float, float] | None:
    """How much later the stamps of a sensor are than the IMU's, and its sd [s]; None where the motion does not tell.

    Parameters
    ----------
    sensor : "dvl" by its acceleration, or a compass by its turning
    """
    apart = float(log[sensor].time[0] - log["imu"].time[0])
    moved = replace(log[sensor], time=log[sensor].time - apart)
    beside = replace(log, streams={"imu": log["imu"], sensor: moved})
    lag = _dvl_lag(beside, config) if sensor == "dvl" else heading_lag(beside, config, sensor)
    if lag is None or not lag[1] < EPOCH_SD_S:
        return None
    return apart + lag[0], lag[1]


def _dvl_lag(log: Log, config: Config) -> tuple[float, float] | None:
    """Lag of a DVL and its sd [s], axes as configured."""
    compared = compare(log, config)
    if compared is None:
        return None
    found = compared.search()
    k = int(np.argmin(found.error[0]))
    if found.agreement[0, k] < ACCELERATION.follows:
        return None
    fit = compared.refine(float(found.lags[k]), ORIENTATIONS[0])
    return None if fit is None else (fit.lag, fit.lag_sd)
