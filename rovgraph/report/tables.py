"""Tables that a command prints; a table wider than its terminal is split into several below each other."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Column, Table

from rovgraph.inference.estimate import CalibrationEstimate, Estimate
from rovgraph.inference.observability import UNOBSERVABLE
from rovgraph.log.units import shown
from rovgraph.report.results import main_first, narrowing
from rovgraph.report.units import duration, label_with_unit, percent, plus_minus


def summary_table(estimates: Sequence[Estimate], summary: Mapping[str, Any]) -> Table:
    """How long, how far, where it ended and how the sensors fitted; a column per estimate.

    Parameters
    ----------
    estimates : as given to `write_results`
    summary : what `write_results` returned
    """
    kinds = [e.kind for e in main_first(estimates)]
    table = Table(
        title=escape(f"{summary['name']}: {summary['log']}"),
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
    )
    table.add_column("")
    for kind in kinds:
        table.add_column(kind.replace("_", " "), justify="right", no_wrap=True)
    numbers = [summary["estimates"][kind] for kind in kinds]
    table.add_row("duration", *(duration(n["duration_s"]) for n in numbers))
    table.add_row("distance", *(f"{_number(n['distance_m']):.1f} m" for n in numbers))
    for name in ("north", "east", "down"):
        table.add_row(f"end {name}", *(_end(n["end"], name, "m") for n in numbers))
    table.add_row("end heading", *(_end(n["end"], "heading", "deg") for n in numbers))
    table.add_row("end 99 % ellipse, semi-axes", *(_ellipse(n["end"]) for n in numbers), end_section=True)
    sensors = list(dict.fromkeys(s for n in numbers for s in n["sensors"]))
    for sensor in sensors:
        table.add_row(sensor, *(_counts(n["sensors"].get(sensor)) for n in numbers))
    if sensors:
        table.caption = "sensors: used / rejected / mean square of the innovations, 1 where the noise is as stated"
    return table


def calibration_table(estimates: Sequence[Estimate], verbose: bool = False) -> Table:
    """Calibration of the leading estimate beside its prior; names of what is held at 0 only where ``verbose``."""
    main = main_first(estimates)[0]
    table = Table(
        title=f"calibration, {main.kind.replace('_', ' ')}",
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
        padding=0,
    )
    for heading in ("variable", "value ± sd", "prior ± sd", "left", "verdict"):  # 80 columns hold the longest of each
        table.add_column(heading, justify="left" if heading in ("variable", "verdict") else "right", no_wrap=True)
    silent = [e for e in main.calibration if not e.estimated and e.value == 0.0 and e.sd == 0.0]
    shown = [e for e in main.calibration if e not in silent]
    for entry in sorted(shown, key=lambda e: not e.estimated):
        name = label_with_unit(entry.label, entry.unit)
        table.add_row(escape(name), *_calibration_cells(entry), style="" if entry.estimated else "dim")
    notes = ["left: sd in percent of the prior's"] if any(e.estimated for e in shown) else []
    if silent:
        held = f"{len(silent)} calibration {'constant is' if len(silent) == 1 else 'constants are'} held at 0"
        notes.append(f"{held}: {', '.join(e.label for e in silent)}" if verbose else f"{held} (--verbose lists them)")
    if any(e.verdict == UNOBSERVABLE for e in main.calibration):
        notes.append("unobservable: this dive says little about it, the value is mostly the prior (rovgraph observe)")
    table.caption = "\n".join(notes) or None
    return table


def _calibration_cells(entry: CalibrationEstimate) -> tuple[str, str, str, str]:
    factor = shown(entry.unit)[0]
    value, sd, mean, prior_sd = (factor * x for x in (entry.value, entry.sd, entry.prior_mean, entry.prior_sd))
    if not entry.estimated:
        return plus_minus(value, sd), "", "", "considered" if sd > 0.0 else "held"
    ratio = narrowing(entry)
    narrowed = "unknown" if not np.isfinite(ratio) else percent(ratio)
    return plus_minus(value, sd), plus_minus(mean, prior_sd), narrowed, entry.verdict


def _number(value: float | None) -> float:
    return float("nan") if value is None else value


def _end(end: Mapping[str, Any], name: str, unit: str) -> str:
    return plus_minus(_number(end[f"{name}_{unit}"]), _number(end[f"{name}_sd_{unit}"]), unit)


def _ellipse(end: Mapping[str, Any]) -> str:
    major, minor = end["ellipse99_major_m"], end["ellipse99_minor_m"]
    return "unknown" if major is None or minor is None else f"{major:.3g} × {minor:.3g} m"


def _counts(sensor: Mapping[str, Any] | None) -> str:
    if sensor is None:
        return "–"
    fit = sensor["mean_square_normalised"]
    return f"{sensor['used']} / {sensor['rejected']} / {'–' if fit is None else f'{fit:.2f}'}"


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
