"""The folder of a run of the online mode, before it and after."""

import contextlib
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rovgraph.config import Config
    from rovgraph.live.session import Session


def configured(config: Path | None, out: Path | None, resume: bool) -> "Config":
    """The configuration of a run; where one goes on and none is given, that of the run before."""
    from rovgraph.config import load_config
    from rovgraph.live.files import SETTINGS

    if resume and config is None and out is not None and (out / SETTINGS).is_file():
        config = out / SETTINGS
    return load_config(config)


def prepared(out: Path, force: bool, resume: bool, sources: Sequence[str]) -> None:
    """Make the folder, or see that it can be gone on with.

    Raises
    ------
    InputError : it holds something that must not be replaced, or cannot be made
    """
    from rovgraph.errors import InputError
    from rovgraph.report.folder import check_writable

    if resume:
        return
    for url in sources:
        if _file(url).is_relative_to(out.resolve()):
            raise InputError(f"{url}: lies in {out}, which would be replaced; choose another --out")
    check_writable(out, force)
    try:
        if out.exists():
            shutil.rmtree(out)
        out.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{out}: cannot be made ({error.strerror}); choose another --out") from None
    _write_summary(out, {"state": "running"})


def unfinished(out: Path | None) -> None:
    """Say in the folder that no estimate was made."""
    from rovgraph.errors import InputError

    if out is not None:
        with contextlib.suppress(InputError):
            _write_summary(out, {"state": "no estimate"})


def finished(out: Path, session: "Session", refine: bool) -> None:
    """Write the summary, and smooth what was recorded.

    Raises
    ------
    InputError : not all of it could be written
    """
    from rovgraph.errors import InputError

    solution, navigator = session.solution, session.navigator
    assert solution is not None
    _write_summary(
        out,
        {
            "state": "finished",
            "verdict": solution.verdict,
            "alarms": [vars(alarm) for alarm in navigator.alarms.history.values()],
            "time": solution.time,
            "position_m": solution.position.tolist(),
            "position_sd_m": solution.position_sd.tolist(),
            "distance_m": solution.distance,
            "calibration": {name: list(pair) for name, pair in solution.calibration.items()},
            "solutions": session.solutions,
            "left_out": [[*key, count] for key, count in sorted(navigator.left_out.items())],
            "warnings": [[*key, count] for key, count in sorted(session.warnings.counts.items())],
            "updates": session.updates(),
        },
    )
    if refine:
        _smooth(out)
    if session.files is not None and session.files.recorder.lost:
        raise InputError(f"{out}: {session.files.recorder.lost} rows of the recording were lost, the disk was full")
    _note(f"results in {out}")


def _smooth(out: Path) -> None:
    """What was recorded, into a folder beside it; standard output is for solutions."""
    from rovgraph.cli.smooth import smooth
    from rovgraph.errors import InputError
    from rovgraph.live.files import CONFIG, RECORDING

    _note("smoothing what was recorded; Ctrl-C leaves it out")
    try:
        with contextlib.redirect_stdout(sys.stderr):
            smooth([out / RECORDING], out / CONFIG, out / "smoothed", force=True)
    except InputError as error:
        _note(f"not smoothed: {error}")
    except KeyboardInterrupt:
        _note("not smoothed: interrupted")


def _note(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):
        print(text, file=sys.stderr, flush=True)


def _file(url: str) -> Path:
    """The file of a URL, if it is one of a file."""
    return Path(url.partition(":")[2].partition("?")[0]).resolve()


def _write_summary(out: Path, content: dict[str, Any]) -> None:
    from rovgraph.errors import InputError
    from rovgraph.report.folder import STAMP, SUMMARY
    from rovgraph.report.results import to_plain

    partial = out / f".{SUMMARY}.partial"
    try:
        plain = to_plain({**STAMP, "kind": "online", **content})
        partial.write_text(json.dumps(plain, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(out / SUMMARY)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise InputError(f"{out / SUMMARY}: cannot be written ({error.strerror}); free some space") from None
