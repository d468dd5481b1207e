"""GPS weeks and times of week as Unix time."""

import numpy as np

from rovgraph.geometry import Array

EPOCH = 315_964_800.0  # of GPS time, in Unix time [s]
LEAP_S = 18.0  # GPS time less UTC since 2017
WEEK_S = 604_800.0
FIRST_LEAP = 13  # GPS time less UTC from 1999 on [s]
LATER_LEAPS = np.array([  # Unix times from which it is a second more each
    1_136_073_600.0, 1_230_768_000.0, 1_341_100_800.0, 1_435_708_800.0, 1_483_228_800.0,
])  # fmt: skip
WEEKS = 990, 4000  # 1998 to 2056: what a receiver that knows the date may state


def unix_of_gps(seconds: Array) -> Array:
    """Unix time of seconds since the GPS epoch, shape (n,); right from 1999 on."""
    late = EPOCH + np.asarray(seconds, dtype=float)
    leaps = FIRST_LEAP + np.searchsorted(LATER_LEAPS + FIRST_LEAP + np.arange(1, len(LATER_LEAPS) + 1), late, "right")
    return np.asarray(late - leaps)


def unwrapped_week(tow: Array) -> Array:
    """Times of week that go on over the end of a week, shape (n,) [s]; NaN stay where they are."""
    out = np.full(len(tow), np.nan)
    known = np.isfinite(tow)
    weeks = np.concatenate([[0], np.cumsum(np.diff(tow[known]) < -0.5 * WEEK_S)])[: int(known.sum())]
    out[known] = tow[known] + WEEK_S * weeks
    return out
