"""Pieces of a long dive, so that what is large of a measurement is there for some of them at a time."""

from collections.abc import Iterator

LENGTH = 8192  # keyframes or measurements: their Jacobians by everything take a few kB each


def pieces(begin: int, end: int) -> Iterator[slice]:
    """What lies from ``begin`` to before ``end``, a piece after the other."""
    for first in range(begin, end, LENGTH):
        yield slice(first, min(first + LENGTH, end))
