"""Lag search between two recordings of one motion: how well one explains the other, at any lag.

For a quantity y on clock A and the same one x on clock B, both as changes over a window,

    y(t) = c + b x(t + lag),

and for an IMU's acceleration a and rate w against a DVL's velocity v, with R from the DVL's axes to the IMU's and l the
DVL's arm from the IMU,

    a(t) = (R dv/dt + w x R v)(t + lag) - w' x l - w x (w x l).

The sums of these least-squares problems at all lags come from FFTs. R is then the best of a set of rotations that is
dense enough for any mounting at right angles, and any about the vertical, each with the arm that fits it best. In waves
the arm's part may be most of the motion: it is not counted in favour of a lag.

The quantities compared need no mounting: turning about the vertical, depth, speed, the velocity along a DVL's own axes,
and the IMU's acceleration without gravity along its own axes. Integrated quantities are compared by their changes over
a window, so that biases and constant offsets drop out.
"""

from dataclasses import dataclass
from itertools import chain
from typing import Literal, Protocol

import numpy as np

from rovgraph.diagnosis.check.findings import valid_pings
from rovgraph.diagnosis.check.inertial import InertialMotion, inertial_motion
from rovgraph.diagnosis.check.lags import ORIENTATIONS, correlate
from rovgraph.geometry import Array, exp_rotation, skew
from rovgraph.log import Log
from rovgraph.log.streams import GAP_PERIODS, integral
from rovgraph.model.config import Config

Kind = Literal["turning", "depth", "speed", "velocity", "way"]
WINDOW = 1.0  # shortest over which changes are compared [s]
WINDOW_PERIODS = 3.0
FIX_WINDOW = 20.0  # over which fixes show a speed [s]
ENOUGH = 20  # measurements of a signal


@dataclass(frozen=True)
class MotionSignal:
    """An integrated quantity.

    Attributes
    ----------
    kind : what changes: "turning" a heading [rad], "depth", a DVL's by its z axis [m], "speed" a distance [m],
        "velocity" along a DVL's axes [m/s], "way" its integral [m]
    sensor : that shows it
    time : ndarray, shape (n,), increasing [s]
    value : ndarray, shape (n, k)
    window : shortest over which its changes stand out [s]
    chord : the length of the change is what counts
    """

    kind: Kind
    sensor: str
    time: Array
    value: Array
    window: float
    chord: bool = False

    def changes(self, times: Array, window: float) -> Array:
        """Change over a window around each time, NaN where it is not known; shape (len(times), k), k = 1 of a chord."""
        period = float(np.median(np.diff(self.time)))
        longest = max(GAP_PERIODS * period, 0.5)
        gaps = np.concatenate([[0], np.cumsum(np.diff(self.time) > longest)])
        begin, end = times - 0.5 * window, times + 0.5 * window
        first = np.searchsorted(self.time, begin, side="right") - 1
        last = np.searchsorted(self.time, end)
        inside = (first >= 0) & (last < len(self.time))
        whole = gaps[last.clip(max=len(self.time) - 1)] == gaps[first.clip(min=0)]
        change = self._at(end) - self._at(begin)
        change = np.linalg.norm(change, axis=1, keepdims=True) if self.chord else change
        return np.where((inside & whole)[:, None], change, np.nan)

    def _at(self, times: Array) -> Array:
        return np.column_stack([np.interp(times, self.time, column) for column in self.value.T])


@dataclass(frozen=True)
class Acceleration:
    """An IMU's acceleration without gravity, along its own axes.

    Attributes
    ----------
    motion : on even times
    """

    motion: InertialMotion

    @property
    def time(self) -> Array:
        return self.motion.time

    def means(self, times: Array, window: float) -> tuple[Array, Array, Array]:
        """Means over a window around each time, NaN where not known, shape (n, 3) each.

        Returns
        -------
        acceleration [m/s^2], rate [rad/s], rate's change per second [rad/s^2]
        """
        motion, half = self.motion, 0.5 * window
        edges = np.concatenate([motion.time - 0.5 * motion.step, motion.time[-1:] + 0.5 * motion.step])
        held = np.column_stack([motion.acceleration_b, motion.rate_b, ~motion.known])
        sums = np.vstack([np.zeros(7), np.cumsum(held * motion.step, axis=0)])
        begin, end = (np.column_stack([np.interp(t, edges, c) for c in sums.T]) for t in (times - half, times + half))
        mean = (end - begin) / window
        inside = (times - half >= edges[0]) & (times + half <= edges[-1]) & (mean[:, 6] < 1e-6)
        ends = [
            np.column_stack([np.interp(t, motion.time, c) for c in motion.rate_b.T])
            for t in (times - half, times + half)
        ]
        mean = np.where(inside[:, None], mean, np.nan)
        return mean[:, :3], mean[:, 3:6], (ends[1] - ends[0]) / window


@dataclass(frozen=True)
class MotionSignals:
    """All signals of a log.

    Attributes
    ----------
    signals : of sensors that are there for long enough
    acceleration : None without an IMU
    """

    signals: tuple[MotionSignal, ...]
    acceleration: Acceleration | None

    def of(self, kind: Kind) -> list[MotionSignal]:
        return [signal for signal in self.signals if signal.kind == kind]


def motion_of(log: Log) -> MotionSignals:
    """Motion by the sensors of a log, each along its own axes."""
    signals = []
    inertial = inertial_motion(log, Config())
    if inertial is not None:
        turned = (np.cumsum(inertial.turning) - 0.5 * inertial.turning) * inertial.step
        turned = turned[inertial.known]
        signals.append(_signal("turning", "imu", inertial.time[inertial.known], turned))
    for sensor, column in (("ahrs", "ahrs_yaw"), ("dvl_heading", "dvl_heading")):
        if sensor in log:
            signals.append(_signal("turning", sensor, log[sensor].time, np.unwrap(log[sensor][column])))
    if "depth" in log:
        signals.append(_signal("depth", "depth", log["depth"].time, log["depth"]["depth"]))
    pings = valid_pings(log["dvl"]) if "dvl" in log else None
    if pings is not None and len(pings) >= ENOUGH:
        way = [integral(pings.time, column) for column in pings.data[:, :3].T]
        signals.append(_signal("velocity", "dvl", pings.time, pings.data[:, :3]))
        signals.append(_signal("way", "dvl", pings.time, np.column_stack(way)))
        signals.append(_signal("depth", "dvl", pings.time, way[2]))
        path = integral(pings.time, np.linalg.norm(pings.data[:, :3], axis=1))
        signals.append(_signal("speed", "dvl", pings.time, path))
    if "fix" in log:
        fix = log["fix"]
        signals.append(_signal("speed", "fix", fix.time, fix.data[:, :2], FIX_WINDOW, chord=True))
    enough = tuple(signal for signal in signals if len(signal.time) >= ENOUGH)
    return MotionSignals(enough, None if inertial is None else Acceleration(inertial))


def _signal(
    kind: Kind, sensor: str, time: Array, value: Array, window: float = WINDOW, chord: bool = False
) -> MotionSignal:
    period = float(np.median(np.diff(time))) if len(time) > 1 else np.inf
    columns = value if value.ndim == 2 else value[:, None]
    return MotionSignal(kind, sensor, time, columns, max(window, WINDOW_PERIODS * period), chord)


MOST_SAMPLES = 20_000  # of a recording that are searched; longer ones are sampled more coarsely
STEPS = 4  # of a window
TURNS = np.deg2rad(np.arange(0.0, 90.0, 15.0))  # about the vertical, between right angles
FLOOR_S = {"turning": 0.03, "depth": 0.05, "speed": 0.1}  # least sd of a lag [s]
COMPASSES, COMPASS_S = {"ahrs", "dvl_heading"}, 0.3  # a compass that is filtered slowly comes late [s]
ARM_SD = 0.5  # [m]
RIDGE, TINY = 1e-3, 1e-9  # of an arm's information, that it is known where nothing turns
ARM_INFORMATION = np.array([0.0, 0.0, 0.0, *[ARM_SD**-2] * 3])


@dataclass(frozen=True)
class Sums:
    """Sums of the unexplained squares at every lag.

    Attributes
    ----------
    lags : ndarray, shape (l,) [s]
    seconds : ndarray, shape (l,), that both recordings cover
    total, error : ndarray, shape (l,), sums of squares before and after
    parameters : ndarray, shape (l, p), of the best fit
    """

    lags: Array
    seconds: Array
    total: Array
    error: Array
    parameters: Array


class SignalPair(Protocol):
    """One quantity, as two recordings show it."""

    @property
    def window(self) -> float:
        """Over which changes are taken [s]."""

    @property
    def name(self) -> str:
        """Name of the compared quantity."""

    @property
    def spans(self) -> tuple[Array, Array]:
        """First and last time of both recordings, each shape (2,) [s]."""

    @property
    def floor_s(self) -> float:
        """Least sd of a lag: sensors filter, and no mounting is exact [s]."""

    @property
    def information(self) -> Array:
        """Of the priors of what a step changes, shape (q,)."""

    def search(self, step: float) -> Sums:
        """Every lag that leaves an overlap."""

    def observed(self, times: Array) -> tuple[Array, Array]:
        """Values on clock A at its times (n,), NaN where not known: shape (n, m), and for `regressors`, (n, k)."""

    def regressors(self, shown: Array, others: Array) -> Array:
        """Regressors, multiplied by the parameters (p,), at times of clock B, shape (n, m, p).

        Parameters
        ----------
        shown : the second result of `observed`
        """

    def tangent(self, parameters: Array) -> Array:
        """Change of the parameters per unit of a step, shape (p, q)."""

    def moved(self, parameters: Array, step: Array) -> Array:
        """The parameters after a step (q,), shape (p,)."""


@dataclass(frozen=True)
class Changes:
    """Changes of one quantity by two sensors; the parameters are c and b."""

    a: MotionSignal
    b: MotionSignal
    information = np.zeros(2)

    @property
    def floor_s(self) -> float:
        return COMPASS_S if {self.a.sensor, self.b.sensor} & COMPASSES else FLOOR_S[self.a.kind]

    @property
    def window(self) -> float:
        return max(self.a.window, self.b.window)

    @property
    def name(self) -> str:
        return f"{self.a.kind} by {self.a.sensor} and {self.b.sensor}"

    @property
    def spans(self) -> tuple[Array, Array]:
        return self.a.time[[0, -1]], self.b.time[[0, -1]]

    def search(self, step: float) -> Sums:
        grids = [np.arange(s.time[0], s.time[-1], step) for s in (self.a, self.b)]
        (y, ya), (x, xb) = (_masked(s.changes(t, self.window)) for s, t in zip((self.a, self.b), grids, strict=True))
        n, sx, sxx = _correlate(ya, np.column_stack([xb, x, x**2])).T
        sy, sxy = _correlate(y, np.column_stack([xb, x])).T
        syy = _correlate(y**2, xb)[:, 0]
        count = np.maximum(n, 1.0)
        total = np.maximum(syy - sy**2 / count, 1e-12)
        spread = np.maximum(sxx - sx**2 / count, 1e-12)
        b = (sxy - sx * sy / count) / spread
        error = np.clip(total - b**2 * spread, 1e-9 * total, None)
        return Sums(_lags(grids), n * step, total, error, np.column_stack([(sy - b * sx) / count, b]))

    def observed(self, times: Array) -> tuple[Array, Array]:
        return self.a.changes(times, self.window), np.empty((len(times), 0))

    def regressors(self, shown: Array, others: Array) -> Array:
        x = self.b.changes(others, self.window)
        return np.concatenate([np.ones_like(x), x], axis=1)[:, None]

    def tangent(self, parameters: Array) -> Array:
        return np.eye(2)

    def moved(self, parameters: Array, step: Array) -> Array:
        return parameters + step


@dataclass(frozen=True)
class Accelerations:
    """An IMU's acceleration against a DVL's; the parameters are R, row by row, and l.

    A free scale would go to zero at a wrong lag, where the IMU's own rates and an arm explain most of the motion.
    """

    a: Acceleration
    velocity: MotionSignal
    way: MotionSignal
    information = ARM_INFORMATION
    floor_s = 0.01

    @property
    def window(self) -> float:
        return self.velocity.window

    @property
    def name(self) -> str:
        return "acceleration by imu and dvl"

    @property
    def spans(self) -> tuple[Array, Array]:
        return self.a.motion.time[[0, -1]], self.velocity.time[[0, -1]]

    def search(self, step: float) -> Sums:
        grids = [np.arange(span[0], span[1], step) for span in self.spans]
        both, known = _masked(np.column_stack(self.a.means(grids[0], self.window)))
        a, G = both[:, :3], skew(both[:, 3:6])
        moved, seen = _masked(np.column_stack(self._moved(grids[1])))
        dv, v = moved[:, :3], moved[:, 3:]
        # d a_i / d M_lk = delta_il dv_k + G_il v_k, of which these are the sums of products
        squared = _correlate(known, _products(dv, dv)).reshape(-1, 3, 3)
        mixed = _correlate(G, _products(dv, v)).reshape(-1, 3, 3, 3, 3)
        turned = _correlate(np.einsum("til,tim->tlm", G, G), _products(v, v)).reshape(-1, 3, 3, 3, 3)
        normal = np.einsum("lm,tkn->tlkmn", np.eye(3), squared) + np.einsum("tlmkn->tlkmn", mixed + turned)
        normal = (normal + np.einsum("tmlnk->tlkmn", mixed)).reshape(-1, 81)
        right = _correlate(a, dv) + _correlate(np.einsum("til,ti->tl", G, a), v)
        # and those of the arm's part Y l, which only clock A has, with what it explains without the DVL
        Y = _by_arm(both[:, 3:6], both[:, 6:9])
        information = _correlate(np.einsum("tij,tik->tjk", Y, Y), seen).reshape(-1, 3, 3)
        ridge = RIDGE * np.trace(information, axis1=1, axis2=2) + TINY
        covariance = np.linalg.inv(information + ridge[:, None, None] * np.eye(3))
        crossed = _correlate(np.einsum("tlj->tjl", Y), dv) + _correlate(np.einsum("tij,til->tjl", Y, G), v)
        crossed = crossed.reshape(-1, 3, 9)
        alone = _correlate(np.einsum("tij,ti->tj", Y, a), seen)
        total = _correlate(np.sum(a**2, axis=1), seen)[:, 0]
        M = _rotations().reshape(-1, 9)
        errors = total[:, None] + normal @ _products(M, M).reshape(-1, 81).T - 2.0 * right @ M.T
        for k, rotation in enumerate(M):
            errors[:, k] -= _explained(alone - crossed @ rotation, covariance)
        total = np.maximum(total - _explained(alone, covariance), 1e-12)
        best = np.argmin(errors, axis=1)
        error = np.clip(errors[np.arange(len(best)), best], 1e-9 * total, None)
        arm = np.einsum("tij,tj->ti", covariance, alone - np.einsum("tjk,tk->tj", crossed, M[best]))
        seconds = _correlate(known, seen)[:, 0] * step
        return Sums(_lags(grids), seconds, total, error, np.column_stack([M[best], arm]))

    def observed(self, times: Array) -> tuple[Array, Array]:
        a, w, spin = self.a.means(times, self.window)
        return a, np.hstack([w, spin])

    def regressors(self, shown: Array, others: Array) -> Array:
        dv, v = self._moved(others)
        by_M = np.einsum("il,tk->tilk", np.eye(3), dv) + np.einsum("til,tk->tilk", skew(shown[:, :3]), v)
        return np.concatenate([by_M.reshape(-1, 3, 9), _by_arm(shown[:, :3], shown[:, 3:])], axis=2)

    def tangent(self, parameters: Array) -> Array:
        M = parameters[:9].reshape(3, 3)
        out = np.zeros((12, 6))
        out[:9, :3] = np.column_stack([(skew(axis) @ M).ravel() for axis in np.eye(3)])
        out[9:, 3:] = np.eye(3)
        return out

    def moved(self, parameters: Array, step: Array) -> Array:
        M = exp_rotation(step[:3]) @ parameters[:9].reshape(3, 3)
        return np.concatenate([M.ravel(), parameters[9:] + step[3:]])

    def _moved(self, times: Array) -> tuple[Array, Array]:
        """Mean acceleration and velocity along the DVL's axes around each time, shape (n, 3) each."""
        dv, way = (signal.changes(times, self.window) for signal in (self.velocity, self.way))
        return dv / self.window, way / self.window


def comparisons(a: MotionSignals, b: MotionSignals) -> list[tuple[SignalPair, float]]:
    """All quantities that both show; with -1 where the roles are exchanged, so that a lag has to change its sign."""
    out: list[tuple[SignalPair, float]] = [
        (Changes(x, y), 1.0) for kind in ("turning", "depth", "speed") for x in a.of(kind) for y in b.of(kind)
    ]
    for one, other, sign in ((a, b, 1.0), (b, a, -1.0)):
        for velocity, way in zip(other.of("velocity"), other.of("way"), strict=True):
            if one.acceleration is not None:
                out.append((Accelerations(one.acceleration, velocity, way), sign))
    return out


def coarse_step(comparison: SignalPair) -> float:
    """Of the times at which lags are searched for [s]."""
    longest = max(float(np.ptp(span)) for span in chain(comparison.spans))
    return max(comparison.window / STEPS, longest / MOST_SAMPLES)


def _explained(sums: Array, covariance: Array) -> Array:
    """What the arm (3,) explains of the squares at every lag, of its sums (l, 3) and inverse information (l, 3, 3)."""
    return np.asarray(np.einsum("ti,tij,tj->t", sums, covariance, sums))


def _by_arm(rate: Array, spin: Array) -> Array:
    """What an arm is multiplied by to give an acceleration, of rates w and their changes w' (n, 3), shape (n, 3, 3)."""
    G = skew(rate)
    return np.asarray(-skew(spin) - G @ G)


def _rotations() -> Array:
    """Rotations from a DVL's axes to an IMU's: right angles, and any turn about the DVL's z axis; shape (k, 3, 3)."""
    right = ORIENTATIONS[np.linalg.det(ORIENTATIONS) > 0.0]
    about_z = exp_rotation(np.column_stack([np.zeros((len(TURNS), 2)), TURNS]))
    return np.asarray((right[:, None] @ about_z).reshape(-1, 3, 3))


def _lags(grids: list[Array]) -> Array:
    """Of the sums that `_correlate` makes of two grids of one step."""
    (a, b), step = grids, float(grids[0][1] - grids[0][0])
    return np.asarray(b[0] - a[0] + step * np.arange(1 - len(a), len(b)))


def _masked(values: Array) -> tuple[Array, Array]:
    """Values (n, k) with zeros where any is not known, and where they are, shape (n, 1), 1 or 0."""
    known = np.isfinite(values).all(axis=1, keepdims=True)
    return np.where(known, values, 0.0), known.astype(float)


def _products(a: Array, b: Array) -> Array:
    """Of all components of (n, i) and (n, j), shape (n, i * j)."""
    return (a[:, :, None] * b[:, None]).reshape(len(a), -1)


def _correlate(a: Array, b: Array) -> Array:
    """Sums over t of a_i(t) b_j(t + lag) for (n, ...) and (m, ...), lags from 1 - n to m - 1; shape (lags, i * j)."""
    sums = correlate(a.reshape(len(a), -1), b.reshape(len(b), -1), 1 - len(a), len(b) - 1)
    return np.ascontiguousarray(sums.reshape(-1, sums.shape[-1]).T)
