"""A second process that renews the filter of the first.

It takes the same measurements, some seconds later, when their order is settled, and solves
the dive so far as a graph at the times of `RENEW_AT_S`, which takes longer than a live
estimate can wait. Asked for a keyframe, it gives its own filter's estimate of it, from which
the first one goes on.
"""

import multiprocessing
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from rovgraph.errors import InputError
from rovgraph.estimators.error_recursion import Gaussian
from rovgraph.estimators.error_state import RENEW_AT_S, ErrorStateFilter
from rovgraph.estimators.initialise import Beginning
from rovgraph.log import Measurement
from rovgraph.workers import companion

DUE_LATER, DUE_AFTER_S = 0.25, 5.0  # a renewal is due this part of its time later, and this much more


def due_times(renew_at: Sequence[float] = RENEW_AT_S) -> list[float]:
    """Times since the start at which a renewal should be ready."""
    return [(1.0 + DUE_LATER) * t + DUE_AFTER_S for t in renew_at]


class Refiner:
    """The other process.

    Parameters
    ----------
    beginning : the dive's
    renew_at : times since the start at which the dive so far is solved as a graph [s]
    learn_noise : of the IMU, as the first filter does
    """

    def __init__(
        self, beginning: Beginning, renew_at: tuple[float, ...] = RENEW_AT_S, learn_noise: bool = False
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._work: Any = context.Queue()  # with a thread that feeds it, so that no one waits here
        self._answers, theirs = context.Pipe(duplex=False)
        self._process = companion(_refine, beginning, renew_at, learn_noise, self._work, theirs)
        theirs.close()
        self._asked: int | None = None

    def take(self, measurements: Sequence[Measurement]) -> None:
        """Hand on measurements, in order."""
        self._work.put(list(measurements))

    def ask(self, index: int) -> None:
        """Ask for the estimate of a keyframe; of one question at a time."""
        self._asked = index
        self._work.put(index)

    @property
    def asked(self) -> bool:
        """Whether an answer is still to come."""
        return self._asked is not None

    def answer(self, wait: bool) -> tuple[int, Gaussian] | None:
        """The keyframe's index and estimate, or None where it is not there yet.

        Raises
        ------
        InputError : the process has ended
        """
        try:
            if not wait and not self._answers.poll():
                return None
            known = self._answers.recv()
        except (EOFError, OSError):
            raise InputError("the process that renews the filter has ended; the filter goes on without it") from None
        index, self._asked = self._asked, None
        assert index is not None
        return index, known

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._work.cancel_join_thread()
        self._work.close()
        self._answers.close()


def _refine(
    beginning: Beginning, renew_at: tuple[float, ...], learn_noise: bool, work: Any, answers: Connection
) -> None:
    """What the process does."""
    estimator = ErrorStateFilter(beginning, renew_at, learn_noise)
    while True:
        item = work.get()
        if isinstance(item, int):
            answers.send(estimator.filtered[item])
            continue
        for measurement in item:
            estimator.add(measurement)
