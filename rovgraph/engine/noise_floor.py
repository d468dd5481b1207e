"""Noise of the IMU as its samples show it while a dive goes on.

Thrusters shake an IMU beyond its data sheet, and the first seconds, at rest, do not show it.
"""

from dataclasses import dataclass, field

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.imu_samples import typical_scatter

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
    _seen: Array = field(default_factory=lambda: np.empty((INTERVALS, 2)))  # the newest, in a ring
    _count: int = 0

    def copy(self) -> "NoiseFloor":
        """One that goes on by itself from here."""
        return NoiseFloor(self.believed, self._seen.copy(), self._count)

    def state(self) -> Array:
        """What it remembers, shape (n, 2)."""
        if self._count < INTERVALS:
            return self._seen[: self._count].copy()
        return np.roll(self._seen, -(self._count % INTERVALS), axis=0)

    def restore(self, state: Array) -> None:
        """Remember what another did."""
        self._seen[: len(state)], self._count = state, len(state)

    def take(self, table: Array) -> None:
        """Take an interval's samples, shape (m, 7), at least three."""
        typical_scatter(table, self._seen[self._count % INTERVALS])
        self._count += 1

    def densities(self) -> Array:
        """Noise densities to go on with, shape (2,); blind to knocks."""
        known = min(self._count, INTERVALS)
        if known < ENOUGH:
            return self.believed
        seen = np.sort(self._seen[:known], axis=0)[known // 2]
        return np.where(seen > NOISIER * self.believed, seen, self.believed)
