"""Keyframes: the interval that leads to each, and the measurements that belong to it."""

from dataclasses import dataclass
from typing import NamedTuple

from rovgraph.engine.late_stamp_window import LateStampWindow
from rovgraph.engine.motion import Motion, Snapshot
from rovgraph.geometry import Array


class LandmarkObservation(NamedTuple):
    """Which place a camera or sonar saw.

    Attributes
    ----------
    name : what the log calls it
    number : of the place's variable: that of its first landmark. To begin with each landmark is of a place
        of its own; `rovgraph.graph.places` finds those that are one.
    believed : False = the vehicle cannot have been there; it is not let in unless the optimum says otherwise
    """

    name: float
    number: int
    believed: bool = True


@dataclass(frozen=True, slots=True)
class KeyframeMeasurement:
    """A measurement that belongs to a keyframe.

    Attributes
    ----------
    sensor : name of the log stream
    keyframe, segment : index of the keyframe, and the segment of time it lies in
    time, row : of the measurement, and its line in the log
    z : ndarray, shape (dim,)
    sd : ndarray, shape (dim,), the instrument's, or the measurement's own
    rate_b, rate_sd : ndarray, shape (3,), float: measured rate, bias still in it [rad/s]
    motion : Snapshot from the keyframe to the measurement
    bias : ndarray, shape (6,), that the motion was integrated with
    window : LateStampWindow of one stamp, where stamps may be late
    scale_to_bias : ndarray, shape (6, 6), of `rovgraph.engine.scale`, where the IMU's scale may be off
    landmark : of a place, where it is one
    """

    sensor: str
    keyframe: int
    segment: int
    time: float
    row: int
    z: Array
    sd: Array
    rate_b: Array
    rate_sd: float
    motion: Snapshot
    bias: Array
    window: LateStampWindow | None = None
    scale_to_bias: Array | None = None
    landmark: LandmarkObservation | None = None


@dataclass(frozen=True, slots=True)
class KeyframeInterval:
    """From the keyframe before to keyframe ``index``; the first has no motion.

    Attributes
    ----------
    index, time : of the keyframe that ends the interval
    segment : of time that this keyframe lies in, from 0 and by steps of 0 or 1: calibration
        variables that walk have one value in each
    rate_b, rate_sd : ndarray, shape (3,), float: measured rate at the keyframe, bias still
        in it, and its noise [rad/s]
    motion : from the keyframe before, None for the first
    measurements : at the keyframe itself, and between the keyframe before and it
    scale_to_bias : ndarray, shape (6, 6), of `rovgraph.engine.scale`, where the IMU's scale may be off
    """

    index: int
    time: float
    segment: int
    rate_b: Array
    rate_sd: float
    motion: Motion | None
    measurements: list[KeyframeMeasurement]
    scale_to_bias: Array | None = None

    @property
    def bridged(self) -> bool:
        """Whether samples of the IMU are missing."""
        return self.motion is not None and self.motion.gap_s > 0.0

    @property
    def between(self) -> list[KeyframeMeasurement]:
        """Measurements that belong to the keyframe before."""
        return [m for m in self.measurements if m.keyframe < self.index]

    @property
    def here(self) -> list[KeyframeMeasurement]:
        """Measurements at the keyframe that ends the interval."""
        return [m for m in self.measurements if m.keyframe == self.index]
