"""How late stamps may be, and where on the time line a measurement is put for that.

A measurement stands at its stamp less the time offset that is assumed. What remains until the one that is estimated is
bridged by a window, the motion at knots around the stamp (`rovgraph.kernels.linearization`). So the assumption need not
be right, but the nearer it is, the less of the IMU's noise lies between a measurement and its keyframe. The assumption
may be renewed while measurements come.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rovgraph.calibration import LAYOUT, Belief
from rovgraph.geometry import Array
from rovgraph.instruments import Instrument
from rovgraph.kernels.measurement_row import KNOT_S

REACH_SD = 4.0  # of the prior, that a time_offset may be off


@dataclass
class TimeOffsets:
    """How late the stamps of a set of instruments are.

    Attributes
    ----------
    variable : sensor -> name of the calibration variable
    lags : variable that is estimated -> ndarray, shape (K,), time_offset that is reckoned with, ascending by
        `rovgraph.kernels.measurement_row.KNOT_S` [s]
    assumed : variable -> time_offset by which measurements are put earlier [s]
    """

    variable: dict[str, str]
    lags: dict[str, Array]
    assumed: dict[str, float]

    @staticmethod
    def of(beliefs: Mapping[str, Belief], instruments: Mapping[str, Instrument]) -> "TimeOffsets":
        """As the priors of the calibration have them."""
        variable = {sensor: i.time_offset for sensor, i in instruments.items() if i.time_offset is not None}
        priors = {name: belief for name, belief in beliefs.items() if name in variable.values()}
        assumed = {name: float(belief.mean[0]) for name, belief in priors.items()}
        lags = {name: around(assumed[name], REACH_SD * b.sd) for name, b in priors.items() if b.estimate}
        return TimeOffsets(variable, lags, assumed)

    def copy(self) -> "TimeOffsets":
        """One that goes on by itself from here."""
        return TimeOffsets(self.variable, self.lags, dict(self.assumed))

    @property
    def span(self) -> float:
        """How far measurements may lie from their stamps, and from the places that they were put to [s]."""
        every = np.concatenate([[0.0], *self.lags.values(), list(self.assumed.values())])
        return float(np.ptp(every))

    def of_sensor(self, sensor: str) -> float:
        """By how much measurements of a sensor are put earlier [s]."""
        return self.assumed.get(self.variable.get(sensor, ""), 0.0)

    def lag(self, sensor: str) -> Array | None:
        """Lateness that is reckoned with for a sensor, shape (K,) [s]; None where it is not estimated."""
        return self.lags.get(self.variable.get(sensor, ""))

    def assume(self, c: Array) -> None:
        """Renew the assumption by a calibration vector, shape (C,), as far as it was reckoned with."""
        for name, lag in self.lags.items():
            self.assumed[name] = float(np.clip(np.mean(c[LAYOUT[name]]), lag[0], lag[-1]))

    def off(self, calibration: Mapping[str, Array]) -> float:
        """How far the assumption lies from estimates, at most [s]."""
        return max((float(np.abs(calibration[n] - self.assumed[n]).mean()) for n in self.lags), default=0.0)

    def centred(self, calibration: Mapping[str, Array], reach: float) -> "TimeOffsets":
        """Offsets that are about as late as was estimated, shape (n, 1) or (1,) each, within ``reach`` [s]."""
        assumed = self.assumed | {name: float(np.mean(calibration[name])) for name in self.lags}
        lags = {name: around(assumed[name], reach + float(np.ptp(calibration[name]))) for name in self.lags}
        return TimeOffsets(self.variable, lags, assumed)


def around(middle: float, reach: float) -> Array:
    """Knots that cover what lies within ``reach`` of ``middle``, shape (K,)."""
    count = 2 + int(np.ceil(reach / KNOT_S))  # the rate's arcs need a knot more at either end
    return np.asarray(middle + KNOT_S * np.arange(-count, count + 1))
