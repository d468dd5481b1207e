"""A thread that does what may block, and a short queue in front of it."""

import queue
import threading
from collections.abc import Callable
from typing import Generic, TypeVar

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
