"""MAVLink frames, in a stream of bytes and in telemetry logs.

A frame begins with a marker and its length; behind a byte that only looks like a marker, the
search goes on with the next byte, so that noise costs no good frame. In a telemetry log (``.tlog``) a time stands
before each frame.
"""

import mmap
from collections.abc import Callable, Iterator
from typing import Any

from rovgraph.errors import InputError

Content = bytes | mmap.mmap
V1, V2 = 0xFE, 0xFD
MARKERS = (bytes([V1]), bytes([V2]))
SIGNED = 0x01
SIGNATURE = 13  # bytes
TIME = 8  # bytes of a time in a telemetry log: microseconds since 1970, big-endian
EARLIEST, LATEST = 946_684_800.0, 4_102_444_800.0  # 2000 and 2100, seconds since 1970
JUMP_S = 60.0  # a message's time alone may not be further off than this


def dialect() -> Any:
    """ArduPilot's messages.

    Raises
    ------
    InputError : pymavlink is not installed
    """
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError:
        raise InputError("mavlink: needs pymavlink; install it with: pip install 'rovgraph[online]'") from None
    return ardupilotmega


def frame_length(data: Content | bytearray, start: int) -> int | None:
    """Bytes of the frame that begins with the marker at ``start``; None where too few are there to tell."""
    if len(data) < start + 3:
        return None
    payload, flags = data[start + 1], data[start + 2]
    if data[start] == V1:
        return payload + 8
    return payload + 12 + (SIGNATURE if flags & SIGNED else 0)


class Frames:
    """Cuts messages out of bytes.

    Parameters
    ----------
    mavlink : pymavlink's dialect
    notify : takes warnings; "bad data" once per stretch of bytes that is no message
    """

    def __init__(self, mavlink: Any, notify: Callable[[str, str], None]) -> None:
        self._parser = mavlink.MAVLink(None)
        self._notify = notify
        self._rest = bytearray()
        self._sane = True  # whether a message has just ended

    def restart(self) -> None:
        """Forget a frame that has only begun."""
        if self._rest:
            self._bad()
        self._rest.clear()
        self._sane = True

    def messages(self, data: bytes) -> Iterator[Any]:
        """Messages that are complete now."""
        self._rest += data
        start = 0
        while start < len(self._rest):
            if self._rest[start] not in (V1, V2):
                self._bad()
                start = self._next_marker(start)
                continue
            length = frame_length(self._rest, start)
            if length is None or start + length > len(self._rest):
                break
            message = self._decoded(start, start + length)
            if message is None:
                self._bad()
                start += 1
                continue
            self._sane = True
            start += length
            yield message
        del self._rest[:start]

    def _decoded(self, start: int, end: int) -> Any:
        """The message between two places, or None.

        One of a kind unknown to the dialect has no checksum that could be checked; it is believed between
        two that are known.
        """
        try:
            message = self._parser.decode(self._rest[start:end])
        except Exception:  # whatever a library of others meets in bytes of others
            return None
        if message.get_type().startswith("UNKNOWN"):
            return message if self._sane and (end == len(self._rest) or self._rest[end] in (V1, V2)) else None
        return message

    def _next_marker(self, start: int) -> int:
        found = (place for place in (self._rest.find(marker, start) for marker in MARKERS) if place >= 0)
        return min(found, default=len(self._rest))

    def _bad(self) -> None:
        if self._sane:
            self._notify("bad data", "bytes that are no message, skipped; a wrong baud rate, or a noisy line?")
        self._sane = False


def frames_with_times(content: Content) -> Iterator[tuple[bytes, float]]:
    """Frames of a telemetry log with the times of their arrival [s]; what stands between them comes too."""
    start = lost = 0
    arrival = 0.0
    while start + TIME < len(content):
        if not begins(content, start):
            start += 1
            continue
        end = start + TIME + (frame_length(content, start + TIME) or len(content))
        if end < len(content) and not begins(content, end) and _begins_within(content, start + 1, end):
            start += 1  # a time and a marker by chance, or a frame that lost bytes
            continue
        time = _arrival(content, start, end, arrival)
        if lost < start:
            yield content[lost:start], arrival or time
        arrival = time
        yield content[start + TIME : end], arrival
        start = lost = end
    if lost < len(content):
        yield content[lost:], arrival


def _arrival(content: Content, start: int, end: int, before: float) -> float:
    """The time of a frame [s]; that of the one before it where neither that nor the next is near."""
    time = _time(content, start)
    near = [before] + ([_time(content, end)] if begins(content, end) else [])
    return time if not before or min(abs(time - other) for other in near) < JUMP_S else before


def _time(content: Content, start: int) -> float:
    return 1e-6 * int.from_bytes(content[start : start + TIME], "big")


def begins(content: Content, start: int) -> bool:
    """Whether a time and the beginning of a frame may stand here."""
    marker = content[start + TIME : start + TIME + 1]
    return marker in MARKERS and EARLIEST < _time(content, start) < LATEST


def _begins_within(content: Content, start: int, end: int) -> bool:
    return any(begins(content, at) for at in range(start, end))
