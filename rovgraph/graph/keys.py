"""Keys of the graph's variables: x pose, v velocity, b bias, n place, one letter per calibration."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam

from rovgraph.calibration import TABLE, Belief
from rovgraph.geometry import Array
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
    index : keyframe; number of a place; for a calibration variable that walks its segment, else 0
    """
    return _FIRST[variable] + index  # consecutive, as gtsam.symbol makes them


def dimension(key: int) -> int:
    """Of the variable that a key is of, in its tangent space."""
    return _DIMENSION[key // _INDICES]


def is_place(key: int) -> bool:
    """Whether a key is of a place."""
    return key // _INDICES == _FIRST[PLACE] // _INDICES


def state_index(key: int) -> tuple[bool, int]:
    """Whether a key is of a keyframe's state, and the index of its keyframe, else of its segment."""
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


@dataclass(frozen=True)
class Unknowns:
    """What of the calibration a graph estimates.

    Attributes
    ----------
    fixed : all calibration variables at their prior means; those that are not estimated
        keep them
    walks : random walk of each that is estimated [unit per root second]; with 0 it has one
        value for all of the dive, otherwise one per segment of time
    """

    fixed: Mapping[str, Array]
    walks: Mapping[str, float]

    @property
    def estimated(self) -> tuple[str, ...]:
        return tuple(self.walks)

    def key(self, name: str, segment: int) -> int:
        """Key of an estimated variable in a segment."""
        return key(name, segment if self.walks[name] else 0)

    def begun_by(self, segment: int) -> tuple[str, ...]:
        """Those that have a new value in a segment."""
        return tuple(name for name, walk in self.walks.items() if walk or segment == 0)

    def of(self, names: Iterable[str]) -> "Unknowns":
        """Only some of the estimated variables."""
        wanted = set(names)
        return Unknowns(self.fixed, {name: walk for name, walk in self.walks.items() if name in wanted})


def unknowns(beliefs: Mapping[str, Belief], sensors: Iterable[str]) -> Unknowns:
    """Calibration variables to be estimated: asked for, and a sensor that shows them is in use."""
    present = {*sensors, "imu"}
    wanted = {n: b.walk for n, b in beliefs.items() if b.estimate and present & set(b.variable.sensors)}
    return Unknowns({name: belief.mean for name, belief in beliefs.items()}, wanted)
