"""``rovgraph convert``: native files as one log."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from rovgraph.cli.files import Choose, Files, Shift, Times, pairs, seconds, whose

WIDE = 150  # columns of a file or a pipe, which has no width of its own


def convert(
    files: Files,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="log to write: .csv, .csv.gz or .parquet")] = None,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    config_out: Annotated[Path | None, typer.Option(help="also write a configuration to begin with (YAML)")] = None,
    choose: Choose = None,
    shift: Shift = None,
    times: Times = None,
    force: Annotated[bool, typer.Option("--force", help="replace older files")] = False,
    guess: Annotated[
        bool, typer.Option("--guess", help="propose columns and units of tables instead; writes no log")
    ] = False,
) -> None:
    """Convert native files of instruments, autopilots and robots into one log.

    Example: rovgraph convert dive.BIN dvl.jsonl --out log.csv --config-out vehicle.yaml
    A table of your own: rovgraph convert table.csv --guess --config-out vehicle.yaml
    """
    import rovgraph as rg
    from rovgraph.errors import InputError

    if guess:
        if out is not None or config is not None or choose or shift or times:
            raise InputError("--guess: writes no log; give tables, and --config-out or nothing")
        propose(files, config_out, force)
        return
    if out is None:
        raise InputError("expected --out with the log to write, or --guess for a table of other columns")
    from rovgraph.cli.console import console, say
    from rovgraph.cli.progress import progress_bar
    from rovgraph.report.conversion import check_suffix, conversion_tables

    check_suffix(out)
    settings = None if config is None else rg.load_config(config)
    with progress_bar() as progress:
        result = rg.convert(files, settings, pairs("choose", choose), seconds("shift", shift), progress, whose(times))
        written = result.save(out, config_out, force, progress)
    shown = console(WIDE)
    for table in conversion_tables(result.report):
        shown.print(table)
        shown.print()
    for note in result.notes:
        say(shown, f"assumed: {note}")
    say(shown, f"log in {written[0]}, with {', '.join(path.name for path in written[1:])}")


def propose(files: Sequence[Path], config_out: Path | None, force: bool) -> None:
    """Print a mapping of the columns of one or more tables."""
    import rovgraph as rg
    from rovgraph.api.guessing import proposal, save_proposal
    from rovgraph.cli.console import console, say
    from rovgraph.report.conversion import guess_table

    guesses = [rg.guess_columns(path) for path in files]
    saved = None if config_out is None else save_proposal(guesses, config_out, force)
    shown = console(WIDE)
    for guess in guesses:
        shown.print(guess_table(guess.columns, guess.left, "" if len(guesses) == 1 else Path(guess.source).name))
        shown.print()
    typer.echo(proposal(guesses))
    for note in dict.fromkeys(note for guess in guesses for note in guess.notes):
        say(shown, f"note: {note}")
    where = "these lines" if saved is None else str(saved)
    check = f"rovgraph check {' '.join(map(str, files))} --config {saved or 'vehicle.yaml'}"
    say(shown, f"this is a proposal: confirm {where}, then run {check}")
