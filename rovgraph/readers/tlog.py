"""MAVLink telemetry logs (``.tlog``), which a ground station records."""

import mmap
from pathlib import Path
from typing import Any

from rovgraph.log.disk_columns import release
from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.mavlink import TIME, V1, WANTED, Gatherer, begins, dialect, frame_length, frames_with_times
from rovgraph.readers.mavlink_recording import recording
from rovgraph.readers.recording import Recording

RECEIVER = "ground station"
RELEASED = 1 << 24  # bytes of the file that are in memory
FRAMES = 3  # in a row that make a telemetry log


class TelemetryLog:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "tlog"
    title = "MAVLink telemetry log (.tlog)"
    extra = "online"

    def recognise(self, path: Path, head: bytes) -> float:
        at = 0
        for _ in range(FRAMES):
            if not begins(head, at):
                return 0.0
            at += TIME + (frame_length(head, at + TIME) or len(head))
        return 0.95

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        mavlink = dialect()
        parser = mavlink.MAVLink(None)
        gatherer = Gatherer()
        done = released = 0
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            for data, received in frames_with_times(content):
                done += TIME + len(data)
                if done > released + RELEASED:
                    release(content)
                    released = done
                options.progress(min(done, len(content)), len(content))
                _take(gatherer, mavlink, parser, data, received)
        return recording(path, self.name, gatherer, RECEIVER, options)


def _take(gatherer: Gatherer, mavlink: Any, parser: Any, data: bytes, received: float) -> None:
    """Count a frame, and take it if it has sensor data; only then is its checksum tested."""
    if len(data) < 8 or frame_length(data, 0) != len(data):
        gatherer.unreadable["bytes that are no message"] += 1
        return
    old = data[0] == V1
    sender = (data[3], data[4]) if old else (data[5], data[6])
    number = data[5] if old else int.from_bytes(data[7:10], "little")
    known = mavlink.mavlink_map.get(number)
    name = f"message {number}" if known is None else known.msgname
    if name in WANTED:
        try:
            message = parser.decode(bytearray(data))
        except Exception:  # whatever a library of others meets in bytes of others
            gatherer.unreadable["a wrong checksum, or a damaged message"] += 1
            return
        gatherer.take(sender, name, message, received)
    gatherer.counts[sender, name] += 1


FORMAT = TelemetryLog()
