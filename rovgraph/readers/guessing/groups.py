"""The columns of a table by sensor and source, the proposal for each, and their units by ranges and physics.

Gravity gives the unit of a specific force. A gyro's unit follows from the turns of another sensor,

    d(heading)/dt = b w . down,    d(f)/dt = -b w x f,

and a DVL's from the sinking by the pressure sensor. Changes of means over a second are compared, so that offsets and
biases drop out.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from rovgraph.dates import DateRules, Order
from rovgraph.errors import InputError
from rovgraph.geometry import Array, cross
from rovgraph.log.latitudes import is_placeholder, unit_of
from rovgraph.log.stamps import UNIX_S
from rovgraph.log.streams import is_optional
from rovgraph.log.tables import Table
from rovgraph.log.units import UNITS, quantities
from rovgraph.readers.guessing.names import Meaning, meaning
from rovgraph.readers.inertial import GRAVITY, MOST
from rovgraph.sensors.pressure import SAME_PA, units_of_air

Sureness = Literal["sure", "likely", "unsure"]
STEP_S = 0.0005, 0.5  # of an IMU's samples [s]: each lasts less than the factor between two units of time
SLOW_STEP_S = 0.02, 20.0  # of other rows
SPEED = 0.05, 5.0  # of a vehicle, most of the time [m/s]
METRIC = "m/s", "cm/s", "mm/s"  # units that a velocity may have unstated: in feet, a DVL and a depth agree as well
DEEPEST = 12e3  # [m]
SHALLOW = 100.0  # numbers of a depth up to this are taken for metres without other evidence
WINDOW = 1.0  # [s]
PERIODS = 3.0
ENOUGH = 20  # changes that are compared
CORRELATION = 0.7  # correlation of two sensors that show the same
TOLERANCE = 1.5  # factor between the changes of two sensors that show the same
TILT_CORRELATION, TILT_TOLERANCE = 0.4, 3.0  # of gravity's direction, beside which a vehicle accelerates
TURNING = 0.02, 3.0  # rates that a vehicle has at most, of which no two units have both [rad/s]
WIDE = 1.0  # spread of an angle that no degrees below a turn have [rad]


@dataclass(frozen=True)
class ForeignSignal:
    """A vector or a number by one sensor.

    Attributes
    ----------
    time : ndarray, shape (n,), increasing [s]
    values : ndarray, shape (n, k), finite
    """

    time: Array
    values: Array

    def integrated(self) -> "ForeignSignal":
        steps = 0.5 * (self.values[1:] + self.values[:-1]) * np.diff(self.time)[:, None]
        return ForeignSignal(self.time, np.vstack([np.zeros((1, self.values.shape[1])), np.cumsum(steps, axis=0)]))

    @property
    def period(self) -> float:
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else np.inf


@dataclass(frozen=True)
class UnitGuess:
    """A unit, a key of `UNITS` or "", with a reason."""

    unit: str
    why: str
    sureness: Sureness


def ratio(a: ForeignSignal, b: ForeignSignal, regressed: bool = False) -> tuple[float, float]:
    """How many times the changes of a are those of b, signed, and their correlation; NaN, 0 where there are too few.

    Parameters
    ----------
    regressed : a alone is disturbed, by a motion that is not in b
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


def _changes(signal: ForeignSignal, edges: Array) -> Array:
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


def rates_that_tilt(force: ForeignSignal, rate: ForeignSignal, units: Sequence[str]) -> list[str]:
    """Those units of a rate that explain how gravity turns in the instrument; all where it does not show."""
    f = np.column_stack([np.interp(rate.time, force.time, column) for column in force.values.T])
    turned = ForeignSignal(rate.time, -cross(rate.values, f)).integrated()
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
    return [unit for unit in METRIC if SPEED[0] <= speed * UNITS["speed"][unit] <= SPEED[1]]


def depths_by_size(depth: Array, stated: str) -> list[str]:
    """Units in which a depth, shape (n,), is one of the sea."""
    if stated:
        return [stated]
    most = float(np.abs(depth).max(initial=0.0))
    return [unit for unit, factor in UNITS["length"].items() if most * factor <= DEEPEST]


def pressures_by_air(pressure: Array, stated: str) -> UnitGuess:
    """Unit of an absolute pressure, shape (n,), the least of which is the air's."""
    factors = UNITS["pressure"]
    least, most = (float(np.nanquantile(pressure, q)) for q in (0.01, 0.99))
    of_air = units_of_air(least, factors)
    unit = stated or (of_air[-1] if of_air else "Pa")
    if (most - least) * factors[unit] < SAME_PA:
        return UnitGuess(unit, "hardly changes: it may be of the air in a housing", "unsure")
    if stated:
        return UnitGuess(stated, "stated", "sure")
    if not of_air:
        return UnitGuess(unit, f"is at least {least:.4g}, and no air's in any unit: state it", "unsure")
    return UnitGuess(unit, f"is at least {least:.4g}, the air's", "likely")


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


VECTORS = {
    "acc": ("acc_x", "acc_y", "acc_z"),
    "gyr": ("gyr_x", "gyr_y", "gyr_z"),
    "mag": ("mag_x", "mag_y", "mag_z"),
    "ahrs": ("ahrs_roll", "ahrs_pitch", "ahrs_yaw"),
    "attitude": ("roll", "pitch", "heading"),
    "dvl_heading": ("dvl_heading",),
    "dvl": ("dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid", "dvl_sd"),
    "dvl_water": ("dvl_water_vx", "dvl_water_vy", "dvl_water_vz"),
    "dvl_altitude": ("dvl_altitude",),
    "depth": ("depth",),
    "pressure": ("pressure",),
    "latitude": ("fix_lat", "fix_lon"),
    "north": ("fix_north", "fix_east"),
    "fix_sd": ("fix_sd",),
}
PARTIAL = "attitude"  # whose columns may be of two sources
OTHER = "attitude of another source"
LARGEST = 1e100  # squares of more are infinite
ORDER: tuple[Sureness, ...] = ("sure", "likely", "unsure")


@dataclass(frozen=True)
class ColumnGuess:
    """Guess of a column.

    Attributes
    ----------
    column : as the file calls it
    field : column of a log that it may feed
    unit : that it is in, as a configuration names it; "" = none to state
    why : a phrase
    sureness : "sure" = name and numbers agree, "likely" = one of them does, "unsure" = not proposed
    """

    column: str
    field: str
    unit: str
    why: str
    sureness: Sureness


@dataclass
class Guesses:
    """Guesses of the columns of a table.

    Attributes
    ----------
    columns : in the order of the file
    left : column -> why it feeds nothing
    settings : of a configuration, that the numbers show, such as the mounting of an IMU
    notes : a sentence each
    seconds : column of dates as text -> their times, ndarray, shape (n,) [s]
    """

    columns: list[ColumnGuess] = field(default_factory=list)
    left: dict[str, str] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    seconds: dict[str, Array] = field(default_factory=dict)

    def state(self, section: str, key: str, value: object) -> None:
        """Add a setting."""
        self.settings.setdefault(section, {})[key] = value

    def times(self, table: Table, name: str) -> bool:
        """Whether a column of texts holds times, which are kept; where day and month may be exchanged, it is noted."""
        orders: tuple[Order | None, ...] = (None, "dmy", "mdy")
        for order in orders:
            try:
                self.seconds[name] = table.times(name, DateRules(order))[0]
            except InputError:
                continue
            if order is not None:
                self.state("times", "order", order)
                self.notes.append(f"dates of {name} may have day or month first: see times.order")
            return True
        return False


@dataclass(frozen=True)
class Candidate:
    """A column that holds numbers and has a name that means something."""

    column: str
    values: Array
    meaning: Meaning


@dataclass(frozen=True)
class Group:
    """Columns of one sensor, of one source.

    ``likely`` is why the choice may be wrong, "" = it is clear.
    """

    columns: Mapping[str, Candidate]
    likely: str = ""

    @property
    def stated(self) -> str:
        return next((each.meaning.unit for each in self.columns.values() if each.meaning.unit), "")

    def signal(self, time: Array, names: Sequence[str]) -> ForeignSignal:
        """Rows that have all of these columns and a time, one row a time."""
        values = np.column_stack([self.columns[name].values for name in names])
        rows = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(time))
        rows = rows[np.argsort(time[rows], kind="stable")]
        rows = rows[np.diff(time[rows], prepend=-np.inf) > 0.0]
        return ForeignSignal(time[rows], values[rows])


def candidates_of(table: Table, out: Guesses) -> tuple[dict[str, Candidate], dict[str, Array]]:
    """Columns of numbers whose names mean something, and the others."""
    named, unnamed = {}, {}
    for name in table.names:
        try:
            values = table.numbers(name)
        except InputError:
            if not out.times(table, name):
                out.left[name] = "holds texts, not numbers alone"
                continue
            values = out.seconds[name]
        values = np.where(np.abs(values) < LARGEST, values, np.nan)
        what = meaning(name)
        if not np.isfinite(values).any():
            out.left[name] = "holds no number"
        elif what.field:
            named[name] = Candidate(name, values, what)
        else:
            out.left[name] = what.why
            unnamed[name] = values
    return named, unnamed


def groups_of(candidates: Sequence[Candidate], out: Guesses) -> dict[str, Group]:
    """Columns of each sensor, of the source that has most of them, then most rows."""
    groups: dict[str, Group] = {}
    for name, fields in VECTORS.items():
        sources: dict[str, dict[str, Candidate]] = {}
        for each in candidates:
            if each.meaning.field in fields:
                twin = sources.setdefault(each.meaning.source, {})
                if each.meaning.field in twin:
                    out.left[each.column] = f"{each.meaning.field}, too; {twin[each.meaning.field].column} is taken"
                else:
                    twin[each.meaning.field] = each
        sources = _of_one_unit(_with_shared(sources), out)
        needed = [f for f in fields if not is_optional(f)]
        whole = {s: c for s, c in sources.items() if name == PARTIAL or all(f in c for f in needed)}
        for source in sources.keys() - whole.keys():
            lacking = ", ".join(f for f in needed if f not in sources[source])
            out.left |= {each.column: f"{each.meaning.field} without {lacking}" for each in sources[source].values()}
        if not whole:
            continue
        best = max(whole, key=lambda source: (len(whole[source]), _rows(whole[source])))
        others = [c for source in whole.keys() - {best} for c in whole[source].values()]
        if name == PARTIAL:
            second = {c.meaning.field: c for c in others if c.meaning.field not in whole[best]}
            groups |= {OTHER: Group(second)} if second else {}
            others = [c for c in others if c not in second.values()]
        taken = next(iter(whole[best].values())).column
        out.left |= {c.column: f"{c.meaning.field}, too; the source of {taken} is taken" for c in others}
        groups[name] = Group(whole[best], "one of several" if others else "")
    return groups


def _with_shared(sources: dict[str, dict[str, Candidate]]) -> dict[str, dict[str, Candidate]]:
    """Sources, of which those of optional columns alone belong to the only other one."""
    alone = [s for s, columns in sources.items() if all(is_optional(f) and f != "fix_sd" for f in columns)]
    others = [s for s in sources if s not in alone]
    if len(others) != 1:
        return sources
    shared = {f: each for s in alone for f, each in sources[s].items()}
    return {others[0]: shared | sources[others[0]]}


def _of_one_unit(sources: Mapping[str, dict[str, Candidate]], out: Guesses) -> dict[str, dict[str, Candidate]]:
    """Sources whose columns do not state several units; optional columns in another one are left."""
    kept = {}
    for source, columns in sources.items():
        units = {c.meaning.unit for f, c in columns.items() if c.meaning.unit and not is_optional(f)}
        if len(units) > 1:
            out.left |= {c.column: f"one of several in {' and '.join(sorted(units))}" for c in columns.values()}
            continue
        other = {f: c for f, c in columns.items() if units and c.meaning.unit and c.meaning.unit not in units}
        out.left |= {c.column: f"in {c.meaning.unit}, others in {next(iter(units))}" for c in other.values()}
        kept[source] = {f: c for f, c in columns.items() if f not in other}
    return kept


def _rows(columns: Mapping[str, Candidate]) -> int:
    return int(np.isfinite(np.column_stack([each.values for each in columns.values()])).sum())


def propose(out: Guesses, group: Group, unit: UnitGuess) -> None:
    """Add columns of a group, none surer than its choice."""
    known = quantities()
    for name, each in group.columns.items():
        if name not in known:  # a flag
            out.columns.append(ColumnGuess(each.column, name, "", each.meaning.why, unit.sureness))
            continue
        shared = "its unit as the others state it" if group.stated and not each.meaning.unit else ""
        doubts = [text for text in (group.likely, each.meaning.assumed, shared) if text]
        choice: Sureness = "likely" if doubts else "sure"
        why = "; ".join([each.meaning.why, unit.why, *doubts])
        sureness = max(unit.sureness, choice, key=ORDER.index)
        out.columns.append(ColumnGuess(each.column, name, unit.unit, why, sureness))
