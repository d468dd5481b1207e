"""Sparse rows: a large log without its empty cells."""

from bisect import bisect_right
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.log.disk_columns import release
from rovgraph.log.streams import LAT_LON, SHIP_LAT_LON, STREAMS, all_columns, labels
from rovgraph.log.tables import Table

STAMP_DIGITS = 6  # of a second, as a log is written


@dataclass(frozen=True)
class Rows:
    """Rows of a log, or of a piece of it, that fill the same columns.

    Attributes
    ----------
    place : ndarray of int, shape (n,), increasing: which rows of it they are, 0 = the first
    columns : column -> ndarray, shape (n,); NaN = an empty cell; ``time`` among them [s]
    """

    place: NDArray[np.int64]
    columns: Mapping[str, Array]


@dataclass(frozen=True)
class Part:
    """Measurements of one sensor that are put into a log, stamped by a clock of their own.

    Attributes
    ----------
    columns : column -> ndarray, shape (n,); ``time`` among them, in order, by that clock [s]
    stamps : from its times to those of the log, which stay in order; both of shape (m,) [s]
    """

    columns: Mapping[str, Array]
    stamps: Callable[[Array], Array]

    def __len__(self) -> int:
        return len(self.columns["time"])

    def rows(self, begin: int, end: int) -> dict[str, Array]:
        """Some rows, stamped as in the log."""
        columns = {name: np.asarray(values[begin:end]) for name, values in self.columns.items()}
        return columns | {"time": np.round(self.stamps(columns["time"]), STAMP_DIGITS)}

    def at(self, row: int) -> float:
        """Time of a row in the log [s]."""
        return float(self.rows(row, row + 1)["time"][0])


def whole(parts: Sequence[Part]) -> list[Rows]:
    """The rows of one log."""
    return in_order([part.rows(0, len(part)) for part in parts])


def pieces(parts: Sequence[Part], count: int) -> Iterator[list[Rows]]:
    """The rows of one log in pieces that follow each other, so that a large one is never in memory twice.

    Parameters
    ----------
    count : of rows of each part that a piece has; more only where their times are equal
    """
    begins = [0] * len(parts)
    while left := [(part, begin) for part, begin in zip(parts, begins, strict=True) if begin < len(part)]:
        until = min(part.at(min(begin + count, len(part)) - 1) for part, begin in left)
        ends = [bisect_right(range(len(part)), until, begin, key=part.at)
                for part, begin in zip(parts, begins, strict=True)]  # fmt: skip
        spans = zip(parts, begins, ends, strict=True)
        yield in_order([part.rows(begin, end) for part, begin, end in spans if begin < end])
        for part in parts:
            release(*part.columns.values())
        begins = ends


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
        _increasing(Rows(of_part, {**part, "time": time}))
        for of_part, part, time in zip(np.split(place, ends), parts, times, strict=True)
    ]


def _increasing(rows: Rows) -> Rows:
    if (np.diff(rows.place) > 0).all():
        return rows
    order = np.argsort(rows.place)
    return Rows(rows.place[order], {name: values[order] for name, values in rows.columns.items()})


def column_names(parts: Sequence[Part | Rows]) -> list[str]:
    """Columns of the log, in the order in which it is written."""
    held = {name for part in parts for name in part.columns}
    known = [name for name in all_columns() if name in held]
    return known + sorted(held.difference(known), key=_natural)


def _natural(name: str) -> tuple[str, int]:
    stem, _, number = name.rpartition("_")
    return (stem, int(number)) if number.isdigit() else (name, 0)


def frame_of(rows: Sequence[Rows]) -> pd.DataFrame:
    """The log as a data frame, its empty cells NaN."""
    names, count = column_names(rows), sum(len(part.place) for part in rows)
    if len(rows) == 1:  # nothing to put together: the columns as they are, not copied
        columns = {name: rows[0].columns[name] for name in names}
    else:
        columns = {name: np.full(count, np.nan) for name in names}
        for part in rows:
            for name, values in part.columns.items():
                columns[name][part.place] = values
    frame = pd.DataFrame(columns, copy=False)
    for name in labels() & {*frame}:
        frame[name] = frame[name].astype("Int64")
    return frame


def tables_of(rows: Sequence[Rows], source: str) -> Iterator[Table]:
    """One table for each set of rows that feed the same streams; lines are those of the whole log."""
    sets: list[tuple[set[str], list[Rows]]] = []
    for part in rows:
        fed, together = _fed(part), [part]
        for others in [each for each in sets if each[0] & fed]:
            sets.remove(others)
            fed, together = fed | others[0], others[1] + together
        sets.append((fed, together))
    for _, together in sets:
        lines = np.sort(np.concatenate([part.place for part in together]))
        inside = [Rows(np.searchsorted(lines, part.place), part.columns) for part in together]
        yield Table(source, frame_of(inside), lines + 2)


def _fed(rows: Rows) -> set[str]:
    """Streams that have columns of these rows; those of no sensor with fixed columns are thrusters'."""
    held = rows.columns.keys() - {"time"}
    fed = {sensor for sensor, columns in STREAMS.items() if held.intersection(columns)}
    if held.intersection(LAT_LON):
        fed.add("fix")
    if held.intersection(SHIP_LAT_LON):
        fed.add("ship")
    return fed or {"thruster"}
