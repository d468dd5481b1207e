"""Biases and calibration variables against time, with their priors."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rovgraph.estimators.estimate import CalibrationEstimate, Estimate
from rovgraph.geometry import Array
from rovgraph.report.colours import PRIOR
from rovgraph.report.results import history_labels
from rovgraph.report.style import Clock, legend_below, line_of, name_lowest, name_of, new_figure, panel_grid, thin
from rovgraph.report.units import plus_minus
from rovgraph.units import shown

COLUMNS = 3
SETTLED = 0.25  # of the dive; what is before it may leave the panel


@dataclass(frozen=True)
class _Curve:
    """One scalar component of one estimate's history, in the unit shown."""

    kind: str
    time: Array
    value: Array
    sd: Array


def draw_calibration(estimates: Sequence[Estimate]) -> Figure | None:
    """A panel per scalar component; None where nothing was estimated."""
    panels = _gather(estimates)
    if not panels:
        return None
    columns = min(COLUMNS, len(panels))
    figure = new_figure(1.0 + 1.75 * -(-len(panels) // columns))
    grid = panel_grid(figure, len(panels), columns)
    clock = Clock.of(estimates[0])
    entries = {c.label: c for c in estimates[0].calibration}
    for axes, (label, (unit, curves)) in zip(grid, panels.items(), strict=True):
        _panel(axes, curves, clock, _prior(entries.get(label)))
        axes.set_title(
            f"{label.replace('_', ' ')}\n{_last(curves, unit)}", loc="left", pad=4, linespacing=1.25, fontsize=8.5
        )
        axes.set_ylabel(f"[{unit}]")
    name_lowest(grid, columns, clock)
    thin_lines = f", thin lines ±2 sd of {name_of(estimates[0].kind)}" if len(estimates) > 1 else ""
    figure.suptitle(f"calibration: bands ±1 and ±2 sd{thin_lines}", x=0.01, ha="left", fontsize=9)
    legend_below(figure, grid)
    return figure


def _gather(estimates: Sequence[Estimate]) -> dict[str, tuple[str, list[_Curve]]]:
    """Label -> unit shown and the curves of all estimates."""
    panels: dict[str, tuple[str, list[_Curve]]] = {}
    for estimate in estimates:
        for variable, history in estimate.history.items():
            factor, unit = shown(history.unit)
            unit = unit.replace("s2", "s²")
            some = thin(len(history.time))
            for i, label in enumerate(history_labels(variable, history)):
                value, sd = factor * history.value[some, i], factor * history.sd[some, i]
                curve = _Curve(estimate.kind, history.time[some], value, sd)
                panels.setdefault(label, (unit, []))[1].append(curve)
    return panels


def _prior(entry: CalibrationEstimate | None) -> tuple[float, float] | None:
    """Mean and sd of a prior in the unit shown."""
    if entry is None:
        return None
    factor = shown(entry.unit)[0]
    return factor * entry.prior_mean, factor * entry.prior_sd


def _last(curves: list[_Curve], unit: str) -> str:
    """The value at the end of the leading estimate."""
    return plus_minus(float(curves[0].value[-1]), float(curves[0].sd[-1]), unit)


def _panel(axes: Axes, curves: list[_Curve], clock: Clock, prior: tuple[float, float] | None) -> None:
    limits = _limits(curves, clock)
    if prior is not None and prior[1] > 0:
        axes.axhspan(
            prior[0] - 2 * prior[1], prior[0] + 2 * prior[1], color=PRIOR, lw=0, zorder=0.5, label="prior ±2 sd"
        )
    for curve in curves:
        _draw_curve(axes, curve, clock(curve.time), shaded=curve is curves[-1])
    axes.set_ylim(*limits)
    axes.locator_params(axis="y", nbins=4)


def _draw_curve(axes: Axes, curve: _Curve, time: Array, shaded: bool) -> None:
    """A line with its bands, shaded or, where another one's are, as thin lines at ±2 sd."""
    look = line_of(curve.kind)
    axes.plot(time, curve.value, label=name_of(curve.kind), **look)
    for width, alpha in ((2, 0.16), (1, 0.22)):
        low, high = curve.value - width * curve.sd, curve.value + width * curve.sd
        if shaded:
            axes.fill_between(time, low, high, color=look["color"], alpha=alpha, lw=0, zorder=look["zorder"] - 2)
        elif width == 2:
            axes.plot(time, np.stack([low, high], axis=-1), color=look["color"], lw=0.6, zorder=look["zorder"])


def _limits(curves: list[_Curve], clock: Clock) -> tuple[float, float]:
    """Limits that hold every curve, and its ±2 sd once it has settled."""
    ends = np.concatenate(list(_extremes(curves, clock.start + SETTLED * (clock.end - clock.start))))
    ends = ends[np.isfinite(ends)]
    if not len(ends):
        return -1.0, 1.0
    low, high = float(ends.min()), float(ends.max())
    margin = 0.25 * (high - low) or max(1e-3 * abs(high), 1e-6)
    return low - margin, high + margin


def _extremes(curves: list[_Curve], settled: float) -> Iterator[Array]:
    for curve in curves:
        late = curve.time >= settled
        yield curve.value[late] - 2 * curve.sd[late]
        yield curve.value[late] + 2 * curve.sd[late]
