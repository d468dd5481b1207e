"""Keys of the graph's variables: x pose, v velocity, b bias, n place, one letter per calibration."""

from rovgraph.calibration import TABLE
from rovgraph.engine.unknowns import Unknowns
from rovgraph.state import BIAS, DIMENSION, PLACE, PLACE_DIM, POSE, VELOCITY

CALIBRATION = "calibration"  # all of it in a segment of time, as iSAM2 has it
_LETTER = {POSE: "x", VELOCITY: "v", BIAS: "b", PLACE: "n", CALIBRATION: "C"}
_NAMES = {ord(letter): variable for variable, letter in _LETTER.items()}
_SIZE = DIMENSION | {PLACE: PLACE_DIM}
_INDICES = 1 << 56  # of a letter
_PLACES = ord(_LETTER[PLACE])
_STATES = {ord(_LETTER[variable]) for variable in DIMENSION}


def key(variable: str, index: int = 0) -> int:
    """Key of a state variable at a keyframe, or of a calibration variable.

    Parameters
    ----------
    variable : "pose", "velocity", "bias", "place" or a name of the calibration table
    index : keyframe; number of a place; for calibration that walks its value, else 0
    """
    letter = _LETTER[variable] if variable in _LETTER else TABLE[variable].letter
    return ord(letter) * _INDICES + index  # as gtsam.symbol makes them


def dimension(key: int) -> int:
    """Of the variable that a key is of, in its tangent space."""
    variable = _variable(key // _INDICES)
    return _SIZE[variable] if variable in _SIZE else TABLE[variable].dim


def is_place(key: int) -> bool:
    """Whether a key is of a place."""
    return key // _INDICES == _PLACES


def key_index(key: int) -> tuple[bool, int]:
    """Whether a key is of a keyframe's state, and the index of its keyframe, else of its value."""
    letter, index = divmod(key, _INDICES)
    return letter in _STATES, index


def key_name(key: int) -> str:
    """What a key stands for, in words: for messages."""
    letter, index = divmod(key, _INDICES)
    variable = _variable(letter)
    if variable == PLACE:
        return f"place {index}"
    return f"{variable} of keyframe {index}" if variable in DIMENSION else variable


def _variable(letter: int) -> str:
    """Whose letter it is."""
    if letter in _NAMES:
        return _NAMES[letter]
    return next(variable.name for variable in TABLE.values() if ord(variable.letter) == letter)


def calibration_key(unknowns: Unknowns, name: str, index: int) -> int:
    """Key of an estimated calibration variable: of its value with that index, where it walks."""
    return key(name, index if unknowns.walks[name] else 0)
