"""Pages of `compare`, `study`, `observe`, `plan` and `calibrate`, from their results folders."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.pages.about import about_section
from rovgraph.pages.calibration import sentence, unit_of
from rovgraph.pages.page import render
from rovgraph.pages.parts import Image, Item, Missing, Panel, Section, Table, Text, Trace, bars, line, points
from rovgraph.pages.source import Clock, Source
from rovgraph.pages.thinning import extremes
from rovgraph.report.units import label_with_unit
from rovgraph.units import behind, shown

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#7B3294", "#A3206B", "#333333", "#8C6D00", "#56808F")
MOST_ROWS = 60
DEAD_RECKONING = "dead-reckoning"
OF_ESTIMATOR = {  # column of table.csv -> what a reader calls it
    "estimator": "estimator",
    "rms_m": "rms error [m]",
    "end_mean_m": "error at the end [m]",
    "end_sd_m": "its sd over runs [m]",
    "max_m": "largest error [m]",
    "heading_rms_deg": "heading, rms [°]",
    "velocity_rms_mps": "velocity, rms [m/s]",
    "nees_mean": "NEES",
    "nees_end_mean": "NEES at the end",
    "nees_end_band": "its band",
    "misalignment_error_rms_deg": "misalignment, rms error [°]",
    "runs": "runs",
    "failed": "failed",
    "about": "what it is",
}
OF_CELL = {  # column of cells.csv -> what a reader calls it
    "rms_deg": "rms error [°]",
    "bias_deg": "bias [°]",
    "sd_deg": "sd of the error [°]",
    "predicted_sd_deg": "predicted sd [°]",
    "coverage": "share within 95 %",
    "nees": "NEES",
    "verdict": "verdict",
    "time_to_1deg_s": "1° after [s]",
    "track_rms_m": "track, rms error [m]",
    "track_rms_held_m": "the same, misalignment held [m]",
    "runs": "runs",
    "failed": "failed",
}
OF_TIMING = {  # key of a timing -> what a reader calls it
    "sensor": "sensor",
    "count": "measurements",
    "rate": "rate [Hz]",
    "first": "first [s]",
    "last": "last [s]",
    "gap": "longest gap [s]",
    "gap_at": "gap begins at [s]",
    "jitter": "jitter [s]",
    "repeats": "repeated values",
}
OF_RUN = {  # column of runs.csv -> what a reader calls it
    "run": "run",
    "estimator": "estimator",
    "rms_m": "rms error [m]",
    "end_m": "error at the end [m]",
    "max_m": "largest error [m]",
    "heading_rms_deg": "heading, rms [°]",
    "velocity_rms_mps": "velocity, rms [m/s]",
    "nees": "NEES",
    "error": "why it failed",
}


def study_page_of(source: Source) -> Callable[[Source], str] | None:
    """What makes the page of a folder that is no dive's; None where there is none."""
    summary = source.summary
    if summary.get("calibration") in ("noise", "magnetometer"):
        return noise_page if summary["calibration"] == "noise" else magnetometer_page
    for key, maker in (
        ("estimators", compare_page),
        ("study", study_page),
        ("ranking", plan_page),
        ("verdicts", observe_page),
    ):
        if key in summary:
            return maker
    return None


def observe_page(source: Source) -> str:
    """What the dive shows of each calibration variable, when, and what is missing."""
    seen = source.json("observability.json")
    if seen is None:
        items: list[Item] = [Missing("Observability", "observability.json is missing")]
        return _render(source, "What can be known", [Section("known", "What can be known", (), items)])
    head = ("variable", "prior sd", "sd", "bits", "verdict", "what would help")
    rows = []
    for label, c in seen["components"].items():
        factor = shown(c["unit"])[0]
        sds = (f"{factor * c['prior_sd']:.3g}", f"{factor * c['sd']:.3g}", f"{c['bits']:.2f}")
        rows.append((label_with_unit(label, c["unit"]), *sds, str(c["verdict"]), str(c["missing"])))
    correlation = seen["correlation"]
    matrix = [
        (row, *(0.0 if v is None else float(v) for v in values))
        for row, values in zip(correlation["rows"], correlation["values"], strict=True)
    ]
    items = [
        Table(
            "Calibration variables",
            head,
            rows,
            note=f"{seen['joint_bits']:.1f} bits in all, combinations counted once.",
        ),
        Table("Correlations", ("", *correlation["columns"]), matrix, shaded=True),
    ]
    time = np.array(seen["history"]["time_s"], float)
    clock = Clock(float(time[0]), float(time[-1])) if len(time) else Clock(0.0, 1.0)
    sd = np.array(seen["history"]["sd"], float).reshape(len(time), -1)
    learning: list[Trace] = []
    for k, (label, c) in enumerate(seen["components"].items()):
        look = {"dash": ("solid", "dash", "dot")[k // len(COLOURS) % 3]}
        learning.append(line(label, clock(time), sd[:, k] / c["prior_sd"], COLOURS[k % len(COLOURS)], **look))
    note = "1: nothing is known beyond the prior."
    items.insert(1, Panel("When the dive showed it", clock.label, "sd / prior sd", learning, note=note))
    words = [sentence(s) for s in seen["in_words"]]
    sections = [Section("known", "What can be known", words, items)]
    return _render(source, "What can be known", sections, clock)


def plan_page(source: Source) -> str:
    """Manoeuvres, ranked."""
    summary = source.summary
    ranking = summary["ranking"]
    goals, labels = summary.get("goals") or {}, [*(summary.get("sd_before") or {})]
    labels.sort(key=lambda label: label not in goals)
    factors = {label: shown(unit_of(label))[0] for label in labels}
    names = [f"{p['manoeuvre']} at {p['speed_mps']:g} m/s" for p in ranking]
    head = ("manoeuvre", "bits", *(f"{label_with_unit(label, unit_of(label))}, sd" for label in labels))
    told = [("as known before", "", summary.get("sd_before") or {})]
    told += [(name, f"{p['bits']:.1f}", p["sd"] or {}) for name, p in zip(names, ranking, strict=True)]
    rows = [(name, bits, *(_times(factors[label], sd.get(label)) for label in labels)) for name, bits, sd in told]
    place = np.arange(1, len(ranking) + 1)
    drawn = [bars("bits", [p["bits"] for p in ranking], place, "#8FBBD9", 0.7, orientation="h", showlegend=False)]
    items: list[Item] = [
        Table("Manoeuvres", head, rows, note="sd: after one manoeuvre. bits: what it tells of all variables."),
        Panel("What each manoeuvre tells", "information [bit]", "manoeuvre", drawn, kind="xy", names=names),
        *_images(source),
    ]
    title = f"Best: {names[0]}" if names else "Best: none"
    lead = [_reached(goal, sd, (ranking[0]["sd"] or {}).get(goal)) for goal, sd in goals.items()] if ranking else []
    return _render(source, "Manoeuvres, ranked", [Section("plan", title, lead, items)])


def _reached(label: str, wanted: float, sd: float | None) -> str:
    """How the best manoeuvre does by a goal."""
    factor, unit = shown(unit_of(label))
    if sd is None:
        return f"{label}: not shown, wanted {factor * wanted:.2g}{behind(unit)}."
    verdict = "the goal is reached" if sd <= wanted else f"{sd / wanted:.2g} times the goal"
    return f"{label}: sd {factor * sd:.2g}{behind(unit)}, wanted {factor * wanted:.2g}{behind(unit)}; {verdict}."


def _times(factor: float, value: float | None) -> str:
    return "–" if value is None else f"{factor * value:.3g}"


def compare_page(source: Source) -> str:
    """Estimators against each other."""
    table, runs = source.frame("table.csv", "estimator"), source.frame("runs.csv", "run", "estimator")
    items: list[Item] = []
    if table is None:
        items.append(Missing("Estimators", "table.csv is missing, or has no column estimator"))
    else:
        items += _errors(table, runs)
        items.append(_table_of(table, "Estimators", OF_ESTIMATOR, "table.csv"))
    if runs is None:
        items.append(Missing("Runs", "runs.csv is missing, or has no column run or estimator"))
    else:
        items.append(_table_of(runs, "Runs", OF_RUN, "runs.csv"))
    failures = [f"{f['estimator']}, {f['run']}: {f['error']}" for f in source.summary.get("failures") or []]
    lists = {"Failures": failures} if failures else {}
    lead = [] if table is None else _ranked_in_words(table)
    sections = [Section("estimators", "Estimators", lead, [*items, *_images(source)], lists)]
    return _render(source, "Estimators against each other", sections)


def _ranked_in_words(table: pd.DataFrame) -> list[str]:
    """Which estimator errs least, and whose sd is not right."""
    sentences = []
    if "rms_m" in table:
        known = table.assign(rms=pd.to_numeric(table["rms_m"], errors="coerce")).dropna(subset="rms")
        rms = dict(zip(known["estimator"].astype(str), known["rms"], strict=True))
        if rms:
            best = min(rms, key=lambda name: rms[name])
            beside = f"; dead reckoning errs by {rms[DEAD_RECKONING]:.3g} m" if DEAD_RECKONING in rms else ""
            sentences.append(f"{best} errs least: {rms[best]:.3g} m rms along the track{beside}.")
    for band, words in (("above", "too small"), ("below", "too large")) if "nees_end_band" in table else ():
        names = table.loc[table["nees_end_band"] == band, "estimator"].astype(str)
        if len(names):
            sentences.append(f"The stated sd is {words} at the end of the track of {', '.join(names)}.")
    return sentences


def _errors(table: pd.DataFrame, runs: pd.DataFrame | None) -> list[Item]:
    """Errors of every estimator, that of each run as a point."""
    names = [*table["estimator"].astype(str)]
    panels: list[Item] = []
    for column, mean, axis in (("rms_m", "rms_m", "rms error [m]"), ("end_m", "end_mean_m", "error at the end [m]")):
        drawn = []
        if runs is not None and column in runs:
            own = runs[runs["estimator"].astype(str).isin(names)]
            place = own["estimator"].astype(str).map(names.index) + 1.0
            drawn.append(points("a run", pd.to_numeric(own[column], errors="coerce"), place, "#56808F", size=6))
        if mean in table:
            values = pd.to_numeric(table[mean], errors="coerce")
            drawn.append(points("mean", values, np.arange(len(names)) + 1.0, "#D55E00", size=9, symbol="diamond-open"))
        if drawn:
            panels.append(Panel(axis, axis, "estimator", drawn, kind="xy", log="x", wide=False, names=names))
    return panels


def study_page(source: Source) -> str:
    """Cells of a Monte Carlo study."""
    table = source.frame("cells.csv", "cell")
    items: list[Item] = [Missing("Cells", "cells.csv is missing, or has no column cell")]
    if table is not None:
        names = {**_that_differ(table), **OF_CELL} if len(table) > 1 else {"manoeuvre": "manoeuvre", **OF_CELL}
        items = [_table_of(table, "Cells", names, "cells.csv")]
    items += _images(source)
    failures = [f"{f['cell']}, run {f['run']}: {f['failure']}" for f in source.summary.get("failures") or []]
    lead = [f"{source.summary.get('runs', 'unknown')} of {source.summary.get('planned', 'unknown')} runs were made."]
    section = Section("cells", "Cells", lead, items, {"Failures": failures} if failures else {})
    return _render(source, f"Study {source.summary['study']}", [section])


def _that_differ(table: pd.DataFrame) -> dict[str, str]:
    """Settings that tell the cells of a study apart: those before the count of its runs."""
    settings = [*table.columns[1 : table.columns.get_loc("runs")]] if "runs" in table else []
    return {str(name): str(name).replace("_", " ") for name in settings if len(table[name].drop_duplicates()) > 1}


def noise_page(source: Source) -> str:
    """Noise of a log at rest: Allan deviations and spectra."""
    channels: dict[str, Any] = source.summary.get("channels") or {}
    keys = ("rate_hz", "sd", "sd_without_lines", "density", "bias_instability", "walk")
    head = ("channel", "unit", "rate [Hz]", "sd", "sd without lines", "density", "bias instability", "random walk")
    rows = [(name, str(c.get("unit", "")), *(_cell(c.get(k)) for k in keys)) for name, c in channels.items()]
    items: list[Item] = [Table("Channels", head, rows)]
    curves = (("allan.csv", "Allan deviation", "tau_s", "deviation", "averaging time [s]"),
              ("spectra.csv", "Spectrum", "frequency_hz", "density", "frequency [Hz]"))  # fmt: skip
    for file, title, x, y, label in curves:
        table = source.frame(file, "channel", x, y)
        items += (
            [Missing(title, f"{file} is missing")] if table is None else _curves(table, title, x, y, label, channels)
        )
    items.append(_piece(source, "noise.yaml"))
    remarks = {"Remarks": source.summary.get("remarks") or []}
    sections = [Section("noise", "Noise", (), items, {k: v for k, v in remarks.items() if v})]
    return _render(source, "Noise of the instruments", sections)


def _curves(table: pd.DataFrame, title: str, x: str, y: str, label: str, channels: dict[str, Any]) -> list[Item]:
    """A panel of each sensor, three axes in one."""
    sensors: dict[str, list[str]] = {}
    for name in dict.fromkeys(table["channel"].astype(str)):
        sensors.setdefault(name.rpartition("_")[0] or name, []).append(name)
    panels: list[Item] = []
    for sensor, names in sensors.items():
        drawn = []
        for k, name in enumerate(names):
            own = table[table["channel"].astype(str) == name]
            values = own[y].to_numpy(float)
            some = extremes(np.log(np.where(values > 0, values, np.nan)))
            drawn.append(line(name, own[x].to_numpy(float)[some], values[some], COLOURS[k % len(COLOURS)]))
        unit = str((channels.get(names[0]) or {}).get("unit", ""))
        unit = f"({unit})²/Hz" if title == "Spectrum" else unit
        axis = f"{title.lower()} [{unit}]"
        panels.append(Panel(f"{sensor}: {title}", label, axis, drawn, kind="xy", log="xy", wide=False))
    return panels


def magnetometer_page(source: Source) -> str:
    """The calibration of a magnetometer."""
    hidden = {"program", "version", "calibration", "turns", "disturbances"}
    rows = [(key.replace("_", " "), _cell(value)) for key, value in source.summary.items() if key not in hidden]
    items: list[Item] = [Table("Calibration", ("", ""), rows)]
    for key in ("disturbances", "turns"):
        entries = source.summary.get(key) or []
        if entries:
            items.append(Table(key.capitalize(), [*entries[0]], [tuple(map(_cell, e.values())) for e in entries]))
    items += [*_images(source), _piece(source, "magnetometer.yaml")]
    return _render(source, "Magnetometer", [Section("magnetometer", "Magnetometer", (), items)])


def check_page(report: dict[str, Any], title: str) -> str:
    """What ``rovgraph check`` found.

    Parameters
    ----------
    report : of `rovgraph.check.Report.as_dict`
    title : the log's name
    """
    levels = ("error", "warning", "ok")
    found = {level: [f for f in report["findings"] if f["level"] == level] for level in levels}
    rows = [(level, str(f["sensor"]), str(f["text"])) for level in levels for f in found[level]]
    timings = report["timings"]
    keys = [key for key in OF_TIMING if any(key in t for t in timings)]
    cells = [tuple(_cell(t.get(key)) for key in keys) for t in timings]
    timing = Table("When measurements came", [OF_TIMING[key] for key in keys], cells)
    lead = [f"{len(found['error'])} errors, {len(found['warning'])} warnings."]
    findings = Table("Findings", ("level", "sensor", "finding"), rows)
    return render(f"Check of {title}", [Section("findings", "Findings", lead, [findings, timing])])


def _render(source: Source, title: str, sections: Sequence[Section], clock: Clock | None = None) -> str:
    note = [Section("version", "Version", [source.other_version])] if source.other_version else []
    time = None
    if clock is not None:
        time = {"unit": clock.unit, "end": (clock.end - clock.start) / clock.scale, "label": clock.label}
    return render(title, [*note, *sections, about_section(source)], time)


def _table_of(table: pd.DataFrame, title: str, names: dict[str, str], file: str) -> Table:
    """Columns that have anything, under names a reader knows."""
    known = {column: name for column, name in names.items() if column in table and table[column].notna().any()}
    rows = [tuple(_cell(v) for v in row) for row in table[[*known]].head(MOST_ROWS).itertuples(index=False)]
    some = f"The first {MOST_ROWS} of {len(table)} rows. " if len(table) > MOST_ROWS else ""
    return Table(title, [*known.values()], rows, note=f"{some}{file} has more columns.")


def _images(source: Source) -> list[Item]:
    return [Image(path.stem.replace("_", " "), path.read_bytes()) for path in sorted(source.folder.glob("*.png"))]


def _piece(source: Source, name: str) -> Item:
    text = source.text(name)
    title = "For the configuration"
    return Missing(title, f"{name} is missing") if text is None else Text(title, text, shown=True)


def _cell(value: object) -> str:
    if value is None or value != value:
        return "–"
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return "(" + ", ".join(_cell(v) for v in value) + ")"
    return str(value)
