"""``rovgraph config``: the effective configuration, or all keys there are."""

import itertools
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

# ending of a key -> unit
_UNITS = {
    "_mps2": "m/s²",
    "_mps": "m/s",
    "_dps": "deg/s",
    "_deg": "deg",
    "_m": "m",
    "_s": "s",
}
_GROUP_TEXT = {
    "": "General",
    "start": "start: where the dive begins",
    "environment": "environment: gravity, magnetic field, Earth rate",
    "imu": "imu: inertial unit",
    "motion": "motion: from keyframe to keyframe",
    "dvl": "dvl: Doppler velocity log",
    "heading": "heading: compasses",
    "tilt": "tilt: roll and pitch of the vehicle",
    "depth": "depth: pressure sensor",
    "fix": "fix: position fixes",
    "place": "place: places seen before",
    "calibration": "calibration: estimated, considered, or exact",
    "vehicle": "vehicle: hydrodynamics, thesis (2.16)-(2.24)",
    "graph": "graph: how it is built and solved",
    "online": "online: estimating as data arrive",
    "times": "times: what dates as text leave open",
}


def config(
    path: Annotated[
        Path | None, typer.Argument(help="configuration (YAML); default: all defaults", metavar="[CONFIG]")
    ] = None,
    keys: Annotated[bool, typer.Option("--keys", help="list all keys with default, unit and meaning")] = False,
    presets: Annotated[bool, typer.Option("--presets", help="list the presets of instruments, with sources")] = False,
    markdown: Annotated[
        bool, typer.Option("--markdown", help="with --keys or --presets: print Markdown, as in the manual")
    ] = False,
) -> None:
    """Print the effective configuration with every key; an unknown key is an error."""
    from rovgraph.config import load_config

    settings = load_config(path)
    if presets:
        typer.echo(preset_tables() if markdown else "\n".join(_preset_lines()))
    elif keys and markdown:
        typer.echo(key_tables())
    elif keys:
        _print_keys()
    else:
        typer.echo(settings.to_yaml().rstrip("\n"))


def key_tables() -> str:
    """All keys as Markdown, a table per section: what docs/configuration.md holds."""
    lines: list[str] = []
    for section, rows in _sections():
        lines += [
            f"### {_GROUP_TEXT.get(section, section)}",
            "",
            "| key | unit | default | meaning |",
            "|---|---|---|---|",
        ]
        lines += [f"| `{key}` | {unit} | `{default}` | {meaning} |" for key, unit, default, meaning in rows]
        lines.append("")
    return "\n".join(lines).rstrip("\n")


def preset_tables() -> str:
    """All presets as Markdown, a table per kind: what docs/presets.md holds."""
    from rovgraph.config.presets import KINDS
    from rovgraph.config.presets import presets as known

    lines: list[str] = []
    for kind in KINDS:
        lines += [
            f"### {_GROUP_TEXT[kind]}",
            "",
            "| preset | instrument | fills in | source and remarks |",
            "|---|---|---|---|",
        ]
        for preset in (p for p in known().values() if p.kind == kind):
            filled = "<br>".join(f"`{f.key}`: {f.stated}" for f in preset.facts) or "nothing"
            said = "<br>".join([*dict.fromkeys(f.source for f in preset.facts), *preset.notes])
            lines.append(f"| `{preset.name}` | {preset.instrument} | {filled} | {said} |")
        lines.append("")
    return "\n".join(lines).rstrip("\n")


def _preset_lines() -> Iterator[str]:
    """Presets with what they fill in, each number with its source."""
    from rovgraph.config.presets import presets as known

    for preset in known().values():
        yield f"{preset.kind}: {{preset: {preset.name}}}    {preset.instrument}"
        for fact in preset.facts:
            value = fact.value if isinstance(fact.value, float) else fact.value[0]
            yield f"    {fact.key:26} {value:<10.4g} {fact.stated}"
            yield f"        {fact.source}"
        yield from (f"    {note}" for note in preset.notes)


def _rows() -> Iterator[tuple[str, str, str, str]]:
    """Key, unit, default as in YAML and meaning of every key."""
    from rovgraph.config import describe

    for key, default, meaning in describe():
        unit = next((unit for ending, unit in _UNITS.items() if key.endswith(ending)), "")
        bracket = re.search(r" ?\[([^]]+)\]", meaning)
        if bracket is not None:
            unit, meaning = bracket.group(1), meaning.replace(bracket.group(0), "")
        unit = {"degrees": "deg", "1": ""}.get(unit, unit)
        yield key, unit, {"True": "true", "False": "false"}.get(default, default), meaning


def _sections() -> Iterator[tuple[str, list[tuple[str, str, str, str]]]]:
    """Rows grouped by the first part of their key; keys without a section are "General"."""
    rows = sorted(_rows(), key=lambda row: "." in row[0])
    for section, group in itertools.groupby(rows, key=lambda row: row[0].split(".")[0] if "." in row[0] else ""):
        yield section, list(group)


def _print_keys() -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    from rovgraph.cli.console import console

    table = Table(box=box.SIMPLE_HEAD)
    for heading in ("key", "default", "meaning"):
        table.add_column(heading, no_wrap=heading == "key", overflow="fold")
    for _, rows in _sections():
        for key, unit, default, meaning in rows:
            table.add_row(key, Text(default), Text(f"{meaning} [{unit}]" if unit else meaning))
        table.add_section()
    console(wide=200).print(table)
