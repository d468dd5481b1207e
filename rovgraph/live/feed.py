"""All sources as one stream of messages, in the order of arrival."""

import contextlib
import heapq
import math
import queue
import threading
from collections.abc import Iterator, Sequence
from operator import attrgetter
from types import TracebackType
from typing import Self

from rovgraph.live.commands import Command
from rovgraph.live.message import Message
from rovgraph.live.sources.source import Source
from rovgraph.live.warnings import Warnings

TICK_S = 0.1  # longest silence of the feed
WAIT_S = 0.2  # how often a thread that waits looks whether it shall stop
QUEUE = 10_000  # messages that may wait for the estimator
COMMANDS = 100  # of persons, likewise


class Feed:
    """Messages of many sources, while they come.

    Each source has a thread of its own. When the estimator falls behind, those that can be kept
    waiting wait; those that cannot lose what is newest, and it is complained of. Files that are
    read as fast as they are taken need no threads when they are alone: they are merged by arrival,
    the same way every time.

    Parameters
    ----------
    sources : at least one
    warnings : where a source's failure goes
    size : messages that may wait
    """

    def __init__(self, sources: Sequence[Source], warnings: Warnings | None = None, size: int = QUEUE) -> None:
        self._sources = tuple(sources)
        self._complaints = warnings or Warnings()
        self._queue: queue.Queue[Message | None] = queue.Queue(size)  # None = a source has ended
        self._commands: queue.Queue[Command] = queue.Queue(COMMANDS)
        self._stop = threading.Event()

    @property
    def recorded(self) -> bool:
        """Whether all sources are files that are read as fast as they are taken."""
        return all(source.pace == math.inf for source in self._sources)

    @property
    def replayed(self) -> bool:
        """Whether all arrivals are recorded ones, so that nothing has to do with the host's clock."""
        return all(source.pace not in (None, 1.0) for source in self._sources)

    def offer(self, command: Command) -> bool:
        """Have a command taken before the next message; from any thread, never waits; whether there was room."""
        try:
            self._commands.put_nowait(command)
        except queue.Full:
            return False
        return True

    def __iter__(self) -> Iterator[Message | Command | None]:
        """Messages in the order of arrival, and commands; None whenever nothing came for `TICK_S`."""
        return self._merged() if self.recorded else self._arriving()

    def close(self) -> None:
        """End the iteration after what has come, and let the threads end; from any thread, more than once."""
        self._stop.set()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _merged(self) -> Iterator[Message | Command]:
        streams = [source.messages(self._stop) for source in self._sources]
        for message in streams[0] if len(streams) == 1 else heapq.merge(*streams, key=attrgetter("arrival")):
            yield from self._given()
            yield message

    def _arriving(self) -> Iterator[Message | Command | None]:
        for source in self._sources:
            threading.Thread(target=self._run, args=(source,), name=f"source {source.url}", daemon=True).start()
        running = len(self._sources)
        while running and not self._stop.is_set():
            try:
                message = self._queue.get(timeout=TICK_S)
            except queue.Empty:
                yield None
                yield from self._given()
                continue
            if message is None:
                running -= 1
            else:
                yield message
            yield from self._given()
        yield from self._left()

    def _given(self) -> Iterator[Command]:
        """Commands that have come."""
        while not self._commands.empty():
            yield self._commands.get_nowait()

    def _left(self) -> Iterator[Message]:
        """What had come before it was closed."""
        with contextlib.suppress(queue.Empty):
            while True:
                message = self._queue.get_nowait()
                if message is not None:
                    yield message

    def _run(self, source: Source) -> None:
        """In a source's thread: what it says into the queue, and at last that it has ended."""
        put = self._put_or_drop if source.lossy else self._put
        try:
            for message in source.messages(self._stop):
                put(message)
        except Exception as error:  # a fault of ours in one source shall not end the others
            self._complaints.complain(source.url, "failed", f"cannot be read any more: {type(error).__name__}: {error}")
        self._put(None)

    def _put(self, message: Message | None) -> None:
        while not self._stop.is_set():
            with contextlib.suppress(queue.Full):
                self._queue.put(message, timeout=WAIT_S)
                return

    def _put_or_drop(self, message: Message) -> None:
        try:
            self._queue.put_nowait(message)
        except queue.Full:
            self._complaints.complain(message.source, "flood", "sends faster than can be worked off, messages are lost")
