"""The IMU's preintegrated motion between two keyframes, and to measurements in between."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array, exp_rotation
from rovgraph.kernels import motion_row as at
from rovgraph.kernels.motion import LONGEST_BRIDGED_S
from rovgraph.kernels.preintegration import integrated_steps
from rovgraph.log import Stream


class SamplesOfLog(NamedTuple):
    """Samples ``first`` to before ``last`` of a log's IMU, which are not kept in body axes beside it.

    Attributes
    ----------
    stream : the IMU's
    R_sb : ndarray, shape (3, 3), from body axes to the IMU's
    """

    stream: Stream
    R_sb: Array
    first: int
    last: int

    def in_body(self) -> Array:
        """As of `Motion`, shape (m, 7)."""
        own = slice(self.first, self.last)
        return np.column_stack([self.stream.time[own], in_body(self.stream.data[own, :6], self.R_sb)])


def in_body(values: Array, R_sb: Array) -> Array:
    """Specific force and rate, shape (..., 6), from the IMU's axes to the body's."""
    # sample by sample, so that one alone comes out as it does among many
    return (values.reshape(-1, 2, 3) @ R_sb).reshape(values.shape)


@dataclass(frozen=True, eq=False, slots=True)
class Motion:
    """The motion over an interval, with what it was integrated from.

    Attributes
    ----------
    row : ndarray, shape (ROW,), as `rovgraph.kernels.motion_row` lays it out: what kernels take
    samples : ndarray, shape (m, 7), that cover it: time, specific force, rate in body axes; or their place in a log
    start, end : of the interval [s]
    stops : ndarray, shape (k,), times of measurements in it, where a step of the integration ends [s]
    """

    row: Array
    samples: "Array | SamplesOfLog"
    start: float
    end: float
    stops: Array

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.row[at.DURATION])

    @property
    def gap_s(self) -> float:
        """How long the IMU was silent, where that lies in the interval or reaches into it, or 0 [s]."""
        return float(self.row[at.GAP])

    @property
    def coasted(self) -> bool:
        """Whether the IMU was silent for so long that its interpolated signals count for little."""
        return self.gap_s > LONGEST_BRIDGED_S

    @property
    def dR(self) -> Array:
        """Rotation over the interval, shape (3, 3)."""
        return exp_rotation(self.row[at.TANGENT : at.TANGENT + 3])

    @property
    def dp(self) -> Array:
        """Change of position in the first keyframe's axes, without gravity, shape (3,) [m]."""
        return self.row[at.TANGENT + 3 : at.TANGENT + 6]

    @property
    def dv(self) -> Array:
        """Change of velocity in the first keyframe's axes, without gravity, shape (3,) [m/s]."""
        return self.row[at.TANGENT + 6 : at.TANGENT + 9]

    @property
    def bias(self) -> Array:
        """Bias that the integration assumed, accelerometer and gyro, shape (6,)."""
        return self.row[at.BIAS : at.BIAS + 6]

    @property
    def densities(self) -> Array:
        """Noise of accelerometer, gyro, their biases' walks and the integration, shape (5,) [SI/rtHz]."""
        return self.row[at.NOISE : at.NOISE + 5]

    @property
    def gravity(self) -> float:
        """[m/s^2]"""
        return float(self.row[at.GRAVITY])

    @property
    def earth_rate_n(self) -> Array:
        """Rate of the Earth that was reckoned with, shape (3,) [rad/s]."""
        return self.row[at.EARTH_RATE : at.EARTH_RATE + 3]

    @property
    def covariance(self) -> Array:
        """Of the residual's rotation, position, velocity, biases, shape (15, 15); of an outage as if bridged."""
        return self.row[at.COVARIANCE :].reshape(15, 15)

    def steps(self) -> Array:
        """What it was integrated from, shape (s, 8): end of each step, its length, specific force, rate."""
        imu = self.samples.in_body() if isinstance(self.samples, SamplesOfLog) else self.samples
        return integrated_steps(imu, self.start, self.stops, self.end, np.ascontiguousarray(self.bias))


@dataclass(frozen=True, eq=False, slots=True)
class Snapshot:
    """Preintegrated motion from the keyframe to some time: see `rovgraph.state.Delta`."""

    dt: float
    dR: Array
    dv: Array
    dp: Array

    @staticmethod
    def of(numbers: Array) -> "Snapshot":
        """From numbers as `rovgraph.kernels.preintegration` writes them, shape (16,)."""
        return Snapshot(float(numbers[0]), numbers[1:10].reshape(3, 3), numbers[10:13], numbers[13:16])
