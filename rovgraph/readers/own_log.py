"""rovgraph's own log (docs/log-format.md) as one of the formats, so that it can be read beside native files.

A log that is read alone does not come here: `rovgraph.log.read_log` reads it.
"""

import warnings as python_warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rovgraph.errors import InputError, collected_warnings
from rovgraph.geometry import Array
from rovgraph.log.companions import beams_beside, cells_beside, columns_beside
from rovgraph.log.reading import in_order, numbers, read_columns
from rovgraph.log.stamps import UNIX_S
from rovgraph.log.streams import LAT_LON, RECEIVED, STREAMS, THRUSTER, VERSION_COLUMN, is_column
from rovgraph.log.tables import names_of, read_table
from rovgraph.log.units import name_and_bracket
from rovgraph.model.config import Config, config_or_defaults
from rovgraph.readers.formats import ReadingOptions, formats, head_of, is_text, purpose, recognise, refusal
from rovgraph.readers.recording import Channel, Clock, Left, Recording

Paths = Path | str | Sequence[Path | str]  # of the files of one dive
NOTHING: Mapping[str, Any] = {}
SURE = 0.95
IN_RECEIVED = "host that received"


class OwnLog:
    """CSV or Parquet in rovgraph's columns, or in those that a configuration maps."""

    name = "log"
    title = "rovgraph log (CSV, Parquet)"
    extra = "parquet"

    def recognise(self, path: Path, head: bytes) -> float:
        """By the names of the columns; a Parquet file can be nothing else."""
        return SURE if is_own_log(head) else 0.0

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        """Every sensor of the log, its stamps one clock."""
        with collected_warnings() as texts, python_warnings.catch_warnings():
            python_warnings.simplefilter("ignore")  # the join repeats them with the name of the file
            table = read_table(path)
            cells, names = read_columns(table, options.table)
            beside = beams_beside(path, config_or_defaults(None)), cells_beside(path, config_or_defaults(None))
            if RECEIVED in table.names:
                cells[RECEIVED] = numbers(table, RECEIVED, RECEIVED)
            try:
                cells = cells if options.arrival else in_order(cells, table.line, table.source, RECEIVED in cells)[0]
            except InputError:
                if RECEIVED not in cells:  # by which each sensor's stamps are put right
                    raise
        channels = tuple(_channels(cells))
        if not channels:
            raise InputError(f"{path}: no measurement of any sensor in it; columns: {', '.join(table.names)[:200]}")
        clock = _clock(cells["time"])
        clocks = {clock.name: clock}
        if RECEIVED in cells:
            clocks[IN_RECEIVED] = Clock(IN_RECEIVED, 0.0, 0.0, "Unix time of arrival")
        ignored = [name for name in table.names if name not in (*names.values(), RECEIVED, VERSION_COLUMN)]
        left = tuple(Left(name, int(table.frame[name].notna().sum()), "no column of a log") for name in ignored)
        tables = {stream.sensor: columns_beside(stream) for stream in beside if stream is not None}
        return Recording(str(path), self.name, channels, clocks, left, warnings=tuple(texts), tables=tables)


FORMAT = OwnLog()


def is_own_log(head: bytes, columns: Mapping[str, str] | None = None) -> bool:
    """Whether a file that begins like this is a log: its header has a time and a sensor's column.

    Parameters
    ----------
    columns : rovgraph's name -> the log's own, of a configuration
    """
    if head.startswith(b"PAR1"):
        return True
    mapping, header = dict(columns or {}), set(names_of(head))
    header |= {name_and_bracket(name)[0] for name in header}
    found = {name for name in header if is_column(name)} | {
        own_name for own_name, name in mapping.items() if name in header
    }
    return "time" in found and len(found) > 1


def _channels(cells: Mapping[str, Array]) -> list[Channel]:
    """A channel per sensor, of the rows in which any of its columns is filled."""
    thrusters = tuple(sorted((c for c in cells if THRUSTER.fullmatch(c)), key=lambda c: int(c.partition("_")[2])))
    sensors = {**{sensor: tuple(STREAMS[sensor]) for sensor in STREAMS}, "thruster": thrusters}
    sensors["fix"] = (*sensors["fix"], *LAT_LON)
    out = []
    for sensor, columns in sensors.items():
        present = [c for c in columns if c in cells]
        if not present:
            continue
        rows = np.any([~np.isnan(cells[c]) for c in present], axis=0)
        if not rows.any():
            continue
        filled = {name: cells[name][rows] for name in ("time", *present)}
        received = cells[RECEIVED][rows] if RECEIVED in cells else None
        receiver = "" if received is None else IN_RECEIVED
        out.append(Channel(sensor, filled, f"columns {', '.join(present)}", "", "time", received, receiver))
    return out


def _clock(time: Array) -> Clock:
    """The clock of the column ``time``: Unix where its stamps look like it."""
    known = time[np.isfinite(time)]
    unix = len(known) > 0 and UNIX_S[0] < np.median(known) < UNIX_S[1]
    return Clock("time", 0.0, 0.0, "stamps look like Unix time") if unix else Clock("time")


def once(files: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Files without those that are given again, and what to say of it."""
    given: dict[Path, Path] = {}
    said = []
    for path in files:
        if (same := given.setdefault(path.resolve(), path)) is not path:
            said.append(f"{path}: is given twice{'' if path == same else f', as {same} too'}, and taken once")
    return list(given.values()), said


def is_plain_log(path: Path, config: Config) -> bool:
    """Whether a file is read as a log, not as a native file.

    Raises
    ------
    InputError : it is neither: says what it is, and which command reads it
    """
    head = head_of(path)
    if is_own_log(head, config.of_file(path).columns):
        return True
    if recognise(path) is not None:
        return False
    if what := purpose(path, head):
        raise InputError(f"{path}: {what}")
    if head and not is_text(head):
        raise InputError(refusal(path, [each.title for each in formats()]))
    return True
