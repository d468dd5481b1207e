"""The current as a function of depth, and an ADCP's profiles of it.

The current is a Gauss process of depth (Matern, 3/2), north and east by themselves. A restless one has another on it
that changes in time (exponential correlation over `FAST_S` and `FAST_M`).
"""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.interpolate import RegularGridInterpolator
from scipy.signal import lfilter

from fault_campaign.earth import Array
from fault_campaign.motion import Motion
from fault_campaign.vehicle import Triple, Vehicle

STEP = 2.0  # of depth [m]
FAST_S, FAST_M = 200.0, 15.0  # over which what changes in time is correlated
GRID_S, GRID_M = 10.0, 5.0  # between its nodes


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
    fast : shape (k, m, 2), what changes at times and depths `GRID_S` and `GRID_M` apart [m/s]; None = nothing
    """

    velocity: Array
    fast: Array | None = None

    def at(self, depth: Array, time: Array) -> Array:
        """Shape (..., 2), at depths and times of one shape."""
        grid = STEP * np.arange(len(self.velocity))
        slow = np.stack([np.interp(depth, grid, column) for column in self.velocity.T], axis=-1)
        if self.fast is None:
            return slow
        nodes = GRID_S * np.arange(self.fast.shape[0]), GRID_M * np.arange(self.fast.shape[1])
        return slow + RegularGridInterpolator(nodes, self.fast)((time, depth))


def draw(
    rng: np.random.Generator, deepest: float, seconds: float = 0.0, fast: float = 0.0, sd: float = 0.3,
    correlation: float = 60.0,
) -> Current:  # fmt: skip
    """A current that is drawn; ``fast`` is the sd of what changes in time [m/s]."""
    grid = np.arange(0.0, deepest + STEP, STEP)
    r = np.sqrt(3.0) * np.abs(grid[:, None] - grid) / correlation
    root = np.linalg.cholesky(sd**2 * (1.0 + r) * np.exp(-r) + 1e-9 * np.eye(len(grid)))
    velocity = root @ rng.normal(0.0, 1.0, (len(grid), 2))
    if not fast:
        return Current(velocity)
    v = rng.normal(0.0, 1.0, (int(seconds / GRID_S) + 2, int(deepest / GRID_M) + 2, 2))
    for axis, kept in ((0, np.exp(-GRID_S / FAST_S)), (1, np.exp(-GRID_M / FAST_M))):
        np.moveaxis(v, axis, 0)[0] /= np.sqrt(1.0 - kept**2)  # of a process that has long begun
        v = lfilter([np.sqrt(1.0 - kept**2)], [1.0, -kept], v, axis=axis)
    return Current(velocity, fast * v)


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
    water_n = np.concatenate(
        [current.at(depth, np.broadcast_to(t[:, None], depth.shape)), np.zeros((*depth.shape, 1))], axis=-1
    )
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
