"""The start that a configuration states, against the first position fixes.

The vehicle cannot be further from its start than the way that the DVL has measured since. Fixes of another origin, or
turned by a wrong heading of the ship, begin somewhere else.
"""

from collections.abc import Iterator

import numpy as np

from rovgraph.check.findings import Finding, valid_pings
from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.log import Log
from rovgraph.log.streams import integral
from rovgraph.rules import START_REMEDY, SURE

FIRST = 5  # fixes, of which the median counts
ENOUGH = 3  # fixes
SOON = 30.0  # after the log's begin [s]


def start(log: Log, config: Config) -> Iterator[Finding]:
    """Distance of the first fixes from ``start.north_m`` and ``start.east_m``, less the way since."""
    stated = config.start
    if not (stated.located and {"dvl", "fix"} <= log.sensors):
        return
    begin = min(float(stream.time[0]) for stream in log.streams.values())
    fix = log["fix"]
    first = fix.take(np.arange(min(FIRST, int(np.searchsorted(fix.time, begin + SOON)))))
    pings = valid_pings(log["dvl"])
    if len(first) < ENOUGH or not len(pings) or pings.time[0] > begin + SOON:
        return
    away = np.hypot(first.data[:, 0] - (stated.north_m or 0.0), first.data[:, 1] - (stated.east_m or 0.0))
    way = _way(np.linalg.norm(pings.data[:, :2], axis=1), pings.time, begin, first.time)
    own = float(np.nanmedian(np.where(np.isnan(first["fix_sd"]), config.fix.sd_m, first["fix_sd"])))
    arm = float(np.hypot(*config.fix.lever_arm_m[:2]))
    beyond = float(np.median(away - way)) - arm
    if beyond > SURE * np.hypot(stated.position_sd_m, own):
        yield Finding(
            "fix",
            "warning",
            f"the first fixes lie {np.median(away):.1f} m from start.north_m and start.east_m, of which the vehicle "
            f"moved at most {np.median(way):.1f} m: {START_REMEDY}",
            "start",
        )


def _way(speed: Array, time: Array, begin: float, at: Array) -> Array:
    """Length of the way since ``begin`` [m], before the first ping at its speed."""
    when = np.unique(np.concatenate([[begin], time, at]))
    v = np.interp(when, time, speed)
    return np.asarray(np.interp(at, when, integral(when, v)))
