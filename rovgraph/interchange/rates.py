"""Whether an inertial unit was recorded often enough."""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.spilling import every

SOME = 10_000  # stamps that a rate is taken from
SLOWEST_HZ = 8.0  # of an inertial unit; in between, the vehicle moves as it likes


def rate_hz(time: Array) -> float:
    """The usual rate of stamps that increase, of some thousands of them; 0 where none do."""
    some = max(len(time) // SOME, 1)
    step = every(time[1:], some) - every(time[:-1], some)
    return float(1.0 / np.median(step[step > 0.0])) if (step > 0.0).any() else 0.0


def too_slow(time: Array, source: str, remedy: str) -> list[str]:
    """A warning where an inertial unit's samples are too few to navigate by, else nothing."""
    rate = rate_hz(time)
    if rate >= SLOWEST_HZ:
        return []
    return [f"{source}: {rate:.2g} samples a second are too few to navigate by; {remedy}"]
