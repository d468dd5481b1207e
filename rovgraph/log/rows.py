"""Rows that fill few of a log's columns each: a large log without its empty cells."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.log.streams import LABEL, LAT_LON, STREAMS, all_columns
from rovgraph.log.table import Table

STAMP_DIGITS = 6  # of a second, as a log is written


@dataclass(frozen=True)
class Rows:
    """Rows of a log that fill the same columns.

    Attributes
    ----------
    place : ndarray of int, shape (n,), increasing: which rows of the log they are, 0 = the first
    columns : column -> ndarray, shape (n,); NaN = an empty cell; ``time`` among them [s]
    """

    place: NDArray[np.int64]
    columns: Mapping[str, Array]


def in_order(parts: Sequence[Mapping[str, Array]]) -> list[Rows]:
    """Rows of one log in the order of time, of some tables that have a time each.

    Parameters
    ----------
    parts : column -> ndarray, shape (n,), ``time`` among them [s]
    """
    times = [np.round(part["time"], STAMP_DIGITS) for part in parts]  # equal stamps stay equal; a file is read the same
    order = np.argsort(np.concatenate(times), kind="stable")
    place = np.empty(len(order), dtype=np.int64)  # of a row among all
    place[order] = np.arange(len(order))
    ends = np.cumsum([len(time) for time in times])[:-1]
    return [
        _increasing(Rows(own, {**part, "time": time}))
        for own, part, time in zip(np.split(place, ends), parts, times, strict=True)
    ]


def _increasing(rows: Rows) -> Rows:
    if (np.diff(rows.place) > 0).all():
        return rows
    order = np.argsort(rows.place)
    return Rows(rows.place[order], {name: values[order] for name, values in rows.columns.items()})


def column_names(rows: Sequence[Rows]) -> list[str]:
    """Columns of the log, in the order in which it is written."""
    held = {name for own in rows for name in own.columns}
    known = [name for name in all_columns() if name in held]
    return known + sorted(held.difference(known), key=_natural)


def _natural(name: str) -> tuple[str, int]:
    stem, _, number = name.rpartition("_")
    return (stem, int(number)) if number.isdigit() else (name, 0)


def frame_of(rows: Sequence[Rows]) -> pd.DataFrame:
    """The log as a data frame, its empty cells NaN."""
    names, count = column_names(rows), sum(len(own.place) for own in rows)
    if len(rows) == 1:  # nothing to put together: the columns as they are, not copied
        columns = {name: rows[0].columns[name] for name in names}
    else:
        columns = {name: np.full(count, np.nan) for name in names}
        for own in rows:
            for name, values in own.columns.items():
                columns[name][own.place] = values
    frame = pd.DataFrame(columns, copy=False)
    if LABEL in frame:
        frame[LABEL] = frame[LABEL].astype("Int64")
    return frame


def tables_of(rows: Sequence[Rows], source: str) -> Iterator[Table]:
    """One table for each set of rows that feed the same streams; lines are those of the whole log."""
    sets: list[tuple[set[str], list[Rows]]] = []
    for own in rows:
        fed, together = _fed(own), [own]
        for others in [each for each in sets if each[0] & fed]:
            sets.remove(others)
            fed, together = fed | others[0], others[1] + together
        sets.append((fed, together))
    for _, together in sets:
        lines = np.sort(np.concatenate([own.place for own in together]))
        inside = [Rows(np.searchsorted(lines, own.place), own.columns) for own in together]
        yield Table(source, frame_of(inside), lines + 2)


def _fed(rows: Rows) -> set[str]:
    """Streams that have columns of these rows; those of no sensor with fixed columns are thrusters'."""
    held = rows.columns.keys() - {"time"}
    fed = {sensor for sensor, columns in STREAMS.items() if held.intersection(columns)}
    if held.intersection(LAT_LON):
        fed.add("fix")
    return fed or {"thruster"}
