"""Figures of a calibration: a magnetometer's samples before and after, and noise of sensors at rest.

The magnetometer is drawn as the sphere from three sides and as the field's length; noise as Allan deviations with the
fitted slopes, and as spectra with their lines named.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.lab.calibrate import MagnetometerCalibration, NoiseReport
from rovgraph.lab.calibrate.noise import ColumnNoise, Peak
from rovgraph.report.colours import PRIOR, REJECTED
from rovgraph.report.style import TimeAxis, legend_below, new_figure, thin

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
COLUMNS = 2
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
    columns = min(COLUMNS, count)
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
