"""Times without heading or tilt in a dive without an IMU.

Without a gyro the turns of the vehicle in such a gap are unknown. A ping gives the velocity along the vehicle's own
axes, which does not determine north and east once the heading may be anywhere: a large error of heading also shortens
the way, and the covariance of a linearised estimate does not hold that. So a long gap is treated as an outage of all
sensors (`rovgraph.kernels.motion`): pings in it are left out, and the other measurements are thinned until it leaves
outages of that length.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.resolve import TILT
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.problem.motion import LONGEST_CRUISED_S, motion_model
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.instruments import heading_sources

DVL = ("dvl", "dvl_water")
PINGS = (*DVL, BEAMS)
TOGETHER_S = 2.0  # of measurements that are kept between silences, so that slow sensors are among them


@dataclass(frozen=True)
class AttitudeGap:
    """A time in which a part of the attitude was not measured.

    Attributes
    ----------
    part : "heading" or "tilt"
    begin, end : times of the last measurement before it and the first one after it, or of the log's ends [s]
    pings : of the DVL, that were left out
    """

    part: str
    begin: float
    end: float
    pings: int


def without_attitude_gaps(log: Log, config: Config) -> tuple[Log, list[AttitudeGap]]:
    """A log without the measurements in attitude gaps that a dive without an IMU cannot use, and the gaps.

    A log whose motion an IMU carries comes back as it is.

    Parameters
    ----------
    log, config : the dive, without what a sensor repeated, and what is believed of it
    """
    if motion_model(config, log.sensors) != "constant_velocity":
        return log, []
    used = [stream.time for sensor, stream in log.streams.items() if sensor != "imu" and len(stream)]
    if not used:
        return log, []
    first, last = min(time[0] for time in used), max(time[-1] for time in used)
    headings = heading_sources(config, log.sensors)
    stated = [first] if config.start.heading_deg is not None else []
    gaps = [
        *_gaps("heading", [np.array(stated), *(log[s].time for s in headings)], first, last),
        *_gaps("tilt", [log[TILT].time] if TILT in log else [], first, last),
    ]
    if not gaps:
        return log, []
    counted = [replace(gap, pings=_pings(log, gap)) for gap in gaps]
    return _thinned(log, _merged(gaps)), counted


def _gaps(part: str, times: Sequence[Array], first: float, last: float) -> list[AttitudeGap]:
    """Times of more than `LONGEST_CRUISED_S` between measurements, and between them and the ends of the log."""
    known = np.unique(np.concatenate([np.array([first, last]), *times]))
    wide = np.flatnonzero(np.diff(known) > LONGEST_CRUISED_S)
    return [AttitudeGap(part, float(known[k]), float(known[k + 1]), 0) for k in wide]


def _inside(time: Array, gap: AttitudeGap) -> NDArray[np.bool_]:
    """What neither end measured."""
    return np.asarray((time > gap.begin) & (time < gap.end))


def _pings(log: Log, gap: AttitudeGap) -> int:
    return sum(int(_inside(log[sensor].time, gap).sum()) for sensor in DVL if sensor in log)


def _merged(gaps: Sequence[AttitudeGap]) -> list[AttitudeGap]:
    """Gaps that overlap become one."""
    merged: list[AttitudeGap] = []
    for gap in sorted(gaps, key=lambda g: g.begin):
        if merged and gap.begin < merged[-1].end:
            merged[-1] = replace(merged[-1], end=max(merged[-1].end, gap.end))
        else:
            merged.append(gap)
    return merged


def _thinned(log: Log, gaps: Sequence[AttitudeGap]) -> Log:
    """The log without pings in gaps, and with other measurements only at times that leave silences."""
    streams = {sensor: stream for sensor, stream in log.streams.items() if sensor != "imu"}
    every = np.unique(np.concatenate([stream.time for sensor, stream in streams.items() if sensor not in PINGS]))
    for gap in gaps:
        begins = _spaced(every[_inside(every, gap)], gap)
        for sensor, stream in streams.items():
            since = stream.time[:, None] - begins
            stays = ((since >= 0.0) & (since <= TOGETHER_S)).any(axis=1) & (sensor not in PINGS)
            streams[sensor] = stream.take(~_inside(stream.time, gap) | stays)
    return replace(log, streams={**log.streams, **streams})


def _spaced(time: Array, gap: AttitudeGap) -> Array:
    """Those of some times from which `TOGETHER_S` is kept, with a silence before and after each."""
    kept, before = [], gap.begin
    for t in time[time < gap.end - LONGEST_CRUISED_S - TOGETHER_S].tolist():
        if t > before + LONGEST_CRUISED_S:
            kept.append(t)
            before = t + TOGETHER_S
    return np.array(kept)
