"""The console script: registers the commands and turns bad input into one line.

Exit codes: 0 done, 2 bad input, 3 done but not trusted (smooth --strict), 130 interrupted (typer's).
"""

import errno
import os
import sys
import warnings
from typing import Annotated, NoReturn

import typer

from rovgraph._version import __version__
from rovgraph.cli.console import folded
from rovgraph.cli.lab import calibrate, compare, demo, observe, plan, simulate, study
from rovgraph.cli.logs import check, config, convert
from rovgraph.cli.online import online
from rovgraph.cli.report import evaluate, export, report, tag
from rovgraph.cli.smooth import smooth
from rovgraph.errors import DataWarning, InputError
from rovgraph.process import leave, limit_threads_and_gc

app = typer.Typer(
    name="rovgraph",
    help="Compute where a small underwater vehicle was, and where it is.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rovgraph {__version__}")
        raise typer.Exit


@app.callback()
def _of_all_commands(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_print_version, help="print the version")
    ] = False,
) -> None:
    pass


for _command in (
    demo, smooth, online, convert, export, tag, report, evaluate, compare, observe, plan, check, config, simulate,
):  # fmt: skip
    app.command()(_command)
app.add_typer(calibrate, name="calibrate")
app.add_typer(study, name="study")


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    if issubclass(category, DataWarning):
        print(folded(f"warning: {message}", sys.stderr), file=sys.stderr)


def run() -> NoReturn:
    """Entry point of the console script ``rovgraph``: `main`, and out of the interpreter without taking it down."""
    try:
        main()
    except SystemExit as stop:
        if stop.code is not None and not isinstance(stop.code, int):
            raise
        leave(stop.code or 0)
    leave(0)


def main() -> None:
    """Run the command that the arguments name."""
    limit_threads_and_gc()
    warnings.simplefilter("default", DataWarning)
    warnings.showwarning = _show_warning
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except InputError as error:
        _refuse(str(error))
    except BrokenPipeError:  # the reader has closed the pipe, as ``head`` does
        _silence()
        sys.exit(0)
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        _silence()
        _refuse(f"standard output cannot be written ({error.strerror}); free some space")


def _refuse(reason: str) -> NoReturn:
    print(folded(f"error: {reason}", sys.stderr), file=sys.stderr)
    sys.exit(2)


def _silence() -> None:
    """Nothing is to be flushed at the end to where nothing can be written."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
