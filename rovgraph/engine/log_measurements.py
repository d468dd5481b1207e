"""What is measured in a long log, in columns: a `KeyframeMeasurement` is made when it is asked for.

Objects of all of them would take as much memory as the log.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.keyframes import KeyframeMeasurement, LandmarkObservation
from rovgraph.engine.late_stamp_window import LateStampWindow
from rovgraph.geometry import Array


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
    which, keyframe, line : ndarray of int, shape (m,), place among ``sensors``, and as of `KeyframeMeasurement`
    segment : ndarray of int, shape (n,), of each keyframe
    rows : ndarray, shape (m, ROW) or wider
    scales : ndarray, shape (m, 6, 6), or None where the IMU's scale is exact
    extras : place of a measurement -> what has no place in a row
    """

    sensors: Sequence[str]
    dims: Sequence[int]
    which: NDArray[np.int64]
    keyframe: NDArray[np.int64]
    line: NDArray[np.int64]
    segment: NDArray[np.int64]
    rows: Array
    scales: Array | None
    extras: Mapping[int, Extra]

    def __getitem__(self, place: int) -> KeyframeMeasurement:
        which, keyframe = self.which.item(place), self.keyframe.item(place)
        window, landmark = self.extras.get(place, _NOTHING)
        scale = None if self.scales is None else self.scales[place]
        where = keyframe, self.segment.item(keyframe), self.line.item(place), self.dims[which]
        return KeyframeMeasurement(self.sensors[which], *where, self.rows[place], window, scale, landmark)


class MeasurementsOfInterval(Sequence[KeyframeMeasurement]):
    """Measurements ``begin`` to before ``end`` of a table."""

    __slots__ = ("_begin", "_end", "_table")

    def __init__(self, table: MeasurementTable, begin: int, end: int) -> None:
        self._table, self._begin, self._end = table, begin, end

    def __len__(self) -> int:
        return self._end - self._begin

    def __iter__(self) -> Iterator[KeyframeMeasurement]:
        return map(self._table.__getitem__, range(self._begin, self._end))

    @overload
    def __getitem__(self, index: int) -> KeyframeMeasurement: ...
    @overload
    def __getitem__(self, index: slice) -> list[KeyframeMeasurement]: ...
    def __getitem__(self, index: int | slice) -> KeyframeMeasurement | list[KeyframeMeasurement]:
        places = range(self._begin, self._end)[index]
        return self._table[places] if isinstance(places, int) else [self._table[place] for place in places]
