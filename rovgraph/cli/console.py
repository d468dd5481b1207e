"""The console: the width of tables, sentences broken between words, and a progress bar on a terminal."""

import os
import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import IO, TYPE_CHECKING

from rovgraph.process import no_progress

if TYPE_CHECKING:
    from rich.console import Console

USUAL = 80  # columns


def console(wide: int = USUAL) -> "Console":
    """Standard output. A terminal or the variable COLUMNS sets the width; a file or a pipe has ``wide`` columns."""
    from rich.console import Console

    out = Console()
    return out if out.is_terminal or os.environ.get("COLUMNS") else Console(width=wide)


def say(out: "Console", text: str, style: str = "", styled: int | None = None, indent: int = 0) -> None:
    """Print a sentence as it stands.

    Parameters
    ----------
    out : of `console`
    style, styled : rich's style of the first ``styled`` characters; None = of all
    indent : of the second line and those below [columns]
    """
    from rich.text import Text

    line = Text(folded(text, out.file, indent))
    line.stylize(style, 0, styled)
    out.print(line, highlight=False, soft_wrap=True)


def folded(text: str, stream: IO[str], indent: int = 0) -> str:
    """A sentence as lines that fit; longer words, such as paths, stay whole. A file or a pipe gets a single line."""
    width = columns(stream)
    if width is None:
        return text
    lines = textwrap.wrap(text, width, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines)


def columns(stream: IO[str]) -> int | None:
    """Width of a terminal, or what the variable COLUMNS states; None = a file or a pipe, which has none."""
    stated = os.environ.get("COLUMNS", "")
    if stated.isdigit() and int(stated) > 0:
        return int(stated)
    try:
        return os.get_terminal_size(stream.fileno()).columns or USUAL
    except (OSError, ValueError, AttributeError):
        return None


@contextmanager
def progress_bar() -> Iterator[Callable[[str, float], None]]:
    """A callback ``(what, done)`` that draws on a terminal what is being done, ``done`` from 0 to 1."""
    from rich.console import Console

    console = Console(stderr=True)
    if not console.is_terminal:
        yield no_progress
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda what, done: bar.update(task, description=what, completed=done)
