"""Whether an inertial unit was recorded often enough."""

import numpy as np

from rovgraph.geometry import Array

SLOWEST_HZ = 8.0  # of an inertial unit; in between, the vehicle moves as it likes


def rate_hz(time: Array) -> float:
    """The usual rate of stamps; 0 where there are fewer than two."""
    step = np.diff(np.unique(time))
    return float(1.0 / np.median(step)) if len(step) else 0.0


def too_slow(time: Array, source: str, remedy: str) -> list[str]:
    """A warning where an inertial unit's samples are too few to navigate by, else nothing."""
    rate = rate_hz(time)
    if rate >= SLOWEST_HZ:
        return []
    return [f"{source}: {rate:.2g} samples a second are too few to navigate by; {remedy}"]
