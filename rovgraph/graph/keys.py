"""Keys of the graph's variables: x pose, v velocity, b bias, one letter per calibration."""

import gtsam

from rovgraph.calibration import TABLE
from rovgraph.state import BIAS, DIMENSION, POSE, VELOCITY

_LETTER = {POSE: "x", VELOCITY: "v", BIAS: "b"} | {v.name: v.letter for v in TABLE.values()}
_FIRST = {variable: int(gtsam.symbol(letter, 0)) for variable, letter in _LETTER.items()}


def key(variable: str, index: int = 0) -> int:
    """Key of a state variable at a keyframe, or of a calibration variable.

    Parameters
    ----------
    variable : "pose", "velocity", "bias" or a name of the calibration table
    index : keyframe; 0 for a calibration variable
    """
    return _FIRST[variable] + index  # consecutive, as gtsam.symbol makes them


def key_name(key: int) -> str:
    """What a key stands for, in words: for messages."""
    symbol = gtsam.Symbol(key)
    letter = chr(symbol.chr())
    variable = next(name for name, own in _LETTER.items() if own == letter)
    return f"{variable} of keyframe {symbol.index()}" if variable in DIMENSION else variable
