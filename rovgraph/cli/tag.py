"""``rovgraph tag``: where the vehicle was at the times of another table."""

from pathlib import Path
from typing import Annotated

import typer


def tag(
    table: Annotated[Path, typer.Argument(help="CSV with a column of times", metavar="TABLE")],
    results: Annotated[Path, typer.Argument(help="results folder of smooth or online", metavar="RESULTS")],
    out: Annotated[Path, typer.Option("--out", "-o", help="CSV to write", show_default=False)],
    time: Annotated[str, typer.Option(help="column of times: seconds of the log's clock, or dates")] = "time",
    offset: Annotated[float, typer.Option(help="seconds to add to the table's times")] = 0.0,
    estimate: Annotated[
        str | None, typer.Option(help="smoothed, filtered or dead_reckoning; default: the best available")
    ] = None,
    exif: Annotated[
        str | None, typer.Option(help="column of JPEG files; write copies with the position in EXIF", metavar="COLUMN")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace older files")] = False,
) -> None:
    """Add position, attitude and their sd to photos, sonar pings or samples.

    Example: rovgraph tag photos.csv results --time taken --out placed.csv
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say

    tagged = rg.tag(table, results, out, time, offset, estimate, exif, force)
    inside, rows = int(tagged.inside.sum()), len(tagged.inside)
    outside = f", {rows - inside} outside the dive" if inside < rows else ""
    say(console(), f"{inside} of {rows} rows placed{outside}: {out}")
