"""Keys of the graph's variables: x pose, v velocity, b bias, n place, one letter per calibration."""

import gtsam

from rovgraph.calibration import TABLE
from rovgraph.engine.unknowns import Unknowns
from rovgraph.state import BIAS, DIMENSION, PLACE, PLACE_DIM, POSE, VELOCITY

_LETTER = {POSE: "x", VELOCITY: "v", BIAS: "b", PLACE: "n"} | {v.name: v.letter for v in TABLE.values()}
_FIRST = {variable: int(gtsam.symbol(letter, 0)) for variable, letter in _LETTER.items()}
_INDICES = 1 << 56  # of a letter
_DIMENSION = {
    _FIRST[variable] // _INDICES: dim
    for variable, dim in (DIMENSION | {PLACE: PLACE_DIM} | {v.name: v.dim for v in TABLE.values()}).items()
}

_STATES = {_FIRST[variable] // _INDICES for variable in DIMENSION}


def key(variable: str, index: int = 0) -> int:
    """Key of a state variable at a keyframe, or of a calibration variable.

    Parameters
    ----------
    variable : "pose", "velocity", "bias", "place" or a name of the calibration table
    index : keyframe; number of a place; for calibration that walks its value, else 0
    """
    return _FIRST[variable] + index  # consecutive, as gtsam.symbol makes them


def dimension(key: int) -> int:
    """Of the variable that a key is of, in its tangent space."""
    return _DIMENSION[key // _INDICES]


def is_place(key: int) -> bool:
    """Whether a key is of a place."""
    return key // _INDICES == _FIRST[PLACE] // _INDICES


def key_index(key: int) -> tuple[bool, int]:
    """Whether a key is of a keyframe's state, and the index of its keyframe, else of its value."""
    letter, index = divmod(key, _INDICES)
    return letter in _STATES, index


def key_name(key: int) -> str:
    """What a key stands for, in words: for messages."""
    symbol = gtsam.Symbol(key)
    letter = chr(symbol.chr())
    variable = next(name for name, own in _LETTER.items() if own == letter)
    if variable == PLACE:
        return f"place {symbol.index()}"
    return f"{variable} of keyframe {symbol.index()}" if variable in DIMENSION else variable


def calibration_key(unknowns: Unknowns, name: str, index: int) -> int:
    """Key of an estimated calibration variable: of its value with that index, where it walks."""
    return key(name, index if unknowns.walks[name] else 0)
