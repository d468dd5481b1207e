"""What to drive: the ranking, and the path of the best."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from rovgraph.report.style import new_figure, save, style
from rovgraph.report.units import shown
from rovgraph.studies.plan import Plan

BEST, OTHERS = "#0072B2", "#B8C7D3"


def draw_plan(folder: Path, plan: Plan) -> list[Path]:
    """Both figures of a results folder."""
    with style():
        figures = {"ranking.png": draw_ranking(plan), "path.png": draw_path(plan)}
        return [save(figure, folder / name) for name, figure in figures.items()]


def draw_ranking(plan: Plan) -> Figure:
    """sd after each manoeuvre, a panel per component that matters, with what is known before and the goal."""
    told = plan.told
    figure = new_figure(1.1 + 0.19 * len(plan.ranked), max(4.5, 1.6 + 1.5 * len(told)))
    panels: list[Axes] = list(figure.subplots(1, len(told), sharey=True, squeeze=False).flat)
    place = np.arange(len(plan.ranked))
    for axes, i in zip(panels, told, strict=True):
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
    """The best manoeuvre from above, and its depth and heading against time."""
    path = plan.path()
    motion = path.motion(np.linspace(0.0, path.duration, 1500))
    figure = new_figure(3.6)
    grid = figure.add_gridspec(2, 2, width_ratios=[1.3, 1.0])
    above, depth, heading = (figure.add_subplot(grid[place]) for place in (np.s_[:, 0], np.s_[0, 1], np.s_[1, 1]))
    north, east, down = motion.p_n.T
    above.plot(east, north, color=BEST, lw=1.2)
    above.plot(east[0], north[0], "o", color="black", ms=4)
    above.set_aspect("equal", adjustable="datalim")
    above.set_xlabel("east [m]")
    above.set_ylabel("north [m]")
    depth.plot(motion.time, down, color=BEST, lw=1.0)
    depth.invert_yaxis()
    depth.set_ylabel("depth [m]")
    yaw = np.unwrap(np.arctan2(motion.R_nb[:, 1, 0], motion.R_nb[:, 0, 0]))
    heading.plot(motion.time, np.rad2deg(yaw), color=BEST, lw=1.0)
    heading.set_ylabel("heading [deg]")
    heading.set_xlabel("time [s]")
    best = plan.ranked[0].manoeuvre
    figure.suptitle(f"{best.name} at {best.speed:g} m/s; it begins at the dot", x=0.01, ha="left", fontsize=9)
    return figure
