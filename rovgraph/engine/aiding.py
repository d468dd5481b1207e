"""Thruster signals and IMU samples become measurements of `ModelAiding`.

Pieces are short, since a mean over a second of turning and rocking is not what is so in its
middle; between keyframes that are further apart there are several.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.imu_samples import fit_rates
from rovgraph.log import Measurement
from rovgraph.sensors import ModelAiding

PIECE_S = 0.25  # longest
OLDEST_SIGNAL_S = 1.0  # a thruster's signal is believed to last that long


def thruster_pieces(
    model: ModelAiding, signals: Sequence[Measurement], begin: float, end: float, samples: Array
) -> Iterator[Measurement | str]:
    """What thrusters tell between two keyframes, each at the middle of its piece, or why a piece tells nothing.

    Parameters
    ----------
    model : ModelAiding
    signals : those up to ``end``, from the one before ``begin`` less the model's memory on, in the order of time
    begin, end : times of the keyframes [s]
    samples : ndarray, shape (n, 7), that cover it: time, specific force, angular rate, body axes

    Returns
    -------
    Measurements of "thruster": values are those of the model (3), and the piece's length [s]; or reasons
    """
    edges = np.linspace(begin, end, 1 + max(1, int(np.ceil((end - begin) / PIECE_S - 1e-6))))
    rates = np.empty((len(edges), 3))
    fit_rates(samples, edges, rates)
    for t0, t1, w0, w1 in zip(edges[:-1].tolist(), edges[1:].tolist(), rates[:-1], rates[1:], strict=True):
        piece = _piece(model, [m for m in signals if m.time <= t1], t0, t1, samples, (w1 - w0) / (t1 - t0))
        if piece is not None:
            yield piece


def _piece(
    model: ModelAiding, signals: Sequence[Measurement], begin: float, end: float, samples: Array, alpha_b: Array
) -> Measurement | str | None:
    inside = samples[(samples[:, 0] >= begin) & (samples[:, 0] <= end)]
    if not (len(inside) and signals):
        return None
    if signals[0].time > begin - model.memory:
        return "pieces before the first signal"
    if signals[-1].time < end - OLDEST_SIGNAL_S:
        return f"pieces without a signal for {OLDEST_SIGNAL_S:g} s"
    time, values = np.array([m.time for m in signals]), np.array([m.values for m in signals])
    turning = model.turning(time, values, inside[:, 0])
    z = model.measured(inside[:, 1:4].mean(axis=0), turning, alpha_b)
    return Measurement(0.5 * (begin + end), "thruster", np.append(z, end - begin), signals[-1].row)
