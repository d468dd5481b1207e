"""Keys of the graph's variables: x pose, v velocity, b bias, one letter per calibration."""

import gtsam

from rovgraph.calibration import TABLE
from rovgraph.state import BIAS, POSE, VELOCITY

_LETTER = {POSE: "x", VELOCITY: "v", BIAS: "b"}


def key(variable: str, index: int = 0) -> int:
    """Key of a state variable at a keyframe, or of a calibration variable.

    Parameters
    ----------
    variable : "pose", "velocity", "bias" or a name of the calibration table
    index : keyframe; 0 for a calibration variable
    """
    if variable in _LETTER:
        return int(gtsam.symbol(_LETTER[variable], index))
    return int(gtsam.symbol(TABLE[variable].letter, 0))


def key_name(key: int) -> str:
    """What a key stands for, in words: for messages."""
    symbol = gtsam.Symbol(key)
    letter = chr(symbol.chr())
    for variable, own in _LETTER.items():
        if own == letter:
            return f"{variable} of keyframe {symbol.index()}"
    return next(v.name for v in TABLE.values() if v.letter == letter)
