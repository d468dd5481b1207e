"""Places that a camera or a sonar recognises."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.kernels import measurements as kernels
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Column, Instrument, Observed, Sensor, instrument, own_sd
from rovgraph.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY, Jacobians, State


@dataclass(frozen=True)
class PlaceOffset:
    """How far a camera or sonar is from a place that it recognises, north and east; 0 is what seeing it again says.

    Horizontally only: a pressure sensor knows the altitude better, and looking down from higher
    up shows the same place.

    Attributes
    ----------
    lever_arm_b : ndarray, shape (3,), of the camera relative to the state's origin [m]
    """

    lever_arm_b: Array
    sensor = "place"
    dim = PLACE_DIM
    angular = False
    state = (POSE, VELOCITY, BIAS, PLACE)
    calibration = ()
    kind = kernels.PLACE_OFFSET

    @cached_property
    def packed(self) -> Array:
        """The lever arm."""
        return np.array([self.lever_arm_b], dtype=float)

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE, PLACE), state, rate_b)


def recognition(config: Config, origin_b: Array) -> Instrument:
    """A place that is not believed is another place, which nothing has to be readmitted to."""
    place = config.place
    return instrument(place, PlaceOffset(np.array(place.lever_arm_m) - origin_b), place.sd_m, ("north", "east"))


SEEN_PLACE = Sensor(
    "place",
    (Column("place_id"), Column("place_sd", "length", optional=True, largest=5e3)),
    recognition,
    standard_deviation=own_sd(1),
    observes=Observed("position", (0, 1)),
    may_begin_later=True,
    occasional=True,
)
