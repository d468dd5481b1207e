"""Noise of the thesis's sensors: full covariances, and a line in the accelerometer."""

from dataclasses import dataclass

import numpy as np

from rovgraph.gauss_markov import stationary_walk, walked
from rovgraph.geometry import Array
from rovgraph.thesis import R_DVL, R_MTI, SAMPLE_S


@dataclass(frozen=True)
class Covariances:
    """White noise with correlations between the components of a sensor.

    The thesis took its matrices from the samples of a vehicle at rest (3.1.4, 3.2.2), so they
    belong to the sensors' own axes, the ones a log is in, whatever the mounting.

    Attributes
    ----------
    imu : ndarray, shape (9, 9), of a sample: specific force, rate, field as a fraction of
        the field's magnitude; IMU axes
    imu_rate : rate of the samples that ``imu`` is of [Hz]
    dvl : ndarray, shape (4, 4), of a ping: velocity, DVL axes, and heading [rad]
    """

    imu: Array
    imu_rate: float
    dvl: Array


THESIS = Covariances(R_MTI, 1.0 / SAMPLE_S, R_DVL)


@dataclass(frozen=True)
class Vibration:
    """A line in the accelerometer's spectrum.

    Attributes
    ----------
    frequency : [Hz]
    amplitude : of each axis [m/s^2]
    """

    frequency: float
    amplitude: float

    def at(self, time: Array, rng: np.random.Generator) -> Array:
        """Specific force at n epochs, each axis with a phase of its own, shape (n, 3)."""
        angle = 2.0 * np.pi * self.frequency * time[:, None] + rng.uniform(0.0, 2.0 * np.pi, 3)
        return np.asarray(self.amplitude * np.sin(angle))


def correlated(covariance: Array, n: int, rng: np.random.Generator) -> Array:
    """n draws of a normal distribution, shape (n, k).

    Parameters
    ----------
    covariance : ndarray, shape (k, k)
    """
    return np.asarray(rng.standard_normal((n, len(covariance))) @ np.linalg.cholesky(covariance).T)


def remembered(white: Array, steps: float) -> Array:
    """White noise made into a Gauss-Markov process of the same sd; shape (n, k).

    Parameters
    ----------
    white : ndarray, shape (n, k)
    steps : correlation time in samples, 0 = white it stays
    """
    if steps == 0.0:
        return white
    keep, sd = walked(stationary_walk(1.0, steps), steps, 1.0)
    driven = white * sd
    driven[0] = white[0]  # it has been going on for long
    from scipy.signal import lfilter  # type: ignore[attr-defined]  # takes a second to load, and few dives need it

    return np.asarray(lfilter([1.0], [1.0, -float(keep)], driven, axis=0))
