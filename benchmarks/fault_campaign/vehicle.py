"""What a vehicle and its instruments are, and the configuration that describes them.

Grades: MTi as an Xsens MTi-30 data sheet (2020), tactical as a Sensonor STIM300 (TS1524),
FOG as a KVH 1750 (2015); noise as densities per root hertz. Scale errors and
non-orthogonality are what remains after the makers' calibration.
"""

from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fault_campaign import earth
from fault_campaign.earth import Array
from fault_campaign.motion import ORIGIN

Triple = Sequence[float]


def _zeros() -> Array:
    return np.zeros(3)


@dataclass
class Imu:
    """An inertial unit.

    Attributes
    ----------
    rate : samples per second
    acc_noise, gyr_noise : [m/s^2/rtHz, rad/s/rtHz]
    acc_walk, gyr_walk : of the biases [m/s^2/rts, rad/s/rts]
    acc_bias_sd, gyr_bias_sd : at the start [m/s^2, deg/s]
    matrix_sd : of scale errors and non-orthogonality
    mount_rpy_deg, arm : in body axes
    acc_bias, gyr_bias : beyond what the sds say [m/s^2, rad/s]
    acc_matrix, gyr_matrix : shape (3, 3), scale and non-orthogonality beyond what the maker left
    """

    acc_noise: float
    gyr_noise: float
    acc_walk: float
    gyr_walk: float
    acc_bias_sd: float
    gyr_bias_sd: float
    matrix_sd: float
    rate: float = 100.0
    mount_rpy_deg: Triple = (0.0, 0.0, 0.0)
    arm: Triple = (-0.1, 0.05, -0.1)
    acc_bias: Array = field(default_factory=_zeros)
    gyr_bias: Array = field(default_factory=_zeros)
    acc_matrix: Array = field(default_factory=lambda: np.eye(3))
    gyr_matrix: Array = field(default_factory=lambda: np.eye(3))


GRADES = {
    "mti": Imu(8e-4, 7e-4, 3e-4, 1e-5, 0.02, 0.2, 2e-4),
    "tactical": Imu(6e-4, 4.4e-5, 5e-5, 1e-6, 0.01, 0.05, 1e-4, mount_rpy_deg=(180.0, 0.0, 90.0)),
    "fog": Imu(1.2e-3, 3.5e-6, 2e-5, 1e-8, 0.01, 3e-4, 5e-5),
}
GRADES["mti, gyro scale 0.2 %"] = replace(GRADES["mti"], gyr_matrix=1.002 * np.eye(3))


@dataclass
class Dvl:
    """A Doppler velocity log with its own compass.

    Attributes
    ----------
    rate : pings per second
    sd, water_sd : of the components of a ping from the bottom, and of one from the water [m/s]
    yaw_sd : how well the mounting's yaw is known [deg]
    scale, scale_sd : relative error of the velocity, and of one that is drawn in addition
    """

    rate: float = 5.0
    sd: Triple = (0.005, 0.005, 0.003)
    water_sd: Triple = (0.03, 0.03, 0.03)
    mount_rpy_deg: Triple = (180.0, 0.0, -45.0)
    arm: Triple = (0.25, 0.0, 0.3)
    yaw_sd: float = 3.0
    scale: float = 0.0
    scale_sd: float = 0.0


@dataclass
class Compass:
    """A heading: white noise, a constant offset and a deviation curve; a magnetometer: hard iron.

    Attributes
    ----------
    rate : samples per second
    sd, offset_sd, curve_sd : [deg]
    offset : beyond what ``offset_sd`` says [deg]
    """

    rate: float = 10.0
    sd: float = 0.5
    offset_sd: float = 1.0
    curve_sd: float = 0.5
    offset: float = 0.0


@dataclass
class Depth:
    """A pressure sensor: rate [Hz], noise [m], place in b [m], offset [m], relative error of the water's density."""

    rate: float = 5.0
    sd: float = 0.02
    arm: Triple = (-0.2, 0.0, -0.1)
    offset: float = 0.0
    density: float = 0.0


@dataclass
class Fix:
    """Position fixes from a ship or a satellite: rate [Hz], noise [m], place of antenna or transponder in b [m]."""

    rate: float = 0.5
    sd: float = 1.0
    arm: Triple = (0.0, 0.0, -0.4)


@dataclass
class Field:
    """The Earth's magnetic field: declination and dip [deg], magnitude [uT], and hard iron's sd as a fraction of it."""

    declination: float = 4.5
    dip: float = 72.0
    magnitude: float = 50.0
    hard_iron_sd: float = 0.02
    soft_iron: Array = field(default_factory=lambda: np.eye(3))
    hard_iron_per_speed: Array = field(default_factory=_zeros)


@dataclass
class Vehicle:
    """All instruments, and the sd of the water's velocity, north and east [m/s].

    ``aids`` names those aboard beside IMU and DVL: ahrs, mag, dvl_heading, depth, fix, dvl_water.
    """

    imu: Imu
    aids: Sequence[str] = ("ahrs", "depth")
    dvl: Dvl = field(default_factory=Dvl)
    ahrs: Compass = field(default_factory=Compass)
    mag: Compass = field(default_factory=lambda: Compass(sd=1.0))
    dvl_heading: Compass = field(default_factory=lambda: Compass(rate=5.0))
    depth: Depth = field(default_factory=Depth)
    fix: Fix = field(default_factory=Fix)
    field: Field = field(default_factory=Field)
    current_sd: float = 0.1


def make_vehicle(grade: str, aids: Sequence[str]) -> Vehicle:
    """A healthy vehicle."""
    return Vehicle(deepcopy(GRADES[grade]), tuple(aids))


def configuration(vehicle: Vehicle) -> dict[str, Any]:
    """What a careful crew would write about a healthy vehicle, by rovgraph's keys."""
    imu, dvl = vehicle.imu, vehicle.dvl
    sources = [name for name in ("mag", "dvl_heading", "ahrs") if name in vehicle.aids]
    precise = imu.gyr_noise < 1e-4  # within ten seconds the Earth turns further than the gyro's noise

    def compass(key: str, model: Compass) -> dict[str, Any]:
        return {
            f"{key}_offset": {"estimate": True, "sd_deg": model.offset_sd},
            f"{key}_deviation": {"estimate": key != "mag", "sd_deg": model.curve_sd},
        }

    return {
        "start": {"position_sd_m": 0.1},
        "environment": {
            "gravity_mps2": float(earth.gravity(np.asarray(ORIGIN[0]), np.asarray(0.0))),
            "latitude_deg": float(np.rad2deg(ORIGIN[0])),
            "declination_deg": vehicle.field.declination,
            "earth_rotation": precise,
        },
        "imu": {
            "mount_rpy_deg": list(imu.mount_rpy_deg),
            "lever_arm_m": list(imu.arm),
            "noise": {
                "acc": imu.acc_noise,
                "gyr": imu.gyr_noise,
                "acc_walk": imu.acc_walk,
                "gyr_walk": imu.gyr_walk,
            },
            "acc_bias_sd_mps2": imu.acc_bias_sd,
            "gyr_bias_sd_dps": imu.gyr_bias_sd,
        },
        "dvl": {
            "mount_rpy_deg": list(dvl.mount_rpy_deg),
            "lever_arm_m": list(dvl.arm),
            "velocity_sd_mps": list(dvl.sd),
            "water_velocity_sd_mps": list(dvl.water_sd),
        },
        "heading": {
            "sources": [name.removesuffix("_heading") for name in sources],
            "mag_sd_deg": vehicle.mag.sd,
            "dvl_sd_deg": vehicle.dvl_heading.sd,
            "ahrs_sd_deg": vehicle.ahrs.sd,
        },
        "depth": {"sd_m": vehicle.depth.sd, "lever_arm_m": list(vehicle.depth.arm)},
        "fix": {"sd_m": vehicle.fix.sd, "lever_arm_m": list(vehicle.fix.arm)},
        "calibration": {
            "dvl_yaw": {"estimate": True, "sd_deg": dvl.yaw_sd},
            **compass("ahrs", vehicle.ahrs),
            **compass("mag", vehicle.mag),
            **compass("dvl_compass", vehicle.dvl_heading),
            "hard_iron": {"estimate": True, "sd": vehicle.field.hard_iron_sd},
        },
    }
