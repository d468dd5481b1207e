"""Streams: the measurements of one sensor of a log, in the order of time."""

import math
import re
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.model.calibration import BEAM_SENSORS, WATER_LAYER
from rovgraph.sensors import SENSORS


class _Streams(Mapping[str, tuple[str, ...]]):
    """The columns of every sensor that has fixed ones, as they are registered now."""

    def __getitem__(self, sensor: str) -> tuple[str, ...]:
        if not SENSORS[sensor].columns:
            raise KeyError(sensor)
        return SENSORS[sensor].column_names

    def __iter__(self) -> Iterator[str]:
        return (sensor.name for sensor in SENSORS.values() if sensor.columns)

    def __len__(self) -> int:
        return sum(1 for _ in self)


STREAMS: Mapping[str, tuple[str, ...]] = _Streams()  # sensor -> its columns
LAT_LON = ("fix_lat", "fix_lon")
SHIP_LAT_LON = ("ship_lat", "ship_lon")
OF_GRID = {LAT_LON: ("fix_northing", "fix_easting"), SHIP_LAT_LON: ("ship_northing", "ship_easting")}  # become these
RECEIVED = "received"  # time of arrival [s]; a log that has this column holds its rows in the order of arrival
VERSION_COLUMN = "rovgraph_log"  # version of the log's form; without this column it is 1
DATE = "date"  # day, or GPS week, of the times beside it
SPACING_S = 1e-4  # closer measurements of a sensor are of one time, and the first is taken: no sensor is that fast
GAP_PERIODS = 5.0  # of a sensor, its usual ones: a longer silence is a gap
THRUSTER = re.compile(r"thruster_[1-9]\d*")


def all_columns() -> tuple[str, ...]:
    """Columns that a log may have, but for thrusters."""
    return ("time", *(c for columns in STREAMS.values() for c in columns), *LAT_LON, *SHIP_LAT_LON)


def labels() -> set[str]:
    """Columns of names, not of quantities."""
    return {column.name for sensor in SENSORS.values() for column in sensor.columns if column.label}


def is_column(name: str) -> bool:
    """Whether a log may have a column of this name."""
    places = (*LAT_LON, *SHIP_LAT_LON, *OF_GRID[LAT_LON], *OF_GRID[SHIP_LAT_LON])
    others = name == "time" or name in places or THRUSTER.fullmatch(name) is not None
    return others or any(name in sensor.column_names for sensor in SENSORS.values())


def is_optional(name: str) -> bool:
    """Whether a measurement is complete without this column."""
    return any(c.optional for sensor in SENSORS.values() for c in sensor.columns if c.name == name)


def label_number(label: str) -> float:
    """The number that stands for a name: itself where it is a whole one, else one that its text always gives.

    >>> label_number("7"), label_number("7.0"), label_number("wreck") == label_number(" wreck")
    (7.0, 7.0, True)
    """
    text = label.strip()
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if number.is_integer() and abs(number) < 2.0**53:
        return number
    return float(zlib.crc32(text.encode()) + 2**32)  # beyond the numbers that people count with


class Measurement(NamedTuple):
    """One measurement as an estimator takes it.

    Attributes
    ----------
    time : [s]
    sensor : name of the stream
    values : ndarray, shape (k,), the columns of the stream in `STREAMS`' order
    row : line of the file it came from, 1 = header
    """

    time: float
    sensor: str
    values: Array
    row: int


@dataclass(frozen=True)
class Stream:
    """All measurements of one sensor.

    Attributes
    ----------
    sensor : key of `STREAMS`, or "thruster"
    columns : names, k of them
    time : ndarray, shape (n,) [s], increasing
    data : ndarray, shape (n, k); optional columns that are missing are NaN (dvl_valid: 1)
    row : ndarray of int, shape (n,), lines of the file, 1 = header
    same_time : others that were left out, as they are of the time of one that is kept
    """

    sensor: str
    columns: tuple[str, ...]
    time: Array
    data: Array
    row: NDArray[np.int64]
    same_time: int = 0

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, column: str) -> Array:
        return self.data[:, self.columns.index(column)]

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "Stream":
        """Some of its measurements, by index or by mask."""
        return replace(self, time=self.time[index], data=self.data[index], row=self.row[index])

    def between(self, begin: float, end: float) -> "Stream":
        """Its measurements between two times, these included [s]."""
        return self.take((self.time >= begin) & (self.time <= end))


def integral(time: Array, values: Array, longest: float = np.inf) -> Array:
    """Trapezoidal integral of values over their times from the first on, all shape (n,); gaps count as ``longest``."""
    steps = 0.5 * (values[1:] + values[:-1]) * np.minimum(np.diff(time), longest)
    return np.concatenate([[0.0], np.cumsum(steps)])


def joined(parts: Sequence[Stream]) -> Stream:
    """One stream of some of one sensor, at least one, in the order of time."""
    time, data, row = (np.concatenate([getattr(part, name) for part in parts]) for name in ("time", "data", "row"))
    return replace(parts[0], time=time, data=data, row=row).take(np.argsort(time, kind="stable"))


def in_precedence(streams: Iterable[Stream]) -> list[Stream]:
    """Streams in the order of their measurements of one time."""
    return sorted(streams, key=lambda s: precedence(s.sensor))


def arrivals(streams: Sequence[Stream]) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """The measurements of some streams, at least one, in the order of time; of equal times in that of streams.

    Returns
    -------
    which, index : ndarray of int, shape (n,), the stream of each, and its place in it
    time : ndarray, shape (n,) [s]
    """
    time = np.concatenate([s.time for s in streams])
    which = np.repeat(np.arange(len(streams)), [len(s) for s in streams])
    index = np.concatenate([np.arange(len(s)) for s in streams])
    order = np.argsort(time, kind="stable")
    return which[order], index[order], time[order]


def precedence(sensor: str) -> int:
    """Place among measurements of one time."""
    return {"imu": 0, "dvl": 1}.get(sensor, 1 if sensor in (*BEAM_SENSORS, WATER_LAYER) else 2)
