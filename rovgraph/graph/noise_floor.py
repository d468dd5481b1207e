"""Noise of the IMU as its samples show it while a dive goes on.

Thrusters shake an IMU beyond its data sheet, and the first seconds, at rest, do not show it.
"""

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from rovgraph.geometry import Array

NOISIER = 1.25  # times the believed density, before the samples' own is taken
INTERVALS = 200  # the newest ones, over which it is taken
ENOUGH = 20


@dataclass
class NoiseFloor:
    """The believed densities, raised to those of the newest intervals.

    Attributes
    ----------
    believed : ndarray, shape (2,), of accelerometer and gyro [SI/rtHz]
    """

    believed: Array
    _recent: deque[Array] = field(default_factory=lambda: deque(maxlen=INTERVALS))

    def copy(self) -> "NoiseFloor":
        """One that goes on by itself from here."""
        return NoiseFloor(self.believed, self._recent.copy())

    def state(self) -> Array:
        """What it remembers, shape (n, 2)."""
        return np.array(self._recent).reshape(-1, 2)

    def restore(self, state: Array) -> None:
        """Remember what another did."""
        self._recent.clear()
        self._recent.extend(state)

    def take(self, odd: Array) -> None:
        """Take an interval's scatter, shape (m, 6), of `rovgraph.graph.preintegration.scatter`."""
        middle = np.sort(np.abs(odd), axis=0)[len(odd) // 2]
        self._recent.append(1.4826 * middle.reshape(2, 3).mean(axis=1))

    def densities(self) -> Array:
        """Noise densities to go on with, shape (2,); blind to knocks."""
        if len(self._recent) < ENOUGH:
            return self.believed
        seen = np.sort(self._recent, axis=0)[len(self._recent) // 2]
        return np.where(seen > NOISIER * self.believed, seen, self.believed)
