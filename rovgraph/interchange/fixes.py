"""Satellite fixes of an autopilot, without those that are none."""

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

NO_DILUTION = 99.0  # and more: how receivers say that they do not know their dilution of precision
RANGE_SD_M = 3.0  # of a satellite's range; with the dilution of precision that of a fix
ONE_POINT = "all fixes are of one point, which no receiver does: the origin of the dive, and no fixes"
FEW = 10  # fixes of one point that may be a vehicle at rest


def new_fixes(stamp: Array, lat: Array, lon: Array) -> NDArray[np.bool_]:
    """Which fixes say something new: those that lie somewhere and do not repeat the one before.

    Parameters
    ----------
    stamp : ndarray, shape (n,), of the receiver
    lat, lon : ndarray, shape (n,) [deg]
    """
    somewhere = (np.abs(lat) <= 90.0) & (np.abs(lon) <= 180.0) & ((lat != 0.0) | (lon != 0.0))
    index = np.flatnonzero(somewhere)
    fresh = np.ones(len(index), dtype=bool)
    stood = (np.diff(lat[index]) == 0.0) & (np.diff(lon[index]) == 0.0)
    fresh[1:] = ~stood & (np.diff(stamp[index]) != 0.0)
    new = np.zeros(len(lat), dtype=bool)
    new[index[fresh]] = True
    return new


def one_point(lat: Array, lon: Array) -> tuple[float, float] | None:
    """The point where all of many fixes lie, which somebody has entered: no receiver repeats one to the centimetre."""
    somewhere = (lat != 0.0) | (lon != 0.0)
    points = np.unique(np.column_stack([lat, lon])[somewhere], axis=0)
    return tuple(points[0].tolist()) if somewhere.sum() >= FEW and len(points) == 1 else None
