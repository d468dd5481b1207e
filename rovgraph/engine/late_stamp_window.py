"""The IMU's motion around a stamp that may be late: along it a measurement is placed.

An instrument whose stamps are late by tau measured at stamp - tau. A derivative by time would
do for an offset that is small against the motion; half a second is not. So the motion from the
keyframe is kept at knots around the stamp, as far as the prior of tau reaches, and
interpolated: rotation along its geodesic, velocity and position linearly. Predictions are exact
for any tau, in the smoother and in filters alike.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.motion import Snapshot
from rovgraph.engine.preintegration import PreintegrationParams, integrate_motion
from rovgraph.geometry import Array, exp_rotation, log_rotation, rotate, transpose
from rovgraph.instruments import Instrument
from rovgraph.state import BIAS, POSE, VELOCITY, Delta, Jacobians, State

KNOT_S = 0.02  # at 3 m/s3, the jerk of gravity in a turning body, velocity is interpolated within 0.2 mm/s
HALF_WINDOW_S = 0.1  # around a knot, over which the rate is taken; the less noise there is in its slope the better


@dataclass(frozen=True)
class LateStampWindow:
    """Motion from a keyframe to times around each of n stamps, K of them.

    Attributes
    ----------
    lag : ndarray, shape (n, K), how long before the stamp, ascending by `KNOT_S` [s]
    dt : ndarray, shape (n, K), from the keyframe, negative before it [s]
    dR : ndarray, shape (n, K, 3, 3)
    dv, dp : ndarray, shape (n, K, 3) [m/s, m]
    rate_b : ndarray, shape (n, K, 3), measured rate, bias still in it [rad/s]
    bias : ndarray, shape (n, 6), that the motion was integrated with
    """

    lag: Array
    dt: Array
    dR: Array
    dv: Array
    dp: Array
    rate_b: Array
    bias: Array

    @staticmethod
    def of(keyframe: Array, knots: Array, lag: Array, rate_b: Array, bias: Array) -> "LateStampWindow":
        """The window of one stamp, from snapshots, shape (16,) and (K, 16), that begin at one time before them all."""
        i, own = Snapshot.of(keyframe), knots - keyframe
        dt, dR = own[:, 0], i.dR.T @ knots[:, 1:10].reshape(-1, 3, 3)
        dv, dp = own[:, 10:13], own[:, 13:16] - dt[:, None] * i.dv
        dv, dp = dv @ i.dR, dp @ i.dR  # into the keyframe's axes
        return LateStampWindow(*(a[None] for a in (lag, dt, dR, dv, dp, rate_b, bias)))

    @staticmethod
    def stack(windows: Sequence["LateStampWindow"]) -> "LateStampWindow":
        """Many windows as one."""
        return LateStampWindow(
            *(np.concatenate([getattr(t, f.name) for t in windows]) for f in fields(LateStampWindow))
        )

    def at(self, index: slice | Array) -> "LateStampWindow":
        """Some of the windows."""
        return LateStampWindow(*(getattr(self, f.name)[index] for f in fields(self)))

    def placed(self, late: Array) -> tuple[Delta, Array]:
        """Motion to where measurements were valid, and the rate there.

        Parameters
        ----------
        late : ndarray, shape (n,), how late the stamps are [s]

        Returns
        -------
        motion : Delta, n
        rate_b : ndarray, shape (n, 3) [rad/s]
        """
        n, k, x = self._knot(late)
        dv, dp = ((1.0 - x) * a[n, k] + x * a[n, k + 1] for a in (self.dv, self.dp))
        dt = self.dt[n, k] * (1.0 - x[:, 0]) + self.dt[n, k + 1] * x[:, 0]
        dR = self.dR[n, k] @ exp_rotation(x * self._turn(n, k))
        return Delta(dt, dR, dv, dp, self.bias), self._rate(n, k, x)[0]

    def by_time_offset(self, late: Array, before: State, there: State, H: Jacobians, gravity: float) -> Array:
        """Derivative of predicted measurements by how late their stamps are.

        Parameters
        ----------
        late : ndarray, shape (n,) [s]
        before, there : State of the keyframes, and where the measurements were valid
        H : Jacobians of the measurements by the state ``there``
        gravity : [m/s^2]

        Returns
        -------
        ndarray, shape (n, dim, 1)
        """
        n, k, x = self._knot(late)
        force, velocity = ((a[n, k + 1] - a[n, k]) / KNOT_S for a in (self.dv, self.dp))
        dt = self.dt[n, k] + (self.dt[n, k + 1] - self.dt[n, k]) * x[:, 0]
        excess = before.bias - self.bias
        own = exp_rotation(dt[:, None] * excess[:, 3:])  # back over the turn that the bias adds
        turn = rotate(own, self._turn(n, k) / KNOT_S) + excess[:, 3:]
        v_n = rotate(before.R_nb, force + excess[:, :3])
        p_n = -before.v_n + rotate(before.R_nb, velocity + dt[:, None] * excess[:, :3])
        v_n[:, 2] -= gravity
        p_n[:, 2] -= gravity * dt
        moved = np.concatenate([turn, rotate(transpose(there.R_nb), p_n)], axis=-1)
        out = rotate(H[POSE], moved)
        if VELOCITY in H:
            out += rotate(H[VELOCITY], v_n)
        if BIAS in H:  # the rate enters less its bias
            out -= rotate(H[BIAS][..., 3:], self._rate(n, k, x)[1])
        return np.asarray(out[..., None])

    def _rate(self, n: NDArray[np.int64], k: NDArray[np.int64], x: Array) -> tuple[Array, Array]:
        """Rate and its slope by time_offset, shape (n, 3) each, on cubic arcs through the knots (Catmull and Rom 1974).

        Linear pieces would not do: noise of a knot and of the slope beside it go together, which through the
        lever arm feigns a time_offset. The slope of these arcs is as symmetric about a knot as the knot is.
        """
        a, b, c, d = (self.rate_b[n, k + i] for i in (-1, 0, 1, 2))
        first, second, third = 0.5 * (c - a), a - 2.5 * b + 2.0 * c - 0.5 * d, 1.5 * (b - c) + 0.5 * (d - a)
        return b + x * (first + x * (second + x * third)), (first + x * (2.0 * second + 3.0 * x * third)) / KNOT_S

    def _turn(self, n: NDArray[np.int64], k: NDArray[np.int64]) -> Array:
        """Rotation vector from a knot to the next, shape (n, 3)."""
        return log_rotation(transpose(self.dR[n, k]) @ self.dR[n, k + 1])

    def _knot(self, late: Array) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
        """The knot before each time, and how far beyond it, shape (n, 1), in knots."""
        x = (late - self.lag[:, 0]) / KNOT_S
        k = np.clip(np.floor(x).astype(int), 1, self.lag.shape[1] - 3)
        return np.arange(len(x)), k, (x - k)[:, None]


def window_around(
    time: float,
    lag: Array,
    imu: Array,
    start: float,
    integration: tuple[PreintegrationParams, Array],
    longest_step: float,
) -> LateStampWindow | None:
    """The motion around a stamp, from IMU samples.

    Parameters
    ----------
    time : the stamp [s]
    lag : ndarray, shape (K,), ascending by `KNOT_S` [s]
    imu : ndarray, shape (m, 7), time, specific force, rate in body axes
    start : of the keyframe [s]
    integration : parameters and bias, shape (6,), to integrate with
    longest_step : between samples [s]

    Returns
    -------
    LateStampWindow of one stamp, or None where samples are missing
    """
    params, bias = integration
    knots = time - lag
    around = np.append(knots, start)
    begin, end = float(around.min()), float(around.max())
    t = imu[:, 0]
    if not t[0] <= begin < end <= t[-1]:
        return None
    within = t[t.searchsorted(begin, side="right") - 1 : t.searchsorted(end) + 1]
    if np.diff(within).max() > longest_step:
        return None
    stops, place = np.unique(around, return_inverse=True)
    _, found = integrate_motion(params, bias, imu, begin, stops, end, 0.0)
    return LateStampWindow.of(found[place[-1]], found[place[:-1]], lag, _rate(imu, knots), bias)


def beyond_samples(instrument: Instrument) -> str:
    """Why a measurement of an instrument is left out that has no window."""
    return f"calibration.{instrument.time_offset} reaches beyond the IMU's samples"


def _rate(imu: Array, time: Array) -> Array:
    """Rate at some times, shape (n, 3) [rad/s].

    From its means over a window and over half of it, extrapolated to none: what curves cancels, noise averages.
    """
    t, rate = imu[:, 0], imu[:, 4:]
    angle = np.vstack([np.zeros(3), np.cumsum(0.5 * np.diff(t)[:, None] * (rate[1:] + rate[:-1]), axis=0)])

    def mean(half: float) -> Array:
        begin, end = np.clip(time - half, t[0], t[-1]), np.clip(time + half, t[0], t[-1])
        turned = [np.interp(end, t, a) - np.interp(begin, t, a) for a in angle.T]
        return np.column_stack(turned) / (end - begin)[:, None]

    return (4.0 * mean(0.5 * HALF_WINDOW_S) - mean(HALF_WINDOW_S)) / 3.0
