"""``rovgraph report``: the page of a results folder, or of several dives side by side."""

from pathlib import Path
from typing import Annotated

import typer


def report(
    results: Annotated[list[Path], typer.Argument(help="results folders", metavar="RESULTS...")],
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="page to write; default: report.html in RESULTS, campaign.html for several"),
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an older file at --out")] = False,
) -> None:
    """Make the page of a results folder again, or a page that compares several dives.

    Example: rovgraph report results/monday results/tuesday --out campaign.html
    """
    import rovgraph as rg

    typer.echo(f"page in {rg.report(*results, out=out, force=force)}")
