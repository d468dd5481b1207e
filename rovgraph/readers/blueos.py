"""MCAP recordings of BlueOS: MAVLink messages as JSON, as mavlink2rest writes them, and other topics of a companion.

A message stands on the topic ``mavlink/<system>/<component>/<NAME>`` and, in some versions, a second time on
``mavlink/out``. Names of enumerations stand for their numbers, and extensions of MAVLink 2 may be missing. Sources:
https://github.com/bluerobotics/blueos-recorder, https://github.com/mavlink/mavlink2rest, https://mcap.dev/spec.
"""

import json
import math
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from rovgraph.readers.formats import ReadingOptions
from rovgraph.readers.mavlink import DOWN, WANTED, Gatherer, Sender
from rovgraph.readers.mavlink_recording import recording
from rovgraph.readers.recording import Left, Recording

RECEIVER = "companion computer"
MAGIC = b"\x89MCAP0\r\n"
ALL = "mavlink/out"  # topic of all messages
ENOUGH = 100  # messages with topics of their own that show that the topic of all adds nothing
CHUNK = 6  # kind of record
FIX_TYPES = ("NO_GPS", "NO_FIX", "2D_FIX", "3D_FIX", "DGPS", "RTK_FLOAT", "RTK_FIXED", "STATIC", "PPP")
NUMBERS = {f"GPS_FIX_TYPE_{name}": number for number, name in enumerate(FIX_TYPES)} | {
    "MAV_SENSOR_ROTATION_PITCH_270": DOWN
}


class BlueOS:
    """The format; see `rovgraph.readers.formats.Format`."""

    name = "blueos"
    title = "BlueOS recording (.mcap)"
    extra = "blueos"

    def recognise(self, path: Path, head: bytes) -> float:
        if not head.startswith(MAGIC):
            return 0.0
        return 0.95 if b"mavlink/" in head or b"mavlink/" in _first_chunk(head) else 0.1

    def read(self, path: Path, options: ReadingOptions) -> Recording:
        each, together = Gatherer(), Gatherer()  # by topics of their own, and by that of all
        lost: Counter[str] = Counter()
        others: Counter[str] = Counter()
        for topic, data, received in _messages(path, lost, options.progress):
            if topic == ALL:
                if sum(each.counts.values()) < ENOUGH:
                    _take(together, data, received)
            elif not topic.startswith("mavlink/"):
                others[topic] += 1
            elif len(parts := topic.split("/")) == 4:  # below are single fields
                if parts[3] in WANTED:
                    _take(each, data, received)
                else:
                    each.counts[_sender(parts), parts[3]] += 1
        best = max(each, together, key=lambda gatherer: sum(gatherer.counts.values()))
        best.unreadable.update(lost)
        made = recording(path, self.name, best, RECEIVER, options)
        left = tuple(Left(topic, count, "a topic without MAVLink") for topic, count in sorted(others.items()))
        return replace(made, left=made.left + left)


FORMAT = BlueOS()


def _messages(
    path: Path, lost: Counter[str], progress: Callable[[int, int], None]
) -> Iterator[tuple[str, bytes, float]]:
    """Topic, content and time of arrival [s] of every message, as far as the file is whole."""
    from mcap.records import Channel, Chunk, Message
    from mcap.stream_reader import StreamReader, breakup_chunk

    topics: dict[int, str] = {}
    size = path.stat().st_size
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, emit_chunks=True, record_size_limit=size).records:
                progress(file.tell(), size)
                parts = [record]
                if isinstance(record, Chunk):
                    try:
                        parts = breakup_chunk(record, validate_crc=True)
                    except Exception:  # whatever libraries of others meet in bytes of others
                        lost["a damaged chunk of messages"] += 1
                        continue
                for part in parts:
                    if isinstance(part, Channel):
                        topics[part.id] = part.topic
                    elif isinstance(part, Message) and part.channel_id in topics:
                        yield topics[part.channel_id], part.data, 1e-9 * part.log_time
        except Exception:  # as above
            lost["the file is cut off or damaged, and read to there"] += 1


def _sender(parts: list[str]) -> Sender:
    """System and component of a topic."""
    system, component = (int(part) if part.isdecimal() else 0 for part in parts[1:3])
    return system, component


def _take(gatherer: Gatherer, data: bytes, received: float) -> None:
    """Count a message, and take it if it has sensor data."""
    try:
        envelope = json.loads(data)
        header, fields = envelope["header"], envelope["message"]
        sender, name = (int(header["system_id"]), int(header["component_id"])), str(fields["type"])
        gatherer.counts[sender, name] += 1
        if name in WANTED:
            gatherer.take(sender, name, SimpleNamespace(**{k: _value(v) for k, v in fields.items()}), received)
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError):
        gatherer.unreadable["no message in JSON as mavlink2rest writes it"] += 1


def _value(value: Any) -> Any:
    """A field as pymavlink has it: numbers for names of enumerations, a text for a list of characters."""
    if value is None:
        return math.nan  # JSON has no other
    if isinstance(value, dict):
        return value["bits"] if "bits" in value else NUMBERS.get(value.get("type", ""), -1)
    if isinstance(value, list) and value and isinstance(value[0], str):
        return "".join(value).partition("\0")[0]
    return [_value(v) for v in value] if isinstance(value, list) else value


def _first_chunk(head: bytes) -> bytes:
    """The beginning of the first chunk of messages, without its compression."""
    at = len(MAGIC)
    while at + 9 <= len(head):
        kind, length = struct.unpack_from("<BQ", head, at)
        if kind == CHUNK and at + 41 <= len(head):
            named = struct.unpack_from("<I", head, at + 37)[0]
            start = at + 41 + named
            return _inflated(head[at + 41 : start], head[start + 8 :])
        at += 9 + length
    return b""


def _inflated(compression: bytes, data: bytes) -> bytes:
    """As much as can be had of data that are cut off."""
    try:
        if compression == b"zstd":
            import zstandard

            return bytes(zstandard.ZstdDecompressor().decompressobj().decompress(data))
        if compression == b"lz4":
            import lz4.frame

            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data))
    except Exception:  # not installed, or damaged: `read` reports which
        return b""
    return data
