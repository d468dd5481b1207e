"""Which of a dive's assumptions matter most: those that could move the whole track, before those on its details."""

from collections.abc import Sequence

MOST = 3
MATTERING = (  # how the lines go that matter, the most important first
    "crossovers: ",
    "profiles of the water are left out",
    "nothing checks the compass",
    "alone: it will drift",
    "error of the heading",
    "error of the DVL's scale",
    "a bottom that moves slowly",
    "begins in motion",
    "start at the origin",
    "error of the depth",
    "heading from",
)


def leading(assumptions: Sequence[str]) -> tuple[list[str], list[str]]:
    """At most `MOST` lines that matter for the track, the most important first, and all the others.

    >>> leading(["left out 3 of dvl: no bottom lock", "heading from ahrs"])
    (['heading from ahrs'], ['left out 3 of dvl: no bottom lock'])
    """

    def rank(line: str) -> int:
        return next((k for k, words in enumerate(MATTERING) if words in line), len(MATTERING))

    first = sorted((line for line in assumptions if rank(line) < len(MATTERING)), key=rank)[:MOST]
    return first, [line for line in assumptions if line not in first]
