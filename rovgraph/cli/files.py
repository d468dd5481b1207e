"""Options that commands share: native files, which of their channels, shifts of clocks, the configuration."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rovgraph import Config, Log

Files = Annotated[
    list[Path],
    typer.Argument(help="a log (docs/log-format.md), or native files of one dive (docs/formats.md)", metavar="FILE..."),
]
Choose = Annotated[
    list[str] | None,
    typer.Option(help="file, instance, message or topic that feeds a sensor; may be repeated", metavar="SENSOR=SOURCE"),
]
Shift = Annotated[
    list[str] | None,
    typer.Option(help="seconds to add to the stamps of a sensor or file; may be repeated", metavar="NAME=SECONDS"),
]
Times = Annotated[
    list[str] | None,
    typer.Option(
        help="take the recorder's times: arrival for all, or of one sensor or file; may be repeated",
        metavar="[NAME=]arrival",
    ),
]
ConfigPath = Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")]
Force = Annotated[bool, typer.Option("--force", help="replace an older results folder")]


def read_files(
    files: Sequence[Path],
    config: "Config | None",
    choose: Sequence[str] | None,
    shift: Sequence[str] | None,
    times: Sequence[str] | None,
) -> "Log":
    """The log of some files, with a progress bar."""
    import rovgraph as rg
    from rovgraph.cli.console import progress_bar

    with progress_bar() as progress:
        return rg.read_log(files, config, pairs("choose", choose), seconds("shift", shift), progress, whose(times))


def pairs(option: str, texts: Sequence[str] | None) -> dict[str, str]:
    """``NAME=VALUE`` of a repeated option."""
    from rovgraph.errors import InputError

    out = {}
    for text in texts or []:
        name, equals, value = text.partition("=")
        if not (name.strip() and equals and value.strip()):
            raise InputError(f"--{option} {text}: expected NAME=VALUE")
        out[name.strip()] = value.strip()
    return out


def seconds(option: str, texts: Sequence[str] | None) -> dict[str, float]:
    """``NAME=SECONDS`` of a repeated option."""
    import math

    from rovgraph.errors import InputError

    out = {}
    for name, value in pairs(option, texts).items():
        try:
            out[name] = float(value)
        except ValueError:
            out[name] = math.nan
        if not math.isfinite(out[name]):
            raise InputError(f"--{option} {name}={value}: expected seconds, a number")
    return out


def whose(texts: Sequence[str] | None) -> "str | dict[str, str]":
    """Whose times are taken: of a repeated ``--times [NAME=]arrival``."""
    alone = [text for text in texts or [] if "=" not in text]
    return alone[0] if alone else pairs("times", texts)


def name_of(files: Sequence[Path]) -> str:
    """The name for a results folder: the first file without its suffixes."""
    return files[0].name.split(".")[0]
