"""IMU preintegration between keyframes (Forster et al. 2017; Carlone et al. 2014).

The state's origin is the IMU: its position and velocity are what an accelerometer can
know without the angular acceleration that (3.1) neglects. Samples are rotated into body
axes first, so biases are in body axes. The equations are in `rovgraph.kernels.preintegration`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rovgraph.config import Config
from rovgraph.engine.constant_velocity import NO_BIAS_SD, has_constant_velocity
from rovgraph.geometry import Array, earth_rate_n
from rovgraph.kernels import motion_row as at
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.preintegration import SNAPSHOT
from rovgraph.kernels.preintegration import preintegrate as integrate

INTEGRATION_SD = 1e-3  # per root second; smaller makes the covariance nearly singular


@dataclass(frozen=True)
class PreintegrationParams:
    """What is believed of the IMU and of where it moves.

    Attributes
    ----------
    densities : noise of accelerometer, gyro, their biases' walks and the integration [SI/rtHz]
    gravity : [m/s^2]
    earth_rate_n : of the Earth, zeros where n is taken as inertial [rad/s]
    """

    densities: Sequence[float]
    gravity: float
    earth_rate_n: Sequence[float] | Array

    def row(self, bias: Array, gap_s: float) -> Array:
        """The row of a motion that is yet to be integrated."""
        row = np.zeros(at.ROW)
        row[at.NOISE : at.NOISE + 5], row[at.GRAVITY] = self.densities, self.gravity
        row[at.EARTH_RATE : at.EARTH_RATE + 3] = self.earth_rate_n
        row[at.BIAS : at.BIAS + 6], row[at.GAP] = bias, gap_s
        return row


def preintegration_params(config: Config) -> PreintegrationParams:
    """Parameters of a configuration; without an IMU those of a motion without gravity, whose biases stay."""
    if has_constant_velocity(config):
        motion = config.motion
        return PreintegrationParams((motion.acc, motion.gyr, NO_BIAS_SD, NO_BIAS_SD, INTEGRATION_SD), 0.0, np.zeros(3))
    noise, env = config.imu.noise, config.environment
    rate = earth_rate_n(np.deg2rad(env.latitude_deg or 0.0)) if env.earth_rotation else np.zeros(3)
    densities = (noise.acc, noise.gyr, noise.acc_walk, noise.gyr_walk, INTEGRATION_SD)
    return PreintegrationParams(densities, env.gravity_mps2, rate)


def scatter(time: Array, samples: Array) -> Array:
    """How much samples differ from the mean of their neighbours, as noise densities.

    White noise of density d gives values of standard deviation d. Vibration and knocks
    that the sampling does not resolve scatter likewise, and harm the integration likewise.

    Parameters
    ----------
    time : ndarray, shape (m,)
    samples : ndarray, shape (m, k)

    Returns
    -------
    ndarray, shape (m - 2, k) [unit/rtHz]
    """
    odd = samples[1:-1] - 0.5 * (samples[:-2] + samples[2:])
    return np.asarray(odd * np.sqrt((time[-1] - time[0]) / (len(time) - 1) / 1.5))


def preintegrate(
    params: PreintegrationParams,
    bias: Array,
    imu: Array,
    start: float,
    stops: Array,
    end: float,
    gap_s: float = 0.0,
) -> tuple[Array, Array, Array]:
    """Integrate IMU samples from ``start`` to ``end``.

    Parameters
    ----------
    params : of `preintegration_params`
    bias : ndarray, shape (6,), accelerometer, gyro, body axes
    imu : ndarray, shape (m, 7), time, specific force, rate in body axes; reaches from
        before ``start`` to after ``end``
    start, end : [s]
    stops : ndarray, shape (k,), increasing, times at which a snapshot is wanted [s]
    gap_s : how long the IMU was silent, or 0 [s]

    Returns
    -------
    motion : ndarray, shape (ROW,), of `rovgraph.kernels.motion_row`
    covariance : ndarray, shape (15, 15), of its residual
    snapshots : ndarray, shape (k, SNAPSHOT), of `rovgraph.kernels.preintegration`
    """
    row, covariance, snapshots = params.row(bias, gap_s), np.empty((MOTION, MOTION)), np.empty((len(stops), SNAPSHOT))
    integrate(imu, start, end, stops, row, covariance, snapshots)
    return row, covariance, snapshots
