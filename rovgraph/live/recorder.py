"""Everything that was received, as a log that ``rovgraph smooth`` reads.

Rows stand in the order of arrival; the last column, ``received``, tells that to whoever reads
the log. Cells hold the shortest decimals that give the same number again, so that a replay
sees what was seen live.

`Recorder.write` only formats and queues. One thread hands rows to the operating system, so
that a crash of the program loses no more than `FLUSH_S`; another asks for them to be put on
the disk, which may take seconds on a memory card.
"""

import contextlib
import os
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rovgraph import compatibility
from rovgraph.errors import InputError
from rovgraph.live.message import GEODETIC, Reading
from rovgraph.live.warnings import Warnings
from rovgraph.log.streams import LAT_LON, RECEIVED, STREAMS, VERSION, all_columns

FLUSH_S = 0.1  # from a row to the operating system
SYNC_S = 1.0  # from there to the disk
CLOSE_S = 3.0  # longest wait for a disk that does not answer
BACKLOG = 200_000  # rows kept while the disk is full; then the oldest are lost
BLOCK = 1 << 16  # read at a time, from the end
THRUSTERS = tuple(f"thruster_{i}" for i in range(1, 9))


def recorded_columns() -> tuple[str, ...]:
    """Columns of a recording."""
    return (*all_columns(), *THRUSTERS, VERSION, RECEIVED)


class Recorder:
    """Append-only recording.

    Parameters
    ----------
    path : a new file, or a recording to go on with; its last line is dropped where it was cut off
    warnings : told, from other threads too, of what goes wrong later

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
        columns = {**STREAMS, GEODETIC: (*LAT_LON, "fix_sd"), "thruster": THRUSTERS}
        self._places = {sensor: tuple(map(names.index, own)) for sensor, own in columns.items()}
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
    InputError : the file cannot be written, or is no recording
    """
    file = None
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o644)
        _continue(path, file, first_line)
    except (OSError, InputError) as error:
        if file is not None:
            os.close(file)
        if isinstance(error, InputError):
            raise
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
