"""Motion between keyframes: IMU preintegration, scale errors of the IMU, and dives without an IMU.

Preintegration follows Forster et al. (2017) and Carlone et al. (2014); its equations are in
`rovgraph.kernels.preintegration`. The state's origin is the IMU: there the accelerometer needs no angular acceleration,
which (3.1) neglects. Samples are rotated into body axes first, so biases are in body axes.

Scale errors of accelerometer and gyro act as biases over a short time. A sample is (1 + k) times the true value,
component by component along the IMU's axes, plus the bias. Over an interval of a fraction of a second k times the mean
signal may stand for k times each sample, so that the motion that was integrated without k serves with the bias
b + S k, where S holds the mean signal (`scale_to_bias`). The same S takes every derivative by the bias to one by k.

Without an IMU the vehicle moves with nearly constant velocity (`rovgraph.kernels.motion`). For the assembly the dive
then has an IMU whose samples are all zero, in a world without gravity: one at the time of every measurement, which
marks that time. When all sensors are silent, that IMU has an outage. No noise is modelled between a keyframe and a
measurement, so every measurement time makes a keyframe, except within ``graph.min_gap_s`` of one.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array, earth_rate_n
from rovgraph.kernels import motion_row as at
from rovgraph.kernels.assembly import LONGEST_CRUISED_S as LONGEST_CRUISED_S
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.preintegration import SNAPSHOT
from rovgraph.kernels.preintegration import preintegrate as integrate
from rovgraph.log import Log, Stream
from rovgraph.model.calibration import Belief
from rovgraph.model.config import Config
from rovgraph.model.state import State

NO_BIAS_SD = 1e-6  # of biases that nothing depends on, at the start and per root second [SI]


def motion_model(config: Config, available: Collection[str]) -> str:
    """The ``motion.model`` of a log that has some streams; without an IMU attitude has to be measured."""
    without_imu = "imu" not in available and "vehicle_tilt" in available
    return config.motion.model or ("constant_velocity" if without_imu else "imu")


def has_constant_velocity(config: Config) -> bool:
    """Whether a dive is estimated without an IMU, once `motion_model` is resolved."""
    return config.motion.model == "constant_velocity"


def gravity(config: Config) -> float:
    """Gravity that the motion is integrated with, 0 without an accelerometer [m/s^2]."""
    return 0.0 if has_constant_velocity(config) else config.environment.gravity


def ticks(log: Log) -> Stream:
    """A sample at the time of every measurement that is not the IMU's."""
    streams = [stream for sensor, stream in log.streams.items() if sensor != "imu"]
    time = np.unique(np.concatenate([stream.time for stream in streams])) if streams else np.empty(0)
    return Stream("imu", ("",) * 6, time, np.zeros((len(time), 6)), np.zeros(len(time), np.int64))


INTEGRATION_SD = 1e-3  # per root second; smaller makes the covariance nearly singular


@dataclass(frozen=True)
class PreintegrationParams:
    """Noise of the IMU, gravity and Earth rate for preintegration.

    Attributes
    ----------
    densities : noise of accelerometer, gyro, their biases' walks and the integration [SI/rtHz]
    gravity : [m/s^2]
    earth_rate_n : of the Earth, zeros where n is taken as inertial [rad/s]
    latitude : of the origin of frame "earth" [rad]; NaN = n is flat
    """

    densities: Sequence[float]
    gravity: float
    earth_rate_n: Sequence[float] | Array
    latitude: float = np.nan

    def row(self, bias: Array, gap_s: float) -> Array:
        """The row of a motion that is yet to be integrated."""
        row = np.zeros(at.ROW)
        row[at.NOISE : at.NOISE + 5], row[at.GRAVITY] = self.densities, self.gravity
        row[at.EARTH_RATE : at.EARTH_RATE + 3], row[at.LATITUDE] = self.earth_rate_n, self.latitude
        row[at.BIAS : at.BIAS + 6], row[at.GAP] = bias, gap_s
        return row


def preintegration_params(config: Config) -> PreintegrationParams:
    """Parameters of a configuration; without an IMU those of a motion without gravity, whose biases stay."""
    noise, env, motion = config.imu.noise, config.environment, config.motion
    if has_constant_velocity(config):
        densities = (motion.acc, motion.gyr, NO_BIAS_SD, NO_BIAS_SD, INTEGRATION_SD)
        return PreintegrationParams(densities, 0.0, np.zeros(3), env.earth_latitude)
    rate = earth_rate_n(np.deg2rad(env.latitude_deg or 0.0)) if env.earth_rotation else np.zeros(3)
    densities = (noise.acc, noise.gyr, noise.acc_walk, noise.gyr_walk, INTEGRATION_SD)
    return PreintegrationParams(densities, env.gravity, rate, env.earth_latitude)


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


SCALES = ("acc_scale", "gyr_scale")
COLUMNS = {"acc_scale": slice(0, 3), "gyr_scale": slice(3, 6)}


def wanted(beliefs: Mapping[str, Belief]) -> bool:
    """Whether any scale is estimated or considered, or known to be off."""
    return any(beliefs[name].estimate or beliefs[name].considered or beliefs[name].mean.any() for name in SCALES)


def scale_to_bias(signal_b: Array, R_bs: Array) -> Array:
    """Derivative by the scales of the bias that they act as.

    Parameters
    ----------
    signal_b : ndarray, shape (..., 6), mean specific force and rate, body axes, biases taken off
    R_bs : ndarray, shape (3, 3), mounting of the IMU

    Returns
    -------
    ndarray, shape (..., 6, 6), bias (accelerometer, gyro; body axes) by `SCALES`
    """
    S = np.zeros((*signal_b.shape, 6))
    for part in COLUMNS.values():
        S[..., part, part] = R_bs * (signal_b[..., part] @ R_bs)[..., None, :]
    return S


def biased(state: State, S: Array) -> State:
    """The state with the bias that the scales act as; ``S`` has shape (n, 6, 6)."""
    scales = [np.broadcast_to(state.calibration[name], (len(state), 3)) for name in SCALES]
    bias = state.bias + (S @ np.concatenate(scales, axis=-1)[..., None])[..., 0]
    return State(state.R_nb, state.p_n, state.v_n, bias, state.calibration)
