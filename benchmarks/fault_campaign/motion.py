"""A smooth motion over the rotating ellipsoid, and the strapdown that proves it.

Heading, roll and pitch against the local geographic frame n, and the velocity over ground in
body axes b (forward, starboard, down), are given functions of time. Everything else follows
(Groves 2013, chapter 5):

    v_n = C_nb v_b,   lat' = v_N / (R_N + h),   lon' = v_E / ((R_E + h) cos lat),   h' = -v_D
    w_ib_b = w_nb_b + C_bn (w_ie_n + w_en_n)
    f_b = C_bn (v_n' + (2 w_ie_n + w_en_n) x v_n - g_n)

and at a lever arm l: f_b + w_ib_b' x l + w_ib_b x (w_ib_b x l).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from fault_campaign import earth
from fault_campaign.earth import Array

NODES, WEIGHTS = np.polynomial.legendre.leggauss(3)  # over one sample period
ORIGIN = (np.deg2rad(58.3), np.deg2rad(14.6))  # latitude and longitude where dives begin


@dataclass(frozen=True)
class Profile:
    """A scalar function of time with continuous second derivative.

    Attributes
    ----------
    start : value before everything
    ramps : (begin [s], duration [s], change): quintic steps
    waves : (amplitude, period [s], phase [rad])
    """

    start: float = 0.0
    ramps: Sequence[tuple[float, float, float]] = ()
    waves: Sequence[tuple[float, float, float]] = ()

    def __call__(self, t: Array) -> Array:
        value = np.full_like(t, self.start)
        for begin, duration, change in self.ramps:
            x = np.clip((t - begin) / duration, 0.0, 1.0)
            value += change * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
        for amplitude, period, phase in self.waves:
            value += amplitude * np.sin(2.0 * np.pi * t / period + phase)
        return value

    def rate(self, t: Array) -> Array:
        """First derivative."""
        value = np.zeros_like(t)
        for begin, duration, change in self.ramps:
            x = np.clip((t - begin) / duration, 0.0, 1.0)
            value += change / duration * 30.0 * x**2 * (1.0 - x) ** 2
        for amplitude, period, phase in self.waves:
            value += amplitude * 2.0 * np.pi / period * np.cos(2.0 * np.pi * t / period + phase)
        return value

    def with_waves(self, *waves: tuple[float, float, float]) -> "Profile":
        """The same with more oscillations."""
        return replace(self, waves=(*self.waves, *waves))


def attitude(roll: Array, pitch: Array, heading: Array) -> Array:
    """C_nb, from b to n, shape (n, 3, 3): heading about down, then pitch, then roll."""
    sr, cr, sp, cp, sh, ch = (f(angle) for angle in (roll, pitch, heading) for f in (np.sin, np.cos))
    rows = [
        [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
        [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def mounting(rpy_deg: Sequence[float]) -> Array:
    """C_bs, from an instrument's axes to b, shape (3, 3)."""
    roll, pitch, yaw = (np.array([np.deg2rad(angle)]) for angle in rpy_deg)
    return np.asarray(attitude(roll, pitch, yaw)[0])


@dataclass(frozen=True)
class Motion:
    """A motion of the body's origin.

    Attributes
    ----------
    duration : [s]
    heading, roll, pitch : [rad]
    velocity_b : three profiles [m/s]
    depth : of the start [m]
    origin : latitude and longitude of the start [rad]
    step : between the epochs where the position is integrated [s]
    """

    duration: float
    heading: Profile
    velocity_b: tuple[Profile, Profile, Profile]
    roll: Profile = Profile()
    pitch: Profile = Profile()
    depth: float = 2.0
    origin: tuple[float, float] = field(default=ORIGIN)
    step: float = field(default=0.01, kw_only=True)

    def C_nb(self, t: Array) -> Array:
        """Attitude, shape (n, 3, 3)."""
        return attitude(self.roll(t), self.pitch(t), self.heading(t))

    def rate_nb_b(self, t: Array) -> Array:
        """Rate of b against n, in b, shape (n, 3) [rad/s]."""
        roll, pitch = self.roll(t), self.pitch(t)
        d_roll, d_pitch, d_heading = self.roll.rate(t), self.pitch.rate(t), self.heading.rate(t)
        x = d_roll - np.sin(pitch) * d_heading
        y = np.cos(roll) * d_pitch + np.sin(roll) * np.cos(pitch) * d_heading
        z = -np.sin(roll) * d_pitch + np.cos(roll) * np.cos(pitch) * d_heading
        return np.stack([x, y, z], axis=-1)

    def v_b(self, t: Array) -> Array:
        """Velocity over ground in b, shape (n, 3) [m/s]."""
        return np.stack([v(t) for v in self.velocity_b], axis=-1)

    def v_n(self, t: Array) -> Array:
        """Velocity over ground in n, shape (n, 3) [m/s]."""
        return np.einsum("nij,nj->ni", self.C_nb(t), self.v_b(t))

    @cached_property
    def _grid(self) -> tuple[Array, Array]:
        """Epochs, and latitude, longitude and height at them, shape (n, 3), by Simpson's rule."""
        t = np.arange(-10.0, self.duration + 10.0 + self.step, self.step)
        v, middle = self.v_n(t), self.v_n(t[:-1] + self.step / 2)

        def integrate(f: Array, f_middle: Array) -> Array:
            steps = self.step / 6.0 * (f[:-1] + 4.0 * f_middle + f[1:])
            total = np.concatenate([[0.0], np.cumsum(steps)])
            return total - np.interp(0.0, t, total)

        def halfway(x: Array) -> Array:
            return 0.5 * (x[1:] + x[:-1])

        height = -self.depth + integrate(-v[:, 2], -middle[:, 2])
        latitude = np.full_like(t, self.origin[0])
        for _ in range(3):  # radii change little within a dive
            meridian, _unused = earth.radii(latitude)
            scale = 1.0 / (meridian + height)
            latitude = self.origin[0] + integrate(v[:, 0] * scale, middle[:, 0] * halfway(scale))
        _, transverse = earth.radii(latitude)
        scale = 1.0 / ((transverse + height) * np.cos(latitude))
        longitude = self.origin[1] + integrate(v[:, 1] * scale, middle[:, 1] * halfway(scale))
        return t, np.stack([latitude, longitude, height], axis=-1)

    def geodetic(self, t: Array) -> Array:
        """Latitude [rad], longitude [rad] and height [m], shape (n, 3): cubic Hermite between the grid's epochs."""
        grid, position = self._grid
        k = np.clip(np.searchsorted(grid, t, side="right") - 1, 0, len(grid) - 2)
        x = ((t - grid[k]) / self.step)[:, None]
        ends = [position[k + end] for end in (0, 1)]
        slopes = [self.step * self._geodetic_rate(p, self.v_n(grid[k + end])) for end, p in enumerate(ends)]
        value = (1.0 + 2.0 * x) * (1.0 - x) ** 2 * ends[0] + x**2 * (3.0 - 2.0 * x) * ends[1]
        return np.asarray(value + x * (1.0 - x) ** 2 * slopes[0] - x**2 * (1.0 - x) * slopes[1])

    @staticmethod
    def _geodetic_rate(position: Array, v_n: Array) -> Array:
        meridian, transverse = earth.radii(position[:, 0])
        north = v_n[:, 0] / (meridian + position[:, 2])
        east = v_n[:, 1] / ((transverse + position[:, 2]) * np.cos(position[:, 0]))
        return np.stack([north, east, -v_n[:, 2]], axis=-1)

    def local(self, t: Array) -> Array:
        """North, east and depth about the origin, shape (n, 3) [m]."""
        position = self.geodetic(t)
        return earth.local(position[:, 0], position[:, 1], position[:, 2], self.origin)

    def felt(self, t: Array, arm_b: Array) -> tuple[Array, Array]:
        """Specific force at ``arm_b`` and inertial rate, in b, each of shape (n, 3) [m/s^2, rad/s]."""
        C_nb, position, rate_nb = self.C_nb(t), self.geodetic(t), self.rate_nb_b(t)
        v_b = self.v_b(t)
        v_n = np.einsum("nij,nj->ni", C_nb, v_b)
        w_ie = earth.earth_rate(position[:, 0])
        w_en = earth.transport_rate(position[:, 0], position[:, 2], v_n)
        v_dot_b = np.stack([v.rate(t) for v in self.velocity_b], axis=-1)
        f_n = np.einsum("nij,nj->ni", C_nb, v_dot_b + np.cross(rate_nb, v_b)) + np.cross(2.0 * w_ie + w_en, v_n)
        f_n[:, 2] -= earth.gravity(position[:, 0], position[:, 2])
        rate_in_b = np.einsum("nji,nj->ni", C_nb, w_ie + w_en)
        rate, h = rate_nb + rate_in_b, 1e-3
        # the rate of n itself changes by less than 1e-6 rad/s^2
        rate_dot = (self.rate_nb_b(t + h) - self.rate_nb_b(t - h)) / (2.0 * h) - np.cross(rate_nb, rate_in_b)
        at_arm = np.cross(rate_dot, arm_b) + np.cross(rate, np.cross(rate, arm_b))
        return np.asarray(np.einsum("nji,nj->ni", C_nb, f_n) + at_arm), np.asarray(rate)

    def averages(self, t: Array, period: float, arm_b: Array) -> tuple[Array, Array]:
        """Specific force and rate averaged over sample periods centred at ``t``, in b, each of shape (n, 3)."""
        at = [self.felt(t + 0.5 * period * node, arm_b) for node in NODES]
        force, rate = (sum(w * felt[k] for w, felt in zip(WEIGHTS, at, strict=True)) for k in (0, 1))
        return 0.5 * np.asarray(force), 0.5 * np.asarray(rate)


def rotation(vector: Array) -> Array:
    """Rotation matrix of a rotation vector, shape (3, 3) (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    a, b = (1.0, 0.5) if angle < 1e-8 else (np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2)
    return np.asarray(np.eye(3) + a * K + b * K @ K)


def strapdown(force: Array, rate: Array, period: float, C_nb: Array, v_n: Array, geodetic: Array) -> Array:
    """Latitude, longitude and height at the ends of the sample periods, from averaged samples alone.

    The increments get their coning and sculling corrections from the sample before (P. Savage,
    Strapdown Inertial Navigation Integration Algorithm Design, 1998, part 1 eq. 46-55, part 2 eq. 31-38).

    Parameters
    ----------
    force, rate : ndarray, shape (n, 3), averages over adjoining periods, in b
    period : of a sample [s]
    C_nb, v_n, geodetic : at the beginning of the first period

    Returns
    -------
    ndarray, shape (n, 3)
    """
    C_nb, v_n, p = C_nb.copy(), v_n.copy(), geodetic.copy()
    d_angle, d_velocity = rate * period, force * period
    before_angle, before_velocity = np.zeros(3), np.zeros(3)
    out = np.empty_like(force)
    for k, (da, dv) in enumerate(zip(d_angle, d_velocity, strict=True)):
        coning = np.cross(before_angle, da) / 12.0
        sculling = (np.cross(before_angle, dv) + np.cross(before_velocity, da)) / 12.0
        dv_b = dv + 0.5 * np.cross(da, dv) + sculling
        latitude, height = p[0], p[2]
        w_ie, w_en = earth.earth_rate(latitude), earth.transport_rate(latitude, height, v_n)
        half_turn = rotation(-0.5 * period * (w_ie + w_en))
        g_n = np.array([0.0, 0.0, float(earth.gravity(latitude, height))])
        v_new = v_n + half_turn @ C_nb @ dv_b + period * (g_n - np.cross(2.0 * w_ie + w_en, v_n))
        C_nb = rotation(-period * (w_ie + w_en)) @ C_nb @ rotation(da + coning)
        p = p + period * Motion._geodetic_rate(p[None], 0.5 * (v_n + v_new)[None])[0]
        v_n, before_angle, before_velocity = v_new, da, dv
        out[k] = p
    return out
