"""Motion of a dive without an IMU: the vehicle goes on as it went (`rovgraph.kernels.cruising`).

To an assembler the dive has an IMU whose samples are all zero, in a world without gravity: one at the time of every
measurement, which says that time goes on. A silence of all sensors is an outage of that IMU
(`rovgraph.kernels.coasting`).

Between a keyframe and a measurement no noise is reckoned with, so what is measured at one time makes a keyframe, but
for what is within ``graph.min_gap_s`` of one.
"""

from collections.abc import Collection

import numpy as np

from rovgraph.config import Config
from rovgraph.kernels.assembly import LONGEST_CRUISED_S as LONGEST_CRUISED_S
from rovgraph.log import Log, Stream

NO_BIAS_SD = 1e-6  # of biases that nothing depends on, at the start and per root second [SI]


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


def ticks(log: Log) -> Stream:
    """A sample at the time of every measurement that is not the IMU's."""
    streams = [stream for sensor, stream in log.streams.items() if sensor != "imu"]
    time = np.unique(np.concatenate([stream.time for stream in streams])) if streams else np.empty(0)
    return Stream("imu", ("",) * 6, time, np.zeros((len(time), 6)), np.zeros(len(time), np.int64))
