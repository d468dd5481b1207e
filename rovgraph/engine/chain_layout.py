"""Where every variable of a chain stands: what walks in each keyframe's block, what is constant in the border."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import LAYOUT, TABLE, calibration_size
from rovgraph.state import BIAS, POSE, VELOCITY

MOTION = 15  # components of a keyframe before what walks
COLUMNS = {POSE: slice(0, 6), VELOCITY: slice(6, 9), BIAS: slice(9, 15)}
NOTHING = np.empty(0, np.int64)


@dataclass(frozen=True)
class ChainLayout:
    """Layout of a chain of blocks of d components with a border of c.

    Attributes
    ----------
    walks : calibration variable that is estimated -> its random walk, 0 = constant
    """

    walks: Mapping[str, float]

    @cached_property
    def places(self) -> dict[str, tuple[bool, slice]]:
        """Calibration variable -> whether it is in the border, and its place there or in a keyframe's block."""
        out, d, c = {}, MOTION, 0
        for name, walk in self.walks.items():
            dim = TABLE[name].dim
            out[name] = (False, slice(d, d + dim)) if walk else (True, slice(c, c + dim))
            d, c = (d + dim, c) if walk else (d, c + dim)
        return out

    @cached_property
    def walking(self) -> list[str]:
        """Variables that walk."""
        return [name for name, (border, _) in self.places.items() if not border]

    @cached_property
    def d(self) -> int:
        """Components of a keyframe's block."""
        return MOTION + sum(TABLE[name].dim for name in self.walking)

    @cached_property
    def c(self) -> int:
        """Components of the border."""
        return sum(TABLE[name].dim for name, (border, _) in self.places.items() if border)

    def target(self, name: str) -> NDArray[np.int64]:
        """Targets of a calibration variable's components, as `rovgraph.kernels.chain` counts them."""
        border, part = self.places[name]
        return np.arange(part.start, part.stop) + (self.d if border else 0)

    @cached_property
    def column(self) -> NDArray[np.int64]:
        """Target of each component of state and calibration vector, shape (15 + C,), -1 where it is not estimated."""
        out = np.full(MOTION + calibration_size(), -1)
        out[:MOTION] = np.arange(MOTION)
        for name in self.places:
            part = LAYOUT[name]
            out[MOTION + part.start : MOTION + part.stop] = self.target(name)
        return out

    def indeterminate(self, keyframe: int | None, component: int) -> str:
        """One line on a system that cannot be solved."""
        if keyframe is not None and component < MOTION:
            variable = next(v for v, columns in COLUMNS.items() if columns.start <= component < columns.stop)
            what = f"{variable} of keyframe {keyframe}"
        else:
            place = (keyframe is None, component)
            parts = self.places.items()
            own = (n for n, (border, p) in parts if border == place[0] and p.start <= place[1] < p.stop)
            what = next(own, "some variable")
        return (
            f"the data do not determine {what}: check the log (rovgraph check), "
            "tighten its prior sd, or hold it fixed in the configuration"
        )
