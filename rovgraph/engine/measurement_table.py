"""Measurements of a dive in columns: a `KeyframeMeasurement` of one of them is made when it is asked for.

Objects of all of them would take as much memory as the log, and as much time as an iteration of the smoother.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement, LandmarkObservation, sd_of
from rovgraph.engine.late_stamp_window import LateStampWindow
from rovgraph.geometry import Array
from rovgraph.kernels import measurement_row as at

Index = NDArray[np.int64]


class Extra(NamedTuple):
    """Of a measurement, as of `KeyframeMeasurement`."""

    window: LateStampWindow | None
    landmark: LandmarkObservation | None


_NOTHING = Extra(None, None)


@dataclass(frozen=True)
class MeasurementTable:
    """m measurements in the order of their intervals.

    Attributes
    ----------
    sensors, dims : names of log streams, and how many components each has
    which, keyframe, segment, line : ndarray of int, shape (m,), place among ``sensors``, and as of
        `KeyframeMeasurement`
    rows : ndarray, shape (m, ROW) or wider
    scales : ndarray, shape (m, 6, 6), or None where the IMU's scale is exact
    extras : place of a measurement -> what has no place in a row
    """

    sensors: Sequence[str]
    dims: Sequence[int]
    which: Index
    keyframe: Index
    segment: Index
    line: Index
    rows: Array
    scales: Array | None
    extras: Mapping[int, Extra]

    @staticmethod
    def of(measurements: Sequence[KeyframeMeasurement]) -> "MeasurementTable":
        """Of measurements by themselves."""
        dims = {m.sensor: m.dim for m in measurements}
        number = {sensor: k for k, sensor in enumerate(dims)}
        rows = np.zeros((len(measurements), max((len(m.row) for m in measurements), default=at.ROW)))
        for k, m in enumerate(measurements):
            rows[k, : len(m.row)] = m.row
        where = [(number[m.sensor], m.keyframe, m.segment, m.line) for m in measurements]
        which, keyframe, segment, line = np.array(where, np.int64).reshape(-1, 4).T
        scaled = len(measurements) > 0 and measurements[0].scale_to_bias is not None
        scales = np.array([m.scale_to_bias for m in measurements]) if scaled else None
        more = ((k, Extra(m.window, m.landmark)) for k, m in enumerate(measurements))
        extras = {k: extra for k, extra in more if extra != _NOTHING}
        names, sizes = [*dims], [*dims.values()]
        return MeasurementTable(names, sizes, which, keyframe, segment, line, rows, scales, extras)

    @staticmethod
    def of_dive(intervals: Sequence[KeyframeInterval]) -> "MeasurementTable":
        """Of all that was measured in some intervals; they may be those of a log, whose columns are at hand."""
        parts = [interval.measurements for interval in intervals]
        whole = _in_a_row(parts)
        return MeasurementTable.of([m for part in parts for m in part]) if whole is None else whole

    def __len__(self) -> int:
        return len(self.which)

    def __getitem__(self, place: int) -> KeyframeMeasurement:
        which = self.which.item(place)
        window, landmark = self.extras.get(place, _NOTHING)
        scale = None if self.scales is None else self.scales[place]
        where = self.keyframe.item(place), self.segment.item(place), self.line.item(place), self.dims[which]
        return KeyframeMeasurement(self.sensors[which], *where, self.rows[place], window, scale, landmark)

    @property
    def time(self) -> Array:
        """Shape (m,) [s]."""
        return self.rows[:, at.TIME]

    @property
    def used(self) -> list[str]:
        """Sensors that have measured something, in the order in which they began to."""
        which, first = np.unique(self.which, return_index=True)
        return [self.sensors[k] for k in which[np.argsort(first)].tolist()]

    def z(self, dim: int) -> Array:
        """Components of measurements that have so many, shape (m, dim)."""
        return self.rows[:, at.Z : at.Z + dim]

    def sd(self, dim: int) -> Array:
        """Their noise, shape (m, dim)."""
        begin = sd_of(dim)
        return self.rows[:, begin : begin + dim]

    @property
    def rate_b(self) -> Array:
        """Measured rate, bias still in it, shape (m, 3) [rad/s]."""
        return self.rows[:, at.RATE : at.RATE + 3]

    @property
    def rate_sd(self) -> Array:
        """Its noise, shape (m,) [rad/s]."""
        return self.rows[:, at.RATE_SD]

    def places_of(self, sensor: str | None) -> Index:
        """Where the measurements of one sensor stand."""
        return np.flatnonzero(self.which == (self.sensors.index(sensor) if sensor in self.sensors else -1))

    def of_sensor(self, sensor: str) -> "MeasurementTable":
        """What one sensor measured."""
        return self.at(self.places_of(sensor))

    def at(self, places: Index | slice) -> "MeasurementTable":
        """Some of the measurements, in order."""
        extras: Mapping[int, Extra] = self.extras
        if extras:
            kept = np.arange(len(self))[places].tolist()
            extras = {k: extras[place] for k, place in enumerate(kept) if place in extras}
        return MeasurementTable(
            self.sensors,
            self.dims,
            self.which[places],
            self.keyframe[places],
            self.segment[places],
            self.line[places],
            self.rows[places],
            None if self.scales is None else self.scales[places],
            extras,
        )


class MeasurementsOfInterval(Sequence[KeyframeMeasurement]):
    """Measurements ``begin`` to before ``end`` of a table."""

    __slots__ = ("begin", "end", "table")

    def __init__(self, table: MeasurementTable, begin: int, end: int) -> None:
        self.table, self.begin, self.end = table, begin, end

    def __len__(self) -> int:
        return self.end - self.begin

    def __iter__(self) -> Iterator[KeyframeMeasurement]:
        return map(self.table.__getitem__, range(self.begin, self.end))

    @overload
    def __getitem__(self, index: int) -> KeyframeMeasurement: ...
    @overload
    def __getitem__(self, index: slice) -> list[KeyframeMeasurement]: ...
    def __getitem__(self, index: int | slice) -> KeyframeMeasurement | list[KeyframeMeasurement]:
        places = range(self.begin, self.end)[index]
        return self.table[places] if isinstance(places, int) else [self.table[place] for place in places]


def _in_a_row(parts: Sequence[Sequence[KeyframeMeasurement]]) -> MeasurementTable | None:
    """The part of a table that some intervals are, one after the other; None = they are not."""
    if not parts or not isinstance(parts[0], MeasurementsOfInterval):
        return None
    table, begin, end = parts[0].table, parts[0].begin, parts[0].begin
    for part in parts:
        if not isinstance(part, MeasurementsOfInterval) or part.table is not table or part.begin != end:
            return None
        end = part.end
    return table.at(slice(begin, end))
