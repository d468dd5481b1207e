"""The columns of a table by sensor and source, and what is proposed for each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rovgraph.dates import DateRules, Order
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.interchange.guessing.names import Meaning, meaning
from rovgraph.interchange.guessing.physics import Signal, Sureness, UnitGuess
from rovgraph.log.streams import is_optional
from rovgraph.log.units import quantities
from rovgraph.tables import Table

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
    """What a column may be.

    Attributes
    ----------
    column : as the file calls it
    field : column of a log that it may feed
    unit : that it is in, as a configuration names it; "" = none to state
    why : a phrase
    sureness : "sure" = name and numbers agree, "likely" = one of them says so, "unsure" = not proposed
    """

    column: str
    field: str
    unit: str
    why: str
    sureness: Sureness


@dataclass
class Guesses:
    """What the columns of a table may be.

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

    ``likely`` tells why the choice may be wrong, "" = nothing does.
    """

    columns: Mapping[str, Candidate]
    likely: str = ""

    @property
    def stated(self) -> str:
        return next((each.meaning.unit for each in self.columns.values() if each.meaning.unit), "")

    def signal(self, time: Array, names: Sequence[str]) -> Signal:
        """Rows that have all of these columns and a time, one row a time."""
        values = np.column_stack([self.columns[name].values for name in names])
        rows = np.flatnonzero(np.isfinite(values).all(axis=1) & np.isfinite(time))
        rows = rows[np.argsort(time[rows], kind="stable")]
        rows = rows[np.diff(time[rows], prepend=-np.inf) > 0.0]
        return Signal(time[rows], values[rows])


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
