"""Counts warnings of sources, outputs and disks; reports the first ones."""

import threading
import time
from collections import Counter
from collections.abc import Callable

Complain = Callable[[str, str, str], None]  # source, kind, text

PERIOD_S = 60.0


class Warnings:
    """Counts warnings by source and kind, and lets one of a kind through per period; thread-safe.

    Parameters
    ----------
    say : called with source, kind and text of each reported warning, in the thread that warns;
        None = only count
    period : [s]
    clock : seconds, increasing
    """

    def __init__(
        self, say: Complain | None = None, period: float = PERIOD_S, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._say = say
        self._period = period
        self._clock = clock
        self._lock = threading.Lock()
        self._counts: Counter[tuple[str, str]] = Counter()
        self._said: dict[tuple[str, str], tuple[float, int]] = {}  # when, and the count then

    @property
    def counts(self) -> dict[tuple[str, str], int]:
        """(source, kind) -> how often, since the start."""
        with self._lock:
            return dict(self._counts)

    def complain(self, source: str, kind: str, text: str, once: bool = False) -> None:
        """Count, and report it unless the same kind was reported within the period.

        Parameters
        ----------
        source : URL that it is about
        kind : short and fixed
        text : one line for a person
        once : report it the first time only
        """
        key = source, kind
        with self._lock:
            self._counts[key] += 1
            count, now = self._counts[key], self._clock()
            when, before = self._said.get(key, (None, 0))
            if when is not None and (once or now - when < self._period):
                return
            self._said[key] = now, count
        if self._say is not None:
            more = count - before - 1
            self._say(source, kind, f"{text} ({more} more since the last)" if more else text)
