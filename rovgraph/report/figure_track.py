"""The track seen from above, north up, with confidence ellipses."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rovgraph.config import Config
from rovgraph.estimators.estimate import Estimate
from rovgraph.geometry import Array
from rovgraph.log import Log
from rovgraph.report.colours import REJECTED, UNUSED, USED
from rovgraph.report.results import CHI2_99, ellipse_axes
from rovgraph.report.style import WIDTH, Clock, legend_below, line_of, name_of, new_figure, thin
from rovgraph.report.units import nice_step
from rovgraph.trajectory import Trajectory

ELLIPSES = 20  # along a track, at most
FIXES = 150  # of a kind that are drawn, at most
_HALO = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "boxstyle": "square,pad=0.1"}


def draw_track(estimates: Sequence[Estimate], log: Log, config: Config, reference: Trajectory | None = None) -> Figure:
    """North over east in metres, equal scales.

    Parameters
    ----------
    estimates : the leading one first; it carries the ellipses
    log : its fixes are drawn, if it has any
    config : names the figure
    reference : a known trajectory, or None
    """
    main = estimates[0]
    limits = _limits([e.trajectory for e in estimates] + ([reference] if reference is not None else []))
    figure = new_figure(*_size(limits))
    axes = figure.add_subplot()
    for estimate in estimates:
        _draw_line(axes, estimate.trajectory, estimate.kind, name_of(estimate.kind))
    if reference is not None:
        _draw_line(axes, reference, "reference", "reference")
    step = nice_step((main.trajectory.time[-1] - main.trajectory.time[0]) / ELLIPSES)
    _draw_ellipses(axes, main.trajectory, _at_times(main.trajectory, step), main.kind, f"99 % every {_spoken(step)}")
    for estimate in estimates[1:]:
        _draw_ellipses(
            axes, estimate.trajectory, np.array([len(estimate.trajectory) - 1]), estimate.kind, "99 % at the end"
        )
    outside = _draw_fixes(axes, main, log, limits)
    _draw_ends(axes, main)
    _name_axes(axes, limits, config.name, outside)
    legend_below(figure, [axes], 3)
    return figure


def _limits(tracks: Sequence[Trajectory]) -> Array:
    """What must be seen, [[east low, high], [north low, high]], with a margin [m].

    All tracks, the ellipses of the first one and the last ellipse of the others.
    """
    corners = [track.p_n[:, [1, 0]] for track in tracks]
    for i, track in enumerate(tracks):
        part = slice(None) if i == 0 else slice(-1, None)
        variance = np.diagonal(track.cov_p[part, :2, :2], axis1=1, axis2=2)[:, ::-1]
        reach = np.sqrt(CHI2_99 * np.nan_to_num(variance))
        corners += [corners[i][part] - reach, corners[i][part] + reach]
    everything = np.concatenate(corners)
    low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
    margin = 0.05 * max(float(np.max(high - low)), 1.0)
    return np.stack([low - margin, high + margin], axis=-1)


def _size(limits: Array) -> tuple[float, float]:
    """Height and width [in] of a figure whose axes hold the limits at equal scales."""
    east, north = limits[:, 1] - limits[:, 0]
    ratio = float(np.clip(north / east, 0.3, 1.35))
    return 1.5 + (WIDTH - 0.8) * ratio, WIDTH


def _spoken(step: float) -> str:
    return f"{step / 60:g} min" if step >= 60 else f"{step:g} s"


def _at_times(track: Trajectory, step: float) -> Array:
    """Indices of the epochs nearest to every multiple of a step, and the last one."""
    times = np.append(np.arange(track.time[0], track.time[-1], step), track.time[-1])
    return np.unique(np.clip(np.searchsorted(track.time, times), 0, len(track) - 1))


def _draw_line(axes: Axes, track: Trajectory, kind: str, label: str) -> None:
    some = thin(len(track))
    axes.plot(track.p_n[some, 1], track.p_n[some, 0], label=label, **line_of(kind))


def _draw_ellipses(axes: Axes, track: Trajectory, index: Array, kind: str, label: str) -> None:
    index = index[np.isfinite(track.cov_p[index, :2, :2]).all(axis=(1, 2))]
    if not len(index):
        return
    major, minor, bearing = ellipse_axes(track.cov_p[index])
    look = line_of(kind)
    face = look["color"] + "18" if len(index) > 1 else "none"
    ellipses = EllipseCollection(
        2 * major,
        2 * minor,
        90.0 - np.rad2deg(bearing),  # from east, counter-clockwise
        units="xy",
        offsets=track.p_n[index][:, [1, 0]],
        offset_transform=axes.transData,
        edgecolors=look["color"],
        linewidths=0.7,
        zorder=2.5,
        facecolors=face,
        linestyles=[look["linestyle"]],
    )
    axes.add_collection(ellipses)
    axes.plot(
        [], [], ls="none", marker="o", ms=8, mfc=face, mec=look["color"], mew=0.7, label=f"{label}, {name_of(kind)}"
    )


def _draw_fixes(axes: Axes, estimate: Estimate, log: Log, limits: Array) -> int:
    """Fixes used, rejected and not used; the number of those outside the limits."""
    if "fix" not in log:
        return 0
    stream, rows = log["fix"], estimate.residuals
    weight = rows[rows["sensor"] == "fix"].groupby("row")["weight"].min().reindex(stream.row).to_numpy(float)
    point = np.stack([stream["fix_east"], stream["fix_north"]], axis=-1)
    inside = ((point >= limits[:, 0]) & (point <= limits[:, 1])).all(axis=-1)
    groups: tuple[tuple[NDArray[np.bool_], str, dict[str, Any]], ...] = (
        (np.isnan(weight), "fix, not used", {"marker": ".", "color": UNUSED, "ms": 3, "zorder": 1}),
        (weight > 0, "fix, used", {"marker": "+", "color": USED, "ms": 5, "zorder": 1.5}),
        (weight <= 0, "fix, rejected", {"marker": "x", "color": REJECTED, "ms": 5, "zorder": 1.6}),
    )
    for chosen, label, look in groups:
        some = np.flatnonzero(chosen & inside)
        if len(some):
            some = some[thin(len(some), FIXES)]
            axes.plot(*point[some].T, linestyle="none", mew=0.8, label=label, **look)
    return int(np.sum(~inside & np.isfinite(point).all(axis=-1)))


def _draw_ends(axes: Axes, estimate: Estimate) -> None:
    north, east = estimate.trajectory.p_n[[0, -1], 0], estimate.trajectory.p_n[[0, -1], 1]
    look: dict[str, Any] = {"linestyle": "none", "color": "black", "zorder": 6}
    axes.plot(east[0], north[0], marker="o", ms=6, mfc="white", mew=1.2, label="start", **look)
    axes.plot(east[1], north[1], marker="s", ms=5.5, mew=1.2, label="end", **look)
    _draw_minutes(axes, estimate)


def _draw_minutes(axes: Axes, estimate: Estimate) -> None:
    """A few times along the track, so that its direction can be read."""
    track, clock = estimate.trajectory, Clock.of(estimate)
    step = nice_step((clock.end - clock.start) / 6)
    for i in _at_times(track, step)[1:-1]:
        text = _spoken(float(np.round((track.time[i] - clock.start) / step)) * step)
        north, east = track.p_n[i, :2]
        axes.plot(east, north, ".", color="black", ms=5, zorder=6)
        axes.annotate(text, (east, north), (4, 4), textcoords="offset points", fontsize=8, zorder=7, bbox=_HALO)


def _name_axes(axes: Axes, limits: Array, name: str, outside: int) -> None:
    axes.set_xlim(*limits[0])
    axes.set_ylim(*limits[1])
    axes.set_aspect("equal", adjustable="box")
    axes.set_xlabel("east [m]")
    axes.set_ylabel("north [m]")
    note = f" ({outside} {'fix' if outside == 1 else 'fixes'} outside the figure)" if outside else ""
    axes.set_title(f"{name}: track{note}", loc="left")
