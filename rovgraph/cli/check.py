"""``rovgraph check``: is this log sane?"""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rovgraph.cli.files import Choose, Files, Shift, Times, read_files

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from rovgraph.check import Report


def check(
    files: Files,
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
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
    from rovgraph.check import refuse
    from rovgraph.cli.console import console, say

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
