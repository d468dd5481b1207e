"""The page of a results folder, whichever command made it: the sections of a dive's page, or those of `studies`."""

from pathlib import Path

from rovgraph.errors import InputError
from rovgraph.report.pages.acoustics import acoustics_sections
from rovgraph.report.pages.calibration import calibration_section
from rovgraph.report.pages.dive import dive_section
from rovgraph.report.pages.page import render, write
from rovgraph.report.pages.sensors import clocks_section, compass_section, dvl_section, residuals_section
from rovgraph.report.pages.source import PAGE, DiveSource, ResultsSource, about_section, damage_named, smooth_command
from rovgraph.report.pages.track import cursor, origin
from rovgraph.report.pages.uncertainty import separation_section
from rovgraph.report.pages.verdict import opening, verdict_section


def dive_page(source: DiveSource) -> str:
    """HTML of a dive.

    Raises
    ------
    InputError : a file that cannot be read, or no trajectory
    """
    sections = [
        dive_section(source),
        verdict_section(source),
        separation_section(source),
        dvl_section(source),
        *acoustics_sections(source),
        residuals_section(source),
        compass_section(source),
        clocks_section(source),
        calibration_section(source),
        about_section(source, smooth_command(source), folded=True),
    ]
    clock = source.clock
    time = {"unit": clock.unit, "end": float((clock.end - clock.start) / clock.scale), "label": clock.label}
    title = str(source.summary.get("name") or Path(source.folder).name)
    return render(title, sections, time, cursor(source), origin(source), opening(source))


def page_of(folder: Path) -> str:
    """HTML of the page of a results folder.

    Raises
    ------
    InputError : no results folder of rovgraph, a file that cannot be read, or a command without a page
    """
    source = ResultsSource.read(folder)
    with damage_named(folder):
        if "main_estimate" in source.summary:
            return dive_page(DiveSource(source.folder, source.summary))
        from rovgraph.report.pages.studies import study_page_of  # no dive needs these

        maker = study_page_of(source)
        if maker is None:
            inside = source.folder / "smoothed"  # of a live dive
            where = f"give {inside}" if inside.is_dir() else "give a results folder of smooth or a study"
            raise InputError(f"{folder}: holds no results that have a page; {where}")
        return maker(source)


def write_page(folder: Path) -> None:
    """Write the page of a results folder as ``report.html`` into it.

    Raises
    ------
    InputError : of `page_of`; or it cannot be written
    """
    write(folder / PAGE, page_of(folder))
