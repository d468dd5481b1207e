"""Two recordings of one motion: how well what one shows is explained by what the other shows, at any lag.

For a quantity y on clock A and the same one x on clock B, both as changes over a window,

    y(t) = c + b x(t + lag),

and for an IMU's acceleration a and rate w against a DVL's velocity v, with R from the DVL's axes to the IMU's and l the
DVL's arm from the IMU,

    a(t) = (R dv/dt + w x R v)(t + lag) - w' x l - w x (w x l).

The sums of these least-squares problems at all lags come from FFTs. R is then the best of a set of rotations that is
dense enough for any mounting at right angles, and any about the vertical, each with the arm that fits it best. In waves
the arm's part may be most of the motion: it counts for no lag.
"""

from dataclasses import dataclass
from itertools import chain
from typing import Protocol

import numpy as np

from rovgraph.check.lags import ORIENTATIONS, correlate
from rovgraph.geometry import Array, exp_rotation, skew
from rovgraph.interchange.motion import Acceleration, Motion, Signal

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
    """What is left unexplained at every lag.

    Attributes
    ----------
    lags : ndarray, shape (l,) [s]
    seconds : ndarray, shape (l,), that both recordings know
    total, error : ndarray, shape (l,), sums of squares before and after
    parameters : ndarray, shape (l, p), of the best fit
    """

    lags: Array
    seconds: Array
    total: Array
    error: Array
    parameters: Array


class Comparison(Protocol):
    """One quantity, as two recordings show it."""

    @property
    def window(self) -> float:
        """Over which changes are taken [s]."""

    @property
    def name(self) -> str:
        """What is compared."""

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
        """What clock A shows at its times (n,), NaN where not known: shape (n, m), and for `regressors`, (n, k)."""

    def regressors(self, shown: Array, others: Array) -> Array:
        """What the parameters (p,) are multiplied by, at times of clock B, shape (n, m, p).

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

    a: Signal
    b: Signal
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
    velocity: Signal
    way: Signal
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
        own = _correlate(known, _products(dv, dv)).reshape(-1, 3, 3)
        mixed = _correlate(G, _products(dv, v)).reshape(-1, 3, 3, 3, 3)
        turned = _correlate(np.einsum("til,tim->tlm", G, G), _products(v, v)).reshape(-1, 3, 3, 3, 3)
        normal = np.einsum("lm,tkn->tlkmn", np.eye(3), own) + np.einsum("tlmkn->tlkmn", mixed + turned)
        normal = (normal + np.einsum("tmlnk->tlkmn", mixed)).reshape(-1, 81)
        right = _correlate(a, dv) + _correlate(np.einsum("til,ti->tl", G, a), v)
        # and those of the arm's part Y l, which clock A alone knows, with what it explains without the DVL
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


def comparisons(a: Motion, b: Motion) -> list[tuple[Comparison, float]]:
    """All quantities that both show; with -1 where the roles are exchanged, so that a lag has to change its sign."""
    out: list[tuple[Comparison, float]] = [
        (Changes(x, y), 1.0) for kind in ("turning", "depth", "speed") for x in a.of(kind) for y in b.of(kind)
    ]
    for one, other, sign in ((a, b, 1.0), (b, a, -1.0)):
        for velocity, way in zip(other.of("velocity"), other.of("way"), strict=True):
            if one.acceleration is not None:
                out.append((Accelerations(one.acceleration, velocity, way), sign))
    return out


def coarse_step(comparison: Comparison) -> float:
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
