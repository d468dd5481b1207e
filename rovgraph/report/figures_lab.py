"""Figures of calibrate, compare, study, observe and plan.

`calibrate`: a magnetometer's samples before and after, as the sphere from three sides and as the field's length; noise
of sensors at rest as Allan deviations with the fitted slopes, and as spectra with their lines named. `compare`: errors,
end points, velocity and misalignment, a row or a panel for each estimator. `study`: error against time, coverage, and
sd by manoeuvre and inertial unit. `observe`: what a dive shows of the calibration and when, and what it leaves
correlated. `plan`: the ranking, and the path of the best.
"""

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import LogLocator, NullFormatter
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.observability import OBSERVABLE, OBSERVABLE_BELOW, UNOBSERVABLE_ABOVE, WEAK
from rovgraph.lab.calibrate import MagnetometerCalibration, NoiseReport
from rovgraph.lab.calibrate.noise import ColumnNoise, Peak
from rovgraph.lab.compare import REFERENCE, Comparison
from rovgraph.lab.misalignment import Tables
from rovgraph.lab.observability import OTHER_LABELS, Observability
from rovgraph.lab.plan import Plan
from rovgraph.log.units import shown
from rovgraph.report.colours import PRIOR, REJECTED, UNUSED
from rovgraph.report.lab import labels, unless_said
from rovgraph.report.results import ellipse_axes
from rovgraph.report.style import WIDTH, TimeAxis, legend_below, name_lowest, new_figure, panel_grid, save, style, thin

BEFORE, AFTER = "#D55E00", "#0072B2"
_SIDES = ((0, 1), (0, 2), (1, 2))
_MOST = 3000  # points of a projection


def draw_magnetometer(found: MagnetometerCalibration) -> Figure:
    """Three projections with equal axes before and after, and the length of the field against time."""
    figure = new_figure(7.4)
    grid = figure.add_gridspec(3, 3, height_ratios=(1.0, 1.0, 0.75))
    clouds = ((found.samples, BEFORE, "before"), (found.field, AFTER, "after"))
    some = thin(len(found.time), _MOST)
    reach = max(float(np.abs(cloud[found.used]).max()) for cloud, _, _ in clouds) * 1.08
    for row, (cloud, colour, name) in enumerate(clouds):
        for column, side in enumerate(_SIDES):
            axes = figure.add_subplot(grid[row, column])
            _projection(axes, cloud[some], found.used[some], side, colour, name)
            axes.add_patch(
                Circle((0.0, 0.0), found.length, fill=False, color="black", lw=0.8, ls=(0, (4, 2)), zorder=5)
            )
            axes.set_xlim(-reach, reach)
            axes.set_ylim(-reach, reach)
            axes.set_title(f"{name}: {'xyz'[side[0]]}, {'xyz'[side[1]]}", loc="left")
    axes = figure.add_subplot(grid[2, :])
    _lengths(axes, found, clouds)
    legend_below(figure, [*figure.axes], ncols=4, scale=2.5)
    title = (
        f"magnetometer, IMU axes, log's unit: scatter of the field's length "
        f"{100 * found.before.length_rms:.2f} % → {100 * found.after.length_rms:.2f} %; dashed: the field's length"
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=9)
    return figure


def _projection(
    axes: Axes, cloud: Array, used: NDArray[np.bool_], side: tuple[int, int], colour: str, name: str
) -> None:
    look: dict[str, Any] = {"ls": "none", "marker": ".", "ms": 2.2, "mew": 0}
    x, y = cloud[:, side[0]], cloud[:, side[1]]
    axes.plot(x[used], y[used], color=colour, label=name, **look)
    if not used.all():
        axes.plot(x[~used], y[~used], color=REJECTED, alpha=0.5, label="left out: disturbed", **look)
    axes.plot(0.0, 0.0, marker="+", ms=7, color="black", zorder=6)
    axes.set_aspect("equal")
    axes.locator_params(nbins=5)


def _lengths(axes: Axes, found: MagnetometerCalibration, clouds: tuple[tuple[Array, str, str], ...]) -> None:
    """Length against time, with the disturbances."""
    clock = TimeAxis(float(found.time[0]), float(found.time[-1]))
    some = thin(len(found.time))
    for cloud, colour, _ in clouds:
        length = np.linalg.norm(cloud[some], axis=1)
        axes.plot(clock(found.time[some]), length, color=colour, lw=0.6)
    for d in found.disturbances or []:
        low, high = clock(np.array([d.start, d.end]))
        axes.axvspan(low, high, color=PRIOR, lw=0, zorder=0.5, label="disturbance")
        vector = ", ".join(f"{x:.3g}" for x in d.vector)
        axes.annotate(
            f"({vector})",
            (0.5 * (low + high), 1.0),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="bottom",
            fontsize=8,
        )
    axes.set_ylabel("field's length")
    clock.name_axis(axes)


COLOURS = ("#0072B2", "#D55E00", "#009E73")
STYLES = ("-", (0, (4, 1.5)), (0, (1, 1.2)))
NOISE_COLUMNS = 2
_NAMES = {
    "acc": "accelerometer",
    "gyr": "gyro",
    "mag": "magnetometer",
    "dvl": "DVL velocity",
    "dvl_heading": "DVL heading",
    "ahrs": "IMU's own heading",
}


def draw_allan(found: NoiseReport) -> Figure:
    """Allan deviation of every sensor, log-log, with the readings as lines of their slopes."""
    groups = _groups(found.channels)
    figure, panels = _panels(len(groups))
    for axes, (name, channels) in zip(panels, groups.items(), strict=True):
        for channel, colour, line in zip(channels, COLOURS, STYLES, strict=False):
            a = channel.allan
            axes.loglog(a.tau, a.deviation, color=colour, ls=line, lw=1.1, label=_label(channel))
            axes.fill_between(a.tau, a.deviation - a.sd, a.deviation + a.sd, color=colour, alpha=0.15, lw=0)
        _readings(axes, channels)
        axes.set_title(f"{_NAMES[name]} [{channels[0].unit}]", loc="left")
        axes.set_xlabel("averaging time [s]")
    legend_below(figure, panels)
    figure.suptitle(
        "Allan deviation without the spectra's lines, bands ±1 sd; thin: the slopes read, median of the axes",
        x=0.01,
        ha="left",
        fontsize=9,
    )
    return figure


def draw_spectra(found: NoiseReport) -> Figure:
    """Power spectral density of every sensor with its lines named."""
    groups = _groups(found.channels)
    figure, panels = _panels(len(groups))
    for axes, (name, channels) in zip(panels, groups.items(), strict=True):
        for channel, colour, line in zip(channels, COLOURS, STYLES, strict=False):
            s = channel.spectrum
            root, some = np.sqrt(s.density), thin(len(s.density))
            some = np.union1d(some, np.searchsorted(s.frequency, [x.frequency for x in s.lines]).clip(0, len(root) - 1))
            axes.loglog(s.frequency[some], root[some], color=colour, ls=line, lw=0.8, label=_label(channel))
        peaks = [p for p in found.peaks if p.sensor == channels[0].sensor and any(c.name in p.rms for c in channels)]
        _name_lines(axes, channels, peaks)
        axes.set_title(f"{_NAMES[name]} [{channels[0].unit}/√Hz]", loc="left")
        axes.set_xlabel("frequency [Hz]")
    legend_below(figure, panels)
    figure.suptitle("square root of the power spectral density, one-sided", x=0.01, ha="left", fontsize=9)
    return figure


def _groups(channels: Sequence[ColumnNoise]) -> dict[str, list[ColumnNoise]]:
    """Channels by instrument."""
    out: dict[str, list[ColumnNoise]] = {}
    for channel in channels:
        out.setdefault(channel.name[:3] if channel.sensor == "imu" else channel.sensor, []).append(channel)
    return out


def _panels(count: int) -> tuple[Figure, list[Axes]]:
    columns = min(NOISE_COLUMNS, count)
    lines = -(-count // columns)
    figure = new_figure(0.9 + 2.5 * lines)
    grid = list(figure.subplots(lines, columns, squeeze=False).flat)
    for axes in grid[count:]:
        axes.remove()
    return figure, grid[:count]


def _label(channel: ColumnNoise) -> str:
    return channel.name[-1] if channel.name[-1] in "xyz" else "heading"


def _readings(axes: Axes, channels: Sequence[ColumnNoise]) -> None:
    """Lines of the slopes -1/2, 0 and 1/2 through what was read, with the numbers."""
    tau = channels[0].allan.tau
    axes.autoscale(False)
    unit = channels[0].unit
    density = float(np.median([c.allan.density for c in channels]))
    look: dict[str, Any] = {"color": "black", "lw": 0.7, "zorder": 1}
    words = []
    if density > 0.0:
        axes.plot(tau, density / np.sqrt(tau), ls=(0, (6, 2)), **look)
        words.append(f"noise {density:.2g} {unit}/√Hz")
    floors = [c.allan.instability for c in channels if c.allan.instability is not None]
    if floors:
        floor = float(np.median(floors))
        axes.axhline(np.sqrt(2.0 * np.log(2.0) / np.pi) * floor, ls=(0, (1, 1.5)), **look)
        words.append(f"instability {floor:.2g} {unit}")
    walks = [c.allan.walk for c in channels if c.allan.walk is not None]
    if walks:
        walk = float(np.median(walks))
        axes.plot(tau, walk * np.sqrt(tau / 3.0), ls=(0, (6, 1.5, 1, 1.5)), **look)
        words.append(f"walk {walk:.2g} {unit}/√s")
    axes.text(0.02, 0.03, "\n".join(words), transform=axes.transAxes, va="bottom", fontsize=8, linespacing=1.3)


def _name_lines(axes: Axes, channels: Sequence[ColumnNoise], peaks: Sequence[Peak]) -> None:
    """Frequency of the strongest lines, above them."""
    low, high = axes.get_ylim()
    axes.set_ylim(low, high * (high / low) ** 0.35)
    for peak in peaks[:4]:
        top = max(float(np.sqrt(np.interp(peak.frequency, c.spectrum.frequency, c.spectrum.density))) for c in channels)
        words = f"{peak.frequency:.2f} Hz\n{peak.rad_per_sample:.2f} rad/sample\n{peak.kind}"
        right = peak.frequency > 0.2 * axes.get_xlim()[1]
        axes.annotate(
            words,
            (peak.frequency, top),
            xytext=(-4 if right else 4, 6),
            textcoords="offset points",
            fontsize=7.5,
            ha="right" if right else "left",
            va="bottom",
            linespacing=1.2,
        )


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
    comparison : of `rovgraph.lab.compare.compare`
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

    Quantities that the reference lacks have no panel.
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
        of_estimator = history[history["estimator"] == name]
        for i, (_, rows) in enumerate(of_estimator.groupby("run", sort=False)):
            _misalignment_line(axes, rows, i == 0)
        axes.axhline(0.0, color="black", lw=0.6, zorder=1)
        late = of_estimator[of_estimator["time"] > SETTLED * of_estimator["time"].max()]
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


HONEST, DISHONEST, PREDICTED = "#0072B2", "#D55E00", "#009E73"
MOST_PANELS, MOST_BARS, STUDY_COLUMNS = 12, 60, 3
TO_95 = 1.96  # sd
TITLE_WIDTH = 40  # of a panel, letters
STUDY_SETTLED = 0.2  # of the dive; the error may leave its panel before


def draw_study(folder: Path, tables: Tables) -> list[Path]:
    """Draw every figure that there are data for.

    Parameters
    ----------
    folder : an existing folder
    tables : of `rovgraph.lab.misalignment.study`

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
    """Error against time: band that 90 % of the runs are in, and the filter's ±1.96 sd; a panel per cell."""
    names = dict(zip(tables.cells["cell"], labels(tables), strict=True))
    chosen = [cell for cell in names if (tables.history["cell"] == cell).any()][:MOST_PANELS]
    if not chosen:
        return None
    columns = min(STUDY_COLUMNS, len(chosen))
    lines = -(-len(chosen) // columns)
    figure = new_figure(0.7 + 1.7 * lines, max(WIDTH * columns / STUDY_COLUMNS, 0.6 * WIDTH))
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
    late = time >= STUDY_SETTLED * time[-1]
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
    tables = [_study_grid(cells[cells["heading_error"] == e], manoeuvres, grades) for e in errors]
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


def _study_grid(cells: pd.DataFrame, manoeuvres: list[str], grades: list[str]) -> Any:
    table = cells.pivot_table("predicted_sd_deg", "manoeuvre", "imu", "median")
    return table.reindex(index=manoeuvres, columns=grades).to_numpy(float)


OBSERVABILITY_COLUMNS = 3
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
    columns = min(OBSERVABILITY_COLUMNS, count)
    figure = new_figure(0.9 + 1.6 * -(-count // columns))
    panels = panel_grid(figure, count, columns)
    clock = TimeAxis(0.0, float(seen.time[-1]))
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


LEAST_SPAN = (0.2, 10.0, 1.0)  # of speed [m/s], heading [deg] and depth [m]
BEST, OTHERS = "#0072B2", "#B8C7D3"


def draw_plan(folder: Path, plan: Plan) -> list[Path]:
    """Both figures of a results folder."""
    with style():
        figures = {"ranking.png": draw_ranking(plan), "path.png": draw_path(plan)}
        return [save(figure, folder / name) for name, figure in figures.items()]


def draw_ranking(plan: Plan) -> Figure:
    """sd after each manoeuvre, a panel per component that matters, with what is known before and the goal."""
    selected = plan.selected
    figure = new_figure(1.1 + 0.19 * len(plan.ranked), max(4.5, 1.6 + 1.5 * len(selected)))
    panels: list[Axes] = list(figure.subplots(1, len(selected), sharey=True, squeeze=False).flat)
    place = np.arange(len(plan.ranked))
    for axes, i in zip(panels, selected, strict=True):
        factor, unit = shown(plan.units[i])
        axes.barh(place, [factor * p.sd[i] for p in plan.ranked], color=[BEST, *[OTHERS] * (len(place) - 1)])
        axes.axvline(factor * plan.before[i], color="black", lw=0.8, ls=(0, (4, 2)))
        if plan.labels[i] in plan.goals:
            axes.axvline(factor * plan.goals[plan.labels[i]], color="#D55E00", lw=1.0)
        axes.set_title(plan.labels[i].replace("_", " "), loc="left", fontsize=8)
        axes.set_xlabel(f"sd [{unit}]" if unit != "1" else "sd")
    panels[0].set_yticks(place, [str(p.manoeuvre) for p in plan.ranked], fontsize=7)
    panels[0].invert_yaxis()
    goal = ", orange: goal" if plan.goals else ""
    figure.suptitle(f"sd after {plan.duration:g} s; dashed: before{goal}", x=0.01, ha="left", fontsize=9)
    return figure


def draw_path(plan: Plan) -> Figure:
    """The best manoeuvre from above; its speed ahead, heading and depth against time."""
    path = plan.path()
    motion = path.motion(np.linspace(0.0, path.duration, 1500))
    figure = new_figure(4.0)
    grid = figure.add_gridspec(3, 2, width_ratios=[1.3, 1.0])
    above = figure.add_subplot(grid[:, 0])
    north, east, down = motion.p_n.T
    above.plot(east, north, color=BEST, lw=1.2)
    above.plot(east[0], north[0], "o", color="black", ms=4)
    above.set_aspect("equal", adjustable="datalim")
    above.set_xlabel("east [m]")
    above.set_ylabel("north [m]")
    yaw = np.unwrap(np.arctan2(motion.R_nb[:, 1, 0], motion.R_nb[:, 0, 0]))
    ahead = np.einsum("ni,ni->n", motion.R_nb[:, :, 0], motion.v_n)
    columns = (("ahead [m/s]", ahead), ("heading [deg]", np.rad2deg(yaw)), ("depth [m]", down))
    first: Axes | None = None
    for row, (label, values) in enumerate(columns):
        axes = first = figure.add_subplot(grid[row, 1], sharex=first)
        axes.plot(motion.time, values, color=BEST, lw=1.0)
        axes.set_ylim(*_limits(values, LEAST_SPAN[row]))
        axes.set_ylabel(label)
        axes.tick_params(labelbottom=row == len(columns) - 1)
    axes.invert_yaxis()
    axes.set_xlabel("time [s]")
    best = plan.ranked[0].manoeuvre
    at = "" if best.speed is None else f" at {best.speed:g} m/s"
    figure.suptitle(f"{best.name}{at}; it begins at the dot", x=0.01, ha="left", fontsize=9)
    return figure


def _limits(values: Array, least: float) -> tuple[float, float]:
    """Of an axis that shows all values and spans no less than is worth a look."""
    middle, half = 0.5 * float(values.max() + values.min()), 0.55 * max(float(np.ptp(values)), least)
    return middle - half, middle + half
