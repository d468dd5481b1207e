"""Tables of text: a line that names the columns, and a row of numbers a line."""

from array import array
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array

LONGEST = 1 << 16  # bytes of a line
FEW = 3  # names of columns that make a line one that names them
EVERY = 4096  # rows between two calls of progress
BAD_COUNT, NO_NUMBER, AGAIN = "more or fewer cells than the names", "a cell that is no number", "the names again"

Naming = Callable[[str], tuple[str, str]]  # a name as written -> the column, and its unit or ""


@dataclass(frozen=True)
class TextLayout:
    """Where the columns of a file are.

    Attributes
    ----------
    names : as written
    start : first byte of the rows
    separator : between cells
    decimal : point or comma
    """

    names: tuple[str, ...]
    start: int
    separator: str = ","
    decimal: str = "."


@dataclass(frozen=True)
class TextColumn:
    """A column of numbers.

    Attributes
    ----------
    name : as written
    unit : that the name states, "" = none
    values : ndarray, shape (n,), NaN where a cell is empty
    """

    name: str
    unit: str
    values: Array


@dataclass
class TextTable:
    """The columns that were asked for, by their plain names, and why rows were left out.

    Attributes
    ----------
    columns : plain name -> column; the first of several that are called alike
    left : why -> rows
    others : names, as written, of the columns that were not asked for
    """

    columns: dict[str, TextColumn]
    left: Counter[str] = field(default_factory=Counter)
    others: tuple[str, ...] = ()

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def __getitem__(self, name: str) -> Array:
        return self.columns[name].values

    def holds(self, *names: str) -> bool:
        """Whether all these columns are there, each with a number."""
        return all(name in self and bool(np.isfinite(self[name]).any()) for name in names)


def cells_of(line: bytes, separator: str = ",") -> list[str]:
    """Cells of a line, without blanks and quotes."""
    text = line.decode("utf-8-sig", "replace").strip("\r\n")
    return [cell.strip().strip('"').strip() for cell in text.split(separator)]


def read_table(
    path: Path,
    layout: TextLayout,
    naming: Naming,
    wanted: Collection[str],
    progress: Callable[[int, int], None],
    parsers: Mapping[str, Callable[[str], float]] | None = None,
) -> TextTable:
    """The columns of a file that are wanted, by plain names.

    Parameters
    ----------
    naming : of a name as written
    progress : called with bytes read and those of the file
    parsers : plain name -> what makes a number of a cell; ``float`` without

    Raises
    ------
    InputError : the columns are named again within the file, in another way
    """
    places: dict[str, tuple[int, str, str]] = {}  # plain name -> place in a row, name as written, unit
    for k, written in enumerate(layout.names):
        plain, unit = naming(written)
        if plain in wanted:
            places.setdefault(plain, (k, written, unit))
    takes = [(k, (parsers or {}).get(plain, float), array("d")) for plain, (k, _, _) in places.items()]
    left: Counter[str] = Counter()
    size, count = path.stat().st_size, len(layout.names)
    known = {naming(name)[0] for name in layout.names}
    with path.open("rb") as file:
        file.seek(layout.start)
        number = 0
        while line := file.readline(LONGEST):
            number += 1
            if number % EVERY == 0:
                progress(min(file.tell(), size), size)
            cells = cells_of(line, layout.separator)
            if len(cells) == count + 1 and not cells[-1]:  # some programs end a row with a separator
                del cells[-1]
            why = BAD_COUNT if len(cells) != count else "" if _take(cells, takes, layout.decimal) else NO_NUMBER
            if why and sum(naming(cell)[0] in known for cell in cells) >= min(FEW, len(known)):
                if tuple(cells) != layout.names:
                    raise InputError(
                        f"{path}: row {number} names the columns again, in another way "
                        f"({', '.join(cells)[:80]}...); split the file there"
                    )
                why = AGAIN
            if why and any(cells):
                left[why] += 1
    progress(size, size)
    columns = {
        plain: TextColumn(written, unit, np.frombuffer(values).copy() if len(values) else np.empty(0))
        for (plain, (_, written, unit)), (_, _, values) in zip(places.items(), takes, strict=True)
    }
    return TextTable(columns, left, tuple(name for name in layout.names if naming(name)[0] not in places))


def _take(cells: list[str], takes: "list[tuple[int, Callable[[str], float], array[float]]]", decimal: str) -> bool:
    """Append a row to its columns; False, and nothing appended, where a cell is no number."""
    try:
        row = [
            parse(cells[k] if decimal == "." else cells[k].replace(decimal, ".")) if cells[k] else np.nan
            for k, parse, _ in takes
        ]
    except (ValueError, OverflowError):
        return False
    for (_, _, values), value in zip(takes, row, strict=True):
        values.append(value)
    return True
