"""``rovgraph smooth``: the best track of a dive."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

NOT_TRUSTED = 3  # exit code of --strict
VERDICT_STYLE = {"trusted": "green", "doubtful": "bold yellow", "wrong": "bold red"}


class Engine(StrEnum):
    """What estimates."""

    batch = "batch"
    isam2 = "isam2"


class Which(StrEnum):
    """Which estimate to make."""

    smoothed = "smoothed"
    filtered = "filtered"
    both = "both"


def smooth(
    log: Annotated[Path, typer.Argument(help="CSV, CSV.gz or Parquet, see docs/log-format.md", metavar="LOG")],
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="results folder; default: results-LOG")] = None,
    engine: Annotated[
        Engine | None, typer.Option(help="batch, or isam2 for filtered and smoothed from one pass; else graph.solver")
    ] = None,
    estimate: Annotated[Which, typer.Option(help="which estimate to make")] = Which.both,
    force: Annotated[bool, typer.Option("--force", help="replace an older results folder")] = False,
    figures: Annotated[bool, typer.Option("--figures/--no-figures", help="draw figures")] = True,
    strict: Annotated[bool, typer.Option("--strict", help="exit with 3 unless the verdict is trusted")] = False,
) -> None:
    """Estimate the track of a dive and everything that was calibrated on the way.

    Example: rovgraph smooth log.csv --config vehicle.yaml --out results
    """
    import time

    from rich.console import Console

    from rovgraph import check
    from rovgraph.cli.beside import warn_of_unused
    from rovgraph.cli.progress import progress_bar
    from rovgraph.config import load_config
    from rovgraph.estimators.dive import smooth as smooth_dive
    from rovgraph.log import read_log
    from rovgraph.report.folder import check_writable, results_folder
    from rovgraph.report.results import write_results
    from rovgraph.report.tables import calibration_table, summary_table

    out = Path("results-" + log.name.split(".")[0]) if out is None else out
    settings = load_config(config)
    if engine is not None:
        settings = settings.model_copy(update={"graph": settings.graph.model_copy(update={"solver": engine.value})})
    warn_of_unused(config, log)
    check_writable(out, force)
    began = time.perf_counter()
    dive_log = read_log(
        log,
        settings.columns,
        settings.units,
        settings.imu.mag.calibrated,
        settings.delay_s,
        settings.environment.origin,
    )
    dive_log = check.bridge_jumps(dive_log, settings)
    check.warn(dive_log, settings)
    seconds = {"reading": time.perf_counter() - began}
    with progress_bar() as progress:
        dive = smooth_dive(dive_log, settings, estimate.value, progress)
    seconds["estimating"] = time.perf_counter() - began - seconds["reading"]
    assumptions = dive.assumptions
    with results_folder(out, force) as folder:
        if figures:
            from rovgraph.report.figures import draw_figures

            draw_figures(folder, dive.estimates, dive_log, dive.beginning.config)
        seconds["total"] = time.perf_counter() - began
        config_used = dive.beginning.config
        summary = write_results(folder, dive.estimates, dive_log, config_used, assumptions, seconds, dive.alarms)
    console = Console()
    console.print(f"verdict: {dive.verdict}", style=VERDICT_STYLE[dive.verdict], highlight=False)
    for alarm in dive.alarms:
        console.print(f"{alarm.severity}: {alarm.text}", highlight=False, markup=False, soft_wrap=True)
    console.print(summary_table(dive.estimates, summary))
    console.print(calibration_table(dive.estimates))
    for line in assumptions:
        console.print(f"assumed: {line}", highlight=False, markup=False)
    console.print(f"results in {out}", highlight=False, markup=False)
    if strict and dive.verdict != "trusted":
        raise typer.Exit(NOT_TRUSTED)
