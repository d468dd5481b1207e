"""Files and tables of ``rovgraph observe`` and ``rovgraph plan``; docs/observability.md describes them."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from rovgraph.inference.observability import OBSERVABLE, OBSERVABLE_BELOW, UNOBSERVABLE_ABOVE
from rovgraph.lab.observability import OTHER_LABELS, Observability, directions, in_words
from rovgraph.lab.plan import Plan
from rovgraph.log.units import shown
from rovgraph.model.config import Config
from rovgraph.report.folder import STAMP, SUMMARY
from rovgraph.report.results import to_plain
from rovgraph.report.units import label_with_unit

OBSERVABILITY, PLAN = "observability.json", "plan.json"
TOLD = 12  # correlations in the table's caption


def write_observability(folder: Path, seen: Observability, config: Config, about: Mapping[str, Any]) -> None:
    """Write every file of ``rovgraph observe`` but the figures.

    Parameters
    ----------
    folder : an existing folder, such as `results_folder` yields
    seen : of `rovgraph.lab.observability.observe`
    config : what was believed
    about : what it was made of, for summary.json
    """
    content = observability_as_dict(seen)
    _write(folder / OBSERVABILITY, {**STAMP, **about, **content})
    verdicts = {label: entry["verdict"] for label, entry in content["components"].items()}
    _write(folder / SUMMARY, {**STAMP, **about, "verdicts": verdicts, "in_words": content["in_words"]})
    (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")


def observability_as_dict(seen: Observability) -> dict[str, Any]:
    """Content of observability.json; matrices in the units of the program, radians for angles."""
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
    """Unobservable directions, a sentence each."""
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


def write_plan(folder: Path, plan: Plan, config: Config, about: Mapping[str, Any]) -> None:
    """Write every file of ``rovgraph plan`` but the figures; parameters as of `write_observability`."""
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
    content = {**STAMP, **about, "goals": plan.goals, "sd_before": before, "ranking": ranking}
    for name in (PLAN, SUMMARY):
        _write(folder / name, content)
    (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")


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
