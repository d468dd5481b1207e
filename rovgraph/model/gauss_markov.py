"""First-order Gauss-Markov processes: errors that last for a while, and random walks as those that last for ever.

    x(t + dt) - mean = exp(-dt / T) (x(t) - mean) + w,  var w = walk^2 T / 2 (1 - exp(-2 dt / T))

(Gelb 1974, 3.8).
"""

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.geometry import Array


def stationary_walk(sd: float, time_constant: float) -> float:
    """The random walk that keeps a first-order Gauss-Markov process at a standard deviation [unit per root second]."""
    return float(sd * np.sqrt(2.0 / time_constant))


def stationary_sd(walk: float, time_constant: float) -> float:
    """The standard deviation that a random walk keeps a first-order Gauss-Markov process at [unit]."""
    return float(walk * np.sqrt(0.5 * time_constant))


def walked(walk: ArrayLike, time_constant: ArrayLike, seconds: ArrayLike) -> tuple[Array, Array]:
    """Factor of a process after a time, and the sd added meanwhile; with infinite time constant a random walk.

    Parameters
    ----------
    walk, time_constant, seconds : array_like that broadcast [unit per root second], [s], [s]

    Returns
    -------
    kept : exp(-dt / T)
    sd : of w
    """
    q, T, dt = np.broadcast_arrays(np.asarray(walk, float), np.asarray(time_constant, float), seconds)
    lasting = np.isfinite(T)
    finite = np.where(lasting, T, 1.0)
    kept = np.where(lasting, np.exp(-dt / finite), 1.0)
    return kept, q * np.sqrt(np.where(lasting, -0.5 * finite * np.expm1(-2.0 * dt / finite), dt))
