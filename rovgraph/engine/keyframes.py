"""Keyframes: the interval that leads to each, and the measurements that belong to it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.engine.late_stamp_window import LateStampWindow
from rovgraph.engine.motion import Motion, Snapshot
from rovgraph.geometry import Array
from rovgraph.kernels import measurement_row as at


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


@dataclass(frozen=True, slots=True, eq=False)
class KeyframeMeasurement:
    """A measurement that belongs to a keyframe.

    Attributes
    ----------
    sensor : name of the log stream
    keyframe, segment : index of the keyframe, and the segment of time it lies in
    line : in the log
    dim : number of components
    row : ndarray, shape (ROW,) or longer, as `rovgraph.kernels.measurement_row` lays it out: what kernels take
    window : LateStampWindow of one stamp, where stamps may be late
    scale_to_bias : ndarray, shape (6, 6), of `rovgraph.engine.scale`, where the IMU's scale may be off
    landmark : of a place, where it is one
    """

    sensor: str
    keyframe: int
    segment: int
    line: int
    dim: int
    row: Array
    window: LateStampWindow | None = None
    scale_to_bias: Array | None = None
    landmark: LandmarkObservation | None = None

    @property
    def time(self) -> float:
        """[s]"""
        return float(self.row[at.TIME])

    @property
    def z(self) -> Array:
        """Components, shape (dim,)."""
        return self.row[at.Z : at.Z + self.dim]

    @property
    def sd(self) -> Array:
        """The instrument's, or the measurement's own, shape (dim,)."""
        begin = sd_of(self.dim)
        return self.row[begin : begin + self.dim]

    @property
    def rate_b(self) -> Array:
        """Measured rate, bias still in it, shape (3,) [rad/s]."""
        return self.row[at.RATE : at.RATE + 3]

    @property
    def rate_sd(self) -> float:
        """Its noise [rad/s]."""
        return float(self.row[at.RATE_SD])

    @property
    def motion(self) -> Snapshot:
        """From the keyframe to the measurement."""
        return Snapshot.of(self.row[at.SNAPSHOT : at.ASSUMED])

    @property
    def bias(self) -> Array:
        """That the motion was integrated with, shape (6,)."""
        return self.row[at.ASSUMED : at.ASSUMED + 6]


def measurement_rows(time: ArrayLike, snapshots: Array, bias: Array, dim: int) -> Array:
    """Rows of n measurements whose motion is known, shape (n, ROW) or wider, and nothing else of them yet.

    Parameters
    ----------
    time : shape (n,) [s]
    snapshots : ndarray, shape (n, 16), motion from their keyframe
    bias : ndarray, shape (6,), that it was integrated with
    dim : the largest number of components that any has
    """
    rows = np.zeros((len(snapshots), at.Z + 2 * max(dim, at.MOST)))
    rows[:, at.TIME], rows[:, at.SNAPSHOT : at.ASSUMED], rows[:, at.ASSUMED : at.Z] = time, snapshots, bias
    return rows


def sd_of(dim: int) -> int:
    """Where in a row the noise of ``dim`` components begins."""
    return at.Z + max(dim, at.MOST)


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
    measurements: Sequence[KeyframeMeasurement]
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
