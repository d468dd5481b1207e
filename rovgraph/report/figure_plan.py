"""What to drive: the ranking, and the path of the best."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rovgraph.geometry import Array
from rovgraph.report.style import new_figure, save, style
from rovgraph.studies.plan import Plan
from rovgraph.units import shown

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
    figure.suptitle(f"{best.name} at {best.speed:g} m/s; it begins at the dot", x=0.01, ha="left", fontsize=9)
    return figure


def _limits(values: Array, least: float) -> tuple[float, float]:
    """Of an axis that shows all values and spans no less than is worth a look."""
    middle, half = 0.5 * float(values.max() + values.min()), 0.55 * max(float(np.ptp(values)), least)
    return middle - half, middle + half
