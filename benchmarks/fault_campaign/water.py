"""The current as a function of depth, and an ADCP's profiles of it.

The current is a Gauss process of depth (Matern, 3/2), north and east by themselves, and does not change in time.
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from fault_campaign.earth import Array
from fault_campaign.motion import Motion
from fault_campaign.vehicle import Triple, Vehicle

STEP = 2.0  # of depth [m]


@dataclass
class Profiler:
    """An ADCP in the DVL's head, looking down.

    Attributes
    ----------
    cells, length, first : how many, how long [m], and how far the middle of the first one is [m]
    sd : of a cell's velocity, along its axes [m/s]
    period : of its profiles [s]
    correlation : of neighbouring cells
    """

    cells: int = 25
    length: float = 4.0
    first: float = 4.0
    sd: Triple = (0.05, 0.05, 0.02)
    period: float = 2.0
    correlation: float = 0.15


@dataclass
class Current:
    """Of the water, north and east, at depths `STEP` apart.

    Attributes
    ----------
    velocity : shape (n, 2) [m/s]
    """

    velocity: Array

    def at(self, depth: Array) -> Array:
        """Shape (..., 2)."""
        grid = STEP * np.arange(len(self.velocity))
        return np.stack([np.interp(depth, grid, column) for column in self.velocity.T], axis=-1)


def draw(rng: np.random.Generator, deepest: float, sd: float = 0.3, correlation: float = 60.0) -> Current:
    """A current that is drawn."""
    grid = np.arange(0.0, deepest + STEP, STEP)
    r = np.sqrt(3.0) * np.abs(grid[:, None] - grid) / correlation
    root = np.linalg.cholesky(sd**2 * (1.0 + r) * np.exp(-r) + 1e-9 * np.eye(len(grid)))
    return Current(root @ rng.normal(0.0, 1.0, (len(grid), 2)))


def profiles(
    motion: Motion, vehicle: Vehicle, unit: Profiler, current: Current, C_bs: Array, rng: np.random.Generator,
    bottom: float = np.inf,
) -> pd.DataFrame:  # fmt: skip
    """The table log.adcp.csv; cells end at a bottom, and the last of them see it by their side lobes."""
    t = np.arange(1.5, motion.duration, unit.period)
    C_nb = motion.C_nb(t)
    v_b = motion.v_b(t) + np.cross(motion.rate_nb_b(t), np.asarray(vehicle.dvl.arm))
    head = motion.local(t)[:, 2] + (C_nb @ np.asarray(vehicle.dvl.arm))[:, 2]
    far = unit.first + unit.length * np.arange(unit.cells)
    down = np.abs((C_nb @ C_bs)[:, 2, 2])
    depth = head[:, None] + far * down[:, None]
    water_n = np.concatenate([current.at(depth), np.zeros((*depth.shape, 1))], axis=-1)
    if np.isfinite(bottom):
        water_n[depth > bottom - 0.14 * (bottom - head[:, None])] = 0.0  # echoes of the bottom, at 30 degrees
    relative = (v_b[:, None] - np.einsum("nji,nkj->nki", C_nb, water_n)) @ C_bs
    white = rng.normal(0.0, 1.0, (len(t), unit.cells + 1, 3))
    share = 0.5 * (1.0 - np.sqrt(1.0 - 4.0 * unit.correlation**2)) / unit.correlation if unit.correlation else 0.0
    noise = (white[:, 1:] + share * white[:, :-1]) / np.sqrt(1.0 + share**2)  # neighbours share a part
    values = relative + noise * np.asarray(unit.sd)
    reaches = np.isfinite(values[..., 0]) & (depth < bottom)
    columns = {f"v{axis}": values[..., k][reaches] for k, axis in enumerate("xyz")}
    time, ranges = np.broadcast_to(t[:, None], depth.shape), np.broadcast_to(far, depth.shape)
    return pd.DataFrame({"time": time[reaches], "range": ranges[reaches], "cell": unit.length, **columns})
