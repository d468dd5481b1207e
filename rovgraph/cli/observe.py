"""``rovgraph observe``: what of the calibration can be known from a dive."""

from pathlib import Path
from typing import Annotated

import typer

from rovgraph.cli.files import Choose, Files, Shift, Times, name_of, read_files

WIDE = 150  # columns of a file or a pipe, which has no width of its own


def observe(
    files: Files,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="results folder; default: observed-LOG")] = None,
    estimate: Annotated[
        str | None, typer.Option(help="further calibration variables to estimate, separated by commas")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an older results folder")] = False,
    choose: Choose = None,
    shift: Shift = None,
    times: Times = None,
) -> None:
    """Show how well a dive determines each calibration variable, when it did, and what is missing.

    Example: rovgraph observe log.csv --config vehicle.yaml --estimate dvl_yaw,dvl_scale
    """
    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.cli.progress import progress_bar
    from rovgraph.report.folder import check_writable
    from rovgraph.report.observability import observability_table, words

    out = Path("observed-" + name_of(files)) if out is None else out
    settings = None if config is None else rg.load_config(config)
    check_writable(out, force, [*files, config])
    dive_log = read_files(files, settings, choose, shift, times)
    with progress_bar() as progress:
        result = rg.observe(dive_log, settings, estimate or (), progress)
    result.save(out, force)
    seen = result.observability
    shown = console(WIDE)
    shown.print(observability_table(seen, f"what {files[0].name} shows"))
    for sentence in words(seen):
        say(shown, sentence)
    say(shown, f"results in {out}")
