"""A DVL that reports exactly zero although the vehicle moves.

Some instruments write zeros when they lose the bottom, others while they are held. A
DVL that measures a standstill shows its noise.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from rovgraph.check.findings import Finding, runs, since
from rovgraph.config import Config
from rovgraph.log import Log, Stream

MIN_PINGS = 5
MIN_SECONDS = 3.0
ABRUPT_SPEED = 0.1  # of the pings just before or after [m/s]
AROUND = 3  # that many pings
AROUND_SECONDS = 5.0  # not further away
TURN_RATE = 0.05  # sd of the rate about any axis that is no standstill [rad/s]
FIX_DISTANCE = 10.0  # between fixes that is no standstill [m]
DRIVE_CHANGE = 0.5  # of a thruster, as part of its sd over the log


def dvl_frozen_intervals(log: Log) -> list[tuple[float, float]]:
    """When the DVL reports exactly zero on all axes although the vehicle moves.

    Returns
    -------
    list of (first, last) : times of the first and last zero ping, both included [s]
    """
    return [(first, last) for first, last, _ in _frozen(log)]


def without_frozen_pings(log: Log) -> Log:
    """The log without the DVL's zeros that are no measurement."""
    intervals = dvl_frozen_intervals(log)
    if not intervals:
        return log
    dvl = log["dvl"]
    keep = ~np.any([(dvl.time >= first) & (dvl.time <= last) for first, last in intervals], axis=0)
    kept = replace(dvl, time=dvl.time[keep], data=dvl.data[keep], row=dvl.row[keep])
    return replace(log, streams={**log.streams, "dvl": kept})


def standstill(log: Log, config: Config) -> Iterator[Finding]:
    """Zeros of the DVL that are no measurement."""
    found = list(_frozen(log))
    for first, last, why in found[:5]:
        yield Finding(
            "dvl", "warning", f"exactly zero for {last - first:.1f} s from {since(log, first)} on although {why}"
        )
    if len(found) > 5:
        total = sum(last - first for first, last, _ in found)
        yield Finding("dvl", "warning", f"exactly zero {len(found)} times, {total:.0f} s in all, although it moves")


def _frozen(log: Log) -> Iterator[tuple[float, float, str]]:
    """First and last time of zeros that are no standstill, and what shows it."""
    if "dvl" not in log:
        return
    stream = log["dvl"]
    valid = stream["dvl_valid"] == 1.0
    pings = Stream(stream.sensor, stream.columns, stream.time[valid], stream.data[valid], stream.row[valid])
    zero = ~np.any(pings.data[:, :3], axis=1)
    for a, b in runs(zero):
        first, last = float(pings.time[a]), float(pings.time[b])
        if b - a + 1 < MIN_PINGS or last - first < MIN_SECONDS:
            continue
        why = _around(pings, a, b) or _meanwhile(log, first, last)
        if why:
            yield first, last, why


def _around(pings: Stream, a: int, b: int) -> str:
    """Pings next to the zeros that move at speed; "" if they do not."""
    speed = np.linalg.norm(pings.data[:, :3], axis=1)
    sides = {"before": np.arange(max(a - AROUND, 0), a), "after": np.arange(b + 1, min(b + 1 + AROUND, len(pings)))}
    for side, index in sides.items():
        edge = pings.time[a if side == "before" else b]
        near = index[np.abs(pings.time[index] - edge) < AROUND_SECONDS]
        if near.size and np.median(speed[near]) > ABRUPT_SPEED:
            return f"it moves at {np.median(speed[near]):.2f} m/s just {side}"
    return ""


def _meanwhile(log: Log, first: float, last: float) -> str:
    """What other sensors say of the motion between two times; "" if they see none."""
    rates = _between(log, "imu", first, last)[:, 3:]
    if len(rates) > 10 and rates.std(axis=0).max() > TURN_RATE:
        return "the gyro turns"
    fixes = _between(log, "fix", first, last)[:, :2]
    if len(fixes) > 1 and np.linalg.norm(fixes[-1] - fixes[0]) > FIX_DISTANCE:
        return f"the fixes move by {np.linalg.norm(fixes[-1] - fixes[0]):.0f} m"
    drive = _between(log, "thruster", first, last)
    if len(drive) > 2 and (drive.std(axis=0) > DRIVE_CHANGE * np.maximum(log["thruster"].data.std(axis=0), 1e-9)).any():
        return "the thrusters work"
    return ""


def _between(log: Log, sensor: str, first: float, last: float) -> np.ndarray:
    if sensor not in log:
        return np.empty((0, 6))
    stream = log[sensor]
    return stream.data[(stream.time >= first) & (stream.time <= last)]
