"""Files of a run of the online mode: recording, checkpoint and track, so that a crash loses no more than a second.

`Recorder` writes all received data as a log that ``rovgraph smooth`` reads. Rows are in the order of arrival, which the
last column, ``received``, holds. Cells hold the shortest decimals that give the same number again, so that a replay
gets the same values as the live run. `Recorder.write` only formats and queues. One thread hands rows to the operating
system, so that a crash of the program loses no more than `FLUSH_S`; another has them put on the disk, which may take
seconds on a memory card.

`Keeper` writes a checkpoint, the state of the running estimate, once a second without delaying the estimate;
``--resume`` continues from it. Its file is one line of text, ``rovgraph checkpoint VERSION DIGEST``, and a body to
which the digest (SHA-256) belongs: the length of a JSON text in 8 bytes, little-endian; that text, in which an array
stands as ``{"$array": [dtype, shape, offset]}``; the arrays' bytes. Reading it cannot run code.

`TrackFile` appends the filtered trajectory as it grows.
"""

import contextlib
import fcntl
import hashlib
import io
import json
import os
import struct
import threading
import time as host
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph import compatibility
from rovgraph.dates import is_unix
from rovgraph.errors import InputError
from rovgraph.inference.error_state import REINITIALISE_AT_S
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.fixed_lag import FixedLag
from rovgraph.inference.trajectory import Trajectory
from rovgraph.live.intake import origin_of
from rovgraph.live.message import ON_EARTH, Reading
from rovgraph.live.navigator import Navigator
from rovgraph.live.solution import Event
from rovgraph.live.warnings import Warnings
from rovgraph.log import Log, read_log
from rovgraph.log.streams import RECEIVED, STREAMS, VERSION_COLUMN, all_columns
from rovgraph.model.config import AS_WRITTEN, Config
from rovgraph.model.config_sections import Fix
from rovgraph.model.origin import Origin, north_east

VERSION = 10
NAME = b"rovgraph checkpoint"
ARRAY = "$array"
NUMBERS = "biufc"  # kinds of dtypes: boolean, integer, unsigned, float, complex

_LENGTH = struct.Struct("<Q")


def write_checkpoint(path: Path | str, state: Mapping[str, Any]) -> None:
    """Write a checkpoint that appears whole or not at all; it waits for the disk.

    Parameters
    ----------
    path : an older one is replaced
    state : None, truth values, numbers, texts, NumPy arrays of numbers, and lists and dicts (with
        texts as keys) of these; a tuple comes back as a list

    Raises
    ------
    InputError : the file cannot be written; the older one stands
    TypeError : something else is in the state
    """
    path = Path(path)
    content = _encoded(state)
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            partial.unlink()
        raise InputError(
            f"{path}: checkpoint cannot be written ({error.strerror}); free some space or choose another place"
        ) from None


def read_checkpoint(path: Path | str) -> dict[str, Any]:
    """Read a checkpoint; arrays are the caller's own.

    Raises
    ------
    InputError : no checkpoint, of another version, or damaged
    """
    try:
        content = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{path}: checkpoint cannot be read ({error.strerror}); check the name") from None
    head, _, body = content.partition(b"\n")
    if not head.startswith(NAME):
        raise InputError(f"{path}: is not a checkpoint of rovgraph; give another file")
    version, _, digest = head.removeprefix(NAME + b" ").partition(b" ")
    if version.isdigit() and int(version) != VERSION:
        raise InputError(
            f"{path}: checkpoint of version {int(version)}, expected {VERSION}; "
            "continue with the version that wrote it, or delete it to start again"
        )
    if not version.isdigit() or digest != _digest(body):
        raise InputError(f"{path}: checkpoint is damaged, its checksum differs; delete it to start again")
    return _decoded(body)


def _encoded(state: Mapping[str, Any]) -> bytes:
    arrays = bytearray()
    text = json.dumps(_packed(state, arrays, "state")).encode()
    body = b"".join([_LENGTH.pack(len(text)), text, arrays])
    return b"%s %d %s\n%s" % (NAME, VERSION, _digest(body), body)


def _decoded(body: bytes) -> dict[str, Any]:
    (length,) = _LENGTH.unpack_from(body)
    start = _LENGTH.size + length
    state: dict[str, Any] = json.loads(
        body[_LENGTH.size : start], object_hook=lambda found: _unpacked(found, body, start)
    )
    return state


def _packed(value: Any, arrays: bytearray, where: str) -> Any:
    """A value as JSON has it; bytes of arrays are appended to ``arrays``."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return _packed(value.item(), arrays, where)
    if isinstance(value, np.ndarray) and value.dtype.kind in NUMBERS:
        offset = len(arrays)
        arrays += value.tobytes()
        return {ARRAY: [value.dtype.str, value.shape, offset]}
    if isinstance(value, Mapping) and ARRAY not in value and all(isinstance(key, str) for key in value):
        return {key: _packed(item, arrays, f"{where}[{key!r}]") for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_packed(item, arrays, f"{where}[{i}]") for i, item in enumerate(value)]
    raise TypeError(f"{where} cannot be put into a checkpoint: {type(value).__name__}")


def _unpacked(found: dict[str, Any], body: bytes, start: int) -> dict[str, Any] | NDArray[Any]:
    """An object of the JSON text, or the array that it stands for."""
    if ARRAY not in found:
        return found
    dtype, shape, offset = found[ARRAY]
    count = int(np.prod(shape, dtype=np.int64))
    return np.frombuffer(body, dtype, count, start + offset).reshape(shape).copy() if count else np.empty(shape, dtype)


def _digest(body: bytes) -> bytes:
    return hashlib.sha256(body).hexdigest().encode()


def _sync_folder(folder: Path) -> None:
    """Let the new name reach the disk too, where folders can be synced."""
    if os.name == "posix":
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


class Keeper:
    """Writes the newest state that it was given, in a thread of its own.

    Parameters
    ----------
    path : of the checkpoint
    warnings : receives, from that thread, that it cannot be written; it keeps trying
    """

    def __init__(self, path: Path, warnings: Warnings) -> None:
        self._path, self._complain = path, warnings.complain
        self._state: Mapping[str, Any] | None = None
        self._given, self._stop = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._work, name="checkpoints", daemon=True)
        self._thread.start()

    def keep(self, state: Mapping[str, Any]) -> None:
        """Have a state written, instead of an older one that has not been yet."""
        self._state = state
        self._given.set()

    def close(self) -> None:
        """Write what was given last, and end."""
        self._stop.set()
        self._given.set()
        self._thread.join(5.0)

    def _work(self) -> None:
        while not self._stop.is_set():
            self._given.wait()
            self._given.clear()
            self._write()
        self._write()

    def _write(self) -> None:
        state, self._state = self._state, None
        if state is not None:
            try:
                write_checkpoint(self._path, state)
            except InputError as error:
                self._complain(str(self._path), "disk", str(error).removeprefix(f"{self._path}: "))


FLUSH_S = 0.1  # from a row to the operating system
SYNC_S = 1.0  # from there to the disk
CLOSE_S = 3.0  # longest wait for a disk that does not answer
BACKLOG = 200_000  # rows kept while the disk is full; then the oldest are lost
BLOCK = 1 << 16  # read at a time, from the end
THRUSTERS = tuple(f"thruster_{i}" for i in range(1, 9))


def recorded_columns() -> tuple[str, ...]:
    """Columns of a recording."""
    return (*all_columns(), *THRUSTERS, VERSION_COLUMN, RECEIVED)


class Recorder:
    """Append-only recording.

    Parameters
    ----------
    path : a new file, or a recording to continue; its last line is dropped where it was cut off
    warnings : receives later errors, from other threads too

    Attributes
    ----------
    lost : rows given up because the disk stayed full

    Raises
    ------
    InputError : the file cannot be written, or is no recording
    """

    def __init__(self, path: Path | str, warnings: Warnings | None = None) -> None:
        self.path = Path(path)
        self.lost = 0
        self._complain = (warnings or Warnings()).complain
        self._rows: deque[str] = deque(maxlen=BACKLOG)
        self._pending = b""  # rows that were taken from the queue, but for what the system took
        self._unsynced = False
        self._stop = threading.Event()
        names = recorded_columns()
        columns = {**STREAMS, **ON_EARTH, "thruster": THRUSTERS}
        self._places = {sensor: tuple(map(names.index, of_sensor)) for sensor, of_sensor in columns.items()}
        self._width = len(names)
        self._file = _opened(self.path, (",".join(names) + "\n").encode())
        self._threads = [
            threading.Thread(target=self._every, args=(period, work), name=f"recorder: {work.__name__}", daemon=True)
            for period, work in ((FLUSH_S, self._hand_over), (SYNC_S, self._sync))
        ]
        for thread in self._threads:
            thread.start()

    def write(self, time: float, arrival: float, readings: Sequence[Reading]) -> None:
        """Record what was received at one time; neither waits nor raises.

        Parameters
        ----------
        time : of the measurement, by the estimator's clock [s]
        arrival : by the host's clock, seconds since 1970
        readings : one per sensor, in SI
        """
        cells = [""] * self._width
        cells[0], cells[-2:] = repr(float(time)), (str(compatibility.LOG), f"{arrival:.6f}")
        for sensor, values in readings:
            places = self._places[sensor]
            if len(values) > len(places):
                self._complain(str(self.path), "left out", f"{sensor}: {len(places)} of {len(values)} values recorded")
            for place, value in zip(places, values.tolist(), strict=False):
                if value == value:  # not NaN
                    cells[place] = repr(value)
        self.lost += len(self._rows) == BACKLOG
        self._rows.append(",".join(cells))

    def close(self) -> None:
        """Put what is queued on the disk; gives up after `CLOSE_S`."""
        self._stop.set()
        last = threading.Thread(target=self._finish, name="recorder: close", daemon=True)
        last.start()
        last.join(CLOSE_S)
        if last.is_alive():
            self._complain(str(self.path), "lost", f"the disk did not answer for {CLOSE_S:g} s, the end may be missing")

    def _every(self, period: float, work: Callable[[], None]) -> None:
        while not self._stop.wait(period):
            work()

    def _finish(self) -> None:
        for thread in self._threads:
            thread.join()
        self._hand_over()
        self._sync()
        left = len(self._rows) + self._pending.count(b"\n")
        if left:
            self.lost += left
            self._complain(str(self.path), "lost", f"{left} rows could not be written")
        os.close(self._file)

    def _hand_over(self) -> None:
        """Queued rows to the operating system; what it does not take is tried again the next time."""
        with self._complaining():
            while self._pending or self._rows:
                if not self._pending:
                    rows = [self._rows.popleft() for _ in range(len(self._rows))]
                    self._pending = ("\n".join(rows) + "\n").encode()
                self._pending = self._pending[os.write(self._file, self._pending) :]
                self._unsynced = True

    def _sync(self) -> None:
        if self._unsynced:
            self._unsynced = False
            with self._complaining():
                os.fsync(self._file)

    @contextlib.contextmanager
    def _complaining(self) -> Iterator[None]:
        """Errors of the file system become warnings."""
        try:
            yield
        except OSError as error:
            reason = error.strerror or error
            self._complain(str(self.path), "disk", f"cannot be written ({reason}), still trying; free some space")


def _opened(path: Path, first_line: bytes) -> int:
    """Descriptor of a recording, at the end of its last whole line.

    Raises
    ------
    InputError : the file cannot be written, is no recording, or another run has it
    """
    file = None
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)  # until it is closed, or its program ends
        _continue(path, file, first_line)
    except (OSError, InputError) as error:
        if file is not None:
            os.close(file)
        if isinstance(error, InputError):
            raise
        if isinstance(error, BlockingIOError):
            raise InputError(f"{path}: another run is recording there; end it, or choose another folder") from None
        raise InputError(f"{path}: cannot be written ({error.strerror}); choose another file to record to") from None
    return file


def _continue(path: Path, file: int, first_line: bytes) -> None:
    """Check the header, or write it, and cut off a last line that is torn or blank after a power cut."""
    found = os.read(file, len(first_line))
    if not first_line.startswith(found):
        raise InputError(f"{path}: is not a recording that can be continued, line 1 differs; choose another file")
    if found != first_line:
        os.ftruncate(file, 0)
        os.write(file, first_line)
        return
    end = os.fstat(file).st_size
    os.ftruncate(file, end - _torn(file, end))


def _torn(file: int, end: int) -> int:
    """Bytes behind the last line's end."""
    length = 0
    while True:
        start = max(end - length - BLOCK, 0)
        os.lseek(file, start, os.SEEK_SET)
        block = os.read(file, end - length - start)
        if b"\n" in block:
            return length + len(block) - block.rindex(b"\n") - 1
        length += len(block)


class TrackFile:
    """A trajectory CSV that rows are added to.

    Parameters
    ----------
    path : new, or to continue
    until : keep rows of an older file up to this time [s]; the rest comes again
    grid : of `Trajectory.write_csv`

    Raises
    ------
    InputError : the file cannot be written, or was begun in a grid and there is none
    """

    def __init__(self, path: Path, until: float = -np.inf, grid: str | None = None) -> None:
        self.path = path
        kept: list[str] = []
        with _one_line(path):
            if path.exists() and np.isfinite(until):
                lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
                kept = [x for x in lines[1:] if x.endswith("\n") and float(x.split(",", 1)[0]) < until - 5e-5]
                kept = lines[:1] + kept if kept else []
            partial = path.with_name(f".{path.name}.partial")
            partial.write_text("".join(kept), encoding="utf-8")
            partial.replace(path)
        self._begun = bool(kept)
        columns = kept[0].rstrip().split(",") if kept else []
        self._on_earth, self._unix = "lat" in columns, "unix_time" in columns
        self._grid = grid if not kept or "easting" in columns else None
        if "easting" in columns and grid is None:
            raise InputError(f"{path}: was begun in a map grid; state the same environment.grid to go on with it")

    def add(self, trajectory: Trajectory, origin: Origin | None = None) -> None:
        """Add epochs, later than those before: all of them, or where the disk is full none.

        Parameters
        ----------
        trajectory : the epochs
        origin : of `Trajectory.write_csv`; a file that was begun without one goes on without it and the grid
        """
        if not self._begun:
            self._on_earth, self._unix = origin is not None, is_unix(trajectory.time)
        with _one_line(self.path):
            size = self.path.stat().st_size
            try:
                where = origin if self._on_earth else None
                trajectory.write_csv(self.path, self._begun, where, self._unix, grid=self._grid)
            except OSError:
                os.truncate(self.path, size)
                raise
        self._begun = True


@contextlib.contextmanager
def _one_line(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror}); free some space or choose another --out"
        ) from None


RECORDING, TRACK, CHECKPOINT = "received.csv", "trajectory_filtered.csv", "checkpoint"
CONFIG, SETTINGS, EVENTS = "config.yaml", "config_online.yaml", "events.jsonl"  # of the recording; of the run
SMOOTHED = "trajectory_smoothed.csv"
KEEP_S = 0.5  # of the host's time between checkpoints
UNWRITTEN = 10_000  # keyframes that wait for a disk that is full; then the oldest are lost
# a recording that is shorter is replayed from its start, since the filter is still to be re-initialised
REPLAYED_S = REINITIALISE_AT_S[-1]
LAST_BYTES = 1 << 22  # of a recording, that a resumed run reads again: minutes


@dataclass
class Files:
    """Files of a run, so that a crash loses no more than a second.

    Parameters
    ----------
    folder : an existing one
    config : as the user gave it
    warnings : where trouble with the disk goes
    resume : continue with what is there
    replayed : from the recording alone, not from the checkpoint

    Attributes
    ----------
    state : the checkpoint that is resumed; None without one
    received : what had been received after it; None where there is nothing
    told : time of the newest event that stands in its file [s]; -inf without one

    Raises
    ------
    InputError : the folder cannot be written, or holds nothing to continue, or a recording that cannot be read
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
        self.told = _newest_event(self.folder / EVENTS) if self.resume else -np.inf
        self.track = TrackFile(self.folder / TRACK, until, self.config.environment.grid)
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
            env = self.config.environment
            env = env.model_copy(update={"frame": self.config.frame_at(env.latitude or 0.0)})  # as `Intake` has it
            # recorded under rovgraph's own names, in SI
            own = Fix(beacon=self.config.positioned_beacon)
            return replace(read_log(path, Config(environment=env, fix=own), as_received=True), config=None)
        return Log.from_frame(_last_rows(path, origin_of(self.state)), source=str(path), as_received=True)

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

    def write_smoothed(self, estimate: Estimate, origin: Origin | None = None) -> None:
        """Put a smoothed track on disk, in place of an older one; ``origin`` of `Trajectory.write_csv`."""
        path, partial = self.folder / SMOOTHED, self.folder / f".{SMOOTHED}.partial"
        try:
            estimate.trajectory.write_csv(partial, origin=origin, grid=self.config.environment.grid)
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
        """Put the end of the track on disk; a run can still be resumed from the checkpoint."""
        if navigator.engine is not None:
            self._add(navigator, navigator.engine)

    def close(self) -> None:
        self.keeper.close()
        self.recorder.close()


def _newest_event(path: Path) -> float:
    """Time of the newest event of a file, -inf without one [s]; a last line that is torn is cut off.

    Raises
    ------
    InputError : the file cannot be read or written
    """
    with _one_line(path):
        if not path.exists():
            return -np.inf
        content = path.read_bytes()
        whole = content[: content.rfind(b"\n") + 1]
        if whole != content:
            os.truncate(path, len(whole))
    times = []
    for line in whole.splitlines():
        with contextlib.suppress(ValueError, TypeError, KeyError):  # blank after a power cut; before there was a time
            times.append(float(json.loads(line)["time"]))
    return max(times, default=-np.inf)


def _last_rows(path: Path, origin: Origin | None) -> pd.DataFrame:
    """The newest rows of a recording; fixes relative to an origin."""
    with path.open("rb") as file:
        header = file.readline()
        file.seek(max(len(header), path.stat().st_size - LAST_BYTES))
        rows = file.read()
    if len(header) + len(rows) < path.stat().st_size:
        rows = rows[rows.index(b"\n") + 1 :]
    frame = pd.read_csv(io.BytesIO(header + rows[: rows.rfind(b"\n") + 1]))
    for of in ("fix", "ship"):
        if origin is not None and f"{of}_lat" in frame and frame[f"{of}_lat"].notna().any():
            lat, lon = (frame.pop(f"{of}_{name}").to_numpy(float) for name in ("lat", "lon"))
            frame[f"{of}_north"], frame[f"{of}_east"] = north_east(lat, lon, origin)
    return frame
