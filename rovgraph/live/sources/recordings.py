"""Links to files: as they are, and telemetry logs (.tlog), where a time stands before each message."""

import gzip
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path

from rovgraph.errors import InputError
from rovgraph.live.sources.mavlink_frames import MARKERS, frame_length
from rovgraph.live.sources.source import Chunk

BLOCK = 1 << 16  # bytes read at a time
TIME = 8  # bytes of a time in a telemetry log: microseconds since 1970, big-endian
EARLIEST, LATEST = 946_684_800.0, 4_102_444_800.0  # 2000 and 2100, seconds since 1970
JUMP_S = 60.0  # a message's time alone may not be further off than this


def read_file(path: Path) -> bytes:
    """A file, unpacked where it is gzipped.

    Raises
    ------
    InputError : it cannot be read
    """
    try:
        content = path.read_bytes()
        return gzip.decompress(content) if content.startswith(b"\x1f\x8b") else content
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None


class FileLink:
    """A file from its beginning to its end; it arrives when it was last written."""

    def __init__(self, path: Path) -> None:
        self._content = read_file(path)
        self._arrival = path.stat().st_mtime

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        for start in range(0, len(self._content), BLOCK):
            if stop.is_set():
                return
            yield Chunk(self._content[start : start + BLOCK], self._arrival)
        yield Chunk(b"\n", self._arrival)  # the last line may lack its end


class TelemetryLog:
    """The messages of a telemetry log, one by one, each arriving when it was received."""

    def __init__(self, path: Path) -> None:
        self._content = read_file(path)

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        for chunk in timed_frames(self._content):
            if stop.is_set():
                return
            yield chunk


def timed_frames(content: bytes) -> Iterator[Chunk]:
    """Frames of a telemetry log; what stands between them and is none comes as a chunk too."""
    start = lost = 0
    arrival = 0.0
    while start + TIME < len(content):
        if not _begins(content, start):
            start += 1
            continue
        end = start + TIME + (frame_length(content, start + TIME) or len(content))
        if end < len(content) and not _begins(content, end) and _begins_within(content, start + 1, end):
            start += 1  # a time and a marker by chance, or a frame that lost bytes
            continue
        time = _arrival(content, start, end, arrival)
        if lost < start:
            yield Chunk(content[lost:start], arrival or time, fresh=True)
        arrival = time
        yield Chunk(content[start + TIME : end], arrival, fresh=True)
        start = lost = end
    if lost < len(content):
        yield Chunk(content[lost:], arrival, fresh=True)


def _arrival(content: bytes, start: int, end: int, before: float) -> float:
    """The time of a frame [s]; that of the one before it where neither that nor the next is near."""
    time = _time(content, start)
    near = [before] + ([_time(content, end)] if _begins(content, end) else [])
    return time if not before or min(abs(time - other) for other in near) < JUMP_S else before


def _time(content: bytes, start: int) -> float:
    return 1e-6 * int.from_bytes(content[start : start + TIME], "big")


def _begins(content: bytes, start: int) -> bool:
    """Whether a time and the beginning of a frame may stand here."""
    marker = content[start + TIME : start + TIME + 1]
    return marker in MARKERS and EARLIEST < _time(content, start) < LATEST


def _begins_within(content: bytes, start: int, end: int) -> bool:
    return any(_begins(content, at) for at in range(start, end))
