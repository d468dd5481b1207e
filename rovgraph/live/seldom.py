"""Complaints of an output or a recorder, not one per line that is lost."""

import threading
import time
from collections.abc import Callable

Complain = Callable[[str, str, str], None]  # source, kind, text

PERIOD_S = 60.0


def seldom(complain: Complain | None, period: float = PERIOD_S) -> Complain:
    """The callback, called at most once per source, kind and period; thread-safe.

    Parameters
    ----------
    complain : where complaints go; None = nowhere
    period : [s]
    """
    if complain is None:
        return lambda source, kind, text: None
    last: dict[tuple[str, str], float] = {}
    lock = threading.Lock()

    def complain_seldom(source: str, kind: str, text: str) -> None:
        now = time.monotonic()
        with lock:
            if now - last.get((source, kind), -period) < period:
                return
            last[source, kind] = now
        complain(source, kind, text)

    return complain_seldom
