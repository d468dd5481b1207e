"""A log: one sparse, wide CSV or Parquet file, read into one stream per sensor."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

STREAMS: dict[str, tuple[str, ...]] = {
    "imu": ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"),
    "mag": ("mag_x", "mag_y", "mag_z"),
    "ahrs": ("ahrs_yaw", "ahrs_roll", "ahrs_pitch"),
    "dvl": ("dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid", "dvl_sd"),
    "dvl_heading": ("dvl_heading",),
    "dvl_altitude": ("dvl_altitude",),
    "depth": ("depth",),
    "fix": ("fix_north", "fix_east", "fix_sd"),
}


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
    """

    sensor: str
    columns: tuple[str, ...]
    time: Array
    data: Array
    row: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, column: str) -> Array:
        return self.data[:, self.columns.index(column)]


@dataclass(frozen=True)
class Log:
    """A dive as recorded.

    Attributes
    ----------
    source : file name, for messages
    streams : sensor -> Stream, only those that the log has
    origin : latitude and longitude [deg] of north = east = 0, or None
    """

    source: str
    streams: Mapping[str, Stream]
    origin: tuple[float, float] | None = None

    def __contains__(self, sensor: str) -> bool:
        return sensor in self.streams

    def __getitem__(self, sensor: str) -> Stream:
        return self.streams[sensor]

    @property
    def sensors(self) -> set[str]:
        return set(self.streams)

    def measurements(self) -> Iterator[Measurement]:
        """All measurements in the order of time; at equal times the IMU comes first."""
        raise NotImplementedError


def read_log(path: Path | str, columns: Mapping[str, str] | None = None, units: Mapping[str, str] | None = None) -> Log:
    """Read a log."""
    raise NotImplementedError
