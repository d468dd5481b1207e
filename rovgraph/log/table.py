"""A file as columns of numbers: CSV, CSV.gz or Parquet, told apart by their content.

What is wrong with a file is said in one line: which file, which line and column, what was
expected and what to do.
"""

import csv
import gzip
import io
import zlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from decimal import Decimal
from numbers import Real
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray

from rovgraph.errors import InputError, kind_of, warn
from rovgraph.geometry import Array
from rovgraph.log.streams import label_number

NUMBERS = Real, Decimal, np.bool_  # what a cell of a column of objects may be
_TIMES = "dates", "durations"
GZIP = b"\x1f\x8b"
LONGEST_HEADER = 1 << 20  # bytes of the first line
SUFFIXES = (".csv.gz", ".csv", ".parquet")  # of a log that is written


@dataclass(frozen=True)
class Table:
    """Cells of a log file.

    Attributes
    ----------
    source : file name, for messages
    frame : cells as read
    line : ndarray of int, shape (n,), lines of the file, 1 = header
    """

    source: str
    frame: pd.DataFrame
    line: NDArray[np.int64]

    @property
    def names(self) -> list[str]:
        return [str(name) for name in self.frame.columns]

    def numbers(self, name: str) -> Array:
        """A column as floats, shape (n,); NaN = empty cell.

        Raises
        ------
        InputError : a cell that is no number
        """
        cells = self.frame[name]
        if held := _no_numbers(cells):
            remedy = "write it in seconds" if held in _TIMES else "give one real number per row"
            raise InputError(f"{self.source}: column {name} holds {held}, expected numbers; {remedy}")
        if pd.api.types.is_string_dtype(cells):  # the parser leaves blanks around numbers that stand among texts
            cells = cells.where(cells.isna(), cells.astype(str).str.strip()).replace("", None)
        if cells.dtype == object:  # what is neither a number nor a text becomes the text that the message shows
            cells = cells.map(lambda cell: cell if isinstance(cell, NUMBERS) else str(cell), na_action="ignore")
        try:
            values = pd.to_numeric(cells, errors="coerce")
        except OverflowError:
            raise InputError(
                f"{self.source}: column {name} holds an integer of hundreds of digits, which no float is; correct it"
            ) from None
        bad = np.flatnonzero(values.isna() & cells.notna())
        if bad.size:
            cell = _shortened(repr(str(cells.iloc[bad[0]])), 30)
            raise InputError(
                f"{self.source}: line {self.line[bad[0]]}, column {name}: {cell} is not a number; "
                f"leave a cell empty where there is no value ({_count(bad.size, 'such cell')})"
            )
        return values.to_numpy(dtype=float, na_value=np.nan)

    def labels(self, name: str) -> Array:
        """A column of names as the numbers that stand for them, shape (n,); NaN = empty cell."""
        cells = self.frame[name]
        filled = cells.notna() & (cells.astype(str).str.strip() != "")
        out = np.full(len(cells), np.nan)
        out[filled] = [label_number(str(cell)) for cell in cells[filled]]
        return out


def read_table(path: Path | str) -> Table:
    """Read a file, whatever of the three formats it is in.

    Raises
    ------
    InputError : no such file, empty, no table in it
    """
    path = Path(path)
    content = _content(path)
    if content.startswith(b"PAR1"):
        frame, line = _parquet(content, str(path))
    else:
        frame, line = _csv(content, str(path))
    _check_rows(frame, str(path))
    return Table(str(path), frame, line)


def table_beside(log: Path, name: str) -> Path:
    """Where another table of a log is kept: ``log.NAME.csv`` beside ``log.csv`` or ``log.csv.gz``."""
    suffix = next((s for s in SUFFIXES if log.name.endswith(s)), log.suffix)
    return log.with_name(f"{log.name.removesuffix(suffix)}.{name}.csv")


def table_of_frame(frame: pd.DataFrame, source: str) -> Table:
    """The table of a data frame; its rows count as lines of a file, the first as line 2.

    Raises
    ------
    InputError : no data frame, no row in it, a name that occurs twice
    """
    if not isinstance(frame, pd.DataFrame):
        raise InputError(f"{source}: is {kind_of(frame)}, expected a pandas DataFrame with the columns of a log")
    names = [str(name).strip() for name in frame.columns]
    _check_names(names, source)
    _check_rows(frame, source)
    return Table(source, frame.set_axis(names, axis="columns"), np.arange(len(frame), dtype=np.int64) + 2)


def table_of_arrays(tables: Sequence[Mapping[str, ArrayLike]], time: str, source: str) -> Table:
    """One table of some that have a time each, in the order of time.

    Parameters
    ----------
    tables : column -> array_like, shape (n,)
    time : name of the column that orders them; a step back within one of them stays one

    Raises
    ------
    InputError : columns that are no arrays of one dimension and the same length; or as `table_of_frame`
    """
    frames = []
    for number, table in enumerate(tables, 1):
        if not isinstance(table, Mapping):
            what = f"table {number} is {kind_of(table)}, expected a mapping of column names to arrays"
            raise InputError(f"{source}: {what}; a configuration is given as config=...")
        arrays = {name: _array(name, values, source) for name, values in table.items()}
        for name, values in arrays.items():
            if values.ndim != 1:
                raise InputError(f"{source}: column {name} has shape {values.shape}, expected one number per row")
        lengths = {len(values) for values in arrays.values()}
        if len(lengths) > 1:
            found = ", ".join(f"{name} {len(values)}" for name, values in arrays.items())
            raise InputError(f"{source}: columns of different length ({_shortened(found, 200)}), expected one")
        frames.append(table_of_frame(pd.DataFrame(arrays), source).frame)
    merged = pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()
    if len(frames) > 1 and all(time in frame for frame in frames):
        latest = [np.fmax.accumulate(Table(source, frame, frame.index.to_numpy()).numbers(time)) for frame in frames]
        merged = merged.iloc[np.argsort(np.concatenate(latest), kind="stable")]
    return table_of_frame(merged, source)


def _array(name: str, values: ArrayLike, source: str) -> NDArray[Any]:
    try:
        if isinstance(values, np.ma.MaskedArray) and values.dtype.kind in "biuf":
            return np.ma.filled(np.ma.asarray(values, dtype=float), np.nan)
        return np.asarray(values)
    except ValueError:  # rows of different length
        raise InputError(f"{source}: column {name} holds lists, expected one number per row") from None


def _content(path: Path) -> bytes:
    """Bytes of a file, unpacked."""
    if path.is_dir():
        raise InputError(f"{path}: is a directory, expected a log file; give a CSV or Parquet file in it")
    try:
        with path.open("rb") as file:
            head = file.read(LONGEST_HEADER)
            if len(head) == LONGEST_HEADER and not head.startswith((b"PAR1", GZIP)) and not {*b"\r\n"} & {*head}:
                raise InputError(f"{path}: its first line is longer than a megabyte, so it is no log in columns")
            file.seek(0)
            content = file.read()
        if content.startswith(GZIP):
            content = gzip.decompress(content)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; check the name") from None
    except (EOFError, zlib.error, gzip.BadGzipFile):
        raise InputError(f"{path}: gzip data are damaged or cut off; copy the file again") from None
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not content.strip():
        raise InputError(f"{path}: is empty, expected a header line and rows")
    return content


def _parquet(content: bytes, source: str) -> tuple[pd.DataFrame, NDArray[np.int64]]:
    try:
        frame = pd.read_parquet(io.BytesIO(content), engine="pyarrow")
    except ImportError:
        raise InputError(
            f"{source}: reading Parquet needs pyarrow; install it with: pip install 'rovgraph[parquet]'"
        ) from None
    except (ValueError, OSError) as error:
        reason = _shortened(str(error).splitlines()[0], 80)
        raise InputError(f"{source}: damaged Parquet file ({reason}); write it again") from None
    return frame, np.arange(len(frame), dtype=np.int64) + 2


def _csv(content: bytes, source: str) -> tuple[pd.DataFrame, NDArray[np.int64]]:
    """Frame and line numbers; blank lines are passed over."""
    content = _text(content, source)
    names = _header(content, source)
    content = _without_torn_end(content, len(names), source)
    filled = _filled(content, len(names), source)
    if not filled.any():
        return pd.DataFrame(columns=names), np.empty(0, dtype=np.int64)
    body = io.BytesIO(content)
    body.readline()
    try:
        frame = pd.read_csv(
            body,
            header=None,
            names=names,
            index_col=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
        )
    except (pd.errors.ParserError, UnicodeDecodeError, ValueError) as error:
        reason = _shortened(str(error).splitlines()[0], 80)
        raise InputError(f"{source}: not a CSV file ({reason}); expected comma-separated numbers") from None
    kept = np.flatnonzero(filled[: len(frame)])
    return frame if len(kept) == len(frame) else frame.iloc[kept], kept.astype(np.int64) + 2


def _text(content: bytes, source: str) -> bytes:
    """A text file without byte order mark, its lines ended by line feeds."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{source}: line {line} is not UTF-8 text, expected a CSV or Parquet file") from None
    if b"\0" in content:
        line = content.count(b"\n", 0, content.index(b"\0")) + 1
        raise InputError(f"{source}: line {line} holds binary data, expected a CSV or Parquet file")
    content = content.removeprefix(b"\xef\xbb\xbf")
    return content.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in content else content


def _lines(content: bytes) -> Iterator[bytes]:
    """Lines without their ends, one at a time: a list of all would be larger than the log."""
    return (line.rstrip(b"\n") for line in io.BytesIO(content))


def _header(content: bytes, source: str) -> list[str]:
    """Names of the columns, without blanks around them."""
    top = next(_lines(content))
    text = top.decode("utf-8")
    first = next((line for line in _lines(content) if not line.lstrip().startswith(b"#")), top)
    if first.count(b",") != top.count(b","):
        raise InputError(
            f"{source}: line 1 begins with #, a comment? Expected the columns' names; delete what stands above them"
        )
    for mark, called in ((";", "semicolons"), ("\t", "tabs")):
        if "," not in text and mark in text:
            raise InputError(f"{source}: line 1 is separated by {called}, expected commas; convert the file")
    names = [name.strip() for name in next(csv.reader([text], skipinitialspace=True), [])]
    if names.count("") > 1:
        raise InputError(
            f"{source}: line 1 has {names.count('')} columns without a name, as spreadsheets leave empty ones; "
            "delete them, or name them"
        )
    _check_names(names, source)
    return names


def _check_names(names: Sequence[str], source: str) -> None:
    twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
    if twice is not None:
        raise InputError(f"{source}: line 1 has the column {twice!r} twice, expected each name once; rename one")


def _check_rows(frame: pd.DataFrame, source: str) -> None:
    if not len(frame):
        raise InputError(f"{source}: has a header and no rows below it, expected one row per measurement")


def _no_numbers(cells: "pd.Series[Any]") -> str:
    """What a column holds that pandas would turn into numbers of some unit; empty where it holds none."""
    kind = pd.api.types.infer_dtype(cells, skipna=True)
    if kind.startswith(("datetime", "date")):
        return "dates"
    known = {"timedelta": "durations", "timedelta64": "durations", "period": "dates", "complex": "complex numbers"}
    nested = str(cells.dtype).startswith(("list<", "struct<", "map<"))  # of Arrow: pandas reads it as nothing
    return "lists" if nested else known.get(kind, "")


def _without_torn_end(content: bytes, width: int, source: str) -> bytes:
    """Lines without a last one that was cut off while it was written."""
    begin, count = content.rfind(b"\n") + 1, content.count(b"\n")
    last = content[begin:]
    if last.strip() and count > 1 and last.count(b",") + 1 < width:
        warn(f"{source}: line {count + 1}, the last, is cut off and left out")
        return content[:begin]
    return content


def _filled(content: bytes, width: int, source: str) -> NDArray[np.bool_]:
    """Which lines below the header are not blank; every one of them has as many cells as the header."""
    filled = bytearray()
    for number, line in enumerate(_lines(content), 1):
        has_cells = bool(line.strip())
        filled.append(has_cells)
        if line.count(b",") + 1 != width and has_cells and b'"' not in line:
            raise InputError(
                f"{source}: line {number} has {line.count(b',') + 1} cells, expected {width} as in the header; "
                "repair or delete that line"
            )
    return np.frombuffer(filled, np.bool_)[1:]


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("s" if n != 1 else "")
