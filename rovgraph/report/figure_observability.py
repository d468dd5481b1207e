"""What a dive taught, and when; and what it left tied together."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rovgraph.estimators.observability import OBSERVABLE, OBSERVABLE_BELOW, UNOBSERVABLE_ABOVE, WEAK
from rovgraph.report.style import Clock, name_lowest, new_figure, panel_grid, save, style
from rovgraph.studies.observability import OTHER_LABELS, Observability
from rovgraph.units import shown

COLUMNS = 3
COLORS = {OBSERVABLE: "#009E73", WEAK: "#E69F00"}
UNKNOWN = "#A3206B"


def draw_observability(folder: Path, seen: Observability) -> list[Path]:
    """Both figures of a results folder."""
    with style():
        figures = {"learning.png": draw_learning(seen), "correlation.png": draw_correlation(seen)}
        return [save(figure, folder / name) for name, figure in figures.items()]


def draw_learning(seen: Observability) -> Figure:
    """sd against time, a panel per component, with the prior's and the verdict's limits."""
    count = len(seen.labels)
    columns = min(COLUMNS, count)
    figure = new_figure(0.9 + 1.6 * -(-count // columns))
    panels = panel_grid(figure, count, columns)
    clock = Clock(0.0, float(seen.time[-1]))
    for i, axes in enumerate(panels):
        factor, unit = shown(seen.variables[i].unit)
        prior = factor * seen.prior_sd[i]
        axes.axhline(prior, color="black", lw=0.8, ls=(0, (4, 2)))
        for limit in (OBSERVABLE_BELOW, UNOBSERVABLE_ABOVE):
            axes.axhline(limit * prior, color="#999999", lw=0.7, ls=(0, (1, 2)))
        color = COLORS.get(seen.verdicts[i], UNKNOWN)
        axes.plot(clock(seen.time), prior * seen.relative[:, i], color=color, lw=1.4, marker=".", ms=3)
        axes.set_ylim(0.0, 1.12 * prior)
        axes.set_title(f"{seen.labels[i].replace('_', ' ')}\n{seen.verdicts[i]}", loc="left", fontsize=8, pad=3)
        axes.set_ylabel(f"[{unit}]" if unit != "1" else "")
        axes.locator_params(axis="y", nbins=4)
    name_lowest(panels, columns, clock)
    figure.suptitle(
        f"sd given the data so far; dashed: prior, dotted: {OBSERVABLE_BELOW:g} and {UNOBSERVABLE_ABOVE:g} of it",
        x=0.01,
        ha="left",
        fontsize=9,
    )
    return figure


def draw_correlation(seen: Observability) -> Figure:
    """Correlations of the components with each other, with the last bias and with the first attitude."""
    names = [*seen.labels, *OTHER_LABELS]
    rows, columns = len(seen.labels), len(names)
    figure = new_figure(1.9 + 0.24 * rows, max(4.5, 2.2 + 0.24 * columns))
    axes = figure.subplots()
    image = axes.imshow(seen.correlation, cmap="RdBu_r", vmin=-1.0, vmax=1.0, aspect="equal")
    axes.set_xticks(np.arange(columns), [n.replace("_", " ") for n in names], rotation=90, fontsize=6.5)
    axes.set_yticks(np.arange(rows), [n.replace("_", " ") for n in seen.labels], fontsize=6.5)
    axes.axvline(rows - 0.5, color="black", lw=0.8)
    axes.grid(False)
    figure.colorbar(image, ax=axes, shrink=0.8, label="correlation")
    figure.suptitle("correlation after the dive; right: last bias, first attitude", x=0.01, ha="left", fontsize=9)
    return figure
