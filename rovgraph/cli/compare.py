"""``rovgraph compare``: estimators against each other, on one log or on many simulated dives."""

from pathlib import Path
from typing import Annotated

import typer

from rovgraph.cli.files import Choose, Shift, Times, read_files

WIDE = 120  # columns of a file or a pipe, which has no width of its own


def compare(
    out: Annotated[Path, typer.Option("--out", "-o", help="results folder", show_default=False)],
    files: Annotated[
        list[Path] | None, typer.Argument(help="a log, or native files of one dive", metavar="[FILE...]")
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    reference: Annotated[
        Path | None, typer.Option(help="CSV with time, north, east, and optionally attitude and velocity")
    ] = None,
    scenario: Annotated[str | None, typer.Option(help="simulate dives of this scenario instead of a LOG")] = None,
    seeds: Annotated[int, typer.Option(help="number of simulated dives")] = 30,
    first_seed: Annotated[int, typer.Option(min=0, help="seed of the first simulated dive")] = 1,
    duration: Annotated[
        float | None, typer.Option(help="duration of a simulated dive in seconds; default: the scenario's")
    ] = None,
    estimators: Annotated[
        str | None,
        typer.Option(help="names or patterns (graph-*), separated by commas; default: all without thrusters"),
    ] = None,
    jobs: Annotated[int | None, typer.Option(help="processes; default: one per core")] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an older results folder")] = False,
    choose: Choose = None,
    shift: Shift = None,
    times: Times = None,
) -> None:
    """Compare estimators: errors, consistency and cost of each, in a table and figures.

    Example: rovgraph compare --scenario vattern --seeds 30 --out comparison
    """
    import rovgraph as rg
    from rovgraph.api.comparison import require_one
    from rovgraph.cli.console import console, say
    from rovgraph.cli.progress import progress_bar
    from rovgraph.report.comparison import comparison_table
    from rovgraph.report.folder import check_writable
    from rovgraph.report.narrow import fitting
    from rovgraph.studies.choices import listed
    from rovgraph.studies.estimators import select

    chosen = range(first_seed, first_seed + seeds)
    select(None if estimators is None else listed(estimators))
    require_one(files[0] if files else None, reference, scenario, chosen, duration)
    check_writable(out, force, [*(files or []), config, reference])
    settings = None if config is None else rg.load_config(config)
    dive_log = read_files(files, settings, choose, shift, times) if files else None
    with progress_bar() as progress:
        result = rg.compare(dive_log, settings, reference, scenario, chosen, duration, estimators, jobs, progress)
    result.save(out, force)
    shown = console(WIDE)
    for part in fitting(comparison_table(result.comparison, result.title, result.thesis), shown):
        shown.print(part)
    for row in result.comparison.runs.dropna(subset="error").drop_duplicates("estimator").itertuples():
        say(shown, f"{row.estimator} failed on {row.run}: {row.error}")
    say(shown, f"results in {out}")
