"""What goes into an interval of the error-state filter, and what comes out."""

from dataclasses import dataclass

from rovgraph.engine.keyframes import KeyframeMeasurement
from rovgraph.estimators.remembered_places import Place
from rovgraph.geometry import Array
from rovgraph.state import State

Gates = dict[str, float]  # sensor that is being kept out -> since when [s]


@dataclass(frozen=True)
class Gaussian:
    """A state with the covariance of its error, in the order of `ErrorVector`.

    Attributes
    ----------
    state : State of one epoch
    P : ndarray, shape (size + 2 m, size + 2 m), the places at the end
    places : m places that are remembered
    """

    state: State
    P: Array
    places: tuple[Place, ...] = ()


@dataclass(frozen=True)
class Step:
    """What a smoother needs of a keyframe.

    Attributes
    ----------
    F, Q : ndarray, shapes as that of P, transition from the keyframe before, and its noise
    predicted : before anything that was measured at the keyframe
    """

    F: Array
    Q: Array
    predicted: Gaussian


@dataclass(frozen=True)
class ProcessedMeasurement:
    """A measurement as the filter met it.

    Attributes
    ----------
    measurement : at its keyframe
    state : of its keyframe, before it entered
    nis : normalised innovation squared
    weight : 1 for a full measurement, less by its loss, 0 for a rejected one; a place that fits none of its
        name counts as rejected, and is remembered as another
    """

    measurement: KeyframeMeasurement
    state: State
    nis: float
    weight: float


@dataclass(frozen=True)
class FilterStep:
    """Through one interval, from one keyframe to the next.

    Attributes
    ----------
    departed : the keyframe before, with what was measured after it; None at the first keyframe
    step : the way from there; None at the first keyframe
    filtered : the keyframe that ends the interval
    used : the measurements
    """

    departed: Gaussian | None
    step: Step | None
    filtered: Gaussian
    used: list[ProcessedMeasurement]
