"""Names of calibration that a person gives to a study."""

import difflib

from rovgraph.calibration import TABLE, Variable
from rovgraph.errors import InputError


def known_variable(name: str) -> Variable:
    """A calibration variable by name.

    Raises
    ------
    InputError : there is none of that name, the nearest is told
    """
    if name in TABLE:
        return TABLE[name]
    near = difflib.get_close_matches(name, TABLE, 1)
    hint = f", did you mean {near[0]}?" if near else ""
    raise InputError(f"unknown calibration variable {name!r}{hint} (known: {', '.join(TABLE)})")
