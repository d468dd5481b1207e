"""The figures of a results folder: track, velocity, attitude, depth, biases, calibration and innovations.

Drawn with matplotlib's objects on an Agg canvas: without display and without pyplot's global state. Biases and
calibration variables are drawn against time with their priors, the track from above, north up, with confidence
ellipses, and normalised innovations of every sensor to show whether the measurements fit their stated noise.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rovgraph.errors import InputError, kind_of
from rovgraph.geometry import Array, matrix_from_rpy, rotate, wrap_angle
from rovgraph.inference.bottom import Bottom, bottom_of
from rovgraph.inference.estimate import CalibrationEstimate, Estimate
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import Log
from rovgraph.log.units import shown
from rovgraph.model.config import Config, beliefs, mount_matrix
from rovgraph.report.colours import PRIOR, REJECTED, UNUSED, USED
from rovgraph.report.motion import Series, axis_limits, lower_end, motion, span, unwrapped, within
from rovgraph.report.results import CHI2_99, ellipse_axes, history_labels, main_first
from rovgraph.report.style import (
    WIDTH,
    TimeAxis,
    legend_below,
    line_of,
    name_lowest,
    name_of,
    new_figure,
    panel_grid,
    save,
    style,
    thin,
)
from rovgraph.report.units import nice_step, plus_minus
from rovgraph.sensors.compass import declination

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
    clock = TimeAxis.of(estimates[0])
    entries = {c.label: c for c in estimates[0].calibration}
    for axes, (label, (unit, curves)) in zip(grid, panels.items(), strict=True):
        _calibration_panel(axes, curves, clock, _prior(entries.get(label)))
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


def _calibration_panel(axes: Axes, curves: list[_Curve], clock: TimeAxis, prior: tuple[float, float] | None) -> None:
    limits = _calibration_limits(curves, clock)
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


def _calibration_limits(curves: list[_Curve], clock: TimeAxis) -> tuple[float, float]:
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


SOURCES: dict[str, tuple[str, dict[str, Any]]] = {
    "ahrs": ("AHRS heading", {"marker": ".", "color": "#999999"}),
    "dvl_heading": ("DVL compass", {"marker": "x", "color": "#009E73", "mew": 0.5}),
    "mag": ("magnetometer", {"marker": "+", "color": "#E69F00", "mew": 0.5}),
}
BOTTOM: dict[str, Any] = {"color": "#8C6D46", "linewidth": 0.9, "zorder": 1}
MOST_SAMPLES = 1500  # of a heading source
DENSE = 2000  # epochs from which lines are drawn thinner
BAND = 2.0  # sds


def draw_velocity(estimates: Sequence[Estimate]) -> Figure:
    """Velocity north, east, down and speed over ground, with ±2 sd."""
    figure = new_figure(7.2)
    names = ("north", "east", "down", "speed")
    panels: list[Axes] = list(figure.subplots(len(names), 1, sharex=True))
    clock = TimeAxis.of(estimates[0])
    motions = [(estimate, _motion(estimate.trajectory)) for estimate in estimates]
    for axes, name in zip(panels, names, strict=True):
        _series(axes, clock, [(estimate, found[name]) for estimate, found in motions])
        axes.set_ylabel(f"{name} [m/s]")
    panels[3].set_ylim(bottom=0.0)
    panels[0].set_title("velocity over ground, bands ±2 sd", loc="left")
    clock.name_axis(panels[3])
    figure.align_ylabels()
    legend_below(figure, panels)
    return figure


def _motion(track: Trajectory, low: float = 0.0) -> dict[str, Series]:
    """The series of a trajectory."""
    columns = {**track.columns(), "cov_v_north_east": track.cov_v[:, 0, 1]}
    return motion(columns.__getitem__, low)


def _series(
    axes: Axes,
    clock: TimeAxis,
    series: Sequence[tuple[Estimate, Series]],
    more: Sequence[tuple[float, float]] = (),
) -> None:
    """A line and a band of each estimate, and the axis that shows them and ``more``."""
    spans = [*more]
    for estimate, one in series:
        time, some = estimate.trajectory.time, thin(len(estimate.trajectory))
        _line_and_band(axes, clock(time[some]), one.value[some], one.sd[some], estimate.kind)
        spans.append(span(time, one.value, one.sd, BAND))
    limits = axis_limits(spans)
    if limits is not None:
        axes.set_ylim(*limits)


def draw_depth(estimates: Sequence[Estimate], log: Log, config: Config) -> Figure:
    """Depth with ±2 sd, the bottom below it and the altitude over it where the DVL measured ranges."""
    clock = TimeAxis.of(estimates[0])
    bottom = bottom_of(log, config, estimates[0])
    has_bottom = bottom is not None
    figure = new_figure(4.8 if has_bottom else 3.6)
    panels: list[Axes] = list(figure.subplots(1 + has_bottom, 1, sharex=True, squeeze=False)[:, 0])
    panels[0].set_title("depth, bands ±2 sd" + ("; bottom and altitude by the DVL" if has_bottom else ""), loc="left")
    _draw_depth(panels[0], estimates, bottom, clock)
    if bottom is not None:
        _draw_altitude(panels[1], bottom, clock)
    clock.name_axis(panels[-1])
    figure.align_ylabels()
    legend_below(figure, panels)
    return figure


def _draw_depth(axes: Axes, estimates: Sequence[Estimate], bottom: Bottom | None, clock: TimeAxis) -> None:
    """Depth, growing downwards, and the bottom where it is known."""
    more = []
    if bottom is not None:
        some = thin(len(bottom.time))
        time, below = bottom.time[some], (bottom.place[:, 2] + bottom.plane[:, 0])[some]
        axes.plot(clock(time), below, label="bottom", **BOTTOM)
        more.append(span(time, below, np.zeros_like(below), BAND))
    _series(axes, clock, [(estimate, _motion(estimate.trajectory)["depth"]) for estimate in estimates], more)
    axes.yaxis.set_inverted(True)
    axes.set_ylabel("depth [m]")


def _draw_altitude(axes: Axes, bottom: Bottom, clock: TimeAxis) -> None:
    some = thin(len(bottom.time))
    axes.plot(clock(bottom.time[some]), bottom.plane[some, 0], **BOTTOM)
    axes.set_ylabel("altitude [m]")
    axes.set_ylim(bottom=0.0)


def draw_attitude(estimates: Sequence[Estimate], log: Log, config: Config) -> Figure:
    """Roll, pitch and heading with ±2 sd, and the compasses' headings."""
    main, clock = estimates[0], TimeAxis.of(estimates[0])
    samples = heading_samples(main.trajectory, log, config)
    heights = (1.0, 1.0, 1.6, 1.1) if samples else (1.0, 1.0, 1.6)
    figure = new_figure(1.0 + 1.6 * sum(heights))
    panels: list[Axes] = list(figure.subplots(len(heights), 1, sharex=True, height_ratios=heights))
    low = lower_end(main.trajectory.rpy[:, 2])
    motions = [(estimate, _motion(estimate.trajectory, low)) for estimate in estimates]
    for axes, name in zip(panels, ("roll", "pitch"), strict=False):
        _series(axes, clock, [(estimate, found[name]) for estimate, found in motions])
    _draw_headings(panels[2], motions, samples, low, clock)
    for sensor, (time, heading) in samples.items():
        look = SOURCES[sensor][1]
        difference = np.rad2deg(wrap_angle(heading - main.trajectory.clamped(time).rpy[:, 2]))
        panels[3].plot(clock(time), difference, ls="none", ms=2.5, alpha=0.6, **look)
    names = ("roll", "pitch", "heading", f"compass − {name_of(main.kind)}")
    for axes, name in zip(panels, names, strict=False):
        axes.set_ylabel(f"{name} [deg]")
    title = "attitude, bands ±2 sd" + ("; compasses before their calibration" if samples else "")
    panels[0].set_title(title, loc="left")
    clock.name_axis(panels[-1])
    figure.align_ylabels()
    legend_below(figure, panels, 5, 2.0)
    return figure


def _draw_headings(
    axes: Axes,
    motions: Sequence[tuple[Estimate, dict[str, Series]]],
    samples: dict[str, tuple[Array, Array]],
    low: float,
    clock: TimeAxis,
) -> None:
    """Headings of estimates and compasses, broken where they pass the end of the axis."""
    for estimate, found in motions:
        some, heading = thin(len(estimate.trajectory)), found["heading"]
        lines = unwrapped(clock(estimate.trajectory.time[some]), heading.value[some], heading.sd[some])
        _line_and_band(axes, lines[0], lines[1], lines[2], estimate.kind)
    for sensor, (time, heading_s) in samples.items():
        label, look = SOURCES[sensor]
        axes.plot(clock(time), within(heading_s, low), ls="none", ms=2.5, label=label, zorder=1, alpha=0.6, **look)
    _limit_heading(axes, low)


def heading_samples(track: Trajectory, log: Log, config: Config) -> dict[str, tuple[Array, Array]]:
    """True heading of the body as each compass has it, before any deviation is taken off.

    Instruments are taken as level: their mounting turns the heading by the azimuth of
    their x axis. The magnetometer is levelled with the estimate's roll and pitch.

    Returns
    -------
    sensor -> (time [s], heading [rad]), each ndarray, shape (m,)
    """
    prior = beliefs(config)
    R_dvl = matrix_from_rpy([float(prior[f"dvl_{angle}"].mean[0]) for angle in ("roll", "pitch", "yaw")])
    R_imu = mount_matrix(config.imu.mount_rpy_deg)
    out = {}
    for sensor, column, R_bs in (("ahrs", "ahrs_yaw", R_imu), ("dvl_heading", "dvl_heading", R_dvl)):
        if sensor in log:
            some = thin(len(log[sensor]), MOST_SAMPLES)
            azimuth = np.arctan2(R_bs[1, 0], R_bs[0, 0])
            out[sensor] = (log[sensor].time[some], log[sensor][column][some] + declination(config, sensor) - azimuth)
    if "mag" in log:
        some = thin(len(log["mag"]), MOST_SAMPLES)
        time = log["mag"].time[some]
        magnetic = _levelled(track.clamped(time), rotate(R_imu, log["mag"].data[some]))
        out["mag"] = (time, magnetic + declination(config, "mag"))
    return out


def _levelled(track: Trajectory, field_b: Array) -> Array:
    """Magnetic heading from a field in body axes at the attitudes of a track [rad]."""
    rpy = track.rpy
    level = rotate(matrix_from_rpy(np.column_stack([rpy[:, :2], np.zeros(len(rpy))])), field_b)
    return np.arctan2(-level[:, 1], level[:, 0])


def _line_and_band(axes: Axes, time: Array, value: Array, sd: Array, kind: str) -> None:
    look = line_of(kind)
    if len(time) > DENSE:
        look = {**look, "linewidth": 0.65 * look["linewidth"]}
    axes.plot(time, value, label=name_of(kind), **look)
    if np.isfinite(sd).any():
        band = {"color": look["color"], "alpha": 0.18, "linewidth": 0, "zorder": look["zorder"] - 2}
        axes.fill_between(time, value - BAND * sd, value + BAND * sd, **band)


def _limit_heading(axes: Axes, low: float) -> None:
    """No axis beyond one turn; over most of a turn, all of it with ticks at the quarters."""
    bottom, top = np.clip(axes.get_ylim(), low, low + 360.0)
    if top - bottom > 220.0:
        bottom, top = low, low + 360.0
        axes.set_yticks(np.arange(low, low + 361.0, 90.0))
    axes.set_ylim(bottom, top)


LIMIT = 6.0  # [sd]; what lies beyond is drawn at the edge


def draw_residuals(estimate: Estimate) -> Figure | None:
    """A panel per sensor and component; None where there are no residuals."""
    groups = list(estimate.residuals.groupby(["sensor", "component"], sort=False))
    if not groups:
        return None
    columns = 1 if len(groups) <= 3 else 2
    figure = new_figure(1.1 + 1.45 * -(-len(groups) // columns))
    panels = panel_grid(figure, len(groups), columns)
    clock = TimeAxis.of(estimate)
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


def _panel(axes: Axes, rows: pd.DataFrame, clock: TimeAxis, title: str) -> None:
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
    limits = _limits([e.trajectory for e in estimates] + ([reference] if reference is not None else []))
    figure = new_figure(*_size(limits))
    axes = figure.add_subplot()
    _draw_track(axes, estimates, log, config, limits, reference)
    legend_below(figure, [axes], 3)
    return figure


def _draw_track(
    axes: Axes,
    estimates: Sequence[Estimate],
    log: Log,
    config: Config,
    limits: Array,
    reference: Trajectory | None = None,
) -> None:
    main = estimates[0]
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
    track, clock = estimate.trajectory, TimeAxis.of(estimate)
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


def draw_figures(
    folder: Path,
    estimates: Sequence[Estimate],
    log: Log,
    config: Config,
    reference: Trajectory | None = None,
    form: str = "png",
) -> list[Path]:
    """Draw every figure that the estimates have data for.

    Parameters
    ----------
    folder : an existing folder
    estimates : of one log; the smoothed one leads where there is one
    log, config : what they were made from
    reference : a known trajectory to draw beside them, or None
    form : "png", "pdf" or "svg"

    Returns
    -------
    list of Path : the files written
    """
    estimates = main_first(estimates)
    # dead reckoning differentiates every ping: against time it would hide the others
    over_time = [e for e in estimates if e.kind != "dead_reckoning"] or estimates
    with style():
        figures = {
            "track": draw_track(estimates, log, config, reference),
            "velocity": draw_velocity(over_time),
            "attitude": draw_attitude(over_time, log, config),
            "depth": draw_depth(over_time, log, config),
            "residuals": draw_residuals(estimates[0]),
            "calibration": draw_calibration(over_time),
        }
        return [save(figure, folder / f"{name}.{form}") for name, figure in figures.items() if figure is not None]


@dataclass(frozen=True)
class Plot:
    """Quantities of a dive on axes of your own: `Result.plot`.

    Each method takes matplotlib's axes, None = new ones of pyplot in the style of the figures, and the names of the
    estimates to draw, none = the main one. It returns the axes. Bands hold two sds to each side; time counts from the
    start of the first estimate, in seconds, or in minutes where it is longer than 20 of them. Lines have labels:
    ``axes.legend()`` names them.

    Raises
    ------
    InputError : what was given is no axes, the result has no such estimate, or the log has none of the quantity

    Attributes
    ----------
    main : the estimate that is drawn where none is named
    of : name -> estimate
    log, config : what the estimates were made from
    """

    main: Estimate
    of: Callable[[str], Estimate]
    log: Log
    config: Config

    def track(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """North over east [m] with 99 % ellipses, fixes, start and end, at equal scales."""
        chosen = self._chosen(estimates)
        limits = _limits([estimate.trajectory for estimate in chosen])
        axes = _axes(axes)
        _draw_track(axes, chosen, self.log, self.config, limits)
        return axes

    def depth(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """Depth [m], growing downwards, and the bottom where the DVL measured ranges."""
        chosen, axes = self._chosen(estimates), _axes(axes)
        _draw_depth(axes, chosen, bottom_of(self.log, self.config, chosen[0]), TimeAxis.of(chosen[0]))
        return self._over_time(axes, chosen)

    def altitude(self, axes: Axes | None = None) -> Axes:
        """Height over the bottom [m], by the ranges of the DVL's beams or its altitude."""
        bottom = bottom_of(self.log, self.config, self.main)
        if bottom is None:
            raise InputError(f"{self.log.source}: no altitude to draw; the log has no dvl_altitude and no ranges")
        axes = _axes(axes)
        _draw_altitude(axes, bottom, TimeAxis.of(self.main))
        return self._over_time(axes, [self.main])

    def heading(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """True heading [deg], and that of each compass before its calibration."""
        chosen, axes = self._chosen(estimates), _axes(axes)
        low = lower_end(chosen[0].trajectory.rpy[:, 2])
        samples = heading_samples(chosen[0].trajectory, self.log, self.config)
        motions = [(estimate, _motion(estimate.trajectory, low)) for estimate in chosen]
        _draw_headings(axes, motions, samples, low, TimeAxis.of(chosen[0]))
        axes.set_ylabel("heading [deg]")
        return self._over_time(axes, chosen)

    def roll(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """Roll [deg]."""
        return self._line(axes, estimates, "roll", "roll [deg]")

    def pitch(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """Pitch [deg]."""
        return self._line(axes, estimates, "pitch", "pitch [deg]")

    def speed(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """Horizontal speed over ground [m/s]."""
        axes = self._line(axes, estimates, "speed", "speed [m/s]")
        axes.set_ylim(bottom=0.0)
        return axes

    def sd(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """sd of the horizontal position along its worst direction [m]."""

        def worst(track: Trajectory) -> Array:
            known = np.asarray(np.isfinite(track.cov_p).all(axis=(1, 2)))
            major = ellipse_axes(np.where(known[:, None, None], track.cov_p, 0.0))[0]
            return np.where(known, major / np.sqrt(CHI2_99), np.nan)

        return self._sds(axes, estimates, worst, "sd of position [m]")

    def heading_sd(self, axes: Axes | None = None, *estimates: str) -> Axes:
        """sd of the heading [deg]."""
        return self._sds(axes, estimates, lambda track: np.rad2deg(track.rpy_sd[:, 2]), "sd of heading [deg]")

    def _chosen(self, names: Sequence[str]) -> list[Estimate]:
        return [self.of(name) for name in names] or [self.main]

    def _line(self, axes: Axes | None, names: Sequence[str], quantity: str, label: str) -> Axes:
        chosen, axes = self._chosen(names), _axes(axes)
        found = [(estimate, _motion(estimate.trajectory)[quantity]) for estimate in chosen]
        _series(axes, TimeAxis.of(chosen[0]), found)
        axes.set_ylabel(label)
        return self._over_time(axes, chosen)

    def _sds(self, axes: Axes | None, names: Sequence[str], of: Callable[[Trajectory], Array], label: str) -> Axes:
        chosen, axes = self._chosen(names), _axes(axes)
        sds = [(estimate, of(estimate.trajectory)) for estimate in chosen]
        lines = [(estimate, Series(label, "", sd, np.full_like(sd, np.nan))) for estimate, sd in sds]
        _series(axes, TimeAxis.of(chosen[0]), lines, [(0.0, 0.0)])
        axes.set_ylim(bottom=0.0)
        axes.set_ylabel(label)
        return self._over_time(axes, chosen)

    def _over_time(self, axes: Axes, estimates: Sequence[Estimate]) -> Axes:
        TimeAxis.of(estimates[0]).name_axis(axes)
        return axes


def _axes(given: object) -> Axes:
    """Axes that were given, or new ones that a notebook and ``pyplot.show`` know."""
    if given is None:
        from matplotlib import pyplot

        with style():
            return pyplot.subplots(figsize=(WIDTH, 3.6), layout="constrained")[1]
    if not isinstance(given, Axes):
        raise InputError(f"axes: expected matplotlib's Axes or None, found {kind_of(given)}; estimates come after it")
    return given
