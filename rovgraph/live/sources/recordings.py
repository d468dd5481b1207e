"""Links to files: as they are, and telemetry logs (.tlog), where a time stands before each message."""

import gzip
import threading
import zlib
from collections.abc import Iterator
from pathlib import Path

from rovgraph.errors import InputError
from rovgraph.interchange.mavlink_frames import frames_with_times
from rovgraph.live.sources.source import Chunk

BLOCK = 1 << 16  # bytes read at a time


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
    return (Chunk(data, time, fresh=True) for data, time in frames_with_times(content))
