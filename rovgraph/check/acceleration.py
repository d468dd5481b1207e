"""The DVL's acceleration against the IMU's: which axes, and which shift of its stamps, make the two agree.

With z the velocity along the body's axes, y along the instrument's and H one of the 48 ways to name three axes,

    z = R_bs H y,  dz/dt(t + tau) + w(t) x z(t + tau) = a_b(t)

where a_b is the IMU's acceleration without gravity, taken to the DVL's place (`inertial`). Heading does not enter.
The sum of squared differences is quadratic in H, so a few dozen cross-correlations, by FFT, give it for every H at
every tau. `refine` then fits tau together with what else may be a little wrong: mounting, scale and lever arm.
"""

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
from numpy.typing import NDArray

from rovgraph.check.inertial import InertialMotion, in_gap, point_acceleration, without_level
from rovgraph.config import Config, mount_matrix
from rovgraph.geometry import Array, cross, exp_rotation, rotate
from rovgraph.log import Stream

WINDOW = 1.0  # over which velocities change, at least two pings [s]
LARGEST_LAG = 300.0  # that is searched for [s]
OVERLAP = 0.6  # of the dive, that a shift leaves
LONGEST_PING_GAP = 2.5  # periods that are interpolated
ENOUGH = 150  # even times
SPIKE = 6.0  # times the usual distance from the median of five pings
LEAST_SPIKE = 0.1  # [m/s]
CLIPPED = 4.0  # times the median difference, which counts no more
PARTS = 10  # of the dive, each left out once to see how much a fit depends on it
ITERATIONS = 4
# priors of what `refine` fits beside the lag: rotation [rad], scale, lever arm [m]
PRIOR_SD = np.array([np.inf, 0.3, 0.3, 0.3, 0.05, 0.1, 0.1, 0.1])


def signed_permutations() -> Array:
    """The 48 ways to name three axes and their senses, the identity first; shape (48, 3, 3)."""
    out = np.zeros((48, 3, 3))
    for H, (order, signs) in zip(out, product(permutations(range(3)), product((1.0, -1.0), repeat=3)), strict=True):
        H[range(3), order] = signs
    return out


ORIENTATIONS = signed_permutations()


@dataclass(frozen=True)
class Search:
    """How well stamps that are late, and axes that are named otherwise, agree with the IMU.

    Attributes
    ----------
    lags : ndarray, shape (m,), how late the stamps are [s]
    error : ndarray, shape (48, m), mean squared difference for each of `ORIENTATIONS` [m^2/s^4]
    likeness : ndarray, shape (48, m), 1 - error / mean square of both, at most 1
    """

    lags: Array
    error: Array
    likeness: Array

    @property
    def now(self) -> int:
        """Index of the lag of zero."""
        return len(self.lags) // 2


@dataclass(frozen=True)
class Fit:
    """What makes the DVL agree with the IMU.

    Attributes
    ----------
    lag, lag_sd : how late its stamps are [s]
    R_bs : ndarray, shape (3, 3), mounting, left-handed if the axes are
    turn_sd : ndarray, shape (3,), of the mounting about the body's axes [rad]
    likeness : as in `Search`
    error : mean squared difference [m^2/s^4]
    """

    lag: float
    lag_sd: float
    R_bs: Array
    turn_sd: Array
    likeness: float
    error: float


class Comparison:
    """Velocities of a DVL beside the motion of the IMU, on the same even times.

    Parameters
    ----------
    motion : of the IMU
    pings : valid ones
    config : mounting and lever arms
    """

    def __init__(self, motion: InertialMotion, pings: Stream, config: Config):
        self.motion, self.R_bs = motion, mount_matrix(config.dvl.mount_rpy_deg)
        self.pings = without_spikes(pings)
        self.period = float(np.median(np.diff(self.pings.time)))
        self.half = max(1, round(max(0.5 * WINDOW, self.period) / motion.step))
        arm_b = np.array(config.dvl.lever_arm_m) - np.array(config.imu.lever_arm_m)
        self.acceleration_b = self._averaged(point_acceleration(motion, arm_b))
        self.rate_b = self._averaged(motion.rate_b)
        self.known = _all_within(motion.known, self.half)

    @property
    def longest(self) -> float:
        """Between two pings that are interpolated [s]."""
        return max(LONGEST_PING_GAP * self.period, 1.0)

    def search(self, largest: float = LARGEST_LAG, during: tuple[float, float] = (-np.inf, np.inf)) -> Search:
        """Every orientation at every lag, by the IMU's samples between two times."""
        time, step = self.motion.time, self.motion.step
        known = self.known & (time >= during[0]) & (time <= during[1])
        seconds = step * np.count_nonzero(known)
        reach = max(1, int(min(largest, (1.0 - OVERLAP) * seconds) / step))
        y, seen = self._velocity(0.0)
        dy, mean, seen = self._changes(y, seen)
        a, w = (np.where(known[:, None], rotate(self.R_bs.T, v), 0.0) for v in (self.acceleration_b, self.rate_b))
        dy, mean = (np.where(seen[:, None], v, 0.0) for v in (dy, mean))
        correlate = _Correlator(len(time), reach)
        pairs = np.triu_indices(3)
        count = np.maximum(correlate(known[:, None] * 1.0, seen[:, None] * 1.0)[0, 0], 1.0)
        own = correlate(_square(a)[:, None], seen[:, None] * 1.0)[0, 0]
        speed = correlate(_square(w)[:, None], _square(mean)[:, None])[0, 0]
        speed += correlate(known[:, None] * 1.0, _square(dy)[:, None])[0, 0]
        swing = correlate(w, cross(mean, dy))
        both = correlate(a, dy) + correlate(cross(a, w), mean)
        twice = np.where(pairs[0] == pairs[1], 1.0, 2.0)
        outer = correlate(w[:, pairs[0]] * w[:, pairs[1]], mean[:, pairs[0]] * mean[:, pairs[1]])
        moment = ORIENTATIONS[:, pairs[0]][:, :, pairs[0]] * ORIENTATIONS[:, pairs[1]][:, :, pairs[1]]
        moment = 0.5 * (moment + ORIENTATIONS[:, pairs[0]][:, :, pairs[1]] * ORIENTATIONS[:, pairs[1]][:, :, pairs[0]])
        moment = moment * twice[:, None] * twice
        shape = (len(ORIENTATIONS), -1)
        of_dvl = speed - moment.reshape(shape) @ outer.reshape(36, -1)
        of_dvl += 2.0 * (np.linalg.det(ORIENTATIONS)[:, None, None] * ORIENTATIONS).reshape(shape) @ swing.reshape(9, -1)
        mixed = ORIENTATIONS.reshape(shape) @ both.reshape(9, -1)
        total = np.maximum(own + of_dvl, 1e-12)
        lags = step * np.arange(-reach, reach + 1)
        enough = count >= max(ENOUGH, OVERLAP * np.count_nonzero(known & seen))
        error = np.where(enough, (total - 2.0 * mixed) / count, np.inf)
        return Search(lags, error, np.where(enough, 2.0 * mixed / total, -1.0))

    def refine(
        self, lag: float, H: Array, during: tuple[float, float] = (-np.inf, np.inf), largest: float = 1.0
    ) -> Fit | None:
        """Least squares from a lag and an orientation; None if it leads away or there is too little."""
        time, step = self.motion.time, self.motion.step
        inside = self.known & (time >= during[0]) & (time <= during[1])
        R_bs, scale, arm_b, begin = self.R_bs @ H, 1.0, np.zeros(3), lag
        measured = self.acceleration_b
        for _ in range(ITERATIONS):
            y, seen = self._velocity(lag)
            z = scale * rotate(R_bs, y)
            predicted, usable = self._acceleration(z, seen)
            usable &= inside
            if np.count_nonzero(usable) < ENOUGH:
                return None
            jerk = np.gradient(predicted, step, axis=0)
            turned = [self._acceleration(cross(np.broadcast_to(axis, z.shape), z), seen)[0] for axis in np.eye(3)]
            swing = [self._swing(axis) for axis in np.eye(3)]
            J = np.stack([jerk, *turned, predicted, *swing], axis=2)
            left = measured - without_level(self.motion, np.where(seen[:, None], predicted, 0.0))
            left = left - rotate(J[:, :, 5:], arm_b)
            size = _square(left)
            usable &= size < CLIPPED**2 * float(np.median(size[usable]))
            step_, sd = self._solved(J[usable], left[usable], arm_b)
            lag += float(step_[0])
            R_bs = exp_rotation(step_[1:4]) @ R_bs
            scale, arm_b = scale * (1.0 + float(step_[4])), arm_b + step_[5:]
            if abs(lag - begin) > largest:
                return None
        error = float(_square(left[usable]).mean())
        total = float((_square(measured[usable]) + _square(predicted[usable])).mean())
        return Fit(lag, float(sd[0]), R_bs, sd[1:4], 1.0 - error / total, error)

    def _solved(self, J: Array, left: Array, arm_b: Array) -> tuple[Array, Array]:
        """Step and standard deviations (8,), these by leaving out one part after the other."""
        variance = float(np.mean(left**2)) * 2 * self.half  # differences within a window are one
        parts = np.array_split(np.arange(len(left)), PARTS)
        H = np.array([np.einsum("nik,nil->kl", J[p], J[p]) for p in parts]) / variance
        g = np.array([np.einsum("nik,ni->k", J[p], left[p]) for p in parts]) / variance
        prior = np.diag(1.0 / PRIOR_SD**2) + 1e-9 * np.eye(8)
        towards = np.concatenate([np.zeros(5), -arm_b / PRIOR_SD[5:] ** 2])
        step = np.linalg.solve(H.sum(axis=0) + prior, g.sum(axis=0) + towards)
        information = H.sum(axis=0) - H + prior
        without = np.linalg.solve(information, (g.sum(axis=0) - g + towards)[..., None])[..., 0]
        spread = np.sqrt((PARTS - 1) * np.var(without, axis=0))
        return step, np.maximum(spread, np.sqrt(np.diag(np.linalg.inv(H.sum(axis=0) + prior))))

    def _velocity(self, lag: float) -> tuple[Array, NDArray[np.bool_]]:
        """Velocity along the instrument's axes at the even times, by stamps that are late; and where it is known."""
        when = self.motion.time + lag
        y = np.column_stack([np.interp(when, self.pings.time, column) for column in self.pings.data[:, :3].T])
        return y, ~in_gap(when, self.pings.time, self.longest)

    def _changes(self, y: Array, seen: NDArray[np.bool_]) -> tuple[Array, Array, NDArray[np.bool_]]:
        """Rate of change of a velocity, its mean, and where both are known."""
        h = self.half
        change = np.zeros_like(y)
        change[h:-h] = (y[2 * h :] - y[: -2 * h]) / (2 * h * self.motion.step)
        return change, self._averaged(y), _all_within(seen, h)

    def _acceleration(self, z: Array, seen: NDArray[np.bool_]) -> tuple[Array, NDArray[np.bool_]]:
        change, mean, seen = self._changes(z, seen)
        return change + cross(self.rate_b, mean), seen

    def _swing(self, arm_b: Array) -> Array:
        """Acceleration of a point at an arm because the vehicle turns."""
        swing = cross(self.rate_b, np.broadcast_to(arm_b, self.rate_b.shape))
        return np.asarray(np.gradient(swing, self.motion.step, axis=0) + cross(self.rate_b, swing))

    def _averaged(self, values: Array) -> Array:
        """Means over the window around each time; shape of values (n, 3)."""
        h = self.half
        padded = np.pad(values, ((h, h), (0, 0)), mode="edge")
        sums = np.vstack([np.zeros(3), np.cumsum(0.5 * (padded[1:] + padded[:-1]), axis=0)])
        return np.asarray((sums[2 * h :] - sums[: -2 * h]) / (2 * h))


class _Correlator:
    """Cross-correlations of columns: sum over t of a_i(t) b_j(t + lag), shape (columns of a, of b, lags)."""

    def __init__(self, n: int, reach: int):
        self.reach, self.size = reach, 1 << (n + reach).bit_length()

    def __call__(self, a: Array, b: Array) -> Array:
        A, B = (np.fft.rfft(v, self.size, axis=0).T for v in (a, b))
        sums = np.fft.irfft(A.conj()[:, None] * B, self.size, axis=-1)
        return np.concatenate([sums[..., -self.reach :], sums[..., : self.reach + 1]], axis=-1)


def _square(v: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", v, v))


def _all_within(flags: NDArray[np.bool_], half: int) -> NDArray[np.bool_]:
    """Whether all flags within half a window around each are set, and there is a window."""
    sums = np.concatenate([[0], np.cumsum(flags)])
    out = np.zeros(len(flags), dtype=bool)
    out[half : len(flags) - half] = sums[2 * half + 1 :] - sums[: -2 * half - 1] == 2 * half + 1
    return out


def without_spikes(pings: Stream) -> Stream:
    """Pings that are near the median of the five around them."""
    if len(pings) < 5:
        return pings
    padded = np.pad(pings.data[:, :3], ((2, 2), (0, 0)), mode="edge")
    off = np.abs(pings.data[:, :3] - np.median(np.lib.stride_tricks.sliding_window_view(padded, 5, axis=0), axis=-1))
    limit = np.maximum(LEAST_SPIKE, SPIKE * np.median(off, axis=0))
    return pings.take((off <= limit).all(axis=1))
