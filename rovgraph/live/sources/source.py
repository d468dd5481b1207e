"""A source of messages: a link that yields bytes, and a decoder that makes messages of them.

`LineDecoder` decodes line by line. `Preferred` chooses one of several kinds of message with the same content.
"""

import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from rovgraph.live.message import Message
from rovgraph.readers.records import Refused

STOP_S = 0.2  # longest wait of a link before it looks whether it shall stop


class Source(Protocol):
    """A source of sensors' measurements.

    Attributes
    ----------
    url : as a person gave it
    pace : of a recording, its seconds per second; infinite = as fast as it is taken; None = live
    lossy : whether what is not taken at once is lost, as it cannot be kept waiting
    """

    @property
    def url(self) -> str: ...
    @property
    def pace(self) -> float | None: ...
    @property
    def lossy(self) -> bool: ...

    def messages(self, stop: threading.Event) -> Iterator[Message]:
        """The source's messages, as they come, until it ends or ``stop`` is set, which it obeys within 0.5 s.

        Never raises for what the far side does. Once only.
        """
        ...


class Notify(Protocol):
    """Takes warnings about one source; see `rovgraph.live.warnings.Warnings.complain`."""

    def __call__(self, kind: str, text: str, once: bool = False) -> None: ...


class Chunk(NamedTuple):
    """Bytes that came at one time.

    Attributes
    ----------
    data : any number of bytes
    arrival : seconds since 1970, by the host's clock, or by that of a recording
    fresh : the bytes before it are complete, or lost: a new connection, a datagram
    """

    data: bytes
    arrival: float
    fresh: bool = False


class Link(Protocol):
    """Where bytes come from."""

    def chunks(self, stop: threading.Event) -> Iterator[Chunk]:
        """Bytes as they come, until they end or ``stop`` is set."""
        ...


class Decoder(Protocol):
    """Makes messages of bytes; keeps what is not complete yet; raises for no bytes whatsoever."""

    def feed(self, chunk: Chunk) -> Iterable[Message]: ...


@dataclass(frozen=True)
class LinkSource:
    """The source that a link and a decoder make."""

    url: str
    link: Link
    decoder: Decoder
    lossy: bool = False
    pace: float | None = None

    def messages(self, stop: threading.Event) -> Iterator[Message]:
        heard = (message for chunk in self.link.chunks(stop) for message in self.decoder.feed(chunk))
        return heard if self.pace is None else paced(heard, self.pace, stop)


def paced(
    messages: Iterable[Message], pace: float, stop: threading.Event, first: float | None = None
) -> Iterator[Message]:
    """Messages of a recording, each at its time.

    At pace 1 they arrive by the host's clock, so that live sources may stand beside the recording;
    at any other, by the recording's.

    Parameters
    ----------
    first : the recorded time that the replay begins at, the same for recordings of one clock; None = the first message
    """
    begin, offset = time.monotonic(), None
    for message in messages:
        if stop.is_set():
            return
        if pace == math.inf:
            yield message
            continue
        if offset is None:
            first = message.arrival if first is None else first
            offset = time.time() - first
        assert first is not None
        if stop.wait(max(0.0, begin + (message.arrival - first) / pace - time.monotonic())):
            return
        yield message._replace(arrival=message.arrival + offset) if pace == 1.0 else message


LONGEST = 1 << 16  # bytes of a line


class LineDecoder:
    """Splits bytes into lines and makes a message of each.

    Parameters
    ----------
    parse : from a line without its end, not empty, and its arrival to a message, or None where it
        has no sensor data; raises `Refused`
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


PATIENCE_S = 5.0  # silence after which a lesser kind takes over


class Preferred:
    """Takes one kind of message: the best one that is heard, so that nothing is counted twice.

    Parameters
    ----------
    kinds : best first
    notify : takes warnings
    """

    def __init__(self, kinds: Sequence[str], notify: Notify) -> None:
        self._kinds = tuple(kinds)
        self._notify = notify
        self._current: str | None = None
        self._heard = 0.0

    def takes(self, kind: str, arrival: float) -> bool:
        """Whether a message of this kind is taken.

        Parameters
        ----------
        kind : of the message
        arrival : seconds since 1970
        """
        if kind not in self._kinds:
            return False
        if kind != self._current and self._takes_over(kind, arrival):
            if self._current is not None:
                self._notify("switched", f"{kind} is read from now on, in the place of {self._current}")
            self._current = kind
        if kind == self._current:
            self._heard = arrival
        return kind == self._current

    def _takes_over(self, kind: str, arrival: float) -> bool:
        if self._current is None or arrival - self._heard > PATIENCE_S:
            return True
        return self._kinds.index(kind) < self._kinds.index(self._current)
