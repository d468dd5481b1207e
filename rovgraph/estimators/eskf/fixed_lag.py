"""The error-state filter on data that arrive late and in any order, for missions without end.

Measurements are held back for a moment, put in order, and then taken. One that comes later
still is put where it belongs: the filter goes back to the keyframe before it and takes
everything since once more. So the estimate does not depend on the order of arrival, as
long as nothing is later than the lag; and nothing older than that is kept.
"""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from itertools import pairwise
from typing import Any

import numpy as np

from rovgraph.engine.assembly import Assembler
from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import Gates, Gaussian, ProcessedMeasurement, states_of
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.remembered_places import RememberedPlace
from rovgraph.estimators.results import body_trajectory
from rovgraph.log import Measurement
from rovgraph.log.packing import pack, unpack
from rovgraph.log.streams import precedence
from rovgraph.state import POSE, VELOCITY
from rovgraph.trajectory import Trajectory


class InsertResult(StrEnum):
    """What became of a measurement."""

    IN = "taken"
    LATE = "later than the lag"
    AGAIN = "repeated"


def place(measurement: Measurement) -> tuple[float, int, str]:
    """Order of measurements: by time, and the IMU's before the DVL's before others."""
    return measurement.time, precedence(measurement.sensor), measurement.sensor


@dataclass(frozen=True)
class FilterSnapshot:
    """The filter as it was after a keyframe.

    Attributes
    ----------
    interval : the keyframe's
    known : its estimate, with what was measured up to it
    gates : sensors that are being kept out
    processed : measurements that entered, or did not, since the mark before
    assembler : what had been assembled
    taken : count of measurements that had been taken
    """

    interval: KeyframeInterval
    known: Gaussian
    gates: Gates
    processed: list[ProcessedMeasurement]
    assembler: Assembler
    taken: int


@dataclass
class FixedLag:
    """Filter with a memory of ``lag_s``.

    Attributes
    ----------
    initial : of `rovgraph.estimators.initialise.initialise`
    lag_s : how late a measurement may be against the newest of the IMU [s]
    hold_s : how long measurements are held back before they are taken; later ones cost more [s]
    passed : called with each `FilterSnapshot` that the lag has passed, for good
    learn_noise : of the IMU, from its newest samples
    """

    initial: InitialConditions
    lag_s: float
    hold_s: float
    passed: Callable[[FilterSnapshot], None] = lambda mark: None
    learn_noise: bool = False
    marks: deque[FilterSnapshot] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self.filter = FilterEngine(self.initial)
        self._assembler = self._fresh()
        self._gates: Gates = {}
        self._record: list[Measurement] = []  # in order; the first `_taken` have been taken
        self._forgotten = 0  # measurements that have left the record
        self._taken = 0
        self._newest = -float("inf")  # of the IMU

    def add(self, measurement: Measurement) -> InsertResult:
        """Take a measurement, whenever it arrives."""
        record = self._record
        if record and measurement.time <= record[-1].time and (own := place(measurement)) <= place(record[-1]):
            position = bisect_right(record, own, key=place)
            if position < self._settled:
                return InsertResult.LATE
            if position > 0 and place(record[position - 1]) == own:
                return InsertResult.AGAIN
            record.insert(position, measurement)
            if position < self._taken:
                self._back_to(position)
        else:
            record.append(measurement)
        if measurement.sensor == "imu" and measurement.time > self._newest:
            self._newest = measurement.time
        self._go_on(self._newest - self.hold_s)
        return InsertResult.IN

    def retract(self, sensor: str, since: float) -> None:
        """Take back a sensor's measurements from a time on, as far as the lag goes."""
        later = range(self._settled, len(self._record))
        wrong = [k for k in later if self._record[k].sensor == sensor and self._record[k].time >= since]
        if not wrong:
            return
        if wrong[0] < self._taken:
            self._back_to(wrong[0])
        for k in reversed(wrong):
            del self._record[k]
        self._go_on(self._newest - self.hold_s)

    def adopt(self, index: int, known: Gaussian) -> bool:
        """Go on from a better estimate of a keyframe, by the intervals since; False = the lag has passed it."""
        if not any(mark.interval.index == index for mark in self.marks):
            return False
        later: list[FilterSnapshot] = []
        while self.marks[-1].interval.index != index:
            later.append(self.marks.pop())
        self.marks[-1] = replace(self.marks[-1], known=known)
        self._gates = dict(self.marks[-1].gates)
        for mark in reversed(later):
            filter_step = self.filter.step(mark.interval, self.marks[-1].known, self._gates)
            after = replace(mark, known=filter_step.filtered, gates=dict(self._gates), processed=filter_step.processed)
            self.marks.append(after)
        self._assembler.time_offsets.assume(self.marks[-1].known.c)
        return True

    def adopt_passed(self, known: Gaussian, gates: Gates) -> None:
        """Go on from a better estimate of the keyframe that the lag has passed last, by the intervals since.

        Parameters
        ----------
        known, gates : its estimate, and the sensors that were left out there
        """
        self._gates = dict(gates)
        for k, mark in enumerate(self.marks):
            done = self.filter.step(mark.interval, known, self._gates)
            known = done.filtered
            self.marks[k] = replace(mark, known=known, gates=dict(self._gates), processed=done.processed)
        self._assembler.time_offsets.assume(known.c)

    def continued(self, initial: InitialConditions, position_sd: float = 0.0) -> "FixedLag":
        """A filter that knows more sensors, or less of where it is, and goes on from here.

        Parameters
        ----------
        initial : this filter's with more instruments, or another prior
        position_sd : that is added to north and east [m]
        """
        oldest = self.oldest()
        while self.marks[0] is not oldest:
            self.passed(self.marks.popleft())
        other = FixedLag(initial, self.lag_s, self.hold_s, self.passed, self.learn_noise)
        known, assembler = _taken_over(self.filter, other.filter, oldest.known), other._fresh()
        here, R_nb = other.filter.layout.columns[POSE], known.state.R_nb[0]
        known.P[here, here][3:, 3:] += R_nb.T @ np.diag([position_sd**2, position_sd**2, 0.0]) @ R_nb
        assembler.restore(oldest.assembler.state())
        other.marks = deque([replace(oldest, known=known, assembler=assembler, taken=0)])
        other._back_to(0)
        for measurement in self._record[oldest.taken - self._forgotten :]:
            other.add(measurement)
        return other

    def oldest(self) -> FilterSnapshot:
        """The oldest mark that the filter can go on from: the last of those that came at once."""
        ends = (a for a, b in pairwise(self.marks) if a.taken != b.taken)
        return next(ends, self.marks[-1])

    def settle(self) -> None:
        """Forget the measurements that can be changed no more."""
        old = self._settled
        del self._record[:old]
        self._forgotten += old
        self._taken -= old

    def state(self) -> dict[str, Any]:
        """All that is needed to go on elsewhere, as plain values and arrays; not before the first keyframe."""
        mark = self.oldest()
        known, interval = mark.known, mark.interval
        return {
            "keyframe": [interval.index, interval.time, interval.segment, interval.rate_sd],
            "rate_b": interval.rate_b,
            "x": known.x,
            "c": known.c,
            "P": known.P,
            "B": known.B,
            "L": known.L,
            "places": np.array([[p.name, p.number, *p.position, p.time] for p in known.places]).reshape(-1, 5),
            "gates": mark.gates,
            "assembler": mark.assembler.state(),
            "record": pack(self._record[mark.taken - self._forgotten :]),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from where another stood."""
        index, time, segment, rate_sd = state["keyframe"]
        interval = KeyframeInterval(index, time, segment, state["rate_b"], rate_sd, None, [])
        places = tuple(RememberedPlace(row[0], int(row[1]), row[2:4], row[4]) for row in state["places"])
        assembler = self._fresh()
        assembler.restore(state["assembler"])
        known = Gaussian(state["x"], state["c"], state["P"], places, state["B"], state["L"])
        self.marks = deque([FilterSnapshot(interval, known, state["gates"], [], assembler, 0)])
        self._record, self._forgotten, self._taken = [], 0, 0
        self._back_to(0)
        for measurement in unpack(state["record"]):
            self.add(measurement)

    @property
    def _settled(self) -> int:
        """Measurements of the record that no later one can come before."""
        return self.marks[0].taken - self._forgotten if self.marks else 0

    def finish(self) -> None:
        """Take what is held back, and close the last interval."""
        self._go_on(float("inf"))
        if intervals := self._assembler.finish():
            self._step(intervals)
        while self.marks:
            self.passed(self.marks.popleft())

    def ahead(self, time: float) -> tuple[KeyframeInterval, Gaussian]:
        """The newest keyframe's estimate, carried on to a time with the IMU alone."""
        mark = self.marks[-1]
        if time <= mark.interval.time:
            return mark.interval, mark.known
        later = [m for m in self._record[self._taken :] if m.sensor == "imu" and m.time <= time]
        interval = self._assembler.ahead(later, time, mark.known.x)
        return interval, self.filter.predict(interval, mark.known).predicted

    def trajectory(self, intervals: Sequence[KeyframeInterval], known: Sequence[Gaussian]) -> Trajectory:
        """The body's origin at keyframes, at least one, in n, with its covariance.

        Parameters
        ----------
        intervals, known : the keyframes and what is known of them, n each
        """
        columns = self.filter.layout.columns
        pose, velocity = (np.array([k.covariance[columns[v], columns[v]] for k in known]) for v in (POSE, VELOCITY))
        return body_trajectory(intervals, states_of(np.array([k.x for k in known])), self.initial, pose, velocity)

    def _go_on(self, until: float) -> None:
        """Take measurements up to a time."""
        while self._taken < len(self._record) and self._record[self._taken].time <= until:
            self._taken += 1
            if intervals := self._assembler.add(self._record[self._taken - 1]):
                self._step(intervals)

    def _step(self, intervals: list[KeyframeInterval]) -> None:
        """Take intervals that are complete, and forget what the lag has passed."""
        known = self.marks[-1].known if self.marks else self.filter.start()
        taken, passed = self._forgotten + self._taken, []
        for interval in intervals:
            filter_step = self.filter.step(interval, known, self._gates)
            known = filter_step.filtered
            passed.append((interval, known, dict(self._gates), filter_step.processed))
        self._assembler.time_offsets.assume(known.c)
        assembler = self._assembler.copy()
        self.marks += [FilterSnapshot(*one, assembler, taken) for one in passed]
        while self.marks[0].interval.time < self.marks[-1].interval.time - self.lag_s:
            self.passed(self.marks.popleft())
        if self._settled > len(self._record) // 2:
            self.settle()

    def _back_to(self, position: int) -> None:
        """Undo the taking of the measurement at a place of the record, and of all after it."""
        while self.marks and self.marks[-1].taken - self._forgotten > position:
            self.marks.pop()
        if self.marks:
            mark = self.marks[-1]
            self._assembler, self._gates = mark.assembler.copy(), dict(mark.gates)
            self._taken = mark.taken - self._forgotten
        else:
            self._assembler, self._gates, self._taken = self._fresh(), {}, 0

    def _fresh(self) -> Assembler:
        b = self.initial
        return Assembler(
            b.config, b.instruments, b.prior.state.bias[0], learn_noise=self.learn_noise, believed=b.beliefs
        )


def _taken_over(old: FilterEngine, new: FilterEngine, known: Gaussian) -> Gaussian:
    """An estimate as a filter with more calibration has it: of what the other did not know, the prior."""
    start, size = new.start(), (old.layout.size, new.layout.size)
    names = old.layout.columns
    at_old, at_new = (np.concatenate([np.r_[f.layout.columns[name]] for name in names]) for f in (old, new))
    considered = at_new[at_old >= size[0]] - size[1]
    more = np.arange(len(known.P) - size[0])  # places that are remembered
    at_old, at_new = (np.append(at[at_old < size[0]], n + more) for at, n in ((at_old, size[0]), (at_new, size[1])))
    P = np.zeros((size[1] + len(more), size[1] + len(more)))
    P[: size[1], : size[1]] = start.P
    P[np.ix_(at_new, at_new)] = known.P[np.ix_(at_old, at_old)]
    B, L = np.zeros((len(P), len(start.L))), start.L
    B[np.ix_(at_new, considered)] = known.B[at_old]
    L[np.ix_(considered, considered)] = known.L
    return Gaussian(known.x, known.c, P, known.places, B, L)
