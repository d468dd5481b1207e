"""Latitudes and longitudes that are invalid, or not in degrees, recognised by their numbers.

A receiver without a fix writes an impossible position. Degrees and minutes in one number (4330.5 = 43 deg 30.5
min), 1e-7 degrees, and exchanged columns are beyond the range of degrees in every row, and within it once corrected.
Errors within the range (radians, exchanged columns near the equator) show against the DVL
(`diagnosis.check.fixes`).
"""

import re

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError, warn
from rovgraph.geometry import Array
from rovgraph.log.units import UNITS, Scale

EARTH_M = 111e3  # of a degree of latitude [m]
FEW = 0.1  # of the fixes, that are out of range one by one
APART_DEG = 1.0  # from the others, of a longitude that only looks like a placeholder
COLLAPSED_M = 0.1  # span, to which no unit may shrink fixes that differ
_PLACEHOLDER = re.compile(r"-?(9+(\.9+)?|91|181|214\.748364[78]|2147483647|2147483648)(\.0*)?")
WHOLE = 1e-3  # of 1e-7 degrees, as which a number is whole
_TOLD = 6  # digits
_POSITIONS = {"fix": "fixes", "ship": "positions of the ship"}


def valid_positions(lat: Array, lon: Array, line: NDArray[np.int64], source: str, of: str) -> tuple[Array, Array]:
    """Positions with NaN in place of invalid ones, shape (n,) each [deg].

    Parameters
    ----------
    lat, lon : ndarray, shape (n,), NaN = none
    line, of : of the file, and "fix" or "ship", for messages

    Raises
    ------
    InputError : numbers that are not degrees, with the unit that they may be in

    Warns
    -----
    DataWarning : what was left out
    """
    lat, lon = lat.copy(), lon.copy()
    known = ~np.isnan(lat) & ~np.isnan(lon)
    beyond = known & ((np.abs(lat) > 90.0) | (np.abs(lon) > 360.0))
    unset = known & (lat == 0.0) & (lon == 0.0)
    if unset.any():
        warn(f"{source}: {unset.sum()} {_POSITIONS[of]} at latitude and longitude 0 are invalid and left out")
    none = np.zeros(len(lat), dtype=bool)
    none[beyond] = is_placeholder(lat[beyond]) | is_placeholder(lon[beyond])
    none |= known & (lon == 181.0) & (np.abs(lon - np.nanmedian(np.where(none | unset, np.nan, lon))) > APART_DEG)
    if not (known & ~none & ~beyond).any() and len(np.unique(lat[none])) > 1:
        none &= False  # numbers of all fixes that look like it are positions in another unit
    wild = beyond & ~none
    if wild.any() and wild.sum() > FEW * (known & ~none).sum():
        k = int(np.argmax(wild))
        raise InputError(
            f"{source}: line {line[k]}: latitude {lat[k]:.{_TOLD}g}, longitude {lon[k]:.{_TOLD}g}, expected degrees; "
            + what_unit(lat[known & ~none & ~unset], lon[known & ~none & ~unset], of)
        )
    none |= wild
    if none.any():
        k = int(np.argmax(none))
        said = f"latitude {lat[k]:.{_TOLD}g}, longitude {lon[k]:.{_TOLD}g} in line {line[k]}"
        warn(f"{source}: {none.sum()} {_POSITIONS[of]} are no positions ({said}) and left out")
    lat[none | unset] = np.nan
    return lat, lon


def what_unit(lat: Array, lon: Array, of: str) -> str:
    """Remedy for positions that are not degrees, shape (n,) each, finite."""
    unit = unit_of(lat, lon)
    if unit == "exchanged":
        lat_lon = f"{of}_lat: {of}_lon, {of}_lon: {of}_lat"
        return f"they are exchanged: state columns: {{{lat_lon}}}, with the log's own names"
    if unit == "ddmm":
        told = Scale(form="ddmm")(lat[:1])[0]
        meant = f"degrees and minutes in one number (latitude {told:.5f} deg)"
        return f"they look like {meant}: state units: {{{of}: ddmm}}"
    if unit == "degE7":
        return f"if they are in units of 1e-7 degrees, state units: {{{of}: degE7}}"
    return "write latitude and longitude in degrees"


def unit_of(lat: Array, lon: Array) -> str:
    """Unit of positions that are not degrees, shape (n,) each, finite; "exchanged", or "" where it is unclear."""
    size_lat, size_lon = np.abs(lat), np.abs(lon)
    if size_lat.max() <= 360.0 and size_lon.max() <= 90.0:
        return "exchanged"
    minutes = all(((size % 100.0) < 60.0).all() for size in (size_lat, size_lon))
    if minutes and size_lat.max() <= 9000.0 and size_lon.max() <= 18000.0:
        return "ddmm"
    factor = UNITS["latitude"]["degE7"]
    span = max(float(np.ptp(lat)), float(np.ptp(lon)))
    shrunk = 0.0 < span * factor * EARTH_M < COLLAPSED_M
    whole = all(bool((np.abs(each - np.round(each)) < WHOLE).all()) for each in (lat, lon))
    if size_lat.max() * factor <= 90.0 and size_lon.max() * factor <= 360.0 and whole and not shrunk:
        return "degE7"
    return ""


def is_placeholder(values: Array) -> NDArray[np.bool_]:
    """Which of some numbers, shape (n,), stand for "unknown", such as 91, 181, 999 or 214.7483647."""
    known = np.unique(values[np.isfinite(values)])
    return np.isin(values, [v for v in known.tolist() if _PLACEHOLDER.fullmatch(f"{v:.10g}")])
