"""Motion of a dive without an IMU: the vehicle goes on as it went (`rovgraph.kernels.cruising`).

To an assembler the dive has an IMU whose samples are all zero, in a world without gravity: one at the time of every
measurement, which says that time goes on. A silence of all sensors is an outage of that IMU
(`rovgraph.kernels.coasting`).

Between a keyframe and a measurement no noise is reckoned with, so what is measured at one time makes a keyframe, but
for what is within ``graph.min_gap_s`` of one.
"""

import math
from collections.abc import Collection

import numpy as np

from rovgraph.config import Config
from rovgraph.engine.motion import Motion
from rovgraph.engine.preintegration import INTEGRATION_SD, PreintegrationParams, integrate_motion
from rovgraph.engine.samples import Samples, surveyed, whole
from rovgraph.geometry import Array
from rovgraph.kernels.coasting import BRIDGE_ACC, BRIDGE_GYR
from rovgraph.kernels.motion_row import NO_IMU
from rovgraph.log import Log, Measurement, Stream

NO_BIAS_SD = 1e-6  # of biases that nothing depends on, at the start and per root second [SI]
LONGEST_CRUISED_S = 10.0  # between measurements; in a longer silence nobody knows which way it turned


def motion_model(config: Config, available: Collection[str]) -> str:
    """The ``motion.model`` of a log that has some streams; without an IMU attitude has to be measured."""
    without_imu = "imu" not in available and "vehicle_tilt" in available
    return config.motion.model or ("constant_velocity" if without_imu else "imu")


def has_constant_velocity(config: Config) -> bool:
    """Whether a dive is reckoned without an IMU, once `motion_model` is resolved."""
    return config.motion.model == "constant_velocity"


def gravity(config: Config) -> float:
    """Gravity that the motion is integrated with, none where no accelerometer feels it [m/s^2]."""
    return 0.0 if has_constant_velocity(config) else config.environment.gravity_mps2


def tick(measurement: Measurement) -> Measurement:
    """The sample that says that time goes on to a measurement."""
    return measurement._replace(sensor="imu", values=np.zeros(6))


def ticks(log: Log) -> Stream:
    """A sample at the time of every measurement that is not the IMU's."""
    streams = [stream for sensor, stream in log.streams.items() if sensor != "imu"]
    time = np.unique(np.concatenate([stream.time for stream in streams])) if streams else np.empty(0)
    return Stream("imu", ("",) * 6, time, np.zeros((len(time), 6)), np.zeros(len(time), np.int64))


class Ticks(Samples):
    """The zero samples of a dive without an IMU; parameters as `Samples`."""

    def __init__(self, config: Config) -> None:
        imu = config.imu.model_copy(update={"max_gap_s": np.inf})
        super().__init__(config.model_copy(update={"imu": imu}), learn_noise=False)
        self.params = _params(config.motion.acc, config.motion.gyr)
        self._bridge = _params(BRIDGE_ACC, BRIDGE_GYR)

    def add(self, m: Measurement) -> bool:
        """Let time go on to a measurement; no sample is missing before it."""
        return m.time > self.newest and super().add(m)

    def integrated(
        self, table: Array, bias: Array, start: float, stops: Array, end: float, learn: bool
    ) -> tuple[Motion, Array]:
        """As `Samples.integrated`: the vehicle goes on as it went, in a long silence whichever way it turns."""
        silent = float(surveyed(table, *whole(table), np.array([start]), np.array([end]))[0, 1])
        params, gap = (self._bridge, silent) if silent > LONGEST_CRUISED_S else (self.params, NO_IMU)
        return integrate_motion(params, bias, table, start, stops, end, gap)

    def rate(self, table: Array, time: float) -> tuple[Array, float]:
        """None is measured."""
        return np.zeros(3), math.radians(self._config.motion.rate_sd_dps)

    def _take_period(self, period: float) -> None:
        """No silence is a gap."""


def _params(acc: float, gyr: float) -> PreintegrationParams:
    """Parameters of a motion without gravity, whose biases stay."""
    return PreintegrationParams((acc, gyr, NO_BIAS_SD, NO_BIAS_SD, INTEGRATION_SD), 0.0, (0.0, 0.0, 0.0))
