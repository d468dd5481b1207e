"""Corrects the stamps of faulty clocks, for every reader and every live source.

Stamps are taken in the order in which they were recorded. Stamps of a clock that was not set are left out; a counter
that wraps is continued; a clock that is set by hours, leap seconds, days or 1024 weeks is corrected; stamps that stand
still, or were written with too few digits, are reported.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.disk_columns import holds, steps

STEP_BACK = 1.0  # streams that are written in turn overlap by less [s]
JUMP = 86400.0  # ahead, after which a stamp is of another epoch [s]
LOST = 0.1  # of the rows, that stamps of another epoch may have
NOT_SET = 0.33  # of the rows, that may be from before a clock was set
UNIX_S = 9.5e8, 4.2e9  # what lies within, 2000 to 2103, is taken for Unix time [s]
HOUR_S, DAY_S, WEEK_S = 3600.0, 86400.0, 604_800.0
LEAP_S = 18.0  # that GPS time is ahead of UTC since 2017
ROLLOVER_S = 1024 * WEEK_S  # after which receivers count GPS weeks from zero again
ZONES_S = tuple(sign * HOUR_S * n for n in (*range(1, 15), 3.5, 4.5, 5.5, 5.75, 6.5, 9.5, 10.5) for sign in (1.0, -1.0))
COUNTERS = {  # range [s] -> what counts so far
    0.065536: "16 bits of microseconds",
    4.294967296: "32 bits of nanoseconds",
    65.536: "16 bits of milliseconds",
    4294.967296: "32 bits of microseconds",
    DAY_S: "the time of day",
    WEEK_S: "the time of the week",
    4294967.296: "32 bits of milliseconds",
}
FULL = (4294967295.0, 4294967.295, 4294.967295)  # 0xFFFFFFFF in s, ms, us: no time is known [s]
GAP_S, GAP, LEAST_GAP_S = 60.0, 0.002, 0.5  # where a counter wraps: at most [s], of its range, at least [s]
NEAR_S = 2.0  # between stamps around a setting [s]
SURELY = 0.5  # share of the shorter of two spans that a known difference of clocks makes common
MOVES = 5  # rows that show a setting, on each side of it
ENOUGH = 20  # rows that show whether stamps advance
STILL = 0.95  # of them, that have the stamp of the one before
LOOK = 1000  # rows at the beginning, in the middle and at the end that are looked at first
DIGITS, LARGE = 7, 1e5  # significant digits that are too few for stamps as large as that [s]


def unwrapped(count: Array, wrap: float) -> Array:
    """A counter, shape (n,), without its wraps, which are where it goes back by more than half its range; NaN stays.

    A row that was written late, and is from before a wrap, stays before it.
    """
    out = np.full(len(count), np.nan)
    known = np.flatnonzero(np.isfinite(count))
    turns, turn = np.zeros(len(known)), 0
    for k in steps(count[known], lambda step: np.abs(step) > 0.5 * wrap).tolist():
        turn = max(turn + (1 if count[known[k]] < count[known[k - 1]] else -1), 0)
        turns[k:] = turn
    out[known] = count[known] + wrap * turns
    return out


def counter_range(before: float, after: float) -> float:
    """Range of a counter that wrapped between two stamps, of `COUNTERS`; 0 where it did not [s].

    One step back does not prove a short counter: a late message causes it, too.
    """
    for wrap in (seconds for seconds in COUNTERS if seconds > GAP_S):
        if wrap - _near(wrap) < before <= wrap and 0.0 <= after < _near(wrap):
            return wrap
    return 0.0


def mend(
    time: Array,
    where: str,
    line: NDArray[np.int64] | None = None,
    step_back: float = STEP_BACK,
    not_set: float = NOT_SET,
) -> tuple[Array, list[str]]:
    """Stamps of one clock in the order in which they were recorded, corrected as far as possible.

    Parameters
    ----------
    time : ndarray, shape (n,) [s]; NaN = not known
    where : file and sensor, for messages
    line : of the file, ndarray of int, shape (n,); None = rows are counted from 1
    step_back : by which rows may be earlier than those above them [s]
    not_set : share of rows that may be left out as they are from before a clock was set

    Returns
    -------
    time : ndarray, shape (n,) [s]; NaN where a stamp cannot be used; rows may still be late by ``step_back``
    said : corrections, a sentence each

    Raises
    ------
    InputError : stamps that stand still; too many of another time
    """
    require_moving(time, where)
    if holds(np.isfinite, time) and not len(_breaks(time, step_back)):
        return time, []
    rows = np.flatnonzero(np.isfinite(time))
    stamps, said = np.array(time[rows], dtype=float), []
    what, number = ("row", np.arange(len(time)) + 1) if line is None else ("line", line)
    kept = np.ones(len(rows), bool)
    unset = _unset(stamps)
    if unset.any():
        if unset.mean() > not_set:
            until = f"{what} {number[rows[np.flatnonzero(~unset)[0]]]}"
            raise InputError(
                f"{where}: {_count(unset)} of {len(rows)} rows have stamps of a clock that was not set "
                f"({stamps[unset][0]:.3f} s), until {until}; nothing tells when they were: delete them"
            )
        said.append(
            f"{where}: {_count(unset)} of {len(rows)} rows have stamps of a clock that was not set "
            f"({_values(stamps[unset])}), left out; {_places(number[rows[unset]], what)}"
        )
        kept &= ~unset
    wrap = _counter(stamps[kept])
    if wrap:
        stamps[kept] = unwrapped(stamps[kept], wrap)
        said.append(f"{where}: stamps count {COUNTERS[wrap]} and wrap; they go on")
    kept[np.flatnonzero(kept)[_alone(stamps[kept], step_back)]] = False
    for k, moved in _settings(stamps, np.flatnonzero(kept), step_back):
        said.append(f"{where}: the clock, at {what} {number[rows[k]]}, {moved}")
    usable = np.flatnonzero(kept)
    usable = usable[_longest(stamps[usable], step_back)]
    lost = np.setdiff1d(np.flatnonzero(~unset), usable)
    if lost.size:
        if lost.size > LOST * len(rows):
            order = np.flatnonzero(~unset)
            at = int(order[_breaks(stamps[order], step_back)[0]])
            raise InputError(
                _two_times(where, stamps[at - 1], stamps[at], lost.size / len(rows), what, number[rows[at]])
            )
        told = f"{lost.size} of {len(rows)} rows have stamps of another time ({_values(time[rows[lost]])}, others from "
        said.append(f"{where}: {told}{stamps[usable[0]]:.1f} s), left out; {_places(number[rows[lost]], what)}")
    out = np.full(len(time), np.nan)
    out[rows[usable]] = stamps[usable]
    return out, said


def require_moving(time: Array, where: str) -> None:
    """Check that stamps, shape (n,) [s], advance.

    Raises
    ------
    InputError : they stand still, or were written with too few digits
    """
    if len(time) < ENOUGH or not _still(np.concatenate([time[k : k + LOOK] for k in _looks(len(time))])):
        return
    known = np.asarray(time[np.isfinite(time)])
    if not _still(known):
        return
    values = np.unique(known)
    told = f"{where}: {len(known)} stamps have {len(values)} values" if len(values) > 1 else f"{where}: all stamps are"
    told += f", such as {values[0]:.10g} s" if len(values) > 1 else f" {values[0]:.10g} s"
    if few_digits(values):
        raise InputError(f"{told}: written with too few digits; write them with six decimals (%.6f)")
    raise InputError(
        f"{told}: they stand still; record the time of each measurement, or that of its arrival in a column received "
        "and give --times arrival"
    )


def few_digits(values: Array) -> bool:
    """Whether different stamps, increasing, shape (n,) [s], were written with too few digits."""
    if abs(values[-1]) >= LARGE and all(float(f"{v:.{DIGITS}g}") == v or np.float32(v) == v for v in values[:LOOK]):
        return True
    return len(values) > 1 and bool((np.round(values) == values).all())


def known_offset(
    span: tuple[float, float], other: tuple[float, float], cycle: float = 0.0
) -> tuple[float, str, bool] | None:
    """Offset, of the usual ones, that brings a clock's stamps to another's in Unix time.

    Parameters
    ----------
    span, other : first and last stamp of each [s]
    cycle : those of ``span`` are Unix time but for multiples of this, such as times of day; 0 = all should be Unix time

    Returns
    -------
    what to add to those of ``span`` [s], why, and whether nothing else meets the other's stamps as well; None = nothing
    """
    middle = 0.5 * (sum(other) - sum(span))
    nearest = cycle * round(middle / cycle) if cycle else 0.0
    whole = "whole days" if cycle == DAY_S else "whole weeks"
    dated = [(nearest + cycle * k, f"its stamps have no date: {whole} are added") for k in (0, -1, 1)] if cycle else []
    weeks = [(n * ROLLOVER_S, f"it is {abs(n) * 1024} weeks off, as receivers are that count weeks with ten bits")
             for n in (1, -1, 2, -2)]  # fmt: skip
    zones = [(nearest + by, f"its stamps are {_zone(-by)} from UTC, a time zone") for by in ZONES_S]
    for candidates in (dated or weeks, zones):
        met = sorted(((_met(span, other, by), by, why) for by, why in candidates), key=lambda each: -each[0])
        if met[0][0] > 0.0:
            return met[0][1], met[0][2], met[0][0] > SURELY and met[1][0] < 0.5 * met[0][0]
    return None


def _zone(seconds: float) -> str:
    return f"{seconds / HOUR_S:+.4g} h"


def _met(span: tuple[float, float], other: tuple[float, float], by: float) -> float:
    """The share of the shorter span that lies within the other, if ``span`` is moved by so much [s]."""
    shared = min(span[1] + by, other[1]) - max(span[0] + by, other[0])
    return shared / max(min(span[1] - span[0], other[1] - other[0]), 1e-9)


def _looks(count: int) -> tuple[int, ...]:
    return (0,) if count <= 3 * LOOK else (0, count // 2, count - LOOK)


def _still(time: Array) -> bool:
    time = time[np.isfinite(time)]
    return len(time) >= ENOUGH and bool(np.mean(np.diff(time) == 0.0) > STILL)


def _breaks(time: Array, step_back: float) -> NDArray[np.int64]:
    """Rows whose stamp does not follow that of the row before."""
    shortest = next((wrap for wrap in COUNTERS if len(time) and time.min() >= 0.0 and time.max() <= wrap), np.inf)
    back = min(step_back, 0.5 * shortest)
    return steps(time, lambda step: (step < -back) | (step > JUMP))


def _unset(time: Array) -> NDArray[np.bool_]:
    """Stamps of a clock that was not set: beside Unix time all from before 2000 and after 2103."""
    unix = (time > UNIX_S[0]) & (time < UNIX_S[1])
    if unix.mean() > LOST:
        return np.asarray(~unix)
    return np.isin(time, FULL)


def _counter(time: Array) -> float:
    """The range of a counter that wraps, as `COUNTERS` has it; 0 where stamps are of none."""
    if len(time) < 2 or time.min() < 0.0:
        return 0.0
    back = np.flatnonzero(np.diff(time) < 0.0)
    usual = float(np.median(np.abs(np.diff(time))))
    for wrap in COUNTERS:
        near = max(_near(wrap), 3.0 * usual)
        if time.max() <= wrap:
            return wrap if ((time[back] > wrap - near) & (time[back + 1] < near)).any() else 0.0
    return 0.0


def _near(wrap: float) -> float:
    """How far from its ends a counter may be before and after a wrap [s]: a dive that ends there is a coincidence."""
    return min(GAP_S, max(LEAST_GAP_S, GAP * wrap), 0.1 * wrap)


def _alone(time: Array, step_back: float) -> NDArray[np.bool_]:
    """Rows whose stamp is wrong by itself: those before and after it are in order, it is not between them."""
    before, after = time[:-2], time[2:]
    outside = (time[1:-1] > after + step_back) | (time[1:-1] < before - step_back)
    return np.pad(outside & (before <= after), 1)[: len(time)]


def _settings(stamps: Array, rows: NDArray[np.int64], step_back: float) -> Iterator[tuple[int, str]]:
    """Move stamps, in place, where a clock was set by an amount that is known, or its date comes late.

    A clock that is set by hours or leap seconds is right afterwards; of two dates 1024 weeks apart, the later is right.

    Yields
    ------
    row of the setting, and what is done
    """
    bounds, late = [0, *_breaks(stamps[rows], step_back).tolist(), len(rows)], 0.0
    for k in range(1, len(bounds) - 1):
        at = bounds[k]
        if min(at - bounds[k - 1], bounds[k + 1] - at) < MOVES:
            continue
        before, after = rows[:at], rows[at:]
        back = float(stamps[rows[bounds[k - 1] : at]].max() - stamps[rows[at]])

        def is_by(amount: float, within: float = NEAR_S, back: float = back) -> bool:
            return -0.5 < amount - back < within

        if is_by(ROLLOVER_S) or is_by(-ROLLOVER_S):
            moved = after if back > 0.0 else before
            stamps[moved] += ROLLOVER_S
            what = "from there on" if back > 0.0 else "before it"
            yield int(rows[at]), f"is 1024 weeks off; stamps {what} are moved by as much"
        elif days := next((by for by in (DAY_S, WEEK_S) if is_by(by)), 0.0):
            stamps[after] += days
            late += days
            yield int(rows[at]), f"has a date that comes late; stamps from there on are moved by {days:+.0f} s"
        elif late and is_by(-late):
            stamps[after] -= late
            yield int(rows[at]), f"has its date again; stamps from there on are moved by {-late:+.0f} s"
            late = 0.0
        elif by := next((by for by in ZONES_S if by > 0.0 and is_by(by)), LEAP_S if is_by(LEAP_S, 0.5) else 0.0):
            stamps[before] -= by
            yield int(rows[at]), f"is set by {-by:+.0f} s; stamps before it are moved by as much"


def _longest(time: Array, step_back: float) -> NDArray[np.int64]:
    """Indices of the longest piece without a jump, and of the pieces around it that go on in its order."""
    pieces = np.split(np.arange(len(time)), _breaks(time, step_back))
    longest = max(range(len(pieces)), key=lambda k: len(pieces[k]))
    kept = [pieces[longest]]
    for piece in pieces[longest + 1 :]:
        if -step_back <= time[piece[0]] - time[kept[-1]].max() <= JUMP:
            kept.append(piece)
    for piece in reversed(pieces[:longest]):
        if -step_back <= time[kept[0][0]] - time[piece].max() <= JUMP:
            kept.insert(0, piece)
    return np.concatenate(kept)


def _two_times(where: str, before: float, after: float, share: float, what: str, number: int) -> str:
    """That a file holds stamps of two times, and what to do: only a file with lines can be cut."""
    goes = "goes back" if after < before else "jumps"
    told = (
        f"{where}: {what} {number}: time {goes} from {before:.3f} to {after:.3f} s, and {share:.0%} of the rows are of "
    )
    told += "another time than the others; was the clock set, or do two dives follow each other? "
    if what != "line":
        return f"{told}Give each dive a file of its own"
    return (
        f"{told}Cut the file before that line and read each dive by itself; if a clock was set there, read both parts "
        "together and state what to add to the stamps of one: --shift FILE=SECONDS"
    )


def _count(rows: NDArray[np.bool_]) -> int:
    return int(np.count_nonzero(rows))


def _values(stamps: Array) -> str:
    """The first and last of some stamps that are left out."""
    first, last = float(stamps[0]), float(stamps[-1])
    return f"{first:.1f} s" if first == last else f"{first:.1f} to {last:.1f} s"


def _places(numbers: NDArray[np.int64], what: str) -> str:
    """The first and last of some rows or lines."""
    return f"in {what} {numbers[0]}" if len(numbers) == 1 else f"in {what}s {numbers[0]} to {numbers[-1]}"
