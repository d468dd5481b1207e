"""Proposes a mapping of the columns of any table, by names, ranges and physics (docs/formats.md).

Names propose; ranges and physics decide units and raise doubt. A column whose name is not recognised is marked unsure
at best, whatever its numbers. May import what `rovgraph.readers` may. Begin with `names` (the words of a column's
name), then `groups` (columns by sensor and source) and `quantities`.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from rovgraph.dates import EPOCHS, DateRules, seconds_of_numbers
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.streams import DATE
from rovgraph.log.tables import Table
from rovgraph.log.units import UNITS
from rovgraph.readers.guessing import groups as physics
from rovgraph.readers.guessing.groups import (
    VECTORS,
    Candidate,
    ColumnGuess,
    Group,
    Guesses,
    UnitGuess,
    candidates_of,
    groups_of,
    propose,
)
from rovgraph.readers.guessing.names import OWN_NAME, Meaning, meaning
from rovgraph.readers.guessing.quantities import guess_doppler, guess_imu, guess_others

IN_ORDER = 0.99  # of stamps that are not before the row above
EVEN = 0.2  # spread of gravity's magnitude over its median
NAMELESS = "its numbers go on; its name does not say so"


def guess_table(table: Table) -> Guesses:
    """Guess the columns of a table.

    Raises
    ------
    InputError : no names of columns, no time
    """
    if all(_is_number(name) for name in table.names):
        raise InputError(
            f"{table.source}: line 1 holds numbers, expected the columns' names; write them above the rows"
        )
    out = Guesses()
    candidates, unnamed = candidates_of(table, out)
    stamps = _time(table, candidates, unnamed, out)
    groups = groups_of([c for c in candidates.values() if c.meaning.field not in ("time", DATE)], out)
    time, unit = _seconds(table, stamps, candidates, groups.get("acc"), out)
    propose(out, Group({"time": stamps}), unit)
    if "acc" not in groups:
        _force_without_a_name(unnamed, out)
    guess_imu(groups, time, out)
    guess_doppler(groups, time, out)
    guess_others(groups, time, out)
    order = {name: place for place, name in enumerate(table.names)}
    out.columns.sort(key=lambda each: order[each.column])
    out.left = {name: out.left[name] for name in sorted(out.left, key=order.__getitem__)}
    return out


def _seconds(
    table: Table, stamps: Candidate, candidates: Mapping[str, Candidate], imu: Group | None, out: Guesses
) -> tuple[Array, UnitGuess]:
    """Times, shape (n,) [s], and the unit of their column; with days of another column where there are some."""
    days = [name for name in table.names if meaning(name).field == DATE]
    for day in days:
        try:
            time, how = table.times(stamps.column, DateRules(), day)
        except InputError:
            continue
        if how and (stamps.column not in out.seconds or "without a date" not in how):
            out.columns.append(ColumnGuess(day, DATE, "", how, "sure"))
            out.left.pop(day, None)
            return time, UnitGuess("", f"beside {day}", "sure")
    out.left |= {day: "a date, of times that have none" for day in days}
    if stamps.column in out.seconds:
        return stamps.values, UnitGuess("", "dates or times of day as text", "sure")
    time, how = seconds_of_numbers(stamps.values)
    if program := next((each for each in EPOCHS if each in how.lower()), ""):
        return time, UnitGuess(program, how, "likely")
    unit = _unit_of_time(stamps, imu)
    return stamps.values * UNITS["time"][unit.unit], unit


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return not text
    return True


def _time(table: Table, candidates: Mapping[str, Candidate], unnamed: Mapping[str, Array], out: Guesses) -> Candidate:
    """The column of stamps, by its name, else one whose numbers increase.

    Raises
    ------
    InputError : nothing can be the time
    """
    named = {name: each for name, each in candidates.items() if each.meaning.field == "time"}
    found = {name: each for name, each in named.items() if _goes_on(each.values)}
    out.left |= {name: "a time that does not go on, or stands in few rows" for name in named.keys() - found.keys()}
    if found:
        best = max(found, key=lambda name: (found[name].meaning.why == OWN_NAME, _distinct(found[name].values)))
        out.left |= {name: f"a time, too; {best} is taken" for name in found if name != best}
        return found[best]
    rising = {name: v for name, v in unnamed.items() if _goes_on(v) and _distinct(v) > max(1, len(v) // 10)}
    if not rising:
        shown = ", ".join(table.names)[:150]
        raise InputError(f"{table.source}: no column that can be the time, in numbers that go on; columns: {shown}")
    name = max(rising, key=lambda name: _distinct(rising[name]))
    del out.left[name]
    return Candidate(name, rising[name], Meaning("time", "", "", NAMELESS))


def _goes_on(values: Array) -> bool:
    known = values[np.isfinite(values)]
    if len(known) < 2 or len(known) < 0.5 * len(values):
        return False
    return bool((np.diff(known) >= 0.0).mean() >= IN_ORDER and known[-1] > known[0])


def _distinct(values: Array) -> int:
    return len(np.unique(values[np.isfinite(values)]))


def _unit_of_time(time: Candidate, imu: Group | None) -> UnitGuess:
    """Unit of stamps, by those of the IMU where there is one."""
    rows = np.isfinite(time.values)
    if imu is not None:
        with_imu = rows & np.isfinite(imu.columns["acc_x"].values)
        rows = with_imu if np.count_nonzero(with_imu) > 1 else rows
    unit = physics.by_time(time.values[rows], imu is not None, time.meaning.unit)
    return replace(unit, sureness="unsure") if time.meaning.why == NAMELESS else unit


def _force_without_a_name(unnamed: Mapping[str, Array], out: Guesses) -> None:
    """Three columns in a row whose magnitude is that of gravity."""
    names = [name for name in unnamed if name in out.left]
    for three in zip(names, names[1:], names[2:], strict=False):
        values = np.column_stack([unnamed[name] for name in three])
        values = values[np.isfinite(values).all(axis=1)]
        if len(values) < physics.ENOUGH:
            continue
        size = np.linalg.norm(values, axis=1)
        unit = physics.by_gravity(values, "")
        if unit.sureness == "sure" and np.std(size) < EVEN * np.median(size) and (np.std(values, axis=0) > 0.0).all():
            why = f"{unit.why} over three columns; their names do not say so"
            for column, name in zip(three, VECTORS["acc"], strict=True):
                del out.left[column]
                out.columns.append(ColumnGuess(column, name, unit.unit, why, "unsure"))
            return
