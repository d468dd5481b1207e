"""A dive's motions and measurements as arrays that kernels take, for smoother and filter alike."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.measurement_table import MeasurementTable
from rovgraph.engine.scale import SCALES
from rovgraph.geometry import Array, rotate
from rovgraph.kernels import measurement_row as measured
from rovgraph.kernels import motion_row
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.motion_residual import motion_residuals, motion_weights
from rovgraph.state import State

Index = NDArray[np.int64]


@dataclass(frozen=True)
class DiveRows:
    """n keyframes with m measurements, in the order of the intervals, which is that of their keyframes.

    Attributes
    ----------
    motions, weights : ndarray, shapes (n - 1, ROW), (n - 1, 15, 15), of `rovgraph.kernels.motion_row`, and their
        square-root information, of `rovgraph.kernels.motion_residual.motion_weights`
    scales : ndarray, shape (n - 1, 6, 6), bias by the IMU's scales, or (0, 6, 6) where these are exact
    rows : ndarray, shape (m, ROW), of `rovgraph.kernels.measurement_row`
    which : ndarray of int, shape (m,), the sensor of each, of ``sensors``
    row_scales : ndarray, shape (m, 6, 6) or (0, 6, 6), as ``scales``
    first : ndarray of int, shape (n + 1,), the first measurement of each keyframe
    taken : ndarray of int, shape (n,), measurements up to the end of each interval
    time : ndarray, shape (n,), of the keyframes [s]
    sensors : names
    """

    motions: Array
    weights: Array
    scales: Array
    rows: Array
    which: Index
    row_scales: Array
    first: Index
    taken: Index
    time: Array
    sensors: tuple[str, ...]

    @staticmethod
    def of(intervals: Sequence[KeyframeInterval], sensors: Sequence[str]) -> "DiveRows":
        """Of the intervals of a dive, from its first; ``sensors`` are those in use.

        The motions' rows become views of ``motions``: of a long dive they are kept once.
        """
        n, index = len(intervals), {sensor: k for k, sensor in enumerate(sensors)}
        motions = np.zeros((max(n - 1, 0), motion_row.ROW))
        for k, interval in enumerate(intervals[1:]):
            assert interval.motion is not None
            motions[k] = interval.motion.row
            object.__setattr__(interval.motion, "row", motions[k])
        scaled = n > 1 and intervals[1].scale_to_bias is not None
        scales = np.array([i.scale_to_bias for i in intervals[1:]]) if scaled else np.zeros((0, 6, 6))
        found = MeasurementTable.of_dive(intervals)
        row_scales = np.zeros((0, 6, 6)) if found.scales is None else found.scales
        number = np.array([index.get(sensor, -1) for sensor in found.sensors], dtype=np.int64)
        which = number[found.which]
        assert (which >= 0).all(), "a sensor that is not in use has measured something"
        ends = np.repeat(np.arange(n), [len(i.measurements) for i in intervals])
        time = np.array([i.time for i in intervals])
        own = found.rows, which, row_scales, found.keyframe
        return DiveRows.from_arrays(motions, scales, *own, ends, time, tuple(sensors))

    @staticmethod
    def from_arrays(
        motions: Array,
        scales: Array,
        rows: Array,
        which: Index,
        row_scales: Array,
        keyframe: Index,
        interval: Index,
        time: Array,
        sensors: tuple[str, ...],
    ) -> "DiveRows":
        """Of arrays as they stand here; ``keyframe`` and ``interval``, shape (m,), are those of each measurement.

        Rows may be wider, as those of measurements that no kernel takes.
        """
        n, weights = len(time), np.empty((len(motions), MOTION, MOTION))
        motion_weights(motions, weights)
        first, taken = keyframe.searchsorted(np.arange(n + 1)), interval.searchsorted(np.arange(1, n + 1))
        rows = np.ascontiguousarray(rows[:, : measured.ROW])
        return DiveRows(motions, weights, scales, rows, which, row_scales, first, taken, time, sensors)

    def without_covariances(self, intervals: Sequence[KeyframeInterval]) -> "DiveRows":
        """The same without the covariances of the motions, for a smoother, which has ``weights`` instead.

        The motions of ``intervals``, whose arrays these are, lose theirs as well.
        """
        motions = self.motions[:, : motion_row.COVARIANCE].copy()
        for interval, row in zip(intervals[1:], motions, strict=True):
            object.__setattr__(interval.motion, "row", row)
        return replace(self, motions=motions)

    def __len__(self) -> int:
        return len(self.taken)

    @property
    def used(self) -> list[str]:
        """Sensors that have measured something."""
        return [self.sensors[k] for k in np.unique(self.which)]

    def upto(self, count: int) -> "DiveRows":
        """The first intervals."""
        m = int(self.taken[count - 1])
        return DiveRows(
            self.motions[: count - 1],
            self.weights[: count - 1],
            self.scales[: count - 1],
            self.rows[:m],
            self.which[:m],
            self.row_scales[:m],
            np.minimum(self.first[: count + 1], m),
            self.taken[:count],
            self.time[:count],
            self.sensors,
        )

    def between(self, begin: int, end: int) -> "DiveRows":
        """Some intervals, the first beyond 0; ``taken`` and ``first`` count from their first measurement."""
        before, after = int(self.taken[begin - 1]), int(self.taken[end - 1])
        return DiveRows(
            self.motions[begin - 1 : end - 1],
            self.weights[begin - 1 : end - 1],
            self.scales[begin - 1 : end - 1],
            self.rows[before:after],
            self.which[before:after],
            self.row_scales[before:after],
            self.first[begin : end + 1] - before,
            self.taken[begin:end] - before,
            self.time[begin:end],
            self.sensors,
        )

    def motion_residuals(self, state: State) -> Array:
        """Whitened residuals of the motions, shape (n - 1, 15), at a state of all keyframes.

        Columns 9 to 14 are the changes of the biases, those before rotation, position and velocity beyond what the
        former tell of the latter.
        """
        shift, r = np.empty((0, 6)), np.empty((len(self.motions), MOTION))
        if len(self.scales):
            k = [np.broadcast_to(np.atleast_2d(state.calibration[s]), (len(self), 3))[1:] for s in SCALES]
            shift = rotate(self.scales, np.concatenate(k, axis=1))
        R, p, v, b = (np.ascontiguousarray(a) for a in (state.R_nb, state.p_n, state.v_n, state.bias))
        motion_residuals(self.motions, self.weights, R, p, v, b, shift, r)
        return r

    def of_sensor(self, sensor: str) -> Index:
        """Places of a sensor's measurements."""
        return np.flatnonzero(self.which == self.sensors.index(sensor)) if sensor in self.sensors else np.empty(0, int)
