"""Normalised innovations of every sensor: do the measurements fit as well as believed?"""

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rovgraph.estimators.estimate import Estimate
from rovgraph.geometry import Array
from rovgraph.report.colours import REJECTED
from rovgraph.report.style import Clock, legend_below, line_of, name_lowest, name_of, new_figure, panel_grid, thin

LIMIT = 6.0  # [sd]; what lies beyond is drawn at the edge


def draw_residuals(estimate: Estimate) -> Figure | None:
    """A panel per sensor and component; None where there are no residuals."""
    groups = list(estimate.residuals.groupby(["sensor", "component"], sort=False))
    if not groups:
        return None
    columns = 1 if len(groups) <= 3 else 2
    figure = new_figure(1.1 + 1.45 * -(-len(groups) // columns))
    panels = panel_grid(figure, len(groups), columns)
    clock = Clock.of(estimate)
    for axes, (key, rows) in zip(panels, groups, strict=True):
        sensor, component = key
        _panel(axes, rows, clock, _title(str(sensor), str(component)))
    name_lowest(panels, columns, clock)
    figure.suptitle(
        f"normalised innovations, {name_of(estimate.kind)}; triangles lie beyond ±{LIMIT:g}",
        x=0.01,
        ha="left",
        fontsize=9,
    )
    figure.supylabel("innovation / sd [1]", fontsize=9)
    legend_below(figure, panels, scale=1.8)
    return figure


def _title(sensor: str, component: str) -> str:
    name = component if component.startswith(sensor) else f"{sensor} {component}"
    return name.replace("_", " ").replace("heading heading", "heading")


def _panel(axes: Axes, rows: pd.DataFrame, clock: Clock, title: str) -> None:
    time = clock(rows["time"].to_numpy(float))
    value, weight = rows["normalised"].to_numpy(float), rows["weight"].to_numpy(float)
    kept = (weight > 0) & np.isfinite(value)
    axes.axhline(0.0, color="#666666", lw=0.6, zorder=1)
    for bound in (-3.0, 3.0):
        axes.axhline(bound, color="black", lw=0.8, ls=(0, (5, 3)), zorder=3)
    some = np.flatnonzero(kept)
    some = some[thin(len(some))]
    _points(
        axes,
        time[some],
        value[some],
        "used",
        {"color": line_of("smoothed")["color"], "marker": ".", "ms": 2.0, "alpha": 0.6},
    )
    gone = np.flatnonzero(~kept & np.isfinite(value))
    gone = gone[thin(len(gone))]
    if len(gone):
        _points(axes, time[gone], value[gone], "rejected", {"color": REJECTED, "marker": "x", "ms": 4, "mew": 0.8})
    mean_square = f"{np.mean(value[kept] ** 2):.2f}" if kept.any() else "unknown"
    rejected = f", {np.sum(~kept)} rejected" if not kept.all() else ""
    axes.set_title(f"{title}: mean square {mean_square}{rejected}", loc="left", pad=5)
    axes.set_ylim(-LIMIT - 0.4, LIMIT + 0.4)
    axes.set_yticks([-6, -3, 0, 3, 6])


def _points(axes: Axes, time: Array, value: Array, label: str, look: dict[str, Any]) -> None:
    """Points inside the panel, and triangles at the edge for those beyond."""
    inside = np.abs(value) <= LIMIT
    axes.plot(time[inside], value[inside], ls="none", zorder=2, label=label, **look)
    for side, marker in ((1.0, "^"), (-1.0, "v")):
        beyond = time[value * side > LIMIT]
        if len(beyond):
            edge = np.full(len(beyond), side * LIMIT)
            axes.plot(beyond, edge, ls="none", marker=marker, ms=3.2, mew=0, color=look["color"], zorder=4)
