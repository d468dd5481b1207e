"""The IMU's samples around the newest keyframe, and what is believed of their noise."""

import math
from collections.abc import Mapping, Sequence
from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.config import Config, mount_matrix
from rovgraph.engine.motion import Motion, in_body
from rovgraph.engine.noise_floor import NoiseFloor
from rovgraph.engine.preintegration import (
    KNOCK,
    PreintegrationParams,
    integrate_motion,
    preintegration_params,
)
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.kernels.coasting import BRIDGE_ACC, BRIDGE_GYR
from rovgraph.kernels.imu_samples import fit_rates, mean_signals, survey
from rovgraph.log import Measurement

Index = NDArray[np.int64]

HALF_WINDOW_S = 0.05  # around a time, over which the rate is averaged; measurements wait that long
ENOUGH_FOR_A_CURVE = 5  # samples in that window; a slower IMU is interpolated between two
GAP_PERIODS = 5.0  # an IMU silence of more sample periods than this is a gap
PERIODS = 50  # of samples, from whose median a gap is told
ROOM = 256  # samples, in a buffer
MEAN_OF = 21  # times of an interval, in a mean over it


class Samples:
    """Keeps samples in body axes and integrates them.

    Parameters
    ----------
    config : effective configuration
    learn_noise : raise the noise to what the newest samples show, where the log is not known as a whole

    Attributes
    ----------
    longest_step : between two samples that are no gap [s]
    newest : time of the newest sample [s]; -inf where there is none
    params : of preintegration, with the noise that is believed
    """

    def __init__(self, config: Config, learn_noise: bool) -> None:
        self._config, self._learn_noise = config, learn_noise
        self._max_gap_s = config.imu.max_gap_s
        self._R_sb = mount_matrix(config.imu.mount_rpy_deg).T
        self._noise = config.imu.noise.acc, config.imu.noise.gyr
        self._floor = NoiseFloor(np.array(self._noise))
        self.params = preintegration_params(config, *self._noise)
        self._bridge = preintegration_params(config, BRIDGE_ACC, BRIDGE_GYR)
        self._rows, self._first, self._last = np.empty((ROOM, 7)), 0, 0  # motions hold views of rows: write only once
        self._fresh: list[Measurement] = []  # that have no row yet
        self.newest = -math.inf
        self._periods: list[float] = []
        self.longest_step = math.inf

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
        if self.newest > -math.inf:
            period = m.time - self.newest
            missing = period > self.longest_step
            if period > self._max_gap_s:
                raise too_long(self._config, period, m.time, m.row)
            if len(self._periods) < PERIODS:
                self._take_period(period)
        self._fresh.append(m)
        self.newest = m.time
        return missing

    @property
    def table(self) -> Array:
        """All that are kept, shape (m, 7): time, specific force, rate in body axes."""
        if self._fresh:
            self._append(self._fresh)
            self._fresh = []
        return self._rows[self._first : self._last]

    def forget(self, time: float, before: float) -> None:
        """Keep those that cover a time and what is up to ``before`` it [s]."""
        self._first += first_covering(self.table, time, before)

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
            rows.append(self._in_body(later))
        if time - rows[-1][-1, 0] > self.longest_step:
            rows.append(np.concatenate([[time], at_rest])[None])
        return np.concatenate(rows)

    def gap(self, table: Array) -> float:
        """The longest time without samples that is longer than it should be, or 0 [s]."""
        longest = float(np.diff(table[:, 0]).max(initial=0.0))
        return longest if longest > self.longest_step else 0.0

    def integrated(
        self, table: Array, bias: Array, start: float, stops: Array, end: float, learn: bool
    ) -> tuple[Motion, Array]:
        """The motion from one time to another, and that to every stop on the way, shape (k, SNAPSHOT).

        Parameters
        ----------
        table : ndarray, shape (m, 7), samples that cover it
        bias, start, stops, end : as `rovgraph.engine.preintegration.preintegrate` takes them
        learn : its samples tell of the noise
        """
        longest, within, *shown = surveyed(table, *whole(table), np.array([start]), np.array([end]))[0].tolist()
        if within > self.longest_step:
            return integrate_motion(self._bridge, bias, table, start, stops, end, within)
        params = self.params
        if learn and len(table) >= 3 and longest <= self.longest_step:
            params = self._params_for(table, shown)
        return integrate_motion(params, bias, table, start, stops, end, 0.0)

    def rate(self, table: Array, time: float) -> tuple[Array, float]:
        """Rate at a time, shape (3,), and the sd of its noise.

        A parabola through the samples around it. The lever arm turns the noise of
        the rate into velocity, and the derivative by the misalignment into knowledge
        that is not there, so a single sample would not do.
        """
        rate, sd = rates(table, *whole(table), np.array([time]), np.array([self.longest_step]), self._noise[1])
        return rate[0], float(sd[0])

    def mean(self, table: Array, begin: float, end: float) -> Array:
        """Mean specific force and rate over a time, shape (6,)."""
        return np.asarray(means(table, *whole(table), np.array([begin]), np.array([end]))[0])

    def copy(self) -> "Samples":
        """One that goes on by itself from here."""
        twin = copy(self)
        twin._rows, twin._first, twin._last = self.table, 0, len(self.table)  # full: the next sample goes elsewhere
        twin._fresh = []
        twin._floor, twin._periods = self._floor.copy(), self._periods[:]
        return twin

    def state(self) -> dict[str, Any]:
        """Where it stands, as plain values and arrays."""
        return {"imu": self.table.copy(), "periods": list(self._periods), "floor": self._floor.state()}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood."""
        self._rows, self._first, self._last = np.ascontiguousarray(state["imu"]), 0, len(state["imu"])
        self._fresh, self.newest = [], float(self._rows[-1, 0]) if self._last else -math.inf
        self._periods = list(state["periods"])
        self.longest_step = longest_regular(self._periods)
        self._floor.restore(state["floor"])
        if self._learn_noise:
            self._raise(*self._floor.densities().tolist())

    def _take_period(self, period: float) -> None:
        self._periods.append(period)
        self.longest_step = longest_regular(self._periods)

    def _append(self, samples: Sequence[Measurement]) -> None:
        """Give samples rows: all of an interval at once."""
        if self._last + len(samples) > len(self._rows):
            kept = self._rows[self._first : self._last]
            self._rows = np.empty((len(kept) + len(samples) + ROOM, 7))
            self._rows[: len(kept)], self._first, self._last = kept, 0, len(kept)
        last = self._last + len(samples)
        self._rows[self._last : last] = self._in_body(samples)
        self._last = last

    def _in_body(self, samples: Sequence[Measurement]) -> Array:
        """Rows of samples, shape (n, 7)."""
        rows = np.empty((len(samples), 7))
        rows[:, 0] = [m.time for m in samples]
        rows[:, 1:] = in_body(np.array([m.values[:6] for m in samples]), self._R_sb)
        return rows

    def _params_for(self, table: Array, shown: Sequence[float]) -> PreintegrationParams:
        """The believed noise, or where a knock shakes the samples far more, what they show."""
        if self._learn_noise:
            self._floor.take(table)
            self._raise(*self._floor.densities().tolist())
        acc, gyr = self._noise
        if not knocked(np.array(shown), self._noise):
            return self.params
        return preintegration_params(self._config, max(shown[0], acc), max(shown[1], gyr))

    def _raise(self, acc: float, gyr: float) -> None:
        """Take other noise densities, where they differ enough to matter."""
        if max(abs(acc / self._noise[0] - 1.0), abs(gyr / self._noise[1] - 1.0)) > 0.05:
            self._noise, self.params = (acc, gyr), preintegration_params(self._config, acc, gyr)


def longest_regular(periods: Sequence[float]) -> float:
    """Step between two samples that is no gap, by the first periods of a log [s]."""
    return GAP_PERIODS * float(np.median(periods)) if len(periods) else math.inf


def too_long(config: Config, period: float, time: float, row: int) -> InputError:
    """A gap before a sample that cannot be bridged."""
    return InputError(
        f"row {row}: the IMU is silent for {period:.1f} s before {time:.3f} s, longer than "
        f"imu.max_gap_s = {config.imu.max_gap_s:g}; split the log there or raise that key"
    )


def knocked(shown: Array, noise: tuple[float, float]) -> NDArray[np.bool_]:
    """Whether samples scatter so much, shape (..., 2), that they tell of a knock; ``noise`` is what is believed."""
    return np.asarray((shown >= KNOCK * np.array(noise)).any(axis=-1))


# of n times or intervals; each has its samples in a table, from ``first`` to before ``last``, shape (n,)


def whole(table: Array) -> tuple[Index, Index]:
    """All of a table, for one interval."""
    return np.zeros(1, np.int64), np.array([len(table)])


def surveyed(table: Array, first: Index, last: Index, start: Array, end: Array) -> Array:
    """Gaps and scatter of n intervals, shape (n, 4), of `rovgraph.kernels.imu_samples.survey`."""
    found = np.empty((len(start), 4))
    survey(table, first, last, start, end, found)
    return found


def rates(
    table: Array, first: Index, last: Index, time: Array, longest_step: Array, density: float
) -> tuple[Array, Array]:
    """Rate at n times, shape (n, 3), and the sd of its noise, shape (n,) [rad/s].

    Parameters
    ----------
    longest_step : shape (n,), step between two samples that is no gap [s]
    density : of the gyro's noise [rad/s/rtHz]
    """
    rate, fit = np.empty((len(time), 3)), np.empty((len(time), 2))
    fit_rates(table, first, last, time, HALF_WINDOW_S, ENOUGH_FOR_A_CURVE, rate, fit)
    step, share = fit.T
    sd = density * np.sqrt(share / np.where(step > 0.0, step, 1.0))
    return rate, np.where(step > longest_step, BRIDGE_GYR, sd)


def means(table: Array, first: Index, last: Index, begin: Array, end: Array) -> Array:
    """Mean specific force and rate over n times, shape (n, 6)."""
    mean = np.empty((len(begin), 6))
    mean_signals(table, first, last, begin, end, MEAN_OF, mean)
    return mean


def first_covering(table: Array, time: float, before: float = HALF_WINDOW_S) -> int:
    """Index of the first of those samples that cover a time and what is up to ``before`` it [s]."""
    return max(int(table[:, 0].searchsorted(time - before, side="right")) - 1, 0)


def covering(table: Array, time: float) -> Array:
    """The samples that cover a time, what is up to half a window before it, and all after it."""
    return table[first_covering(table, time) :]
