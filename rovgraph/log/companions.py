"""Tables beside a log, which become streams of it: beams of a DVL, and profiles of the water.

``log.dvl_beams.csv`` has ``time`` [s] and, for every beam by the instrument's own number k from 0 to 8, ``valid_k`` (1
or 0), ``velocity_k`` [m/s], ``range_k`` or ``distance_k`` [m], ``sd_k`` [m/s]. One of these is enough. A log may hold
the same columns itself, named as ``dvl_beam_velocity_1``.

``log.adcp.csv`` has a row for each cell of each profile: ``time`` [s], ``range`` [m] from the head along its axis to
the middle of the cell, and the velocity of the instrument relative to the water there, along its own axes (``vx``,
``vy``, ``vz``), along beams (``beam_1`` ...) or north, east and down, beside ``heading``, ``roll`` and ``pitch``.

Other columns are ignored (docs/log-format.md).
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.errors import InputError, warn
from rovgraph.geometry import Array
from rovgraph.log.reading import delay_of, read_streams
from rovgraph.log.streams import Stream
from rovgraph.log.tables import Table, read_table, table_beside, table_of_arrays
from rovgraph.model.config import Config
from rovgraph.sensors.dvl_beam import BEAMS, NUMBERS, QUANTITIES
from rovgraph.sensors.water_layer import ADCP, CELLS

PREFIX = "dvl_beam_"  # of the columns of beams in a log
CELL_PREFIX = "adcp_"  # of those of cells
_COLUMN = re.compile(rf"({'|'.join(QUANTITIES)})_(0|[1-9][0-9]?)")
Arrays = Mapping[str, ArrayLike]


def beams_of_table(table: Table, config: Config) -> Stream:
    """The stream of a table of beams, by the columns, units and delays of a configuration.

    Raises
    ------
    InputError : no time, no beam, a beam of a number beyond 8, or cells that cannot be used

    Warns
    -----
    DataWarning : what was left out or sorted
    """
    columns: dict[str, str] = {}
    for name in table.names:
        if match := _COLUMN.fullmatch(name):
            if int(match[2]) not in NUMBERS:
                raise InputError(f"{table.source}: column {name}: beams are numbered 0 to {NUMBERS[-1]}")
            columns[PREFIX + name] = name
    columns = _with_stated(columns, table, config, PREFIX)
    if not columns.keys() - {"time"}:
        raise InputError(
            f"{table.source}: no column valid_1, velocity_1, range_1 or distance_1, expected those of each beam"
        )
    frame = table.frame[[name for name in table.names if name == "time" or name in columns.values()]]
    return _streams(replace(table, frame=frame), columns, config, BEAMS)[BEAMS]


def cells_of_table(table: Table, config: Config) -> Stream:
    """The stream of a table of profiles, by the columns, units and delays of a configuration.

    Raises
    ------
    InputError : no time, no ranges, no velocities, or cells that cannot be used

    Warns
    -----
    DataWarning : what was left out or sorted
    """
    columns = {name: short for name in ADCP.column_names if (short := name.removeprefix(CELL_PREFIX)) in table.names}
    columns = _with_stated(columns, table, config, CELL_PREFIX)
    if "adcp_range" not in columns:
        raise InputError(f"{table.source}: cells without ranges, expected column range, from the head to each cell [m]")
    names = {columns.get("time", "time"): "time"} | {short: name for name, short in columns.items() if name != "time"}
    frame = table.frame[[name for name in table.names if name in names]].rename(columns=names)  # as range is a sensor's
    streams = _streams(replace(table, frame=frame), {}, config, CELLS)
    if CELLS not in streams:
        raise InputError(f"{table.source}: no cell has a number")
    return streams[CELLS]


def _with_stated(columns: dict[str, str], table: Table, config: Config, prefix: str) -> dict[str, str]:
    """Columns by their names in a log, with those that a configuration states."""
    stated = {
        target: column
        for target, column in config.columns.items()
        if column in table.names and (target == "time" or target.startswith(prefix))
    }
    if "time" not in {*table.names, *columns, *stated}:
        raise InputError(f"{table.source}: no column time, expected seconds of the log's clock")
    return columns | stated


def _streams(table: Table, columns: dict[str, str], config: Config, sensor: str) -> dict[str, Stream]:
    own = config.as_recorded().model_copy(update={"columns": columns, "delay_s": {sensor: delay_of(config, sensor)}})
    return read_streams([table], own, table.source)[0]


def columns_beside(stream: Stream) -> dict[str, Array]:
    """A stream of beams or cells as the columns of its table, without those that are empty."""
    prefix = PREFIX if stream.sensor == BEAMS else CELL_PREFIX
    filled = {name.removeprefix(prefix): stream[name] for name in stream.columns if np.isfinite(stream[name]).any()}
    return {"time": stream.time, **filled}


def usable_beams(table: Path | Arrays, config: Config, source: str = "") -> Stream | None:
    """`beams_of_table` of a file, or of column -> array_like, shape (n,); None where that cannot be used.

    Parameters
    ----------
    source : name of arrays, for messages

    Warns
    -----
    DataWarning : what is wrong with the table
    """
    return _usable(beams_of_table, table, config, source, "the DVL's beams")


def usable_cells(table: Path | Arrays, config: Config, source: str = "") -> Stream | None:
    """The same with `cells_of_table`."""
    return _usable(cells_of_table, table, config, source, "profiles of the water")


def _usable(
    of_table: Callable[[Table, Config], Stream], table: Path | Arrays, config: Config, source: str, what: str
) -> Stream | None:
    try:
        return of_table(
            read_table(table) if isinstance(table, Path) else table_of_arrays([table], "time", source), config
        )
    except InputError as error:
        warn(f"{error}; {what} are left out")
        return None


def beams_beside(log: Path, config: Config) -> Stream | None:
    """The beams that a file beside a log holds, ``log.dvl_beams.csv``; None without a usable one.

    Warns
    -----
    DataWarning : what is wrong with the file
    """
    path = table_beside(log, BEAMS)
    return usable_beams(path, config) if path.is_file() else None


def cells_beside(log: Path, config: Config) -> Stream | None:
    """The same of profiles, ``log.adcp.csv``."""
    path = table_beside(log, CELLS)
    return usable_cells(path, config) if path.is_file() else None
