"""Motion from the IMU alone, at even times: rates, level, and acceleration without gravity.

The gyro gives the attitude relative to that at the start, ``R_gb``, which drifts slowly. There the mean specific force
of some 20 s is gravity (upwards), since no vehicle accelerates for so long; it turns with the gyro's bias ``b``,

    d(g_g)/dt = (R_gb b) x g_g,

which gives the horizontal components of the bias.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, cross, exp_rotation, rotate, skew, transpose
from rovgraph.log import Log, Stream
from rovgraph.log.streams import integral
from rovgraph.model.config import Config, mount_matrix

STEP = 0.1  # of the even times, or the IMU's period if that is longer [s]
GAP, GAP_OF_PERIODS = 0.5, 2.5  # without samples that is not interpolated, the longer of the two [s]
LEVEL_SECONDS = 25.0  # before and after, over which specific force shows the vertical
BLOCK_SECONDS = 20.0  # over which the vertical shows the gyro's bias
BIAS_SD = 0.1  # prior, which holds what the dive does not show [rad/s]
FORCE_SD = 0.05  # of a block's mean force [m/s^2]
ROUNDS = 3  # of the bias
ENOUGH_SECONDS = 30.0


@dataclass(frozen=True)
class InertialMotion:
    """The motion of the IMU at n even times.

    Attributes
    ----------
    time : ndarray, shape (n,), a step apart [s]
    step : [s]
    rate_b : ndarray, shape (n, 3), mean over the step, bias removed [rad/s]
    acceleration_b : ndarray, shape (n, 3), without gravity [m/s^2]
    R_gb : ndarray, shape (n, 3, 3), attitude relative to the start, by the gyro alone
    down_b : ndarray, shape (n, 3), unit vectors
    known : ndarray of bool, shape (n,), where there are samples
    """

    time: Array
    step: float
    rate_b: Array
    acceleration_b: Array
    R_gb: Array
    down_b: Array
    known: NDArray[np.bool_]

    @property
    def turning(self) -> Array:
        """Rate about the vertical, shape (n,) [rad/s]."""
        return np.asarray(np.sum(self.rate_b * self.down_b, axis=1))

    def at(self, times: Array, values: Array) -> Array:
        """Values at the even times (n, k), interpolated to others; shape (m, k)."""
        return np.column_stack([np.interp(times, self.time, column) for column in values.T])


def inertial_motion(log: Log, config: Config) -> InertialMotion | None:
    """Motion by the IMU; None where its log is too short."""
    if "imu" not in log or len(log["imu"]) < 3:
        return None
    imu = log["imu"]
    step = max(STEP, float(np.median(np.diff(imu.time))))
    edges = np.arange(imu.time[0], imu.time[-1], step)
    if len(edges) * step < ENOUGH_SECONDS:
        return None
    R_bs = mount_matrix(config.imu.mount_rpy_deg)
    force_b, rate_b = (rotate(R_bs, means(imu, imu.data[:, k : k + 3], edges)) for k in (0, 3))
    time = edges[:-1] + 0.5 * step
    known = ~in_gap(time, imu.time, GAP)
    force_b, rate_b = np.where(known[:, None], force_b, 0.0), np.where(known[:, None], rate_b, 0.0)
    R_gb = attitudes(rate_b, step)
    for _ in range(ROUNDS):
        bias = _bias(R_gb, rotate(R_gb, force_b), known, step)
        rate_b = rate_b - bias * known[:, None]
        R_gb = attitudes(rate_b, step)
        if np.linalg.norm(bias) * BLOCK_SECONDS < 0.1:
            break
    up_g = smoothed(rotate(R_gb, force_b), known, LEVEL_SECONDS, step)
    up_b = rotate(transpose(R_gb), up_g)
    down_b = -up_b / np.maximum(np.linalg.norm(up_b, axis=1), 1e-9)[:, None]
    return InertialMotion(time, step, rate_b, np.where(known[:, None], force_b - up_b, 0.0), R_gb, down_b, known)


def means(stream: Stream, values: Array, edges: Array) -> Array:
    """Means of a signal (n, k) between edges (m + 1,), shape (m, k)."""
    columns = [np.interp(edges, stream.time, integral(stream.time, column)) for column in values.T]
    return np.diff(np.column_stack(columns), axis=0) / np.diff(edges)[:, None]


def in_gap(times: Array, stamps: Array, longest: float) -> NDArray[np.bool_]:
    """Whether each time lies outside the stamps, or between two that are further apart; shape (len(times),)."""
    k = np.searchsorted(stamps, times).clip(1, len(stamps) - 1)
    return np.asarray((stamps[k] - stamps[k - 1] > longest) | (times < stamps[0]) | (times > stamps[-1]))


def attitudes(rate_b: Array, step: float) -> Array:
    """Attitude in the middle of each step relative to the start, rates (n, 3) held over a step; shape (n, 3, 3)."""
    n = len(rate_b)
    rows = max(1, round(np.sqrt(n)))
    columns = -(-n // rows)
    rotvec = np.zeros((rows * columns, 3))
    rotvec[:n] = rate_b * step
    R = exp_rotation(rotvec).reshape(rows, columns, 3, 3)
    for k in range(1, columns):
        R[:, k] = R[:, k - 1] @ R[:, k]
    for k in range(1, rows):
        R[k] = R[k - 1, -1] @ R[k]
    return np.asarray(R.reshape(-1, 3, 3)[:n] @ exp_rotation(-0.5 * step * rate_b))


def _bias(R_gb: Array, force_g: Array, known: NDArray[np.bool_], step: float) -> Array:
    """Bias of the gyro that turns gravity from block to block, shape (3,) [rad/s]."""
    size = max(1, round(BLOCK_SECONDS / step))
    if len(known) < 3 * size:
        return np.zeros(3)
    begins = np.arange(0, len(known) - size + 1, size)
    counts = np.maximum(np.add.reduceat(known[: begins[-1] + size], begins), 1)
    up = np.add.reduceat(force_g[: begins[-1] + size], begins) / counts[:, None]
    middle = begins + size // 2
    turned = np.vstack([np.zeros((1, 3, 3)), np.cumsum(R_gb * step, axis=0)])
    H = skew(0.5 * (up[1:] + up[:-1])) @ (turned[middle[1:]] - turned[middle[:-1]]) * -1.0
    usable = counts > 0.8 * size
    usable = usable[1:] & usable[:-1]
    H, change = H[usable].reshape(-1, 3), np.diff(up, axis=0)[usable].ravel()
    information = H.T @ H / FORCE_SD**2 + np.eye(3) / BIAS_SD**2
    return np.asarray(np.linalg.solve(information, H.T @ change / FORCE_SD**2))


def fast_length(count: int) -> int:
    """The least number from ``count`` on of factors 2, 3 and 5 alone, whose Fourier transform is quick."""
    odd = (3**k * 5**m for k in range(16) for m in range(10))
    return int(min(each << (-(-count // each) - 1).bit_length() for each in odd))


def smoothed(values: Array, known: NDArray[np.bool_], seconds: float, step: float) -> Array:
    """Means of (n, k) with raised-cosine weights over some seconds before and after, of what is known."""
    half = max(1, round(seconds / step))
    kernel = 1.0 + np.cos(np.pi * np.arange(-half, half + 1) / half)
    size = fast_length(len(values) + 2 * half)
    spectrum = np.fft.rfft(kernel, size)[:, None]
    data = np.column_stack([values * known[:, None], known])
    sums = np.fft.irfft(np.fft.rfft(data, size, axis=0) * spectrum, size, axis=0)[half : half + len(values)]
    return np.asarray(sums[:, :-1] / np.maximum(sums[:, -1:], 1.0))


def point_acceleration(motion: InertialMotion, arm_b: Array) -> Array:
    """Acceleration of a point at an arm (3,) from the IMU, shape (n, 3): f + w' x l + w x (w x l) [m/s^2]."""
    arms = np.broadcast_to(arm_b, motion.rate_b.shape)
    swing = cross(motion.rate_b, arms)
    return np.asarray(motion.acceleration_b + np.gradient(swing, motion.step, axis=0) + cross(motion.rate_b, swing))
