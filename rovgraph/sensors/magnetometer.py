"""The magnetometer: the Earth's field in the IMU's axes."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels import measurements as kernels
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.state import BIAS, POSE, Jacobians, State
from rovgraph.sensors.compass import gradient
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Column, Instrument, Level, Observed, Said, Sensor, instrument

# the mean field of the Earth in each unit; "1" where it was normalised
EARTH_FIELD = {"uT": 45.0, "nT": 45e3, "mG": 450.0, "gauss": 0.45, "T": 45e-6, "1": 1.0}
EARTH_RANGE = (0.3, 2.5)  # of it, 22 to 67 uT and as much again for iron and an uncalibrated instrument
DEFAULT_DIP = np.deg2rad(72.0)  # southern Sweden; used where neither log nor configuration state it


def field_direction(declination: Array | float, dip: Array | float) -> Array:
    """Unit vector of the magnetic field in n, shape (..., 3)."""
    d, i = np.broadcast_arrays(np.asarray(declination, float), np.asarray(dip, float))
    return np.stack([np.cos(i) * np.cos(d), np.cos(i) * np.sin(d), np.sin(i)], axis=-1)


@dataclass(frozen=True)
class MagneticField:
    """Magnetometer vector in IMU axes (3.14), soft iron beyond its calibration (3.2) a symmetric matrix.

    Attributes
    ----------
    declination, dip : [rad], declination east positive, dip down positive
    magnitude : length of the field, in the log's unit
    R_bs : ndarray, shape (3, 3), mounting of the IMU
    gradient : change of the declination by metres north and east [rad/m]
    """

    declination: float
    dip: float
    magnitude: float
    R_bs: Array = field(default_factory=lambda: np.eye(3))
    gradient: tuple[float, float] = (0.0, 0.0)
    sensor = "mag"
    dim = 3
    angular = False
    state = (POSE, BIAS)
    calibration = ("mag_offset", "mag_deviation", "hard_iron", "soft_iron", "field_dip", "field_scale")
    kind = kernels.MAGNETOMETER

    @cached_property
    def packed(self) -> Array:
        """Declination, dip, magnitude, the mounting row by row, the declination's gradient."""
        return np.array([[self.declination, self.dip, self.magnitude, *self.R_bs.ravel(), *self.gradient]])

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE,), state, rate_b)


def magnetometer(config: Config, origin_b: Array) -> Instrument:
    """A heading error of ``heading.mag_sd_deg`` turns the horizontal part of the field."""
    env = config.environment
    dip = DEFAULT_DIP if env.dip_deg is None else float(np.deg2rad(env.dip_deg))
    magnitude = 1.0 if env.field_norm is None else env.field_norm
    declination = float(np.deg2rad(env.declination_deg))
    R_bs = mount_matrix(config.imu.mount_rpy_deg)
    model = MagneticField(declination, dip, magnitude, R_bs, gradient(config, "mag"))
    sd = np.deg2rad(config.heading.mag_sd_deg) * magnitude * max(np.cos(dip), 0.1)
    return instrument(config.heading, model, sd, ("x", "y", "z"), time_offset="mag_time_offset")


def _refused(values: Array, config: Config) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    yield "exactly zero", (values == 0.0).all(axis=1)


def _magnitude(values: Array, config: Config) -> Iterator[Said]:
    """The field's magnitude is the Earth's, and constant but for iron near the magnetometer."""
    low, middle, high = np.percentile(np.linalg.norm(values, axis=1), [5, 50, 95])
    spread = (high - low) / middle if middle > 0 else np.inf
    level: Level = "warning" if spread > 0.4 else "ok"
    hint = "; the hard iron is large: calibrate it (rovgraph calibrate magnetometer)" if level == "warning" else ""
    given = [unit for name, unit in config.units.items() if name.startswith("mag")]
    possible = ("uT",) if given else tuple(EARTH_FIELD)
    if not any(low < middle / EARTH_FIELD[unit] < high for unit in possible for low, high in (EARTH_RANGE,)):
        said = "uT" if given else "any unit"
        yield (
            "warning",
            f"field {middle:.4g} is not the Earth's in {said} (22 to 67 uT); if the unit is wrong, "
            "state it, such as units: {mag: nT}, or calibrate it (rovgraph calibrate magnetometer)",
            "unit",
        )
    yield level, f"field {middle:.4g}, its middle 90 % within {spread:.0%}{hint}", "iron"


MAG = Sensor(
    "mag",
    tuple(Column(name, "field") for name in ("mag_x", "mag_y", "mag_z")),
    magnetometer,
    refused=_refused,
    once_per_interval=True,
    observes=Observed("heading", (2,)),
    linear_in="hard_iron",
    heading_source="mag",
    usual_rates=(0.5, 4000.0),
    look=_magnitude,
)
