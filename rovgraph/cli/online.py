"""``rovgraph online``: estimate while data arrive, until a signal or a limit ends it."""

import contextlib
import signal
from collections.abc import Callable, Iterator
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rovgraph.cli.files import ConfigPath

if TYPE_CHECKING:
    from rovgraph.live.solution import Solution

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")  # Ctrl-C, a system that shuts down, a terminal that is closed


@contextlib.contextmanager
def ended_by_signals(end: Callable[[], None]) -> Iterator[None]:
    """Have the first of these signals call ``end``; a second one does what it always does.

    A signal that is ignored, as nohup has it, stays ignored.
    """
    handled = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
    before = {number: handler for number in handled if (handler := signal.getsignal(number)) != signal.SIG_IGN}

    def restore(*_: object) -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def first(*_: object) -> None:
        restore()
        end()

    for number in before:
        signal.signal(number, first)
    try:
        yield
    finally:
        restore()


def asked_by_signal(answer: Callable[[], None]) -> None:
    """Have SIGUSR1 call ``answer``, where there is such a signal."""
    if hasattr(signal, "SIGUSR1"):
        signal.signal(signal.SIGUSR1, lambda *_: answer())


class OnlineEngine(StrEnum):
    """What estimates."""

    fixed_lag = "fixed-lag"
    isam2 = "isam2"


def online(
    sources: Annotated[list[str], typer.Argument(help="URLs, see docs/online.md", metavar="SOURCE...")],
    config: ConfigPath = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="folder for recording, track and checkpoint")] = None,
    output: Annotated[
        list[str] | None, typer.Option("--output", help="where to send solutions; default: - unless on a terminal")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.01, max=200.0, help="solutions per second; default: 5, or 10 with --http")
    ] = None,
    speed: Annotated[str, typer.Option(help="speed of replayed files: 1, 10, max")] = "1",
    engine: Annotated[
        OnlineEngine, typer.Option(help="fixed-lag for missions of any length; isam2 also gives the smoothed track")
    ] = (OnlineEngine.fixed_lag),
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
