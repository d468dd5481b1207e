"""Files and tables of compare, study, observe and plan.

docs/compare.md, docs/studies.md and docs/observability.md describe their columns.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from rovgraph.inference.observability import OBSERVABLE, OBSERVABLE_BELOW, UNOBSERVABLE_ABOVE
from rovgraph.lab.compare import Comparison
from rovgraph.lab.crosslines import CrosslinePlan
from rovgraph.lab.misalignment import Study, Tables
from rovgraph.lab.observability import OTHER_LABELS, Observability, directions, in_words
from rovgraph.lab.plan import Plan
from rovgraph.log.units import shown
from rovgraph.model.config import Config
from rovgraph.report.folder import STAMP, SUMMARY, versions
from rovgraph.report.results import to_plain
from rovgraph.report.units import label_with_unit, plus_minus

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
    """What tells each row of ``cells`` from the others: the grid's parameters, and others where they are unusual."""
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
        table.add_row(str(row["cell"]), escape(label), *(escape(cell) for cell in _study_cells(row)))
    beyond = len(tables.cells) - MOST_ROWS
    table.caption = (
        "coverage: share of runs whose 95 % interval holds the truth, with the 95 % interval of that share. bias, sd: "
        "of the error. predicted: sd that the estimator states, median. NEES: 1 if consistent, ↑↓ outside its 95 % band"
        + (f"; {beyond} more cells are in cells.csv" if beyond > 0 else "")
        + (f"; {escape(remark)}" if (remark := unless_said(tables)) else "")
    )
    return table


def _study_cells(row: "pd.Series[Any]") -> list[str]:
    nees, mark = row["nees"], ""
    if nees == nees:
        mark = " ↑" if nees > row["nees_high"] else " ↓" if nees < row["nees_low"] else ""
    coverage = "–"
    if row["coverage"] == row["coverage"]:
        parts = (100 * row[name] for name in ("coverage", "coverage_low", "coverage_high"))
        coverage = "{:.0f} % ({:.0f}–{:.0f})".format(*parts)
    numbers = [_study_number(row[name]) for name in ("bias_deg", "sd_deg", "predicted_sd_deg", "sd_ratio")]
    converged = "–" if pd.isna(row["converged"]) else f"{100 * row['converged']:.0f} %"
    verdict = "" if pd.isna(row["verdict"]) else str(row["verdict"])
    failed = str(row["failed"]) if row["failed"] else ""
    tail = [_study_number(nees) + mark, converged, _study_number(row["track_rms_m"]), verdict, failed]
    return [str(row["runs"]), coverage, *numbers, *tail]


def _study_number(value: float) -> str:
    return "–" if pd.isna(value) else f"{value:.3g}"


def study_plan_table(study: Study) -> Table:
    """The cells of a study before it is run, by what varies among them."""
    varied, cells = study.varied(), study.all_cells()
    table = Table(title=escape(f"{study.name}: {len(cells)} cells of {study.runs} runs"), box=SIMPLE_HEAD, padding=0)
    for heading in ("cell", *varied):
        table.add_column(heading)
    for cell in cells:
        table.add_row(cell.id, *(escape(_said(name, getattr(cell, name))) for name in varied))
    return table


OBSERVABILITY, PLAN = "observability.json", "plan.json"
TOLD = 12  # correlations in the table's caption


def write_observability(
    folder: Path,
    seen: Observability,
    config: Config,
    about: Mapping[str, Any],
    crosslines: CrosslinePlan | None = None,
) -> None:
    """Write every file of ``rovgraph observe`` but the figures.

    Parameters
    ----------
    folder : an existing folder, such as `results_folder` yields
    seen : of `rovgraph.lab.observability.observe`
    config : what was believed
    about : what it was made of, for summary.json
    crosslines : what they would show of the track's drift, if that was asked
    """
    content = observability_as_dict(seen)
    if crosslines is not None:
        about = {**about, "crosslines": crosslines_as_dict(crosslines)}
    _write(folder / OBSERVABILITY, {**STAMP, **about, **content})
    verdicts = {label: entry["verdict"] for label, entry in content["components"].items()}
    _write(folder / SUMMARY, {**STAMP, **about, "verdicts": verdicts, "in_words": content["in_words"]})
    (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")


def observability_as_dict(seen: Observability) -> dict[str, Any]:
    """What observability.json holds; matrices in the units of the program, radians for angles."""
    weakest = directions(seen.information)
    components = {
        label: {
            "unit": seen.variables[i].unit,
            "prior_sd": seen.prior_sd[i],
            "sd": seen.sd[i],
            "claimed_sd": seen.claimed_sd[i],
            "ratio": seen.ratio[i],
            "bits": seen.bits[i],
            "verdict": seen.verdicts[i],
            "missing": "" if seen.verdicts[i] == OBSERVABLE else seen.variables[i].excited_by,
        }
        for i, label in enumerate(seen.labels)
    }
    return {
        "thresholds": {"observable_below": OBSERVABLE_BELOW, "unobservable_above": UNOBSERVABLE_ABOVE},
        "components": components,
        "joint_bits": seen.joint_bits,
        "in_words": words(seen),
        "correlated": [{"of": a, "with": b, "correlation": rho} for a, b, rho in seen.correlated()],
        "correlation": {"rows": seen.labels, "columns": [*seen.labels, *OTHER_LABELS], "values": seen.correlation},
        "covariance": seen.covariance,
        "information_in_prior_sd": seen.information,
        "directions": [
            {"ratio": ratio, "axis_in_prior_sd": axis} for ratio, axis in zip(weakest.ratio, weakest.axes, strict=True)
        ],
        "history": {"time_s": seen.time, "sd": seen.relative * seen.prior_sd},
    }


def words(seen: Observability) -> list[str]:
    """What cannot be known, a sentence each."""
    return in_words(seen.information, seen.labels, [v.unit for v in seen.variables], seen.prior_sd)


def observability_table(seen: Observability, title: str) -> Table:
    """A row per component: sd before and after, bits, verdict, and what is missing."""
    table = Table(
        title=escape(title),
        title_justify="left",
        caption_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
        padding=0,
    )
    for heading in ("variable", "prior sd", "sd", "bits", "verdict", "needs"):
        numbers = heading in ("prior sd", "sd", "bits")
        table.add_column(heading, justify="right" if numbers else "left", no_wrap=heading != "needs")
    for i, (label, variable, verdict) in enumerate(zip(seen.labels, seen.variables, seen.verdicts, strict=True)):
        factor = shown(variable.unit)[0]
        name = label_with_unit(label, variable.unit)
        cells = (f"{factor * seen.prior_sd[i]:.3g}", f"{factor * seen.sd[i]:.3g}", f"{seen.bits[i]:.2f}")
        missing = "" if verdict == OBSERVABLE else variable.excited_by
        table.add_row(escape(name), *cells, verdict, escape(missing), style="" if verdict == OBSERVABLE else "bold")
    pairs = ", ".join(f"{a} with {b} {rho:+.2f}" for a, b, rho in seen.correlated()[:TOLD])
    table.caption = f"{seen.joint_bits:.1f} bits in all. Correlations beyond 0.5: {pairs or 'none'}"
    return table


def crosslines_as_dict(plan: CrosslinePlan) -> dict[str, Any]:
    """What observability.json, plan.json and summary.json hold of crosslines."""
    return {
        "lines": int(plan.survey.parallel.sum()),
        "course_deg": np.round(np.rad2deg(plan.survey.course)) % 360.0,
        "lines_m": plan.survey.legs,
        "speed_mps": plan.survey.speed,
        "relief_sd_m": plan.relief.sd,
        "relief_length_m": plan.relief.length,
        "noise_m": plan.relief.noise,
        "in_words": crosslines_in_words(plan),
        "ranking": [
            {
                "along_m": c.along,
                "ends_m": plan.survey.crosslines(c.along),
                "duration_s": c.duration,
                "crossings": c.crossings,
                "sd_m": c.sd,
                "shape_sd_m": c.shape_sd,
            }
            for c in plan.ranked
        ],
    }


CROSSLINES = ("crosslines", "along the lines [m]", "minutes", "crossings", "sd [m]", "sd of the shape [m]")
HELPS, ENOUGH = 0.9, 0.75  # share of the sd that crosslines leave, and of what most of them would take off it


def crosslines_table(plan: CrosslinePlan) -> Table:
    """A row per number of crosslines."""
    content = crosslines_as_dict(plan)
    title = f"crosslines after {content['lines']} lines towards {content['course_deg']:.0f}°"
    table = Table(title=escape(title), title_justify="left", box=SIMPLE_HEAD, show_edge=False, padding=0)
    for heading in CROSSLINES:
        table.add_column(escape(heading), justify="right")
    for row in crosslines_rows(content["ranking"]):
        table.add_row(*row)
    return table


def crosslines_rows(ranking: Sequence[Mapping[str, Any]]) -> list[tuple[str, ...]]:
    """Cells under `CROSSLINES`, of the ranking in summary.json."""
    return [
        (
            str(len(c["along_m"]) or "none"),
            ", ".join(f"{a:.0f}" for a in c["along_m"]),
            f"{c['duration_s'] / 60.0:.0f}" if len(c["along_m"]) else "",
            str(c["crossings"]),
            f"{c['sd_m']:.2f}",
            f"{c['shape_sd_m']:.2f}",
        )
        for c in ranking
    ]


def crosslines_in_words(plan: CrosslinePlan) -> list[str]:
    """What they would leave, and what not, a sentence each."""
    relief = plan.relief
    if len(plan.ranked) == 1:
        noise = f"the bottom shows no relief above the noise of its soundings, {relief.noise:.2f} m"
        return [f"Crosslines would show nothing: {noise}"]
    before, *after = plan.ranked
    if after[-1].crossings <= before.crossings:
        return ["Crosslines would show nothing: their shift is too uncertain to look for, or they cross too little"]
    some = next(c for c in after if before.sd - c.sd >= ENOUGH * (before.sd - min(x.sd for x in after)))
    north, east = np.round(plan.survey.corner) + 0.0
    count = {1: "One crossline", 2: "Two crosslines", 4: "Four crosslines"}[len(some.along)]
    where = ", ".join(f"{a:.0f}" for a in some.along)
    become = f"the survey's horizontal sd from {before.sd:.2f} m to {some.sd:.2f} m in {some.duration / 60.0:.0f} min"
    answer = f"{count}, {where} m along the lines from {north:.0f} m north, {east:.0f} m east, would bring {become}"
    if some.sd > HELPS * before.sd:
        answer = f"Crosslines would hardly help: {answer[0].lower()}{answer[1:]}"
    known = f"relief of {relief.sd:.2f} m over {relief.length:.1f} m and soundings of {relief.noise:.2f} m"
    return [
        answer,
        f"That holds if all crossings match, by {'a' if np.isfinite(relief.gain) else 'an assumed'} {known}; "
        "graph.crossovers: true matches them",
        "No crossline shows a shift, a rotation or a scale of the whole survey; these need position fixes. What is "
        f"left without them, the shape, goes from {before.shape_sd:.2f} m to {some.shape_sd:.2f} m",
    ]


def write_plan(
    folder: Path, plan: Plan | None, config: Config, about: Mapping[str, Any], crosslines: CrosslinePlan | None = None
) -> None:
    """Write every file of ``rovgraph plan`` but the figures; parameters as of `write_observability`."""
    content = {**STAMP, **about, **({} if plan is None else plan_as_dict(plan))}
    content |= {} if crosslines is None else {"crosslines": crosslines_as_dict(crosslines)}
    for name in (PLAN, SUMMARY):
        _write(folder / name, content)
    (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")


def plan_as_dict(plan: Plan) -> dict[str, Any]:
    """What plan.json and summary.json hold of manoeuvres."""
    ranking = [
        {
            "manoeuvre": p.manoeuvre.name,
            "speed_mps": p.manoeuvre.speed,
            "score": score,
            "bits": p.bits,
            "sd": dict(zip(plan.labels, p.sd.tolist(), strict=True)),
        }
        for p, score in zip(plan.ranked, plan.scores, strict=True)
    ]
    before = dict(zip(plan.labels, plan.before.tolist(), strict=True))
    return {"goals": plan.goals, "sd_before": before, "ranking": ranking}


def plan_table(plan: Plan, title: str) -> Table:
    """A row per manoeuvre, the best first, with the sd of what is aimed at."""
    table = Table(title=escape(title), title_justify="left", caption_justify="left", box=SIMPLE_HEAD)
    table.add_column("manoeuvre")
    table.add_column("bits", justify="right")
    columns = plan.selected
    for i in columns:
        unit = shown(plan.units[i])[1]
        table.add_column(escape(plan.labels[i] + (f"\n[{unit}]" if unit != "1" else "")), justify="right")
    table.add_row("as known before", "", *(f"{shown(plan.units[i])[0] * plan.before[i]:.3g}" for i in columns))
    table.add_section()
    for p in plan.ranked:
        sds = (f"{shown(plan.units[i])[0] * p.sd[i]:.3g}" for i in columns)
        table.add_row(escape(str(p.manoeuvre)), f"{p.bits:.1f}", *sds)
    if plan.goals:
        best = float(np.min(plan.scores))
        reached = "reaches the goal" if best <= 1.0 else f"leaves {best:.2g} times the goal"
        table.caption = f"{plan.ranked[0].manoeuvre} {reached}"
    return table


def _write(path: Path, content: Mapping[str, Any]) -> None:
    text = json.dumps(to_plain(content), indent=2, allow_nan=False, ensure_ascii=False)
    path.write_text(text + "\n", encoding="utf-8")
