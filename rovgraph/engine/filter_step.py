"""What goes into an interval of the error-state filter, and what comes out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibration import LAYOUT, calibration_size
from rovgraph.engine.keyframes import KeyframeMeasurement
from rovgraph.engine.remembered_places import RememberedPlace
from rovgraph.geometry import Array
from rovgraph.kernels.filtering import Filtered
from rovgraph.state import State

Gates = dict[str, float]  # sensor that is left out -> since when [s]


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
    """A state with the covariance of its error, in the order of `rovgraph.engine.error_layout`.

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


def stack_states(known: Sequence["Gaussian | ProcessedMeasurement"]) -> State:
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
class ProcessedMeasurement:
    """A measurement as the filter met it.

    Attributes
    ----------
    measurement : at its keyframe
    x, c : ndarray, shapes (21,), (C,), the keyframe before it entered, as of `Gaussian`
    nis : normalised innovation squared
    weight : 1 for a full measurement, less by its loss, 0 for a rejected one; a place that fits none of its
        name counts as rejected, and is remembered as another
    place : ndarray, shape (2,), where the place that is seen was believed to be, or None
    """

    measurement: KeyframeMeasurement
    x: Array
    c: Array
    nis: float
    weight: float
    place: Array | None = None


@dataclass(frozen=True)
class FilterStep:
    """Through one interval, from one keyframe to the next.

    Attributes
    ----------
    departed : the keyframe before, with what was measured after it; None at the first keyframe
    transition : the way from there; None at the first keyframe
    filtered : the keyframe that ends the interval
    processed : the measurements
    """

    departed: Gaussian | None
    transition: Transition | None
    filtered: Gaussian
    processed: list[ProcessedMeasurement]


@dataclass(frozen=True)
class FilterRun:
    """Through k intervals in a row, with m measurements.

    Attributes
    ----------
    before, known : Gaussian of the keyframe before them, and of the last one
    filtered : the keyframes, and what became of the measurements
    sensors, which : names, and ndarray of int, shape (m,), whose of them each measurement is
    interval, between : ndarray of int and of bool, shape (m,), the interval of each, and whether it belongs to the
        keyframe before that
    """

    before: Gaussian
    known: Gaussian
    filtered: Filtered
    sensors: Sequence[str]
    which: NDArray[np.int64]
    interval: NDArray[np.int64]
    between: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.filtered.x)


@dataclass(frozen=True)
class MetStates:
    """x and c of n measurements that a filter met while it ran through intervals, as of `ProcessedMeasurement`.

    Attributes
    ----------
    before : Gaussian of the keyframe before the intervals
    x, c, predicted_x, predicted_c : as of `rovgraph.kernels.filtering.Filtered`
    interval, between : as of it, of the n measurements
    """

    before: Gaussian
    x: Array
    c: Array
    predicted_x: Array
    predicted_c: Array
    interval: NDArray[np.int64]
    between: NDArray[np.bool_]

    def __call__(self) -> tuple[Array, Array]:
        """x and c, shapes (n, 21), (n, C)."""
        interval, between = self.interval, self.between
        x, c = self.predicted_x[interval], self.predicted_c[interval]
        former, first = between & (interval > 0), between & (interval == 0)
        x[former], c[former] = self.x[interval[former] - 1], self.c[interval[former] - 1]
        x[first], c[first] = self.before.x, self.before.c
        return x, c
