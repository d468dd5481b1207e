"""GPS time, weeks and seconds since 1980 without leap seconds, as Unix time, and back.

Leap seconds are those of IERS Bulletin C; the last was that of 2017.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rovgraph.geometry import Array

EPOCH, WEEK_S = 315_964_800.0, 604_800.0  # in Unix time; [s]
WEEKS = 1356, 4000  # a receiver that states another has not learnt the week: 2006 to 2056
UNIX = 315_532_800.0, 4_102_444_800.0  # 1980, which no clock that counts from its start reaches, to 2100 [s]
_LEAPS = np.array([1136073600.0, 1230768000.0, 1341100800.0, 1435708800.0, 1483228800.0])  # Unix times of leap seconds
_FIRST_LEAP = 13  # seconds that GPS was ahead of UTC before the first of them


def unix_of_gps(week: ArrayLike, seconds: ArrayLike) -> Array:
    """Unix time [s] of weeks and seconds of the week, shape (n,)."""
    ahead = EPOCH + WEEK_S * np.asarray(week, dtype=float) + np.asarray(seconds, dtype=float)
    leaps = np.searchsorted(_LEAPS + _FIRST_LEAP + 1 + np.arange(len(_LEAPS)), ahead, side="right")
    return np.asarray(ahead - _FIRST_LEAP - leaps)


def gps_of_unix(unix: ArrayLike) -> tuple[Array, Array]:
    """Weeks and seconds of the week [s] of Unix times [s], each of their shape."""
    time = np.asarray(unix, dtype=float)
    week, seconds = np.divmod(time - EPOCH + _FIRST_LEAP + np.searchsorted(_LEAPS, time, side="right"), WEEK_S)
    return np.asarray(week), np.asarray(seconds)


def is_unix(time: ArrayLike) -> bool:
    """Whether times [s], any shape, count from 1970."""
    known = np.asarray(time, dtype=float)
    return bool(known.size) and bool(((known >= UNIX[0]) & (known < UNIX[1])).all())


def is_week(week: ArrayLike) -> NDArray[np.bool_]:
    """Whether a receiver knew the week, shape (n,)."""
    known = np.asarray(week, dtype=float)
    return np.asarray((known >= WEEKS[0]) & (known <= WEEKS[1]))
