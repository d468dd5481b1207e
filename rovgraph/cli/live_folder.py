"""The folder of a run of the online mode, before it and after."""

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rovgraph.live.session import Session


def prepared(out: Path, force: bool, resume: bool) -> None:
    """Make the folder, or see that it can be gone on with.

    Raises
    ------
    InputError : it holds something that must not be replaced, or cannot be made
    """
    from rovgraph.errors import InputError
    from rovgraph.report.folder import check_writable

    if resume:
        if not out.is_dir():
            raise InputError(f"{out}: nothing to resume, there is no such folder; leave out --resume")
        return
    check_writable(out, force)
    if out.exists():
        shutil.rmtree(out)
    out.mkdir(parents=True)
    _write_summary(out, {"state": "running"})


def finished(out: Path, session: "Session", refine: bool) -> None:
    """Write the summary, and smooth what was recorded."""
    import sys

    from rovgraph.cli.smooth import smooth
    from rovgraph.errors import InputError
    from rovgraph.live.session import CONFIG, RECORDING

    solution, navigator = session.solution, session.navigator
    assert solution is not None
    _write_summary(
        out,
        {
            "state": "finished",
            "time": solution.time,
            "position_m": solution.position.tolist(),
            "position_sd_m": solution.position_sd.tolist(),
            "distance_m": solution.distance,
            "calibration": {name: list(pair) for name, pair in solution.calibration.items()},
            "solutions": session.solutions,
            "left_out": [[*key, count] for key, count in sorted(navigator.left_out.items())],
            "complaints": [[*key, count] for key, count in sorted(session.complaints.counts.items())],
            "updates": session.updates(),
        },
    )
    if not refine:
        return
    print("smoothing what was recorded", file=sys.stderr)
    try:
        smooth(out / RECORDING, out / CONFIG, out / "smoothed", force=True)
    except InputError as error:
        print(f"not smoothed: {error}", file=sys.stderr)


def _write_summary(out: Path, content: dict[str, Any]) -> None:
    from rovgraph.report.folder import STAMP, SUMMARY

    partial = out / f".{SUMMARY}.partial"
    partial.write_text(json.dumps({**STAMP, "kind": "online", **content}, indent=2) + "\n", encoding="utf-8")
    partial.replace(out / SUMMARY)
