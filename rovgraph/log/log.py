"""`Log`: the recording of a dive, from a file, a data frame or arrays."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from rovgraph.errors import InputError, collected_warnings, warn
from rovgraph.log.companions import beams_beside, cells_beside
from rovgraph.log.reading import read_streams, with_sound_speed
from rovgraph.log.rows import Rows, tables_of
from rovgraph.log.streams import STREAMS, Measurement, Stream, arrivals, in_precedence
from rovgraph.log.tables import Table, read_table, table_of_arrays, table_of_frame, tables_of_keywords
from rovgraph.model.config import Config, config_or_defaults
from rovgraph.model.origin import Origin, frame_of


@dataclass(frozen=True, repr=False)
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
    origin: Origin | None = None
    config: Config | None = None
    warnings: tuple[str, ...] = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    @staticmethod
    def from_frame(
        frame: pd.DataFrame, config: Config | None = None, source: str = "log", as_received: bool = False
    ) -> "Log":
        """Make a log from a data frame, as `read_log` would from a file.

        Parameters
        ----------
        frame : columns of a log (docs/log-format.md), one row per event; the index is ignored
        config : for the frame's columns, units, delays and magnetometer's calibration
        source : name for messages
        as_received : a stream "pressure" stays, beside "depth", else it becomes "depth"; fixes of all beacons stay

        Raises
        ------
        InputError : a frame that cannot be used; lines are counted as in a file, the first row is line 2

        Warns
        -----
        DataWarning : what was ignored or sorted
        """
        return _log([table_of_frame(frame, source)], config, source, as_received=as_received)

    @staticmethod
    def from_arrays(
        *tables: Mapping[str, ArrayLike],
        config: Config | None = None,
        source: str = "log",
        **arrays: ArrayLike | tuple[ArrayLike, ArrayLike],
    ) -> "Log":
        """Make a log from arrays, by table or by name; NaN is no measurement.

        >>> import numpy as np
        >>> t, up = np.arange(0.0, 2.0, 0.01), np.array([0.0, 0.0, -9.81])
        >>> acc, gyr = np.tile(up, (200, 1)), np.zeros((200, 3))
        >>> Log.from_arrays(time=t, acc=acc, gyr=gyr, dvl=(t[::20], np.zeros((10, 3))), depth=(t[::10], np.ones(20)))
        <Log log: imu 200, dvl 10, depth 20; 0.0 to 2.0 s>

        Parameters
        ----------
        tables : column -> array_like, shape (n,), including ``time``; one table for each clock or rate. ``acc``,
            ``gyr``, ``mag``, ``dvl`` and ``dvl_water`` of shape (n, 3) stand for their three columns, ``ahrs`` for
            roll, pitch and yaw, ``fix`` of shape (n, 2) for north and east
        config, source : of `from_frame`
        arrays : the same by name: those of ``time``, and pairs (times, values) with times of their own

        Raises
        ------
        InputError : arrays of another shape, of different length or without times, or as `from_frame`
        """
        columns = {} if config is None else config.columns
        time = columns.get("time", "time")
        named = tables_of_keywords({time if n == "time" else n: a for n, a in arrays.items()}, time, source)
        return _log([table_of_arrays([*tables, *named], time, source, columns)], config, source)

    def to_frame(self) -> pd.DataFrame:
        """The log as a data frame, one row per measurement in the order of time: the inverse of `from_frame`.

        Columns and units are rovgraph's own (docs/log-format.md), times are those of the measurements: ``columns``,
        ``units``, ``delay_s``, ``imu.mag`` and ``dvl.sound_speed_set_mps`` of the configuration are applied already. So
        read it again with a configuration without them. Positions are north and east of `origin`.

        Returns
        -------
        DataFrame, ``time`` and the columns of the log's sensors; NaN where a row has no value
        """
        frames = []
        for stream in in_precedence(self.streams.values()):
            frame = pd.DataFrame(stream.data, columns=pd.Index(stream.columns)).dropna(axis="columns", how="all")
            frame.insert(0, "time", stream.time)
            frames.append(frame)
        return pd.concat(frames, ignore_index=True).sort_values("time", kind="stable", ignore_index=True)

    @staticmethod
    def from_rows(rows: Sequence[Rows], config: Config | None = None, source: str = "log") -> "Log":
        """Make a log from rows that fill few of its columns each, without a frame of mostly empty cells.

        Parameters
        ----------
        rows : of `rovgraph.log.rows.in_order`
        config, source : of `from_frame`

        Raises
        ------
        InputError : as `from_frame`
        """
        return _log(tables_of(rows, source), config, source)

    def __repr__(self) -> str:
        sensors = ", ".join(f"{name} {len(stream)}" for name, stream in self.streams.items())
        span = f"; {self.start:.1f} to {self.end:.1f} s" if self.streams else ""
        return f"<Log {self.source}: {sensors}{span}>"

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

    @property
    def end(self) -> float:
        """Time of the last measurement [s]."""
        return max(float(stream.time[-1]) for stream in self.streams.values())

    def with_beams(self, beams: Stream | None) -> "Log":
        """The log with what each beam of its DVL measured, beside its other streams.

        Parameters
        ----------
        beams : of `rovgraph.log.companions`, by the log's clock, as the DVL gave them; None = not known

        Warns
        -----
        DataWarning : beams of another time than the log's; they are left out
        """
        return self if beams is None else self._with(beams, "the DVL's beams")

    def with_profiles(self, cells: Stream | None) -> "Log":
        """The log with profiles of the water beside its other streams.

        Parameters
        ----------
        cells : of `rovgraph.log.companions`, by the log's clock; None = not known

        Warns
        -----
        DataWarning : profiles of another time than the log's; they are left out
        """
        return self if cells is None else self._with(cells, "profiles of the water")

    def _with(self, stream: Stream, what: str) -> "Log":
        """The log with a stream of a table beside it."""
        first, last = float(stream.time[0]), float(stream.time[-1])
        if first <= self.end and last >= self.start:
            as_measured = {stream.sensor: stream}
            corrected = with_sound_speed(as_measured, self.streams, config_or_defaults(self.config))
            return replace(self, streams={**self.streams, **as_measured, **corrected})
        with collected_warnings() as texts:
            warn(
                f"{self.source}: {what} have times from {first:.1f} to {last:.1f} s, the log from {self.start:.1f} to "
                f"{self.end:.1f} s; they are left out; convert the native files again"
            )
        return replace(self, warnings=(*self.warnings, *texts))

    def require_read_with(self, config: Config) -> None:
        """Check that the log was read with this configuration's columns, units, delays and magnetometer calibration.

        Raises
        ------
        InputError : it was read with another configuration
        """
        if self.config is None:
            return
        tables = "columns", "units", "angles", "times", "files", "delay_s", "imu.mag"
        keys = (*tables, "environment.origin", "environment.grid", "dvl.sound_speed_set_mps", "dvl.sound_speed_mps")
        other = [key for key in keys if _entry(self.config, key) != _entry(config, key)]
        frame = None if self.origin is None else frame_of(self.origin)
        if frame is not None and config.environment.frame not in (frame, "auto"):
            other.append("environment.frame")
        if other:
            raise InputError(
                f"{self.source}: was read with another value of {other[0]} than the configuration has; "
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


def read_log(path: Path | str, config: Config | None = None, as_received: bool = False) -> Log:
    """Read a log, and what lies beside it: each beam of its DVL in ``log.dvl_beams.csv``, profiles in ``log.adcp.csv``.

    Parameters
    ----------
    path : CSV, gzipped CSV or Parquet
    config : for the log's columns, units and delays, and the magnetometer's calibration: times are those of the
        measurements, and everything that takes the log sees the field
    as_received : of `Log.from_frame`

    Raises
    ------
    InputError : a file that cannot be used

    Warns
    -----
    DataWarning : what was ignored or sorted; beams that cannot be used, which are left out
    """
    with collected_warnings() as texts:
        table = read_table(path)
        beams = beams_beside(Path(path), config_or_defaults(config))
        cells = cells_beside(Path(path), config_or_defaults(config))
    log = _log([table], config, table.source, texts, as_received)
    return log.with_beams(beams).with_profiles(cells)


def _log(
    tables: Iterable[Table],
    config: Config | None,
    source: str,
    before: Iterable[str] = (),
    as_received: bool = False,
) -> Log:
    """A log of tables that share no stream, with what was warned of ``before`` and while its streams were made."""
    config = config_or_defaults(config)
    with collected_warnings() as texts:
        notes: list[str] = []
        streams, origin = read_streams(tables, config, source, notes, as_received)
    return Log(source, streams, origin, config, (*before, *texts), notes=tuple(notes))


def _entry(config: Config, key: str) -> object:
    entry: object = config
    for name in key.split("."):
        entry = getattr(entry, name)
    return entry


def gathered(measurements: Iterable[Measurement], source: str, origin: Origin | None = None) -> Log:
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
