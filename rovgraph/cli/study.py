"""``rovgraph study``: many simulated dives, to see what can be known."""

from pathlib import Path
from typing import Annotated

import typer

study = typer.Typer(help="Study by many simulated dives what is observable.", no_args_is_help=True)

WIDE = 170  # columns of a file or a pipe, which has no width of its own


@study.callback()
def _study() -> None:
    """Keep ``misalignment`` a command of its own, though it is the only one."""


@study.command()
def misalignment(
    config: Annotated[Path, typer.Option("--config", "-c", help="the study (YAML), see docs/studies.md")],
    out: Annotated[Path | None, typer.Option("--out", "-o", help="results folder", show_default=False)] = None,
    resume: Annotated[bool, typer.Option("--resume", help="continue with the files in the results folder")] = False,
    only: Annotated[str | None, typer.Option(help="one cell, by the first characters of its id")] = None,
    jobs: Annotated[int | None, typer.Option(help="processes; default: one per core")] = None,
    scheduler: Annotated[str | None, typer.Option(help="address of a Dask cluster, such as tcp://host:8786")] = None,
    show: Annotated[bool, typer.Option("--list", help="list the cells and their ids without running them")] = False,
) -> None:
    """Study how well the DVL's misalignment can be estimated, and whether the stated sd is right.

    Example: rovgraph study misalignment --config configs/studies/quick.yaml --out quick
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.cli.progress import progress_bar
    from rovgraph.errors import InputError
    from rovgraph.report.narrow import fitting
    from rovgraph.report.study import plan_table, study_table
    from rovgraph.studies.misalignment import read_study

    shown = console(WIDE)
    if show:
        for part in fitting(plan_table(read_study(config)), shown):
            shown.print(part)
        return
    if out is None:
        raise InputError("--out is needed: a folder for the results")
    try:
        with progress_bar() as progress:
            tables = rg.study_misalignment(config, out, resume, only, jobs, scheduler, progress)
    except KeyboardInterrupt:
        say(shown, f"interrupted; {out} keeps every finished run, --resume continues")
        raise typer.Exit(130) from None
    for part in fitting(study_table(tables), shown):
        shown.print(part)
    for row in tables.runs.dropna(subset="failure").drop_duplicates("cell").itertuples():
        say(shown, f"{row.cell} failed in run {row.run}: {row.failure}")
    say(shown, f"results in {out}")
