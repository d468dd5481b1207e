"""Compasses that give a heading: the IMU's own, the DVL's, and the vehicle's; and the vehicle's own roll and pitch.

Roll and pitch replace the accelerometer where there is no IMU.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels import measurements as kernels
from rovgraph.model.calibration import LAYOUT, MOUNT
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.state import BIAS, POSE, Jacobians, State
from rovgraph.sensors.dvl import TIME_OFFSET
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Column, Instrument, Observed, Sensor, instrument


@dataclass(frozen=True)
class CompassHeading:
    """Heading of an instrument's x axis with its deviation curve.

    Attributes
    ----------
    sensor : "ahrs", "dvl_heading" or "vehicle_heading"
    offset, curve : names of its calibration variables
    declination : of the north that it is relative to [rad], east positive; one for all epochs or for each
    R_bs : ndarray, shape (3, 3), mounting of the instrument; the DVL's own comes from
        the calibration variables instead
    error : name of the variable of its error that lasts, or None
    gradient : change of the declination by metres north and east [rad/m]
    """

    sensor: str
    offset: str
    curve: str
    declination: float | Array
    R_bs: Array = field(default_factory=lambda: np.eye(3))
    error: str | None = None
    gradient: tuple[float, float] = (0.0, 0.0)
    dim = 1
    angular = True
    state = (POSE, BIAS)

    @property
    def calibration(self) -> tuple[str, ...]:
        mount = MOUNT if self.sensor == "dvl_heading" else ()
        return (self.offset, self.curve, *mount, *(() if self.error is None else (self.error,)))

    @property
    def kind(self) -> int:
        return kernels.DVL_COMPASS if self.sensor == "dvl_heading" else kernels.COMPASS

    @cached_property
    def packed(self) -> Array:
        """Declination, places of offset, curve, error (or -1) in the calibration vector, the x axis in b, gradient."""
        declination = np.atleast_1d(self.declination)
        error = -1 if self.error is None else LAYOUT[self.error].start
        constants = LAYOUT[self.offset].start, LAYOUT[self.curve].start, error, *self.R_bs[:, 0], *self.gradient
        return np.column_stack([declination, np.tile(constants, (len(declination), 1))])

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, (POSE,), state, rate_b)


def reference(config: Config, sensor: str) -> str | None:
    """North that a compass is relative to: "magnetic", "true" or "grid"; None = not stated."""
    return "magnetic" if sensor == "mag" else getattr(config.heading, f"{sensor.partition('_')[0]}_reference")


def declination(config: Config, sensor: str) -> float:
    """Of the north that a compass is relative to, from true north [rad], east positive."""
    env = config.environment
    others = {"true": 0.0, "grid": env.convergence_deg or 0.0}
    return float(np.deg2rad(others.get(reference(config, sensor) or "magnetic", env.declination_deg)))


def gradient(config: Config, sensor: str) -> tuple[float, float]:
    """Change of the declination of its north by metres north and east [rad/m]."""
    by_km = config.environment.declination_per_km_deg
    if by_km is None or reference(config, sensor) in ("true", "grid"):
        return 0.0, 0.0
    return float(np.deg2rad(1e-3 * by_km[0])), float(np.deg2rad(1e-3 * by_km[1]))


def turns_true_headings(config: Config) -> bool:
    """Whether a true heading can be given relative to the north that ``ahrs_yaw`` is relative to."""
    return reference(config, "ahrs") != "magnetic" or "declination_deg" in config.environment.model_fields_set


TRUE_NORTH = "it is relative to true north: state heading.ahrs_reference: true, or environment.declination_deg"


def of_imu(config: Config, origin_b: Array) -> Instrument:
    """The heading that the IMU makes itself."""
    north, R_bs = declination(config, "ahrs"), mount_matrix(config.imu.mount_rpy_deg)
    model = CompassHeading("ahrs", "ahrs_offset", "ahrs_deviation", north, R_bs, "ahrs_error", gradient(config, "ahrs"))
    sd = np.deg2rad(config.heading.ahrs_sd_deg)
    return instrument(config.heading, model, sd, ("heading",), time_offset="ahrs_time_offset")


def of_dvl(config: Config, origin_b: Array) -> Instrument:
    """The heading of the DVL's compass."""
    north, names = declination(config, "dvl_heading"), ("dvl_compass_offset", "dvl_compass_deviation")
    model = CompassHeading(
        "dvl_heading", *names, north, error="dvl_compass_error", gradient=gradient(config, "dvl_heading")
    )
    sd = np.deg2rad(config.heading.dvl_sd_deg)
    return instrument(config.heading, model, sd, ("heading",), time_offset=TIME_OFFSET)


def of_vehicle(config: Config, origin_b: Array) -> Instrument:
    """The heading of the body as the vehicle's own navigation gives it."""
    north = declination(config, "vehicle_heading")
    names = "vehicle_compass_offset", "vehicle_compass_deviation"
    model = CompassHeading(
        "vehicle_heading", *names, north, error="vehicle_compass_error", gradient=gradient(config, "vehicle_heading")
    )
    return instrument(config.heading, model, np.deg2rad(config.heading.vehicle_sd_deg), ("heading",))


AHRS = Sensor(
    "ahrs",
    (
        Column("ahrs_yaw", "angle"),
        Column("ahrs_roll", "angle", optional=True),
        Column("ahrs_pitch", "angle", optional=True),
    ),
    of_imu,
    once_per_interval=True,
    observes=Observed("heading", (2,)),
    linear_in="ahrs_offset",
    heading_source="ahrs",
    may_begin_later=True,
)
DVL_HEADING = Sensor(
    "dvl_heading",
    (Column("dvl_heading", "angle"),),
    of_dvl,
    once_per_interval=True,
    observes=Observed("heading", (2,)),
    linear_in="dvl_compass_offset",
    heading_source="dvl",
    may_begin_later=True,
)
VEHICLE_HEADING = Sensor(
    "vehicle_heading",
    (Column("heading", "angle", group="attitude"),),
    of_vehicle,
    once_per_interval=True,
    observes=Observed("heading", (2,)),
    linear_in="vehicle_compass_offset",
    heading_source="vehicle",
    may_begin_later=True,
)


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


def tilt_of_vehicle(config: Config, origin_b: Array) -> Instrument:
    """Roll and pitch as the vehicle's own navigation gives them."""
    return instrument(config.tilt, Tilt(), np.deg2rad(config.tilt.sd_deg), ("roll", "pitch"))


VEHICLE_TILT = Sensor(
    "vehicle_tilt",
    (Column("roll", "angle", group="attitude"), Column("pitch", "angle", group="attitude")),
    tilt_of_vehicle,
    once_per_interval=True,
    observes=Observed("heading", (0, 1)),
    may_begin_later=True,
)
