"""``rovgraph online``: estimate while data arrive."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from rovgraph.live.outputs import Output
    from rovgraph.live.solution import Solution
    from rovgraph.web.page import LivePage


class Engine(StrEnum):
    """What estimates."""

    fixed_lag = "fixed-lag"
    isam2 = "isam2"


def online(
    sources: Annotated[list[str], typer.Argument(help="URLs, see docs/online.md", metavar="SOURCE...")],
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="folder for recording, track and checkpoint")] = None,
    output: Annotated[
        list[str] | None, typer.Option("--output", help="where solutions go; default: - unless on a terminal")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.01, max=200.0, help="solutions per second; default: 5, or 10 with --http")
    ] = None,
    speed: Annotated[str, typer.Option(help="of files: 1, 10, max")] = "1",
    engine: Annotated[Engine, typer.Option(help="fixed-lag for missions without end, isam2 for all of the track")] = (
        Engine.fixed_lag
    ),
    resume: Annotated[bool, typer.Option("--resume", help="go on after a crash, with what is in --out")] = False,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="smooth the recording at the end")] = True,
    force: Annotated[bool, typer.Option("--force", help="replace an older folder")] = False,
    http: Annotated[str | None, typer.Option("--http", help="show a live page at host:port", metavar="ADDRESS")] = None,
    chart: Annotated[
        list[Path] | None, typer.Option("--chart", help="below the live page's track: GeoTIFF, GeoJSON, tiles")
    ] = None,
    http_origin: Annotated[
        list[str] | None, typer.Option("--http-origin", help="origin of a page that may frame the live page")
    ] = None,
    http_token: Annotated[Path | None, typer.Option("--http-token", help="file that keeps the page's token")] = None,
    position_sd_limit: Annotated[float, typer.Option(help="metres; beyond it the live page raises an alarm")] = 5.0,
) -> None:
    """Estimate while data arrive, on board or at the topside.

    Example: rovgraph online waterlinked://192.168.2.95 mavlink:udpin:127.0.0.1:14550 --out dive
    """
    import sys

    from rovgraph.api.logs import warn_of_unused
    from rovgraph.cli.ending import asked_by_signal, ended_by_signals
    from rovgraph.cli.live_folder import configured, finished, prepared, unfinished
    from rovgraph.errors import InputError
    from rovgraph.live.clocks import Clocks
    from rovgraph.live.feed import Feed
    from rovgraph.live.files import Files
    from rovgraph.live.marks import Marks
    from rovgraph.live.navigator import Navigator
    from rovgraph.live.outputs import open_output
    from rovgraph.live.session import PAGE_RATE_HZ, RATE_HZ, Session
    from rovgraph.live.sources import open_sources
    from rovgraph.live.warnings import Warnings
    from rovgraph.report.status import StatusLine

    if resume and out is None:
        raise InputError("--resume needs the folder to go on with, --out")
    settings, warnings = configured(config, out, resume), Warnings(_say)
    replayed = [url.removeprefix("file:").partition("?")[0] for url in sources if url.startswith("file:")]
    warn_of_unused(*(replayed if config is None and not resume else []))
    opened = open_sources(sources, warnings, settings, speed)
    if resume and any(source.pace == 1.0 for source in opened):
        raise InputError("--resume goes on with a recording at another speed than 1; add --speed max")
    feed = Feed(opened, warnings)
    wanted = output if output is not None else ([] if sys.stdout.isatty() else ["-"])
    outputs: list[Output | LivePage] = [open_output(url, warnings, patient=feed.recorded) for url in wanted]
    marks = Marks(out, warnings, resume)
    watched = chart or (), http_origin or (), http_token, position_sd_limit
    outputs += [] if http is None else [_page(http, feed.offer, marks, *watched, warnings)]
    usual_rate = RATE_HZ if http is None else PAGE_RATE_HZ
    files = None
    if out is not None:
        prepared(out, force, resume, sources)
        files = Files(out, settings, warnings, resume, anew=engine is Engine.isam2)
    navigator = Navigator(settings, feed.recorded, smooth=engine is Engine.isam2, clocks=Clocks(trust=feed.replayed))
    session = Session(navigator, [each.send for each in outputs], warnings, rate or usual_rate, files, marks)
    asked_by_signal(session.want_smoothed)
    with ended_by_signals(feed.close):
        try:
            with StatusLine(waiting=lambda: navigator.waiting(sources)) as status:
                session.receivers.append(status.show)
                if not status.shown:
                    session.receivers.append(_tell)
                if resume:
                    session.resume()
                session.run(feed)
        finally:
            navigator.close()
            for each in outputs:
                each.close()
            if files is not None:
                files.close()
    if session.solution is None:
        unfinished(out)
        raise InputError(f"no estimate was made: {navigator.waiting(sources)}")
    if out is not None:
        finished(out, session, refine)


def _say(source: str, kind: str, text: str) -> None:
    _note(f"{source}: {kind}: {text}")


def _page(address: str, *arguments: Any) -> "LivePage":
    """The live page, and its address for a person."""
    from rovgraph.api.live_page import live_page

    page = live_page(address, *arguments)
    _note(f"live page: {page.url}")
    return page


def _note(text: str) -> None:
    """A line for a person, wherever that person has gone."""
    import contextlib
    import sys

    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def _tell(solution: "Solution") -> None:
    """Events, where nothing else shows them."""
    for event in solution.events:
        _say(f"{event.time:.1f} s: {event.source}", event.kind, event.text)
