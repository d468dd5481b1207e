"""Stamps of a channel that are put in order: a clock that was set within a file is told, never believed."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.interchange.recording import Channel
from rovgraph.spilling import steps, taken

STEP_BACK = 1.0  # streams that are written in turn overlap by less [s]
JUMP = 86400.0  # ahead, after which a stamp is of another epoch [s]
UNIX_S = 9.5e8, 4.2e9  # what lies within, 2000 to 2103, is taken for Unix time [s]
LOST = 0.1  # of the rows, that stamps of another epoch may have


def unix_of_calendar(
    year: NDArray[np.int64],
    month: NDArray[np.int64],
    day: NDArray[np.int64],
    hour: NDArray[np.int64],
    minute: NDArray[np.int64],
    second: NDArray[np.int64],
) -> Array:
    """Seconds since 1970 of calendar dates taken for UTC, each argument and the result of shape (n,).

    NaN where a field is outside of its range; days of short months that there are not count on into the next month.
    """
    sound = (month >= 1) & (month <= 12) & (day >= 1) & (day <= 31) & (hour < 24) & (minute < 60) & (second < 60)
    months = np.where(sound, 12 * (year - 1970) + month - 1, 0).astype("datetime64[M]")
    days = months.astype("datetime64[D]").astype(np.int64) + day - 1
    return np.where(sound, 86400.0 * days + 3600.0 * hour + 60.0 * minute + second, np.nan)


def unix_of_text(text: str) -> float:
    """Seconds since 1970 of an ISO 8601 date, which is in UTC where it states no zone.

    Raises
    ------
    ValueError : it is no date
    """
    date = datetime.fromisoformat(text)
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def unwrapped(count: Array, wrap: float) -> Array:
    """A counter, shape (n,), without its wraps, which are where it goes back by more than half its range; NaN stays."""
    out = np.full(len(count), np.nan)
    known = np.isfinite(count)
    out[known] = count[known] + wrap * np.cumsum(np.diff(count[known], prepend=count[known][:1]) < -0.5 * wrap)
    return out


def put_in_order(channel: Channel, file: str) -> tuple[Channel, list[str]]:
    """A channel with its rows in the order of time, and what was done, a sentence each.

    Rows whose stamps jump back, or ahead by a day, are left out where they are few, such as those from before a clock
    was set.

    Raises
    ------
    InputError : no row with a time, or many whose stamps are of another epoch
    """
    where, time = f"{file}: {channel.source}", np.asarray(channel.columns["time"], dtype=float)
    if _increase(time):
        return channel, []
    said: list[str] = []
    kept = None if _of_one_clock(time) else _usable(time, where, said)
    stamps = time if kept is None else time[kept]
    late = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps)))
    if late:
        said.append(f"{where}: {late} rows are earlier than a row above them, sorted")
    order = np.argsort(stamps, kind="stable")
    order = order if kept is None else kept[order]
    if len(order) == len(time) and not late:
        return channel, said
    received = None if channel.received is None else taken(channel.received, order)
    columns = {name: taken(np.asarray(values), order) for name, values in channel.columns.items()}
    return replace(channel, columns=columns, received=received), said


def _increase(time: NDArray[np.float64]) -> bool:
    """Whether all stamps are known and in order, as most are: a large channel is not copied to find out."""
    known = len(time) > 0 and bool(np.isfinite(time[[0, -1]]).all())
    return known and not len(steps(time, lambda step: ~((step >= 0.0) & (step <= JUMP))))


def _of_one_clock(time: NDArray[np.float64]) -> bool:
    """Whether all stamps are known and nearly in order: then all rows are of one epoch, found without a copy."""
    return len(time) > 1 and not len(steps(time, lambda step: ~((step > -0.5 * STEP_BACK) & (step <= JUMP))))


def _usable(time: NDArray[np.float64], where: str, said: list[str]) -> NDArray[np.int64]:
    """Indices of the rows whose stamps can be used; what is left out is said."""
    stamped = np.isfinite(time)
    if not stamped.any():
        raise InputError(f"{where}: no row has a time")
    if not stamped.all():
        said.append(f"{where}: {np.count_nonzero(~stamped)} rows without time left out")
    rows = np.flatnonzero(stamped)
    kept = rows[_of_one_epoch(time[rows])]
    if lost := len(rows) - len(kept):
        odd = np.setdiff1d(rows, kept)[0]
        apart = f"{time[odd]:.1f} s, others from {time[kept[0]]:.1f} s"
        told = f"{lost} of {len(rows)} rows have stamps of another time ({apart})"
        if lost > LOST * len(rows):
            raise InputError(f"{where}: {told}; was the clock set, or are two dives in one file? Split it")
        said.append(f"{where}: {told}; left out")
    return kept


def _of_one_epoch(time: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of the longest piece without a jump, and of the pieces around it that go on in its order."""
    kept = np.flatnonzero(~_alone(time))
    return np.asarray(kept[_longest(time[kept])])


def _alone(time: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Rows whose stamp is wrong by itself: those before and after it are in order, it is not between them."""
    before, after = time[:-2], time[2:]
    outside = (time[1:-1] > after + STEP_BACK) | (time[1:-1] < before - STEP_BACK)
    return np.pad(outside & (before <= after), 1)[: len(time)]


def _longest(time: NDArray[np.float64]) -> NDArray[np.int64]:
    steps = np.diff(time)
    breaks = np.flatnonzero((steps < -STEP_BACK) | (steps > JUMP)) + 1
    pieces = np.split(np.arange(len(time)), breaks)
    longest = max(range(len(pieces)), key=lambda k: len(pieces[k]))
    kept = [pieces[longest]]
    for piece in pieces[longest + 1 :]:
        if -STEP_BACK <= time[piece[0]] - time[kept[-1]].max() <= JUMP:
            kept.append(piece)
    for piece in reversed(pieces[:longest]):
        if -STEP_BACK <= time[kept[0][0]] - time[piece].max() <= JUMP:
            kept.insert(0, piece)
    return np.concatenate(kept)
