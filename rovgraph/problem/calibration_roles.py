"""Roles of the calibration variables: which are estimated, and which are considered."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.geometry import Array
from rovgraph.model.calibration import Belief
from rovgraph.model.gauss_markov import walked


@dataclass(frozen=True)
class CalibrationRoles:
    """Roles of the calibration variables in a dive's estimate.

    Attributes
    ----------
    fixed : all calibration variables at their prior means; those that are not estimated
        keep them
    walks : random walk of each that is estimated [unit per root second]; with 0 it has one
        value for all of the dive, otherwise one per segment of time
    considered : constants that keep their means, and whose uncertainty is in that of all else
    time_constants : of those that return to their mean [s]
    """

    fixed: Mapping[str, Array]
    walks: Mapping[str, float]
    considered: tuple[str, ...] = ()
    time_constants: Mapping[str, float] = field(default_factory=dict)

    @property
    def estimated(self) -> tuple[str, ...]:
        return tuple(self.walks)

    def begun_by(self, segment: int) -> tuple[str, ...]:
        """Those that have a new value in a segment."""
        return tuple(name for name, walk in self.walks.items() if walk or segment == 0)

    def of(self, names: Iterable[str]) -> "CalibrationRoles":
        """Only some of the estimated variables."""
        wanted = set(names)
        return replace(self, walks={name: walk for name, walk in self.walks.items() if name in wanted})

    def estimating(self, names: Iterable[str]) -> "CalibrationRoles":
        """Some of the considered variables estimated, behind the others."""
        more = tuple(names)
        left = tuple(name for name in self.considered if name not in more)
        return replace(self, walks={**self.walks, **dict.fromkeys(more, 0.0)}, considered=left)

    def considering(self, names: Iterable[str]) -> "CalibrationRoles":
        """Some of the estimated constants considered, behind the others."""
        more = tuple(names)
        kept = self.of(name for name in self.estimated if name not in more)
        return replace(kept, considered=(*self.considered, *more))

    def with_lasting(self, belief: Belief) -> "CalibrationRoles":
        """An error that lasts estimated, too, behind the others."""
        name, lasting = belief.variable.name, {n: s for n, s in self.time_constants.items() if n in self.walks}
        if np.isfinite(belief.time_constant):
            lasting[name] = belief.time_constant
        left = tuple(n for n in self.considered if n != name)
        return replace(self, walks={**self.walks, name: belief.walk}, considered=left, time_constants=lasting)

    def walked(self, name: str, seconds: ArrayLike) -> tuple[Array, Array]:
        """Factor and added sd of one that walks, in a time: `rovgraph.model.gauss_markov.walked`."""
        return walked(self.walks[name], self.time_constants.get(name, np.inf), seconds)


def unknowns(beliefs: Mapping[str, Belief], sensors: Iterable[str]) -> CalibrationRoles:
    """Calibration variables to be estimated or considered: asked for, and a sensor that shows them is in use."""
    present = {*sensors, "imu"}
    used = {n: b for n, b in beliefs.items() if b.is_shown_by(present)}
    wanted = {n: b.walk for n, b in used.items() if b.estimate}
    considered = tuple(n for n, b in used.items() if b.considered)
    lasting = {n: used[n].time_constant for n in wanted if np.isfinite(used[n].time_constant)}
    return CalibrationRoles({name: belief.mean for name, belief in beliefs.items()}, wanted, considered, lasting)
