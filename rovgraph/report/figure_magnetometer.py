"""A magnetometer before and after its calibration: the sphere from three sides, and the field's length."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from rovgraph.calibrate import MagnetometerCalibration
from rovgraph.geometry import Array
from rovgraph.report.colours import PRIOR, REJECTED
from rovgraph.report.style import Clock, legend_below, new_figure, thin

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
    clock = Clock(float(found.time[0]), float(found.time[-1]))
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
