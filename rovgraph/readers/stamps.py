"""Puts the stamps of a channel in order, by `rovgraph.log.stamps` and by the arrivals that a recorder kept.

`receiver_clock` corrects the clock of the receiver of an autopilot's messages by the autopilot's own. A vehicle's
companion has no clock that runs while it is off, so its clock jumps once it receives the time; a link stalls, and then
delivers the delayed messages. The least delay (received - boot time) distinguishes them: a stall does not change it.
"""

import sys
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.disk_columns import computed, every, holds, steps, taken
from rovgraph.log.stamps import COUNTERS, ENOUGH, JUMP, LOST, NOT_SET, STEP_BACK, mend, require_moving
from rovgraph.readers.recording import Channel

RESET_S = 1.0  # boot time that goes back further is another boot
STEP_S = 1.0  # delays of successive messages that differ by more: a stall, or a clock that was set
SAME_S = 0.5  # least delays that differ by less are of one clock
FEW = 20  # messages, too few for a judgement


@dataclass(frozen=True)
class ReceiverClock:
    """Where a receiver's clock was set.

    Attributes
    ----------
    place : ndarray of int, shape (k,), first message of each piece in which it went on undisturbed
    offset : ndarray, shape (k,), least of (received - boot time) in each piece [s]
    """

    place: NDArray[np.int64]
    offset: Array

    @property
    def steps(self) -> list[float]:
        """By how much it was set each time [s]."""
        return [float(step) for step in np.diff(self.offset)]

    def corrected(self, place: NDArray[np.int64], received: Array) -> Array:
        """Times of arrival as the clock would have stamped them had it been right from the beginning, as at the end.

        Parameters
        ----------
        place : ndarray of int, shape (n,), numbers of messages
        received : ndarray, shape (n,) [s]
        """
        piece = np.clip(np.searchsorted(self.place, place, side="right") - 1, 0, None)
        return np.asarray(received - self.offset[piece] + self.offset[-1])


def receiver_clock(place: NDArray[np.int64], received: Array, boot: Array) -> ReceiverClock:
    """The receiver's clock by messages that are sent when they are stamped.

    Parameters
    ----------
    place : ndarray of int, shape (n,), increasing numbers of messages, n > 0
    received, boot : ndarray, shape (n,), when each was received, and its stamp [s]
    """
    delay = computed(np.subtract, received, boot)
    bounds = [0, *steps(delay, lambda step: np.abs(step) > STEP_S).tolist(), len(delay)]
    pieces: list[tuple[int, float, int]] = []  # first message, least delay, messages
    for first, end in pairwise(bounds):
        least = float(delay[first:end].min())
        if pieces and abs(least - pieces[-1][1]) < SAME_S:
            pieces[-1] = pieces[-1][0], min(least, pieces[-1][1]), pieces[-1][2] + end - first
        elif pieces and end - first < FEW:
            continue
        elif pieces and pieces[-1][2] < FEW:
            pieces[-1] = pieces[-1][0], least, end - first
        else:
            pieces.append((int(place[first]), least, end - first))
    return ReceiverClock(np.array([p[0] for p in pieces]), np.array([p[1] for p in pieces]))


def longest_boot(place: NDArray[np.integer[Any]], boot: Array) -> tuple[int, int, int]:
    """The messages of the longest run of an autopilot.

    Returns
    -------
    number of the first message and of the one behind the last, and how often the autopilot was restarted
    """
    back = steps(boot, lambda step: step < -RESET_S)
    bounds = [0, *back.tolist(), len(boot)]
    longest = int(np.argmax(np.diff(bounds)))
    first = 0 if longest == 0 else int(place[bounds[longest]])
    end = sys.maxsize if longest == len(back) else int(place[bounds[longest + 1]])
    return first, end, len(back)


SET = 1e9  # [s] since 1970: stamps before are of no clock that was set
APART_S = 1.0  # between stamp and arrival; more is another clock
SOME = 10_000  # rows enough for a judgement
WENT_BY_S = 2.0  # that shows whether stamps advance
STANDS = 0.1  # of the time that went by, over which stamps that stand still reach


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


def put_in_order(channel: Channel, file: str) -> tuple[Channel, list[str]]:
    """A channel with its rows in the order of time, and what was done, a sentence each.

    Where its stamps are empty or stand still, those of the recorder are taken, if they are known.

    Raises
    ------
    InputError : no row with a time, stamps that stand still, or many that are of another epoch
    """
    where, said = f"{file}: {channel.source}", list[str]()
    if channel.received is not None and (why := _tells_nothing(channel.columns["time"], channel.received)):
        said.append(f"{where}: its stamps {why}; those of arrival are taken, which are late")
        channel = by_arrival(channel)
    time = np.asarray(channel.columns["time"], dtype=float)
    if _increase(time):
        require_moving(time, where)
        return channel, said
    if not np.isfinite(time).any():
        raise InputError(f"{where}: no row has a time")
    if timeless := int(np.count_nonzero(~np.isfinite(time))):
        said.append(f"{where}: {timeless} rows without time left out")
    try:
        mended, told = mend(time, where, not_set=NOT_SET if channel.received is None else LOST)
    except InputError:
        if channel.received is None:
            raise
        by_recorder, told = by_arrivals(time, channel.received)
        mended = time if by_recorder is None else by_recorder
        told = [f"{where}: {text}" for text in told]
    said += told
    kept = None if holds(np.isfinite, mended) else np.flatnonzero(np.isfinite(mended))
    stamps = mended if kept is None else mended[kept]
    late = int(np.count_nonzero(stamps < np.maximum.accumulate(stamps)))
    if late:
        said.append(f"{where}: {late} rows are earlier than a row above them, sorted")
    order = np.argsort(stamps, kind="stable")
    order = order if kept is None else kept[order]
    received = None if channel.received is None else taken(channel.received, order)
    columns = {name: taken(np.asarray(values), order) for name, values in channel.columns.items()}
    columns["time"] = taken(mended, order)
    return replace(channel, columns=columns, received=received), said


def by_arrival(channel: Channel) -> Channel:
    """A channel, whose arrivals are known, that is stamped by its receiver."""
    assert channel.received is not None
    columns = {**channel.columns, "time": channel.received}
    return replace(channel, columns=columns, clock=channel.receiver)


def by_arrivals(stamp: Array, received: Array) -> tuple[Array | None, list[str]]:
    """Stamps of a message's sender, corrected by its receiver's.

    Parameters
    ----------
    stamp, received : ndarray, shape (n,) [s]

    Returns
    -------
    stamp : ndarray, shape (n,) [s], on the clock's last setting, NaN where it cannot be used; None = take arrivals
    said : what was done, without a subject
    """
    if why := _tells_nothing(stamp, received):
        return None, [f"stamps {why}; those of arrival are taken, which are late"]
    out = np.where(stamp == 0.0, np.nan, stamp)
    rows = np.flatnonzero(np.isfinite(out))
    unset = out[rows] < SET
    if not ((np.diff(out[rows]) < -STEP_BACK).any() or (unset.any() and not unset.all())):
        return out, []
    clock = receiver_clock(np.arange(len(rows)), out[rows], received[rows])
    out[rows] = clock.corrected(np.arange(len(rows)), out[rows])
    steps = ", ".join(f"{step:+.1f} s" for step in clock.steps) or "an amount that too few messages show"
    apart = received[rows] - out[rows]
    out[rows[np.abs(apart - np.median(apart)) > APART_S]] = np.nan  # too few to find how their clock was set
    return out, [f"its clock was set by {steps}; earlier stamps are moved to it"]


def _tells_nothing(stamp: Array, received: Array) -> str:
    """What is wrong with useless stamps, by the arrivals; "" for useful ones."""
    stamp, received = (every(np.asarray(values), max(len(stamp) // SOME, 1)) for values in (stamp, received))
    known = np.isfinite(stamp) & (stamp != 0.0)
    if known.mean() <= 0.5:
        return "are empty"
    went_by = float(np.ptp(received[known]))
    if np.count_nonzero(known) < ENOUGH or not went_by > WENT_BY_S:
        return ""
    low, high = np.percentile(stamp[known], [5.0, 95.0])
    wraps = any(low >= 0.0 and high <= wrap and high > 0.5 * wrap for wrap in COUNTERS)
    return f"stand still at {low:.10g} s" if high - low < STANDS * went_by and not wraps else ""


def _increase(time: NDArray[np.float64]) -> bool:
    """Whether all stamps are known and in order, as most are: a large channel is not copied to find out."""
    known = len(time) > 0 and bool(np.isfinite(time[[0, -1]]).all())
    return known and not len(steps(time, lambda step: ~((step >= 0.0) & (step <= JUMP))))
