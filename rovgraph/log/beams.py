"""Single beams of a DVL: a table beside a log, which becomes its stream "dvl_beams".

The table has ``time`` [s] and, for every beam by the instrument's own number k from 0 to 8, ``valid_k`` (1 or 0),
``velocity_k`` [m/s], ``range_k`` or ``distance_k`` [m], ``sd_k`` [m/s]. One of these is enough; other columns are
ignored. A log may hold the same columns itself, named as ``dvl_beam_velocity_1``.
"""

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from rovgraph.errors import InputError, warn
from rovgraph.log.reading import delay_of, read_streams
from rovgraph.log.streams import Stream
from rovgraph.log.tables import Table, read_table, table_beside, table_of_arrays
from rovgraph.model.config import Config
from rovgraph.sensors.dvl_beam import BEAMS, NUMBERS, QUANTITIES

PREFIX = "dvl_beam_"  # of the columns in a log
_COLUMN = re.compile(rf"({'|'.join(QUANTITIES)})_(0|[1-9][0-9]?)")


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
    columns |= {
        target: column
        for target, column in config.columns.items()
        if column in table.names and (target == "time" or target.startswith(PREFIX))
    }
    if "time" not in {*table.names, *columns}:
        raise InputError(f"{table.source}: no column time, expected seconds of the log's clock")
    if not columns.keys() - {"time"}:
        raise InputError(
            f"{table.source}: no column valid_1, velocity_1, range_1 or distance_1, expected those of each beam"
        )
    frame = table.frame[[name for name in table.names if name == "time" or name in columns.values()]]
    own = config.as_recorded().model_copy(update={"columns": columns, "delay_s": {BEAMS: delay_of(config, BEAMS)}})
    streams, _ = read_streams([replace(table, frame=frame)], own, table.source)
    return streams[BEAMS]


def beams_frame(beams: Stream) -> pd.DataFrame:
    """The stream as the table is written, without the columns that are empty."""
    filled = {name: beams[name] for name in beams.columns if np.isfinite(beams[name]).any()}
    return pd.DataFrame({"time": beams.time, **{name.removeprefix(PREFIX): v for name, v in filled.items()}})


def usable_beams(table: Path | Mapping[str, ArrayLike], config: Config, source: str = "") -> Stream | None:
    """`beams_of_table` of a file, or of column -> array_like, shape (n,); None where that cannot be used.

    Parameters
    ----------
    source : name of arrays, for messages

    Warns
    -----
    DataWarning : what is wrong with the table
    """
    try:
        read = read_table(table) if isinstance(table, Path) else table_of_arrays([table], "time", source)
        return beams_of_table(read, config)
    except InputError as error:
        warn(f"{error}; the DVL's beams are left out")
        return None


def beams_beside(log: Path, config: Config) -> Stream | None:
    """The beams that a file beside a log holds, ``log.dvl_beams.csv``; None without a usable one.

    Warns
    -----
    DataWarning : what is wrong with the file
    """
    path = table_beside(log, BEAMS)
    return usable_beams(path, config) if path.is_file() else None
