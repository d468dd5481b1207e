"""What ends a command that would go on for ever."""

import contextlib
import signal
from collections.abc import Callable, Iterator

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP")  # Ctrl-C, a system that shuts down, a terminal that is closed


@contextlib.contextmanager
def ended_by_signals(end: Callable[[], None]) -> Iterator[None]:
    """Have the first of these signals call ``end``; a second one does what it always does.

    A signal that is ignored, as nohup has it, stays ignored.
    """
    handled = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
    before = {number: handler for number in handled if (handler := signal.getsignal(number)) != signal.SIG_IGN}

    def restore(*_: object) -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def first(*_: object) -> None:
        restore()
        end()

    for number in before:
        signal.signal(number, first)
    try:
        yield
    finally:
        restore()


def asked_by_signal(answer: Callable[[], None]) -> None:
    """Have SIGUSR1 call ``answer``, where there is such a signal."""
    if hasattr(signal, "SIGUSR1"):
        signal.signal(signal.SIGUSR1, lambda *_: answer())
