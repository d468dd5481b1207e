"""Places that are seen again and again: each view counts once."""

import math
from dataclasses import dataclass, field

from rovgraph.engine.keyframes import LandmarkObservation

STILL_IN_VIEW = "still in view"  # why a view does not count


@dataclass
class Landmarks:
    """What has been in view.

    Attributes
    ----------
    every_s : time after which a place counts again [s]
    seen : place -> when it last counted [s]
    count : observations so far
    """

    every_s: float
    seen: dict[float, float] = field(default_factory=dict)
    count: int = 0

    def observe(self, name: float, time: float) -> LandmarkObservation | None:
        """A place that is seen; None where it has been in view just now. Times do not decrease."""
        if time - self.seen.get(name, -math.inf) < self.every_s:
            return None
        self.seen[name], self.count = time, self.count + 1
        return LandmarkObservation(name, self.count)

    def copy(self) -> "Landmarks":
        """One that goes on by itself from here."""
        return Landmarks(self.every_s, dict(self.seen), self.count)
