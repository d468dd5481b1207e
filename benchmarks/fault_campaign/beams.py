"""The head of a DVL beam by beam: where each points, what it measures over a bottom, what the instrument makes of it.

A beam's echo comes from a footprint, not from a point. With a Gaussian two-way pattern of sd s about the axis u, a
bottom that scatters by Lambert's law and sends back (u.m) / r^2 exp(-k r) of what is sent along u (m: its normal,
downwards; r: the range; k: twice the absorption), the mean direction of the echo is

    u (1 - s^2) + s^2 (m - (u.m) u) (3 + k r) / (u.m)

to the second order of s: over a flat bottom a wide beam measures too little speed, and the less, the higher it is.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from fault_campaign.earth import Array
from fault_campaign.motion import Motion
from fault_campaign.vehicle import Triple, Vehicle

Flags = NDArray[np.bool_]


@dataclass
class Bottom:
    """A bottom that undulates, at rest.

    Attributes
    ----------
    depth, amplitude : its mean, and how far it rises and falls [m]
    wavelength, bearing : between crests [m], clockwise from north of the way across them [rad]
    """

    depth: float = 12.0
    amplitude: float = 0.0
    wavelength: float = 300.0
    bearing: float = 0.0

    def at(self, north: Array, east: Array) -> tuple[Array, Array]:
        """Depth [m] and unit normal downwards, shapes (n,), (n, 3)."""
        k = 2.0 * np.pi / self.wavelength
        phase = k * (north * np.cos(self.bearing) + east * np.sin(self.bearing))
        slope = self.amplitude * k * np.cos(phase)
        normal = np.stack([-slope * np.cos(self.bearing), -slope * np.sin(self.bearing), np.ones_like(phase)], axis=-1)
        return self.depth + self.amplitude * np.sin(phase), normal / np.linalg.norm(normal, axis=1, keepdims=True)

    def range(self, p: Array, u: Array) -> Array:
        """From p along unit vectors u, both of shape (n, 3), to it [m]."""
        r = np.full(len(p), self.depth)
        for _ in range(30):
            reached = p + r[:, None] * u
            r = r + 0.9 * (self.at(reached[:, 0], reached[:, 1])[0] - reached[:, 2]) / u[:, 2]
        return r


@dataclass
class Head:
    """A head of four beams; azimuths clockwise from x, forward, seen from above.

    Attributes
    ----------
    angle, azimuths : from the head's z axis, and around it [deg]
    first : number of the first beam
    sd, range_sd : noise of a beam's velocity [m/s] and range [m]
    error_sd, bias_sd : of a beam's angle [deg], of its velocity at rest [m/s], both for ever
    width : of the pattern, one way, between half powers [deg]; 0 = a pencil
    absorption : [dB/m]
    reach : longest range [m]
    error_limit : the instrument refuses a ping whose beams disagree by more [m/s]
    """

    angle: float = 22.5
    azimuths: Sequence[float] = (135.0, 225.0, 315.0, 45.0)
    first: int = 0
    sd: float = 0.0027
    range_sd: float = 0.05
    error_sd: float = 0.1
    bias_sd: float = 0.0005
    width: float = 0.0
    absorption: float = 0.29
    reach: float = 60.0
    error_limit: float = 0.05

    def axes(self, errors: Array | float = 0.0) -> Array:
        """Directions in the head's axes, with errors of the angles [rad], shape (4, 3)."""
        around, off = np.deg2rad(self.azimuths), np.deg2rad(self.angle) + errors
        level = np.sin(off)
        return np.stack([level * np.cos(around), level * np.sin(around), np.cos(off) + 0.0 * around], axis=-1)

    def echo(self, u: Array, normal: Array, r: Array) -> Array:
        """Mean direction from which echoes come, shape (n, 3)."""
        s2 = (np.deg2rad(self.width) / np.sqrt(16.0 * np.log(2.0))) ** 2  # of the pattern, both ways
        k = 0.2 * np.log(10.0) * self.absorption
        along = np.einsum("ni,ni->n", u, normal)
        lean = (normal - along[:, None] * u) * ((3.0 + k * r) / along)[:, None]
        return u * (1.0 - s2) + s2 * lean

    @property
    def velocity_sd(self) -> Triple:
        """Noise of the velocity by all four [m/s]."""
        D = self.axes()
        return [float(sd) for sd in self.sd * np.sqrt(np.diag(np.linalg.inv(D.T @ D)))]


@dataclass
class Pings:
    """What the beams of a head measured.

    Attributes
    ----------
    time : shape (n,)
    velocity, range : along each beam, positive towards the bottom, shape (n, 4)
    valid : shape (n, 4), the instrument calls a beam so
    refused : shape (n,), it makes no velocity of the ping, whatever the beams say
    """

    time: Array
    velocity: Array
    range: Array
    valid: Flags
    refused: Flags


Fault = Callable[[Pings, np.random.Generator], None]


@dataclass
class Beams:
    """A head over a bottom.

    Attributes
    ----------
    faults : what goes wrong with pings
    angle_errors : beyond what ``head.error_sd`` says, of each beam [deg]
    """

    head: Head = field(default_factory=Head)
    bottom: Bottom = field(default_factory=Bottom)
    faults: Sequence[Fault] = ()
    angle_errors: Sequence[float] = (0.0, 0.0, 0.0, 0.0)


def ping(motion: Motion, vehicle: Vehicle, beams: Beams, C_bs: Array, scale: float, rng: np.random.Generator) -> Pings:
    """Pings at the rate of the vehicle's DVL.

    Parameters
    ----------
    C_bs : how the head is mounted
    scale : relative error of velocities and ranges, as by a wrong sound speed
    """
    head, bottom, unit = beams.head, beams.bottom, vehicle.dvl
    t = np.arange(0.13, motion.duration, 1.0 / unit.rate)
    C_nb, arm = motion.C_nb(t), np.asarray(unit.arm)
    p = motion.local(t) + C_nb @ arm
    v_n = np.einsum("nij,nj->ni", C_nb, motion.v_b(t) + np.cross(motion.rate_nb_b(t), arm))
    off = np.deg2rad(rng.normal(0.0, head.error_sd, 4) + beams.angle_errors)
    bias, axes = rng.normal(0.0, head.bias_sd, 4), head.axes(off)
    velocity, far = np.empty((len(t), 4)), np.empty((len(t), 4))
    for k in range(4):
        u = C_nb @ (C_bs @ axes[k])
        r = bottom.range(p, u)
        reached = p + r[:, None] * u
        _, normal = bottom.at(reached[:, 0], reached[:, 1])
        along = np.einsum("ni,ni->n", head.echo(u, normal, r), v_n)
        velocity[:, k] = (1.0 + scale) * along + bias[k] + rng.normal(0.0, head.sd, len(t))
        far[:, k] = (1.0 + scale) * r + rng.normal(0.0, head.range_sd, len(t))
    pings = Pings(t, velocity, far, (far > 0.05) & (far < head.reach), np.zeros(len(t), bool))
    for place, fault in enumerate(beams.faults):
        fault(pings, np.random.default_rng(place))  # of its own: the noise of all else stays
    return pings


def solve(pings: Pings, head: Head) -> tuple[Array, Array, Flags]:
    """What the instrument makes of its beams: velocity, shape (n, 3), error velocity, and whether it stands for it.

    Three beams give a velocity without an error velocity; with fewer, or with an error velocity that is too large, the
    ping is refused.
    """
    D, n = head.axes(), len(pings.time)
    velocity, error, good = np.zeros((n, 3)), np.zeros(n), ~pings.refused
    for k in range(n):
        use = pings.valid[k]
        if use.sum() < 3:
            good[k] = False
            continue
        velocity[k] = np.linalg.lstsq(D[use], pings.velocity[k, use], rcond=None)[0]
        if use.all():
            rest = pings.velocity[k] - D @ velocity[k]
            error[k] = np.sqrt(rest @ rest)
            good[k] &= error[k] < head.error_limit
    return velocity, error, good


def log_columns(pings: Pings, head: Head) -> pd.DataFrame:
    """Velocity of the instrument, and each beam, as columns of a log."""
    velocity, _, good = solve(pings, head)
    table = {"time": pings.time}
    for k, axis in enumerate("xyz"):
        table[f"dvl_v{axis}"] = np.where(good, velocity[:, k], np.nan)
    table["dvl_valid"] = good.astype(float)
    down = np.where(pings.valid, pings.range * head.axes()[:, 2], np.nan)
    seen = pings.valid.sum(axis=1)
    table["dvl_altitude"] = np.where(seen > 0, np.nansum(down, axis=1) / np.maximum(seen, 1), np.nan)
    for k in range(4):
        use = pings.valid[:, k]
        table[f"dvl_beam_valid_{head.first + k}"] = use.astype(float)
        table[f"dvl_beam_velocity_{head.first + k}"] = np.where(use, pings.velocity[:, k], np.nan)
        table[f"dvl_beam_range_{head.first + k}"] = np.where(use, pings.range[:, k], np.nan)
    return pd.DataFrame(table)


def within(begin: float, end: float, pings: Pings) -> Flags:
    """Which pings."""
    return np.asarray((pings.time >= begin) & (pings.time < end))


def lose(which: Sequence[int], begin: float, end: float) -> Fault:
    """Beams that get no echo for a time."""

    def fault(pings: Pings, rng: np.random.Generator) -> None:
        pings.valid[np.ix_(within(begin, end, pings), np.asarray(which))] = False

    return fault


def bias(which: int, by: float, begin: float, end: float) -> Fault:
    """A beam that measures too much for a time [m/s]."""

    def fault(pings: Pings, rng: np.random.Generator) -> None:
        pings.velocity[within(begin, end, pings), which] += by

    return fault


def refuse(share: float, head: Head) -> Fault:
    """Pings, in groups of three, that the instrument refuses, for a reason: 0.09 to 0.41 m/s off.

    As of an A50 seven of ten have four beams that call themselves valid, the others three.
    """

    def fault(pings: Pings, rng: np.random.Generator) -> None:
        n = len(pings.time)
        bad = np.repeat(rng.uniform(size=n // 3 + 1) < share, 3)[:n] & (pings.time > 5.0)
        course, length = rng.uniform(0.0, 2.0 * np.pi, n), rng.uniform(0.09, 0.41, n)
        off = np.stack([length * np.cos(course), length * np.sin(course), np.zeros(n)], axis=-1)
        wrong = off @ head.axes().T + rng.normal(0.0, 0.046, (n, 4))
        pings.velocity[bad] += wrong[bad]
        pings.refused |= bad
        fewer = np.flatnonzero(bad & (rng.uniform(size=n) < 0.3))
        pings.valid[fewer, rng.integers(0, 4, len(fewer))] = False

    return fault


def stated(head: Head, **more: object) -> dict[str, object]:
    """The part of the configuration that says how a head is made; ``more`` of the section dvl."""
    geometry = {"angle_deg": head.angle, "azimuth_deg": list(head.azimuths), "first_number": head.first}
    return {"dvl": {"velocity_sd_mps": head.velocity_sd, "beam_sd_mps": head.sd, "beams": geometry, **more}}
