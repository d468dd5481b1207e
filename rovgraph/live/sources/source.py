"""A source of messages: a link that yields bytes, and a decoder that makes messages of them."""

import math
import threading
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from rovgraph.live.message import Message

STOP_S = 0.2  # longest wait of a link before it looks whether it shall stop


class Source(Protocol):
    """Something that says what sensors measured.

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
        """What the source says, as it comes, until it ends or ``stop`` is set, which it obeys within 0.5 s.

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
