"""Pages of `compare`, `study`, `observe`, `plan` and `calibrate`, from their results folders."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.pages.about import about_section
from rovgraph.pages.calibration import sentence
from rovgraph.pages.page import render
from rovgraph.pages.parts import Image, Item, Missing, Panel, Section, Table, Text, Trace, bars, line, points
from rovgraph.pages.source import Clock, Source
from rovgraph.pages.thinning import extremes
from rovgraph.report.units import label_with_unit
from rovgraph.units import shown

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#7B3294", "#A3206B", "#333333", "#8C6D00", "#56808F")
MOST_ROWS = 60


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
        Table("Calibration variables", head, rows, note=f"{seen['joint_bits']:.1f} bits in all."),
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
    ranking = source.summary["ranking"]
    labels = [*(source.summary.get("sd_before") or {})]
    head = ("manoeuvre", "speed [m/s]", "score", "bits", *(f"{label}, sd" for label in labels))
    rows = [
        (
            str(p["manoeuvre"]),
            _cell(p["speed_mps"]),
            _cell(p["score"]),
            f"{p['bits']:.1f}",
            *(_cell((p["sd"] or {}).get(label)) for label in labels),
        )
        for p in ranking
    ]
    best = f"{ranking[0]['manoeuvre']} at {ranking[0]['speed_mps']:g} m/s" if ranking else "none"
    place = np.arange(1, len(ranking) + 1)
    drawn = [bars("bits", place, [p["bits"] for p in ranking], "#8FBBD9", 0.7)]
    items: list[Item] = [
        Table("Manoeuvres", head, rows, note="sd in radians and SI."),
        Panel("What each shows", "rank", "information [bit]", drawn, kind="xy"),
        *_images(source),
    ]
    return _render(source, "Manoeuvres, ranked", [Section("plan", f"Best: {best}", (), items)])


def compare_page(source: Source) -> str:
    """Estimators against each other."""
    items: list[Item] = []
    runs = source.frame("runs.csv", "run", "estimator")
    if runs is not None:
        items += _of_runs(runs)
    items += [_frame_table(source, name, title) for name, title in (("table.csv", "Estimators"), ("runs.csv", "Runs"))]
    failures = [f"{f['estimator']}, {f['run']}: {f['error']}" for f in source.summary.get("failures") or []]
    lists = {"Failures": failures} if failures else {}
    sections = [Section("estimators", "Estimators", (), [*items, *_images(source)], lists)]
    return _render(source, "Estimators against each other", sections)


def _of_runs(runs: pd.DataFrame) -> list[Item]:
    """Every run's errors by estimator."""
    panels: list[Item] = []
    estimators = [*dict.fromkeys(runs["estimator"].astype(str))]
    for column, axis in (("end_m", "end error [m]"), ("rms_m", "rms error [m]")):
        if column not in runs:
            continue
        drawn = []
        for k, name in enumerate(estimators):
            values = pd.to_numeric(runs.loc[runs["estimator"].astype(str) == name, column], errors="coerce").to_numpy()
            colour = COLOURS[k % len(COLOURS)]
            drawn.append(points(name, np.full(len(values), k + 1.0), values, colour, size=6))
        note = "One point per run; the number of an estimator is its place in the legend."
        panels.append(Panel(axis, "estimator [number]", axis, drawn, kind="xy", note=note, log="y"))
    return panels


def study_page(source: Source) -> str:
    """Cells of a Monte Carlo study."""
    items = [_frame_table(source, "cells.csv", "Cells"), *_images(source)]
    failures = [f"{f['cell']}, run {f['run']}: {f['failure']}" for f in source.summary.get("failures") or []]
    lead = [f"{source.summary.get('runs', 'unknown')} of {source.summary.get('planned', 'unknown')} runs were made."]
    section = Section("cells", "Cells", lead, items, {"Failures": failures} if failures else {})
    return _render(source, f"Study {source.summary['study']}", [section])


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
    keys = [*timings[0]] if timings else []
    timing = Table("When measurements came", keys, [tuple(_cell(t[k]) for k in keys) for t in timings])
    lead = [f"{len(found['error'])} errors, {len(found['warning'])} warnings."]
    findings = Table("Findings", ("level", "sensor", "finding"), rows)
    return render(f"{title}: is this log sane?", [Section("findings", "Findings", lead, [findings, timing])])


def _render(source: Source, title: str, sections: Sequence[Section], clock: Clock | None = None) -> str:
    note = [Section("version", "Version", [source.other_version])] if source.other_version else []
    time = None
    if clock is not None:
        time = {"unit": clock.unit, "end": (clock.end - clock.start) / clock.scale, "label": clock.label}
    return render(title, [*note, *sections, about_section(source)], time)


def _frame_table(source: Source, name: str, title: str) -> Item:
    table = source.frame(name)
    if table is None:
        return Missing(title, f"{name} is missing")
    rows = [tuple(_cell(v) for v in row) for row in table.head(MOST_ROWS).itertuples(index=False)]
    note = f"The first {MOST_ROWS} of {len(table)} rows; {name} has all." if len(table) > MOST_ROWS else ""
    return Table(title, [str(c) for c in table.columns], rows, note=note)


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
