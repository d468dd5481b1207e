"""``rovgraph convert``: native files as one log."""

from pathlib import Path
from typing import Annotated

import typer

from rovgraph.cli.files import Choose, Files, Shift, pairs, seconds

WIDE = 150  # columns of a file or a pipe, which has no width of its own


def convert(
    files: Files,
    out: Annotated[Path, typer.Option("--out", "-o", help="log to write: .csv, .csv.gz or .parquet")],
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    config_out: Annotated[Path | None, typer.Option(help="also write a configuration to begin with (YAML)")] = None,
    choose: Choose = None,
    shift: Shift = None,
    force: Annotated[bool, typer.Option("--force", help="replace older files")] = False,
) -> None:
    """Convert native files of instruments, autopilots and robots into one log.

    Example: rovgraph convert dive.BIN dvl.jsonl --out log.csv --config-out vehicle.yaml
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.cli.progress import progress_bar
    from rovgraph.report.conversion import check_suffix, conversion_tables

    check_suffix(out)
    settings = None if config is None else rg.load_config(config)
    with progress_bar() as progress:
        result = rg.convert(files, settings, pairs("choose", choose), seconds("shift", shift), progress)
        written = result.save(out, config_out, force, progress)
    shown = console(WIDE)
    for table in conversion_tables(result.report):
        shown.print(table)
        shown.print()
    for note in result.notes:
        say(shown, f"assumed: {note}")
    say(shown, f"log in {written[0]}, with {', '.join(path.name for path in written[1:])}")
