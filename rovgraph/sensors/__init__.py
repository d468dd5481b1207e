"""Every sensor in one place: measurement model, noise, admission, what it observes, and its checks.

May import `rovgraph.model`, `kernels` and what is below. Begin with `sensor` (`Sensor`, all that rovgraph has of one)
and `dvl`; one module per sensor holds its model and its `Sensor`, and `SENSORS` has them all by the name of their log
stream. The equations are in `rovgraph.kernels.measurements`. docs/own-sensor.md shows how to `register` one of your
own.
"""

from rovgraph.sensors.acoustic import RANGE, SHIP, SHIP_HEADING, SHIP_TILT, USBL, AcousticExchange
from rovgraph.sensors.compass import AHRS, DVL_HEADING, VEHICLE_HEADING, VEHICLE_TILT, CompassHeading, Tilt
from rovgraph.sensors.dvl import DVL, DVL_ALTITUDE, DVL_WATER, DvlVelocity, dvl_mounting
from rovgraph.sensors.dvl_beam import DVL_BEAMS, SINGLE_BEAMS, DvlBeam
from rovgraph.sensors.dvl_sound import DVL_SOUND
from rovgraph.sensors.magnetometer import DEFAULT_DIP, MAG, MagneticField, field_direction
from rovgraph.sensors.model import CompiledModel, SensorModel, evaluate, innovation
from rovgraph.sensors.position import DEPTH, FIX, SEEN_PLACE, PlaceOffset, Position
from rovgraph.sensors.pressure import PRESSURE
from rovgraph.sensors.sensor import (
    MOSTLY,
    SENSORS,
    Column,
    Fault,
    Instrument,
    Kind,
    Level,
    Observed,
    Sensor,
    instrument,
    placeholders,
    register,
    settings,
    unregister,
)
from rovgraph.sensors.thruster import THRUSTER, ModelAiding, WaterVelocity, hydrodynamics
from rovgraph.sensors.water_layer import ADCP, LAYER, WaterLayer

__all__ = [
    "DEFAULT_DIP",
    "MOSTLY",
    "SENSORS",
    "AcousticExchange",
    "Column",
    "CompassHeading",
    "CompiledModel",
    "DvlBeam",
    "DvlVelocity",
    "Fault",
    "Instrument",
    "Kind",
    "Level",
    "MagneticField",
    "ModelAiding",
    "Observed",
    "PlaceOffset",
    "Position",
    "Sensor",
    "SensorModel",
    "Tilt",
    "WaterLayer",
    "WaterVelocity",
    "dvl_mounting",
    "evaluate",
    "field_direction",
    "hydrodynamics",
    "innovation",
    "instrument",
    "placeholders",
    "register",
    "settings",
    "unregister",
]

IMU = Sensor(  # it carries the estimate from one measurement to the next
    "imu",
    (
        *(Column(name, "acceleration", group="acc") for name in ("acc_x", "acc_y", "acc_z")),
        *(Column(name, "rate", group="gyr") for name in ("gyr_x", "gyr_y", "gyr_z")),
    ),
    usual_rates=(5.0, 4000.0),
    if_missing=(
        "error",
        "no IMU: the attitude between measurements is unknown; give acc_x, acc_y, acc_z, gyr_x, gyr_y, gyr_z, "
        "or roll and pitch instead",
    ),
)

_VEHICLE = VEHICLE_HEADING, VEHICLE_TILT
_DVL = DVL, DVL_WATER, DVL_HEADING, DVL_ALTITUDE, DVL_SOUND, DVL_BEAMS, *SINGLE_BEAMS, ADCP, LAYER
_ACOUSTIC = USBL, RANGE, SHIP, SHIP_HEADING, SHIP_TILT
for _sensor in (IMU, MAG, AHRS, *_VEHICLE, *_DVL, DEPTH, PRESSURE, FIX, SEEN_PLACE, *_ACOUSTIC, THRUSTER):
    SENSORS[_sensor.name] = _sensor
