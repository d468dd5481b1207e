"""The folder of a live run, before it and after."""

import contextlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rovgraph.config import Config, load_config
from rovgraph.errors import InputError
from rovgraph.live.files import SETTINGS
from rovgraph.live.session import Session
from rovgraph.report.folder import STAMP, SUMMARY, check_writable
from rovgraph.report.results import to_plain


def settings_of(folder: Path) -> Config:
    """The configuration of an earlier run; all defaults where it left none."""
    return load_config(folder / SETTINGS if (folder / SETTINGS).is_file() else None)


def prepare(folder: Path, force: bool, sources: Sequence[str]) -> None:
    """Make the folder of a run.

    Raises
    ------
    InputError : it holds something that must not be replaced, or cannot be made
    """
    for url in sources:
        if _file(url).is_relative_to(folder.resolve()):
            raise InputError(f"{url}: lies in {folder}, which would be replaced; choose another --out")
    check_writable(folder, force)
    try:
        if folder.exists():
            shutil.rmtree(folder)
        folder.mkdir(parents=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}); choose another --out") from None
    _write_summary(folder, {"state": "running"})


def summarise(folder: Path, session: Session) -> None:
    """Write what came of a run.

    Raises
    ------
    InputError : it cannot be written
    """
    solution, navigator = session.solution, session.navigator
    if solution is None:
        with contextlib.suppress(InputError):  # that there is no estimate is the worse news
            _write_summary(folder, {"state": "no estimate"})
        return
    _write_summary(
        folder,
        {
            "state": "finished",
            "verdict": solution.verdict,
            "alarms": [vars(alarm) for alarm in navigator.alarms.history.values()],
            "advice": [vars(advice) for advice in navigator.alarms.advice.values()],
            "time": solution.time,
            "position_m": solution.position.tolist(),
            "position_sd_m": solution.position_sd.tolist(),
            "distance_m": solution.distance,
            "calibration": {name: list(pair) for name, pair in solution.calibration.items()},
            "marks": [asdict(mark) for mark in session.marks.all],
            "solutions": session.solutions,
            "left_out": [[*key, count] for key, count in sorted(navigator.left_out.items())],
            "warnings": [[*key, count] for key, count in sorted(session.warnings.counts.items())],
            "updates": session.updates(),
        },
    )


def _file(url: str) -> Path:
    """The file of a URL, if it is one of a file."""
    return Path(url.partition(":")[2].partition("?")[0]).resolve()


def _write_summary(folder: Path, content: dict[str, Any]) -> None:
    partial = folder / f".{SUMMARY}.partial"
    try:
        plain = to_plain({**STAMP, "kind": "online", **content})
        partial.write_text(json.dumps(plain, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(folder / SUMMARY)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise InputError(f"{folder / SUMMARY}: cannot be written ({error.strerror}); free some space") from None
