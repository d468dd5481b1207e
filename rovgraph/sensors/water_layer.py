"""Layers of the water: profiles of velocities that a DVL or an ADCP measures in cells, and what they become.

One stream, "adcp", has a row for each cell of each profile. For the estimate the cells of a profile are reduced to
measurements of one sensor, "water_layer", at most one between two knots of the current (`rovgraph.problem.layers`).
"""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, skew
from rovgraph.kernels import measurements as kernels
from rovgraph.kernels.measurement_row import ABOVE_AT, BELOW_AT, LAYER_ARM, LAYER_WIDTH, SHARE
from rovgraph.model.calibration import LAYERS, LAYOUT, WATER_LAYER
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.state import BIAS, POSE, VELOCITY, Jacobians, State
from rovgraph.sensors.dvl import DVL_CALIBRATION, TIME_OFFSET
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Column, Instrument, Observed, Sensor, instrument

CELLS = "adcp"  # stream of cells, and name of the table beside a log
VELOCITIES = ("adcp_vx", "adcp_vy", "adcp_vz")
ALONG = tuple(f"adcp_beam_{k}" for k in range(9))
EARTH = ("adcp_north", "adcp_east", "adcp_down")
ATTITUDE = ("adcp_roll", "adcp_pitch", "adcp_heading")


FIRST = np.zeros(LAYER_WIDTH)  # context of a layer between the first two knots
FIRST[[ABOVE_AT, BELOW_AT, SHARE]] = LAYOUT[LAYERS[0]].start, LAYOUT[LAYERS[1]].start, 0.5


@dataclass(frozen=True)
class WaterLayer:
    """Velocity of the DVL in its own axes, relative to a layer of the water.

    Attributes
    ----------
    context : ndarray, shape (1 or n, LAYER_WIDTH or more), of each measurement, `rovgraph.kernels.measurement_row`
    knots : of the current; 1 = `calibration.current`
    """

    context: Array = field(default_factory=lambda: FIRST[None])
    knots: int = len(LAYERS)
    sensor: str = WATER_LAYER
    dim = 3
    angular = False
    state = (POSE, VELOCITY, BIAS)
    kind = kernels.WATER_LAYER

    @property
    def calibration(self) -> tuple[str, ...]:
        return (*DVL_CALIBRATION, *(LAYERS[: self.knots] if self.knots > 1 else ("current",)))

    @property
    def packed(self) -> Array:
        """The contexts."""
        return self.context

    def of(self, context: Array) -> "WaterLayer":
        """The model of measurements with these contexts, shape (n, LAYER_WIDTH or more)."""
        return replace(self, context=np.ascontiguousarray(context))

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, self.state, state, rate_b)


def _layer(config: Config, origin_b: Array) -> Instrument:
    dvl = config.dvl
    arm_b = np.array(dvl.lever_arm_m) - origin_b
    gain = mount_matrix(dvl.mount_rpy_deg).T @ skew(-arm_b)
    context = FIRST.copy()
    context[LAYER_ARM : LAYER_ARM + 3] = arm_b
    model = WaterLayer(context[None], config.water.knots or len(LAYERS))
    return instrument(dvl, model, config.water.cell_sd_mps, ("x", "y", "z"), gain, TIME_OFFSET)


def _is_cell(values: Array) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(values).any(axis=1))


ADCP = Sensor(
    CELLS,
    (
        Column("adcp_range", "length", optional=True, group="adcp_range"),
        Column("adcp_cell", "length", optional=True, group="adcp_range"),
        Column("adcp_bottom", "length", optional=True, group="adcp_range"),
        Column("adcp_valid", optional=True, flag=True),
        *(Column(name, "speed", optional=True, group="adcp_velocity") for name in (*VELOCITIES, *ALONG, *EARTH)),
        Column("adcp_sd", "speed", optional=True, group="adcp_velocity"),
        *(Column(name, "angle", optional=True, group="adcp_attitude") for name in ATTITUDE),
    ),
    may_begin_later=True,
    complete=_is_cell,
    together="adcp_range and a velocity",
)
LAYER = Sensor(WATER_LAYER, (), _layer, observes=Observed("velocity"))
