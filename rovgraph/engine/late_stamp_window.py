"""The IMU's motion around a stamp that may be late: along it a measurement is placed.

An instrument whose stamps are late by tau measured at stamp - tau. A derivative by time would
do for an offset that is small against the motion; half a second is not. So the motion from the
keyframe is kept at knots around the stamp, as far as the prior of tau reaches, and
interpolated: rotation along its geodesic, velocity and position linearly. Predictions are exact
for any tau, in the smoother and in filters alike.
"""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, exp_rotation, log_rotation, rotate, transpose
from rovgraph.state import BIAS, POSE, VELOCITY, Delta, Jacobians, State

KNOT_S = 0.02  # at 3 m/s3, the jerk of gravity in a turning body, velocity is interpolated within 0.2 mm/s


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
    def of(lag: Array, knots: Array, bias: Array) -> "LateStampWindow":
        """The windows of n stamps of one sensor, shape (n, K or more, KNOT), as of `rovgraph.kernels.assembly`."""
        n, K = len(knots), len(lag)
        dt, dR, dv, dp, rate_b = np.split(knots[:, :K], [1, 10, 13, 16], axis=2)
        shared = np.broadcast_to(lag, (n, K)), np.broadcast_to(bias, (n, 6))
        return LateStampWindow(shared[0], dt[..., 0], dR.reshape(n, K, 3, 3), dv, dp, rate_b, shared[1])

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
