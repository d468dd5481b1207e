"""Rotations and angles over a leading axis of epochs.

Everything here takes and returns NumPy arrays. ``(..., 3)`` and ``(..., 3, 3)`` mean
that any leading axes broadcast.
"""

from functools import cache
from itertools import accumulate, permutations, product
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Coefficient = TypeVar("Coefficient", float, Array)


@cache
def identity(n: int) -> Array:
    """The unit matrix of n rows, not to be written to."""
    out = np.eye(n)
    out.flags.writeable = False
    return out


def wrap_angle(angle: ArrayLike) -> Array:
    """Angle wrapped to [-pi, pi) [rad]."""
    return (np.asarray(angle, dtype=float) + np.pi) % (2.0 * np.pi) - np.pi


def skew(v: ArrayLike) -> Array:
    """Cross-product matrix S(v), so that ``skew(a) @ b = a x b`` (2.2).

    Parameters
    ----------
    v : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    v = np.asarray(v, dtype=float)
    out: Array = (v @ _SKEW).reshape(*v.shape, 3)
    return out


_SKEW = np.zeros((3, 9))  # from x, y, z to the flattened matrix
_SKEW[[0, 1, 2], [7, 2, 3]], _SKEW[[0, 1, 2], [5, 6, 1]] = 1.0, -1.0


def cross(a: Array, b: Array) -> Array:
    """``np.cross`` of vectors in three dimensions, at a tenth of its overhead; shape (..., 3)."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    x = ay * bz - az * by
    out = np.empty((*x.shape, 3))
    out[..., 0], out[..., 1], out[..., 2] = x, az * bx - ax * bz, ax * by - ay * bx
    return out


def matrix_from_rpy(rpy: ArrayLike) -> Array:
    """Rotation matrix Rz(yaw) Ry(pitch) Rx(roll).

    Parameters
    ----------
    rpy : array_like, shape (..., 3), roll, pitch, yaw [rad]

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    rpy = np.asarray(rpy, dtype=float)
    cosine, sine = np.cos(rpy), np.sin(rpy)
    cr, cp, cy = cosine[..., 0], cosine[..., 1], cosine[..., 2]
    sr, sp, sy = sine[..., 0], sine[..., 1], sine[..., 2]
    out = np.empty((*rpy.shape, 3))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    out[..., 2, 0], out[..., 2, 1], out[..., 2, 2] = -sp, cp * sr, cp * cr
    return out


def rpy_from_matrix(R: ArrayLike) -> Array:
    """Roll, pitch, yaw [rad] of rotation matrices: the inverse of `matrix_from_rpy`.

    (2.7) in NED with the usual sign of the pitch, ``pitch = -arcsin(R31)``.

    Parameters
    ----------
    R : array_like, shape (..., 3, 3)

    Returns
    -------
    ndarray, shape (..., 3)
    """
    R = np.asarray(R, dtype=float)
    out = np.empty(R.shape[:-1])
    out[..., 0] = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    out[..., 1] = -np.arcsin(np.minimum(np.maximum(R[..., 2, 0], -1.0), 1.0))
    out[..., 2] = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return out


def level_from_force(force_b: Array) -> Array:
    """Roll and pitch [rad] at which a specific force is that of a vehicle at rest.

    Parameters
    ----------
    force_b : ndarray, shape (..., 3), body axes, any unit

    Returns
    -------
    ndarray, shape (..., 2)
    """
    x, y, z = force_b[..., 0], force_b[..., 1], force_b[..., 2]
    return np.stack([np.arctan2(-y, -z), np.arctan2(x, np.hypot(y, z))], axis=-1)


def rpy_jacobian(rpy: ArrayLike) -> Array:
    """Derivative of roll, pitch, yaw with respect to a rotation vector in n.

    For ``R_nb <- Exp(dtheta_n) R_nb`` the angles change by ``J @ dtheta_n``.

    Parameters
    ----------
    rpy : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., 3, 3); singular at a pitch of 90 degrees
    """
    rpy = np.asarray(rpy, dtype=float)
    cp, tp = np.cos(rpy[..., 1]), np.tan(rpy[..., 1])
    cy, sy = np.cos(rpy[..., 2]), np.sin(rpy[..., 2])
    J = np.zeros((*rpy.shape, 3))
    J[..., 0, 0], J[..., 0, 1] = cy / cp, sy / cp
    J[..., 1, 0], J[..., 1, 1] = -sy, cy
    J[..., 2, 0], J[..., 2, 1], J[..., 2, 2] = cy * tp, sy * tp, 1.0
    return J


def rpy_axes(rpy: Array) -> Array:
    """The inverse of `rpy_jacobian`: axes in n that roll, pitch and yaw turn about, as columns, shape (n, 3, 3).

    Parameters
    ----------
    rpy : ndarray, shape (n, 3)
    """
    cp, sp = np.cos(rpy[:, 1]), np.sin(rpy[:, 1])
    cy, sy = np.cos(rpy[:, 2]), np.sin(rpy[:, 2])
    zero, one = np.zeros_like(cy), np.ones_like(cy)
    axes = [[cp * cy, cp * sy, -sp], [-sy, cy, zero], [zero, zero, one]]
    return np.moveaxis(np.array(axes), -1, 0).swapaxes(-1, -2)


def exp_rotation(rotvec: ArrayLike) -> Array:
    """Rotation matrices Exp(rotvec), Rodrigues' formula (2.1).

    Parameters
    ----------
    rotvec : array_like, shape (..., 3) [rad]

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    rotvec = np.asarray(rotvec, dtype=float)
    sine, cosine, _ = _rodrigues(rotvec)
    S = skew(rotvec)
    return _EYE + sine * S + cosine * (S @ S)


def right_jacobian(rotvec: Array) -> Array:
    """Jr with Exp(r + d) ~ Exp(r) Exp(Jr d) to first order in d (Forster et al. 2017, eq. 8).

    Parameters
    ----------
    rotvec : ndarray, shape (..., 3) [rad]

    Returns
    -------
    ndarray, shape (..., 3, 3)
    """
    return exp_and_right_jacobian(rotvec)[1]


def exp_and_right_jacobian(rotvec: Array) -> tuple[Array, Array]:
    """`exp_rotation` and `right_jacobian` of the same vectors, for little more than one of them."""
    sine, cosine, cubic = _rodrigues(rotvec)
    S = skew(rotvec)
    square = S @ S
    return _EYE + sine * S + cosine * square, _EYE - cosine * S + cubic * square


_EYE = np.eye(3)


def _rodrigues(rotvec: Array) -> tuple[Array, Array, Array] | tuple[float, float, float]:
    """sin(a)/a, (1 - cos a)/a^2, (a - sin a)/a^3 of the angle a, shapes (..., 1, 1) or none."""
    square = rotvec[..., None, :] @ rotvec[..., :, None]
    if square.size == 1 and square.item() < _SMALL:  # plain floats, at a third of the time
        return _series(square.item())
    if square.size and square.max() < _SMALL:  # the series are exact to rounding, the closed forms are not
        return _series(square)
    small = square < _SMALL
    angle = np.sqrt(np.where(small, 1.0, square))
    closed = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    sine, cosine, cubic = (np.where(small, *pair) for pair in zip(_series(square), closed, strict=True))
    return sine, cosine, cubic


_SMALL = 1e-4  # square of an angle


def _series(square: Coefficient) -> tuple[Coefficient, Coefficient, Coefficient]:
    return (
        1.0 - square * (1.0 / 6.0 - square / 120.0),
        0.5 - square * (1.0 / 24.0 - square / 720.0),
        1.0 / 6.0 - square * (1.0 / 120.0 - square / 5040.0),
    )


def log_rotation(R: ArrayLike) -> Array:
    """Rotation vectors Log(R) [rad], the inverse of `exp_rotation`.

    Parameters
    ----------
    R : array_like, shape (..., 3, 3)

    Returns
    -------
    ndarray, shape (..., 3)
    """
    q = quaternion_from_matrix(R)
    q = np.where(q[..., 3:] < 0.0, -q, q)  # of the two that are one rotation, the shorter
    half = np.arctan2(np.linalg.norm(q[..., :3], axis=-1), q[..., 3])[..., None]
    return q[..., :3] * _angle_over_sine(half)


def slerp(time: Array, R: Array, at: Array) -> Array:
    """Rotations between those of some times, along the shortest arc; beyond the ends the last turn goes on.

    Parameters
    ----------
    time : ndarray, shape (n,), increasing, n of at least 2
    R : ndarray, shape (n, 3, 3)
    at : ndarray, shape (m,)

    Returns
    -------
    ndarray, shape (m, 3, 3)
    """
    k = np.searchsorted(time, at).clip(1, len(time) - 1)
    share = (at - time[k - 1]) / (time[k] - time[k - 1])
    return np.asarray(R[k - 1] @ exp_rotation(share[:, None] * log_rotation(transpose(R[k - 1]) @ R[k])))


def _angle_over_sine(half: Array) -> Array:
    """Angle over the sine of its half, of half angles [rad]; a series where the sine vanishes."""
    angle = 2.0 * half
    small, square = angle <= 1e-3, angle**2
    series = 2.0 + square / 12.0 + 7.0 * square**2 / 2880.0
    return np.where(small, series, angle / np.sin(np.where(small, 1.0, half)))


def quaternion_from_matrix(R: ArrayLike) -> Array:
    """Unit quaternions x, y, z, w of rotation matrices, by their largest component (Shepperd 1978).

    Parameters
    ----------
    R : array_like, shape (..., 3, 3)

    Returns
    -------
    ndarray, shape (..., 4)
    """
    R = np.asarray(R, dtype=float)
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    rows = np.empty((*R.shape[:-2], 4, 4))  # 4 q q^T, of which each row is the quaternion but for its length
    rows[..., :3, :3] = R + transpose(R)
    rows[..., _XYZ, _XYZ] += 1.0 - trace[..., None]
    rows[..., 3, :3] = rows[..., :3, 3] = R[..., [2, 0, 1], [1, 2, 0]] - R[..., [1, 2, 0], [2, 0, 1]]
    rows[..., 3, 3] = 1.0 + trace
    diagonal = np.concatenate([R[..., _XYZ, _XYZ], trace[..., None]], axis=-1)
    largest = np.argmax(diagonal, axis=-1)[..., None, None]
    q = np.take_along_axis(rows, largest, axis=-2)[..., 0, :]
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


_XYZ = [0, 1, 2]
UNIT = 0.01  # by which the length of a unit quaternion that somebody wrote may differ from 1


def matrix_from_quaternion(xyzw: ArrayLike) -> Array:
    """Rotation matrices, shape (..., 3, 3), of quaternions x, y, z, w, shape (..., 4).

    NaN where a quaternion's length differs from 1 by more than `UNIT`, as that of the zeros which stand for none.
    """
    q = np.asarray(xyzw, dtype=float)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    unit = np.divide(q, length, where=np.abs(length - 1.0) < UNIT, out=np.full(q.shape, np.nan))
    x, y, z, w = np.moveaxis(unit, -1, 0)
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def turned(time: Array, rate_b: Array) -> Array:
    """Rotations from the body's axes at each sample of a gyro to those at the first, shape (n, 3, 3).

    Parameters
    ----------
    time : ndarray, shape (n,) [s]
    rate_b : ndarray, shape (n, 3) [rad/s]
    """
    steps = exp_rotation(0.5 * (rate_b[1:] + rate_b[:-1]) * np.diff(time)[:, None])
    return np.array(list(accumulate(steps, np.matmul, initial=np.eye(3))))


def earth_rate_n(latitude: float) -> Array:
    """Angular rate of the Earth in n [rad/s], shape (3,); latitude in radians."""
    return EARTH_RATE * np.array([np.cos(latitude), 0.0, -np.sin(latitude)])


EARTH_RATE = 7.292115e-5  # [rad/s], WGS 84


def signed_permutations() -> Array:
    """The 48 ways to name three axes and their senses, the identity first; shape (48, 3, 3)."""
    out = np.zeros((48, 3, 3))
    for H, (order, signs) in zip(out, product(permutations(range(3)), product((1.0, -1.0), repeat=3)), strict=True):
        H[range(3), order] = signs
    return out


def transpose(R: Array) -> Array:
    """Transpose of the last two axes."""
    return R.swapaxes(-1, -2)


def rotate(R: Array, v: ArrayLike) -> Array:
    """``R @ v`` over leading axes.

    Parameters
    ----------
    R : ndarray, shape (..., m, 3)
    v : array_like, shape (..., 3)

    Returns
    -------
    ndarray, shape (..., m)
    """
    out: Array = (R @ np.asarray(v)[..., None])[..., 0]
    return out
