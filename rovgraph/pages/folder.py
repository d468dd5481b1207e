"""What pages of results folders share: their end, tables of CSV files, images, and numbers as text."""

from collections.abc import Sequence

import pandas as pd

from rovgraph.pages.about import about_section
from rovgraph.pages.page import render
from rovgraph.pages.parts import Image, Item, Missing, Section, Table, Text
from rovgraph.pages.source import Clock, Source

MOST_ROWS = 60


def rendered(source: Source, title: str, sections: Sequence[Section], clock: Clock | None = None) -> str:
    """The page of a folder, with its configuration, versions and files at the end."""
    note = [Section("version", "Version", [source.other_version])] if source.other_version else []
    time = None
    if clock is not None:
        time = {"unit": clock.unit, "end": (clock.end - clock.start) / clock.scale, "label": clock.label}
    return render(title, [*note, *sections, about_section(source)], time)


def table_of(table: pd.DataFrame, title: str, names: dict[str, str], file: str) -> Table:
    """Columns that have anything, under names a reader knows."""
    known = {column: name for column, name in names.items() if column in table and table[column].notna().any()}
    rows = [tuple(cell(v) for v in row) for row in table[[*known]].head(MOST_ROWS).itertuples(index=False)]
    some = f"The first {MOST_ROWS} of {len(table)} rows. " if len(table) > MOST_ROWS else ""
    return Table(title, [*known.values()], rows, note=f"{some}{file} has more columns.")


def images(source: Source) -> list[Item]:
    """The figures of the folder."""
    return [Image(path.stem.replace("_", " "), path.read_bytes()) for path in sorted(source.folder.glob("*.png"))]


def piece(source: Source, name: str) -> Item:
    """A file that goes into a configuration, as text."""
    text = source.text(name)
    title = "For the configuration"
    return Missing(title, f"{name} is missing") if text is None else Text(title, text, shown=True)


def cell(value: object) -> str:
    """A value as text, "–" where there is none."""
    if value is None or value != value:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return "(" + ", ".join(cell(v) for v in value) + ")"
    return str(value)
