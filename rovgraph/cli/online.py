"""``rovgraph online``: estimate while data arrive."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer


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
    rate: Annotated[float, typer.Option(min=0.01, max=200.0, help="solutions per second")] = 10.0,
    speed: Annotated[str, typer.Option(help="of files: 1, 10, max")] = "1",
    engine: Annotated[Engine, typer.Option(help="fixed-lag for missions without end, isam2 for all of the track")] = (
        Engine.fixed_lag
    ),
    resume: Annotated[bool, typer.Option("--resume", help="go on after a crash, with what is in --out")] = False,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="smooth the recording at the end")] = True,
    force: Annotated[bool, typer.Option("--force", help="replace an older folder")] = False,
) -> None:
    """Estimate while data arrive, on board or at the topside.

    Example: rovgraph online waterlinked://192.168.2.95 mavlink:udpin:127.0.0.1:14550 --out dive
    """
    import signal
    import sys

    from rovgraph.cli.live_folder import finished, prepared
    from rovgraph.config import load_config
    from rovgraph.errors import InputError
    from rovgraph.live.clocks import Clocks
    from rovgraph.live.complaints import Complaints
    from rovgraph.live.feed import Feed
    from rovgraph.live.navigator import Navigator
    from rovgraph.live.outputs import open_output
    from rovgraph.live.session import Files, Session
    from rovgraph.live.sources import open_sources
    from rovgraph.report.status import StatusLine

    if resume and out is None:
        raise InputError("--resume needs the folder to go on with, --out")

    def say(source: str, kind: str, text: str) -> None:
        print(f"{source}: {kind}: {text}", file=sys.stderr)

    settings, complaints = load_config(config), Complaints(say)
    feed = Feed(open_sources(sources, complaints, settings, speed), complaints)
    recorded = feed.recorded
    wanted = output if output is not None else ([] if sys.stdout.isatty() else ["-"])
    outputs = [open_output(url, complaints.complain, patient=recorded) for url in wanted]
    files = None
    if out is not None:
        prepared(out, force, resume)
        files = Files(out, settings, complaints, resume)
    navigator = Navigator(settings, patient=recorded, clocks=Clocks(trust=recorded))
    session = Session(navigator, outputs, complaints, rate, files)
    signal.signal(signal.SIGINT, lambda *_: feed.close())
    signal.signal(signal.SIGTERM, lambda *_: feed.close())
    try:
        with StatusLine() as status:
            session.watch(status.show)
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
        raise InputError(f"no estimate was made: {navigator.waits_for or 'no measurement of an IMU came'}")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if out is not None:
        finished(out, session, refine)
