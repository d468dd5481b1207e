"""A dive as arrays: n keyframes, the motions between them, and what was measured at them and after them.

Every solver takes it: chain, GTSAM's graph, iSAM2 and the filter. So do statistics and alarms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, rotate
from rovgraph.kernels import assembly as at
from rovgraph.kernels import measurement_row as measured
from rovgraph.kernels import motion_row
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.measurement_row import MeasuredRows
from rovgraph.kernels.motion import LONGEST_BRIDGED_S
from rovgraph.kernels.motion_residual import motion_residuals
from rovgraph.kernels.preintegration import integrated_steps
from rovgraph.kernels.states import States
from rovgraph.model.state import State
from rovgraph.problem.motion import SCALES

Index = NDArray[np.int64]


@dataclass(frozen=True)
class Problem:
    """A dive of n keyframes with m measurements, those of an interval in the order of time, what is at its end last.

    Attributes
    ----------
    sensors, dims : names of those in use, and how many components each measures
    keyframes : ndarray, shape (n, KEYFRAME), of `rovgraph.kernels.assembly`
    motions : ndarray, shape (n - 1, ROW), of `rovgraph.kernels.motion_row`
    covariances : ndarray, shape (n - 1, 15, 15), of their residuals, or (0, 15, 15) where no filter needs them any more
    weights : ndarray, shape (n - 1, 15, 15), their square-root information, of
        `rovgraph.kernels.motion_residual.motion_weights`
    scales : ndarray, shape (n - 1, 6, 6), bias by the IMU's scales, or (0, 6, 6) where these are exact
    rows : ndarray, shape (m, ROW) or wider, of `rovgraph.kernels.measurement_row`
    row_scales : ndarray, shape (m, 6, 6) or (0, 6, 6), as ``scales``
    of : ndarray of int, shape (OF, m), what each measurement is of
    windows : ndarray, shape (w, K, KNOT), motion around stamps that may be late
    names : ndarray, shape (m,), of places that are seen
    lags : sensor whose stamps may be late -> time offsets at the knots of its windows [s]
    bias : ndarray, shape (6,), that motions are integrated with
    imu, forgotten : ndarray, shape (k, 7), samples in body axes, and how many there were before them
    doubted : measurements of places where the vehicle cannot have been, by their index
    context : numbers of a measurement's context at the end of ``rows``, 0 where no sensor has one
    """

    sensors: tuple[str, ...]
    dims: tuple[int, ...]
    keyframes: Array
    motions: Array
    covariances: Array
    weights: Array
    scales: Array
    rows: Array
    row_scales: Array
    of: Index
    windows: Array
    names: Array
    lags: Mapping[str, Array]
    bias: Array
    imu: Array
    forgotten: int
    doubted: frozenset[int] = frozenset()
    context: int = 0

    def __len__(self) -> int:
        """Count of keyframes."""
        return len(self.keyframes)

    # keyframes

    @property
    def time(self) -> Array:
        """Of the keyframes, shape (n,) [s]."""
        return self.keyframes[:, at.TIME]

    @property
    def segment(self) -> Index:
        """Of time that each lies in, from 0 and by steps of 0 or 1: what walks has one value in each for iSAM2."""
        return self.keyframes[:, at.SEGMENT].astype(np.int64)

    @property
    def rate_b(self) -> Array:
        """Measured rate at each, bias still in it, shape (n, 3) [rad/s]."""
        return self.keyframes[:, at.RATE_B : at.RATE_B + 3]

    @property
    def rate_sd(self) -> Array:
        """Its noise, shape (n,) [rad/s]."""
        return self.keyframes[:, at.SPREAD]

    @property
    def gap_s(self) -> Array:
        """How long the IMU was silent in the interval to each, or 0, shape (n,) [s]."""
        return np.append(0.0, self.motions[:, motion_row.GAP])

    @property
    def bridged(self) -> NDArray[np.bool_]:
        """Whether samples of the IMU are missing in the interval to each, shape (n,)."""
        return self.gap_s > 0.0

    @property
    def coasted(self) -> NDArray[np.bool_]:
        """Whether it was silent for so long that its interpolated signals count for little, shape (n,)."""
        return self.gap_s > LONGEST_BRIDGED_S

    def steps(self, k: int) -> Array:
        """What the motion to keyframe k was integrated from, shape (s, 8), of `rovgraph.kernels.preintegration`."""
        of_interval = slice(int(self.taken[k - 1]), int(self.taken[k]))
        stops = self.rows[of_interval, measured.TIME][self.keyframe[of_interval] < k]
        first, last = (self.keyframes[k, [at.FIRST, at.LAST]].astype(int) - self.forgotten).tolist()
        return integrated_steps(
            self.imu[first:last], self.time[k - 1], stops, self.time[k], np.ascontiguousarray(self.bias)
        )

    # measurements

    @property
    def which(self) -> Index:
        """The sensor of each, of `sensors`, shape (m,)."""
        return np.asarray(self.of[at.WHICH])

    @property
    def keyframe(self) -> Index:
        """The keyframe that each belongs to, shape (m,)."""
        return np.asarray(self.of[at.KEYFRAME_OF])

    @property
    def interval(self) -> Index:
        """The keyframe at the end of the interval that each lies in, shape (m,)."""
        return np.asarray(self.of[at.INTERVAL_OF])

    @property
    def line(self) -> Index:
        """Of each in the log, shape (m,)."""
        return np.asarray(self.of[at.LINE_OF])

    @property
    def window(self) -> Index:
        """Of each whose stamp may be late, else -1, shape (m,)."""
        return np.asarray(self.of[at.WINDOW_OF])

    @property
    def number(self) -> Index:
        """Of the place that is seen, that of its first sighting to begin with, else -1, shape (m,)."""
        return np.asarray(self.of[at.NUMBER_OF])

    @property
    def believed(self) -> NDArray[np.bool_]:
        """False = the vehicle cannot have been there, shape (m,)."""
        out = np.full(len(self.rows), True)
        out[list(self.doubted)] = False
        return out

    def measured_in(self, k: int) -> tuple[int, int]:
        """The first measurement of the interval that ends with keyframe k, and the one after its last."""
        return int(self.keyframes[k - 1, at.TAKEN]) if k else 0, int(self.keyframes[k, at.TAKEN])

    def z(self, index: Index, dim: int) -> Array:
        """Components of measurements that have so many, shape (k, dim)."""
        return self.rows[index, measured.Z : measured.Z + dim]

    def sd(self, index: Index, dim: int) -> Array:
        """Their sds, shape (k, dim)."""
        return self.rows[index, sd_of(dim) : sd_of(dim) + dim]

    def noise(self, index: Index, dim: int) -> Array:
        """Their sds, of fewer than three also their covariance, shape (k, dim or 3)."""
        return self.rows[index, sd_of(dim) : sd_of(dim) + max(dim, measured.MOST)]

    def contexts(self, index: "slice | Index") -> Array:
        """What was known of the other end of measurements, shape (k, context)."""
        return self.rows[index, self.rows.shape[1] - self.context :]

    @cached_property
    def taken(self) -> Index:
        """Measurements up to the end of each interval, shape (n,)."""
        return self.keyframes[:, at.TAKEN].astype(np.int64)

    @cached_property
    def first(self) -> Index:
        """The first measurement of each keyframe, shape (n + 1,)."""
        return np.asarray(self.keyframe.searchsorted(np.arange(len(self) + 1)))

    def measured(self, some: "slice | Index" = slice(None)) -> MeasuredRows:
        """Measurements as kernels take them."""
        rows, which, window = self.rows[some], self.which[some], self.window[some]
        if rows.shape[1] > measured.ROW + self.context:  # of sensors with more components than a kernel takes
            rows = np.hstack([rows[:, : measured.ROW], self.contexts(some)])
        scales = self.row_scales[some] if len(self.row_scales) else self.row_scales
        contiguous = np.ascontiguousarray
        return MeasuredRows(contiguous(rows), contiguous(which), scales, contiguous(window), self.windows)

    @property
    def used(self) -> list[str]:
        """Sensors that have measured something, in the order in which they began to."""
        which, first = np.unique(self.which, return_index=True)
        return [self.sensors[k] for k in which[np.argsort(first)].tolist()]

    def of_sensor(self, sensor: str | None) -> Index:
        """Places of a sensor's measurements."""
        return np.flatnonzero(self.which == (self.sensors.index(sensor) if sensor in self.sensors else -1))

    # parts

    def upto(self, count: int) -> "Problem":
        """The first keyframes."""
        return self.part(0, count, 0, int(self.taken[count - 1]))

    def part(self, first: int, last: int, begin: int, end: int) -> "Problem":
        """Keyframes ``first`` to before ``last`` by themselves, with measurements ``begin`` to before ``end``."""
        keyframes, of = self.keyframes[first:last], self.of[:, begin:end]
        if first or begin:
            keyframes, of = keyframes.copy(), of.copy()
            keyframes[:, at.TAKEN] = np.clip(keyframes[:, at.TAKEN] - begin, 0, end - begin)
            of[[at.KEYFRAME_OF, at.INTERVAL_OF]] -= first
        scales, row_scales = self.scales[first : last - 1], self.row_scales[begin:end]
        more = replace(self, keyframes=keyframes, of=of, scales=scales, row_scales=row_scales)
        motions, covariances, weights = (a[first : last - 1] for a in (self.motions, self.covariances, self.weights))
        rows, names = self.rows[begin:end], self.names[begin:end]
        doubted = frozenset(row - begin for row in self.doubted if begin <= row < end)
        more = replace(more, motions=motions, covariances=covariances, weights=weights, doubted=doubted)
        return replace(more, rows=rows, names=names)

    def without(self, sensor: str) -> "Problem":
        """The same without what a sensor has measured."""
        kept = np.delete(np.arange(len(self.rows)), self.of_sensor(sensor))
        keyframes, scaled = self.keyframes.copy(), len(self.row_scales) > 0
        keyframes[:, at.TAKEN] = kept.searchsorted(self.taken)
        row_scales = self.row_scales[kept] if scaled else self.row_scales
        of, names = np.ascontiguousarray(self.of[:, kept]), self.names[kept]
        more = replace(self, keyframes=keyframes, row_scales=row_scales, doubted=frozenset())
        return replace(more, rows=self.rows[kept], of=of, names=names)

    def sighting(self, numbers: Index, doubted: Index) -> "Problem":
        """The same with other numbers of the places that are seen, and some sightings that are not believed."""
        of = self.of.copy()
        of[at.NUMBER_OF, of[at.NUMBER_OF] >= 0] = numbers
        return replace(self, of=of, doubted=frozenset(doubted.tolist()))

    def without_covariances(self) -> "Problem":
        """The same without the covariances of the motions, for a smoother, which has ``weights`` instead."""
        return replace(self, covariances=np.empty((0, MOTION, MOTION)))

    # equations

    def motion_residuals(self, state: State) -> Array:
        """Whitened residuals of the motions, shape (n - 1, 15), at a state of all keyframes.

        Columns 9 to 14 are the changes of the biases, those before rotation, position and velocity given these
        changes.
        """
        shift, r = np.empty((0, 6)), np.empty((len(self.motions), MOTION))
        if len(self.scales):
            k = [np.broadcast_to(np.atleast_2d(state.calibration[s]), (len(self), 3))[1:] for s in SCALES]
            shift = rotate(self.scales, np.concatenate(k, axis=1))
        states = States(*map(np.ascontiguousarray, (state.R_nb, state.p_n, state.v_n, state.bias)))
        motion_residuals(self.motions, self.weights, states, shift, r)
        return r


def gathered(measurements: Sequence[tuple[Problem, int]]) -> Problem:
    """Measurements of one dive, at least one, from problems of it as it grew; without keyframes."""
    last, rows = measurements[-1][0], np.array([problem.rows[k] for problem, k in measurements])
    of, scaled = np.column_stack([problem.of[:, k] for problem, k in measurements]), len(last.row_scales) > 0
    late = of[at.WINDOW_OF] >= 0
    knots = [problem.windows[problem.window[k]] for problem, k in measurements if problem.window[k] >= 0]
    of[at.WINDOW_OF, late] = np.arange(np.count_nonzero(late))
    row_scales = np.array([problem.row_scales[k] for problem, k in measurements]) if scaled else last.row_scales
    more = replace(last, rows=rows, of=of, row_scales=row_scales, keyframes=last.keyframes[:0])
    names = np.array([problem.names[k] for problem, k in measurements])
    return replace(more, names=names, windows=np.array(knots) if knots else last.windows[:0])


def sd_of(dim: int) -> int:
    """Where in a row the noise of ``dim`` components begins."""
    return measured.Z + max(dim, measured.MOST)


def in_body(values: Array, R_sb: Array) -> Array:
    """Specific force and rate, shape (..., 6), from the IMU's axes to the body's."""
    # sample by sample, so that one alone comes out as it does among many
    return (values.reshape(-1, 2, 3) @ R_sb).reshape(values.shape)
