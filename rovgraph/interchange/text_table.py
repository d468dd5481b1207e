"""Columns of a large table of text: blocks of whole lines, read by pandas; lines that are no rows are counted."""

import csv
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array

BLOCK = 1 << 24  # bytes that are read at once
LOOKED_AT = 1000  # lines of a block without numbers, in which names of columns are looked for
NO_NUMBER = ("nan(ind)", "-nan(ind)", "-nan")  # beside those that pandas knows
CELLS, WORDS, NAMES = "more or fewer cells than the names", "a cell that is no number", "the names of columns again"


@dataclass(frozen=True)
class Layout:
    """How a table is written.

    Attributes
    ----------
    names : of its columns; some programs name several alike
    start : first byte behind the line of the names
    separator, decimal : between cells, and in numbers
    """

    names: tuple[str, ...]
    start: int
    separator: str = ","
    decimal: str = "."


@dataclass
class Columns:
    """What a table holds.

    Attributes
    ----------
    numbers : index of a column -> ndarray, shape (n,), NaN where a cell is empty
    texts : index of a column -> its n cells
    filled : cells of each column that hold something, shape (columns,)
    left : why lines were left out -> how many
    """

    numbers: dict[int, Array]
    texts: dict[int, list[str]]
    filled: NDArray[np.int64]
    left: Counter[str] = field(default_factory=Counter)


def cells_of(line: str, separator: str = ",") -> list[str]:
    """Cells of a line, without quotation marks and blanks around them."""
    return [cell.strip().strip('"').strip() for cell in line.strip("\r\n").split(separator)]


def read_columns(
    path: Path, layout: Layout, numbers: Collection[int], texts: Collection[int], progress: Callable[[int, int], None]
) -> Columns:
    """Some columns of a table as numbers or texts.

    Raises
    ------
    InputError : the names of the columns change within the file
    """
    count = len(layout.names)
    blocks: list[pd.DataFrame] = []
    out = Columns({}, {}, np.zeros(count, dtype=np.int64))
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(layout.start)
        for data in _blocks(file, out.left):
            progress(min(file.tell(), size), size)
            rows, others = _rows(data, count, layout.separator)
            for line in others[:LOOKED_AT]:
                _check_names(path, layout, cells_of(line.decode("latin-1"), layout.separator), out.left, CELLS)
            out.left[CELLS] += max(len(others) - LOOKED_AT, 0)
            if rows:
                blocks.append(_numbers(path, layout, rows, numbers, texts, out))
    frame = pd.concat(blocks, ignore_index=True) if blocks else pd.DataFrame(columns=[*numbers, *texts])
    out.numbers = {k: frame[k].to_numpy(dtype=float) for k in numbers}
    out.texts = {k: [cell.strip().strip('"') for cell in frame[k].fillna("").astype(str)] for k in texts}
    out.left = +out.left
    return out


def _blocks(file: BinaryIO, left: Counter[str]) -> Iterator[bytes]:
    """Whole lines, each with its end, and without carriage returns and zeros, which a table has none of."""
    rest = b""
    while block := file.read(BLOCK):
        rest += block
        end = rest.rfind(b"\n") + 1
        if end:
            yield _plain(rest[:end])
            rest = rest[end:]
        elif len(rest) > BLOCK:
            left["a line without end"] += 1
            rest = b""
    if rest.strip():
        yield _plain(rest + b"\n")


def _plain(data: bytes) -> bytes:
    return data.replace(b"\r\n", b"\n").replace(b"\r", b"?").replace(b"\0", b"?")


def _rows(data: bytes, count: int, separator: str) -> tuple[bytes, list[bytes]]:
    """Lines with as many cells as there are names, or an empty one more; and the others that are not blank."""
    raw = np.frombuffer(data, np.uint8)
    ends = np.flatnonzero(raw == ord("\n"))
    begins = np.concatenate([[0], ends[:-1] + 1])
    cells = 1 + np.diff(np.searchsorted(np.flatnonzero(raw == ord(separator)), ends), prepend=0)
    closed = (cells == count + 1) & (raw[ends - 1] == ord(separator))  # some programs end a line with a separator
    good = (cells == count) | closed
    if good.all():
        return data, []
    others = [data[begins[k] : ends[k]] for k in np.flatnonzero(~good)]
    return raw[np.repeat(good, ends + 1 - begins)].tobytes(), [line for line in others if line.strip()]


def _numbers(
    path: Path, layout: Layout, rows: bytes, numbers: Collection[int], texts: Collection[int], out: Columns
) -> pd.DataFrame:
    count = len(layout.names)
    frame = pd.read_csv(
        BytesIO(rows), sep=layout.separator, decimal=layout.decimal, header=None, names=range(count + 1),
        index_col=False, dtype=dict.fromkeys(texts, str), na_values=[*NO_NUMBER], skipinitialspace=True,
        quoting=csv.QUOTE_NONE, lineterminator="\n", encoding="latin-1", low_memory=False, skip_blank_lines=False,
    )  # fmt: skip
    wrong = np.zeros(len(frame), dtype=bool)
    made: dict[int, pd.Series] = {k: frame[k] for k in texts}
    for k in numbers:
        values = pd.to_numeric(frame[k], errors="coerce").astype(float)
        wrong |= (values.isna() & frame[k].notna()).to_numpy()
        made[k] = values.where(np.isfinite(values))
    for k, row in enumerate(np.flatnonzero(wrong)):
        if k < LOOKED_AT:
            _check_names(
                path, layout, [str(cell).strip() for cell in frame.iloc[int(row)].tolist()[:count]], out.left, WORDS
            )
        else:
            out.left[WORDS] += 1
    out.filled += frame.loc[~wrong, range(count)].notna().sum().to_numpy()
    return pd.DataFrame(made)[~wrong]


def _check_names(path: Path, layout: Layout, cells: Sequence[str], left: Counter[str], why: str) -> None:
    """Count a line that is no row, unless it names other columns: then the file is two in one."""
    plain = [cell.strip('"') for cell in cells]
    while plain and plain[-1] in ("", "nan"):
        del plain[-1]
    shared = {name for name in layout.names if name} & set(plain)
    if plain == list(layout.names)[: len(plain)] and shared:
        left[NAMES] += 1
    elif len(shared) >= 2:
        odd = next((cell for cell in plain if cell not in layout.names), "fewer of them")
        raise InputError(f"{path}: names its columns twice, and not alike (then with {odd[:40]!r}); split it there")
    else:
        left[why] += 1
