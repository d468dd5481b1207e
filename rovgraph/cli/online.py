"""``rovgraph online``: estimate while data arrive."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rovgraph.live.solution import Solution


class Engine(StrEnum):
    """What estimates."""

    fixed_lag = "fixed-lag"
    isam2 = "isam2"


def online(
    sources: Annotated[list[str], typer.Argument(help="URLs, see docs/online.md", metavar="SOURCE...")],
    config: Annotated[Path | None, typer.Option("--config", "-c", help="configuration (YAML)")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="folder for recording, track and checkpoint")] = None,
    output: Annotated[
        list[str] | None, typer.Option("--output", help="where to send solutions; default: - unless on a terminal")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.01, max=200.0, help="solutions per second; default: 5, or 10 with --http")
    ] = None,
    speed: Annotated[str, typer.Option(help="speed of replayed files: 1, 10, max")] = "1",
    engine: Annotated[
        Engine, typer.Option(help="fixed-lag for missions of any length; isam2 also gives the smoothed track")
    ] = (Engine.fixed_lag),
    resume: Annotated[bool, typer.Option("--resume", help="continue after a crash, with the files in --out")] = False,
    refine: Annotated[bool, typer.Option("--refine/--no-refine", help="smooth the recording at the end")] = True,
    force: Annotated[bool, typer.Option("--force", help="replace an older folder")] = False,
    http: Annotated[str | None, typer.Option("--http", help="show a live page at host:port", metavar="ADDRESS")] = None,
    chart: Annotated[
        list[Path] | None, typer.Option("--chart", help="chart under the live page's track: GeoTIFF, GeoJSON, tiles")
    ] = None,
    http_origin: Annotated[
        list[str] | None, typer.Option("--http-origin", help="origin of a page that may frame the live page")
    ] = None,
    http_token: Annotated[Path | None, typer.Option("--http-token", help="file that holds the page's token")] = None,
    position_sd_limit: Annotated[
        float, typer.Option(help="position sd in metres beyond which the live page raises an alarm")
    ] = 5.0,
) -> None:
    """Estimate while data arrive, on board or at the topside.

    Example: rovgraph online waterlinked://192.168.2.95 mavlink:udpin:0.0.0.0:14551 --out dive
    """
    import sys

    import rovgraph as rg
    from rovgraph.cli.ending import asked_by_signal, ended_by_signals
    from rovgraph.report.status import StatusLine

    believed = None if config is None else rg.load_config(config)
    wanted = output if output is not None else ([] if sys.stdout.isatty() else ["-"])
    run = rg.Online(believed, rate, engine.value).run(
        *sources,
        outputs=wanted,
        speed=speed,
        out=out,
        resume=resume,
        force=force,
        on_warning=_say,
        http=http,
        page={
            "charts": chart or (),
            "origins": http_origin or (),
            "token": http_token,
            "position_sd_limit_m": position_sd_limit,
        },
    )
    if run.page is not None:
        _note(f"live page: {run.page.url}")
    asked_by_signal(run.write_smoothed)
    with ended_by_signals(run.close), StatusLine(waiting=run.waiting) as status:
        for solution in run:
            status.show(solution)
            if not status.shown:
                _tell(solution)
    if out is not None:
        if refine:
            _smooth(out)
        run.require_whole_recording()
        _note(f"results in {out}")


def _smooth(out: Path) -> None:
    """What was recorded, into a folder beside it; standard output is for solutions."""
    import contextlib
    import sys

    from rovgraph.cli.smooth import smooth
    from rovgraph.errors import InputError
    from rovgraph.live.files import CONFIG, RECORDING

    _note("smoothing the recording; Ctrl-C skips it")
    try:
        with contextlib.redirect_stdout(sys.stderr):
            smooth([out / RECORDING], out / CONFIG, out / "smoothed", force=True)
    except InputError as error:
        _note(f"not smoothed: {error}")
    except KeyboardInterrupt:
        _note("not smoothed: interrupted")


def _say(source: str, kind: str, text: str) -> None:
    """What is wrong with a source, an output or the disk."""
    _note(f"{source}: {kind}: {text}")


def _note(text: str) -> None:
    """A line for a person, wherever that person has gone."""
    import contextlib
    import sys

    from rovgraph.cli.console import folded

    with contextlib.suppress(OSError, ValueError):
        print(folded(text, sys.stderr), file=sys.stderr, flush=True)


def _tell(solution: "Solution") -> None:
    """Events, where nothing else shows them."""
    for event in solution.events:
        _say(f"{event.time:.1f} s: {event.source}", event.kind, event.text)
