"""Bottom and water tracks of Nortek's DVLs, as channels of a log.

Velocities are those of the instrument, along its X, Y and Z: forward, starboard and down as it is drawn.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.interchange.recording import Channel

FRAME = "X, Y, Z of the instrument: forward, starboard, down as it is drawn"
LONGEST_DELAY_S = 5.0  # from a stamp to the echo; more is none
BAR = 1e5  # [Pa]


@dataclass(frozen=True)
class Track:
    """A track of n pings.

    Attributes
    ----------
    time : of the records [s]
    delay : from there to the echo [s], ndarray, shape (n,)
    velocity : of the instrument, shape (n, 3); NaN = none [m/s]
    sd : figure of merit of each axis, shape (n, 3); NaN = none [m/s]
    distance : to the bottom, shape (n, beams); NaN = none [m]
    beams : velocity along each beam, shape (n, beams); NaN = none [m/s]
    merit : figure of merit of each beam, shape (n, beams) [m/s]
    """

    time: Array
    delay: Array
    velocity: Array
    sd: Array
    distance: Array
    beams: Array
    merit: Array

    @property
    def stamp(self) -> Array:
        """When the bottom was heard [s]."""
        known = np.isfinite(self.delay) & (np.abs(self.delay) < LONGEST_DELAY_S)
        return self.time + np.where(known, self.delay, 0.0)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which pings have a velocity on all axes."""
        return np.asarray(np.isfinite(self.velocity).all(axis=1))


def bottom_channels(track: Track, name: str, clock: str) -> Iterator[Channel]:
    """Velocity over the bottom, and altitude."""
    valid = track.valid
    vx, vy, vz = np.where(valid[:, None], track.velocity, np.nan).T
    sd = np.sqrt(np.mean(track.sd**2, axis=1))
    columns = {"dvl_vx": vx, "dvl_vy": vy, "dvl_vz": vz, "dvl_valid": valid.astype(float)}
    if np.isfinite(sd).any():
        columns["dvl_sd"] = np.where(valid, sd, np.nan)
    yield Channel("dvl", {"time": track.stamp, **columns}, f"{name}: {', '.join(columns)}", FRAME, clock)
    seen = np.isfinite(track.distance)
    if (any_ := seen.any(axis=1)).any():
        mean = np.nansum(track.distance[any_], axis=1) / seen[any_].sum(axis=1)
        yield Channel("dvl_altitude", {"time": track.stamp[any_], "dvl_altitude": mean}, f"{name}: distance", "", clock)


def water_channels(track: Track, name: str, clock: str) -> Iterator[Channel]:
    """Velocity through the water."""
    if (valid := track.valid).any():
        names = "dvl_water_vx", "dvl_water_vy", "dvl_water_vz"
        columns = dict(zip(names, track.velocity[valid].T, strict=True))
        yield Channel("dvl_water", {"time": track.stamp[valid], **columns}, f"{name}: velocity", FRAME, clock)


def beam_table(track: Track) -> dict[str, Array]:
    """What each beam measured."""
    of_beams = {"velocity": track.beams, "distance": track.distance, "fom": track.merit}
    count = track.beams.shape[1]
    columns = {f"{name}_{k + 1}": values[:, k] for name, values in of_beams.items() for k in range(count)}
    return {"time": track.stamp, **columns}


def where_bits(values: Array, status: NDArray[np.integer], first: int) -> Array:
    """Values, NaN where their bit of the status is not set: the first column has the bit ``first``."""
    bits = (status[:, None] >> (first + np.arange(values.shape[1]))) & 1
    return np.where(bits == 1, values, np.nan).astype(float)
