"""The rows of a study on disk, as they come: what an interrupted study goes on from."""

import contextlib
import csv
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from rovgraph.errors import InputError


class Ledger:
    """A CSV file to which rows are added, each on disk before the next.

    Parameters
    ----------
    path : of the file; where it is not, it is made with its header
    columns : of the file
    order : columns that a row is found by

    Raises
    ------
    InputError : the file cannot be read or written, or has other columns
    """

    def __init__(self, path: Path, columns: Sequence[str], order: Sequence[str]) -> None:
        self.path, self.columns, self.order = path, list(columns), list(order)
        if path.exists():
            self._mend()
        else:
            self._write(pd.DataFrame(columns=pd.Index(self.columns)))

    def _mend(self) -> None:
        """Cut off a row that was not written to its end."""
        with kept_so_far(self.path), self.path.open("rb+") as file:
            content = file.read()
            file.truncate(content.rfind(b"\n") + 1)

    def add(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Append rows; what a column lacks is left empty."""
        with kept_so_far(self.path), self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns, lineterminator="\n")
            writer.writerows(rows)
            file.flush()

    def read(self) -> pd.DataFrame:
        """All rows, each once."""
        with kept_so_far(self.path):
            try:
                frame = pd.read_csv(self.path, engine="python", dtype={"cell": str})  # floats exactly as written
            except ValueError as error:
                raise InputError(f"{self.path}: not what a study wrote ({str(error).splitlines()[0]})") from None
        if list(frame) != self.columns:
            raise InputError(f"{self.path}: not what this version of rovgraph wrote; choose another --out")
        return frame.drop_duplicates(self.order, keep="last")

    def settle(self, cells: Sequence[str]) -> pd.DataFrame:
        """Write all rows in their order, and return them; ``cells`` are ids in the order of the study."""
        rank = {cell: i for i, cell in enumerate(cells)}
        frame = self.read().sort_values(
            self.order, key=lambda c: c.map(rank) if c.name == "cell" else c, kind="stable", ignore_index=True
        )
        self._write(frame)
        return frame

    def _write(self, frame: pd.DataFrame) -> None:
        fresh = self.path.with_suffix(".new")
        with kept_so_far(self.path):
            frame.to_csv(fresh, index=False)
            fresh.replace(self.path)


@contextlib.contextmanager
def kept_so_far(path: Path) -> Iterator[None]:
    """Turn an error of the file system into an `InputError` that says how to go on."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"{path}: {reason}; what was written before is kept, --resume goes on") from None
