"""Decoders of bytes that work line by line."""

from collections.abc import Callable, Iterator

from rovgraph.interchange.lines import Refused
from rovgraph.live.message import Message
from rovgraph.live.sources.source import Chunk, Notify

LONGEST = 1 << 16  # bytes of a line


class LineDecoder:
    """Splits bytes into lines and makes a message of each.

    Parameters
    ----------
    parse : from a line without its end, not empty, and its arrival to a message, or None where it
        says nothing of a sensor; raises `Refused`
    notify : takes warnings
    """

    def __init__(self, parse: Callable[[bytes, float], Message | None], notify: Notify) -> None:
        self._parse = parse
        self._notify = notify
        self._rest = b""
        self._skipping = False  # within a line that is too long

    def feed(self, chunk: Chunk) -> Iterator[Message]:
        if chunk.fresh:
            self._rest, self._skipping = b"", False
        *lines, rest = chunk.data.split(b"\n")
        if lines:
            lines[0] = self._rest + lines[0]
            self._rest = b""
            if self._skipping:
                self._skipping = False
                del lines[0]
        self._keep(rest)
        for line in lines:
            message = self._message(line, chunk.arrival)
            if message is not None:
                yield message

    def _keep(self, rest: bytes) -> None:
        """The beginning of a line, unless it is too long already."""
        if self._skipping:
            return
        self._rest += rest
        if len(self._rest) > LONGEST:
            self._rest, self._skipping = b"", True
            self._notify("too long", f"a line of more than {LONGEST} bytes is skipped")

    def _message(self, line: bytes, arrival: float) -> Message | None:
        line = line.strip()
        try:
            if len(line) > LONGEST:
                raise Refused("too long", f"a line of more than {LONGEST} bytes is skipped")
            return self._parse(line, arrival) if line else None
        except Refused as refused:
            self._notify(refused.kind, refused.text)
            return None
