"""The motion that the sensors on one clock show, in quantities that need no mounting to be compared.

Turning about the vertical, depth, speed, the velocity along a DVL's own axes, and the IMU's acceleration without
gravity along its own axes. Integrated quantities are compared by their changes over a window, so that biases and
constant offsets drop out.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from rovgraph.check.findings import valid_pings
from rovgraph.check.inertial import InertialMotion, inertial_motion
from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.log import Log
from rovgraph.log.streams import GAP_PERIODS, integral

Kind = Literal["turning", "depth", "speed", "velocity", "way"]
WINDOW = 1.0  # shortest over which changes are compared [s]
WINDOW_PERIODS = 3.0
FIX_WINDOW = 20.0  # over which fixes show a speed [s]
ENOUGH = 20  # measurements of a signal


@dataclass(frozen=True)
class Signal:
    """An integrated quantity.

    Attributes
    ----------
    kind : what changes: "turning" a heading [rad], "depth", a DVL's by its z axis [m], "speed" a distance [m],
        "velocity" along a DVL's axes [m/s], "way" its integral [m]
    sensor : that shows it
    time : ndarray, shape (n,), increasing [s]
    value : ndarray, shape (n, k)
    window : shortest over which its changes stand out [s]
    chord : the length of the change is what counts
    """

    kind: Kind
    sensor: str
    time: Array
    value: Array
    window: float
    chord: bool = False

    def changes(self, times: Array, window: float) -> Array:
        """Change over a window around each time, NaN where it is not known; shape (len(times), k), k = 1 of a chord."""
        period = float(np.median(np.diff(self.time)))
        longest = max(GAP_PERIODS * period, 0.5)
        gaps = np.concatenate([[0], np.cumsum(np.diff(self.time) > longest)])
        begin, end = times - 0.5 * window, times + 0.5 * window
        first = np.searchsorted(self.time, begin, side="right") - 1
        last = np.searchsorted(self.time, end)
        inside = (first >= 0) & (last < len(self.time))
        whole = gaps[last.clip(max=len(self.time) - 1)] == gaps[first.clip(min=0)]
        change = self._at(end) - self._at(begin)
        change = np.linalg.norm(change, axis=1, keepdims=True) if self.chord else change
        return np.where((inside & whole)[:, None], change, np.nan)

    def _at(self, times: Array) -> Array:
        return np.column_stack([np.interp(times, self.time, column) for column in self.value.T])


@dataclass(frozen=True)
class Acceleration:
    """What an IMU feels without gravity, along its own axes.

    Attributes
    ----------
    motion : on even times
    """

    motion: InertialMotion

    @property
    def time(self) -> Array:
        return self.motion.time

    def means(self, times: Array, window: float) -> tuple[Array, Array, Array]:
        """Means over a window around each time, NaN where not known, shape (n, 3) each.

        Returns
        -------
        acceleration [m/s^2], rate [rad/s], rate's change per second [rad/s^2]
        """
        motion, half = self.motion, 0.5 * window
        edges = np.concatenate([motion.time - 0.5 * motion.step, motion.time[-1:] + 0.5 * motion.step])
        held = np.column_stack([motion.acceleration_b, motion.rate_b, ~motion.known])
        sums = np.vstack([np.zeros(7), np.cumsum(held * motion.step, axis=0)])
        begin, end = (np.column_stack([np.interp(t, edges, c) for c in sums.T]) for t in (times - half, times + half))
        mean = (end - begin) / window
        inside = (times - half >= edges[0]) & (times + half <= edges[-1]) & (mean[:, 6] < 1e-6)
        ends = [
            np.column_stack([np.interp(t, motion.time, c) for c in motion.rate_b.T])
            for t in (times - half, times + half)
        ]
        mean = np.where(inside[:, None], mean, np.nan)
        return mean[:, :3], mean[:, 3:6], (ends[1] - ends[0]) / window


@dataclass(frozen=True)
class Motion:
    """All signals of a log.

    Attributes
    ----------
    signals : of sensors that are there for long enough
    acceleration : None without an IMU
    """

    signals: tuple[Signal, ...]
    acceleration: Acceleration | None

    def of(self, kind: Kind) -> list[Signal]:
        return [signal for signal in self.signals if signal.kind == kind]


def motion_of(log: Log) -> Motion:
    """What the sensors of a log show, each along its own axes."""
    signals = []
    inertial = inertial_motion(log, Config())
    if inertial is not None:
        turned = (np.cumsum(inertial.turning) - 0.5 * inertial.turning) * inertial.step
        turned = turned[inertial.known]
        signals.append(_signal("turning", "imu", inertial.time[inertial.known], turned))
    for sensor, column in (("ahrs", "ahrs_yaw"), ("dvl_heading", "dvl_heading")):
        if sensor in log:
            signals.append(_signal("turning", sensor, log[sensor].time, np.unwrap(log[sensor][column])))
    if "depth" in log:
        signals.append(_signal("depth", "depth", log["depth"].time, log["depth"]["depth"]))
    pings = valid_pings(log["dvl"]) if "dvl" in log else None
    if pings is not None and len(pings) >= ENOUGH:
        way = [integral(pings.time, column) for column in pings.data[:, :3].T]
        signals.append(_signal("velocity", "dvl", pings.time, pings.data[:, :3]))
        signals.append(_signal("way", "dvl", pings.time, np.column_stack(way)))
        signals.append(_signal("depth", "dvl", pings.time, way[2]))
        path = integral(pings.time, np.linalg.norm(pings.data[:, :3], axis=1))
        signals.append(_signal("speed", "dvl", pings.time, path))
    if "fix" in log:
        fix = log["fix"]
        signals.append(_signal("speed", "fix", fix.time, fix.data[:, :2], FIX_WINDOW, chord=True))
    enough = tuple(signal for signal in signals if len(signal.time) >= ENOUGH)
    return Motion(enough, None if inertial is None else Acceleration(inertial))


def _signal(kind: Kind, sensor: str, time: Array, value: Array, window: float = WINDOW, chord: bool = False) -> Signal:
    period = float(np.median(np.diff(time))) if len(time) > 1 else np.inf
    columns = value if value.ndim == 2 else value[:, None]
    return Signal(kind, sensor, time, columns, max(window, WINDOW_PERIODS * period), chord)
