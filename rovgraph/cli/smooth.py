"""``rovgraph smooth``: the best track of a dive."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rovgraph.cli.files import Choose, ConfigPath, Files, Force, Shift, Times, name_of, read_files

if TYPE_CHECKING:
    from rovgraph import Result

NOT_TRUSTED = 3  # exit code of --strict
VERDICT_STYLE = {"trusted": "green", "doubtful": "bold yellow", "wrong": "bold red"}


class SmoothEngine(StrEnum):
    """What estimates."""

    batch = "batch"
    isam2 = "isam2"


class Which(StrEnum):
    """Which estimate to make."""

    smoothed = "smoothed"
    filtered = "filtered"
    both = "both"


class Figures(StrEnum):
    """Formats of figures."""

    png = "png"
    pdf = "pdf"
    svg = "svg"


def smooth(
    files: Files,
    config: ConfigPath = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="results folder; default: results-LOG")] = None,
    engine: Annotated[
        SmoothEngine | None,
        typer.Option(help="batch, or isam2 for filtered and smoothed from one pass; default: graph.solver"),
    ] = None,
    estimate: Annotated[Which, typer.Option(help="which estimate to make")] = Which.both,
    force: Force = False,
    figures: Annotated[Figures, typer.Option(help="format of the figures")] = Figures.png,
    no_figures: Annotated[bool, typer.Option("--no-figures", help="draw none")] = False,
    export: Annotated[
        list[str] | None,
        typer.Option(help="also write the track as kml, geojson, ... (docs/export.md); may be repeated"),
    ] = None,
    page: Annotated[bool, typer.Option("--page/--no-page", help="make report.html")] = True,
    strict: Annotated[bool, typer.Option("--strict", help="exit with 3 unless the verdict is trusted")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="print all assumptions and constants")] = False,
    choose: Choose = None,
    shift: Shift = None,
    times: Times = None,
) -> None:
    """Estimate the track of a dive, and the calibration of its instruments.

    Example: rovgraph smooth log.csv --config vehicle.yaml --out results
    """
    import time

    import rovgraph as rg
    from rovgraph.cli.console import progress_bar
    from rovgraph.report.export.formats import check_exportable, known_formats
    from rovgraph.report.folder import check_writable

    out = Path("results-" + name_of(files)) if out is None else out
    settings = None if config is None else rg.load_config(config)
    known_formats(export or [])
    check_writable(out, force, [*files, config])
    began = time.perf_counter()
    dive_log = read_files(files, settings, choose, shift, times)
    check_exportable(export or [], dive_log.source, dive_log.origin, dive_log.start)
    read = time.perf_counter()
    with progress_bar() as progress:
        result = rg.smooth(dive_log, settings, estimate.value, None if engine is None else engine.value, progress)
    result.seconds["reading"] = read - began
    summary = result.save(out, force, False if no_figures else figures.value, page, export or [])
    show_result(result, summary, out, verbose)
    if strict and result.verdict != "trusted":
        raise typer.Exit(NOT_TRUSTED)


def show_result(result: "Result", summary: dict[str, Any], out: Path, verbose: bool) -> None:
    """Print verdict, alarms, tables, assumptions and advice; all assumptions and names where ``verbose``."""
    from rovgraph.cli.console import console, say
    from rovgraph.report.assumptions import leading
    from rovgraph.report.tables import calibration_table, summary_table

    shown = console()
    say(shown, f"verdict: {result.verdict}", VERDICT_STYLE[result.verdict])
    for alarm in result.alarms:
        say(shown, f"{alarm.severity}: {alarm.text}")
    shown.print(summary_table(result.dive.estimates, summary))
    shown.print(calibration_table(result.dive.estimates, verbose))
    first, others = leading(result.assumptions)
    for line in [*first, *(others if verbose else [])]:
        say(shown, f"assumed: {line}")
    if others and not verbose:
        say(shown, f"assumed: {len(others)} more (--verbose lists them)")
    for advice in result.advice:
        say(shown, f"advice: {advice.text}")
    page = " (open report.html)" if (out / "report.html").exists() else ""
    say(shown, f"results in {out}{page}")
