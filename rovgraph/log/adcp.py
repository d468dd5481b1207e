"""Profiles of the water: a table beside a log, which becomes its stream "adcp".

The table has a row for each cell of each profile: ``time`` [s], ``range`` [m] from the head along its axis to the
middle of the cell, and the velocity of the instrument relative to the water there, along its own axes (``vx``, ``vy``,
``vz``), along beams (``beam_1`` ...) or north, east and down, beside ``heading``, ``roll`` and ``pitch``
(docs/log-format.md). Other columns are ignored.
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from numpy.typing import ArrayLike

from rovgraph.errors import InputError, warn
from rovgraph.log.reading import delay_of, read_streams
from rovgraph.log.streams import Stream
from rovgraph.log.tables import Table, read_table, table_beside, table_of_arrays
from rovgraph.model.config import Config
from rovgraph.sensors.water_layer import ADCP, CELLS

PREFIX = "adcp_"  # of the columns in a log


def cells_of_table(table: Table, config: Config) -> Stream:
    """The stream of a table of profiles, by the columns, units and delays of a configuration.

    Raises
    ------
    InputError : no time, no ranges, no velocities, or cells that cannot be used

    Warns
    -----
    DataWarning : what was left out or sorted
    """
    columns = {name: short for name in ADCP.column_names if (short := name.removeprefix(PREFIX)) in table.names}
    columns |= {
        target: column
        for target, column in config.columns.items()
        if column in table.names and (target == "time" or target.startswith(PREFIX))
    }
    if "time" not in {*table.names, *columns}:
        raise InputError(f"{table.source}: no column time, expected seconds of the log's clock")
    if "adcp_range" not in columns:
        raise InputError(f"{table.source}: cells without ranges, expected column range, from the head to each cell [m]")
    names = {columns.get("time", "time"): "time"} | {short: name for name, short in columns.items() if name != "time"}
    frame = table.frame[[name for name in table.names if name in names]].rename(columns=names)  # as range is a sensor's
    own = config.as_recorded().model_copy(update={"columns": {}, "delay_s": {CELLS: delay_of(config, CELLS)}})
    streams, _ = read_streams([replace(table, frame=frame)], own, table.source)
    if CELLS not in streams:
        raise InputError(f"{table.source}: no cell has a number")
    return streams[CELLS]


def usable_cells(table: Path | Mapping[str, ArrayLike], config: Config, source: str = "") -> Stream | None:
    """`cells_of_table` of a file, or of column -> array_like, shape (n,); None where that cannot be used.

    Warns
    -----
    DataWarning : what is wrong with the table
    """
    try:
        read = read_table(table) if isinstance(table, Path) else table_of_arrays([table], "time", source)
        return cells_of_table(read, config)
    except InputError as error:
        warn(f"{error}; profiles of the water are left out")
        return None


def cells_beside(log: Path, config: Config) -> Stream | None:
    """The profiles that a file beside a log holds, ``log.adcp.csv``; None without a usable one.

    Warns
    -----
    DataWarning : what is wrong with the file
    """
    path = table_beside(log, CELLS)
    return usable_cells(path, config) if path.is_file() else None
