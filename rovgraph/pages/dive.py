"""The page of a dive, from the results folder of ``rovgraph smooth``."""

from pathlib import Path

from rovgraph.pages.about import about_section, smooth_command
from rovgraph.pages.calibration import calibration_section
from rovgraph.pages.compasses import compass_section
from rovgraph.pages.page import render
from rovgraph.pages.sensors import clocks_section, dvl_section, residuals_section
from rovgraph.pages.source import DiveSource
from rovgraph.pages.track import cursor, origin, track_section
from rovgraph.pages.uncertainty import separation_section, uncertainty_section
from rovgraph.pages.verdict import verdict_section


def dive_page(source: DiveSource) -> str:
    """HTML of a dive.

    Raises
    ------
    InputError : a file that cannot be read, or no trajectory
    """
    sections = [
        verdict_section(source),
        track_section(source),
        uncertainty_section(source),
        separation_section(source),
        dvl_section(source),
        residuals_section(source),
        compass_section(source),
        clocks_section(source),
        calibration_section(source),
        about_section(source, smooth_command(source)),
    ]
    clock = source.clock
    time = {"unit": clock.unit, "end": float((clock.end - clock.start) / clock.scale), "label": clock.label}
    title = f"{source.summary.get('name') or Path(source.folder).name}: track and its quality"
    return render(title, sections, time, cursor(source), origin(source))
