"""MAVLink frames in a stream of bytes.

A frame begins with a marker and its length; behind a byte that only looks like a marker, the
search goes on with the next byte, so that noise costs no good frame.
"""

from collections.abc import Iterator
from typing import Any

from rovgraph.live.sources.source import Notify

V1, V2 = 0xFE, 0xFD
MARKERS = (bytes([V1]), bytes([V2]))
SIGNED = 0x01
SIGNATURE = 13  # bytes


def frame_length(data: bytes | bytearray, start: int) -> int | None:
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

    def __init__(self, mavlink: Any, notify: Notify) -> None:
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
