"""Sound in layered water: what ranges and angles say that were made with one speed.

Along a ray cos(angle) / c is constant (Snell). For a range the harmonic mean of the speed between both depths is
enough, to 0.1 m at 1000 m; the angle that a head sees is bent, the more the flatter the ray. `SoundSpeedProfile.trace`
goes through thin layers; with a constant gradient g the closed form that it is tested by is

    t = arccosh(1 + g^2 (X^2 + dz^2) / (2 c1 c2)) / |g|
"""

from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike, NDArray

from rovgraph.errors import InputError, as_path, warn
from rovgraph.geometry import Array
from rovgraph.model.config_sections import FASTEST_MPS, FOOT_M, SLOWEST_MPS

BAR_OF_M = 0.10198  # of water [bar/m]
LAYER_M = 1.0  # of water that is taken as one
BEYOND_M = 1.0  # the end of a profile, that a vehicle may go


# of `sound_speed`: by the power of the pressure [bar], then of the temperature [deg C]
_WATER = (
    (1402.388, 5.03711, -5.80852e-2, 3.3420e-4, -1.478e-6, 3.1464e-9),
    (0.153563, 6.8982e-4, -8.1788e-6, 1.3621e-7, -6.1185e-10),
    (3.1260e-5, -1.7107e-6, 2.5974e-8, -2.5335e-10, 1.0405e-12),
    (-9.7729e-9, 3.8504e-10, -2.3643e-12),
)
_SALT = (
    (1.389, -1.262e-2, 7.164e-5, 2.006e-6, -3.21e-8),
    (9.4742e-5, -1.2580e-5, -6.4885e-8, 1.0507e-8, -2.0122e-10),
    (-3.9064e-7, 9.1041e-9, -1.6002e-10, 7.988e-12),
    (1.100e-10, 6.649e-12, -3.389e-13),
)
_SALT_15 = (-1.922e-2, -4.42e-5), (7.3637e-5, 1.7945e-7)
_SALT_2 = (1.727e-3,), (-7.9836e-6,)


def sound_speed(salinity: ArrayLike, temperature: ArrayLike, depth: ArrayLike) -> Array:
    """Speed of sound in water [m/s], shape of the arguments together.

    Chen and Millero 1977, as in Fofonoff and Millard, UNESCO Technical Papers in Marine Science 44, 1983, p. 46; for 0
    to 40 psu, 0 to 40 deg C.

    Parameters
    ----------
    salinity : [psu]
    temperature : [deg C]
    depth : [m]
    """
    s, t, p = (np.asarray(a, dtype=float) for a in (salinity, temperature, depth))
    p = BAR_OF_M * p
    water, salt, salt_15, salt_2 = (
        sum(polyval(t, row) * p**k for k, row in enumerate(rows)) for rows in (_WATER, _SALT, _SALT_15, _SALT_2)
    )
    return np.asarray(water + s * salt + s**1.5 * salt_15 + s**2 * salt_2)


def is_of_water(speed: Array) -> NDArray[np.bool_]:
    """Which speeds [m/s] sound has in water, of the shape of ``speed``."""
    return np.asarray((speed >= SLOWEST_MPS) & (speed <= FASTEST_MPS))


def is_in_feet(speed: Array) -> NDArray[np.bool_]:
    """Which speeds are those of water in ft/s by their size, of the shape of ``speed``."""
    return is_of_water(FOOT_M * speed)


def look_at_sound_speed(column: str, speed: Array) -> Iterator[tuple[Literal["error"], str, Literal["unit"]]]:
    """Whether a column of speeds of sound, shape (n,), NaN = none, is in ft/s."""
    known = speed[speed > 0.0]
    if 2 * int(is_in_feet(known).sum()) > len(known):
        text = f"its speed of sound is {np.median(known):.0f}; if it is in ft/s, state units: {{{column}: ft/s}}"
        yield "error", text, "unit"


class SoundSpeedProfile:
    """Speed of sound by depth, linear between the depths that are given; beyond them it stays.

    Parameters
    ----------
    depth, speed : ndarray, shape (n,), depth increasing [m], [m/s]
    water : temperature [deg C] and salinity [psu], ndarray, shape (n,) each; None = not known

    Raises
    ------
    InputError : depths that do not increase, speeds of no water
    """

    def __init__(self, depth: Array, speed: Array, water: tuple[Array, Array] | None = None) -> None:
        if len(depth) < 2 or not (np.diff(depth) > 0.0).all() or depth[0] < -BEYOND_M:
            raise InputError(
                "sound.profile: expected two or more depths that increase, in metres and positive down; "
                + _remedy_of_depths(depth)
            )
        if not (speed.min() > SLOWEST_MPS and speed.max() < FASTEST_MPS):
            raise InputError(
                f"sound.profile: speeds from {speed.min():.0f} to {speed.max():.0f}, expected {SLOWEST_MPS:.0f} to "
                f"{FASTEST_MPS:.0f} m/s"
                + (f"; if they are in ft/s, multiply them by {FOOT_M}" if is_in_feet(speed).all() else "")
            )
        self.depth, self.speed, self.water = depth, speed, water

    def mean(self, upper: Array, lower: Array) -> Array:
        """Harmonic mean of the speed between two depths each, shape (n,) [m/s]."""
        edges = np.arange(min(upper.min(), lower.min()) - LAYER_M, max(upper.max(), lower.max()) + 2 * LAYER_M, LAYER_M)
        slowness = np.append(0.0, np.cumsum(LAYER_M / self._in_layers(edges)))
        seconds = np.interp(lower, edges, slowness) - np.interp(upper, edges, slowness)
        here = np.interp(upper, self.depth, self.speed)
        return np.where(np.abs(lower - upper) < 1e-3, here, (lower - upper) / np.where(seconds == 0.0, 1.0, seconds))

    def trace(self, depth: float, angle: Array, seconds: Array) -> tuple[Array, Array]:
        """Where rays are after a time: distance across, and further down, shape (n,) [m]; NaN where one turns back.

        Parameters
        ----------
        depth : where they begin [m]
        angle, seconds : below the horizon [rad], and one way, shape (n,)
        """
        sense = np.where(angle < 0.0, -1.0, 1.0)
        reach = 1.05 * FASTEST_MPS * float(seconds.max(initial=0.0)) + 2 * LAYER_M
        out = np.full((2, len(angle)), np.nan)
        for side in (-1.0, 1.0):
            rows = np.flatnonzero(sense == side)
            edges = depth + side * np.arange(0.0, reach, LAYER_M)
            c = self._in_layers(edges)
            begin = float(np.interp(depth, self.depth, self.speed))
            for k in rows:  # of up to some thousand layers
                cosine = np.cos(angle[k]) / begin * c
                sine = np.sqrt(np.where(cosine < 1.0, 1.0 - cosine**2, np.nan))
                time, across = np.cumsum(LAYER_M / (c * sine)), np.cumsum(LAYER_M * cosine / sine)
                layers = np.append(0.0, time)
                if seconds[k] <= np.nanmax(layers):
                    known = np.isfinite(layers)
                    out[0, k] = np.interp(seconds[k], layers[known], np.append(0.0, across)[known])
                    out[1, k] = side * LAYER_M * np.interp(seconds[k], layers[known], np.flatnonzero(known))
        return out[0], out[1]

    def _in_layers(self, edges: Array) -> Array:
        """Speeds in the middle of layers [m/s]."""
        return np.asarray(np.interp(0.5 * (edges[1:] + edges[:-1]), self.depth, self.speed))

    def warn_beyond(self, deepest: float) -> None:
        """Warn where a vehicle goes deeper than the profile."""
        if deepest > self.depth[-1] + BEYOND_M:
            warn(
                f"sound.profile ends at {self.depth[-1]:.0f} m and the vehicle goes to {deepest:.0f} m: the speed is "
                "taken to stay below; measure it as deep as the dive"
            )


def _remedy_of_depths(depth: Array) -> str:
    if len(depth) < 2:
        return "measure at another depth"
    if np.median(depth) < 0.0:
        return "change the sign of its depths, and sort it by them"
    if len(np.unique(depth)) == len(depth):
        return "sort it by depth"
    return "keep one row of each depth, as of a cast's way down alone"


def profile_of(rows: Sequence[tuple[float, float]] | str | None) -> SoundSpeedProfile | None:
    """A profile from rows of depth and speed, or a table's file; None = none.

    Raises
    ------
    InputError : no such file, no columns that tell the speed, or what `SoundSpeedProfile` refuses
    """
    if rows is None:
        return None
    if isinstance(rows, str):
        return _read(as_path(rows, "sound.profile"))
    table = np.array(rows, float)
    return SoundSpeedProfile(table[:, 0], table[:, 1])


@cache
def _read(path: Path) -> SoundSpeedProfile:
    """A table with columns depth, and sound_speed or temperature [deg C] and salinity [PSU]."""
    import pandas as pd  # not for those without a profile

    try:
        table = pd.read_csv(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as a table of depth and sound_speed ({error})") from None
    table.columns = [str(name).strip().lower() for name in table.columns]
    if "depth" not in table or not ({"sound_speed"} <= {*table} or {"temperature", "salinity"} <= {*table}):
        found = ", ".join(table.columns)
        raise InputError(
            f"{path}: expected columns depth and sound_speed, or depth, temperature and salinity, with commas between "
            f"them; rename those that it has: {found[:100]}"
        )
    columns = [name for name in ("depth", "sound_speed", "temperature", "salinity") if name in table]
    try:
        table = table[columns].dropna().astype(float)
    except ValueError as error:
        raise InputError(f"{path}: {', '.join(columns)} are no numbers ({error})") from None
    depth = table["depth"].to_numpy(float)
    water = None
    if {"temperature", "salinity"} <= {*table}:
        water = table["temperature"].to_numpy(), table["salinity"].to_numpy()
    speed = table["sound_speed"].to_numpy() if "sound_speed" in table else sound_speed(water[1], water[0], depth)  # type: ignore[index]
    return SoundSpeedProfile(depth, speed, water)
