"""The vehicle's own roll and pitch, which stand in for an accelerometer where there is no IMU."""

from dataclasses import dataclass

import numpy as np

from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.kernels import measurements as kernels
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Column, Instrument, Observed, Sensor, instrument
from rovgraph.state import BIAS, POSE, Jacobians, State


@dataclass(frozen=True)
class Tilt:
    """Roll and pitch of the body."""

    sensor = "vehicle_tilt"
    dim = 2
    angular = True
    state = (POSE, BIAS)
    calibration: tuple[str, ...] = ()
    kind = kernels.TILT
    packed = np.zeros((1, 0))  # it has no numbers of its own

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE,), state, rate_b)


def of_vehicle(config: Config, origin_b: Array) -> Instrument:
    """Roll and pitch as the vehicle's own navigation gives them."""
    return instrument(config.tilt, Tilt(), np.deg2rad(config.tilt.sd_deg), ("roll", "pitch"))


VEHICLE_TILT = Sensor(
    "vehicle_tilt",
    (Column("roll", "angle", group="attitude"), Column("pitch", "angle", group="attitude")),
    of_vehicle,
    once_per_interval=True,
    observes=Observed("heading", (0, 1)),
    may_begin_later=True,
)
