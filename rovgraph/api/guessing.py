"""A mapping of the columns of anyone's table: what ``rovgraph convert --guess`` proposes."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rovgraph.config import Config, parse_config
from rovgraph.errors import InputError, as_path
from rovgraph.interchange.formats import head_of, recognise
from rovgraph.interchange.guessing.groups import ColumnGuess
from rovgraph.interchange.guessing.imu import POINTS_UP
from rovgraph.interchange.guessing.table import guess_table
from rovgraph.interchange.own_log import FORMAT as OWN_LOG
from rovgraph.interchange.unknown import purpose
from rovgraph.log.units import groups, quantities
from rovgraph.tables import read_table


@dataclass(frozen=True)
class Guess:
    """A mapping of the columns of a table, to be confirmed.

    Attributes
    ----------
    source : the file
    columns : what each column may be, in the order of the file; of these, the unsure ones are not proposed
    left : column -> why it feeds nothing
    settings : of a configuration, that the numbers show: the mounting of an IMU whose z axis points up
    notes : a sentence each
    """

    source: str
    columns: tuple[ColumnGuess, ...]
    left: Mapping[str, str]
    settings: Mapping[str, Any]
    notes: tuple[str, ...]

    @property
    def proposed(self) -> tuple[ColumnGuess, ...]:
        """The columns that are sure or likely."""
        return tuple(each for each in self.columns if each.sureness != "unsure")

    @property
    def mapping(self) -> dict[str, str]:
        """Column of a log -> the file's column, as a configuration's ``columns`` has it, but for equal names."""
        return {each.field: each.column for each in self.proposed if each.field != each.column}

    @property
    def units(self) -> dict[str, str]:
        """Group or column -> unit, as a configuration's ``units`` has it."""
        kinds = quantities()
        known = {each.field: each.unit for each in self.proposed if each.unit and each.field in kinds}
        out: dict[str, str] = {}
        for group, members in groups().items():
            units = {field: known[field] for field in members if field in known}
            same = len(set(units.values())) == 1 and len({kinds[field] for field in units}) == 1
            out |= {group: next(iter(units.values()))} if same else units
        return out

    @property
    def config(self) -> Config:
        """The configuration that is proposed."""
        return parse_config(self.to_yaml(), f"guess of {self.source}")

    def to_yaml(self) -> str:
        """``columns`` and ``units`` for a configuration, and settings; unsure columns are comments."""
        from rovgraph.report.conversion import commented_yaml

        reasons = {f"columns.{each.field}": f"{each.sureness}: {each.why}" for each in self.proposed}
        reasons |= {f"{section}.{key}": POINTS_UP for section, keys in self.settings.items() for key in keys}
        sections: dict[str, Any] = {"columns": self.mapping, "units": self.units, **self.settings}
        stated = {name: section for name, section in sections.items() if section}
        text = commented_yaml(stated, reasons) if stated else ""
        unsure = [each for each in self.columns if each.sureness == "unsure"]
        lines = [f"# unsure: {each.field}: {_one_line(each.column)}  ({each.why})" for each in unsure]
        return text + "".join(f"{line}\n" for line in lines)

    def save(self, path: Path | str, force: bool = False) -> Path:
        """Write the configuration.

        Raises
        ------
        InputError : the file exists and ``force`` is not given, or cannot be written
        """
        from rovgraph.report.folder import results_files

        path = as_path(path, "path")
        if path.resolve() == Path(self.source).resolve():
            raise InputError(f"{path} is the file that is read; choose another name")
        head = f"# Proposed for {_one_line(Path(self.source).name)}: confirm each line\n"
        with results_files([path], force) as (temporary,):
            temporary.write_text(head + self.to_yaml(), encoding="utf-8")
        return path


def guess_columns(path: Path | str) -> Guess:
    """Propose how the columns of anyone's table map to those of a log, by names, ranges and physics.

    Parameters
    ----------
    path : CSV, gzipped CSV or Parquet

    Returns
    -------
    Guess : ``.columns`` with reasons, ``.to_yaml()`` for a configuration; confirm it, and check the log with it

    Raises
    ------
    InputError : no table, no names of columns, no time, or a native file, which needs no mapping
    """
    path = as_path(path, "path")
    head = head_of(path)
    format_ = recognise(path)
    if format_ is not None and format_ is not OWN_LOG:
        raise InputError(f"{path}: is a {format_.title}, whose columns are known; convert it without a guess")
    if what := purpose(path, head):
        raise InputError(f"{path}: {what}")
    found = guess_table(read_table(path))
    return Guess(str(path), tuple(found.columns), found.left, found.settings, tuple(found.notes))


def _one_line(text: str) -> str:
    """A text as it may stand in a comment."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))
