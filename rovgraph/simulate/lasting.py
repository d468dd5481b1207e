"""Errors that last: first-order Gauss-Markov processes (Gelb 1974, 3.8) that belong to calibration variables."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rovgraph.config import beliefs
from rovgraph.geometry import Array
from rovgraph.simulate.noise import remembered
from rovgraph.simulate.truth import Truth, of_waves

STEPS = 50  # of a process, in its time constant


@dataclass(frozen=True)
class LastingErrors:
    """What of the calibration changes with time.

    Attributes
    ----------
    series : variable -> time, ndarray, shape (k,) [s], and its values, shape (k, dim), linear in between
    """

    series: Mapping[str, tuple[Array, Array]]

    def at(self, time: Array) -> dict[str, Array]:
        """Variable -> ndarray, shape (n, dim), at n epochs [s]."""
        return {
            name: np.column_stack([np.interp(time, own, values) for values in every.T])
            for name, (own, every) in self.series.items()
        }


def draw_lasting(
    truth: Truth, calibration: Mapping[str, Array], seconds: float, rng: np.random.Generator
) -> LastingErrors:
    """A process for each variable that is estimated with a time constant and has no value given.

    Parameters
    ----------
    truth : says which
    calibration : where they begin
    seconds : how long they go on [s]
    rng : the same seed gives the same errors; its own stream stays as it is
    """
    series: dict[str, tuple[Array, Array]] = {}
    for own, (name, belief) in zip(rng.spawn(len(beliefs(truth.config))), beliefs(truth.config).items(), strict=True):
        lasts = belief.estimate and np.isfinite(belief.time_constant) and not of_waves(belief)
        if truth.noise and lasts and name not in truth.calibration:
            step = belief.time_constant / STEPS
            time = step * np.arange(int(seconds / step) + 2.0)
            white = belief.sd * own.standard_normal((len(time), belief.variable.dim))
            white[0] = calibration[name] - belief.mean
            series[name] = time, belief.mean + remembered(white, STEPS)
    return LastingErrors(series)
