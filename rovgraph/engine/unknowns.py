"""What of the calibration is estimated."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from rovgraph.calibration import Belief
from rovgraph.geometry import Array


@dataclass(frozen=True)
class Unknowns:
    """What of the calibration a dive's estimate holds.

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
