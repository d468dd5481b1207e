"""A run of the online mode: sources to a navigator, solutions to receivers, all data to disk.

`Feed` merges all sources into one stream of messages, in the order of arrival.
"""

import contextlib
import gc
import heapq
import math
import queue
import threading
import time as host
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from types import TracebackType
from typing import Self

import numpy as np

from rovgraph.errors import InputError
from rovgraph.live.files import Files
from rovgraph.live.marks import Command, DropMark, Marks, RemoveMark, SetPosition
from rovgraph.live.message import Message
from rovgraph.live.navigator import Navigator
from rovgraph.live.solution import Solution
from rovgraph.live.sources.source import Source
from rovgraph.live.warnings import Warnings

RATE_HZ = 5.0  # of solutions, about that of pings
PAGE_RATE_HZ = 10.0  # where a person watches
COLLECT = (5_000, 200, 50)  # thresholds of the collector: next to nothing here is cyclic; few objects, short pauses
QUIET_S = 0.5  # without the IMU, after which time advances by the host's clock


@dataclass
class Session:
    """Runs until the sources end or are closed.

    Attributes
    ----------
    navigator : the estimate
    receivers : called with each solution: outputs, the status line
    rate_hz : of solutions
    files : None = nothing is kept
    marks : that a person drops
    warnings : what sources, outputs and disk complain of
    solution : the newest
    solutions : count
    took : times of the filter's updates [s]
    """

    navigator: Navigator
    receivers: list[Callable[[Solution], None]]
    warnings: Warnings
    rate_hz: float = RATE_HZ
    files: Files | None = None
    marks: Marks = field(default_factory=Marks)
    solution: Solution | None = None
    solutions: int = 0
    _due: float = -math.inf
    took: "array[float]" = field(default_factory=lambda: array("f"))
    _resumed: float = -math.inf
    _wanted: bool = False

    def want_smoothed(self) -> None:
        """Ask for the smoothed track so far; from a signal's handler."""
        self._wanted = True

    def write_smoothed(self) -> None:
        """The whole smoothed track so far to disk, where iSAM2 has it."""
        isam2 = self.navigator.isam2
        if self.files is None or isam2 is None or isam2.updated <= 0:
            return
        try:
            estimate = isam2.solve()
        except InputError as error:
            self.navigator.lose_isam2(str(error))
        else:
            self.files.write_smoothed(estimate, self.navigator.origin)

    def updates(self) -> dict[str, float]:
        """Times that updates of the filter took [ms]."""
        took = 1e3 * np.array(self.took or [0.0])
        return {
            "count": len(self.took),
            "mean_ms": float(took.mean()),
            "p99_ms": float(np.percentile(took, 99)),
            "max_ms": float(took.max()),
        }

    def resume(self) -> None:
        """Continue from the last checkpoint and what was recorded after it."""
        assert self.files is not None
        state = self.files.state
        if state is not None and self.files.replayed:
            self.navigator.clocks.restore(state["clocks"])
        elif state is not None:
            self.navigator.restore(state)
        if self.files.received is None:
            self.navigator.say("start", "resumed", "nothing was received before: starts again")
            return
        self.navigator.replay(self.files.received, self.files.told)
        self._resumed = self.navigator.time
        self.navigator.say("start", "resumed", f"continues from the data received up to {self._resumed:.1f} s")

    def run(self, feed: Iterable[Message | Command | None]) -> None:
        """Process the messages of the sources."""
        for _ in self.solve(feed):
            pass

    def solve(self, feed: Iterable[Message | Command | None]) -> Iterator[Solution]:
        """Process the messages and yield each solution once it has been sent; the disk has all at the end."""
        try:
            with _seldom_collected():
                for message in feed:
                    if (solution := self._step(message)) is not None:
                        yield solution
        except GeneratorExit:  # the caller stops iterating
            self._end()
            raise
        if (solution := self._end()) is not None:
            yield solution

    def _step(self, message: Message | Command | None) -> Solution | None:
        """Take a message or command, or None where nothing came for a while, and send a solution if one is due."""
        if message is None:
            self._wait()
        elif isinstance(message, Command):
            self._obey(message)
        elif not self._known(message):
            self._take(message)
        navigator, solution = self.navigator, None
        if navigator.engine is not None and navigator.time >= self._due:
            solution = self._send()
        if self.files is not None:
            self.files.keep(navigator)
        if self._wanted:
            self._wanted = False
            self.write_smoothed()
        return solution

    def _end(self) -> Solution | None:
        """No more messages: take what is held back, send a last solution, and bring all to disk."""
        if self.files is not None:
            self.files.keep(self.navigator, now=True)
        self.navigator.finish()
        solution = self._send()
        if self.files is not None:
            self.files.finish(self.navigator)
            self.write_smoothed()
        return solution

    def _known(self, message: Message) -> bool:
        """Whether a recording that is read again holds what had been received before a crash."""
        return self.navigator.clocks.trust and message.stamp is not None and message.stamp <= self._resumed

    def _take(self, message: Message) -> None:
        before = self.navigator.updates
        rows = self.navigator.take(message)
        if self.navigator.updates > before:
            self.took.append(self.navigator.update_s)
        if not rows:
            self.warnings.complain(message.source, "stamp", "a stamp seconds off from those before, left out")
        if self.files is not None:
            for time, readings in rows:
                self.files.recorder.write(time, message.arrival, readings)

    def _obey(self, command: Command) -> None:
        """Execute a person's command; before the first solution it has nothing to refer to."""
        navigator, at = self.navigator, self.solution
        if at is None:
            return
        if isinstance(command, DropMark):
            mark = self.marks.drop(command.name, at, command.north, command.east)
            name = mark.name or f"number {mark.number}"
            navigator.say("pilot", mark.kind, f"{name}: north {mark.north:.2f} m, east {mark.east:.2f} m")
        elif isinstance(command, RemoveMark) and (gone := self.marks.remove(command.number)) is not None:
            navigator.say("pilot", "removed", gone.name or f"number {gone.number}")
        elif isinstance(command, SetPosition):
            north, east, sd = command.north, command.east, command.sd
            readings = navigator.take_fix(north, east, sd)
            if readings and self.files is not None:
                self.files.recorder.write(navigator.time, host.time(), readings)
            text = f"a fix at north {north:.2f} m, east {east:.2f} m, sd {sd:.2g} m"
            apart, gate = _sds_apart(command, at), navigator.config.fix.gate_sd
            if gate is not None and apart > gate:
                text += f", {apart:.1f} sd from the estimate, which rejects it (fix.gate_sd {gate:g}); give a larger sd"
            navigator.say("pilot", "position", text)

    def _wait(self) -> None:
        """Advance the time when no message comes."""
        now = self.navigator.clocks.now(host.time())
        if now is not None and now - self.navigator.time > QUIET_S:
            self.navigator.tick(now)
        if self.navigator.waits_for:
            self.warnings.complain("start", "waiting", self.navigator.waits_for)

    def _send(self) -> Solution | None:
        solution = self.navigator.solution()
        if solution is None:
            return None
        self._due = (math.floor(self.navigator.time * self.rate_hz + 1e-6) + 1) / self.rate_hz
        self.solution, self.solutions = solution, self.solutions + 1
        if self.files is not None:
            self.files.note(solution.events)
        for receive in self.receivers:
            receive(solution)
        return solution


def _sds_apart(given: SetPosition, at: Solution) -> float:
    """Distance of a place from a solution, in units of their joint sd."""
    apart = np.array([given.north, given.east]) - at.position[:2]
    covariance = np.diag(at.position_sd[:2] ** 2 + given.sd**2)
    covariance[0, 1] = covariance[1, 0] = at.cov_north_east
    return float(np.sqrt(apart @ np.linalg.solve(covariance, apart)))


@contextlib.contextmanager
def _seldom_collected() -> Iterator[None]:
    """Garbage is collected seldom, and not among libraries and recordings, which takes a tenth of a second."""
    before = gc.get_threshold()
    gc.freeze()
    gc.set_threshold(*COLLECT)
    try:
        yield
    finally:
        gc.set_threshold(*before)
        gc.unfreeze()


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
        """Whether all arrivals are recorded ones, so that the host's clock is not used."""
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
        """In a source's thread: its messages into the queue, and at the end that it has ended."""
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
