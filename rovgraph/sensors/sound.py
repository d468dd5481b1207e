"""Sound in layered water: what ranges and angles say that were made with one speed.

Along a ray cos(angle) / c is constant (Snell). For a range the harmonic mean of the speed between both depths is
enough, to 0.1 m at 1000 m; the angle that a head sees is bent, the more the flatter the ray. `SoundSpeedProfile.trace`
goes through thin layers; with a constant gradient g the closed form that it is tested by is

    t = arccosh(1 + g^2 (X^2 + dz^2) / (2 c1 c2)) / |g|
"""

from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from rovgraph.errors import InputError, as_path, warn
from rovgraph.geometry import Array

SLOWEST_MPS, FASTEST_MPS = 1300.0, 1700.0
LAYER_M = 1.0  # of water that is taken as one
BEYOND_M = 1.0  # the end of a profile, that a vehicle may go


class SoundSpeedProfile:
    """Speed of sound by depth, linear between the depths that are given; beyond them it stays.

    Parameters
    ----------
    depth, speed : ndarray, shape (n,), depth increasing [m], [m/s]

    Raises
    ------
    InputError : depths that do not increase, speeds of no water
    """

    def __init__(self, depth: Array, speed: Array) -> None:
        if len(depth) < 2 or not (np.diff(depth) > 0.0).all() or depth[0] < -BEYOND_M:
            raise InputError(
                "sound.profile: expected two or more depths that increase, in metres and positive down; "
                "sort it by depth, or change the sign"
            )
        if not (speed.min() > SLOWEST_MPS and speed.max() < FASTEST_MPS):
            raise InputError(
                f"sound.profile: speeds from {speed.min():.0f} to {speed.max():.0f}, expected {SLOWEST_MPS:.0f} to "
                f"{FASTEST_MPS:.0f} m/s; 1 ft/s is 0.3048 m/s"
            )
        self.depth, self.speed = depth, speed

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
        raise InputError(f"{path}: expected columns depth and sound_speed, or depth, temperature and salinity")
    columns = ["depth", "sound_speed"] if "sound_speed" in table else ["depth", "temperature", "salinity"]
    try:
        table = table[columns].dropna().astype(float)
    except ValueError as error:
        raise InputError(f"{path}: {', '.join(columns)} are no numbers ({error})") from None
    depth = table["depth"].to_numpy(float)
    if "sound_speed" in table:
        return SoundSpeedProfile(depth, table["sound_speed"].to_numpy(float))
    try:
        import gsw
    except ImportError:
        raise InputError(f"{path}: temperature and salinity need gsw; pip install rovgraph[acoustics]") from None
    pressure = 1.0198 * depth  # [dbar]
    speed = gsw.sound_speed_t_exact(table["salinity"].to_numpy(float), table["temperature"].to_numpy(float), pressure)
    return SoundSpeedProfile(depth, np.asarray(speed))
