"""From readings to admitted measurements: which may enter an estimate, at what time, and as which arrays.

`admitted` applies the limits of each sensor. `thruster_pieces` makes measurements of `ModelAiding` from thruster
signals and IMU samples; the pieces are short, since the mean over a second of turning and rocking differs from the
value in its middle, so a long interval between keyframes holds several. `pack` and `unpack` turn measurements into a
few arrays, for files and between processes.

`TimeOffsets` holds how late stamps may be. A measurement is placed at its stamp less the assumed time offset; a window,
the motion at knots around the stamp (`rovgraph.kernels.linearization`), bridges the rest. So the assumption may be
wrong, but the nearer it is, the less of the IMU's noise lies between a measurement and its keyframe. It may be renewed
while measurements arrive.
"""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.measurement_row import KNOT_S
from rovgraph.kernels.preintegration import fit_rates
from rovgraph.log import Measurement
from rovgraph.model.calibration import LAYOUT, Belief
from rovgraph.model.config import Config
from rovgraph.sensors import SENSORS, ModelAiding
from rovgraph.sensors.instruments import Instrument


def admitted(sensor: str, values: Array, config: Config, left_out: Counter[tuple[str, str]]) -> NDArray[np.bool_]:
    """Whether measurements may enter the graph.

    Parameters
    ----------
    sensor : name of the log stream
    values : ndarray, shape (n, k), its columns
    config : effective configuration
    left_out : (sensor, reason) -> count, of those that may not

    Returns
    -------
    ndarray of bool, shape (n,)
    """
    mask = np.ones(len(values), bool)
    for reason, bad in SENSORS[sensor].refused(values, config):
        if count := int((bad & mask).sum()):
            left_out[sensor, reason] += count
            mask &= ~bad
    return mask


PIECE_S = 0.25  # longest
OLDEST_SIGNAL_S = 1.0  # a thruster's signal is believed to last that long


def thruster_pieces(
    model: ModelAiding, signals: Sequence[Measurement], begin: float, end: float, samples: Array
) -> Iterator[Measurement | str]:
    """Thruster measurements between two keyframes, each at the middle of its piece, or why a piece has none.

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


def pack(measurements: Sequence[Measurement]) -> dict[str, dict[str, Any]]:
    """Arrays of each sensor: place in the sequence, time, row and values."""
    by_sensor: dict[str, list[int]] = {}
    for k, m in enumerate(measurements):
        by_sensor.setdefault(m.sensor, []).append(k)
    return {
        sensor: {
            "place": np.array(places),
            "time": np.array([measurements[k].time for k in places]),
            "row": np.array([measurements[k].row for k in places]),
            "values": np.array([measurements[k].values for k in places]),
        }
        for sensor, places in by_sensor.items()
    }


def unpack(packed: Mapping[str, Mapping[str, Any]]) -> list[Measurement]:
    """The inverse of `pack`."""
    out: list[tuple[int, Measurement]] = []
    for sensor, arrays in packed.items():
        columns = (arrays[name].tolist() for name in ("place", "time", "row"))
        for place, time, row, values in zip(*columns, arrays["values"], strict=True):
            out.append((place, Measurement(time, sensor, values, row)))
    return [m for _, m in sorted(out, key=lambda pair: pair[0])]


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
        """Range of the time offset of a sensor, shape (K,) [s]; None where it is not estimated."""
        return self.lags.get(self.variable.get(sensor, ""))

    def assume(self, c: Array) -> None:
        """Renew the assumed time offsets by a calibration vector, shape (C,), within the assumed range."""
        for name, lag in self.lags.items():
            self.assumed[name] = float(np.clip(np.mean(c[LAYOUT[name]]), lag[0], lag[-1]))

    def off(self, calibration: Mapping[str, Array]) -> float:
        """How far the assumption lies from estimates, at most [s]."""
        return max((float(np.abs(calibration[n] - self.assumed[n]).mean()) for n in self.lags), default=0.0)

    def centred(self, calibration: Mapping[str, Array], reach: float) -> "TimeOffsets":
        """Time offsets near the estimate, shape (n, 1) or (1,) each, within ``reach`` [s]."""
        assumed = self.assumed | {name: float(np.mean(calibration[name])) for name in self.lags}
        lags = {name: around(assumed[name], reach + float(np.ptp(calibration[name]))) for name in self.lags}
        return TimeOffsets(self.variable, lags, assumed)


def around(middle: float, reach: float) -> Array:
    """Knots that cover what lies within ``reach`` of ``middle``, shape (K,)."""
    count = 2 + int(np.ceil(reach / KNOT_S))  # the rate's arcs need a knot more at either end
    return np.asarray(middle + KNOT_S * np.arange(-count, count + 1))
