"""The IMU's samples around the newest keyframe, and what is believed of their noise."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import gtsam
import numpy as np

from rovgraph.config import Config, mount_matrix
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.graph.noise_floor import NoiseFloor
from rovgraph.graph.preintegration import (
    BRIDGE_ACC,
    BRIDGE_GYR,
    KNOCK,
    Snapshot,
    preintegrate,
    preintegration_params,
    scatter,
)
from rovgraph.log import Measurement

HALF_WINDOW_S = 0.05  # around a time, over which the rate is averaged; measurements wait that long
ENOUGH_FOR_A_CURVE = 5  # samples in that window; a slower IMU is interpolated between two
GAP_PERIODS = 5.0  # an IMU silence of more sample periods than this is a gap
PERIODS = 50  # of samples, from whose median a gap is told
ROOM = 64  # samples, at first


class Samples:
    """Keeps samples in body axes and integrates them.

    Parameters
    ----------
    config : effective configuration
    learn_noise : raise the noise to what the newest samples show, where the log is not known as a whole

    Attributes
    ----------
    longest_step : between two samples that are no gap [s]
    params : of preintegration, with the noise that is believed
    """

    def __init__(self, config: Config, learn_noise: bool) -> None:
        self._config, self._learn_noise = config, learn_noise
        self._R_sb = mount_matrix(config.imu.mount_rpy_deg).T
        self._noise = np.array([config.imu.noise.acc, config.imu.noise.gyr])
        self._floor = NoiseFloor(self._noise)
        self.params = preintegration_params(config, *self._noise)
        self._bridge = preintegration_params(config, BRIDGE_ACC, BRIDGE_GYR)
        self._rows, self._count = np.empty((ROOM, 7)), 0
        self._periods: list[float] = []
        self.longest_step = np.inf

    def add(self, m: Measurement) -> bool:
        """Take a sample; times must not decrease.

        Returns
        -------
        bool : samples were missing before it

        Raises
        ------
        InputError : a gap longer than ``imu.max_gap_s``
        """
        missing = False
        if self._count:
            period = m.time - self.newest
            missing = period > self.longest_step
            if period > self._config.imu.max_gap_s:
                raise InputError(
                    f"row {m.row}: the IMU is silent for {period:.1f} s before {m.time:.3f} s, longer than "
                    f"imu.max_gap_s = {self._config.imu.max_gap_s:g}; split the log there or raise that key"
                )
            if len(self._periods) < PERIODS:
                self._periods.append(period)
                self.longest_step = GAP_PERIODS * float(np.median(self._periods))
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.empty_like(self._rows)])
        row = self._rows[self._count]
        row[0], row[1:] = m.time, self._in_body(m.values[:6])
        self._count += 1
        return missing

    @property
    def table(self) -> Array:
        """All that are kept, shape (m, 7): time, specific force, rate in body axes."""
        return self._rows[: self._count]

    @property
    def newest(self) -> float:
        """Time of the newest sample [s]; -inf where there is none."""
        return float(self._rows[self._count - 1, 0]) if self._count else -math.inf

    def forget(self, time: float, before: float) -> None:
        """Keep those that cover a time and what is up to ``before`` it [s]."""
        kept = covering(self.table, time, before).copy()
        self._rows[: len(kept)], self._count = kept, len(kept)

    def ahead(self, later: Sequence[Measurement], time: float, at_rest: Array) -> Array:
        """The table with samples that have not been taken; beyond the last one as if it stood still.

        Parameters
        ----------
        later : of the IMU
        time : to which it has to reach [s]
        at_rest : ndarray, shape (6,), signal at rest
        """
        rows = [self.table]
        if later:
            values = self._in_body(np.array([m.values[:6] for m in later]))
            rows.append(np.column_stack([[m.time for m in later], values]))
        if time - rows[-1][-1, 0] > self.longest_step:
            rows.append(np.concatenate([[time], at_rest])[None])
        return np.concatenate(rows)

    def gap(self, table: Array) -> float:
        """The longest time without samples that is longer than it should be, or 0 [s]."""
        longest = float(np.diff(table[:, 0]).max(initial=0.0))
        return longest if longest > self.longest_step else 0.0

    def integrated(
        self, table: Array, bias: Array, start: float, stops: Array, end: float, learn: bool
    ) -> tuple[gtsam.PreintegratedCombinedMeasurements, list[Snapshot], float]:
        """The motion from one time to another, that to every stop on the way, and the gap that was bridged [s].

        Parameters
        ----------
        table : ndarray, shape (m, 7), samples that cover it
        bias, start, stops, end : as `rovgraph.graph.preintegration.preintegrate` takes them
        learn : its samples tell of the noise
        """
        t = table[:, 0]
        gap_s = self.gap(table[max(int(t.searchsorted(start, side="right")) - 1, 0) : int(t.searchsorted(end)) + 1])
        params = self._bridge if gap_s else self._params_for(table) if learn else self.params
        return *preintegrate(params, bias, table, start, stops, end), gap_s

    def rate(self, table: Array, time: float) -> tuple[Array, float]:
        """Rate at a time, shape (3,), and the sd of its noise.

        A parabola through the samples around it. The lever arm turns the noise of
        the rate into velocity, and the derivative by the misalignment into knowledge
        that is not there, so a single sample would not do.
        """
        t = table[:, 0]
        first, last = t.searchsorted([time - HALF_WINDOW_S, time + HALF_WINDOW_S + 1e-9])
        degree = 2
        if last - first < ENOUGH_FOR_A_CURVE:
            degree = 1
            first = min(max(int(t.searchsorted(time, side="right")) - 1, 0), max(len(t) - 2, 0))
            last = first + 2
        t, rate = t[first:last] - time, table[first:last, 4:]
        step = float(t[-1] - t[0]) / max(len(t) - 1, 1)
        if len(t) < 2:
            return rate[0].copy(), float(self._noise[1])
        powers = np.vander(t / HALF_WINDOW_S, degree + 1)
        weights = np.linalg.solve(powers.T @ powers, powers.T)[-1]
        if step > self.longest_step:
            return weights @ rate, BRIDGE_GYR
        return weights @ rate, float(self._noise[1]) * math.sqrt(float(weights @ weights) / step)

    def copy(self) -> "Samples":
        """One that goes on by itself from here."""
        twin = copy(self)
        twin._rows, twin._floor, twin._periods = self._rows.copy(), self._floor.copy(), self._periods[:]
        return twin

    def state(self) -> dict[str, Any]:
        """Where it stands, as plain values and arrays."""
        return {"imu": self.table.copy(), "periods": list(self._periods), "floor": self._floor.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood."""
        self._rows, self._count = np.concatenate([state["imu"], np.empty((ROOM, 7))]), len(state["imu"])
        self._periods = list(state["periods"])
        self.longest_step = GAP_PERIODS * float(np.median(self._periods)) if self._periods else np.inf
        self._floor.restore(state["floor"])
        if self._learn_noise:
            self._raise(self._floor.densities())

    def _in_body(self, values: Array) -> Array:
        """Specific force and rate, shape (..., 6), from the IMU's axes to the body's."""
        return (values.reshape(-1, 3) @ self._R_sb).reshape(values.shape)

    def _params_for(self, table: Array) -> gtsam.PreintegrationCombinedParams:
        """The believed noise, or where a knock shakes the samples far more, what they show."""
        if len(table) < 3 or self.gap(table):
            return self.params
        odd = scatter(table[:, 0], table[:, 1:])
        if self._learn_noise:
            self._floor.take(odd)
            self._raise(self._floor.densities())
        seen = np.sqrt((odd**2).reshape(-1, 2, 3).mean(axis=(0, 2)))
        if (seen < KNOCK * self._noise).all():
            return self.params
        return preintegration_params(self._config, *np.maximum(seen, self._noise))

    def _raise(self, noise: Array) -> None:
        """Take other noise densities, where they differ enough to matter."""
        if np.abs(noise / self._noise - 1.0).max() > 0.05:
            self._noise, self.params = noise, preintegration_params(self._config, *noise)


def covering(table: Array, time: float, before: float = HALF_WINDOW_S) -> Array:
    """The samples that cover a time, what is up to ``before`` it [s], and all after it."""
    return table[max(int(np.searchsorted(table[:, 0], time - before, side="right")) - 1, 0) :]
