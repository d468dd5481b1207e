"""A file as columns of numbers: CSV, CSV.gz or Parquet, told apart by their content.

What is wrong with a file is said in one line: which file, which line and column, what was
expected and what to do.
"""

import csv
import gzip
import io
import warnings
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.errors import DataWarning, InputError
from rovgraph.geometry import Array
from rovgraph.log.streams import label_number


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
        if pd.api.types.is_string_dtype(cells):  # the parser leaves blanks around numbers that stand among texts
            cells = cells.where(cells.isna(), cells.astype(str).str.strip()).replace("", None)
        values = pd.to_numeric(cells, errors="coerce") if not pd.api.types.is_datetime64_any_dtype(cells) else None
        if values is None:
            raise InputError(f"{self.source}: column {name} holds dates, expected numbers; write it in seconds")
        bad = np.flatnonzero(values.isna() & cells.notna())
        if bad.size:
            cell = _shortened(repr(str(cells.iloc[bad[0]])), 30)
            raise InputError(
                f"{self.source}: line {self.line[bad[0]]}, column {name}: {cell} is no number; "
                f"leave a cell empty where there is no value ({_count(bad.size, 'such cell')})"
            )
        return values.to_numpy(dtype=float, na_value=np.nan)

    def labels(self, name: str) -> Array:
        """A column of names as the numbers that stand for them, shape (n,); NaN = empty cell."""
        cells = self.frame[name]
        told = cells.notna() & (cells.astype(str).str.strip() != "")
        out = np.full(len(cells), np.nan)
        out[told] = [label_number(str(cell)) for cell in cells[told]]
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
    if not len(frame):
        raise InputError(f"{path}: has a header and no rows below it, expected one row per measurement")
    return Table(str(path), frame, line)


def _content(path: Path) -> bytes:
    """Bytes of a file, unpacked."""
    if path.is_dir():
        raise InputError(f"{path}: is a directory, expected a log file; give a CSV or Parquet file in it")
    try:
        content = path.read_bytes()
        if content.startswith(b"\x1f\x8b"):
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
    lines = _text_lines(content, source)
    names = _header(lines, source)
    lines = _without_torn_end(content, lines, len(names), source)
    _require_even(lines, len(names), source)
    body = b"\n".join(lines[1:])
    if not body.strip():
        return pd.DataFrame(columns=names), np.empty(0, dtype=np.int64)
    try:
        frame = pd.read_csv(
            io.BytesIO(body),
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
    filled = np.flatnonzero(np.fromiter((bool(x.strip()) for x in lines[1:]), bool, len(lines) - 1)[: len(frame)])
    return frame.iloc[filled], filled.astype(np.int64) + 2


def _text_lines(content: bytes, source: str) -> list[bytes]:
    """Lines of a text file, without byte order mark."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(f"{source}: line {line} is not UTF-8 text, expected a CSV or Parquet file") from None
    if b"\0" in content:
        line = content.count(b"\n", 0, content.index(b"\0")) + 1
        raise InputError(f"{source}: line {line} holds binary data, expected a CSV or Parquet file")
    return content.removeprefix(b"\xef\xbb\xbf").splitlines()


def _header(lines: list[bytes], source: str) -> list[str]:
    """Names of the columns, without blanks around them."""
    text = lines[0].decode("utf-8")
    first = next((line for line in lines if not line.lstrip().startswith(b"#")), lines[0])
    if first.count(b",") != lines[0].count(b","):
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
    twice = next((n for i, n in enumerate(names) if n in names[:i]), None)
    if twice is not None:
        raise InputError(f"{source}: line 1 has the column {twice!r} twice, expected each name once; rename one")
    return names


def _without_torn_end(content: bytes, lines: list[bytes], width: int, source: str) -> list[bytes]:
    """Lines without a last one that was cut off while it was written."""
    torn = not content.endswith((b"\n", b"\r")) and len(lines) > 2 and lines[-1].count(b",") + 1 < width
    if torn and lines[-1].strip():
        warnings.warn(f"{source}: line {len(lines)}, the last, is cut off and left out", DataWarning, stacklevel=2)
        return lines[:-1]
    return lines


def _require_even(lines: list[bytes], width: int, source: str) -> None:
    """Every line has as many cells as the header."""
    for number, line in enumerate(lines, 1):
        if line.count(b",") + 1 != width and line.strip() and b'"' not in line:
            raise InputError(
                f"{source}: line {number} has {line.count(b',') + 1} cells, expected {width} as in the header; "
                "repair or delete that line"
            )


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("s" if n != 1 else "")
