"""Units of foreign columns by ranges and physics.

Gravity gives the unit of a specific force; what turns by one sensor turns by another, which gives the unit of a gyro,

    d(heading)/dt = b w . down,    d(f)/dt = -b w x f,

and what sinks by the DVL sinks by the pressure sensor. Changes of means over a second are compared, so that offsets
and biases drop out.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from rovgraph.geometry import Array, cross
from rovgraph.interchange.inertial import GRAVITY, MOST
from rovgraph.log.latitudes import is_placeholder, unit_of
from rovgraph.log.units import UNITS
from rovgraph.stamps import UNIX_S

Sureness = Literal["sure", "likely", "unsure"]
STEP_S = 0.0005, 0.5  # of an IMU's samples [s]: each lasts less than the factor between two units of time
SLOW_STEP_S = 0.02, 20.0  # of other rows
SPEED = 0.05, 5.0  # of a vehicle, most of the time [m/s]
DEEPEST = 12e3  # [m]
SHALLOW = 100.0  # numbers of a depth up to this are taken for metres where nothing else tells
WINDOW = 1.0  # [s]
PERIODS = 3.0
ENOUGH = 20  # changes that are compared
CORRELATION = 0.7  # correlation of two sensors that show the same
TOLERANCE = 1.5  # factor between the changes of two sensors that show the same
TILT_CORRELATION, TILT_TOLERANCE = 0.4, 3.0  # of gravity's direction, beside which a vehicle accelerates
TURNING = 0.02, 3.0  # rates that a vehicle has at most, of which no two units have both [rad/s]
WIDE = 1.0  # spread of an angle that no degrees below a turn have [rad]


@dataclass(frozen=True)
class Signal:
    """A vector or a number by one sensor.

    Attributes
    ----------
    time : ndarray, shape (n,), increasing [s]
    values : ndarray, shape (n, k), finite
    """

    time: Array
    values: Array

    def integrated(self) -> "Signal":
        steps = 0.5 * (self.values[1:] + self.values[:-1]) * np.diff(self.time)[:, None]
        return Signal(self.time, np.vstack([np.zeros((1, self.values.shape[1])), np.cumsum(steps, axis=0)]))

    @property
    def period(self) -> float:
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else np.inf


@dataclass(frozen=True)
class UnitGuess:
    """A unit, a key of `UNITS` or "", with a reason."""

    unit: str
    why: str
    sureness: Sureness


def ratio(a: Signal, b: Signal, regressed: bool = False) -> tuple[float, float]:
    """How many times the changes of a are those of b, signed, and their correlation; NaN, 0 where there are too few.

    Parameters
    ----------
    regressed : a alone is disturbed, by something else that b does not know
    """
    window = max(WINDOW, PERIODS * a.period, PERIODS * b.period)
    if len(a.time) < 2 or len(b.time) < 2 or not np.isfinite(window):
        return np.nan, 0.0
    edges = np.arange(max(a.time[0], b.time[0]), min(a.time[-1], b.time[-1]), window)
    if len(edges) < ENOUGH + 2:
        return np.nan, 0.0
    y, x = (_changes(signal, edges) for signal in (a, b))
    yy, xx, xy = np.sum(y * y), np.sum(x * x), np.sum(y * x)
    if not (yy > 0.0 and xx > 0.0):
        return np.nan, 0.0
    correlation = float(xy / np.sqrt(yy * xx))
    return float(xy / xx if regressed else np.sign(xy) * np.sqrt(yy / xx)), correlation


def _changes(signal: Signal, edges: Array) -> Array:
    """Changes between the means of successive windows, less their mean, shape (m - 2, k)."""
    integral = signal.integrated().values
    means = np.diff(np.column_stack([np.interp(edges, signal.time, column) for column in integral.T]), axis=0)
    changes = np.diff(means, axis=0) / float(edges[1] - edges[0])
    return np.asarray(changes - changes.mean(axis=0))


def by_time(values: Array, with_imu: bool, stated: str) -> UnitGuess:
    """Unit of stamps, shape (n,), finite and in order.

    Parameters
    ----------
    with_imu : they are those of an IMU's samples
    """
    factors, middle = UNITS["time"], float(np.median(values))
    if unix := [unit for unit, factor in factors.items() if UNIX_S[0] < middle * factor < UNIX_S[1]]:
        if stated and stated not in unix:
            return UnitGuess(
                unix[0], f"Unix time in {unix[0]} by its size, although the name states {stated}", "likely"
            )
        return UnitGuess(unix[0], f"Unix time in {unix[0]} by its size", "sure")
    if stated:
        return UnitGuess(stated, "stated", "sure")
    steps = np.diff(values)
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    low, high = STEP_S if with_imu else SLOW_STEP_S
    fits = [unit for unit, factor in factors.items() if low <= step * factor < high]
    if not fits:
        return UnitGuess("s", f"a step of {step:.3g} fits no unit", "unsure")
    return UnitGuess(fits[0], f"a step of {step:.3g} {fits[0]} between rows", "likely")


def by_gravity(values: Array, stated: str) -> UnitGuess:
    """Unit of a specific force, shape (n, 3)."""
    size = float(np.median(np.linalg.norm(values, axis=1)))
    fits = [u for u in ("m/s2", "g", "mg") if GRAVITY[0] <= UNITS["acceleration"][u] * size <= GRAVITY[1]]
    if not fits:
        return UnitGuess(stated, f"{size:.3g} is usual, which is gravity in no unit", "unsure")
    if stated and UNITS["acceleration"][stated] != UNITS["acceleration"][fits[0]]:
        return UnitGuess(fits[0], f"gravity is {size:.4g}, although the name states {stated}", "likely")
    return UnitGuess(stated or fits[0], f"gravity is {size:.4g}", "sure")


def rates_that_tilt(force: Signal, rate: Signal, units: Sequence[str]) -> list[str]:
    """Those units of a rate that explain how gravity turns in the instrument; all where it does not show."""
    f = np.column_stack([np.interp(rate.time, force.time, column) for column in force.values.T])
    turned = Signal(rate.time, -cross(rate.values, f)).integrated()
    slope, correlation = ratio(force, turned, regressed=True)
    if correlation < TILT_CORRELATION:
        return list(units)
    found = [unit for unit in units if _within(slope / UNITS["rate"][unit], TILT_TOLERANCE)]
    return found or list(units)


def rates_by_size(rate: Array, units: Sequence[str]) -> list[str]:
    """Those units in which a rate, shape (n, 3), is one that a vehicle has."""
    most = float(np.percentile(np.abs(rate - np.median(rate, axis=0)), 99.0))
    return [unit for unit in units if TURNING[0] <= UNITS["rate"][unit] * most <= TURNING[1]]


def angles_by_range(values: Iterable[Array], stated: str) -> list[str]:
    """Units that angles of one source may be in."""
    if stated:
        return [stated]
    most = max((float(np.abs(v).max()) for v in values), default=0.0)
    return ["deg"] if most > MOST["angle"] else ["rad", "deg"]


def speeds_by_size(velocity: Array, stated: str) -> list[str]:
    """Units in which a velocity, shape (n, 3), is one that a vehicle has."""
    if stated:
        return [stated]
    if not len(velocity):
        return []
    speed = float(np.percentile(np.linalg.norm(velocity, axis=1), 90.0))
    return [unit for unit, factor in UNITS["speed"].items() if SPEED[0] <= speed * factor <= SPEED[1]]


def depths_by_size(depth: Array, stated: str) -> list[str]:
    """Units in which a depth, shape (n,), is one of the sea."""
    if stated:
        return [stated]
    most = float(np.abs(depth).max(initial=0.0))
    return [unit for unit, factor in UNITS["length"].items() if most * factor <= DEEPEST]


def agreeing(slope: float, a: tuple[str, Sequence[str]], b: tuple[str, Sequence[str]]) -> list[tuple[str, str]]:
    """Pairs of units in which two sensors show the same.

    Parameters
    ----------
    slope : of `ratio`
    a, b : quantity, and its units that are possible
    """
    return [
        (one, other)
        for one in a[1]
        for other in b[1]
        if _within(abs(slope) * UNITS[a[0]][one] / UNITS[b[0]][other], TOLERANCE)
    ]


def latitudes_by_range(lat: Array, lon: Array, stated: str) -> UnitGuess:
    """Unit of positions on the ellipsoid, shape (n,) each."""
    known = ~(is_placeholder(lat) | is_placeholder(lon)) | (np.abs(lat) <= 90.0) & (np.abs(lon) <= 360.0)
    lat, lon = (lat[known], lon[known]) if known.any() else (lat, lon)
    most_lat, most_lon = float(np.abs(lat).max()), float(np.abs(lon).max())
    fits = [
        unit
        for unit, factor in UNITS["latitude"].items()
        if most_lat * factor <= 90.0 and most_lon * factor <= 180.0 and (unit != "degE7" or most_lat * factor > 0.01)
    ]
    if stated:
        fits_stated = stated in fits or stated == "ddmm"
        return UnitGuess(stated, "stated", "sure") if fits_stated else UnitGuess(stated, "out of range", "unsure")
    if fits == ["deg", "rad"]:
        return UnitGuess("deg", "degrees or radians, both are in range", "unsure")
    if not fits:
        unit = unit_of(lat, lon)
        if unit in ("", "exchanged"):
            why = "latitude and longitude are exchanged" if unit else "out of range in any unit"
            return UnitGuess("deg", why, "unsure")
        return UnitGuess(
            unit, "degrees and minutes" if unit == "ddmm" else f"up to {most_lat:.7g}, {most_lon:.7g}", "sure"
        )
    unit = fits[0]
    return UnitGuess(unit, f"up to {most_lat:.7g}, {most_lon:.7g}", "sure")


def _within(value: float, factor: float) -> bool:
    return bool(1.0 / factor <= value <= factor)
