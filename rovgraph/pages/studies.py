"""Pages of `observe`, `plan`, `calibrate` and `check`; and which page a results folder that is no dive's has."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.pages.calibration import sentence, unit_of
from rovgraph.pages.folder import cell, images, piece, rendered
from rovgraph.pages.many_dives import compare_page, study_page
from rovgraph.pages.page import render
from rovgraph.pages.parts import Item, Missing, Panel, Section, Table, Trace, bars, line
from rovgraph.pages.source import Clock, Source
from rovgraph.pages.thinning import extremes
from rovgraph.report.colours import SERIES
from rovgraph.report.units import label_with_unit
from rovgraph.units import behind, shown

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

OF_MAGNETOMETER = {  # key of a summary -> what a reader calls it
    "log": "log",
    "method": "method",
    "samples": "samples",
    "samples_used": "of these used",
    "centre": "centre (hard iron), in the log's unit",
    "centre_sd": "its sd",
    "matrix": "matrix (soft iron)",
    "radii": "radii, in the log's unit",
    "field_length": "length of the field, calibrated",
    "length_rms_before": "its scatter as recorded, part of it",
    "length_rms_after": "its scatter, calibrated",
    "dip_deg": "dip [deg]",
    "dip_rms_before_deg": "its scatter as recorded [deg]",
    "dip_rms_after_deg": "its scatter, calibrated [deg]",
}
WORSE = 0.8  # of the scatter before, that is hardly less


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
        return rendered(source, "What can be known", [Section("known", "What can be known", (), items)])
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
        look = {"dash": ("solid", "dash", "dot")[k // len(SERIES) % 3]}
        learning.append(line(label, clock(time), sd[:, k] / c["prior_sd"], SERIES[k % len(SERIES)], **look))
    note = "1: nothing is known beyond the prior."
    items.insert(1, Panel("When the dive showed it", clock.label, "sd / prior sd", learning, note=note))
    words = [sentence(s) for s in seen["in_words"]]
    sections = [Section("known", "What can be known", words, items)]
    return rendered(source, "What can be known", sections, clock)


def plan_page(source: Source) -> str:
    """Manoeuvres, ranked."""
    summary = source.summary
    ranking = summary["ranking"]
    goals, labels = summary.get("goals") or {}, [*(summary.get("sd_before") or {})]
    labels.sort(key=lambda label: label not in goals)
    factors = {label: shown(unit_of(label))[0] for label in labels}
    names = [f"{p['manoeuvre']} at {p['speed_mps']:g} m/s" for p in ranking]
    head = ("manoeuvre", "bits", *(f"{label_with_unit(label, unit_of(label))}, sd" for label in labels))
    sentences = [("as known before", "", summary.get("sd_before") or {})]
    sentences += [(name, f"{p['bits']:.1f}", p["sd"] or {}) for name, p in zip(names, ranking, strict=True)]
    rows = [(name, bits, *(_scaled(factors[label], sd.get(label)) for label in labels)) for name, bits, sd in sentences]
    place = np.arange(1, len(ranking) + 1)
    drawn = [bars("bits", [p["bits"] for p in ranking], place, "#8FBBD9", 0.7, orientation="h", showlegend=False)]
    items: list[Item] = [
        Table("Manoeuvres", head, rows, note="sd: after one manoeuvre. bits: what it tells of all variables."),
        Panel("What each manoeuvre tells", "information [bit]", "manoeuvre", drawn, kind="xy", names=names),
        *images(source),
    ]
    title = f"Best: {names[0]}" if names else "Best: none"
    lead = [_reached(goal, sd, (ranking[0]["sd"] or {}).get(goal)) for goal, sd in goals.items()] if ranking else []
    return rendered(source, "Manoeuvres, ranked", [Section("plan", title, lead, items)])


def _reached(label: str, wanted: float, sd: float | None) -> str:
    """How the best manoeuvre does by a goal."""
    factor, unit = shown(unit_of(label))
    if sd is None:
        return f"{label}: not shown, wanted {factor * wanted:.2g}{behind(unit)}."
    verdict = "the goal is reached" if sd <= wanted else f"{sd / wanted:.2g} times the goal"
    return f"{label}: sd {factor * sd:.2g}{behind(unit)}, wanted {factor * wanted:.2g}{behind(unit)}; {verdict}."


def _scaled(factor: float, value: float | None) -> str:
    return "–" if value is None else f"{factor * value:.3g}"


def noise_page(source: Source) -> str:
    """Noise of a log at rest: Allan deviations and spectra."""
    channels: dict[str, Any] = source.summary.get("channels") or {}
    keys = ("rate_hz", "sd", "sd_without_lines", "density", "bias_instability", "walk")
    head = ("channel", "unit", "rate [Hz]", "sd", "sd without lines", "density", "bias instability", "random walk")
    rows = [(name, str(c.get("unit", "")), *(cell(c.get(k)) for k in keys)) for name, c in channels.items()]
    items: list[Item] = [Table("Channels", head, rows)]
    curves = (("allan.csv", "Allan deviation", "tau_s", "deviation", "averaging time [s]"),
              ("spectra.csv", "Spectrum", "frequency_hz", "density", "frequency [Hz]"))  # fmt: skip
    for file, title, x, y, label in curves:
        table = source.frame(file, "channel", x, y)
        items += (
            [Missing(title, f"{file} is missing")] if table is None else _curves(table, title, x, y, label, channels)
        )
    items.append(piece(source, "noise.yaml"))
    remarks = {"Remarks": source.summary.get("remarks") or []}
    sentences = [f"Noise of {len(channels)} channels over {source.summary.get('duration_s') or 0.0:.0f} s at rest."]
    found = source.summary.get("lines") or []
    if found:
        lines = _describe_lines(found)
        sentences.append(f"Regular motion or vibration, which the noise is stated without: {lines}.")
    sections = [Section("noise", "Noise", sentences, items, {k: v for k, v in remarks.items() if v})]
    return rendered(source, "Noise of the instruments", sections)


def _describe_lines(found: Sequence[Mapping[str, Any]]) -> str:
    return ", ".join(
        f"{cell(one.get('frequency_hz'))} Hz of the {one.get('sensor')} ({one.get('kind')})" for one in found
    )


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
            drawn.append(line(name, own[x].to_numpy(float)[some], values[some], SERIES[k % len(SERIES)]))
        unit = str((channels.get(names[0]) or {}).get("unit", ""))
        unit = f"({unit})²/Hz" if title == "Spectrum" else unit
        axis = f"{title.lower()} [{unit}]"
        panels.append(Panel(f"{sensor}: {title}", label, axis, drawn, kind="xy", log="xy", wide=False))
    return panels


def magnetometer_page(source: Source) -> str:
    """The calibration of a magnetometer."""
    summary = source.summary
    rows = [(label, cell(summary.get(key))) for key, label in OF_MAGNETOMETER.items()]
    items: list[Item] = [Table("Calibration", ("", ""), rows)]
    for key in ("disturbances", "turns"):
        entries = summary.get(key) or []
        if entries:
            head = [name.removesuffix("_s") + " [s]" if name.endswith("_s") else name for name in entries[0]]
            items.append(Table(key.capitalize(), head, [tuple(map(cell, e.values())) for e in entries]))
    items += [*images(source), piece(source, "magnetometer.yaml")]
    return rendered(source, "Magnetometer", [Section("magnetometer", "Magnetometer", _describe_field(summary), items)])


def _describe_field(summary: Mapping[str, Any]) -> list[str]:
    """How much the calibration improves, in sentences."""
    before, after = (summary.get(f"length_rms_{when}") for when in ("before", "after"))
    if before is None or after is None:
        return []
    sentences = [
        f"The length of the measured field scatters by {100 * before:.3g} % as recorded and by {100 * after:.3g} % "
        f"with the calibration ({summary.get('samples_used')} of {summary.get('samples')} samples were used)."
    ]
    if summary.get("dip_deg") is not None:
        sideways = float(np.rad2deg(after / max(np.cos(np.deg2rad(summary["dip_deg"])), 0.01)))
        sentences.append(f"So much error across the field turns a level heading by {sideways:.2g}° (rms).")
    if after > WORSE * before:
        sentences.append("The calibration hardly improves the field: do not use it. Turn the vehicle far from steel.")
    if summary.get("disturbances"):
        sentences.append("The field changed with something on the vehicle, at the times below, which are left out.")
    return sentences


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
    cells = [tuple(cell(t.get(key)) for key in keys) for t in timings]
    timing = Table("When measurements came", [OF_TIMING[key] for key in keys], cells)
    lead = [f"{len(found['error'])} errors, {len(found['warning'])} warnings."]
    findings = Table("Findings", ("level", "sensor", "finding"), rows)
    return render(f"Check of {title}", [Section("findings", "Findings", lead, [findings, timing])])
