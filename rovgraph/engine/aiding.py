"""Thruster signals and IMU samples become measurements of `ModelAiding`.

Pieces are short, since a mean over a second of turning and rocking is not what is so in its
middle; between keyframes that are further apart there are several.
"""

from collections import Counter
from collections.abc import Callable

import numpy as np

from rovgraph.geometry import Array
from rovgraph.log import Measurement
from rovgraph.sensors import ModelAiding

PIECE_S = 0.25  # longest
OLDEST_SIGNAL_S = 1.0  # a thruster's signal is believed to last that long


class Aiding:
    """Collects signals, gives back what they say of the time between two keyframes.

    Parameters
    ----------
    model : ModelAiding
    left_out : (sensor, reason) -> count, of pieces that give no measurement

    Attributes
    ----------
    signals : those that may still act
    """

    def __init__(self, model: ModelAiding, left_out: Counter[tuple[str, str]]) -> None:
        self.model, self.left_out = model, left_out
        self.signals: list[Measurement] = []

    def copy(self, left_out: Counter[tuple[str, str]]) -> "Aiding":
        """One that goes on by itself from here."""
        twin = Aiding(self.model, left_out)
        twin.signals = self.signals[:]
        return twin

    def add(self, signal: Measurement) -> None:
        """Take the signals of one epoch."""
        self.signals.append(signal)

    def between(self, begin: float, end: float, samples: Array, rate: Callable[[float], Array]) -> list[Measurement]:
        """Measurements of "thruster" between two keyframes, each at the middle of its piece.

        Parameters
        ----------
        begin, end : times of the keyframes [s]; what is older than ``begin`` is forgotten
        samples : ndarray, shape (n, 7), time, specific force, angular rate, body axes
        rate : of a time, angular rate, shape (3,) [rad/s]

        Returns
        -------
        list of Measurement : values are those of the model (3), and the piece's length [s]
        """
        edges = np.linspace(begin, end, 1 + max(1, int(np.ceil((end - begin) / PIECE_S - 1e-6))))
        rates = [rate(float(edge)) for edge in edges]
        pieces = [
            self._piece(float(t0), float(t1), samples, (w1 - w0) / (t1 - t0))
            for t0, t1, w0, w1 in zip(edges[:-1], edges[1:], rates[:-1], rates[1:], strict=True)
        ]
        acting = sum(m.time <= end - self.model.memory for m in self.signals)
        self.signals = self.signals[max(acting - 1, 0) :]
        return [piece for piece in pieces if piece is not None]

    def _piece(self, begin: float, end: float, samples: Array, alpha_b: Array) -> Measurement | None:
        inside = samples[(samples[:, 0] >= begin) & (samples[:, 0] <= end)]
        signals = [m for m in self.signals if m.time <= end]
        if not (len(inside) and signals):
            return None
        if signals[0].time > begin - self.model.memory:
            self.left_out["thruster", "pieces before the first signal"] += 1
            return None
        if signals[-1].time < end - OLDEST_SIGNAL_S:
            self.left_out["thruster", f"pieces without a signal for {OLDEST_SIGNAL_S:g} s"] += 1
            return None
        time, values = np.array([m.time for m in signals]), np.array([m.values for m in signals])
        turning = self.model.turning(time, values, inside[:, 0])
        z = self.model.measured(inside[:, 1:4].mean(axis=0), turning, alpha_b)
        return Measurement(0.5 * (begin + end), "thruster", np.append(z, end - begin), signals[-1].row)
