"""Depth from pressure, and which pressure is that of the surface."""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.interchange.recording import Zero

STANDARD = 101325.0  # of the atmosphere at sea level [Pa]
GRAVITY = 9.80665  # [m/s2]
FRESH = 1000.0  # density of water [kg/m3]
PLAUSIBLE = 50_000.0, 110_000.0  # of air where people dive, mountain lakes included [Pa]


def surface_pressure(stated: float | None, pressure: Array) -> tuple[float, str, bool]:
    """The pressure at depth 0.

    Parameters
    ----------
    stated : what the file says it is [Pa], None = it says nothing
    pressure : ndarray, shape (n,), all that were measured [Pa]

    Returns
    -------
    pressure [Pa], where it comes from, whether that is as good as what a file states
    """
    low, high = PLAUSIBLE
    if stated is not None and low <= stated <= high:
        return stated, "as the file states", True
    said = "not stated" if stated is None else f"stated as {stated / 100.0:.0f} hPa, which no air has"
    sane = pressure[np.isfinite(pressure) & (pressure >= low)]
    least = float(np.quantile(sane, 0.01)) if len(sane) else np.inf  # of outliers none
    if least <= high:
        return least, f"{said}; the least that was measured", False
    return STANDARD, f"{said}, and never measured; the standard atmosphere", False


def zero_of(surface: float, density: float, said: str) -> Zero:
    """The surface as a depth, where it is guessed by the measured pressures."""
    return Zero(surface / (density * GRAVITY), said, surface != STANDARD)


def depth(pressure: Array, surface: float, density: float) -> Array:
    """Depth below the surface [m], shape (n,); impossible pressures are NaN."""
    possible = np.isfinite(pressure) & (pressure >= PLAUSIBLE[0])
    return np.where(possible, (pressure - surface) / (density * GRAVITY), np.nan)
