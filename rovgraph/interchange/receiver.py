"""The clock of whoever receives an autopilot's messages, by the autopilot's own.

A vehicle's companion has no clock that runs while it is off, so its clock jumps once it learns the time; a link
stalls, and then delivers what it held. The least delay (received - boot time) tells them apart: a stall leaves it as
it was.
"""

import sys
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.spilling import computed, steps

RESET_S = 1.0  # boot time that goes back further is another boot
STEP_S = 1.0  # delays of successive messages that differ by more: a stall, or a clock that was set
SAME_S = 0.5  # least delays that differ by less are of one clock
FEW = 20  # messages that are too few to tell


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
