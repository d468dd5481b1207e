"""What a dive has recorded, from a file, a data frame or arrays."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from rovgraph.config import Config, config_or_defaults
from rovgraph.errors import InputError, collected_warnings
from rovgraph.log.reading import read_streams
from rovgraph.log.streams import STREAMS, Measurement, Stream, arrivals, in_precedence
from rovgraph.log.table import Table, read_table, table_of_arrays, table_of_frame


@dataclass(frozen=True)
class Log:
    """A dive as recorded.

    Attributes
    ----------
    source : file name, for messages
    streams : sensor -> Stream, for the sensors in the log
    origin : latitude and longitude [deg] of north = east = 0, or None
    config : its columns, units, delays and magnetometer calibration were used to read the log; None if the streams
        were made otherwise
    warnings : what was ignored or sorted on reading
    settings : what its files state of the vehicle, nested as in YAML; a configuration takes precedence
    notes : how it was converted from native files, a sentence each
    """

    source: str
    streams: Mapping[str, Stream]
    origin: tuple[float, float] | None = None
    config: Config | None = None
    warnings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @staticmethod
    def from_frame(frame: pd.DataFrame, config: Config | None = None, source: str = "log") -> "Log":
        """Make a log from a data frame, as `read_log` would from a file.

        Parameters
        ----------
        frame : columns of a log (docs/log-format.md), one row per event; the index is ignored
        config : for the frame's columns, units, delays and magnetometer's calibration
        source : name for messages

        Raises
        ------
        InputError : a frame that cannot be used; lines are counted as in a file, the first row is line 2

        Warns
        -----
        DataWarning : what was ignored or sorted
        """
        return _log(table_of_frame(frame, source), config)

    @staticmethod
    def from_arrays(*tables: Mapping[str, ArrayLike], config: Config | None = None, source: str = "log") -> "Log":
        """Make a log from arrays.

        Parameters
        ----------
        tables : column -> array_like, shape (n,), including ``time``; one table for each clock or rate
        config, source : of `from_frame`

        Raises
        ------
        InputError : arrays of different length, or as `from_frame`
        """
        time = "time" if config is None else config.columns.get("time", "time")
        return _log(table_of_arrays(tables, time, source), config)

    def __contains__(self, sensor: str) -> bool:
        return sensor in self.streams

    def __iter__(self) -> Iterator[str]:
        return iter(self.streams)

    def __len__(self) -> int:
        return len(self.streams)

    def __getitem__(self, sensor: str) -> Stream:
        return self.streams[sensor]

    @property
    def sensors(self) -> set[str]:
        """Names of its streams."""
        return set(self.streams)

    @property
    def start(self) -> float:
        """Time of the first measurement [s]."""
        return min(float(stream.time[0]) for stream in self.streams.values())

    def require_read_with(self, config: Config) -> None:
        """Check that the log was read with this configuration's columns, units, delays and magnetometer calibration.

        Raises
        ------
        InputError : it was read with another configuration
        """
        if self.config is None:
            return
        for key in ("columns", "units", "delay_s", "imu.mag", "environment.origin"):
            if _entry(self.config, key) != _entry(config, key):
                raise InputError(
                    f"{self.source}: was read with another value of {key} than the configuration has; "
                    "read it with this configuration"
                )

    def measurements(self) -> Iterator[Measurement]:
        """Yield all measurements in the order of time; at equal times the IMU comes first, then the DVL.

        So a ping makes its keyframe before simultaneous measurements are attached to it.
        """
        streams = in_precedence(self.streams.values())
        if not streams:
            return
        which, index, time = arrivals(streams)
        names, data, rows = [s.sensor for s in streams], [s.data for s in streams], [s.row.tolist() for s in streams]
        for t, k, i in zip(time.tolist(), which.tolist(), index.tolist(), strict=True):
            yield Measurement(t, names[k], data[k][i], rows[k][i])


def read_log(path: Path | str, config: Config | None = None) -> Log:
    """Read a log.

    Parameters
    ----------
    path : CSV, gzipped CSV or Parquet
    config : for the log's columns, units and delays, and the magnetometer's calibration: times are those of the
        measurements, and everything that takes the log sees the field

    Raises
    ------
    InputError : a file that cannot be used

    Warns
    -----
    DataWarning : what was ignored or sorted
    """
    with collected_warnings() as texts:
        table = read_table(path)
    return _log(table, config, texts)


def _log(table: Table, config: Config | None, before: Iterable[str] = ()) -> Log:
    """A log of a table, with what was warned of ``before`` and while its streams were made."""
    config = config_or_defaults(config)
    with collected_warnings() as texts:
        streams, origin = read_streams(table, config)
    return Log(table.source, streams, origin, config, (*before, *texts))


def _entry(config: Config, key: str) -> object:
    entry: object = config
    for name in key.split("."):
        entry = getattr(entry, name)
    return entry


def gathered(measurements: Iterable[Measurement], source: str, origin: tuple[float, float] | None = None) -> Log:
    """A log of measurements in the order of time: the inverse of `Log.measurements`."""
    rows: dict[str, list[Measurement]] = {}
    for m in measurements:
        rows.setdefault(m.sensor, []).append(m)
    streams = {}
    for sensor, own in rows.items():
        columns = STREAMS.get(sensor) or tuple(f"thruster_{k + 1}" for k in range(len(own[0][2])))
        time, line = np.array([m.time for m in own]), np.array([m.row for m in own], dtype=np.int64)
        streams[sensor] = Stream(sensor, columns, time, np.array([values for _, _, values, _ in own]), line)
    return Log(source, streams, origin)
