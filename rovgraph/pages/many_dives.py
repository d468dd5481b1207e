"""Pages of `compare` and `study`: many dives, and how well each estimator or cell does on them."""

import numpy as np
import pandas as pd

from rovgraph.pages.folder import images, rendered, table_of
from rovgraph.pages.parts import Item, Missing, Panel, Section, points
from rovgraph.pages.source import Source

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


def compare_page(source: Source) -> str:
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


def study_page(source: Source) -> str:
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
    """Settings that tell the cells of a study apart: those before the count of its runs."""
    settings = [*table.columns[1 : table.columns.get_loc("runs")]] if "runs" in table else []
    return {str(name): str(name).replace("_", " ") for name in settings if len(table[name].drop_duplicates()) > 1}
