"""The water that a vehicle moves in: a current and the orbits of small waves.

Linear waves in deep water: a wave of amplitude A and angular frequency s moves the water at
depth z on circles with the speed A s exp(-k z), k = s^2 / g, along its direction and, a
quarter of a period apart, vertically. All water around the vehicle moves as one.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array
from rovgraph.thesis import WAVE_HZ

GRAVITY = 9.81
SURFACE_AMPLITUDE = 0.1  # of all waves together: "small waves" (3.1.4); the figure is a choice [m]
BANDWIDTH_HZ = 0.02  # sd of the waves' frequencies about the thesis's line: a choice
COMPONENTS = 7
CURRENT_MAX = 0.1  # of a current that is drawn; a lake without a river: a choice [m/s]


@dataclass(frozen=True)
class Sea:
    """Motion of the water, the same everywhere.

    Attributes
    ----------
    current_n : ndarray, shape (3,) [m/s]
    amplitude_n : ndarray, shape (k, 3), amplitudes of the waves' velocity [m/s]
    frequency : ndarray, shape (k,) [Hz]
    phase : ndarray, shape (k, 3) [rad]
    """

    current_n: Array
    amplitude_n: Array
    frequency: Array
    phase: Array

    def velocity(self, time: Array) -> Array:
        """Velocity of the water at n epochs, shape (n, 3) [m/s]."""
        waves = [a * np.sin(angle) for a, angle in self._waves(time)]
        return np.asarray(sum(waves, np.tile(self.current_n, (len(time), 1))))

    def acceleration(self, time: Array) -> Array:
        """Acceleration of the water at n epochs, shape (n, 3) [m/s^2]."""
        rates = 2.0 * np.pi * self.frequency
        waves = [s * a * np.cos(angle) for s, (a, angle) in zip(rates, self._waves(time), strict=True)]
        return np.asarray(sum(waves, np.zeros((len(time), 3))))

    def _waves(self, time: Array) -> list[tuple[Array, Array]]:
        """Amplitude (3,) and angle (n, 3) of each wave."""
        turns = 2.0 * np.pi * time[:, None]
        return [(a, turns * f + p) for a, f, p in zip(self.amplitude_n, self.frequency, self.phase, strict=True)]


STILL = Sea(np.zeros(3), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)))


def drawn_sea(
    rng: np.random.Generator,
    depth: float,
    current: tuple[float, float] | None = None,
    amplitude: float = SURFACE_AMPLITUDE,
) -> Sea:
    """Waves about the thesis's frequency from one direction, and a current.

    Parameters
    ----------
    rng : numpy Generator
    depth : of the dive [m], positive
    current : north, east [m/s]; None = drawn, of at most `CURRENT_MAX`
    amplitude : of all waves together at the surface [m]
    """
    course, toward = rng.uniform(0.0, 2.0 * np.pi, 2)
    drift = rng.uniform(0.0, CURRENT_MAX) * np.array([np.cos(course), np.sin(course)])
    frequency = WAVE_HZ + BANDWIDTH_HZ * rng.standard_normal(COMPONENTS).clip(-3.0, 3.0)
    start = rng.uniform(0.0, 2.0 * np.pi, COMPONENTS)
    rate = 2.0 * np.pi * frequency
    speed = amplitude / np.sqrt(COMPONENTS) * rate * np.exp(-(rate**2) / GRAVITY * depth)
    orbit = np.array([np.cos(toward), np.sin(toward), 1.0])
    phase = start[:, None] + np.array([0.0, 0.0, 0.5 * np.pi])
    current_n = np.append(drift if current is None else current, 0.0)
    return Sea(current_n, speed[:, None] * orbit, frequency, phase)
