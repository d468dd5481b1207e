"""A second process that renews the filter of the first.

It takes the same measurements, some seconds later, when their order is settled, and solves
the dive so far as a graph at the times of `REINITIALISE_AT_S`, which takes longer than a live
estimate can wait. FilterJob for a keyframe, it gives its own filter's estimate of it, from which
the first one goes on.
"""

import multiprocessing
from collections.abc import Sequence
from multiprocessing.connection import Connection
from typing import Any

from rovgraph.engine.assembly import Assembler
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.errors import InputError
from rovgraph.estimators.dead_reckoning import dead_reckon
from rovgraph.estimators.error_recursion import ErrorStateRecursion
from rovgraph.estimators.error_state import REINITIALISE_AT_S
from rovgraph.estimators.filter_step import Gates, Gaussian
from rovgraph.estimators.initialise import InitialConditions
from rovgraph.estimators.reinitialisation import renewed
from rovgraph.log import Measurement
from rovgraph.log.packing import pack, unpack
from rovgraph.workers import companion

DUE_LATER = 0.4  # a renewal takes up to this part of its time


def due_times(lag_s: float, reinitialise_at: Sequence[float] = REINITIALISE_AT_S) -> list[float]:
    """Times since the start at which a renewal should be ready, where measurements are settled after ``lag_s``."""
    return [(1.0 + DUE_LATER) * t + lag_s for t in reinitialise_at]


class Refiner:
    """The other process, which is started at once and takes a second or two until it can work.

    Parameters
    ----------
    reinitialise_at : times since the start at which the dive so far is solved as a graph [s]
    learn_noise : of the IMU, as the first filter does
    """

    def __init__(self, reinitialise_at: tuple[float, ...] = REINITIALISE_AT_S, learn_noise: bool = False) -> None:
        context = multiprocessing.get_context("spawn")
        self._work: Any = context.Queue()  # with a thread that feeds it, so that no one waits here
        self._answers, theirs = context.Pipe(duplex=False)
        self._process = companion(_refine, reinitialise_at, learn_noise, self._work, theirs)
        theirs.close()
        self._asked: int | None = None

    def begin(self, beginning: InitialConditions) -> None:
        """The beginning of the dive, before all else."""
        self._work.put(beginning)

    def take(self, measurements: Sequence[Measurement]) -> None:
        """Hand on measurements, in order."""
        self._work.put(pack(measurements))  # one by one they take fifteen times as long, from this process's time

    def ask(self, index: int) -> None:
        """Ask for the estimate of a keyframe; of one question at a time."""
        self._asked = index
        self._work.put(index)

    def served(self) -> None:
        """Say that the answer was of use: there is nothing more to do until the next renewal."""
        self._work.put(None)

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
        if isinstance(known, str):
            raise InputError(f"the filter is renewed no more ({known}); it goes on as it is")
        index, self._asked = self._asked, None
        assert index is not None
        return index, known

    def close(self) -> None:
        """End the process."""
        self._process.terminate()
        self._work.cancel_join_thread()
        self._work.close()
        self._answers.close()


class _Renewed:
    """What the process does: it solves the dive at each time of renewal, and filters on from there until it is done."""

    def __init__(self, beginning: InitialConditions, reinitialise_at: Sequence[float], learn_noise: bool) -> None:
        b = beginning
        self._assembler = Assembler(b.config, b.instruments, b.start.state.bias[0], learn_noise=learn_noise)
        self._recursion = ErrorStateRecursion(b)
        self._renewals = list(reinitialise_at)
        self._intervals: list[KeyframeInterval] = []
        self._known: list[Gaussian] = []  # of the newest keyframes, since the last renewal
        self._gates: Gates = {}
        self._made = self._served = 0

    def add(self, measurement: Measurement) -> None:
        for interval in self._assembler.add(measurement):
            self._intervals.append(interval)
            if self._renewals and interval.time - self._intervals[0].time >= self._renewals[0]:
                self._renewals.pop(0)
                self._made += 1
                self._known, self._gates = [self._solved()], {}
            elif self._known:
                self._known.append(self._recursion.through(interval, self._known[-1], self._gates).filtered)

    def known(self, index: int) -> Gaussian:
        """The estimate of a keyframe since the last renewal."""
        return self._known[index - len(self._intervals)]

    def rest(self) -> None:
        """An answer was of use: filter no more until the next renewal, unless that has been made already."""
        self._served += 1
        if self._served >= self._made:
            self._known = []

    def _solved(self) -> Gaussian:
        b, recursion = self._recursion.beginning, self._recursion
        return renewed(recursion, self._intervals, dead_reckon(self._intervals, b, recursion.unknowns.fixed))


def _refine(reinitialise_at: tuple[float, ...], learn_noise: bool, work: Any, answers: Connection) -> None:
    """Work off what the first process sends: measurements, the index of a keyframe, None = the answer served."""
    dive = _Renewed(work.get(), reinitialise_at, learn_noise)
    try:
        while True:
            item = work.get()
            if item is None:
                dive.rest()
            elif isinstance(item, int):
                answers.send(dive.known(item))
            else:
                for measurement in unpack(item):
                    dive.add(measurement)
    except Exception as error:  # whatever it is, the first process goes on without this one
        answers.send(str(error) or type(error).__name__)
