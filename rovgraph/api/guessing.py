"""A mapping of the columns of anyone's table: what ``rovgraph convert --guess`` proposes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rovgraph.config import Config, TableSettings, parse_config
from rovgraph.errors import InputError, as_path
from rovgraph.interchange.formats import head_of, recognise
from rovgraph.interchange.guessing.groups import ColumnGuess
from rovgraph.interchange.guessing.imu import POINTS_UP
from rovgraph.interchange.guessing.table import guess_table
from rovgraph.interchange.own_log import FORMAT as OWN_LOG
from rovgraph.interchange.unknown import purpose
from rovgraph.log.units import groups, quantities
from rovgraph.tables import read_table

REASONS = {
    "imu": POINTS_UP,
    "dvl": "its axes point forward, to port and up by their names",
    "angles": "counts anticlockwise by the gyro, and its name says ENU",
    "times": "day and month may be exchanged: both orders are possible",
}


@dataclass(frozen=True)
class Guess:
    """A mapping of the columns of a table, to be confirmed.

    Attributes
    ----------
    source : the file
    columns : what each column may be, in the order of the file; of these, the unsure ones are not proposed
    left : column -> why it feeds nothing
    settings : of a configuration, that names or numbers show: mountings, how headings count, the order of dates
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
        return proposal([self])

    def save(self, path: Path | str, force: bool = False) -> Path:
        """Write the configuration.

        Raises
        ------
        InputError : the file exists and ``force`` is not given, or cannot be written
        """
        return save_proposal([self], path, force)


def proposal(guesses: Sequence[Guess]) -> str:
    """The configuration that one table's guess, or those of several, propose, as YAML; several stand under ``files``.

    Mountings hold for all tables; those of the first one take precedence.
    """
    from rovgraph.report.conversion import commented_yaml

    sections: dict[str, Any] = {}
    reasons: dict[str, str] = {}
    for guess in guesses:
        own: dict[str, Any] = {"columns": guess.mapping, "units": guess.units}
        above = f"files.{Path(guess.source).name}." if len(guesses) > 1 else ""
        reasons |= {f"{above}columns.{each.field}": f"{each.sureness}: {each.why}" for each in guess.proposed}
        for section, keys in guess.settings.items():
            of_table = section in TableSettings.model_fields
            (own if of_table else sections).setdefault(section, {}).update(keys)
            reasons |= {f"{above if of_table else ''}{section}.{key}": REASONS[section] for key in keys}
        stated = {name: section for name, section in own.items() if section}
        if len(guesses) > 1:
            sections.setdefault("files", {})[Path(guess.source).name] = stated
        else:
            sections = stated | sections
    text = commented_yaml(sections, reasons) if sections else ""
    unsure = [each for guess in guesses for each in guess.columns if each.sureness == "unsure"]
    lines = [f"# unsure: {each.field}: {_one_line(each.column)}  ({each.why})" for each in unsure]
    return text + "".join(f"{line}\n" for line in lines)


def save_proposal(guesses: Sequence[Guess], path: Path | str, force: bool = False) -> Path:
    """Write the configuration that `proposal` gives.

    Raises
    ------
    InputError : the file exists and ``force`` is not given, or cannot be written
    """
    from rovgraph.report.folder import results_files

    path = as_path(path, "path")
    if any(path.resolve() == Path(guess.source).resolve() for guess in guesses):
        raise InputError(f"{path} is the file that is read; choose another name")
    names = ", ".join(_one_line(Path(guess.source).name) for guess in guesses)
    with results_files([path], force) as (temporary,):
        temporary.write_text(f"# Proposed for {names}: confirm each line\n" + proposal(guesses), encoding="utf-8")
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

    Warns
    -----
    DataWarning : how the table was read, where it is not written as a log of this program
    """
    path = as_path(path, "path")
    head = head_of(path)
    format_ = recognise(path)
    if format_ is not None and format_ is not OWN_LOG:
        raise InputError(f"{path}: is a {format_.title}, whose columns are known; convert it without a guess")
    if what := purpose(path, head):
        raise InputError(f"{path}: {what}")
    table = read_table(path)
    found = guess_table(table)
    table.warn_how()
    return Guess(str(path), tuple(found.columns), found.left, found.settings, tuple(found.notes))


def _one_line(text: str) -> str:
    """A text as it may stand in a comment."""
    return "".join(letter if letter.isprintable() else "?" for letter in " ".join(text.split()))
