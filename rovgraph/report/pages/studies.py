"""Pages of `compare`, `study`, `observe`, `plan`, `calibrate` and `check`, and of several dives side by side.

`compare` and `study` show how well each estimator or cell does on many dives. Dives side by side have a table, a map of
all, and the growth of each one's error.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pymap3d import geodetic2ned

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.units import behind, shown
from rovgraph.report.colours import SERIES
from rovgraph.report.lab import CROSSLINES, crosslines_rows
from rovgraph.report.pages.calibration import sentence, unit_of
from rovgraph.report.pages.page import (
    Item,
    Missing,
    PageTable,
    Panel,
    Section,
    Trace,
    bars,
    extremes,
    line,
    points,
    render,
)
from rovgraph.report.pages.source import (
    DiveSource,
    DiveTime,
    ResultsSource,
    cell,
    damage_named,
    images,
    piece,
    rendered,
    table_of,
)
from rovgraph.report.pages.track import origin
from rovgraph.report.pages.verdict import limits
from rovgraph.report.units import label_with_unit, plus_minus

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


def compare_page(source: ResultsSource) -> str:
    """Estimators against each other."""
    table, runs = source.frame("table.csv", "estimator"), source.frame("runs.csv", "run", "estimator")
    items: list[Item] = []
    if table is None:
        items.append(Missing("Estimators", "table.csv is missing, or has no column estimator"))
    else:
        items += _errors(table, runs)
        items.append(table_of(table, "Estimators", OF_ESTIMATOR, "table.csv"))
    if runs is None:
        items.append(Missing("Runs", "runs.csv is missing, or has no column run or estimator"))
    else:
        items.append(table_of(runs, "Runs", OF_RUN, "runs.csv"))
    failures = [f"{f['estimator']}, {f['run']}: {f['error']}" for f in source.summary.get("failures") or []]
    lists = {"Failures": failures} if failures else {}
    lead = [] if table is None else _ranked_in_words(table)
    sections = [Section("estimators", "Estimators", lead, [*items, *images(source)], lists)]
    return rendered(source, "Estimators against each other", sections)


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


def study_page(source: ResultsSource) -> str:
    """Cells of a Monte Carlo study."""
    table = source.frame("cells.csv", "cell")
    items: list[Item] = [Missing("Cells", "cells.csv is missing, or has no column cell")]
    if table is not None:
        names = {**_that_differ(table), **OF_CELL} if len(table) > 1 else {"manoeuvre": "manoeuvre", **OF_CELL}
        items = [table_of(table, "Cells", names, "cells.csv")]
    items += images(source)
    failures = [f"{f['cell']}, run {f['run']}: {f['failure']}" for f in source.summary.get("failures") or []]
    lead = [f"{source.summary.get('runs', 'unknown')} of {source.summary.get('planned', 'unknown')} runs were made."]
    section = Section("cells", "Cells", lead, items, {"Failures": failures} if failures else {})
    return rendered(source, f"Study {source.summary['study']}", [section])


def _that_differ(table: pd.DataFrame) -> dict[str, str]:
    """Settings that distinguish the cells of a study: those before the count of its runs."""
    settings = [*table.columns[1 : table.columns.get_loc("runs")]] if "runs" in table else []
    return {str(name): str(name).replace("_", " ") for name in settings if len(table[name].drop_duplicates()) > 1}


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


def study_page_of(source: ResultsSource) -> Callable[[ResultsSource], str] | None:
    """The function that makes the page of a folder without a dive; None if there is no such page."""
    summary = source.summary
    if summary.get("calibration") in ("noise", "magnetometer"):
        return noise_page if summary["calibration"] == "noise" else magnetometer_page
    for key, maker in (
        ("estimators", compare_page),
        ("study", study_page),
        ("ranking", plan_page),
        ("verdicts", observe_page),
        ("crosslines", plan_page),
    ):
        if key in summary:
            return maker
    return None


def observe_page(source: ResultsSource) -> str:
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
        PageTable(
            "Calibration variables",
            head,
            rows,
            note=f"{seen['joint_bits']:.1f} bits in all, combinations counted once.",
        ),
        PageTable("Correlations", ("", *correlation["columns"]), matrix, shaded=True),
    ]
    time = np.array(seen["history"]["time_s"], float)
    clock = DiveTime(float(time[0]), float(time[-1])) if len(time) else DiveTime(0.0, 1.0)
    sd = np.array(seen["history"]["sd"], float).reshape(len(time), -1)
    learning: list[Trace] = []
    for k, (label, c) in enumerate(seen["components"].items()):
        look = {"dash": ("solid", "dash", "dot")[k // len(SERIES) % 3]}
        learning.append(line(label, clock(time), sd[:, k] / c["prior_sd"], SERIES[k % len(SERIES)], **look))
    note = "1: nothing is known beyond the prior."
    items.insert(1, Panel("When the dive showed it", clock.label, "sd / prior sd", learning, note=note))
    words = [sentence(s) for s in seen["in_words"]]
    sections = [Section("known", "What can be known", words, items)]
    if "crosslines" in seen:
        sections.append(_crosslines(seen["crosslines"]))
    return rendered(source, "What can be known", sections, clock)


CROSSED = (("#BFD7EA", 8.0), ("#4F94CD", 4.5), ("#08306B", 1.5))  # colour and width of most crosslines, fewer, one


def _crosslines(seen: Mapping[str, Any]) -> Section:
    """What crosslines would leave of a survey's drift, and where they are."""
    ranking = seen["ranking"]
    drawn = [line("lines", *_drawn(seen["lines_m"]), "#8A96A3", width=1.0)]
    for c, (colour, width) in zip(ranking[:0:-1], CROSSED, strict=False):
        count = len(c["along_m"])
        drawn.append(line(f"{count} crossline{'s'[: count - 1]}", *_drawn(c["ends_m"]), colour, width=width))
    note = "The survey's own sd, without and with crosslines after it. Shape: without shift, rotation and scale of all."
    items: list[Item] = [PageTable("Drift of the survey", CROSSLINES, crosslines_rows(ranking), note=note)]
    if len(ranking) > 1:
        items.append(Panel("Lines and crosslines", "east [m]", "north [m]", drawn, kind="plan", wide=False))
    title = f"Crosslines after {seen['lines']} lines towards {seen['course_deg']:.0f}°"
    return Section("crosslines", title, [sentence(s) for s in seen["in_words"]], items)


def _drawn(lines: Sequence[Sequence[Sequence[float]]]) -> tuple[Array, Array]:
    """East and north of lines, with gaps between."""
    north, east = np.pad(np.array(lines, float), ((0, 0), (0, 1), (0, 0)), constant_values=np.nan).reshape(-1, 2).T
    return east, north


def plan_page(source: ResultsSource) -> str:
    """Manoeuvres, ranked, and what crosslines would leave of a survey's drift."""
    summary, sections = source.summary, list[Section]()
    if "ranking" in summary:
        sections.append(_manoeuvres(source, summary))
    if "crosslines" in summary:
        sections.append(_crosslines(summary["crosslines"]))
    return rendered(source, "Manoeuvres, ranked" if "ranking" in summary else "A survey with crosslines", sections)


def _manoeuvres(source: ResultsSource, summary: Mapping[str, Any]) -> Section:
    ranking = summary["ranking"]
    goals, labels = summary.get("goals") or {}, [*(summary.get("sd_before") or {})]
    labels.sort(key=lambda label: label not in goals)
    factors = {label: shown(unit_of(label))[0] for label in labels}
    at = ("" if p["speed_mps"] is None else f" at {p['speed_mps']:g} m/s" for p in ranking)
    names = [p["manoeuvre"] + speed for p, speed in zip(ranking, at, strict=True)]
    head = ("manoeuvre", "bits", *(f"{label_with_unit(label, unit_of(label))}, sd" for label in labels))
    sentences = [("as known before", "", summary.get("sd_before") or {})]
    sentences += [(name, f"{p['bits']:.1f}", p["sd"] or {}) for name, p in zip(names, ranking, strict=True)]
    rows = [(name, bits, *(_scaled(factors[label], sd.get(label)) for label in labels)) for name, bits, sd in sentences]
    place = np.arange(1, len(ranking) + 1)
    drawn = [bars("bits", [p["bits"] for p in ranking], place, "#8FBBD9", 0.7, orientation="h", showlegend=False)]
    items: list[Item] = [
        PageTable("Manoeuvres", head, rows, note="sd: after one manoeuvre. bits: what it tells of all variables."),
        Panel("What each manoeuvre tells", "information [bit]", "manoeuvre", drawn, kind="xy", names=names),
        *images(source),
    ]
    title = f"Best: {names[0]}" if names else "Best: none"
    lead = [_reached(goal, sd, (ranking[0]["sd"] or {}).get(goal)) for goal, sd in goals.items()] if ranking else []
    return Section("plan", title, lead, items)


def _reached(label: str, wanted: float, sd: float | None) -> str:
    """How the best manoeuvre does by a goal."""
    factor, unit = shown(unit_of(label))
    if sd is None:
        return f"{label}: not shown, wanted {factor * wanted:.2g}{behind(unit)}."
    verdict = "the goal is reached" if sd <= wanted else f"{sd / wanted:.2g} times the goal"
    return f"{label}: sd {factor * sd:.2g}{behind(unit)}, wanted {factor * wanted:.2g}{behind(unit)}; {verdict}."


def _scaled(factor: float, value: float | None) -> str:
    return "–" if value is None else f"{factor * value:.3g}"


def noise_page(source: ResultsSource) -> str:
    """Noise of a log at rest: Allan deviations and spectra."""
    channels: dict[str, Any] = source.summary.get("channels") or {}
    keys = ("rate_hz", "sd", "sd_without_lines", "density", "bias_instability", "walk")
    head = ("channel", "unit", "rate [Hz]", "sd", "sd without lines", "density", "bias instability", "random walk")
    rows = [(name, str(c.get("unit", "")), *(cell(c.get(k)) for k in keys)) for name, c in channels.items()]
    items: list[Item] = [PageTable("Channels", head, rows)]
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


def magnetometer_page(source: ResultsSource) -> str:
    """The calibration of a magnetometer."""
    summary = source.summary
    rows = [(label, cell(summary.get(key))) for key, label in OF_MAGNETOMETER.items()]
    items: list[Item] = [PageTable("Calibration", ("", ""), rows)]
    for key in ("disturbances", "turns"):
        entries = summary.get(key) or []
        if entries:
            head = [name.removesuffix("_s") + " [s]" if name.endswith("_s") else name for name in entries[0]]
            items.append(PageTable(key.capitalize(), head, [tuple(map(cell, e.values())) for e in entries]))
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
    report : of `rovgraph.diagnosis.check.Report.as_dict`
    title : the log's name
    """
    levels = ("error", "warning", "ok")
    found = {level: [f for f in report["findings"] if f["level"] == level] for level in levels}
    rows = [(level, str(f["sensor"]), str(f["text"])) for level in levels for f in found[level]]
    timings = report["timings"]
    keys = [key for key in OF_TIMING if any(key in t for t in timings)]
    cells = [tuple(cell(t.get(key)) for key in keys) for t in timings]
    timing = PageTable("When measurements came", [OF_TIMING[key] for key in keys], cells)
    lead = [f"{len(found['error'])} errors, {len(found['warning'])} warnings."]
    findings = PageTable("Findings", ("level", "sensor", "finding"), rows)
    return render(f"Check of {title}", [Section("findings", "Findings", lead, [findings, timing])])


CAMPAIGN = "campaign.html"
DASHES = ("solid", "dash", "dot", "dashdot")


def campaign_page(folders: Sequence[Path]) -> str:
    """HTML of several dives.

    Parameters
    ----------
    folders : results folders of ``smooth``

    Raises
    ------
    InputError : one of them is not a results folder, or cannot be read
    """
    with damage_named(*folders):
        dives = {name: _dive(folder) for name, folder in zip(_names(folders), folders, strict=True)}
        sections = [
            Section("dives", "Dives", (), [_table(dives)], {"What limited each": _limited(dives)}),
            Section("map", "Map of all", *_map(dives)),
            Section("drift", "Uncertainty and drift", (), [*_growth(dives)]),
            Section("calibration", "Calibration of each", (), [_calibrations(dives)]),
        ]
    return render(f"{len(dives)} dives side by side", sections)


def _dive(folder: Path) -> DiveSource:
    source = ResultsSource.read(folder)
    if "main_estimate" not in source.summary:
        raise InputError(f"{folder}: holds no results of rovgraph smooth; only dives are set side by side")
    dive = DiveSource(source.folder, source.summary)
    _ = dive.main  # read it now, to name the folder that cannot be read
    return dive


def _names(folders: Sequence[Path]) -> list[str]:
    """Names that distinguish the folders: their own names, or their whole paths where these are the same."""
    short = [folder.resolve().name for folder in folders]
    return [
        s if short.count(s) == 1 else f"{folder} ({k + 1})"
        for k, (s, folder) in enumerate(zip(short, folders, strict=True))
    ]


def _table(dives: dict[str, DiveSource]) -> PageTable:
    rows = []
    for name, dive in dives.items():
        s, track = dive.summary, dive.main
        reach = track.ellipses[0]
        known = np.isfinite(reach).any()
        rejected = sum(int(c.get("rejected") or 0) for c in (s.get("sensors") or {}).values())
        rows.append(
            (
                name,
                str(s.get("name", "")),
                str(s.get("verdict", "unknown")),
                f"{(dive.clock.end - dive.clock.start) / 60:.1f}",
                _number(s.get("distance_m"), ".0f"),
                f"{np.nanmax(reach):.2g}" if known else "unknown",
                _number(100 * np.nanmax(reach) / s["distance_m"], ".2g") if known and s.get("distance_m") else "–",
                str(rejected),
                str(len(s.get("alarms") or [])),
            )
        )
    head = ("folder", "name", "verdict", "minutes", "distance [m]", "worst 99 % [m]", "of the distance [%]", "rejected",
            "alarms")  # fmt: skip
    return PageTable("Dives", head, rows, note="worst 99 %: semi-axis of the largest ellipse along the track.")


def _number(value: object, form: str) -> str:
    return format(value, form) if isinstance(value, int | float) else "unknown"


def _limited(dives: dict[str, DiveSource]) -> list[str]:
    return [f"{name}: {' '.join(limits(dive)) or 'not known'}" for name, dive in dives.items()]


def _look(k: int) -> tuple[str, str]:
    return SERIES[k % len(SERIES)], DASHES[k // len(SERIES) % len(DASHES)]


def _map(dives: dict[str, DiveSource]) -> tuple[list[str], list[Item]]:
    """Tracks about the first dive's origin where all origins are known, else each about its own."""
    origins = [origin(dive) for dive in dives.values()]
    common = origins[0] if all(origins) else None
    lead = (
        ["All tracks stand where they were, in metres from the origin of the first dive."]
        if common
        else ["Some dives have no latitude and longitude: each track begins at its own origin."]
    )
    traces: list[Trace] = []
    for k, (name, dive) in enumerate(dives.items()):
        own, track = origins[k], dive.main
        shift = np.zeros(3)
        if common and own:
            shift = np.array(geodetic2ned(own["lat"], own["lon"], 0.0, common["lat"], common["lon"], 0.0))
        some = extremes(track["north"], track["east"])
        north, east = track["north"][some] + shift[0], track["east"][some] + shift[1]
        colour, dash = _look(k)
        traces.append(line(name, east, north, colour, dash=dash, width=2))
        look = {"size": 8, "symbol": "circle-open", "showlegend": False, "hoverinfo": "skip"}
        traces.append(points(f"start of {name}", east[:1], north[:1], colour, **look))
    return lead, [Panel("Tracks", "east [m]", "north [m]", traces, kind="map", note="Circles: where each began.")]


def _growth(dives: dict[str, DiveSource]) -> list[Item]:
    """99 % radius against the way travelled, and how far dead reckoning went astray."""
    radius: list[Trace] = []
    drift: list[Trace] = []
    for k, (name, dive) in enumerate(dives.items()):
        colour, dash = _look(k)
        track = dive.main
        way, reach = _way(track["north"], track["east"]), track.ellipses[0]
        if np.isfinite(reach).any():
            some = extremes(reach)
            radius.append(line(name, way[some], reach[some], colour, dash=dash))
        reckoned = dive.tracks.get("dead_reckoning")
        if reckoned is not None and reckoned is not track:
            north, east = (np.interp(track["time"], reckoned["time"], reckoned[c]) for c in ("north", "east"))
            off = np.hypot(north - track["north"], east - track["east"])
            some = extremes(off)
            drift.append(line(name, way[some], off[some], colour, dash=dash))
    x = "way travelled [m]"
    titles = "99 % radius", "Dead reckoning from the best track"
    charts = ((titles[0], "semi-axis [m]", radius), (titles[1], "distance [m]", drift))
    return [
        Panel(title, x, y, drawn, kind="xy") if drawn else Missing(title, "no dive of these has what it takes")
        for title, y, drawn in charts
    ]


def _way(north: Array, east: Array) -> Array:
    steps = np.hypot(np.diff(north, prepend=north[:1]), np.diff(east, prepend=east[:1]))
    return np.asarray(np.cumsum(np.nan_to_num(steps)))


def _calibrations(dives: dict[str, DiveSource]) -> Item:
    """Estimated variables of every dive; what is mounted once should come out the same."""
    cells: dict[str, dict[str, str]] = {}
    for name, dive in dives.items():
        table = dive.calibration
        if table is None or "estimated" not in table:
            continue
        for c in table[table["estimated"].astype(str) == "True"].to_dict("records"):
            label = str(c["label"]) + ("" if str(c["unit"]) == "1" else f" [{c['unit']}]")
            cells.setdefault(label, {})[name] = plus_minus(c["value"], c["sd"])
    title = "What was estimated, ± one standard deviation"
    if not cells:
        return Missing(title, "no dive of these estimated a calibration variable")
    rows = [(label, *(own.get(name, "–") for name in dives)) for label, own in cells.items()]
    note = "What is mounted once should come out the same within its sd."
    return PageTable(title, ("variable", *dives), rows, note=note)
