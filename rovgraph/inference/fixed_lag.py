"""The error-state filter on data that arrive late and in any order, for missions without end.

Measurements are held back for a moment, put in order, and then processed. One that arrives later still is put where it
belongs: the filter goes back to the keyframe before it and processes everything since again. So the estimate does not
depend on the order of arrival, as long as no measurement is later than the lag; older data are dropped.
"""

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from rovgraph.geometry import Array
from rovgraph.inference.estimate import body_trajectory, velocity_covariance
from rovgraph.inference.filter import ErrorLayout, FilterEngine
from rovgraph.inference.filter_step import FilterGates, Gaussian, Met, states_of
from rovgraph.inference.remembered_places import RememberedPlace
from rovgraph.inference.trajectory import Trajectory
from rovgraph.kernels import assembly as at
from rovgraph.kernels.layout import MOTION
from rovgraph.kernels.motion_row import GAP
from rovgraph.log import Measurement
from rovgraph.problem.assembly import InsertResult, assembly_of
from rovgraph.problem.initial_conditions import InitialConditions

Revision = Callable[[Gaussian, ErrorLayout], Gaussian]
KEPT_S = 30.0  # of the dive, behind the lag: the filter may have to go back so far


@dataclass(frozen=True)
class FilterSnapshot:
    """The filter as it was after a keyframe.

    Attributes
    ----------
    index : of the keyframe, from the first of the dive
    keyframe : ndarray, shape (KEYFRAME,), of `rovgraph.kernels.assembly`
    bridged : samples of the IMU are missing before it
    closed : time of the sample by which it was past [s]
    known : its estimate, with what was measured up to it
    gates : sensors that are being kept out
    met : measurements that entered, or did not, since the keyframe before
    """

    index: int
    keyframe: Array
    bridged: bool
    closed: float
    known: Gaussian
    gates: FilterGates
    met: Met

    @property
    def time(self) -> float:
        """Of the keyframe [s]."""
        return float(self.keyframe[at.TIME])


@dataclass
class FixedLag:
    """Filter with a memory of ``lag_s``.

    Attributes
    ----------
    initial : of `rovgraph.inference.initialise.initialise`
    lag_s : how late a measurement may be against the newest of the IMU [s]
    hold_s : how long measurements are held back before they are taken; later ones cost more [s]
    passed : called with each `FilterSnapshot` that the lag has passed, for good
    learn_noise : of the IMU, from its newest samples
    keeps_all : keep the whole dive, for a smoother
    assembly : the dive, as far as it is kept
    """

    initial: InitialConditions
    lag_s: float
    hold_s: float
    passed: Callable[[FilterSnapshot], None] = lambda snapshot: None
    learn_noise: bool = False
    keeps_all: bool = False
    snapshots: deque[FilterSnapshot] = field(default_factory=deque)

    def __post_init__(self) -> None:
        self.filter = FilterEngine(self.initial)
        self.assembly = assembly_of(self.initial, learn_noise=self.learn_noise)
        self._gates: FilterGates = {}

    def add(self, measurement: Measurement) -> InsertResult:
        """Take a measurement, whenever it arrives."""
        outcome = self.assembly.insert(measurement, self._settled)
        until = self.assembly.newest - self.hold_s
        if outcome == InsertResult.IN and self.assembly.is_due(until):
            self._go_on(until)
        return outcome

    def retract(self, sensor: str, since: float) -> None:
        """Take back a sensor's measurements from a time on, as far as the lag goes."""
        self.assembly.remove(sensor, since, self._settled)
        self._go_on(self.assembly.newest - self.hold_s)

    def adopt(self, index: int, known: Gaussian) -> bool:
        """Continue from a better estimate of a keyframe, by the intervals since; False = the lag has passed it."""
        if not any(snapshot.index == index for snapshot in self.snapshots):
            return False
        later: list[FilterSnapshot] = []
        while self.snapshots[-1].index != index:
            later.append(self.snapshots.pop())
        self.snapshots[-1] = replace(self.snapshots[-1], known=known)
        self._gates = dict(self.snapshots[-1].gates)
        for snapshot in reversed(later):
            self.snapshots.append(self._again(snapshot, self.snapshots[-1].known))
        self.assembly.time_offsets.assume(self.snapshots[-1].known.c)
        return True

    def adopt_passed(self, known: Gaussian, gates: FilterGates) -> None:
        """Continue from a better estimate of the keyframe that the lag has passed last, by the intervals since.

        Parameters
        ----------
        known, gates : its estimate, and the sensors that were left out there
        """
        self._gates = dict(gates)
        for k, snapshot in enumerate(self.snapshots):
            self.snapshots[k] = self._again(snapshot, known)
            known = self.snapshots[k].known
        self.assembly.time_offsets.assume(known.c)

    def _again(self, snapshot: FilterSnapshot, before: Gaussian) -> FilterSnapshot:
        """A keyframe filtered once more, from another estimate of the one before."""
        done = self.filter.step(self.assembly.problem, self.place(snapshot), before, self._gates)
        return replace(snapshot, known=done.filtered, gates=dict(self._gates), met=done.met)

    def place(self, snapshot: FilterSnapshot) -> int:
        """The keyframe of a snapshot among those that are kept."""
        return snapshot.index - self.assembly.forgotten

    def continued(
        self,
        initial: InitialConditions,
        revised: Revision = lambda known, layout: known,
        again: Sequence[Measurement] = (),
    ) -> "FixedLag":
        """A filter with more sensors, or that believes something else, that continues from here.

        Parameters
        ----------
        initial : this filter's with more instruments, or another prior
        revised : from the estimate from which it continues, and the layout of its error, to what is believed of it
        again : all measurements so far of some sensors that make no keyframes, as they came, in place of what was
            made of them; where the whole dive is kept
        """
        oldest = self.oldest()
        while self.snapshots[0] is not oldest:
            self.passed(self.snapshots.popleft())
        other = FixedLag(initial, self.lag_s, self.hold_s, self.passed, self.learn_noise, self.keeps_all)
        known = revised(_taken_over(self.filter, other.filter, oldest.known), other.filter.layout)
        other.assembly.restore(self.assembly.state(self.place(oldest) + 1, whole=True))
        if again:
            other.assembly.time_offsets.assume(known.c)
            other.assembly.take_again(again, self.place(oldest) + 1)
        other.snapshots = deque([replace(oldest, known=known)])
        other._go_on(other.assembly.newest - other.hold_s)
        return other

    def oldest(self) -> FilterSnapshot:
        """The oldest snapshot that the filter can continue from: the last of those made at once."""
        ends = (a for a, b in pairwise(self.snapshots) if a.closed != b.closed)
        return next(ends, self.snapshots[-1])

    def state(self) -> dict[str, Any]:
        """The state from which another can continue, as plain values and arrays; not before the first keyframe."""
        oldest = self.oldest()
        known = oldest.known
        return {
            "keyframe": [oldest.index, oldest.time, oldest.bridged, oldest.closed],
            "x": known.x,
            "c": known.c,
            "P": known.P,
            "B": known.B,
            "L": known.L,
            "places": np.array([[p.name, p.number, *p.position, p.time] for p in known.places]).reshape(-1, 5),
            "gates": oldest.gates,
            "assembly": self.assembly.state(self.place(oldest) + 1),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from the state of another."""
        index, _, bridged, closed = state["keyframe"]
        places = tuple(RememberedPlace(row[0], int(row[1]), row[2:4], row[4]) for row in state["places"])
        self.assembly.restore(state["assembly"])
        known = Gaussian(state["x"], state["c"], state["P"], places, state["B"], state["L"])
        met = Met.none(self.assembly.problem, len(known.c))
        row = self.assembly.problem.keyframes[-1].copy()
        self.snapshots = deque([FilterSnapshot(int(index), row, bool(bridged), closed, known, state["gates"], met)])
        self._go_on(self.assembly.newest - self.hold_s)

    @property
    def _settled(self) -> float:
        """Time before which nothing is taken any more [s]."""
        return self.snapshots[0].closed if self.snapshots else -np.inf

    def finish(self) -> None:
        """Take what is held back, and close the last interval."""
        self._go_on(np.inf)
        self._step(self.assembly.extend(finish=True))
        while self.snapshots:
            self.passed(self.snapshots.popleft())

    def ahead(self, time: float) -> tuple[Array, Gaussian]:
        """The newest keyframe, shape (KEYFRAME,), and its estimate, carried on to a time with the IMU alone."""
        newest = self.snapshots[-1]
        if time <= newest.time:
            return newest.keyframe, newest.known
        problem = self.assembly.ahead(time, newest.known.x)
        return problem.keyframes[1].copy(), self.filter.predict(problem, 1, newest.known).predicted

    def trajectory(self, keyframes: Sequence[Array], known: Sequence[Gaussian]) -> Trajectory:
        """The body's origin at keyframes, at least one, in n, with its covariance.

        Parameters
        ----------
        keyframes, known : ndarray, shape (KEYFRAME,), and what is known, of n of them
        """
        states, of = states_of(np.array([k.x for k in known])), np.array(keyframes)
        P = np.array([k.covariance[:MOTION, :MOTION] for k in known])
        velocity = velocity_covariance(of, states, self.initial, P)
        return body_trajectory(of, states, self.initial, P[:, :6, :6], velocity)

    def _go_on(self, until: float) -> None:
        """Take measurements up to a time, from the newest keyframe that still stands."""
        count, unmade = self.assembly.forgotten + len(self.assembly), False
        while self.snapshots and self.snapshots[-1].index >= count:
            self.snapshots.pop()
            unmade = True
        if unmade:
            self._gates = dict(self.snapshots[-1].gates) if self.snapshots else {}
            self.assembly.time_offsets.assume(self.snapshots[-1].known.c if self.snapshots else self.filter.start().c)
        one = bool(self.assembly.time_offsets.lags)  # which are renewed after each keyframe
        while made := self.assembly.extend(until, one):
            self._step(made)

    def _step(self, made: int) -> None:
        """Filter the newest keyframes, and forget what the lag has passed."""
        if not made:
            return
        problem, n = self.assembly.problem, len(self.assembly)
        known, closed = self.snapshots[-1].known if self.snapshots else self.filter.start(), self.assembly.closed_at
        for k in range(n - made, n):
            done = self.filter.step(problem, k, known, self._gates)
            known, index = done.filtered, self.assembly.forgotten + k
            of_keyframe = problem.keyframes[k].copy(), bool(k and problem.motions[k - 1, GAP] > 0.0), closed(k)
            self.snapshots.append(FilterSnapshot(index, *of_keyframe, known, dict(self._gates), done.met))
        self.assembly.time_offsets.assume(known.c)
        while self.snapshots[0].time < self.snapshots[-1].time - self.lag_s:
            self.passed(self.snapshots.popleft())
        if not self.keeps_all:
            self.assembly.forget(int(problem.time.searchsorted(self.snapshots[0].time - KEPT_S)))


def _taken_over(old: FilterEngine, new: FilterEngine, known: Gaussian) -> Gaussian:
    """An estimate with the additional calibration of another filter at its prior."""
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
