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
    page: Annotated[bool, typer.Option("--page/--no-page", help="make report.html")] = True,
    strict: Annotated[bool, typer.Option("--strict", help="exit with 3 unless the verdict is trusted")] = False,
) -> None:
    """Estimate the track of a dive and everything that was calibrated on the way.

    Example: rovgraph smooth log.csv --config vehicle.yaml --out results
    """
    import time

    from rich.console import Console

    import rovgraph as rg
    from rovgraph.cli.progress import progress_bar
    from rovgraph.report.folder import check_writable
    from rovgraph.report.tables import calibration_table, summary_table

    out = Path("results-" + log.name.split(".")[0]) if out is None else out
    settings = None if config is None else rg.load_config(config)
    check_writable(out, force)
    began = time.perf_counter()
    dive_log = rg.read_log(log, settings)
    read = time.perf_counter()
    with progress_bar() as progress:
        result = rg.smooth(dive_log, settings, estimate.value, None if engine is None else engine.value, progress)
    result.seconds["reading"] = read - began
    summary = result.save(out, force, figures, page)
    console = Console()
    console.print(f"verdict: {result.verdict}", style=VERDICT_STYLE[result.verdict], highlight=False)
    for alarm in result.alarms:
        console.print(f"{alarm.severity}: {alarm.text}", highlight=False, markup=False, soft_wrap=True)
    console.print(summary_table(result.dive.estimates, summary))
    console.print(calibration_table(result.dive.estimates))
    for line in result.assumptions:
        console.print(f"assumed: {line}", highlight=False, markup=False)
    console.print(f"results in {out}" + (", open report.html" if page else ""), highlight=False, markup=False)
    if strict and result.verdict != "trusted":
        raise typer.Exit(NOT_TRUSTED)
