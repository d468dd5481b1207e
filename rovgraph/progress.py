"""How a long task tells how far it is."""

from collections.abc import Callable

Progress = Callable[[str, float], None]  # the current task, and how much of it is done, from 0 to 1


def no_progress(what: str, done: float) -> None:
    """Show nothing."""
