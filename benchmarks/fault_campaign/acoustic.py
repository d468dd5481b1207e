"""A ship with an acoustic head and receivers, beacons on the bottom, and what they measure of a vehicle.

Times of exchanges are solved, not approximated: the head asks at t0, the transponder hears at t1 and answers after its
turn-around time D, the head hears at t2, with all of them moving (Vickery 1998):

    t1 = t0 + |q(t1) - h(t0)| / c,    t2 = t1 + D + |h(t2) - q(t1 + D)| / c

The direction is that of q(t1 + D) at t2, in the axes of the head. In layered water rays are arcs of circles between
the depths that are given (`ray`), found by bisection of Snell's constant.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from fault_campaign.earth import Array
from fault_campaign.motion import Motion, Profile, attitude, mounting
from fault_campaign.vehicle import Triple

Place = Callable[[Array], Array]  # times, shape (n,), to north, east, depth, shape (n, 3) [m]

STILL, ROLLS, PITCHES = Profile(), Profile(0.0, (), ((0.05, 8.3, 0.4),)), Profile(0.0, (), ((0.03, 6.9, 1.2),))


@dataclass
class Ship:
    """A vessel; arms from a point of it on the waterline.

    Attributes
    ----------
    north, east : of that point [m]
    heading, roll, pitch : [rad]
    antenna, head : arms [m]
    mount_rpy_deg : of the head's axes
    position_sd, heading_error : noise of the antenna's position [m], error of its gyro that lasts [deg]
    rate, heading_rate : of its position and of its attitude [Hz]
    """

    north: Profile = STILL
    east: Profile = STILL
    heading: Profile = STILL
    roll: Profile = ROLLS
    pitch: Profile = PITCHES
    antenna: Triple = (-5.0, 1.0, -12.0)
    head: Triple = (8.0, -2.0, 3.0)
    mount_rpy_deg: Triple = (0.0, 0.0, 0.0)
    position_sd: float = 0.1
    heading_error: float = 0.0
    rate: float = 1.0
    heading_rate: float = 10.0

    def C_ns(self, t: Array) -> Array:
        """From ship axes to n, shape (n, 3, 3)."""
        return attitude(self.roll(t), self.pitch(t), self.heading(t))

    def place(self, arm: Triple) -> Place:
        """Where a point of it is."""

        def at(t: Array) -> Array:
            at_waterline = np.stack([self.north(t), self.east(t), np.zeros_like(t)], axis=-1)
            return at_waterline + self.C_ns(t) @ np.asarray(arm)

        return at

    def says(self, duration: float, rng: np.random.Generator) -> dict[str, pd.DataFrame]:
        """Its position, heading and attitude as a log has them."""
        t, fast = np.arange(0.0, duration, 1.0 / self.rate), np.arange(0.02, duration, 1.0 / self.heading_rate)
        p = self.place(self.antenna)(t)[:, :2] + rng.normal(0.0, self.position_sd, (len(t), 2))
        heading = self.heading(fast) + np.deg2rad(self.heading_error) + rng.normal(0.0, 1e-3, len(fast))
        roll, pitch = (f(fast) + rng.normal(0.0, 5e-4, len(fast)) for f in (self.roll, self.pitch))
        return {
            "ship": pd.DataFrame({"time": t, "ship_north": p[:, 0], "ship_east": p[:, 1]}),
            "ship_heading": pd.DataFrame(
                {"time": fast, "ship_heading": np.mod(heading, 2 * np.pi), "ship_roll": roll, "ship_pitch": pitch}
            ),
        }


@dataclass
class System:
    """An acoustic system.

    Attributes
    ----------
    rate : of replies [Hz]
    range_sd, angle_sd : noise [m], [deg] on the head's axis
    sound_speed, believed_speed : of the water, and the one that ranges are made with [m/s]
    turn_around : [s]
    latency : of stamps [s]
    range_offset : of ranges, by a turn-around time that is off [m]
    layers : depth and sound speed, shape (k, 2) [m], [m/s]; none = ``sound_speed`` everywhere
    arm : of the transponder or transducer on the vehicle [m]
    """

    rate: float = 1.0
    range_sd: float = 0.2
    angle_sd: float = 0.5
    sound_speed: float = 1500.0
    believed_speed: float = 1500.0
    turn_around: float = 0.05
    latency: float = 0.0
    range_offset: float = 0.0
    layers: Sequence[tuple[float, float]] = ()
    arm: Triple = (0.1, 0.0, -0.3)

    def hears(self, here: Array, there: Array) -> tuple[Array, Array]:
        """Seconds that sound takes between two places, and the direction from which it comes, shape (n,) and (n, 3)."""
        away = there - here
        straight = np.linalg.norm(away, axis=1)
        if not len(self.layers):
            return straight / self.sound_speed, away / straight[:, None]
        level = np.hypot(away[:, 0], away[:, 1])
        seconds, elevation = ray(level, here[:, 2], there[:, 2], np.asarray(self.layers, float))
        u = away / np.maximum(level, 1e-9)[:, None] * np.cos(elevation)[:, None]
        u[:, 2] = np.sin(elevation)
        return seconds, u


def ray(level: Array, begin: Array, end: Array, layers: Array) -> tuple[Array, Array]:
    """Time [s] and angle below the horizon at its begin [rad] of rays that do not turn back (Medwin 2005, 3.3).

    Parameters
    ----------
    level, begin, end : distance across, and depths of both ends, shape (n,) [m]
    layers : depth and speed, shape (k, 2)
    """
    upper, lower = np.minimum(begin, end), np.maximum(begin, end)
    edges = np.clip(layers[:, 0], upper[:, None], lower[:, None])
    edges = np.concatenate([upper[:, None], edges, lower[:, None]], axis=1)
    edges.sort(axis=1)
    c, dz = np.interp(edges, *layers.T), np.diff(edges, axis=1)
    c1, c2 = c[:, :-1], c[:, 1:]
    low, high = np.zeros_like(level), 1.0 / c.max(axis=1)
    for _ in range(60):
        p = 0.5 * (low + high)
        s = np.sqrt(np.maximum(1.0 - (p[:, None] * c) ** 2, 1e-18))
        across = np.sum(p[:, None] * (c1 + c2) * dz / (s[:, :-1] + s[:, 1:]), axis=1)
        low, high = np.where(across < level, p, low), np.where(across < level, high, p)
    g = (c2 - c1) / np.maximum(dz, 1e-12)
    bent = np.abs(c2 - c1) > 1e-9
    arc = np.log(c2 * (1.0 + s[:, :-1]) / (c1 * (1.0 + s[:, 1:]))) / np.where(bent, g, 1.0)
    seconds = np.sum(np.where(bent, arc, dz / (c1 * s[:, :-1])), axis=1)
    elevation = np.arccos(np.minimum(p * np.interp(begin, *layers.T), 1.0))
    return seconds, elevation * np.sign(end - begin)


@dataclass
class Exchange:
    """Times of exchanges, asked, answered and heard [s]; the way back [s], and from where it is heard."""

    asked: Array
    answered: Array
    heard: Array
    back: Array
    u_n: Array


def exchange(asks: Place, answers: Place, heard: Array, system: System) -> Exchange:
    """The exchange of which the answer is heard at some times."""
    here, answered, wait = asks(heard), heard.copy(), system.turn_around
    for _ in range(8):
        back, u_n = system.hears(here, answers(answered))
        answered = heard - back
    there_at, asked = answers(answered - wait), answered - wait
    for _ in range(8):
        asked = answered - wait - system.hears(asks(asked), there_at)[0]
    return Exchange(asked, answered, heard, back, u_n)


def on_vehicle(motion: Motion, arm: Triple) -> Place:
    """Where a point of the vehicle is."""
    return lambda t: motion.local(t) + motion.C_nb(t) @ np.asarray(arm)


def fixed(place: Triple) -> Place:
    """Where a beacon is."""
    return lambda t: np.tile(np.asarray(place, float), (len(t), 1))


def usbl(motion: Motion, ship: Ship, system: System, rng: np.random.Generator) -> pd.DataFrame:
    """Range, bearing and elevation in the head's axes, stamped when the reply is heard, or later."""
    t = np.arange(1.7, motion.duration - 1.0, 1.0 / system.rate) + rng.uniform(-0.02, 0.02)
    vehicle, head = on_vehicle(motion, system.arm), ship.place(ship.head)
    one = exchange(head, vehicle, t, system)
    u = np.einsum("nji,nj->ni", ship.C_ns(t), one.u_n) @ mounting(ship.mount_rpy_deg)
    tilted = _perturbed(u, np.deg2rad(system.angle_sd), rng)
    seconds = one.heard - one.asked - system.turn_around
    length = 0.5 * system.believed_speed * seconds + system.range_offset + rng.normal(0.0, system.range_sd, len(t))
    return pd.DataFrame(
        {
            "time": t + system.latency,
            "usbl_range": length,
            "usbl_bearing": np.arctan2(tilted[:, 1], tilted[:, 0]),
            "usbl_elevation": np.arcsin(tilted[:, 2]),
        }
    )


def _perturbed(u: Array, sd: float, rng: np.random.Generator) -> Array:
    """Directions with noise: ``sd`` around the axis of the head, more towards its horizon."""
    level = np.hypot(u[:, 0], u[:, 1])
    sine, cosine = u[:, 1] / np.maximum(level, 1e-9), u[:, 0] / np.maximum(level, 1e-9)
    across = np.stack([-sine, cosine, np.zeros(len(u))], axis=-1)
    up = np.cross(u, across)
    noise = rng.normal(0.0, sd, (len(u), 2))
    noise[:, 1] /= np.maximum(np.abs(u[:, 2]), np.sin(np.deg2rad(5.0)))
    moved = u + noise[:, :1] * across + noise[:, 1:] * up
    return np.asarray(moved / np.linalg.norm(moved, axis=1, keepdims=True))


def ranges(
    motion: Motion, beacons: dict[str, Triple], system: System, rng: np.random.Generator, apart: float = 0.3
) -> pd.DataFrame:
    """Ranges that the vehicle asks of beacons, one after the other, ``apart`` [s]."""
    tables, vehicle = [], on_vehicle(motion, system.arm)
    for k, (name, place) in enumerate(beacons.items()):
        t = np.arange(2.3 + k * apart, motion.duration - 1.0, 1.0 / system.rate)
        one = exchange(vehicle, fixed(place), t, system)
        length = 0.5 * system.believed_speed * (t - one.asked - system.turn_around) + system.range_offset
        noisy = length + rng.normal(0.0, system.range_sd, len(t))
        tables.append(pd.DataFrame({"time": t + system.latency, "range": noisy, "range_beacon": name}))
    return pd.concat(tables, ignore_index=True).sort_values("time", ignore_index=True)


def heard_by_receivers(
    motion: Motion, ship: Ship, receivers: dict[str, Triple], system: System, common_sd: float, rng: np.random.Generator
) -> pd.DataFrame:
    """Ranges one way, without a turn-around, to receivers on a ship, whose clock has one error at a time."""
    t, vehicle, tables = np.arange(1.3, motion.duration - 1.0, 1.0 / system.rate), on_vehicle(motion, system.arm), []
    clock = rng.normal(0.0, common_sd, len(t))
    for name, arm in receivers.items():
        back = exchange(ship.place(arm), vehicle, t, replace(system, turn_around=0.0)).back
        length = system.believed_speed * back + clock + rng.normal(0.0, system.range_sd, len(t))
        tables.append(pd.DataFrame({"time": t + system.latency, "range": length, "range_receiver": name}))
    return pd.concat(tables, ignore_index=True).sort_values("time", kind="stable", ignore_index=True)


@dataclass
class Acoustic:
    """The configuration's part that a careful crew would write of ship and system."""

    ship: Ship = field(default_factory=Ship)
    system: System = field(default_factory=System)

    def usbl(self) -> dict[str, object]:
        """Of a head on the ship."""
        return {
            "ship": {"antenna_m": list(self.ship.antenna), "sd_m": self.ship.position_sd},
            "usbl": {
                "lever_arm_m": list(self.ship.head),
                "beacon_arm_m": list(self.system.arm),
                "turn_around_s": self.system.turn_around,
                "range_sd_m": self.system.range_sd,
                "angle_sd_deg": self.system.angle_sd,
                "sound_speed_mps": self.system.believed_speed,
            },
        }

    def ranges(self, beacons: dict[str, Triple | None], sd: float) -> dict[str, object]:
        """Of beacons, some of them where they were surveyed."""
        listed = []
        for name, place in beacons.items():
            known = {} if place is None else dict(zip(("north_m", "east_m", "down_m"), place, strict=True))
            listed.append({"name": name, **known, **({} if place is None else {"sd_m": sd, "down_sd_m": sd})})
        return {
            "range": {
                "lever_arm_m": list(self.system.arm),
                "turn_around_s": self.system.turn_around,
                "sd_m": self.system.range_sd,
                "sound_speed_mps": self.system.believed_speed,
            },
            "beacons": listed,
        }
