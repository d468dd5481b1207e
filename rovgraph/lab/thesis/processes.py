"""Process models of the thesis's filters, and the attitude that some of them take as given.

Constant acceleration and rate in b (2.9) and in n (2.8):

    a' = -w x a    v' = a - w x v    p' = R_nb v    w' = 0    q' = 1/2 T(q) w
    a' = 0         v' = a            p' = v         w' = 0    q' = 1/2 T(q) w

attitude and rate given (4.1): the first three of (2.9), linear in the state. The same with
the hydrodynamic model (4.2), M = mI + M_a, F the forces of thrusters and drag:

    v' = M^-1 (F - w x M v)    p' = R_nb v

All are discretised by forward Euler (2.26), ``x <- x + dt x'``, ``F = I + dt A``.

A process of several filters side by side is made from theirs by ``together``; states,
intervals and epochs then have a leading axis for the filters.

For 4.1 and 4.2 the inertial unit gives attitude and rate. The thesis uses the MTi's own fused attitude, which a log may
have (``ahrs_*``), with the calibration of its heading at the means. Without it the accelerometer levels each sample, as
if the vehicle did not accelerate, and the magnetometer gives the heading; such an attitude is far noisier than a fused
one.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol, Self

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import (
    Array,
    cross,
    exp_rotation,
    level_from_force,
    matrix_from_rpy,
    right_jacobian,
    skew,
    transpose,
)
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.thesis.core import RATES, SECOND, Epochs, Index, Linearized, Polynomials, diagonal, matrix, times
from rovgraph.lab.thesis.variants import Filter, Numbers
from rovgraph.log import Log
from rovgraph.model.calibration import Belief
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.hydrodynamics import Hydrodynamics
from rovgraph.model.thesis import SAMPLE_S


@dataclass(frozen=True)
class KnownMotion:
    """Attitude and rate at the IMU's epochs.

    Attributes
    ----------
    R_nb : ndarray, shape (n, 3, 3)
    w_b : ndarray, shape (n, 3) [rad/s]
    source : where the attitude is from, for people
    """

    R_nb: Array
    w_b: Array
    source: str


def known_motion(log: Log, config: Config, beliefs: dict[str, Belief], gyr_bias_b: Array) -> KnownMotion:
    """Attitude and rate that 4.1 and 4.2 take as given.

    Parameters
    ----------
    log, config : of the dive
    beliefs : of the calibration variables; the compass stands at its means
    gyr_bias_b : ndarray, shape (3,), taken off the rate [rad/s]

    Raises
    ------
    InputError : the log has neither the IMU's attitude nor a magnetometer
    """
    imu, R_bs = log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    level = level_from_force(imu.data[:, :3] @ R_bs.T)
    if "ahrs" in log:
        R_nb, source = _fused(log, config, beliefs, level), "the IMU's own attitude"
    elif "mag" in log:
        R_nb = _magnetic(log, config, beliefs, level)
        source = "levelled by the accelerometer, heading from the magnetometer: the log has no ahrs_*"
    else:
        raise InputError(
            f"{log.source}: this filter takes the attitude as given, which needs ahrs_yaw (with ahrs_roll, ahrs_pitch) "
            "or the magnetometer mag_x, mag_y, mag_z"
        )
    return KnownMotion(R_nb, imu.data[:, 3:] @ R_bs.T - gyr_bias_b, source)


def _undeviated(magnetic: Array, offset: Array, curve: Array) -> Array:
    """Heading h with ``h + A + B sin h + C cos h = magnetic``, by fixed-point iteration; shape (n,)."""
    heading = magnetic
    for _ in range(5):
        heading = magnetic - offset[0] - curve[0] * np.sin(heading) - curve[1] * np.cos(heading)
    return heading


def _fused(log: Log, config: Config, beliefs: dict[str, Belief], level: Array) -> Array:
    """The IMU's own attitude turned to b, at the IMU's epochs; tilt from ``level`` where it has none."""
    ahrs, imu, R_bs = log["ahrs"], log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    yaw = _undeviated(ahrs["ahrs_yaw"], beliefs["ahrs_offset"].mean, beliefs["ahrs_deviation"].mean)
    yaw = yaw + np.deg2rad(config.environment.declination_deg)
    tilt = np.column_stack([ahrs["ahrs_roll"], ahrs["ahrs_pitch"]])
    if np.isfinite(tilt).all():
        R_nb = matrix_from_rpy(np.column_stack([tilt, yaw])) @ R_bs.T
        nowhere = np.zeros((len(ahrs), 3))
        return Trajectory.certain(ahrs.time, nowhere, R_nb, nowhere).clamped(imu.time).R_nb
    at = np.interp(imu.time, ahrs.time, np.unwrap(yaw))
    return matrix_from_rpy(np.column_stack([level, at]))


def _magnetic(log: Log, config: Config, beliefs: dict[str, Belief], level: Array) -> Array:
    """Levelled attitude with the heading of the levelled field; the field is interpolated."""
    mag, imu, R_bs = log["mag"], log["imu"], mount_matrix(config.imu.mount_rpy_deg)
    length = np.linalg.norm(mag.data, axis=1).mean()
    field_b = (mag.data / length - beliefs["hard_iron"].mean) @ R_bs.T
    field_b = np.column_stack([np.interp(imu.time, mag.time, column) for column in field_b.T])
    flat = matrix_from_rpy(np.column_stack([level, np.zeros(len(level))]))
    field = np.einsum("nij,nj->ni", flat, field_b)
    magnetic = np.arctan2(-field[:, 1], field[:, 0])
    yaw = _undeviated(magnetic, beliefs["mag_offset"].mean, beliefs["mag_deviation"].mean)
    return matrix_from_rpy(np.column_stack([level, yaw + np.deg2rad(config.environment.declination_deg)]))


Layout = dict[str, slice]  # a, v, p, w, q, acc_bias, gyr_bias, mag_bias, mount -> place in the state

SIZES = {"a": 3, "v": 3, "p": 3, "w": 3, "q": 4, "acc_bias": 3, "gyr_bias": 3, "mag_bias": 3, "mount": 3}
MOTION = ("a", "v", "p", "w", "q")
_LEVI_CIVITA = np.moveaxis(skew(np.eye(3)), 0, -1)  # skew(u) = _LEVI_CIVITA @ u


def layout(*names: str) -> Layout:
    """The state made of these parts, in this order."""
    ends = np.cumsum([SIZES[n] for n in names]).tolist()
    return {n: slice(end - SIZES[n], end) for n, end in zip(names, ends, strict=True)}


def length(places: Layout) -> int:
    """Number of scalars of a state."""
    return sum(SIZES[name] for name in places)


def moving(places: Layout) -> int:
    """Number of scalars before those that are constant but for their walk."""
    return max(int(place.stop) for name, place in places.items() if name in MOTION)


class Process(Protocol):
    """A process model.

    Attributes
    ----------
    layout : of its state
    """

    @property
    def layout(self) -> Layout: ...

    def step(self, x: Array, dt: float | Array, epoch: Index) -> Linearized:
        """The state ``dt`` seconds on, from IMU epoch ``epoch``, and F."""
        ...

    def noise(self, x: Array) -> Array:
        """Q of one second, shape (..., n, n), or the diagonal alone, by ``diagonal``."""
        ...

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        """The process of several filters side by side."""
        ...


def noise_per_second(places: Layout, numbers: Numbers) -> Array:
    """Diagonal of Q of one second from the printed ones of a sample of 10 ms, shape (n,)."""
    q = np.zeros(length(places))
    values: dict[str, tuple[float, ...] | float] = {
        "a": numbers.acceleration,
        "w": numbers.rate,
        "acc_bias": numbers.acc_bias,
        "gyr_bias": numbers.gyr_bias,
        "mag_bias": numbers.mag_bias,
        "mount": numbers.mount,
    }
    if "a" not in places:
        values["v"] = numbers.acceleration
    for name, value in values.items():
        if name in places:
            q[places[name]] = value
    return q / SAMPLE_S


class ConstantAcceleration:
    """Acceleration and rate are constant in b (2.9) or n (2.8).

    Parameters
    ----------
    variant : Filter, motion "body" or "earth"
    """

    def __init__(self, variant: Filter) -> None:
        self._body = variant.motion == "body"
        self._exact = self._body and variant.coriolis == "exact"
        names = [n for n in SIZES if n != "mount" or variant.misalignment]
        self.layout = layout(*names)
        self._rate = self._right_hand_side()
        self._q = noise_per_second(self.layout, variant.numbers)
        frame = "body" if self._body else "earth"
        isotropic = len(set(variant.numbers.acceleration)) == 1
        self._turned_noise = variant.noise_frame not in (None, frame) and not isotropic

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        whole._rate = Polynomials.together([m._rate for m in members])
        whole._q = np.stack([m._q for m in members])
        whole._turned_noise = any(m._turned_noise for m in members)
        return whole

    def _right_hand_side(self) -> Polynomials:
        """x' of (2.9) or (2.8)."""
        s, n = self.layout, length(self.layout)
        rate = Polynomials(n, n)
        rate.add(s["v"], np.eye(3), s["a"])
        rate.add(s["q"], 0.5 * RATES, s["w"], s["q"])
        rate.add(s["p"], np.eye(3), s["v"])
        if self._body:
            for moved in ("a", "v"):
                rate.add(s[moved], -_LEVI_CIVITA, s[moved], s["w"])
            rate.add(s["p"], 0.5 * SECOND, s["v"], s["q"], s["q"])  # R_nb = I + q' SECOND q / 2
        return Polynomials.together([rate])

    def step(self, x: Array, dt: float | Array, epoch: Index) -> Linearized:
        new, F = self._rate.step(x, dt)
        if self._exact:
            self._turn_exactly(x, new, F, np.asarray(dt)[..., None])
        return new, F

    def _turn_exactly(self, x: Array, new: Array, F: Array, dt: Array) -> None:
        """a <- E a, v <- E (v + dt a) with E = Exp(-w dt), in place of Euler's I - dt S(w)."""
        s = self.layout
        turn = -dt * x[..., s["w"]]
        E, Jr = exp_rotation(turn), right_jacobian(turn)
        a, v = x[..., s["a"]], x[..., s["v"]] + dt * x[..., s["a"]]
        new[..., s["a"]], new[..., s["v"]] = times(E, a), times(E, v)
        dt = dt[..., None]
        F[..., s["a"], s["a"]] = F[..., s["v"], s["v"]] = E
        F[..., s["v"], s["a"]] = dt * E
        F[..., s["a"], s["w"]] = dt * (E @ skew(a) @ Jr)
        F[..., s["v"], s["w"]] = dt * (E @ skew(v) @ Jr)

    def noise(self, x: Array) -> Array:
        if not self._turned_noise:
            return self._q
        R_nb = matrix(x[..., self.layout["q"]])
        to_own = transpose(R_nb) if self._body else R_nb
        Q, a = self._q[..., None] * np.eye(self._q.shape[-1]), self.layout["a"]
        Q[..., a, a] = to_own @ Q[..., a, a] @ transpose(to_own)
        return Q


def _euler(A: Array, dt: Array) -> Array:
    """I + dt A; ``A`` is overwritten."""
    A *= dt[..., None]
    diagonal(A)[...] += 1.0
    return A


class KnownAttitude:
    """Acceleration constant in b, attitude and rate given (4.1).

    Parameters
    ----------
    variant : Filter
    known : attitude and rate at the IMU's epochs
    """

    def __init__(self, variant: Filter, known: KnownMotion) -> None:
        self.layout = layout("a", "v", "p", *(["acc_bias"] if variant.accelerometer else []))
        self._given = Epochs(known.R_nb), Epochs(skew(known.w_b))
        self._q = noise_per_second(self.layout, variant.numbers)

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        R_nb, turning = (Epochs.together(rows) for rows in zip(*(m._given for m in members), strict=True))
        whole._given = R_nb, turning
        whole._q = np.stack([m._q for m in members])
        return whole

    def step(self, x: Array, dt: float | Array, epoch: Index) -> Linearized:
        s, A = self.layout, np.zeros((*x.shape, x.shape[-1]))
        R_nb, turning = (given.at(epoch) for given in self._given)
        A[..., s["a"], s["a"]] = A[..., s["v"], s["v"]] = -turning
        A[..., s["v"], s["a"]], A[..., s["p"], s["v"]] = np.eye(3), R_nb
        F = _euler(A, np.asarray(dt)[..., None])
        return times(F, x), F

    def noise(self, x: Array) -> Array:
        return self._q


class HydrodynamicModel:
    """Velocity from thrusters and drag, attitude and rate given (4.2).

    Parameters
    ----------
    variant : Filter
    known : attitude and rate at the IMU's epochs
    vehicle : Hydrodynamics
    force_b : ndarray, shape (n, 3), of the thrusters at the IMU's epochs [N]
    """

    def __init__(self, variant: Filter, known: KnownMotion, vehicle: Hydrodynamics, force_b: Array) -> None:
        self.layout = layout("v", "p")
        self._given = Epochs(known.R_nb), Epochs(known.w_b), Epochs(force_b)
        self._vehicle = vehicle
        self._q = noise_per_second(self.layout, variant.numbers)

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        R_nb, w_b, force_b = (Epochs.together(rows) for rows in zip(*(m._given for m in members), strict=True))
        whole._given = R_nb, w_b, force_b
        whole._vehicle = _fleet([m._vehicle for m in members])
        whole._q = np.stack([m._q for m in members])
        return whole

    def step(self, x: Array, dt: float | Array, epoch: Index) -> Linearized:
        v, p, dt = self.layout["v"], self.layout["p"], np.asarray(dt)[..., None]
        R_nb, w_b, force_b = (given.at(epoch) for given in self._given)
        acceleration, slopes = self._vehicle.acceleration(x[..., v], w_b, force_b)
        A = np.zeros((*x.shape, x.shape[-1]))
        A[..., v, v], A[..., p, v] = slopes["velocity"], R_nb
        return x + dt * np.concatenate([acceleration, times(R_nb, x[..., v])], axis=-1), _euler(A, dt)

    def noise(self, x: Array) -> Array:
        return self._q


def _fleet(vehicles: Sequence[Hydrodynamics]) -> Hydrodynamics:
    """What (4.2) takes of several vehicles, side by side."""
    return replace(
        vehicles[0],
        mass=np.stack([v.mass for v in vehicles]),
        drag_linear=np.stack([v.drag_linear for v in vehicles]),
        drag_quadratic=np.stack([v.drag_quadratic for v in vehicles]),
    )


def centripetal(w_b: Array, lever_arm_b: Array) -> Array:
    """w x (w x l), shape (..., 3) [m/s^2]."""
    return cross(w_b, cross(w_b, lever_arm_b))
