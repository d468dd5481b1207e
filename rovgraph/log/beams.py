"""Single beams of a DVL: a table beside a log, which reports show and no estimate uses.

The table has ``time`` [s] and, for every beam by the instrument's own number k, ``valid_k`` (1 or 0), ``velocity_k``
[m/s], ``range_k`` or ``distance_k`` [m]. One of these is enough; other columns are ignored.
"""

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from rovgraph.errors import InputError, warn
from rovgraph.geometry import Array
from rovgraph.log.streams import Stream
from rovgraph.log.tables import Table, read_table, table_beside, table_of_arrays

BEAMS = "dvl_beams"  # name of the table
MOST_BEAMS = 8
_COLUMN = re.compile(r"(valid|velocity|range|distance)_(0|[1-9][0-9]?)")


def beams_of(table: Table) -> Stream:
    """Validity and range of every beam, in the order of time.

    Parameters
    ----------
    table : of n pings and k beams. A beam without ``valid_k`` is valid where its velocity is known; without both,
        where its range is

    Returns
    -------
    Stream : ``data``, shape (n, 2k): ``valid_k`` (1 or 0) of all beams, then ``range_k`` as the instrument measures it
        [m], NaN where the beam is not valid or has none

    Raises
    ------
    InputError : no time, no beam, more than `MOST_BEAMS`, quantities of different beams, or cells that cannot be used
    """
    columns, numbers = _columns(table)
    cells = {what: np.column_stack([table.numbers(name) for name in headers]) for what, headers in columns.items()}
    time = table.numbers("time")
    order = np.argsort(time, kind="stable")
    order = order[np.isfinite(time[order])]
    if not order.size:
        raise InputError(f"{table.source}: column time is empty, expected seconds in every row")
    valid, far = _valid(cells, columns, table), np.full((len(time), len(numbers)), np.nan)
    for what in ("distance", "range"):
        far = cells.get(what, far)
    far = np.where(valid & np.isfinite(far) & (far > 0.0), far, np.nan)  # 0 and -1 are invalid
    names = (*(f"valid_{k}" for k in numbers), *(f"range_{k}" for k in numbers))
    return Stream(BEAMS, names, time[order], np.hstack([valid, far])[order], table.line[order])


def beam_numbers(beams: Stream) -> list[str]:
    """The instrument's own numbers of the beams, as text."""
    return [name.removeprefix("valid_") for name in beams.columns if name.startswith("valid_")]


def beams_frame(beams: Stream) -> pd.DataFrame:
    """The table of `beams_of` as it is written."""
    return pd.DataFrame({"time": beams.time, **{name: beams[name] for name in beams.columns}})


def usable_beams(table: Path | Mapping[str, ArrayLike], source: str = "") -> Stream | None:
    """`beams_of` a file, or of column -> array_like, shape (n,); None where that cannot be used.

    Parameters
    ----------
    source : name of arrays, for messages

    Warns
    -----
    DataWarning : what is wrong with the table
    """
    try:
        return beams_of(read_table(table) if isinstance(table, Path) else table_of_arrays([table], "time", source))
    except InputError as error:
        warn(f"{error}; the DVL's beams are left out")
        return None


def beams_beside(log: Path) -> Stream | None:
    """The beams that a file beside a log holds, ``log.dvl_beams.csv``; None without a usable one.

    Warns
    -----
    DataWarning : what is wrong with the file
    """
    path = table_beside(log, BEAMS)
    return usable_beams(path) if path.is_file() else None


def _columns(table: Table) -> tuple[dict[str, list[str]], list[int]]:
    """Quantity -> its columns, in the order of the beams' numbers, and these."""
    found: dict[str, dict[int, str]] = {}
    for name in table.names:
        if match := _COLUMN.fullmatch(name):
            found.setdefault(match[1], {})[int(match[2])] = name
    if "time" not in table.names or not found:
        lacking = "time" if "time" not in table.names else "valid_1, velocity_1, range_1 or distance_1"
        raise InputError(f"{table.source}: no column {lacking}, expected time and the columns of each beam")
    first, *others = found
    numbers = sorted(found[first])
    for other in others:
        if apart := sorted(found[first].keys() ^ found[other].keys()):
            has, lacks = (first, other) if apart[0] in found[first] else (other, first)
            raise InputError(
                f"{table.source}: has {has}_{apart[0]} and no {lacks}_{apart[0]}, expected both of each beam"
            )
    if len(numbers) > MOST_BEAMS:
        raise InputError(f"{table.source}: has {len(numbers)} beams, expected at most {MOST_BEAMS}")
    return {what: [by_number[k] for k in numbers] for what, by_number in found.items()}, numbers


def _valid(cells: Mapping[str, Array], columns: Mapping[str, list[str]], table: Table) -> NDArray[np.bool_]:
    """Which beams of each ping are valid, shape (n, k)."""
    if "valid" not in cells:
        return np.isfinite(next(cells[what] for what in ("velocity", "range", "distance") if what in cells))
    valid = cells["valid"]
    odd = np.argwhere(~np.isnan(valid) & (valid != 0.0) & (valid != 1.0))
    if odd.size:
        row, beam = odd[0]
        where = f"line {table.line[row]}, column {columns['valid'][beam]}"
        raise InputError(f"{table.source}: {where}: {valid[row, beam]:g}, expected 0 or 1")
    return np.asarray(valid == 1.0)
