"""What a run of the online mode has on disk, so that a crash loses no more than a second."""

import io
import json
import time as host
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pymap3d

from rovgraph.config import AS_WRITTEN, Config
from rovgraph.errors import InputError
from rovgraph.estimators.eskf.error_state import REINITIALISE_AT_S
from rovgraph.estimators.eskf.fixed_lag import FixedLag
from rovgraph.estimators.estimate import Estimate
from rovgraph.live.checkpoint import read_checkpoint
from rovgraph.live.keeper import Keeper
from rovgraph.live.navigator import Navigator
from rovgraph.live.recorder import Recorder
from rovgraph.live.solution import Event
from rovgraph.live.track import TrackFile
from rovgraph.live.warnings import Warnings
from rovgraph.log import Log, read_log

RECORDING, TRACK, CHECKPOINT = "received.csv", "trajectory_filtered.csv", "checkpoint"
CONFIG, SETTINGS, EVENTS = "config.yaml", "config_online.yaml", "events.jsonl"  # of the recording; of the run
KNOWN = "sources.json"
SMOOTHED = "trajectory_smoothed.csv"
KEEP_S = 0.5  # of the host's time between checkpoints
UNWRITTEN = 10_000  # keyframes that wait for a disk that is full; then the oldest are lost
# a recording that is shorter is replayed from its start, since the filter is still to be re-initialised
REPLAYED_S = REINITIALISE_AT_S[-1]
LAST_BYTES = 1 << 22  # of a recording, that a resumed run reads again: minutes


@dataclass
class Files:
    """What is on disk of a run, so that a crash loses no more than a second.

    Parameters
    ----------
    folder : an existing one
    config : as the user gave it
    warnings : where trouble with the disk goes
    resume : go on with what is there
    replayed : from the recording alone, not from the checkpoint

    Attributes
    ----------
    state : the checkpoint that is resumed; None where there is none
    received : what had been received after it; None where there is nothing

    Raises
    ------
    InputError : the folder cannot be written, or holds nothing to go on with, or a recording that cannot be read
    """

    folder: Path
    config: Config
    warnings: Warnings
    resume: bool = False
    replayed: bool = False

    def __post_init__(self) -> None:
        if self.resume and not self.folder.is_dir():
            raise InputError(f"{self.folder}: nothing to resume, there is no such folder; leave out --resume")
        checkpoint = self.folder / CHECKPOINT
        self.state: dict[str, Any] | None = None
        until = -np.inf
        if self.resume and not (self.folder / RECORDING).exists():
            raise InputError(f"{self.folder}: nothing to resume, there is no {RECORDING}; leave out --resume")
        self.replayed = self.replayed or (self.resume and self._seconds() < REPLAYED_S)
        if self.resume and checkpoint.exists():
            self.state = read_checkpoint(checkpoint)
            until = -np.inf if self.replayed else float(self.state["engine"]["keyframe"][1])
        self.recorder = Recorder(self.folder / RECORDING, self.warnings)
        self.received = self._received() if self.resume else None  # before the track is touched: it may not be readable
        self.track = TrackFile(self.folder / TRACK, until)
        self.keeper = Keeper(checkpoint, self.warnings)
        recorded = self.config.model_copy(update={**AS_WRITTEN, "delay_s": {}})  # which has been applied
        try:
            (self.folder / CONFIG).write_text(recorded.to_yaml(), encoding="utf-8")
            (self.folder / SETTINGS).write_text(self.config.to_yaml(), encoding="utf-8")
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be written ({error.strerror}); free some space") from None
        self._kept = host.monotonic()

    def _seconds(self) -> float:
        """Length of the recording [s]; 0 where it has no two rows."""
        try:
            with (self.folder / RECORDING).open("rb") as file:
                file.readline()
                first = file.readline()
                file.seek(max(file.tell(), file.seek(0, 2) - 65536))
                last = file.read().splitlines()[-2:]
            return float(last[0].split(b",")[0]) - float(first.split(b",")[0])
        except (OSError, ValueError, IndexError):
            return 0.0

    def _received(self) -> Log | None:
        """Of a recording that is resumed all, or what is newer than the checkpoint; None where it has no row."""
        path = self.folder / RECORDING
        with path.open("rb") as file:
            file.readline()
            if not file.readline():  # the header alone
                return None
        if self.replayed or self.state is None:
            # recorded under rovgraph's own names, in SI
            return replace(read_log(path, Config(environment=self.config.environment)), config=None)
        return Log.from_frame(_last_rows(path, self.state["origin"]), source=str(path))

    def note(self, events: Iterable[Event]) -> None:
        """Keep events."""
        lines = "".join(json.dumps(event.as_dict(), allow_nan=False) + "\n" for event in events)
        if not lines:
            return
        path = self.folder / EVENTS
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(lines)
        except OSError as error:
            self.warnings.complain(str(path), "disk", f"cannot be written ({error.strerror}); free some space")

    def write_smoothed(self, estimate: Estimate, origin: tuple[float, float] | None = None) -> None:
        """Put a smoothed track on disk, in place of an older one; ``origin`` of `Trajectory.write_csv`."""
        path, partial = self.folder / SMOOTHED, self.folder / f".{SMOOTHED}.partial"
        try:
            estimate.trajectory.write_csv(partial, origin=origin)
            partial.replace(path)
        except OSError as error:
            self.warnings.complain(str(path), "disk", f"cannot be written ({error.strerror}); free some space")

    def keep(self, navigator: Navigator, now: bool = False) -> None:
        """Put the track and a checkpoint on disk, if it is time to."""
        if not now and host.monotonic() - self._kept < KEEP_S:
            return
        self._kept = host.monotonic()
        engine = navigator.engine
        if engine is None:
            return
        written = self._add(navigator, engine)
        if written and (state := navigator.state()) is not None:  # a checkpoint may not be ahead of the track
            self.keeper.keep(state)

    def _add(self, navigator: Navigator, engine: FixedLag) -> bool:
        """Add to the track what the lag has passed, if the disk takes it."""
        if not navigator.passed:
            return True
        passed = navigator.passed
        try:
            self.track.add(engine.trajectory([s.keyframe for s in passed], [s.known for s in passed]), navigator.origin)
        except InputError as error:
            path = str(self.track.path)
            self.warnings.complain(path, "disk", str(error).removeprefix(f"{path}: "))
            del navigator.passed[:-UNWRITTEN]
            return False
        navigator.passed = []
        return True

    def finish(self, navigator: Navigator) -> None:
        """Put the end of the track on disk; the checkpoint stays where it was, from there one may go on."""
        if navigator.engine is not None:
            self._add(navigator, navigator.engine)

    def close(self) -> None:
        self.keeper.close()
        self.recorder.close()


class Known(dict[str, float]):
    """What sources have found out and a resumed run goes on with, such as the pressure at the surface, in a file.

    Parameters
    ----------
    folder : of the run; None = it is not kept
    resume : go on with what is there
    warnings : told where it cannot be written
    """

    def __init__(self, folder: Path | None, resume: bool, warnings: Warnings) -> None:
        super().__init__()
        self._path, self._warnings = None if folder is None else folder / KNOWN, warnings
        if resume and self._path is not None and self._path.is_file():
            try:
                self.update({str(key): float(value) for key, value in json.loads(self._path.read_bytes()).items()})
            except (OSError, ValueError, TypeError, AttributeError):
                warnings.complain(str(self._path), "damaged", "is damaged: what sources had found out is found again")

    def __setitem__(self, key: str, value: float) -> None:
        if self.get(key) == value:
            return
        super().__setitem__(key, value)
        if self._path is None:
            return
        partial = self._path.with_name(f".{KNOWN}.partial")
        try:
            partial.write_text(json.dumps(self), encoding="utf-8")
            partial.replace(self._path)
        except OSError as error:
            self._warnings.complain(str(self._path), "disk", f"cannot be written ({error.strerror}); free some space")


def _last_rows(path: Path, origin: tuple[float, float] | None) -> pd.DataFrame:
    """The newest rows of a recording; fixes relative to an origin."""
    with path.open("rb") as file:
        header = file.readline()
        file.seek(max(len(header), path.stat().st_size - LAST_BYTES))
        rows = file.read()
    if len(header) + len(rows) < path.stat().st_size:
        rows = rows[rows.index(b"\n") + 1 :]
    frame = pd.read_csv(io.BytesIO(header + rows[: rows.rfind(b"\n") + 1]))
    if origin is not None and frame["fix_lat"].notna().any():
        lat, lon = frame.pop("fix_lat").to_numpy(float), frame.pop("fix_lon").to_numpy(float)
        frame["fix_north"], frame["fix_east"], _ = pymap3d.geodetic2ned(lat, lon, 0.0, *origin, 0.0)
    return frame
