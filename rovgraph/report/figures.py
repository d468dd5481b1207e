"""The figures of a results folder.

Drawn with matplotlib's objects on an Agg canvas: no display, no global state of pyplot.
"""

from collections.abc import Sequence
from pathlib import Path

from rovgraph.config import Config
from rovgraph.estimators.estimate import Estimate
from rovgraph.log import Log
from rovgraph.report.figure_calibration import draw_calibration
from rovgraph.report.figure_motion import draw_attitude, draw_depth, draw_velocity
from rovgraph.report.figure_residuals import draw_residuals
from rovgraph.report.figure_track import draw_track
from rovgraph.report.results import main_first
from rovgraph.report.style import save, style
from rovgraph.trajectory import Trajectory


def draw_figures(
    folder: Path, estimates: Sequence[Estimate], log: Log, config: Config, reference: Trajectory | None = None
) -> list[Path]:
    """Draw every figure that the estimates have data for.

    Parameters
    ----------
    folder : an existing folder
    estimates : of one log; the smoothed one leads where there is one
    log, config : what they were made from
    reference : a known trajectory to draw beside them, or None

    Returns
    -------
    list of Path : the PNG files written
    """
    estimates = main_first(estimates)
    # dead reckoning differentiates every ping: against time it would hide the others
    over_time = [e for e in estimates if e.kind != "dead_reckoning"] or estimates
    with style():
        figures = {
            "track.png": draw_track(estimates, log, config, reference),
            "velocity.png": draw_velocity(over_time),
            "attitude.png": draw_attitude(over_time, log, config),
            "depth.png": draw_depth(over_time, log),
            "residuals.png": draw_residuals(estimates[0]),
            "calibration.png": draw_calibration(over_time),
        }
        return [save(figure, folder / name) for name, figure in figures.items() if figure is not None]
