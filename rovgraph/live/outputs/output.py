"""What all outputs have in common."""

import math
import threading
from abc import ABC, abstractmethod
from dataclasses import replace
from typing import ClassVar

from rovgraph.errors import InputError
from rovgraph.live.outputs.url import Url
from rovgraph.live.solution import Event, Solution
from rovgraph.live.warnings import Warnings


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
        """Count what is given up, and say it; from any thread."""
        with self._counting:
            self.dropped += count
        self._complain(kind, f"{text}; {self.dropped} dropped so far")
