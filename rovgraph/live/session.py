"""A run of the online mode: sources to a navigator, solutions to outputs, everything to disk."""

import gc
import io
import json
import math
import time as host
from array import array
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pandas as pd
import pymap3d

from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.fixed_lag import FixedLag
from rovgraph.live.checkpoint import read_checkpoint
from rovgraph.live.complaints import Complaints
from rovgraph.live.keeper import Keeper
from rovgraph.live.message import Message
from rovgraph.live.navigator import Navigator
from rovgraph.live.recorder import Recorder
from rovgraph.live.solution import Event, Solution
from rovgraph.live.track import TrackFile, trajectory_of
from rovgraph.log import log_from_frame, read_log
from rovgraph.log.streams import Log

RECORDING, TRACK, CHECKPOINT = "received.csv", "trajectory_filtered.csv", "checkpoint"
CONFIG, SETTINGS, EVENTS = "config.yaml", "config_online.yaml", "events.jsonl"  # of the recording; of the run
SMOOTHED = "trajectory_smoothed.csv"
KEEP_S = 0.5  # of the host's time between checkpoints
UNWRITTEN = 10_000  # keyframes that wait for a disk that is full; then the oldest are lost
ANEW_S = 600.0  # a recording that is shorter is estimated anew: the filter is still to be renewed
LAST_BYTES = 1 << 22  # of a recording, that a resumed run reads again: minutes
COLLECT = (50_000, 20, 50)  # thresholds of the collector: next to nothing here is cyclic
QUIET_S = 0.5  # without the IMU, after which time goes on by the host's clock


class Receiver(Protocol):
    """Takes solutions: an output, the status line."""

    def send(self, solution: Solution) -> None: ...


@dataclass
class Files:
    """What is on disk of a run, so that a crash loses no more than a second.

    Parameters
    ----------
    folder : an existing one
    config : as the user gave it
    complaints : where trouble with the disk goes
    resume : go on with what is there
    anew : from the recording alone, not from the checkpoint

    Raises
    ------
    InputError : the folder cannot be written, or holds nothing to go on with
    """

    folder: Path
    config: Config
    complaints: Complaints
    resume: bool = False
    anew: bool = False

    def __post_init__(self) -> None:
        if self.resume and not self.folder.is_dir():
            raise InputError(f"{self.folder}: nothing to resume, there is no such folder; leave out --resume")
        checkpoint = self.folder / CHECKPOINT
        self.state: dict[str, Any] | None = None
        until = -np.inf
        if self.resume and not (self.folder / RECORDING).exists():
            raise InputError(f"{self.folder}: nothing to resume, there is no {RECORDING}; leave out --resume")
        self.anew = self.anew or (self.resume and self._seconds() < ANEW_S)
        if self.resume and checkpoint.exists():
            self.state = read_checkpoint(checkpoint)
            until = -np.inf if self.anew else float(self.state["engine"]["keyframe"][1])
        self.recorder = Recorder(self.folder / RECORDING, self.complaints.complain)
        self.track = TrackFile(self.folder / TRACK, until)
        self.keeper = Keeper(checkpoint, self.complaints.complain)
        recorded = self.config.model_copy(update=_as_recorded(self.config))
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

    def recorded(self, origin: tuple[float, float] | None) -> Log | None:
        """The end of a recording that is resumed; None where it has no measurement.

        Parameters
        ----------
        origin : latitude and longitude [deg] of north = east = 0, where it is known
        """
        try:
            return log_from_frame(_last_rows(self.folder / RECORDING, origin), str(self.folder / RECORDING))
        except InputError:
            return None

    def all_recorded(self) -> Log | None:
        """All of a recording that is resumed; None where it has no measurement."""
        try:
            return read_log(self.folder / RECORDING)
        except InputError:
            return None

    def note(self, events: Iterable[Event]) -> None:
        """Keep events."""
        lines = "".join(json.dumps(vars(event)) + "\n" for event in events)
        if not lines:
            return
        path = self.folder / EVENTS
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(lines)
        except OSError as error:
            self.complaints.complain(str(path), "disk", f"cannot be written ({error.strerror}); free some space")

    def write_smoothed(self, estimate: Estimate) -> None:
        """Put a smoothed track on disk, in place of an older one."""
        path, partial = self.folder / SMOOTHED, self.folder / f".{SMOOTHED}.partial"
        try:
            estimate.trajectory.write_csv(partial)
            partial.replace(path)
        except OSError as error:
            self.complaints.complain(str(path), "disk", f"cannot be written ({error.strerror}); free some space")

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
        arm = np.array(engine.beginning.config.imu.lever_arm_m)
        try:
            self.track.add(trajectory_of(navigator.passed, engine.recursion.error, arm))
        except InputError as error:
            path = str(self.track.path)
            self.complaints.complain(path, "disk", str(error).removeprefix(f"{path}: "))
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


def _as_recorded(config: Config) -> dict[str, Any]:
    """What of a configuration has been applied to a recording already."""
    return {"columns": {}, "units": {}, "online": config.online.model_copy(update={"delay_s": {}})}


@dataclass
class Session:
    """Runs until the sources end or are closed.

    Attributes
    ----------
    navigator : the estimate
    outputs : where solutions go
    rate_hz : of solutions
    files : None = nothing is kept
    complaints : what sources, outputs and disk complain of
    solution : the newest
    solutions : count
    took : times of the filter's updates [s]
    """

    navigator: Navigator
    outputs: Sequence[Receiver]
    complaints: Complaints
    rate_hz: float = 10.0
    files: Files | None = None
    solution: Solution | None = None
    solutions: int = 0
    _due: float = -math.inf
    _watchers: list[Callable[[Solution], None]] = field(default_factory=list)
    took: "array[float]" = field(default_factory=lambda: array("f"))
    _resumed: float = -math.inf
    _wanted: bool = False

    def watch(self, show: Callable[[Solution], None]) -> None:
        """Have every solution shown."""
        self._watchers.append(show)

    def want_smoothed(self) -> None:
        """Ask for the smoothed track so far; from a signal's handler."""
        self._wanted = True

    def write_smoothed(self) -> None:
        """The whole smoothed track so far to disk, where iSAM2 has it."""
        isam2 = self.navigator.isam2
        if self.files is not None and isam2 is not None and isam2.updated > 0:
            self.files.write_smoothed(isam2.solve())

    def updates(self) -> dict[str, float]:
        """Times that updates of the filter took [ms]."""
        took = 1e3 * np.array(self.took or [0.0])
        return {
            "count": len(self.took),
            "mean_ms": float(took.mean()),
            "p99_ms": float(np.percentile(took, 99)),
            "max_ms": float(took.max()),
        }

    def resume(self) -> None:
        """Go on from the last checkpoint and what was recorded after it."""
        assert self.files is not None
        state = self.files.state
        if self.files.anew:
            if state is not None:
                self.navigator.clocks.restore(state["clocks"])
            recorded = self.files.all_recorded()
        else:
            if state is not None:
                self.navigator.restore(state)
            recorded = self.files.recorded(self.navigator.origin)
        if recorded is not None:
            self.navigator.replay(recorded)
        self._resumed = self.navigator.time
        self.navigator.say("start", "resumed", f"goes on from what was received up to {self._resumed:.1f} s")

    def run(self, feed: Iterable[Message | None]) -> None:
        """Work off what the sources say."""
        navigator, files = self.navigator, self.files
        gc.freeze()  # or the collector looks through libraries and recordings now and then, for a tenth of a second
        gc.set_threshold(*COLLECT)
        for message in feed:
            if message is None:
                self._wait()
            elif not self._known(message):
                self._take(message)
            if navigator.engine is not None and navigator.time >= self._due:
                self._send()
            if files is not None:
                files.keep(navigator)
            if self._wanted:
                self._wanted = False
                self.write_smoothed()
        if files is not None:
            files.keep(navigator, now=True)
        navigator.finish()
        self._send()
        if files is not None:
            files.finish(navigator)
            self.write_smoothed()

    def _known(self, message: Message) -> bool:
        """Whether a recording that is read again says what had been received before a crash."""
        return self.navigator.clocks.trust and message.stamp is not None and message.stamp <= self._resumed

    def _take(self, message: Message) -> None:
        before = self.navigator.updates
        rows = self.navigator.take(message)
        if self.navigator.updates > before:
            self.took.append(self.navigator.update_s)
        if not rows:
            self.complaints.complain(message.source, "stamp", "a stamp seconds off from those before, left out")
        if self.files is not None:
            for time, readings in rows:
                self.files.recorder.write(time, message.arrival, readings)

    def _wait(self) -> None:
        """Time goes on where nothing comes."""
        now = self.navigator.clocks.now(host.time())
        if now is not None and now - self.navigator.time > QUIET_S:
            self.navigator.tick(now)
        if self.navigator.waits_for:
            self.complaints.complain("start", "waiting", self.navigator.waits_for)

    def _send(self) -> None:
        solution = self.navigator.solution()
        if solution is None:
            return
        self._due = (math.floor(self.navigator.time * self.rate_hz + 1e-6) + 1) / self.rate_hz
        self.solution, self.solutions = solution, self.solutions + 1
        if self.files is not None:
            self.files.note(solution.events)
        for output in self.outputs:
            output.send(solution)
        for show in self._watchers:
            show(solution)
