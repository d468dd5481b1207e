"""The sensors of a configuration: measurement models with the noise that is believed.

`instruments` is the one place where a configuration becomes measurement models, and
`hydrodynamics` the one where it becomes a vehicle in water.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.config import Config, mount_matrix
from rovgraph.errors import InputError
from rovgraph.geometry import Array, skew
from rovgraph.model_aiding import ModelAiding
from rovgraph.sensors import CompassHeading, DvlVelocity, MagneticField, PlaceOffset, Position, SensorModel
from rovgraph.vehicle import Hydrodynamics

HEADING_STREAMS = ("mag", "ahrs", "dvl_heading")  # log streams that give heading, in order
DEFAULT_DIP = np.deg2rad(72.0)  # southern Sweden; used where neither log nor configuration say


@dataclass(frozen=True)
class Instrument:
    """A measurement model and the belief about its noise.

    Attributes
    ----------
    model : the measurement model
    sd : ndarray, shape (dim,), standard deviation of a measurement
    loss : "none", "huber" or "cauchy"
    gate_sd : normalised innovation beyond which a measurement is left out, or None
    readmit_s : time of being left out after which a filter doubts itself [s]
    components : names of the components, dim of them
    rate_gain : ndarray, shape (dim, 3), how an error of the measured rate [rad/s] enters:
        through the DVL's lever arm, at the nominal mounting
    time_offset : name of the calibration variable that says how late its stamps are, or None
    """

    model: SensorModel
    sd: Array
    loss: str
    gate_sd: float | None
    readmit_s: float
    components: tuple[str, ...]
    rate_gain: Array
    time_offset: str | None = None

    @property
    def calibration(self) -> tuple[str, ...]:
        """Calibration variables that its measurements depend on."""
        own = self.model.calibration
        return own if self.time_offset is None else (*own, self.time_offset)


def heading_sources(config: Config, available: set[str]) -> list[str]:
    """Log streams that give heading, in order: "mag", "ahrs", "dvl_heading".

    Where the configuration names no sources, the magnetometer goes before the IMU's own
    heading, which is made from it and would count it twice.
    """
    stream = {"mag": "mag", "ahrs": "ahrs", "dvl": "dvl_heading"}
    if config.heading.sources is not None:
        wanted = [stream[s] for s in config.heading.sources]
    else:
        wanted = ["mag" if "mag" in available else "ahrs", "dvl_heading"]
    return [s for s in HEADING_STREAMS if s in wanted and s in available]


def instruments(config: Config, origin_b: ArrayLike = (0.0, 0.0, 0.0)) -> dict[str, Instrument]:
    """Every sensor of a configuration, by the name of its log stream.

    Parameters
    ----------
    config : Config
    origin_b : array_like, shape (3,), the point of the body that the state's position and
        velocity belong to [m]; lever arms are taken relative to it

    Returns
    -------
    dict : "dvl", "dvl_water", "dvl_heading", "ahrs", "mag", "depth", "fix", "place", "thruster" -> Instrument;
        the sd of "thruster" is that of a mean over one second
    """
    env = config.environment
    origin: Array = np.asarray(origin_b, float)
    declination = float(np.deg2rad(env.declination_deg))
    R_imu = mount_matrix(config.imu.mount_rpy_deg)
    dip = DEFAULT_DIP if env.dip_deg is None else float(np.deg2rad(env.dip_deg))
    magnitude = 1.0 if env.field_norm is None else env.field_norm
    heading = config.heading

    def arm(lever_arm_m: tuple[float, float, float]) -> Array:
        return np.array(lever_arm_m) - origin

    def make(section: object, model: SensorModel, sd: ArrayLike, components: tuple[str, ...]) -> Instrument:
        spread = np.broadcast_to(np.asarray(sd, float), (model.dim,))
        gain = np.zeros((model.dim, 3))
        if isinstance(model, DvlVelocity):
            gain = mount_matrix(config.dvl.mount_rpy_deg).T @ skew(-model.lever_arm_b)
        # a place that is not believed is another place, which nothing has to be readmitted to
        limits = section.gate_sd, getattr(section, "readmit_s", np.inf)  # type: ignore[attr-defined]
        late = "dvl_time_offset" if model.sensor.startswith("dvl") else None
        return Instrument(model, spread, section.loss, *limits, components, gain, late)  # type: ignore[attr-defined]

    dvl, water = (DvlVelocity(arm(config.dvl.lever_arm_m), sensor) for sensor in ("dvl", "dvl_water"))
    compass = CompassHeading("dvl_heading", "dvl_compass_offset", "dvl_compass_deviation", declination)
    ahrs = CompassHeading("ahrs", "ahrs_offset", "ahrs_deviation", declination, R_imu)
    # a heading error of mag_sd turns the horizontal part of the field
    mag_sd = np.deg2rad(heading.mag_sd_deg) * magnitude * max(np.cos(dip), 0.1)
    depth = Position("depth", arm(config.depth.lever_arm_m), (2,), "depth_offset")
    fix = Position("fix", arm(config.fix.lever_arm_m), (0, 1))
    place = PlaceOffset(arm(config.place.lever_arm_m))
    aiding = ModelAiding(hydrodynamics(config), origin, env.gravity_mps2, config.vehicle.thrust_rise_s)
    return {
        "dvl": make(config.dvl, dvl, config.dvl.velocity_sd_mps, ("x", "y", "z")),
        "dvl_water": make(config.dvl, water, config.dvl.water_velocity_sd_mps, ("x", "y", "z")),
        "dvl_heading": make(heading, compass, np.deg2rad(heading.dvl_sd_deg), ("heading",)),
        "ahrs": make(heading, ahrs, np.deg2rad(heading.ahrs_sd_deg), ("heading",)),
        "mag": make(heading, MagneticField(declination, dip, magnitude, R_imu), mag_sd, ("x", "y", "z")),
        "depth": make(config.depth, depth, config.depth.sd_m, ("down",)),
        "fix": make(config.fix, fix, config.fix.sd_m, ("north", "east")),
        "place": make(config.place, place, config.place.sd_m, ("north", "east")),
        "thruster": make(config.vehicle, aiding, config.vehicle.acceleration_sd_mps2, ("x", "y", "z")),
    }


def hydrodynamics(config: Config) -> Hydrodynamics:
    """The vehicle of a configuration, as a body in water; the body's origin is its centre of mass.

    Raises
    ------
    InputError : a thruster without a direction
    """
    vehicle = config.vehicle
    directions = np.array([t.direction for t in vehicle.thrusters], float).reshape(-1, 3)
    idle = np.flatnonzero(~directions.any(axis=1))
    if idle.size:
        raise InputError(f"vehicle.thrusters.{idle[0]}.direction: 0, 0, 0 points nowhere; any other length will do")
    return Hydrodynamics(
        mass=vehicle.mass_kg + np.array(vehicle.added_mass_kg),
        inertia=np.array(vehicle.inertia_kgm2) + np.array(vehicle.added_inertia_kgm2),
        drag_linear=np.array(vehicle.drag_linear),
        drag_quadratic=np.array(vehicle.drag_quadratic),
        turning_drag_linear=np.array(vehicle.turning_drag_linear),
        turning_drag_quadratic=np.array(vehicle.turning_drag_quadratic),
        centre_of_buoyancy=np.array(vehicle.centre_of_buoyancy_m),
        buoyancy=vehicle.mass_kg * config.environment.gravity_mps2,
        thrust_curve=np.array(vehicle.thrust),
        thruster_positions=np.array([t.position_m for t in vehicle.thrusters], float).reshape(-1, 3),
        thruster_directions=directions / np.linalg.norm(directions, axis=1, keepdims=True),
    )
