"""The base of all outputs: their URLs, their protocol, and a thread for blocking calls.

A URL is ``scheme:place?option=value``. `Background` is the thread, with a short queue in front of it.
"""

import math
import queue
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from typing import ClassVar, Generic, NamedTuple, TypeVar
from urllib.parse import parse_qsl, urlsplit

from rovgraph.errors import InputError
from rovgraph.live.solution import Event, Solution
from rovgraph.live.warnings import Warnings


class Url(NamedTuple):
    """A URL in its parts.

    Attributes
    ----------
    text : as a person gave it
    scheme, place : before and after the first colon
    options : what stands behind the question mark
    """

    text: str
    scheme: str
    place: str
    options: dict[str, str]

    def host_port(self, default_host: str | None = None) -> tuple[str, int]:
        """Host and port of ``scheme://host:port``.

        Raises
        ------
        InputError : one of them is missing or out of range
        """
        try:
            parts = urlsplit(f"{self.scheme}:{self.place}")
            host, port = parts.hostname or default_host, parts.port
        except ValueError:
            host = port = None
        if not host or not port or parts.path not in ("", "/"):
            wanted = "host:port" if default_host is None else "[host]:port"
            raise InputError(f"output {self.text!r}: expected {self.scheme}://{wanted}, the port from 1 to 65535")
        return host, port

    def number(self, option: str, default: float | None, low: float, high: float) -> float | None:
        """A number among the options.

        Raises
        ------
        InputError : not a number, or not from ``low`` to ``high``
        """
        if option not in self.options:
            return default
        try:
            value = float(self.options[option])
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise InputError(f"output {self.text!r}: {option}: expected a number from {low:g} to {high:g}")
        return value


def parsed(text: str) -> Url:
    """The parts of an output's URL."""
    before, _, query = text.partition("?")
    scheme, _, place = before.partition(":")
    return Url(text, scheme, place, dict(parse_qsl(query, keep_blank_values=True)))


class Output(ABC):
    """A place where solutions go.

    Parameters
    ----------
    url : parsed; the option ``rate`` is the most solutions a second [Hz]
    warnings : where warnings go

    Attributes
    ----------
    dropped : lines or messages that were given up, over all readers

    Raises
    ------
    InputError : an option that is not in `OPTIONS`
    """

    OPTIONS: ClassVar[tuple[str, ...]] = ("rate",)

    def __init__(self, url: Url, warnings: Warnings | None = None) -> None:
        unknown = [name for name in url.options if name not in self.OPTIONS]
        if unknown:
            known = ", ".join(self.OPTIONS)
            raise InputError(f"output {url.text!r}: unknown option {unknown[0]!r}; known are {known}")
        self.url = url
        self.dropped = 0
        self._rate = url.number("rate", None, 1e-3, 1e4)
        self._tick: int | None = None
        self._held: tuple[Event, ...] = ()
        self._complaints = warnings or Warnings()
        self._counting = threading.Lock()

    def send(self, solution: Solution) -> None:
        """Send a solution, or pass over it where the rate asks for fewer; its events go with the next."""
        if self._rate is not None:
            tick = math.floor(solution.time * self._rate + 1e-6)
            if tick == self._tick:
                self._held += solution.events
                return
            self._tick = tick
            solution = replace(solution, events=self._held + solution.events)
            self._held = ()
        self._send(solution)

    @abstractmethod
    def close(self) -> None:
        """Send what is queued within a second or so, and let go."""

    @abstractmethod
    def _send(self, solution: Solution) -> None: ...

    def _complain(self, kind: str, text: str) -> None:
        self._complaints.complain(self.url.text, kind, text)

    def _drop(self, count: int, kind: str, text: str) -> None:
        """Count what is given up, and report it; from any thread."""
        with self._counting:
            self.dropped += count
        self._complain(kind, f"{text}; {self.dropped} dropped so far")


T = TypeVar("T")


class Background(Generic[T]):
    """Calls ``handle`` with what is put, in order, in a thread of its own.

    Parameters
    ----------
    handle : may block, must not raise
    capacity : longest queue
    name : of the thread
    """

    def __init__(self, handle: Callable[[T], None], capacity: int, name: str) -> None:
        self._handle = handle
        self._queue: queue.Queue[T | None] = queue.Queue(capacity)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def put(self, item: T | None) -> int:
        """Queue an item; returns how many others, the oldest, had to make room."""
        lost = 0
        while True:
            try:
                self._queue.put_nowait(item)
                return lost
            except queue.Full:
                lost += self._take()

    def close(self, timeout: float) -> int:
        """End after what is queued; returns how much was left after ``timeout`` [s]."""
        lost = self.put(None)
        self._thread.join(timeout)
        return lost + max(self._queue.qsize() - 1, 0)

    def _take(self) -> int:
        try:
            self._queue.get_nowait()
        except queue.Empty:  # the thread was quicker
            return 0
        return 1

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            self._handle(item)
