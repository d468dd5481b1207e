"""A table that is wider than its terminal, as several below each other."""

from collections.abc import Iterator, Sequence

from rich.console import Console
from rich.measure import Measurement
from rich.table import Column, Table


def fitting(table: Table, console: Console) -> Iterator[Table]:
    """The table, or parts of it that fit into the console; each part begins with the first column.

    A part has one more column at least, so that a console narrower than two columns folds it.
    """
    first, *rest = table.columns
    while rest:
        count = len(rest)
        while count > 1 and _width(_part(table, [first, *rest[:count]]), console) > console.width:
            count -= 1
        part = _part(table, [first, *rest[:count]])
        part.title = table.title if len(rest) == len(table.columns) - 1 else None
        rest = rest[count:]
        part.caption = None if rest else table.caption
        yield part


def _width(table: Table, console: Console) -> int:
    return Measurement.get(console, console.options.update(width=10_000), table).maximum


def _part(table: Table, columns: Sequence[Column]) -> Table:
    part = Table(box=table.box, padding=table.padding, show_edge=table.show_edge)
    part.title_justify, part.caption_justify = table.title_justify, table.caption_justify
    for column in columns:
        part.add_column(column.header, justify=column.justify, no_wrap=column.no_wrap)
    for row, cells in zip(table.rows, zip(*(column.cells for column in columns), strict=True), strict=True):
        part.add_row(*cells, style=row.style, end_section=row.end_section)
    return part
