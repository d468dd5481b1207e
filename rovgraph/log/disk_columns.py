"""Columns that are too long for memory: kept in temporary files, and processed in pieces.

Where the system permits, a file has no name, so it disappears with the last reference to its column, however the
process ends. It is mapped into memory for reading; each piece is released after use, and the system reads it again when
it is needed again.
"""

import errno
import mmap
import sys
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator
from typing import IO, Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from rovgraph.errors import InputError

IN_MEMORY = 1 << 21  # bytes of a column that are kept in memory
PIECE = 1 << 18  # rows that are computed with at a time
NEW = 1 << 14  # numbers of a table that are gathered before they are put to the others


class GrowingColumn:
    """A column that grows: in memory while it is short, then in a temporary file."""

    def __init__(self, dtype: DTypeLike) -> None:
        self._dtype = np.dtype(dtype)
        self._held: list[NDArray[Any]] = []
        self._file: IO[bytes] | None = None
        self._bytes = 0

    def __len__(self) -> int:
        return self._bytes // self._dtype.itemsize

    def extend(self, values: NDArray[Any]) -> None:
        """Append values, shape (n,), which are copied.

        Raises
        ------
        InputError : no space for a temporary file
        MemoryError : as for any array
        """
        self._held.append(np.array(values, self._dtype))
        self._bytes += self._held[-1].nbytes
        if self._bytes <= IN_MEMORY:
            return
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115 - `array` closes it
            for each in self._held:
                self._file.write(each.data)
        except OSError as error:
            raise _refused(error) from None
        self._held.clear()

    def array(self) -> NDArray[Any]:
        """All values, shape (n,), not to be changed; the column ends with that."""
        if self._file is None:
            return np.concatenate(self._held) if self._held else np.empty(0, self._dtype)
        try:
            with self._file:
                self._file.flush()
                held = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        except OSError as error:
            raise _refused(error) from None
        return np.ndarray(len(self), self._dtype, held)


class FlatTable:
    """Rows of as many numbers each, which come one by one."""

    def __init__(self, width: int) -> None:
        self._width = width
        self._new = array("d")
        self._column = GrowingColumn(float)
        self._table: NDArray[np.float64] | None = None

    def __len__(self) -> int:
        return (len(self._column) + len(self._new)) // self._width

    def append(self, row: Iterable[float]) -> None:
        self._new.extend(row)
        if len(self._new) >= NEW:
            self._put()

    def table(self) -> NDArray[np.float64]:
        """All rows, shape (n, width), not to be changed; the table ends with that."""
        if self._table is None:
            self._put()
            self._table = self._column.array().reshape(-1, self._width)
        return self._table

    def _put(self) -> None:
        self._column.extend(np.frombuffer(self._new))
        self._new = array("d")


def in_pieces(*columns: NDArray[Any], beyond: int = 0) -> Iterator[tuple[NDArray[Any], ...]]:
    """The same rows of some columns, a piece after the other.

    Parameters
    ----------
    columns : ndarray, shape (n, ...) each
    beyond : rows of the next piece that each has as well
    """
    for begin in range(0, len(columns[0]), PIECE):
        yield tuple(values[begin : begin + PIECE + beyond] for values in columns)
        release(*columns)


def release(*columns: NDArray[Any] | mmap.mmap) -> None:
    """Give back the memory that files are mapped into, those of columns or others."""
    if sys.platform == "win32":
        return
    for held in {_file_of(values) for values in columns}:
        if held is not None:
            held.madvise(mmap.MADV_DONTNEED)


def _file_of(values: NDArray[Any] | mmap.mmap) -> mmap.mmap | None:
    held: object = values
    while isinstance(held, np.ndarray):
        held = held.base
    return held if isinstance(held, mmap.mmap) else None


def spilled(values: NDArray[Any]) -> NDArray[Any]:
    """A column as it is if it is short, or in a file already; else in a file."""
    return values if _file_of(values) is not None else computed(lambda piece: piece, values)


def computed(function: Callable[..., NDArray[Any]], *columns: NDArray[Any]) -> NDArray[Any]:
    """A function of columns that treats each row by itself.

    Parameters
    ----------
    function : of some rows of each column, to ndarray, shape (n, ...), always of one type
    """
    if len(columns[0]) <= PIECE:
        return function(*columns)
    out: GrowingColumn | None = None
    for piece in in_pieces(*columns):
        values = function(*piece)
        out = GrowingColumn(values.dtype) if out is None else out
        out.extend(values.ravel())
    assert out is not None
    return out.array().reshape(-1, *values.shape[1:])


def taken(values: NDArray[Any], rows: NDArray[Any]) -> NDArray[Any]:
    """Some rows of a column, by a mask or by their indices."""
    if len(values) <= PIECE:
        return np.asarray(values[rows])
    out = GrowingColumn(values.dtype)
    if rows.dtype == bool:
        for piece, chosen in in_pieces(values, rows):
            out.extend(piece[chosen].ravel())
    else:
        for (chosen,) in in_pieces(rows):
            out.extend(values[chosen].ravel())
            release(values)
    return out.array().reshape(-1, *values.shape[1:])


def holds(condition: Callable[..., NDArray[np.bool_]], *columns: NDArray[Any]) -> bool:
    """Whether a condition is true of every row."""
    return all(bool(condition(*piece).all()) for piece in in_pieces(*columns))


def steps(values: NDArray[Any], found: Callable[[NDArray[Any]], NDArray[np.bool_]]) -> NDArray[np.int64]:
    """Rows whose difference from the row before, perhaps NaN, is such, by their indices."""
    with np.errstate(invalid="ignore"):  # between infinite values
        rows = [np.flatnonzero(found(np.diff(piece))) for (piece,) in in_pieces(values, beyond=1)]
    return np.concatenate([np.empty(0, np.int64), *(1 + k * PIECE + in_piece for k, in_piece in enumerate(rows))])


def every(values: NDArray[Any], step: int) -> NDArray[Any]:
    """Each so manieth row, a copy."""
    if len(values) <= PIECE:
        return np.array(values[::step])
    first = np.arange(0, len(values), step)
    return np.concatenate(
        [piece[first[(first >= k * PIECE) & (first < (k + 1) * PIECE)] - k * PIECE]
         for k, (piece,) in enumerate(in_pieces(values))]
    )  # fmt: skip


def median_step(values: NDArray[np.float64]) -> float:
    """Median of the differences of rows that do not decrease, shape (n,), n > 1, as `numpy.median` has it.

    Floats of one sign are in the order of their bits: the middle ones are found by 16 bits at a time.
    """
    if len(values) <= PIECE:
        return float(np.median(np.diff(values)))
    count = len(values) - 1
    middle = {_ranked(values, rank) for rank in ((count - 1) // 2, count // 2)}
    return float(np.mean(sorted(middle)))


def _ranked(values: NDArray[np.float64], rank: int) -> float:
    """The difference of that rank, 0 = the least."""
    known = 0
    for shift in (48, 32, 16, 0):
        counts = np.zeros(1 << 16, np.int64)
        for (piece,) in in_pieces(values, beyond=1):
            bits = np.abs(np.diff(piece)).view(np.uint64) >> np.uint64(shift)
            low = bits[bits >> np.uint64(16) == known] & np.uint64(0xFFFF)
            counts += np.bincount(low.astype(np.int64), minlength=len(counts))
        below = np.cumsum(counts)
        digit = int(np.searchsorted(below, rank, side="right"))
        rank -= int(below[digit] - counts[digit])
        known = (known << 16) | digit
    return float(np.array(known, np.uint64).view(np.float64))


def _refused(error: OSError) -> Exception:
    reason = error.strerror or str(error)
    if error.errno == errno.ENOMEM:
        return MemoryError(reason)
    if error.errno in (errno.EMFILE, errno.ENFILE):
        return InputError(
            f"no temporary file can be opened ({reason}); allow more (ulimit -n 4096), or convert fewer files at once"
        )
    folder = tempfile.tempdir or "any temporary folder"
    return InputError(
        f"no temporary file can be written in {folder} ({reason}); set TMPDIR to a folder with more space"
    )
