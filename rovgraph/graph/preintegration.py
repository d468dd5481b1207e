"""IMU preintegration between keyframes (Forster et al. 2017; Carlone et al. 2014).

The state's origin is the IMU: its position and velocity are what an accelerometer can
know without the angular acceleration that (3.1) neglects. Samples are rotated into body
axes first, so biases are in body axes.

Between two samples both signals are taken as linear. GTSAM turns the specific force
with the attitude at the beginning of a step; rotating it by half the step's turn first
makes the integration second order.
"""

from dataclasses import dataclass

import gtsam
import numpy as np

from rovgraph.config import Config
from rovgraph.geometry import Array, cross, earth_rate_n
from rovgraph.state import Delta

INTEGRATION_SD = 1e-3  # per root second; smaller makes the covariance nearly singular
BRIDGE_ACC, BRIDGE_GYR = 0.3, 0.3  # densities over a gap: an ROV at its liveliest [SI/rtHz]
KNOCK = 3.0  # times the believed noise, before an interval's own scatter is taken


def preintegration_params(config: Config, acc: float, gyr: float) -> gtsam.PreintegrationCombinedParams:
    """GTSAM's parameters for a configuration and noise densities.

    Parameters
    ----------
    config : Config
    acc, gyr : noise densities [m/s^2/rtHz, rad/s/rtHz]
    """
    noise, env = config.imu.noise, config.environment
    params = gtsam.PreintegrationCombinedParams.MakeSharedD(env.gravity_mps2)
    params.setAccelerometerCovariance(np.eye(3) * acc**2)
    params.setGyroscopeCovariance(np.eye(3) * gyr**2)
    params.setBiasAccCovariance(np.eye(3) * noise.acc_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * noise.gyr_walk**2)
    params.setIntegrationCovariance(np.eye(3) * INTEGRATION_SD**2)
    if env.earth_rotation:
        params.setOmegaCoriolis(earth_rate_n(np.deg2rad(env.latitude_deg or 0.0)))
    return params


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


@dataclass(frozen=True)
class Snapshot:
    """Preintegrated motion from the keyframe to some time: see `rovgraph.state.Delta`."""

    dt: float
    dR: Array
    dv: Array
    dp: Array


def preintegrate(
    params: gtsam.PreintegrationCombinedParams, bias: Array, imu: Array, start: float, stops: Array, end: float
) -> tuple[gtsam.PreintegratedCombinedMeasurements, list[Snapshot]]:
    """Integrate IMU samples from ``start`` to ``end``.

    Parameters
    ----------
    params : of `preintegration_params`
    bias : ndarray, shape (6,), accelerometer, gyro, body axes
    imu : ndarray, shape (m, 7), time, specific force, rate in body axes; reaches from
        before ``start`` to after ``end``
    start, end : [s]
    stops : ndarray, shape (k,), increasing, times at which a snapshot is wanted [s]

    Returns
    -------
    pim : gtsam.PreintegratedCombinedMeasurements
    snapshots : list of Snapshot, k
    """
    t = imu[:, 0]
    inside = t[(t > start) & (t < end)]
    grid = np.array(sorted({start, end, *inside.tolist(), *stops.tolist()}))  # half of np.unique's time
    middle, dt = 0.5 * (grid[1:] + grid[:-1]), np.diff(grid)
    signal = _between(imu, middle)
    acc, gyr = signal[:, :3], signal[:, 3:]
    acc = acc + 0.5 * dt[:, None] * cross(gyr - bias[3:], acc - bias[:3])

    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    wanted = grid.searchsorted(stops).tolist()
    taken = {0: _snapshot(pim)} if 0 in wanted else {}
    for k, step in enumerate(zip(acc, gyr, dt.tolist(), strict=True), 1):
        pim.integrateMeasurement(*step)
        if k in wanted:
            taken[k] = _snapshot(pim)
    return pim, [taken[k] for k in wanted]


def _between(imu: Array, time: Array) -> Array:
    """The samples, linear in between and held beyond the ends; shape (k, 6)."""
    t, samples = imu[:, 0], imu[:, 1:]
    after = np.minimum(np.maximum(t.searchsorted(time), 1), len(t) - 1)
    before = after - 1
    share = np.minimum(np.maximum((time - t[before]) / (t[after] - t[before]), 0.0), 1.0)
    return np.asarray(samples[before] + share[:, None] * (samples[after] - samples[before]))


def _snapshot(pim: gtsam.PreintegratedCombinedMeasurements) -> Snapshot:
    return Snapshot(pim.deltaTij(), pim.deltaRij().matrix(), pim.deltaVij(), pim.deltaPij())


def whole(pim: gtsam.PreintegratedCombinedMeasurements) -> Delta:
    """The motion over a whole interval, one epoch."""
    motion, bias = _snapshot(pim), pim.biasHat().vector()
    return Delta(np.array([motion.dt]), motion.dR[None], motion.dv[None], motion.dp[None], bias[None])
