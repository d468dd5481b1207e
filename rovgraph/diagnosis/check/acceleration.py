"""The DVL's acceleration against the IMU's: the axes and the time offset that make the two agree.

With z the velocity along the body's axes, y along the instrument's and H one of the 48 ways to name three axes,

    z = R_bs H y,  dz/dt(t + tau) + w(t) x z(t + tau) = a_b(t)

where a_b is the IMU's acceleration without gravity, taken to the DVL's place (`inertial`). Heading does not enter.
The sum of squared differences is quadratic in H, so a few dozen cross-correlations, by FFT, give it for every H at
every tau. `refine` then fits tau together with small errors of mounting, scale and lever arm.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from rovgraph.diagnosis.check.findings import without_spikes
from rovgraph.diagnosis.check.inertial import (
    GAP_OF_PERIODS,
    LEVEL_SECONDS,
    InertialMotion,
    in_gap,
    point_acceleration,
    smoothed,
)
from rovgraph.diagnosis.check.lags import ORIENTATIONS, correlate, normal_equations, spread
from rovgraph.geometry import Array, cross, exp_rotation, rotate
from rovgraph.log import Stream
from rovgraph.model.config import Config, mount_matrix
from rovgraph.rules import ACCELERATION, CLIPPED

BETTER = 2.0  # times smaller an error than as configured, which chance does not make
WINDOW = 1.0  # over which velocities change, at least two pings [s]
OVERLAP = 0.6  # of the dive, that a shift leaves
ENOUGH = 150  # even times
ENOUGH_PINGS = 30
BURST = 5  # pings that a serial buffer may hold back
ITERATIONS = 12  # at most: a turn of 90 degrees is found in steps
SETTLED = 2e-3  # step that ends it [s, rad]
LARGEST_STEP = 1.0  # that a fit leads away from where it began [s]
ALWAYS = (-np.inf, np.inf)
TURNING_SECONDS = 1200.0  # of a dive, the liveliest, that show whether the axes turn with the vehicle
LARGEST_DRIFT = np.deg2rad(3.0)  # of the gyro about the vertical [rad/s]
# priors of what `refine` fits: lag [s], rotation [rad], scale, lever arm [m], the accelerometer's bias [m/s^2]
PRIOR_SD = np.array([10.0, 0.3, 0.3, 0.3, 0.05, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05])


@dataclass(frozen=True)
class Search:
    """How well stamps that are late, and axes that are named otherwise, agree with the IMU.

    Attributes
    ----------
    lags : ndarray, shape (m,), how late the stamps are [s]
    error : ndarray, shape (48, m), mean squared difference for each of `ORIENTATIONS` [m^2/s^4]
    agreement : ndarray, shape (48, m), 1 - error / mean square of both, at most 1
    """

    lags: Array
    error: Array
    agreement: Array

    @property
    def now(self) -> int:
        """Index of the lag of zero."""
        return len(self.lags) // 2


@dataclass(frozen=True)
class AccelerationFit:
    """Axes, time offset and mounting that make the DVL agree with the IMU.

    Attributes
    ----------
    lag, lag_sd : how late its stamps are [s]
    R_bs : ndarray, shape (3, 3), mounting, left-handed if the axes are
    turn_sd : ndarray, shape (3,), of the mounting about the body's axes [rad]
    agreement : as in `Search`
    error : mean squared difference [m^2/s^4]
    count : of independent differences
    """

    lag: float
    lag_sd: float
    R_bs: Array
    turn_sd: Array
    agreement: float
    error: float
    count: float


@dataclass(frozen=True)
class TurningVelocities:
    """Horizontal velocities along axes that turn with the vehicle, and along axes that do not.

    Attributes
    ----------
    with_vehicle, not_at_all : agreement as in `Search`
    """

    with_vehicle: float
    not_at_all: float


@dataclass(frozen=True)
class _Guess:
    """Where a least-squares fit stands."""

    lag: float
    R_bs: Array
    scale: float
    arm_b: Array
    bias_b: Array

    def moved(self, step: Array) -> "_Guess":
        """After a step (11,) in the order of `PRIOR_SD`."""
        R_bs = exp_rotation(step[1:4]) @ self.R_bs
        scale = self.scale * (1.0 + float(step[4]))
        return _Guess(self.lag + float(step[0]), R_bs, scale, self.arm_b + step[5:8], self.bias_b + step[8:])


class DvlAgainstImu:
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
        self.period = _period(self.pings.time)
        self.half = max(1, round(max(0.5 * WINDOW, self.period) / motion.step))
        self.apart = max(1, round(WINDOW / self.period))
        self.arm_b = np.array(config.dvl.lever_arm_m) - np.array(config.imu.lever_arm_m)
        self.acceleration_b = self._averaged(point_acceleration(motion, self.arm_b))
        self.force_g = rotate(motion.R_gb, motion.acceleration_b)
        self.smooth_rate_b = _boxed(motion.rate_b, 2)
        self.way_g = np.vstack([np.zeros(3), np.cumsum(self.force_g * motion.step, axis=0)])
        middle = 0.5 * (self.force_g[1:] + self.force_g[:-1])
        self.slope_g = np.vstack([self.force_g[:1], middle, self.force_g[-1:]])
        self.rate_b = self._averaged(motion.rate_b)
        self.known = _all_within(motion.known, self.half)

    @property
    def longest(self) -> float:
        """Between two pings that are interpolated [s]."""
        return max(GAP_OF_PERIODS * self.period, 1.0)

    def search(self, largest: float = ACCELERATION.reach_s, during: tuple[float, float] = ALWAYS) -> Search:
        """Every orientation at every lag, by the IMU's samples between two times."""
        time, step = self.motion.time, self.motion.step
        known = self.known & (time >= during[0]) & (time <= during[1])
        seconds = step * np.count_nonzero(known)
        reach = max(1, int(min(largest, (1.0 - OVERLAP) * seconds) / step))
        y, seen = self._velocity(0.0)
        dy, mean, seen = self._changes(y, seen)
        a, w = (np.where(known[:, None], rotate(self.R_bs.T, v), 0.0) for v in (self.acceleration_b, self.rate_b))
        dy, mean = (np.where(seen[:, None], v, 0.0) for v in (dy, mean))
        sums = partial(correlate, first=-reach, last=reach)
        inertial, pinged = (flags[:, None].astype(float) for flags in (known, seen))
        pairs = np.triu_indices(3)
        count = np.maximum(sums(inertial, pinged)[0, 0], 1.0)
        of_imu = sums(_square(a)[:, None], pinged)[0, 0]
        speed = sums(_square(w)[:, None], _square(mean)[:, None])[0, 0]
        speed += sums(inertial, _square(dy)[:, None])[0, 0]
        swing = sums(w, cross(mean, dy))
        both = sums(a, dy) + sums(cross(a, w), mean)
        twice = np.where(pairs[0] == pairs[1], 1.0, 2.0)
        outer = sums(w[:, pairs[0]] * w[:, pairs[1]], mean[:, pairs[0]] * mean[:, pairs[1]])
        moment = ORIENTATIONS[:, pairs[0]][:, :, pairs[0]] * ORIENTATIONS[:, pairs[1]][:, :, pairs[1]]
        moment = 0.5 * (moment + ORIENTATIONS[:, pairs[0]][:, :, pairs[1]] * ORIENTATIONS[:, pairs[1]][:, :, pairs[0]])
        moment = moment * twice[:, None] * twice
        shape = (len(ORIENTATIONS), -1)
        of_dvl = speed - moment.reshape(shape) @ outer.reshape(36, -1)
        of_dvl += (
            2.0 * (np.linalg.det(ORIENTATIONS)[:, None, None] * ORIENTATIONS).reshape(shape) @ swing.reshape(9, -1)
        )
        mixed = ORIENTATIONS.reshape(shape) @ both.reshape(9, -1)
        total = np.maximum(of_imu + of_dvl, 1e-12)
        lags = np.arange(-reach, reach + 1, dtype=float) * step
        enough = count >= max(ENOUGH, OVERLAP * np.count_nonzero(known & seen))
        error = np.where(enough, (total - 2.0 * mixed) / count, np.inf)
        return Search(lags, error, np.where(enough, 2.0 * mixed / total, -1.0))

    def refine(
        self, lag: float, H: Array, during: tuple[float, float] = ALWAYS, held: bool = False
    ) -> AccelerationFit | None:
        """Least squares from a lag and an orientation; None if it leads away or there is too little.

        Parameters
        ----------
        lag, H : where to begin
        during : first and last stamp of the pings that count
        held : fit everything but the lag
        """
        if len(self.pings) < self.apart + ENOUGH_PINGS:
            return None
        guess = _Guess(lag, self.R_bs @ H, 1.0, np.zeros(3), np.zeros(3))
        prior_sd = np.where(np.arange(len(PRIOR_SD)) == 0, 1e-9 if held else PRIOR_SD[0], PRIOR_SD)
        for _ in range(ITERATIONS):
            left, J, measured, usable = self._differences(guess, during)
            if np.count_nonzero(usable) < ENOUGH_PINGS:
                return None
            size = _square(left)
            usable &= size < CLIPPED**2 * float(np.median(size[usable]))
            step, sd = self._solved(J[usable], left[usable], guess, prior_sd)
            guess = guess.moved(step)
            if abs(guess.lag - lag) > LARGEST_STEP:
                return None
            if abs(step[0]) < SETTLED and np.abs(step[1:4]).max() < SETTLED:
                break
        left, measured = left[usable], measured[usable]
        error = float(_square(left).mean())
        total = float((_square(measured) + _square(measured - left)).mean())
        return AccelerationFit(
            guess.lag, float(sd[0]), guess.R_bs, sd[1:4], 1.0 - error / total, error, len(left) / self.apart
        )

    def turning(self) -> TurningVelocities | None:
        """Whether the velocities are along axes that turn with the vehicle, by their horizontal components.

        Changes of velocity between pings are compared with the IMU's as in `_differences`, along level axes. Either
        way the heading of the DVL's axes, their sense and the gyro's drift by its bias are those that fit best.
        None = there is too little.
        """
        i, j, seconds, middle = self._pairs(0.0)
        usable = self._usable(i, j, 0.0, ALWAYS)
        if np.count_nonzero(usable) < ENOUGH_PINGS:
            return None
        R_gb, rate_b, way_g = self._inertial(self.pings.time)
        swing_g = rotate(R_gb, cross(rate_b, np.broadcast_to(self.arm_b, rate_b.shape)))
        along = _level_axes(rotate(self.motion.R_gb, self.motion.down_b).mean(axis=0)) @ (1.0, 1.0j)
        heading = np.exp(1.0j * np.unwrap(np.angle(R_gb[:, :, 0] @ along)))

        def change(v: Array) -> Array:
            return np.asarray((v[j] - v[i]) / seconds)

        swing = change(swing_g)
        measured = (change(way_g) + swing - self._slow(middle, swing)) @ along
        part = _liveliest(middle, usable * (1e-12 + np.abs(measured) ** 2), TURNING_SECONDS) & usable
        inertial, time = measured[part], middle[part] - middle[part][0]
        gyro = np.exp(1.0j * np.outer(np.arange(-LARGEST_DRIFT, LARGEST_DRIFT, 1.0 / max(time[-1], 1.0)), time))

        def agreement(v: NDArray[np.complexfloating]) -> float:
            changes = change(np.column_stack([v.real, v.imag]))
            seen = (changes - self._slow(middle, changes))[part] @ (1.0, 1.0j)
            total = float(np.vdot(inertial, inertial).real + np.vdot(seen, seen).real)
            return float(2.0 * np.abs((gyro * inertial) @ seen.conj()).max() / max(total, 1e-12))

        y = self.pings.data[:, 0] + 1.0j * self.pings.data[:, 1]
        senses = y, y.conj()
        return TurningVelocities(max(agreement(v * heading) for v in senses), max(agreement(v) for v in senses))

    def _differences(
        self, guess: "_Guess", during: tuple[float, float]
    ) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Changes of velocity over a window, IMU less DVL, by m pairs of pings.

        In the gyro's axes, with l the DVL's arm from the IMU: change of R_gb (R_bs y - w x l) = integral of R_gb a_b.
        Between pings nothing is interpolated but the IMU.

        Returns
        -------
        left : ndarray, shape (m, 3), the differences per second [m/s^2]
        J : ndarray, shape (m, 3, 11), what they fall by per unit of what `PRIOR_SD` lists
        measured : ndarray, shape (m, 3), by the IMU [m/s^2]
        usable : ndarray of bool, shape (m,)
        """
        stamps = self.pings.time
        i, j, seconds, _ = self._pairs(guess.lag)
        z = guess.scale * rotate(guess.R_bs, self.pings.data[:, :3])
        arms = np.broadcast_to(self.arm_b + guess.arm_b, z.shape)

        def change(v_g: Array) -> Array:
            return np.asarray((v_g[j] - v_g[i]) / seconds)

        def difference(lag: float) -> tuple[Array, Array]:
            when = stamps - lag
            R_gb, rate_b, way_g = self._inertial(when)
            measured, predicted = change(way_g), change(rotate(R_gb, z - cross(rate_b, arms)))
            return measured - predicted + self._slow(0.5 * (when[i] + when[j]), predicted), measured

        when = stamps - guess.lag
        R_gb, rate_b, _ = self._inertial(when)
        axes = [np.broadcast_to(axis, z.shape) for axis in np.eye(3)]
        turned = [change(rotate(R_gb, cross(axis, z))) for axis in axes]
        swing = [-change(rotate(R_gb, cross(rate_b, axis))) for axis in axes]
        biased = 0.5 * (R_gb[i] + R_gb[j])
        biased = biased - self._slow(0.5 * (when[i] + when[j]), biased.reshape(-1, 9)).reshape(-1, 3, 3)
        h = self.motion.step
        later = (difference(guess.lag - h)[0] - difference(guess.lag + h)[0]) / (2.0 * h)
        J = np.stack([later, *turned, change(rotate(R_gb, z)), *swing], axis=2)
        left, measured = difference(guess.lag)
        left = left - rotate(biased, guess.bias_b)
        usable = self._usable(i, j, guess.lag, during)
        return left, np.concatenate([J, biased], axis=2), measured, usable

    def _pairs(self, lag: float) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]:
        """Pings and those after them, the time between, shape (m, 1), and its middle, of stamps that are late [s]."""
        stamps = self.pings.time
        i = np.arange(len(stamps) - self.apart)
        j = i + self.apart
        return i, j, (stamps[j] - stamps[i])[:, None], 0.5 * (stamps[i] + stamps[j]) - lag

    def _usable(
        self, i: NDArray[np.int64], j: NDArray[np.int64], lag: float, during: tuple[float, float]
    ) -> NDArray[np.bool_]:
        """Which pairs lie within a time, without a gap of either sensor; shape (m,)."""
        stamps = self.pings.time
        known = self._known(stamps - lag)
        within = known[i] & known[j] & (stamps[i] >= during[0]) & (stamps[j] <= during[1])
        return np.asarray(within & (stamps[j] - stamps[i] < self.apart * self.period + self.longest))

    def _solved(self, J: Array, left: Array, guess: "_Guess", prior_sd: Array) -> tuple[Array, Array]:
        """Step and standard deviations (11,), these by leaving out one part after the other."""
        variance = float(np.mean(left**2)) * self.apart  # differences overlap
        H, g = normal_equations(J, left, variance)
        so_far = np.concatenate([np.zeros(5), guess.arm_b, guess.bias_b])
        towards = -so_far / prior_sd**2
        information = H.sum(axis=0) + np.diag(1.0 / prior_sd**2)
        step = np.linalg.solve(information, g.sum(axis=0) + towards)
        without = np.linalg.solve(information - H, (g.sum(axis=0) - g + towards)[..., None])[..., 0]
        return step, np.maximum(spread(without), np.sqrt(np.diag(np.linalg.inv(information))))

    def _inertial(self, when: Array) -> tuple[Array, Array, Array]:
        """Attitude, rate and the integral of the acceleration along the gyro's axes, at some times."""
        motion = self.motion
        k = self._nearest(when)
        rate_b = np.column_stack([np.interp(when, motion.time, column) for column in self.smooth_rate_b.T])
        R_gb = motion.R_gb[k] @ exp_rotation((when - motion.time[k])[:, None] * motion.rate_b[k])
        edge = (when - motion.time[0]) / motion.step + 0.5
        left = np.floor(edge).astype(np.int64).clip(0, len(motion.time) - 1)
        part = (edge - left)[:, None]
        begin, end, mean = self.slope_g[left], self.slope_g[left + 1], self.force_g[left]
        # a parabola over the step with these ends, bent so that its mean is that of the samples
        bend = 6.0 * (mean - 0.5 * (begin + end))
        way = begin * part + 0.5 * (end - begin) * part**2 + bend * (0.5 * part**2 - part**3 / 3.0)
        return R_gb, rate_b, self.way_g[left] + motion.step * way

    def _known(self, when: Array) -> NDArray[np.bool_]:
        inside = (when >= self.motion.time[0]) & (when <= self.motion.time[-1])
        return np.asarray(inside & self.known[self._nearest(when)])

    def _nearest(self, when: Array) -> NDArray[np.int64]:
        k = np.rint((when - self.motion.time[0]) / self.motion.step).astype(np.int64)
        return np.asarray(k.clip(0, len(self.motion.time) - 1))

    def _slow(self, when: Array, change_g: Array) -> Array:
        """What `inertial_motion` takes of accelerations (n, k) for gravity."""
        motion = self.motion
        even = np.column_stack([np.interp(motion.time, when, column) for column in change_g.T])
        slow = smoothed(even, motion.known, LEVEL_SECONDS, motion.step)
        return np.column_stack([np.interp(when, motion.time, column) for column in slow.T])

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

    def _averaged(self, values: Array) -> Array:
        return _boxed(values, self.half)


def _level_axes(down: Array) -> Array:
    """Two level axes, the second to starboard of the first, as columns, shape (3, 2)."""
    other = cross(down, np.eye(3)[np.argmin(np.abs(down))])
    starboard = other / np.linalg.norm(other)
    return np.column_stack([cross(starboard, down / np.linalg.norm(down)), starboard])


def _liveliest(time: Array, power: Array, seconds: float) -> NDArray[np.bool_]:
    """Which of n times lie in the piece of a length [s] that has the most power."""
    piece = ((time - time[0]) // seconds).astype(np.int64)
    return np.asarray(piece == np.argmax(np.bincount(piece, power)))


def _period(time: Array) -> float:
    """Time between pings [s], the usual one; of pings that come in bursts their mean."""
    stride = min(BURST, len(time) - 1)
    return float(np.median(time[stride:] - time[:-stride])) / stride


def _square(v: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", v, v))


def _boxed(values: Array, half: int) -> Array:
    """Means of (n, 3) from half a window before to half a window after."""
    padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
    sums = np.vstack([np.zeros(3), np.cumsum(0.5 * (padded[1:] + padded[:-1]), axis=0)])
    return np.asarray((sums[2 * half :] - sums[: -2 * half]) / (2 * half))


def _all_within(flags: NDArray[np.bool_], half: int) -> NDArray[np.bool_]:
    """Whether all flags within half a window around each are set, and there is a window."""
    sums = np.concatenate([[0], np.cumsum(flags)])
    out = np.zeros(len(flags), dtype=bool)
    out[half : len(flags) - half] = sums[2 * half + 1 :] - sums[: -2 * half - 1] == 2 * half + 1
    return out
