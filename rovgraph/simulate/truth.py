"""The simulated vehicle's true constants, noise and faults, apart from what an estimator assumes.

Includes the noise of the thesis's sensors: full covariances, and a line in the accelerometer.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.model.calibration import CHART_PLACE, LAYERS, Belief
from rovgraph.model.config import Config, beliefs
from rovgraph.model.gauss_markov import stationary_walk, walked
from rovgraph.model.thesis import R_DVL, R_MTI, SAMPLE_S
from rovgraph.simulate.environment import UNDISTURBED, Magnetism
from rovgraph.simulate.path import Path


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


@dataclass(frozen=True)
class Truth:
    """The vehicle, its sensors and their faults.

    Attributes
    ----------
    config : mountings, lever arms, noise and environment, taken as exact
    calibration : true values by name, each of shape (dim,); what is not given is drawn from
        the configuration's belief where it is estimated, and is the belief's mean elsewhere
    bias : ndarray, shape (6,), bias at the first sample, accelerometer [m/s^2] and gyro
        [rad/s], body axes; None = drawn from the configuration's sd
    noise : False = no noise, no bias, no drawn calibration, no outliers
    start_error : the dive begins off its planned start by a draw from the start's sd
    imu_rate : [Hz]; the magnetometer has the same
    dvl_rate : mean rate of the pings [Hz]
    dvl_jitter : intervals between pings vary by up to this share
    water_track : pings also measure the velocity relative to the water
    depth_rate, ahrs_rate : [Hz], None = no such sensor
    fix_interval : [s], None = no fixes
    covariances : noise of IMU, magnetometer, DVL and its compass instead of the configuration's
    vibration : a line in the accelerometer's spectrum
    magnetism : iron around the vehicle, an uncalibrated magnetometer
    ahrs_memory : correlation time of the errors of the unit's own attitude [s]
    outlier_share : part of the pings that are wrong
    outlier_size : sd of the error of a wrong ping, every component [m/s]
    profiles : length of a cell [m] and number of cells of an ADCP's profiles; None = without
    dropouts : intervals (from, to) [s] without bottom lock
    places : north, east [m] of each place that a camera recognises, 1, 2, ... in the log
    place_radius : how near the camera has to come [m]
    false_places : part of the landmarks that are of another spot
    ship : what the ship of an acoustic system does; None = it stays near the dive's middle
    """

    config: Config = field(default_factory=Config)
    calibration: Mapping[str, Array] = field(default_factory=dict)
    bias: Array | None = None
    noise: bool = True
    start_error: bool = False
    imu_rate: float = 100.0
    dvl_rate: float = 5.6
    dvl_jitter: float = 0.1
    water_track: bool = False
    depth_rate: float | None = 5.0
    ahrs_rate: float | None = None
    fix_interval: float | None = None
    covariances: Covariances | None = None
    vibration: Vibration | None = None
    magnetism: Magnetism = UNDISTURBED
    ahrs_memory: float = 0.0
    outlier_share: float = 0.0
    outlier_size: float = 0.5
    profiles: tuple[float, float] | None = None
    dropouts: tuple[tuple[float, float], ...] = ()
    places: tuple[tuple[float, float], ...] = ()
    place_radius: float = 1.0
    false_places: float = 0.0
    ship: Path | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.outlier_share <= 1.0:
            raise InputError(f"share of outliers {self.outlier_share}: between 0 and 1 is expected")
        if not 0.0 <= self.false_places < 1.0:
            raise InputError(f"share of false places {self.false_places}: 0 to less than 1 is expected")
        unknown = set(self.calibration) - set(beliefs(self.config))
        if unknown:
            raise InputError(f"unknown calibration variable {min(unknown)}")

    def draw_calibration(self, rng: np.random.Generator) -> dict[str, Array]:
        """True value of every calibration variable, shape (dim,) each.

        Each has a generator of its own, so that a variable more does not change the dives of old seeds.
        """
        out = {}
        entropy = int(rng.integers(2**62))
        for name, belief in beliefs(self.config).items():
            generator = np.random.default_rng([entropy, zlib.crc32(name.encode())])
            draw = belief.sd * generator.standard_normal(belief.variable.dim)
            uncertain = (belief.estimate or belief.considered) and not of_waves(belief)
            value = belief.mean + draw if uncertain and self.noise else belief.mean
            out[name] = np.array(self.calibration.get(name, value), float).reshape(belief.variable.dim)
        return out

    def draw_bias(self, rng: np.random.Generator) -> Array:
        """Bias at the first sample, shape (6,)."""
        imu = self.config.imu
        sd = np.repeat([imu.acc_bias_sd_mps2, np.deg2rad(imu.gyr_bias_sd_dps)], 3)
        draw = sd * rng.standard_normal(6)
        if self.bias is not None:
            return np.array(self.bias, float)
        return draw if self.noise else np.zeros(6)

    def draw_start(self, rng: np.random.Generator) -> Array:
        """Offset of the true start from the planned one, shape (3,) [m]."""
        draw = self.config.start.position_sd_m * rng.standard_normal(3)
        return draw if self.start_error else np.zeros(3)


def of_waves(belief: Belief) -> bool:
    """Whether a variable stands for what waves do, which is in a simulated path, or for what is not simulated."""
    return belief.variable.name in ("water_oscillation", *LAYERS, CHART_PLACE)
