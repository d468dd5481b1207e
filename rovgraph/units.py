"""Units as a person reads them: degrees instead of radians."""

import math


def shown(unit: str) -> tuple[float, str]:
    """Factor from a unit inside the program to the one shown, and that one's name.

    >>> shown("m")
    (1.0, 'm')
    """
    if unit.startswith("rad"):
        return math.degrees(1.0), "deg" + unit[3:]
    return 1.0, unit


def behind(unit: str) -> str:
    """A unit that is shown, as it stands behind a number; nothing of a ratio.

    >>> behind("deg"), behind("1")
    (' deg', '')
    """
    return "" if unit in ("", "1") else f" {unit}"
