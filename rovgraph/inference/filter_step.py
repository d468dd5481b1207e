"""Inputs and results of one interval of the error-state filter."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.remembered_places import RememberedPlace
from rovgraph.kernels.filtering import Filtered
from rovgraph.model.calibration import LAYOUT, calibration_size
from rovgraph.model.state import State
from rovgraph.problem.problem import Problem

FilterGates = dict[str, float]  # sensor that is left out -> since when [s]


def calibration_vector(calibration: Mapping[str, Array]) -> Array:
    """All calibration variables as one vector, shape (C,)."""
    c = np.empty(calibration_size())
    for name, part in LAYOUT.items():
        c[part] = calibration[name]
    return c


def state_vector(state: State) -> Array:
    """R_nb by rows, p_n, v_n and bias of a `State` of one epoch, shape (21,)."""
    return np.concatenate([state.R_nb.ravel(), state.p_n[0], state.v_n[0], state.bias[0]])


def states_of(x: Array, c: Array | None = None) -> State:
    """`State` of n epochs from state vectors, shape (n, 21), and calibration vectors, if any, shape (n, C) or (C,)."""
    calibration = {} if c is None else {name: c[..., part] for name, part in LAYOUT.items()}
    return State(x[:, :9].reshape(-1, 3, 3), x[:, 9:12], x[:, 12:15], x[:, 15:21], calibration)


def _nothing() -> Array:
    """Of what is considered where nothing is."""
    return np.zeros((0, 0))


@dataclass(frozen=True)
class Gaussian:
    """A state with the covariance of its error, in the order of `rovgraph.inference.filter`.

    Attributes
    ----------
    x : ndarray, shape (21,), R_nb by rows, p_n, v_n, bias
    c : ndarray, shape (C,), calibration vector
    P : ndarray, shape (size + 2 m, size + 2 m), the places at the end; without the part of what is considered
    places : m places that are remembered
    B : ndarray, shape (size + 2 m, h), the part of what is considered: the error that h white numbers of unit
        variance would make; or (0, 0)
    L : ndarray, shape (h, h), root of the covariance of what is considered: L times these numbers
    """

    x: Array
    c: Array
    P: Array
    places: tuple[RememberedPlace, ...] = ()
    B: Array = field(default_factory=_nothing)
    L: Array = field(default_factory=_nothing)

    @staticmethod
    def of(state: State, P: Array, places: tuple[RememberedPlace, ...] = ()) -> "Gaussian":
        """From a `State` of one epoch, its calibration of shape (dim,)."""
        return Gaussian(state_vector(state), calibration_vector(state.calibration), P, places)

    @cached_property
    def covariance(self) -> Array:
        """Of the error with all that is uncertain, shape as that of P."""
        return np.asarray(self.P + self.B @ self.B.T) if len(self.L) else self.P

    @cached_property
    def state(self) -> State:
        """The state, of one epoch; calibration has shape (dim,)."""
        return states_of(self.x[None], self.c)


def stack_states(known: Sequence[Gaussian]) -> State:
    """The states of n estimates as one `State`; calibration has shape (n, dim)."""
    return states_of(np.array([k.x for k in known]), np.array([k.c for k in known]))


@dataclass(frozen=True)
class Transition:
    """The way from a keyframe to the next.

    Attributes
    ----------
    F, Q : ndarray, shapes as that of P, transition from the keyframe before, and its noise
    predicted : before anything that was measured at the keyframe
    """

    F: Array
    Q: Array
    predicted: Gaussian


@dataclass(frozen=True, slots=True)
class Met:
    """The m measurements of an interval as the filter met them.

    Attributes
    ----------
    problem, begin, end : they are from ``begin`` to before ``end`` of it
    x, c : ndarray, shapes (m, 21), (m, C), the keyframe before each entered, as of `Gaussian`
    nis : ndarray, shape (m,), normalised innovation squared
    weight : ndarray, shape (m,), 1 for a full measurement, less by its loss, 0 for a rejected one; a place that fits
        no place of its name counts as rejected, and is remembered as another
    place : ndarray, shape (m, 2), where the place that is seen was believed to be, nan where none is
    number : ndarray of int, shape (m,), of the place that is seen, as the filter has it
    """

    problem: Problem
    begin: int
    end: int
    x: Array
    c: Array
    nis: Array
    weight: Array
    place: Array
    number: NDArray[np.int64]

    @staticmethod
    def of(problem: Problem, k: int, C: int) -> "Met":
        """Room for those of the interval that ends with keyframe k."""
        begin, end = problem.measured_in(k)
        m = end - begin
        numbers = np.empty((m, 21)), np.empty((m, C)), np.zeros(m), np.zeros(m), np.full((m, 2), np.nan)
        return Met(problem, begin, end, *numbers, problem.number[begin:end].copy())

    @staticmethod
    def none(problem: Problem, C: int) -> "Met":
        """No measurements."""
        m = len(problem.rows)
        numbers = np.empty((0, 21)), np.empty((0, C)), np.empty(0), np.empty(0), np.empty((0, 2))
        return Met(problem, m, m, *numbers, np.empty(0, np.int64))

    def states(self) -> tuple[Array, Array]:
        """x and c."""
        return self.x, self.c

    def __len__(self) -> int:
        return self.end - self.begin

    @property
    def index(self) -> NDArray[np.int64]:
        """Which they are of the problem's, shape (m,)."""
        return np.arange(self.begin, self.end)

    @property
    def sensors(self) -> list[str]:
        """Of each."""
        return [self.problem.sensors[k] for k in self.problem.which[self.begin : self.end].tolist()]

    def put(self, index: NDArray[np.int64], before: Gaussian, nis: Array, weight: Array) -> None:
        """Some of them, met by an estimate."""
        slots = index - self.begin
        self.x[slots], self.c[slots], self.nis[slots], self.weight[slots] = before.x, before.c, nis, weight

    def see(self, row: int, before: Gaussian, nis: float, weight: float, place: Array, number: int) -> None:
        """One of a place."""
        slot = row - self.begin
        self.x[slot], self.c[slot], self.nis[slot], self.weight[slot] = before.x, before.c, nis, weight
        self.place[slot], self.number[slot] = place, number


@dataclass(frozen=True)
class FilterStep:
    """Through one interval, from one keyframe to the next.

    Attributes
    ----------
    filtered : the keyframe that ends the interval
    met : the measurements
    departed : the keyframe before, with what was measured after it; None at the first keyframe, or not asked for
    transition : the way from there; None in the same cases
    """

    filtered: Gaussian
    met: Met
    departed: Gaussian | None
    transition: Transition | None


@dataclass(frozen=True)
class FilterRun:
    """Through k intervals in a row, with m measurements.

    Attributes
    ----------
    before, known : Gaussian of the keyframe before them, and of the last one
    filtered : the keyframes, and what became of the measurements
    interval, between : ndarray of int and of bool, shape (m,), the interval of each, and whether it belongs to the
        keyframe before that
    """

    before: Gaussian
    known: Gaussian
    filtered: Filtered
    interval: NDArray[np.int64]
    between: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.filtered.x)

    def states(self) -> tuple[Array, Array]:
        """x and c before each measurement entered, shapes (m, 21), (m, C)."""
        interval, between, found = self.interval, self.between, self.filtered
        x, c = found.predicted_x[interval], found.predicted_c[interval]
        former, first = between & (interval > 0), between & (interval == 0)
        x[former], c[former] = found.x[interval[former] - 1], found.c[interval[former] - 1]
        x[first], c[first] = self.before.x, self.before.c
        return x, c
