"""The series of a dive against time, as figures and pages show them: value and sd in the unit shown.

They come from the columns of a trajectory, in memory (`Trajectory.columns`) or from its file. Speed is that over ground
in the horizontal plane; its variance is u^T P u, u the direction of travel, P the covariance of the velocity.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array

FIRST_S = 1.0  # in which a poorly known start would set the scale of an axis
USUAL = (1.0, 99.0)  # percentiles of the band that an axis shows


@dataclass(frozen=True)
class Series:
    """One quantity against the time of its trajectory.

    Attributes
    ----------
    name, unit : in words, and of both arrays
    value, sd : ndarray, shape (n,); NaN where it is not known
    """

    name: str
    unit: str
    value: Array
    sd: Array


def motion(column: Callable[[str], Array], low: float) -> dict[str, Series]:
    """Depth, attitude, velocity and speed.

    Parameters
    ----------
    column : name of a trajectory's column -> ndarray, shape (n,), NaN where it has none; ``cov_v_north_east`` is zero
        where it is not known
    low : lower end of the heading [deg], as of `lower_end`
    """
    v_n, v_e = column("v_north"), column("v_east")
    speed = np.hypot(v_n, v_e)
    u_n, u_e = v_n / np.maximum(speed, 1e-6), v_e / np.maximum(speed, 1e-6)
    P_ne = np.nan_to_num(column("cov_v_north_east"))
    variance = (u_n * column("v_north_sd")) ** 2 + (u_e * column("v_east_sd")) ** 2 + 2.0 * u_n * u_e * P_ne
    found = {
        "depth": Series("depth", "m", column("down"), column("down_sd")),
        "heading": Series("heading", "°", within(column("yaw"), low), np.rad2deg(column("yaw_sd"))),
        "speed": Series("speed", "m/s", speed, np.sqrt(np.clip(variance, 0.0, None))),
    }
    for name in ("roll", "pitch"):
        found[name] = Series(name, "°", np.rad2deg(column(name)), np.rad2deg(column(f"{name}_sd")))
    for name in ("north", "east", "down"):
        found[name] = Series(name, "m/s", column(f"v_{name}"), column(f"v_{name}_sd"))
    return found


def bottom(time: Array, down: Array, ping: Array, altitude: Array) -> Array:
    """Depth of the bottom under each ping [m].

    Parameters
    ----------
    time, down : ndarray, shape (n,), of the trajectory
    ping, altitude : ndarray, shape (m,), time and height over the bottom
    """
    return np.asarray(np.interp(ping, time, down) + altitude)


def within(heading: Array, low: float) -> Array:
    """Heading [rad] in degrees from ``low`` to ``low + 360``."""
    return np.asarray((np.rad2deg(heading) - low) % 360.0 + low)


def lower_end(heading: Array) -> float:
    """Lower end of the heading axis [deg], 0 or -180, whichever breaks the line less often."""
    jumps = {low: int(np.sum(np.abs(np.diff(within(heading, low))) > 180.0)) for low in (0.0, -180.0)}
    return min(jumps, key=lambda low: jumps[low])


def unwrapped(time: Array, angle_deg: Array, *others: Array) -> tuple[Array, ...]:
    """Lines of a wrapped angle with NaN put in where it jumps, so that no line crosses.

    Parameters
    ----------
    time, angle_deg, others : ndarray, shape (n,)

    Returns
    -------
    the same arrays, longer by the number of jumps
    """
    at = np.flatnonzero(np.abs(np.diff(angle_deg)) > 180.0) + 1
    return tuple(np.insert(np.asarray(x, float), at, np.nan) for x in (time, angle_deg, *others))


def span(time: Array, value: Array, sd: Array, width: float) -> tuple[float, float]:
    """What an axis has to show of a line and its band of ``width`` sds, but for the first second.

    Parameters
    ----------
    time, value, sd : ndarray, shape (n,)

    Returns
    -------
    low, high : all of the line and most of the band; inf, -inf where nothing is known
    """
    known = np.isfinite(value)
    later = known & (time >= time[0] + min(FIRST_S, 0.1 * float(time[-1] - time[0]))) if len(time) else known
    known = later if later.any() else known
    if not known.any():
        return np.inf, -np.inf
    value, spread = value[known], width * np.nan_to_num(sd[known])
    ends = np.percentile(value - spread, USUAL[0]), np.percentile(value + spread, USUAL[1])
    return float(min(*ends, value.min())), float(max(*ends, value.max()))


def axis_limits(spans: list[tuple[float, float]], least: float = 1e-3) -> tuple[float, float] | None:
    """Ends of an axis that shows all of some spans, and little more; None where nothing is known."""
    low, high = min((s[0] for s in spans), default=np.inf), max((s[1] for s in spans), default=-np.inf)
    margin = max(0.05 * (high - low), least)
    return (low - margin, high + margin) if high >= low else None
