"""When the filters of a batch do what, so that they go in lock step.

At each step all take an inertial sample, or all take a ping. Their logs have different
epochs, and nothing ties one filter's time to another's; so the first pings of all are one
step, the second ones are one step, and between them each takes the samples of its own log
that lie there. Who has fewer of them is idle until the others are through. Pings come at
about the same rate in all logs, so that this is little.

A ping between two samples comes between them; at equal times the sample comes first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

KEEP_EVERY = 10  # of the inertial samples' innovations


@dataclass(frozen=True)
class Timetable:
    """Steps of a batch; arrays of shape (steps, members) but for ``ping``.

    Attributes
    ----------
    ping : ndarray, shape (steps,), of bool: a ping is taken, otherwise a sample
    active : of bool; the others are idle
    time, epoch : of the state after the step [s], and the last IMU epoch at or before it
    number : of the ping, where one is taken
    keeps_state : of bool: at the first epoch, pings and the last epoch, and every
        ``longest`` where pings are missing
    keeps_innovation : of bool: at pings and at every tenth sample
    """

    ping: NDArray[np.bool_]
    active: NDArray[np.bool_]
    time: Array
    epoch: NDArray[np.int64]
    number: NDArray[np.int64]
    keeps_state: NDArray[np.bool_]
    keeps_innovation: NDArray[np.bool_]

    @property
    def ends(self) -> NDArray[np.int64]:
        """Number of steps until each member is through, shape (members,)."""
        return np.asarray(len(self.active) - np.argmax(self.active[::-1], axis=0))

    def of(self, members: list[int]) -> "Timetable":
        """That of some of the members."""
        return Timetable(
            self.ping,
            self.active[:, members],
            self.time[:, members],
            self.epoch[:, members],
            self.number[:, members],
            self.keeps_state[:, members],
            self.keeps_innovation[:, members],
        )


def timetable(samples: Sequence[Array], pings: Sequence[Array], longest: Sequence[float]) -> Timetable:
    """The steps of filters side by side.

    Parameters
    ----------
    samples, pings : for each member, times [s] in their order; pings are within the samples' time
    longest : for each member, between states that are kept [s]
    """
    last = [np.searchsorted(s, p, side="right") - 1 for s, p in zip(samples, pings, strict=True)]  # epoch before a ping
    rounds = max(map(len, pings)) + 1
    counts = np.zeros((len(samples), rounds), dtype=np.int64)  # of samples before each ping, and after the last
    for b, before in enumerate(last):
        counts[b, : len(before) + 1] = np.diff([-1, *before, len(samples[b]) - 1])
    lengths = counts.max(axis=0)
    begins = np.concatenate([[0], np.cumsum(lengths + 1)])  # of each round: samples, then the ping
    shape = (int(begins[-1]) - 1, len(samples))
    ping = np.zeros(shape[0], dtype=bool)
    ping[begins[1:-1] - 1] = True
    time, epoch, number = np.full(shape, -np.inf), np.zeros(shape, dtype=np.int64), np.zeros(shape, dtype=np.int64)
    active, keeps_state, keeps_innovation = (np.zeros(shape, dtype=bool) for _ in range(3))
    for b, before in enumerate(last):
        k = np.arange(len(samples[b]))
        its_round = np.searchsorted(before, k)
        at = begins[its_round] + k - np.concatenate([[-1], before])[its_round] - 1
        there = begins[1 : len(before) + 1] - 1
        time[at, b], epoch[at, b], time[there, b], epoch[there, b] = samples[b], k, pings[b], before
        number[there, b] = np.arange(len(before))
        active[at, b] = active[there, b] = True
        keeps_innovation[at[::KEEP_EVERY], b] = keeps_innovation[there, b] = True
        own = np.flatnonzero(active[:, b])
        keeps_state[own, b] = _keeps(time[own, b].tolist(), ping[own].tolist(), longest[b])
    time, epoch = np.maximum.accumulate(time, axis=0), np.maximum.accumulate(epoch, axis=0)
    return Timetable(ping, active, time, epoch, number, keeps_state, keeps_innovation)


def _keeps(time: list[float], ping: list[bool], longest: float) -> list[bool]:
    """Which of a filter's states are kept: one for each time at most."""
    keeps, last = [], -np.inf
    for k, (t, is_ping) in enumerate(zip(time, ping, strict=True)):
        final = k == len(time) - 1
        followed = not final and time[k + 1] == t
        keep = not followed and (is_ping or t - last > longest or final)
        keeps.append(keep)
        last = t if keep else last
    return keeps
