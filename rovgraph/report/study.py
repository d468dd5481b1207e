"""The files and the table of ``rovgraph study misalignment``; docs/studies.md describes their columns."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from rovgraph.lab.misalignment import Study, Tables
from rovgraph.report.folder import STAMP, SUMMARY, versions
from rovgraph.report.results import to_plain

SEEDS = "run r of a cell: 15 hexadecimal digits of SHA-256 of [seed, parameters of the dive, r]; column seed"
MOST_ROWS = 60  # of a table on a terminal


def write_study(folder: Path, tables: Tables, about: Mapping[str, Any]) -> None:
    """Write what is not there already: ``cells.csv`` and ``summary.json``.

    Parameters
    ----------
    folder : of the study, with its runs.csv
    tables : of `rovgraph.lab.misalignment.study`
    about : where and how long it ran
    """
    tables.cells.to_csv(folder / "cells.csv", index=False, float_format="%.7g")
    failed = tables.runs[tables.runs["failure"].notna()]
    summary = {
        **STAMP,
        "study": tables.study.name,
        "seed": tables.study.seed,
        "seeds": SEEDS,
        "cells": len(tables.cells),
        "runs": len(tables.runs),
        "planned": tables.study.runs * len(tables.study.all_cells()),
        "failures": failed[["cell", "run", "failure"]].to_dict("records"),
        **about,
        "versions": versions(),
    }
    text = json.dumps(to_plain(summary), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")


def labels(tables: Tables) -> list[str]:
    """Labels that distinguish the rows of ``cells``: the grid's parameters, and others where they are unusual."""
    usual = _usual(tables)
    return [
        ", ".join(
            said for name in tables.study.varied() if (said := _said(name, row[name])) != usual.get(name)
        ) or "as usual"
        for _, row in tables.cells.iterrows()
    ]  # fmt: skip


def unless_said(tables: Tables) -> str:
    """What `labels` leave out; empty where that is nothing."""
    usual = _usual(tables)
    return "unless said: " + ", ".join(usual.values()) if usual else ""


def _usual(tables: Tables) -> dict[str, str]:
    """What most cells have, of the parameters that differ and are not in the grid."""
    usual = {}
    for name in tables.study.varied():
        said = tables.cells[name].map(lambda value, name=name: _said(name, value)).value_counts()
        if name not in tables.study.grid.model_fields_set and said.iloc[0] > len(tables.cells) / 2:
            usual[name] = str(said.index[0])
    return usual


def _said(name: str, value: object) -> str:
    """A parameter's value as a person reads it."""
    units = {"_mps": " m/s", "_s": " s", "_m": " m", "_deg": "°"}
    tail = next((unit for end, unit in units.items() if name.endswith(end)), "")
    if isinstance(value, bool):
        return name if value else f"no {name}"
    if value is None or value != value:
        return "no fixes" if name == "fix_sd_m" else f"no {name}"
    prefix = {"fix_sd_m": "fixes ", "fix_interval_s": "every ", "prior_sd_deg": "prior ", "prior": "prior "}.get(
        name, ""
    )
    prefix = {"heading_error": "heading ", "heading_error_sd_deg": "by "}.get(name, prefix)
    return prefix + (f"{value:g}{tail}" if isinstance(value, float) else str(value))


def study_table(tables: Tables) -> Table:
    """A row per cell, coverage with its binomial interval first."""
    title = f"{tables.study.name}: {len(tables.runs)} runs of {len(tables.cells)} cells"
    table = Table(title=escape(title), title_justify="left", caption_justify="left", box=SIMPLE_HEAD, padding=0)
    for heading in ("cell", "parameters"):
        table.add_column(heading, no_wrap=heading == "cell")
    for heading in (
        "runs", "coverage\n(of 95 %)", "bias\n[°]", "sd\n[°]", "predicted\n[°]", "predicted\n/ error", "NEES",
        "converged", "track\n[m]", "verdict", "failed",
    ):  # fmt: skip
        table.add_column(escape(heading), justify="right", no_wrap=True)
    for label, (_, row) in list(zip(labels(tables), tables.cells.iterrows(), strict=True))[:MOST_ROWS]:
        table.add_row(str(row["cell"]), escape(label), *(escape(cell) for cell in _cells(row)))
    beyond = len(tables.cells) - MOST_ROWS
    table.caption = (
        "coverage: share of runs whose 95 % interval holds the truth, with the 95 % interval of that share. bias, sd: "
        "of the error. predicted: sd that the estimator states, median. NEES: 1 if consistent, ↑↓ outside its 95 % band"
        + (f"; {beyond} more cells are in cells.csv" if beyond > 0 else "")
        + (f"; {escape(remark)}" if (remark := unless_said(tables)) else "")
    )
    return table


def _cells(row: "pd.Series[Any]") -> list[str]:
    nees, mark = row["nees"], ""
    if nees == nees:
        mark = " ↑" if nees > row["nees_high"] else " ↓" if nees < row["nees_low"] else ""
    coverage = "–"
    if row["coverage"] == row["coverage"]:
        parts = (100 * row[name] for name in ("coverage", "coverage_low", "coverage_high"))
        coverage = "{:.0f} % ({:.0f}–{:.0f})".format(*parts)
    numbers = [_number(row[name]) for name in ("bias_deg", "sd_deg", "predicted_sd_deg", "sd_ratio")]
    converged = "–" if pd.isna(row["converged"]) else f"{100 * row['converged']:.0f} %"
    verdict = "" if pd.isna(row["verdict"]) else str(row["verdict"])
    failed = str(row["failed"]) if row["failed"] else ""
    tail = [_number(nees) + mark, converged, _number(row["track_rms_m"]), verdict, failed]
    return [str(row["runs"]), coverage, *numbers, *tail]


def _number(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3g}"


def plan_table(study: Study) -> Table:
    """The cells of a study before it is run, by what varies among them."""
    varied, cells = study.varied(), study.all_cells()
    table = Table(title=escape(f"{study.name}: {len(cells)} cells of {study.runs} runs"), box=SIMPLE_HEAD, padding=0)
    for heading in ("cell", *varied):
        table.add_column(heading)
    for cell in cells:
        table.add_row(cell.id, *(escape(_said(name, getattr(cell, name))) for name in varied))
    return table
