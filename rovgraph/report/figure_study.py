"""Figures of a study of the misalignment: error against time, coverage, and sd by manoeuvre and inertial unit."""

from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rovgraph.report.study import labels, unless_said
from rovgraph.report.style import WIDTH, legend_below, new_figure, save, style
from rovgraph.studies.misalignment import Tables

HONEST, DISHONEST, PREDICTED = "#0072B2", "#D55E00", "#009E73"
MOST_PANELS, MOST_BARS, COLUMNS = 12, 60, 3
TO_95 = 1.96  # sd
TITLE_WIDTH = 40  # of a panel, letters
SETTLED = 0.2  # of the dive; the error may leave its panel before


def draw_study(folder: Path, tables: Tables) -> list[Path]:
    """Draw every figure that there are data for.

    Parameters
    ----------
    folder : an existing folder
    tables : of `rovgraph.studies.misalignment.study`

    Returns
    -------
    list of Path : the PNG files written
    """
    known = tables.cells["coverage"].notna()
    if not known.any():
        return []
    with style():
        figures = {
            "error.png": draw_error(tables),
            "coverage.png": draw_coverage(tables),
            "sd.png": draw_sd(tables.cells[known]),
        }
        return [save(figure, folder / name) for name, figure in figures.items() if figure is not None]


def draw_error(tables: Tables) -> Figure | None:
    """Error against time: band that 90 % of the runs are in, and what the filter says, ±1.96 sd; a panel per cell."""
    names = dict(zip(tables.cells["cell"], labels(tables), strict=True))
    chosen = [cell for cell in names if (tables.history["cell"] == cell).any()][:MOST_PANELS]
    if not chosen:
        return None
    columns = min(COLUMNS, len(chosen))
    lines = -(-len(chosen) // columns)
    figure = new_figure(0.7 + 1.7 * lines, max(WIDTH * columns / COLUMNS, 0.6 * WIDTH))
    panels = list(figure.subplots(lines, columns, squeeze=False).flat)
    for i, (axes, cell) in enumerate(zip(panels, chosen, strict=False)):
        _error_panel(axes, tables.history[tables.history["cell"] == cell])
        axes.set_title(fill(names[cell], TITLE_WIDTH), loc="left", fontsize=7, pad=3)
        if i % columns == 0:
            axes.set_ylabel("error [deg]")
        if i >= len(chosen) - columns:
            axes.set_xlabel("time [s]")
    for axes in panels[len(chosen) :]:
        axes.remove()
    legend_below(figure, panels[: len(chosen)], 3)
    _say_the_rest(figure, tables)
    return figure


def _say_the_rest(figure: Figure, tables: Tables) -> None:
    if remark := unless_said(tables):
        figure.suptitle(fill(remark, 130), x=0.01, ha="left", fontsize=7)


def _error_panel(axes: Axes, rows: pd.DataFrame) -> None:
    by_time = rows.groupby("time_s")
    time = by_time["time_s"].first().to_numpy(float)
    error = np.column_stack([by_time["error_deg"].quantile(part) for part in (0.05, 0.5, 0.95)])
    sd = TO_95 * by_time["sd_deg"].median().to_numpy()
    axes.fill_between(time, error[:, 0], error[:, 2], color=HONEST, alpha=0.25, lw=0, label="90 % of the runs")
    axes.plot(time, error[:, 1], color=HONEST, lw=1.2, label="median error")
    for sign in (1.0, -1.0):
        axes.plot(time, sign * sd, color=PREDICTED, lw=1.0, ls=(0, (4, 1.5)), label="±1.96 predicted sd")
    axes.axhline(0.0, color="black", lw=0.5)
    late = time >= SETTLED * time[-1]
    top = 1.15 * max(float(np.abs(error[late]).max()), float(sd[late].max()))
    axes.set_ylim(-top, top)
    axes.set_xlim(0.0, time[-1])


def draw_coverage(tables: Tables) -> Figure:
    """Share of runs whose 95 % interval holds the truth, with its binomial interval; a row per cell."""
    names = labels(tables)
    known = tables.cells[tables.cells["coverage"].notna()].head(MOST_BARS)
    figure = new_figure(0.9 + 0.19 * len(known))
    axes = figure.subplots()
    for y, (_, row) in enumerate(known.iterrows()):
        low, mid, high = (100 * row[name] for name in ("coverage_low", "coverage", "coverage_high"))
        color = HONEST if low <= 95.0 <= high else DISHONEST
        axes.plot([low, high], [y, y], color=color, lw=1.4)
        axes.plot([mid], [y], "o", color=color, ms=4)
    axes.axvline(95.0, color="black", lw=0.8, ls=(0, (4, 2)))
    axes.set_yticks(range(len(known)), [names[int(i)] for i in known.index], fontsize=7)
    axes.set_ylim(len(known) - 0.4, -0.6)
    axes.set_xlim(0.0, 101.0)
    axes.set_xlabel("runs within their 95 % interval [%]")
    _say_the_rest(figure, tables)
    return figure


def draw_sd(cells: pd.DataFrame) -> Figure:
    """Predicted sd, median over the other parameters, by manoeuvre and inertial unit; a panel per heading error."""
    several = cells.groupby("heading_error", sort=False)["manoeuvre"].nunique()
    errors = list(several.index[several > 0.5 * several.max()])  # where the comparison is worth a panel
    manoeuvres, grades = (list(dict.fromkeys(cells[name])) for name in ("manoeuvre", "imu"))
    tables = [_grid(cells[cells["heading_error"] == e], manoeuvres, grades) for e in errors]
    seen = np.concatenate([t[np.isfinite(t)] for t in tables])
    scale: dict[str, Any] = {"norm": "log", "vmin": seen.min(), "vmax": max(seen.max(), 1.01 * seen.min())}
    figure = new_figure(1.0 + 0.34 * len(manoeuvres), max(WIDTH * 0.45, min(WIDTH, 2.6 * len(errors))))
    panels = figure.subplots(1, len(errors), sharey=True, squeeze=False)[0]
    for axes, error, values in zip(panels, errors, tables, strict=True):
        image = axes.imshow(values, aspect="auto", cmap="viridis_r", **scale)
        axes.set_title(f"heading error: {error}", loc="left")
        axes.set_xticks(range(len(grades)), grades)
        axes.set_yticks(range(len(manoeuvres)), manoeuvres)
        axes.grid(visible=False)
        middle = float(np.sqrt(scale["vmin"] * scale["vmax"]))
        for (i, j), value in np.ndenumerate(values):
            if np.isfinite(value):
                color = "white" if value > middle else "black"
                axes.text(j, i, f"{value:.2g}", ha="center", va="center", fontsize=8, color=color)
    ticks = np.geomspace(scale["vmin"], scale["vmax"], 4)
    figure.colorbar(image, ax=panels, label="predicted sd [deg]", ticks=ticks, format="%.3g").minorticks_off()
    return figure


def _grid(cells: pd.DataFrame, manoeuvres: list[str], grades: list[str]) -> Any:
    table = cells.pivot_table("predicted_sd_deg", "manoeuvre", "imu", "median")
    return table.reindex(index=manoeuvres, columns=grades).to_numpy(float)
