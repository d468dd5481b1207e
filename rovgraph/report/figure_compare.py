"""Figures of a comparison: errors, end points, velocity, misalignment, a row or a panel per estimator."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from rovgraph.geometry import Array
from rovgraph.report.colours import UNUSED
from rovgraph.report.results import ellipse_axes
from rovgraph.report.style import WIDTH, legend_below, new_figure, save, style
from rovgraph.studies.compare import REFERENCE, Comparison

COLUMNS = 4
# Okabe and Ito's colours, a marker each for grey prints
FAMILIES: dict[str, dict[str, Any]] = {
    "dead reckoning": {"color": "#666666", "marker": "s"},
    "thesis": {"color": "#D55E00", "marker": "o"},
    "error state": {"color": "#009E73", "marker": "^"},
    "graph": {"color": "#0072B2", "marker": "D"},
    "isam2": {"color": "#E69F00", "marker": "P"},
}
OTHER: dict[str, Any] = {"color": "#CC79A7", "marker": "v"}
INSIDE, OUTSIDE = "#0072B2", "#D55E00"
SETTLED = 0.25  # of the dive; the misalignment may leave its panel before
MOST_SEEN = 0.75  # share of estimators whose end points all lie within the panels


def draw_comparison(folder: Path, comparison: Comparison, title: str, thesis: bool = False) -> list[Path]:
    """Draw every figure that there are data for.

    Parameters
    ----------
    folder : an existing folder
    comparison : of `rovgraph.studies.compare.compare`
    title : what was compared on what
    thesis : show the thesis's end errors beside ours; they are of its own dives

    Returns
    -------
    list of Path : the PNG files written
    """
    good = comparison.runs[comparison.runs["error"].isna()]
    if not len(good):
        return []
    with style():
        figures = {
            "errors.png": draw_errors(comparison.table, good, title, thesis),
            "end_points.png": draw_end_points(comparison.table, good, title),
            "velocity.png": draw_velocity(comparison.velocity, str(comparison.runs["run"].iloc[0])),
            "misalignment.png": draw_misalignment(comparison.misalignment),
        }
        return [save(figure, folder / name) for name, figure in figures.items() if figure is not None]


def draw_errors(table: pd.DataFrame, runs: pd.DataFrame, title: str, thesis: bool = False) -> Figure:
    """End, heading and velocity errors of every run as dots, their mean over runs marked; log axes.

    What the reference does not know has no panel.
    """
    names = table["estimator"].tolist()
    panels = {
        "end_m": ("end_mean_m", "end error [m]"),
        "heading_rms_deg": ("heading_rms_deg", "heading, rms [deg]"),
        "velocity_rms_mps": ("velocity_rms_mps", "velocity, rms [m/s]"),
    }
    panels = {single: panel for single, panel in panels.items() if runs[single].notna().any()}
    figure = new_figure(1.3 + 0.21 * len(names))
    widths = (1.5, 1, 1)[: len(panels)]
    grid = figure.subplots(1, len(panels), sharey=True, width_ratios=widths, squeeze=False)[0]
    for axes, (single, (mean, label)) in zip(grid, panels.items(), strict=True):
        for y, (_, row) in enumerate(table.iterrows()):
            look = FAMILIES.get(str(row["family"]), OTHER)
            dots = runs.loc[runs["estimator"] == row["estimator"], single].astype(float)
            axes.plot(dots, np.full(len(dots), y), ".", color=look["color"], alpha=0.5, ms=5, mew=0)
            axes.plot([row[mean]], [y], ls="none", mec="white", mew=0.6, ms=6.5, label=row["family"], zorder=4, **look)
        _log_axis(axes, label)
    known = table["thesis_end_mean_m"].notna().to_numpy()
    if thesis and known.any():
        at, printed = np.flatnonzero(known), table["thesis_end_mean_m"][known]
        grid[0].plot(printed, at, "x", color="black", ms=6, mew=1.3, zorder=5, label="as printed there")
    grid[0].set_yticks(range(len(names)), names)
    grid[0].set_ylim(len(names) - 0.4, -0.6)
    figure.suptitle(f"{title}: each dot a run, marks the mean (end) or rms over runs", x=0.01, ha="left", fontsize=9)
    legend_below(figure, [grid[0]], 5)
    return figure


def draw_end_points(table: pd.DataFrame, runs: pd.DataFrame, title: str) -> Figure:
    """Estimated minus true end of every run with its 99 % ellipse, all panels to one scale."""
    names = [n for n in table["estimator"] if (runs["estimator"] == n).any()]
    reach = runs.groupby("estimator")["end_m"].max().loc[names].to_numpy(float)
    limit = 1.15 * float(np.quantile(reach, MOST_SEEN, method="higher"))
    figure, grid = _grid(names, WIDTH / COLUMNS, "east [m]", "north [m]")
    for axes, name in zip(grid, names, strict=True):
        _end_panel(axes, runs[runs["estimator"] == name], limit)
        axes.set_aspect("equal", adjustable="box")
    figure.suptitle(f"{title}: ends, estimated minus true, with 99 % ellipses", x=0.01, ha="left", fontsize=9)
    legend_below(figure, grid, scale=2.0)
    return figure


def _end_panel(axes: Axes, runs: pd.DataFrame, limit: float) -> None:
    point = runs[["end_east_m", "end_north_m"]].to_numpy(float)
    seen = (np.abs(point) <= limit).all(axis=1)
    inside, known = runs["inside_end"].isin([True]).to_numpy(), runs["inside_end"].notna().to_numpy()
    kinds = (
        (inside, INSIDE, "true end inside its ellipse"),
        (known & ~inside, OUTSIDE, "outside"),
        (~known, UNUSED, "no ellipse"),
    )
    for chosen, color, label in kinds:
        _ellipses(axes, runs[chosen], color)
        if (chosen & seen).any():
            axes.plot(*point[chosen & seen].T, ".", color=color, ms=3.5, mew=0, label=label)
    edge = np.clip(point[~seen], -0.95 * limit, 0.95 * limit)
    if len(edge):
        axes.plot(*edge.T, "^", color="black", ms=4, mew=0, label="beyond the panel")
    axes.axhline(0.0, color="black", lw=0.5, zorder=1)
    axes.axvline(0.0, color="black", lw=0.5, zorder=1)
    axes.set_xlim(-limit, limit)
    axes.set_ylim(-limit, limit)
    mean = runs["end_m"].mean()
    axes.text(0.03, 0.03, f"mean {mean:.3g} m", transform=axes.transAxes, fontsize=7, zorder=6)


def _ellipses(axes: Axes, runs: pd.DataFrame, color: str) -> None:
    """99 % ellipses about the estimated ends, north up."""
    north, east, both = (runs[f"end_cov_{c}_m2"].to_numpy(float) for c in ("north", "east", "north_east"))
    known = np.isfinite(north)
    covariance = np.stack([north, both, both, east], axis=-1).reshape(-1, 2, 2)[known]
    if not len(covariance):
        return
    major, minor, bearing = ellipse_axes(covariance)
    ellipses = EllipseCollection(
        2 * major,
        2 * minor,
        90.0 - np.rad2deg(bearing),  # from east, counter-clockwise
        units="xy",
        offsets=runs[["end_east_m", "end_north_m"]].to_numpy(float)[known],
        offset_transform=axes.transData,
        edgecolors=color,
        facecolors="none",
        linewidths=0.5,
        alpha=0.7,
    )
    axes.add_collection(ellipses)


def draw_velocity(velocity: pd.DataFrame, run: str) -> Figure | None:
    """North and east velocity against time of one run, and the reference's."""
    reference = velocity[velocity["estimator"] == REFERENCE]
    names = [n for n in velocity["estimator"].unique() if n != REFERENCE]
    if not names:
        return None
    figure, grid = _grid(names, 1.35, "time [s]", "[m/s]")
    known = bool(reference[["v_north", "v_east"]].notna().any(axis=None))
    top = _limit(reference[["v_north", "v_east"]].to_numpy(float), velocity)
    for axes, name in zip(grid, names, strict=True):
        rows = velocity[velocity["estimator"] == name]
        axes.plot(rows["time"], rows["v_north"], color="#0072B2", lw=0.7, label="north")
        axes.plot(rows["time"], rows["v_east"], color="#D55E00", lw=0.7, label="east")
        for column in ("v_north", "v_east") if known else ():
            axes.plot(reference["time"], reference[column], color="black", lw=0.5, ls=(0, (4, 2)), label="reference")
        axes.set_ylim(-top, top)
        axes.set_xlim(0.0, float(velocity["time"].max()))
    beside = "" if known else "; the reference has none"
    figure.suptitle(f"velocity over ground, {run}{beside}", x=0.01, ha="left", fontsize=9)
    legend_below(figure, grid)
    return figure


def _limit(reference: Array, velocity: pd.DataFrame) -> float:
    """Of the axis of velocity: half as much again as the reference, or all where it has none."""
    known = np.abs(reference[np.isfinite(reference)])
    if not len(known):
        known = np.abs(velocity[["v_north", "v_east"]].to_numpy(float))
    return 1.5 * float(np.nanmax(known)) or 1.0


def draw_misalignment(history: pd.DataFrame) -> Figure | None:
    """Error of the DVL's yaw against time; the first run with ±2 sd, the others as thin lines."""
    if not len(history):
        return None
    names = list(history["estimator"].unique())
    true = history["true_deg"].fillna(0.0)
    history = history.assign(error_deg=history["value_deg"] - true)
    figure, grid = _grid(names, 1.9, "time [s]", "[deg]", 3, one_scale=False)
    for axes, name in zip(grid, names, strict=True):
        own = history[history["estimator"] == name]
        for i, (_, rows) in enumerate(own.groupby("run", sort=False)):
            _misalignment_line(axes, rows, i == 0)
        axes.axhline(0.0, color="black", lw=0.6, zorder=1)
        late = own[own["time"] > SETTLED * own["time"].max()]
        top = 1.1 * float((late["error_deg"].abs() + 2.0 * late["sd_deg"]).quantile(0.98)) or 1.0
        axes.set_ylim(-top, top)
        axes.set_xlim(0.0, float(history["time"].max()))
    known = bool(history["true_deg"].notna().all())
    what = "estimated minus true" if known else "estimated minus the mounting"
    figure.suptitle(f"DVL's misalignment in yaw, {what}; scales differ", x=0.01, ha="left", fontsize=9)
    legend_below(figure, grid)
    return figure


def _misalignment_line(axes: Axes, rows: pd.DataFrame, first: bool) -> None:
    time, error, sd = (rows[c].to_numpy(float) for c in ("time", "error_deg", "sd_deg"))
    if not first:
        axes.plot(time, error, color="#999999", lw=0.5, zorder=2, label="other runs")
        return
    axes.fill_between(time, error - 2 * sd, error + 2 * sd, color="#0072B2", alpha=0.2, lw=0, label="its ±2 sd")
    axes.plot(time, error, color="#0072B2", lw=1.1, zorder=4, label="first run")


def _grid(
    names: Sequence[str], height: float, x: str, y: str, columns: int = COLUMNS, one_scale: bool = True
) -> tuple[Figure, list[Axes]]:
    """A panel per estimator, with its name above; x and y name the outer axes."""
    columns = min(columns, len(names))
    lines = -(-len(names) // columns)
    figure = new_figure(0.9 + height * lines, max(WIDTH * columns / COLUMNS, 0.6 * WIDTH))
    grid: list[Axes] = list(figure.subplots(lines, columns, sharex=True, sharey=one_scale, squeeze=False).flat)
    for i, (axes, name) in enumerate(zip(grid, names, strict=False)):
        axes.set_title(name, loc="left", fontsize=7, pad=3)
        if i % columns == 0:
            axes.set_ylabel(y, fontsize=8)
        if i >= len(names) - columns:
            axes.set_xlabel(x, fontsize=8)
            axes.tick_params(labelbottom=True)
    for axes in grid[len(names) :]:
        axes.remove()
    return figure, grid[: len(names)]


def _log_axis(axes: Axes, label: str) -> None:
    """A logarithmic axis with plain numbers, at 1, 2, 5 where there are few decades."""
    axes.set_xscale("log")
    axes.set_xlabel(label)
    low, high = axes.get_xlim()
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if high < 12.0 * low else (1.0,)))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(NullFormatter())
