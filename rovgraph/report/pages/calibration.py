"""Section on the calibration: each variable against its prior, confounded variables, remedies, and the biases."""

import re
from collections.abc import Sequence

import numpy as np
import pandas as pd

from rovgraph.errors import InputError
from rovgraph.inference.observability import data_information
from rovgraph.lab.observability import in_words
from rovgraph.log.units import shown
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import parse_config
from rovgraph.report.colours import ESTIMATES
from rovgraph.report.motion import axis_limits, span
from rovgraph.report.pages.page import (
    Item,
    Missing,
    PageTable,
    Panel,
    Section,
    Text,
    Trace,
    extremes,
    line,
    packed,
)
from rovgraph.report.pages.source import DiveSource
from rovgraph.report.units import plus_minus, words

MOVED = 3.0  # prior sd beyond which a variable has moved suspiciously far


def calibration_section(source: DiveSource) -> Section:
    """Table, correlations, words, and histories."""
    items: list[Item] = []
    lead: list[str] = []
    table = source.calibration
    if table is None or table.empty:
        items.append(Missing("Calibration against prior", "calibration.csv is missing or has no rows of this estimate"))
    else:
        items += _against_prior(table)
    joint = ((source.summary.get("estimates") or {}).get(source.main.kind) or {}).get("calibration_covariance")
    if isinstance(joint, dict):
        lead += _words(joint)
        items.append(correlation_table(joint["labels"], np.array(joint["covariance"], float)))
    items += [*_histories(source), *_allan(source)]
    finding, well = _in_a_sentence(table)
    return Section("calibration", "Calibration and biases", lead, items, finding=finding, well=well)


def _in_a_sentence(table: pd.DataFrame | None) -> tuple[str, bool | None]:
    """What the dive showed of its instruments, and whether anything moved far."""
    if table is None or table.empty or not {"verdict", "moved_in_prior_sd"} <= set(table):
        return "What the dive showed of its instruments.", None
    estimated = table[table["estimated"].astype(str) == "True"] if "estimated" in table else table
    seen = int((estimated["verdict"] == "observable").sum())
    moved = pd.to_numeric(table["moved_in_prior_sd"], errors="coerce")
    far = [words(str(label)) for label in table.loc[np.abs(moved) > MOVED, "label"]]
    sentence = f"The dive shows {seen} of {len(estimated)} variables that were estimated"
    return f"{sentence}; {', '.join(far)} moved far." if far else f"{sentence}; none moved far.", not far


def _against_prior(table: pd.DataFrame) -> list[Item]:
    held = (table["sd"] == 0) & (table["prior_sd"].fillna(0) == 0)
    rows = []
    for c in table[~held].to_dict("records"):
        moved = c.get("moved_in_prior_sd")
        flag = " (far)" if isinstance(moved, float) and abs(moved) > MOVED else ""
        left = c.get("narrowing")
        verdict = str(c.get("verdict") or "") if c.get("verdict") == c.get("verdict") else ""
        rows.append(
            (
                words(str(c["label"])) + ("" if c["unit"] in ("1", 1) else f" [{str(c['unit']).replace('deg', '°')}]"),
                plus_minus(c["prior_mean"], c["prior_sd"]),
                plus_minus(c["value"], c["sd"]),
                (f"{moved:+.2f}" if isinstance(moved, float) and np.isfinite(moved) else "–") + flag,
                f"{100 * left:.0f} %" if isinstance(left, float) and np.isfinite(left) else "–",
                verdict,
                needs(str(c["label"])) if verdict in ("weak", "unobservable") else "",
                str(c["label"]),
            )
        )
    head = ("variable", "prior", "after the dive", "moved [prior sd]", "sd left", "verdict", "what would help", "key")
    note = "± one sd. considered: held, with its uncertainty in that of all else."
    found: list[Item] = [PageTable("Calibration against prior", head, rows, note=note)]
    exact = "\n".join(table.loc[held, "label"].astype(str))
    return [*found, Text(f"{held.sum()} constants are held at their value without an sd", exact)] if exact else found


def needs(label: str) -> str:
    """What a dive must have to show a component; empty where it is not known."""
    return next((v.excited_by for v in TABLE.values() if label in v.labels), "")


def _words(joint: dict[str, list[float]]) -> list[str]:
    """Variables that cannot be separated, in the words of ``rovgraph observe``."""
    labels = [str(label) for label in joint["labels"]]
    prior, P = np.array(joint["prior_sd"], float), np.array(joint["covariance"], float)
    if not (np.isfinite(P).all() and np.isfinite(prior).all() and (prior > 0).all()):
        return []
    try:
        sentences = in_words(data_information(P, prior), labels, [unit_of(label) for label in labels], prior)
    except np.linalg.LinAlgError:
        return ["the covariance of the calibration is singular, so nothing is said of its combinations"]
    return [sentence(s) for s in sentences]


def sentence(words: str) -> str:
    """With a capital, unless it begins with a variable's name, and a full stop."""
    named = "_" in words.split(" ", 1)[0]
    return (words if named else words[:1].upper() + words[1:]) + "."


def unit_of(label: str) -> str:
    """Unit of a component inside the program; "1" where it is not known."""
    return next((v.unit for v in TABLE.values() if label in v.labels), "1")


def correlation_table(labels: Sequence[str], covariance: np.ndarray) -> Item:
    """A shaded matrix."""
    title = "Correlations at the end of the dive"
    sd = np.sqrt(np.diag(covariance))
    if not (np.isfinite(covariance).all() and (sd > 0).all()):
        return Missing(title, "the covariance is not known")
    rho = covariance / np.outer(sd, sd)
    rows = [(label, *(float(r) for r in row)) for label, row in zip(labels, rho, strict=True)]
    note = "Near ±1: the dive shows a combination of the two only."
    return PageTable(title, ("", *labels), rows, note=note, shaded=True)


def _allan(source: DiveSource) -> list[Item]:
    """Allan deviations that the configuration states: N and K of sigma^2 = N^2 / tau + K^2 tau / 3."""
    text = source.text("config.yaml")
    if text is None or "imu" not in (source.summary.get("sensors") or {}):
        return []
    try:
        imu = re.search(r"^imu:.*\n([ #].*\n)*", text, re.MULTILINE)  # to parse all of it takes as long as the page
        noise = parse_config(imu[0] if imu else "", "config.yaml").imu.noise
    except InputError as error:
        return [Missing("Allan deviation, as configured", str(error))]
    tau = np.geomspace(0.01, max(source.clock.end - source.clock.start, 1.0), 100)
    note = "Falling: noise of the samples. Rising: walk of the bias. `rovgraph calibrate noise` measures both."
    items: list[Item] = []
    for name, unit, density, walk in (
        ("accelerometer", "m/s²", noise.acc, noise.acc_walk),
        ("gyro", "rad/s", noise.gyr, noise.gyr_walk),
    ):
        drawn = [line("stated", tau, np.sqrt(density**2 / tau + walk**2 * tau / 3.0), ESTIMATES["smoothed"])]
        labels = ("averaging time [s]", f"Allan deviation [{unit}]")
        title = f"Allan deviation of the {name}, as configured"
        items.append(Panel(title, *labels, drawn, kind="xy", note=note, log="xy", wide=False))
    return items


def _histories(source: DiveSource) -> list[Item]:
    """Biases and calibration against time with bands of two sd."""
    table = source.history
    if table is None:
        return [Missing("Biases", "the folder has no history.csv")]
    items: list[Item] = []
    for variable, own in table.groupby("variable", sort=False):
        drawn: list[Trace] = []
        spans, unit = [], ""
        for kind, rows in own.groupby("estimate", sort=False):
            if kind not in ESTIMATES:
                continue
            factor, unit = shown(str(rows["unit"].iloc[0]))
            time = rows["time"].to_numpy(float)
            value, sd = factor * rows["value"].to_numpy(float), factor * rows["sd"].to_numpy(float)
            drawn.append(_band(source, str(kind), time, value, sd))
            spans.append(span(time, value, sd, BAND if kind == source.main.kind else 0.0))
        if drawn:
            name, key, unit = words(str(variable)), str(variable), unit.replace("deg", "°").replace("s2", "s²")
            label = f"estimate [{unit or 1}]"
            labels, limits = (source.clock.label, label), axis_limits(spans, 0.0)
            title, note = name[:1].upper() + name[1:], "Bands: two sd."
            items.append(Panel(title, *labels, drawn, note=note, wide=False, key=key, limits=limits))
    return items


BAND = 2  # sds


def _band(source: DiveSource, kind: str, time: np.ndarray, value: np.ndarray, sd: np.ndarray) -> Trace:
    some = extremes(value, sd, stretches=250)
    band = {"sd": packed(sd[some]), "band": BAND} if np.isfinite(sd).any() else {}
    dash = "solid" if kind == "smoothed" else "dash"
    return line(kind, source.clock(time[some]), value[some], ESTIMATES[kind], dash=dash, **band)
