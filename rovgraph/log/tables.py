"""A file as columns of cells: CSV as anyone writes it, gzipped or not, or Parquet, told apart by content.

Encoding, separator, decimal commas and a row of units are found in the first bytes, and pandas parses. A file that is
not written as this program's own is read with a warning that states how. An error is one line: which file, which line
and column, what was expected and what to do.
"""

import csv
import gzip
import io
import re
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

from rovgraph.dates import DateRules, is_text, seconds_of_day_and_time, seconds_of_numbers, seconds_of_texts
from rovgraph.errors import InputError, kind_of, warn
from rovgraph.geometry import Array

NUMBERS = Real, Decimal, np.bool_  # what a cell of a column of objects may be
_TIMES = "dates", "durations"
GZIP = b"\x1f\x8b"
LONGEST_HEADER = 1 << 20  # bytes of the first line
HEAD = 1 << 16  # bytes by which a layout is found
BLOCK = 1 << 24  # bytes of which lines are counted at a time
SUFFIXES = (".csv.gz", ".csv", ".parquet")  # of a log that is written
WIDE_ROWS = 0.9  # of the rows below the first that is longer than the header, which are as long
SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas"}
_BOMS = {b"\xff\xfe\x00\x00": "utf-32", b"\x00\x00\xfe\xff": "utf-32", b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16"}
_UTF8_BOM = b"\xef\xbb\xbf"
_CONTROL = bytes(b for b in range(32) if b not in b"\t\n\r\f") + b"\x7f"  # that no text has
_COMMA = rb"-?\d+,\d+"  # a number
_PLAIN_UNIT = re.compile(r"\[?\(?[A-Za-z°µμ%/^²0-9*.\- ]{1,16}\)?\]?")


@dataclass(frozen=True)
class Table:
    """Cells of a file.

    Attributes
    ----------
    source : file name, for messages
    frame : cells as read
    line : ndarray of int, shape (n,), lines of the file, 1 = header
    decimal : sign in numbers that the parser left as texts
    said : how the file was read, where it is not written as a log of this program, phrases
    """

    source: str
    frame: pd.DataFrame
    line: NDArray[np.int64]
    decimal: str = "."
    said: tuple[str, ...] = ()

    @property
    def names(self) -> list[str]:
        return [str(name) for name in self.frame.columns]

    def numbers(self, name: str) -> Array:
        """A column as floats, shape (n,); NaN = empty cell.

        Raises
        ------
        InputError : a cell that is not a number
        """
        cells = self.frame[name]
        if held := _no_numbers(cells):
            remedy = "write it in seconds" if held in _TIMES else "give one real number per row"
            raise InputError(f"{self.source}: column {name} holds {held}, expected numbers; {remedy}")
        if pd.api.types.is_string_dtype(cells):  # the parser leaves blanks around numbers that stand among texts
            cells = cells.where(cells.isna(), cells.astype(str).str.strip()).replace("", None)
            if self.decimal != ".":
                self._refuse_points(name, cells)
                cells = cells.str.replace(self.decimal, ".", regex=False)
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

    def _refuse_points(self, name: str, cells: "pd.Series[Any]") -> None:
        """Where commas are decimal, a point may be one as well, or part of thousands."""
        both = np.flatnonzero(cells.str.fullmatch(r"[+-]?\d{1,3}(\.\d{3})+").fillna(False))
        if both.size:
            cell = str(cells.iloc[both[0]])
            raise InputError(
                f"{self.source}: line {self.line[both[0]]}, column {name}: {cell!r} may be {cell.replace('.', '')} or "
                f"{cell}, as the file has decimal commas; write its numbers in one way"
            )

    def warn_how(self, *more: str) -> None:
        """Issue a `DataWarning` of how the file was read, and of ``more``; none of a log of this program."""
        phrases = [phrase for phrase in (", ".join(filter(None, self.said)), *more) if phrase]
        if phrases:
            warn(f"{self.source}: read {'; '.join(phrases)}")

    def times(self, name: str, rules: DateRules, day: str | None = None, in_seconds: bool = False) -> tuple[Array, str]:
        """A column of times [s]: Unix time of dates and of what looks like it, else its numbers.

        Parameters
        ----------
        day : column of the days of these times, as far as it holds any
        in_seconds : numbers are what they are, whatever their size

        Returns
        -------
        time : ndarray, shape (n,), NaN = empty cell
        how : dates, and numbers that are not seconds, were read, a phrase

        Raises
        ------
        InputError : a cell that is not a time; a date that may mean two days
        """
        cells = self.frame[name]

        def where(row: int) -> str:
            return f"{self.source}: line {self.line[row]}, column {name}"

        found = None if day is None else seconds_of_day_and_time(self.frame[day], cells, rules, where)
        held = _no_numbers(cells)
        if found is None and held == "dates":  # of a data frame or Parquet
            found = seconds_of_texts(cells.map(str, na_action="ignore"), rules, where)
        if found is None and not held and is_text(cells if self.decimal == "." else _with_points(cells)):
            found = seconds_of_texts(cells, rules, where)
        if found is None:
            values = self.numbers(name)
            found = (values, "") if in_seconds else seconds_of_numbers(values)
        return found[0], f"column {name} as {found[1]}" if found[1] else ""


def _with_points(cells: "pd.Series[Any]") -> "pd.Series[Any]":
    return cells if cells.dtype.kind in "biufc" else cells.astype("string").str.replace(",", ".", regex=False)


@dataclass(frozen=True)
class CellLayout:
    """How cells stand in a text.

    Attributes
    ----------
    names : of the columns; of one with a row of units, ``name [unit]``
    separator, decimal : signs
    first : line of the first row
    said : what differs from a log of this program, phrases
    """

    names: tuple[str, ...]
    separator: str = ","
    decimal: str = "."
    first: int = 2
    said: tuple[str, ...] = ()


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
        table = Table(str(path), frame, line)
    else:
        table = _csv(content, str(path))
    _check_rows(table.frame, str(path))
    return table


def read_cells(path: Path | str) -> Table:
    """The cells of a text file as texts, whatever they and their columns are called.

    Raises
    ------
    InputError : no such file, empty, no text in columns
    """
    source = str(path)
    text, called = _text(_content(Path(path)), source)
    layout = layout_of(text)
    try:
        frame = pd.read_csv(
            io.BytesIO(text),
            sep=layout.separator,
            header=None,
            skiprows=layout.first - 2,
            skipinitialspace=True,
            dtype=str,
            keep_default_na=False,
        )
    except ValueError as error:
        reason = _shortened(str(error).splitlines()[0], 80)
        raise InputError(f"{source}: cannot be read as CSV ({reason})") from None
    rows = frame.iloc[1:].set_axis(frame.iloc[0].str.strip(), axis="columns").reset_index(drop=True)
    if not len(rows):
        raise InputError(f"{source}: holds no row below its header")
    line = np.arange(len(rows), dtype=np.int64) + layout.first
    return Table(source, rows, line, layout.decimal, (called, *layout.said))


def names_of(head: bytes) -> list[str]:
    """Names of the columns of a file that begins like this; none where it is no text."""
    encoding = encoding_of(head)
    if encoding is None:
        return []
    text = head.decode(encoding, "ignore").encode()
    try:
        return list(layout_of(text.removeprefix(_UTF8_BOM).replace(b"\r\n", b"\n").replace(b"\r", b"\n")).names)
    except csv.Error:
        return []


def encoding_of(head: bytes) -> str | None:
    """How a file that begins like this is encoded, as Python names it; None where it is no text."""
    bom = next((called for mark, called in _BOMS.items() if head.startswith(mark)), None)
    if bom is not None:
        return bom
    few = head[:400]
    if b"\0" in few and len(few) > 4:  # letters of UTF-16 without a mark have every second byte zero
        for encoding, zeros in (("utf-16-le", few[1::2]), ("utf-16-be", few[::2])):
            if zeros.count(0) == few.count(0) > 0.4 * len(few):
                return encoding
    try:
        head.decode("utf-8")
        return None if b"\0" in head else "utf-8"
    except UnicodeDecodeError as error:
        if len(head) - error.start <= 3 and b"\0" not in head:  # a letter was cut
            return "utf-8"
    try:
        head.decode("cp1252")
    except UnicodeDecodeError:
        return None
    return "cp1252" if head.translate(None, _CONTROL) == head else None


def layout_of(text: bytes) -> CellLayout:
    """How the cells of a text in UTF-8 stand, by its first lines.

    Parameters
    ----------
    text : without byte order mark, its lines ended by line feeds
    """
    first, lines = 1, text[:HEAD].split(b"\n", 12)[:12]
    stated = re.fullmatch(rb'"?sep=(.)"?\s*', lines[0])  # as Excel writes it
    if stated:
        first, lines = 2, lines[1:] or [b""]
    top = lines[0] if len(lines) > 1 or stated else text.partition(b"\n")[0]
    separator, said = ",", []
    if stated or b";" in top or b"\t" in top:
        separator = stated[1].decode() if stated else _separator(lines)
    if separator != ",":
        said.append(f"separated by {SEPARATORS.get(separator, repr(separator))}")
    names = _cells(top, separator)
    decimal = "."
    if separator != "," or b'"' in text[:HEAD]:
        sign = re.escape(separator.encode())
        bare = rb"(?:^|%s) *%s *(?:%s|$)" % (sign, _COMMA, sign)
        if re.search(rb'"%s"' % _COMMA if separator == "," else rb'%s|"%s"' % (bare, _COMMA), text, re.MULTILINE):
            decimal = ","
            said.append("with decimal commas")
    units = _units(lines[1:3], names, separator, decimal)
    if units:
        names = [f"{name} [{unit}]" if unit and name else name for name, unit in zip(names, units, strict=True)]
        said.append(f"with units in line {first + 1}")
    return CellLayout(tuple(names), separator, decimal, first + (2 if units else 1), tuple(said))


def _cells(line: bytes, separator: str) -> list[str]:
    rows = csv.reader([line.decode("utf-8", "replace")], delimiter=separator, skipinitialspace=True)
    return [cell.strip() for cell in next(rows, [])]


def _separator(lines: Sequence[bytes]) -> str:
    """The sign that separates most cells of the header, and as many in the row below it."""
    top, rows = lines[0], [line for line in lines[1:] if line.strip()][:1] or [lines[0]]
    counts = {sign: top.count(sign.encode()) for sign in SEPARATORS}
    fitting = [s for s in SEPARATORS if counts[s] and all(row.count(s.encode()) >= counts[s] for row in rows)]
    return max(fitting or SEPARATORS, key=lambda sign: counts[sign])


def _units(lines: Sequence[bytes], names: Sequence[str], separator: str, decimal: str) -> list[str]:
    """The cells of a second line that holds units alone; none where it is a row."""
    if len(lines) < 2 or not lines[1].strip():
        return []
    below, row = (_cells(line, separator) for line in lines[:2])
    held = [cell for cell in below if cell]
    if len(below) != len(names) or 2 * len(held) < len(names) or len(row) != len(names):
        return []
    if any(not _PLAIN_UNIT.fullmatch(cell) or _is_number(cell, decimal) for cell in held):
        return []
    if not any(_is_number(cell, decimal) for cell in row):
        return []
    return [cell.strip("[]()- ") for cell in below]


def _is_number(text: str, decimal: str) -> bool:
    try:
        float(text.replace(decimal, "."))
    except ValueError:
        return False
    return True


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


VECTORS = {  # what is given as one array of shape (n, k) -> its columns
    "acc": ("acc_x", "acc_y", "acc_z"),
    "gyr": ("gyr_x", "gyr_y", "gyr_z"),
    "mag": ("mag_x", "mag_y", "mag_z"),
    "ahrs": ("ahrs_roll", "ahrs_pitch", "ahrs_yaw"),
    "dvl": ("dvl_vx", "dvl_vy", "dvl_vz"),
    "dvl_water": ("dvl_water_vx", "dvl_water_vy", "dvl_water_vz"),
    "fix": ("fix_north", "fix_east"),
}


def tables_of_keywords(given: Mapping[str, Any], time: str, source: str) -> list[Mapping[str, ArrayLike]]:
    """Tables of arrays that are given by name: those of ``time``, and pairs (times, values) with their own.

    Raises
    ------
    InputError : arrays without times
    """
    own = {name: values for name, values in given.items() if not _has_times(values)}
    tables: list[Mapping[str, ArrayLike]] = [
        {time: times[0], name: times[1]} for name, times in given.items() if name not in own
    ]
    if own and time not in own:
        name = next(iter(own))
        raise InputError(f"{source}: {name} has no times: give {time}=..., or {name}=(times, values)")
    return [own, *tables] if own else tables


def _has_times(values: object) -> bool:
    return isinstance(values, tuple) and len(values) == 2 and np.ndim(values[0]) > 0


def _with_columns(table: Mapping[str, ArrayLike], names: Mapping[str, str], source: str) -> dict[str, NDArray[Any]]:
    """The arrays of a table, those of `VECTORS` by column; ``names`` are what a file calls rovgraph's."""
    out: dict[str, NDArray[Any]] = {}
    for name, given in table.items():
        values = _array(name, given, source)
        if name not in VECTORS:
            out[name] = values
            continue
        columns = VECTORS[name]
        if values.dtype.kind not in "biuf":
            raise InputError(f"{source}: {name} holds {values.dtype}, expected numbers")
        if values.ndim != 2 or values.shape[1] != len(columns):
            raise InputError(
                f"{source}: {name} has shape {values.shape}, expected (n, {len(columns)}): {', '.join(columns)}"
            )
        out |= {names.get(column, column): axis for column, axis in zip(columns, values.T, strict=True)}
    return out


def table_of_arrays(
    tables: Sequence[Mapping[str, ArrayLike]], time: str, source: str, names: Mapping[str, str] | None = None
) -> Table:
    """One table of some that have a time each, in the order of time.

    Parameters
    ----------
    tables : column -> array_like, shape (n,); those of `VECTORS` have shape (n, k)
    time : name of the column that orders them; a step back within one of them stays one
    names : rovgraph's column -> its name in the tables, where it is another

    Raises
    ------
    InputError : columns that are not arrays of one dimension and the same length; or as `table_of_frame`
    """
    frames = []
    for number, table in enumerate(tables, 1):
        if not isinstance(table, Mapping):
            what = f"table {number} is {kind_of(table)}, expected a mapping of column names to arrays"
            raise InputError(f"{source}: {what}; a configuration is given as config=...")
        arrays = _with_columns(table, names or {}, source)
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


def _csv(content: bytes, source: str) -> Table:
    """A text as a table; blank lines are passed over."""
    text, called = _text(content, source)
    layout = layout_of(text)
    names, sign = list(layout.names), layout.separator.encode()
    _check_header(text, names, layout, source)
    text = _without_torn_end(text, len(names), sign, source)
    filled, wide = _filled(text, len(names), sign, layout.first)
    if wide is not None and (repaired := _with_decimals_of_seconds(text, wide)) is not None:
        return _csv(repaired, source)
    said = [called, *layout.said]
    at, more = (0, 0) if wide is None else _place_of_more(text, names, wide, layout, source)
    if wide is not None and more:
        before = f"before {names[at]!r}" if at < len(names) else "behind the others"
        said.append(f"without {_count(more, 'column')} that no name stands for, {before} from line {wide.line} on")
    nameless = [k for k, name in enumerate(names) if not name]
    if len(nameless) > 1:
        said.append(f"without {len(nameless)} columns that have no name")
    if not filled.any():
        return Table(source, pd.DataFrame(columns=names), np.empty(0, dtype=np.int64))
    plain = [name or f"\0{k}" for k, name in enumerate(names)] if len(nameless) > 1 else names
    body = io.BytesIO(text)
    for _ in range(layout.first - 1):
        body.readline()
    if wide is None or not more:
        frame = _parsed(body, plain, layout, source)
    else:
        narrow = b"".join(body.readline() for _ in range(wide.line - layout.first))
        wider = [*plain[:at], *(f"\0+{k}" for k in range(more)), *plain[at:]]
        parts = [_parsed(io.BytesIO(narrow), plain, layout, source)] if narrow else []
        frame = pd.concat([*parts, _parsed(body, wider, layout, source)[plain]], ignore_index=True)
    if len(nameless) > 1:
        frame = frame[[name for name in names if name]]
    kept = np.flatnonzero(filled[: len(frame)])
    frame = frame if len(kept) == len(frame) else frame.iloc[kept]
    return Table(source, frame, kept.astype(np.int64) + layout.first, layout.decimal, tuple(said))


def _parsed(body: io.BytesIO, names: list[str], layout: CellLayout, source: str) -> pd.DataFrame:
    try:
        return pd.read_csv(
            body,
            sep=layout.separator,
            decimal=layout.decimal,
            header=None,
            names=names,
            index_col=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            low_memory=False,
        )
    except (pd.errors.ParserError, UnicodeDecodeError, ValueError) as error:
        reason = _shortened(str(error).splitlines()[0], 80)
        expected = f"numbers separated by {SEPARATORS.get(layout.separator, repr(layout.separator))}"
        raise InputError(f"{source}: not a CSV file ({reason}); expected {expected}") from None


def _text(content: bytes, source: str) -> tuple[bytes, str]:
    """A text file in UTF-8 without byte order mark, its lines ended by line feeds; and what it was, "" = that."""
    called, encoding = "", encoding_of(content[:HEAD])
    if encoding is not None and encoding.startswith(("utf-16", "utf-32")):
        called = f"in {encoding[:6].upper()}"
        try:
            content = content.decode(encoding).encode()
        except UnicodeDecodeError:
            raise InputError(f"{source}: is damaged {encoding[:6].upper()} text; write it again as UTF-8") from None
    else:
        try:
            content.decode("utf-8")
        except UnicodeDecodeError as error:
            line = content.count(b"\n", 0, error.start) + 1
            if encoding is None or content.translate(None, _CONTROL) != content:
                raise InputError(f"{source}: line {line} is not UTF-8 text, expected a CSV or Parquet file") from None
            content, called = content.decode("cp1252", "replace").encode(), "in Windows-1252"
    if b"\0" in content:
        line = content.count(b"\n", 0, content.index(b"\0")) + 1
        raise InputError(f"{source}: line {line} holds binary data, expected a CSV or Parquet file")
    content = content.removeprefix(_UTF8_BOM)
    return (content.replace(b"\r\n", b"\n").replace(b"\r", b"\n") if b"\r" in content else content), called


def _lines(content: bytes) -> Iterator[bytes]:
    """Lines without their ends, one at a time: a list of all would be larger than the log."""
    return (line.rstrip(b"\n") for line in io.BytesIO(content))


def _check_header(text: bytes, names: Sequence[str], layout: CellLayout, source: str) -> None:
    top, sign = next(_lines(text)), layout.separator.encode()
    if top.lstrip().startswith(b"#"):
        first = next((line for line in _lines(text) if not line.lstrip().startswith(b"#")), top)
        if first.count(sign) != top.count(sign):
            raise InputError(
                f"{source}: line 1 begins with #, a comment? Expected the columns' names; delete what stands above them"
            )
    _check_names([name for name in names if name], source)


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


def _without_torn_end(content: bytes, width: int, separator: bytes, source: str) -> bytes:
    """Lines without a last one that was cut off while it was written."""
    begin, count = content.rfind(b"\n") + 1, content.count(b"\n")
    last = content[begin:]
    if last.strip() and count > 1 and last.count(separator) + 1 < width:
        warn(f"{source}: line {count + 1}, the last, is cut off and left out")
        return content[:begin]
    return content


@dataclass
class _Odd:
    """Lines with more or fewer cells than the header: the first one, and what comes from there on."""

    line: int
    cells: int
    alike: int = 1
    others: int = 0


def _filled(content: bytes, width: int, separator: bytes, first: int) -> tuple[NDArray[np.bool_], _Odd | None]:
    """Which lines below the header are not blank, and those that have not as many cells as the header."""
    if (lines := _even_lines(content, width, separator)) is not None:
        return np.ones(max(lines - first + 1, 0), np.bool_), None
    filled, odd = bytearray(), None
    for number, line in enumerate(_lines(content), 1):
        has_cells = bool(line.strip())
        filled.append(has_cells)
        cells = line.count(separator) + 1
        if cells != width and has_cells and b'"' not in line and number >= first:
            if odd is None:
                odd = _Odd(number, cells)
            elif cells == odd.cells:
                odd.alike += 1
            else:
                odd.others += 1
        elif odd is not None and has_cells:
            odd.others += 1
    return np.frombuffer(filled, np.bool_)[first - 1 :], odd


def _even_lines(content: bytes, width: int, separator: bytes) -> int | None:
    """How many lines there are, where each of them has the header's number of cells and none is blank; else None."""
    lines = begin = 0
    while begin < len(content):
        end = content.find(b"\n", begin + BLOCK) + 1 or len(content)
        block = np.frombuffer(content, np.uint8, end - begin, begin)
        starts = np.concatenate([[0], np.flatnonzero(block[:-1] == ord("\n")) + 1])
        separators = np.add.reduceat(block == ord(separator), starts, dtype=np.int32)
        if (separators != width - 1).any() or not np.logical_or.reduceat(block > ord(" "), starts).all():
            return None
        lines, begin = lines + len(starts), end
    return lines


def _with_decimals_of_seconds(text: bytes, odd: _Odd) -> bytes | None:
    """The text with points in times such as 09:30:00,005, where their comma makes one more cell."""
    row = next(line for k, line in enumerate(_lines(text), 1) if k == odd.line)
    form = re.compile(rb"(\d\d:\d\d:\d\d),(\d{3}|\d{6})(?=,)")
    if odd.others or len(form.findall(row)) != 1:
        return None
    return form.sub(rb"\1.\2", text)


def _place_of_more(text: bytes, names: Sequence[str], odd: _Odd, layout: CellLayout, source: str) -> tuple[int, int]:
    """Where columns without a name stand in rows that are longer than the header, and how many they are.

    Some programs add columns in the middle of a file. Their place is where the row before continues.

    Raises
    ------
    InputError : a few rows that differ; a place that the rows do not show
    """
    wrong = InputError(
        f"{source}: line {odd.line} has {odd.cells} cells, expected {len(names)} as in the header; "
        + _cause(odd, len(names), layout)
    )
    more = odd.cells - len(names)
    if more < 0 or odd.alike < 2 or odd.alike < WIDE_ROWS * (odd.alike + odd.others) or odd.others > 1:
        raise wrong
    rows = [line for k, line in enumerate(_lines(text), 1) if layout.first <= k and odd.line - 2 < k < odd.line + 2]
    if odd.line == layout.first:
        empty = b"(?:%s *){%d}" % (re.escape(layout.separator.encode()), more)
        below = (line for k, line in enumerate(_lines(text), 1) if k >= layout.first and line.strip())
        if not all(re.search(empty + rb"$", line) for line in below):
            raise wrong
        return len(names), more
    before, after = (_cells(line, layout.separator) for line in rows[:2])
    if len(before) + more != len(after):  # a name of the header goes over two lines
        raise wrong
    likeness = [
        sum(_alike(a, b) for a, b in zip(before, [*after[:k], *after[k + more :]], strict=True))
        for k in range(len(names) + 1)
    ]
    best = max(likeness)
    if likeness.count(best) > 1 or best < 0.8 * len(names):
        raise wrong
    return likeness.index(best), more


def _cause(odd: _Odd, width: int, layout: CellLayout) -> str:
    """What to do about rows that are not as long as the header."""
    if odd.alike == 1:
        return "repair or delete that line"
    if layout.separator == "," and not odd.others and odd.cells >= 2 * width - 1:
        return "decimal commas between commas? Write the table with semicolons"
    return "repair these lines, or name every column in the header"


def _alike(one: str, other: str) -> float:
    """How well a cell continues the one before: 1 = equal, 0 = it is of another kind."""
    if one == other:
        return 1.0
    if _is_number(one, ".") and _is_number(other, "."):
        a, b = float(one), float(other)
        return 0.9 if abs(a - b) <= 0.1 * max(abs(a), abs(b)) else 0.4
    return 0.8 if re.sub(r"\d", "0", one) == re.sub(r"\d", "0", other) else 0.0


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else text[: length - 3] + "..."


def _count(n: int, what: str) -> str:
    return f"{n} {what}" + ("s" if n != 1 else "")
