"""Commands on logs: ``check``, ``config`` (the effective configuration, or all keys) and ``convert``."""

import itertools
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rovgraph.cli.files import Choose, ConfigPath, Files, Shift, Times, pairs, read_files, seconds, whose

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rovgraph.diagnosis.check import Report


def check(
    files: Files,
    config: ConfigPath = None,
    as_json: Annotated[bool, typer.Option("--json", help="print the report as JSON")] = False,
    choose: Choose = None,
    shift: Shift = None,
    times: Times = None,
    page: Annotated[Path | None, typer.Option("--page", help="also write the report as an HTML page")] = None,
    force: Annotated[bool, typer.Option("--force", help="replace an older page")] = False,
) -> None:
    """Check a log: sensors, rates, gaps, units, signs, clocks, and the assumptions of an estimate."""
    import json

    import rovgraph as rg
    from rovgraph.cli.console import console, say
    from rovgraph.diagnosis.check import refuse

    settings = None if config is None else rg.load_config(config)
    log = read_files(files, settings, choose, shift, times)
    report = rg.check(log, settings)
    if page is not None:
        rg.report_check(report, page, force)
    if as_json:
        typer.echo(json.dumps(report.as_dict(), indent=2, allow_nan=False))
    else:
        out = console()
        out.print(_timing_table(report))
        for finding in report.findings:
            _print_finding(out, finding.level, f"{finding.sensor}: {finding.text}")
        for note in log.notes:
            say(out, f"assumed: {note}")
        errors, doubts = len(report.at("error")), len(report.at("warning"))
        out.print(f"{_plural(errors, 'error')}, {_plural(doubts, 'warning')}", style="bold")
    refuse(report)


def _plural(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n or 'no'} {what}s"


def _print_finding(console: "Console", level: str, text: str) -> None:
    from rovgraph.cli.console import say

    style = {"ok": "green", "warning": "yellow", "error": "bold red"}[level]
    say(console, f"{level:8}{text}", style, styled=8, indent=8)


def _timing_table(report: "Report") -> "Table":
    """When the measurements of each sensor came; times are seconds from the start of the log."""
    from rich import box
    from rich.table import Table
    from rich.text import Text

    table = Table(title=Text(report.source), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for heading in ("sensor", "count", "Hz", "from\n[s]", "to\n[s]", "gap\n[s]", "at\n[s]", "jitter\n[s]", "repeats"):
        table.add_column(Text(heading), justify="left" if heading == "sensor" else "right", no_wrap=True)
    start = min(t.first for t in report.timings)
    for t in report.timings:
        gap = f"{t.gap:.3g}" if t.gap < 1000.0 else f"{t.gap:.0f}"
        numbers = (f"{t.rate:.4g}", f"{t.first - start:.1f}", f"{t.last - start:.1f}", gap)
        jitter = f"{t.jitter:.2g}" if t.jitter >= 1e-4 else "0"
        table.add_row(t.sensor, str(t.count), *numbers, f"{t.gap_at - start:.1f}", jitter, str(t.repeats))
    table.caption = f"0 s is {start:.3f} s of the log's clock; gap: the largest, and when"
    return table


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
    "usbl": "usbl: acoustic direction and range",
    "range": "range: acoustic ranges to beacons",
    "ship": "ship: what carries acoustic heads",
    "sound": "sound: its speed in the water",
    "place": "place: places seen before",
    "calibration": "calibration: estimated, considered, or exact",
    "vehicle": "vehicle: hydrodynamics, thesis (2.16)-(2.24)",
    "graph": "graph: how it is built and solved",
    "chart": "chart: of the bottom",
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
    from rovgraph.model.config import load_config

    settings = load_config(path)
    if presets:
        typer.echo(preset_tables() if markdown else "\n".join(_preset_lines()))
    elif keys and markdown:
        typer.echo(key_tables())
    elif keys:
        _print_keys()
    else:
        typer.echo(settings.to_yaml().rstrip("\n"))


_LIKE_THE_FIRST = re.compile(r"calibration\.beacon_[2-9]")


def key_tables() -> str:
    """All keys as Markdown, a table per section: what docs/configuration.md holds; of beacons the first one's."""
    lines: list[str] = []
    for section, rows in _sections():
        lines += [
            f"### {_GROUP_TEXT.get(section, section)}",
            "",
            "| key | unit | default | meaning |",
            "|---|---|---|---|",
        ]
        rows = [row for row in rows if not _LIKE_THE_FIRST.match(row[0])]
        lines += [f"| `{key}` | {unit} | `{default}` | {meaning} |" for key, unit, default, meaning in rows]
        lines.append("")
    return "\n".join(lines).rstrip("\n")


def preset_tables() -> str:
    """All presets as Markdown, a table per kind: what docs/presets.md holds."""
    from rovgraph.model.presets import KINDS
    from rovgraph.model.presets import presets as known

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
    from rovgraph.model.presets import presets as known

    for preset in known().values():
        yield f"{preset.kind}: {{preset: {preset.name}}}    {preset.instrument}"
        for fact in preset.facts:
            value = fact.value[0] if isinstance(fact.value, tuple) else fact.value
            yield f"    {fact.key:26} {value:<10.4g} {fact.stated}"
            yield f"        {fact.source}"
        yield from (f"    {note}" for note in preset.notes)


def _rows() -> Iterator[tuple[str, str, str, str]]:
    """Key, unit, default as in YAML and meaning of every key."""
    from rovgraph.model.config import describe

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


WIDE = 150  # columns of a file or a pipe, which has no width of its own


def convert(
    files: Files,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="log to write: .csv, .csv.gz or .parquet")] = None,
    config: ConfigPath = None,
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
    from rovgraph.cli.console import console, progress_bar, say
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
    from rovgraph.api.conversion import proposal, save_proposal
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
