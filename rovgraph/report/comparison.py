"""The files and the table of ``rovgraph compare``; docs/compare.md describes their columns."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from rovgraph.lab.compare import Comparison
from rovgraph.report.folder import STAMP, SUMMARY, versions
from rovgraph.report.results import to_plain
from rovgraph.report.units import plus_minus

DIGITS = "%.7g"
MARKS = {"above": "↑", "below": "↓", "within": " "}  # of a mean NEES against its band


def write_comparison(folder: Path, comparison: Comparison, about: Mapping[str, Any]) -> None:
    """Write every file but the figures.

    Parameters
    ----------
    folder : an existing folder, such as `results_folder` yields
    comparison : of `rovgraph.lab.compare.compare`
    about : what it was made of and how long it took, for summary.json
    """
    tables = {
        "table": comparison.table,
        "runs": comparison.runs,
        "misalignment": comparison.misalignment,
        "velocity": comparison.velocity,
    }
    for name, frame in tables.items():
        if len(frame):
            frame.to_csv(folder / f"{name}.csv", index=False, float_format=DIGITS)
    (folder / "config.yaml").write_text(comparison.config.to_yaml(), encoding="utf-8")
    failed = comparison.runs[comparison.runs["error"].notna()]
    summary = {
        **STAMP,
        **about,
        "estimators": comparison.table["estimator"].tolist(),
        "failures": failed[["run", "estimator", "error"]].to_dict("records"),
        "versions": versions(),
        "config": comparison.config.model_dump(mode="json"),
    }
    text = json.dumps(to_plain(summary), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / SUMMARY).write_text(text + "\n", encoding="utf-8")


def comparison_table(comparison: Comparison, title: str, thesis: bool) -> Table:
    """A row per estimator, 120 columns wide; `rovgraph.report.tables` fits it into fewer.

    Parameters
    ----------
    comparison : of `rovgraph.lab.compare.compare`
    title : what was compared on what
    thesis : show the thesis's end errors beside ours
    """
    table = Table(title=escape(title), title_justify="left", caption_justify="left", box=SIMPLE_HEAD, padding=0)
    table.add_column("estimator", no_wrap=True)
    headings = ["end error\n[m]", *(["thesis\n[m]"] if thesis else []), "rms\n[m]", "heading\n[°]", "vel.\n[mm/s]"]
    for heading in [*headings, "NEES", "in\n99 %", "DVL\nfit", "misalign-\nment [°]", "failed", "cost\n[ms/s]"]:
        table.add_column(escape(heading), justify="right", no_wrap=True)
    family = ""
    for _, row in comparison.table.iterrows():
        if family and row["family"] != family:
            table.add_section()
        family = str(row["family"])
        table.add_row(*_cells(row, thesis))
    table.caption = (
        "end error: mean ± sd over runs. rms, heading, velocity: along the track. NEES: at the end, 2 if consistent, "
        "↑↓ outside the 95 % band of its mean. in 99 %: ends inside their ellipse. DVL fit: mean NIS / dimension, "
        "in () mean square of residuals. misalignment: mean error of the DVL's yaw, where the truth is unknown its "
        "mean beyond the mounting, ± stated sd. cost: processor time per second of log"
    )
    return table


def _cells(row: "pd.Series[Any]", thesis: bool) -> list[str]:
    numbers = [_spread(row["end_mean_m"], row["end_sd_m"]), *([_number(row["thesis_end_mean_m"])] if thesis else [])]
    numbers += [_number(row["rms_m"]), _number(row["heading_rms_deg"]), _number(1e3 * row["velocity_rms_mps"])]
    nees = f"{_number(row['nees_end_mean'])} {MARKS.get(row['nees_end_band'], ' ')}"
    failed = f"{round(row['failed'] * row['runs'])}/{row['runs']}" if row["failed"] else ""
    consistency = [nees.rstrip() or "–", _share(row["inside_end"]), _dvl_fit(row), _misalignment(row)]
    return [escape(str(row["estimator"])), *numbers, *consistency, failed, _number(1e3 * row["cpu_per_s"])]


def _number(value: float) -> str:
    """Three digits, as short as they can be."""
    if pd.isna(value):
        return "–"
    if abs(value) >= 1e5:
        return f"{value:.0e}"
    return f"{value:.0f}" if abs(value) >= 100 else f"{value:.3g}"


def _spread(mean: float, sd: float) -> str:
    return _number(mean) if pd.isna(sd) or pd.isna(mean) else plus_minus(mean, sd)


def _share(value: float) -> str:
    return "–" if pd.isna(value) else f"{100 * value:.0f} %"


def _dvl_fit(row: "pd.Series[Any]") -> str:
    if not pd.isna(nis := row.get("nis_dvl", float("nan"))):
        return _number(nis)
    fit = row.get("fit_dvl", float("nan"))
    return "–" if pd.isna(fit) else f"({_number(fit)})"


def _misalignment(row: "pd.Series[Any]") -> str:
    mean, error = row.get("misalignment_mean_deg", float("nan")), row.get("misalignment_error_mean_deg", float("nan"))
    value = mean if pd.isna(error) else error
    return "" if pd.isna(value) else plus_minus(value, row["misalignment_sd_deg"])
