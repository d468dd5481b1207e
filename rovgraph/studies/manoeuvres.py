"""Manoeuvres to choose from: scenarios of the simulator, each at some speeds."""

from collections.abc import Sequence
from dataclasses import dataclass

from rovgraph.errors import InputError
from rovgraph.simulate import scenario

CANDIDATES = ("straight", "lawnmower", "square", "circle", "figure8", "accelerate-and-stop", "spiral")
SPEEDS = (0.25, 0.5)  # [m/s]


@dataclass(frozen=True)
class Manoeuvre:
    """A scenario at a speed [m/s]."""

    name: str
    speed: float

    def __str__(self) -> str:
        return f"{self.name}@{self.speed:g}"


def manoeuvres(names: Sequence[str] | None, duration: float) -> list[Manoeuvre]:
    """Those of some names, as ``circle`` at all speeds or ``circle@0.3`` at one.

    Parameters
    ----------
    names : None = all candidates
    duration : that they have to fit into [s]

    Raises
    ------
    InputError : no such scenario, no such speed, too short a duration
    """
    chosen: dict[Manoeuvre, None] = {}
    for text in names or CANDIDATES:
        name, at, speed = text.partition("@")
        for one in (_number(speed, text),) if at else SPEEDS:
            scenario(name, duration, one)  # refuses what cannot be
            chosen[Manoeuvre(name, one)] = None
    return list(chosen)


def _number(speed: str, text: str) -> float:
    try:
        return float(speed)
    except ValueError:
        raise InputError(f"manoeuvre {text!r}: a speed in m/s is expected behind the @, as circle@0.3") from None
