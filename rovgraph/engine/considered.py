"""Calibration that a dive does not show, held at its prior and considered.

Noise moves the estimate of what cannot be observed, by more than the data justify, and the
track with it. Such a variable is held at its prior's mean; the covariance of all else keeps its
prior's uncertainty: it is considered, not estimated (the Schmidt-Kalman filter). With K the derivative of
the optimum by what is held, P = P(held known) + K P(prior) K'.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from rovgraph.engine.optimum import Optimum
from rovgraph.geometry import Array


@dataclass(frozen=True)
class Considered:
    """An optimum, and what is held in it.

    Attributes
    ----------
    optimum : Optimum
    held : name -> ndarray, shape (dim,), prior sd of what is considered
    sensitivity : variable -> ndarray, shape (n, dim, k), derivative of the optimum by what is held
    """

    optimum: Optimum
    held: Mapping[str, Array] = field(default_factory=dict)
    sensitivity: Mapping[str, Array] = field(default_factory=dict)

    def covariances(self, variable: str) -> Array:
        """Of a state or calibration variable at every keyframe, shape (n, d, d)."""
        known = self.optimum.covariances(variable)
        if not self.held:
            return known
        K = self.sensitivity[variable] * np.concatenate(list(self.held.values()))
        return np.asarray(known + K @ np.swapaxes(K, 1, 2))


def consider(optimum: Optimum, names: Sequence[str]) -> Considered:
    """The optimum where some estimated constants are held, their prior's uncertainty in its covariance."""
    without, sensitivity = optimum.holding(names)
    beliefs = optimum.beliefs
    return Considered(
        without, {name: np.full(beliefs[name].variable.dim, beliefs[name].sd) for name in names}, sensitivity
    )
