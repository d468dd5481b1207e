"""What MAVLink messages of an autopilot say of its sensors: one table for live links and for recordings.

Sources: the message definitions at https://mavlink.io/en/messages/common.html; units of RAW_IMU as ArduPilot fills
it. Values come in the order of `COLUMNS`, in SI and radians; vectors along the vehicle's axes, forward, starboard,
down; headings from true north.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rovgraph.interchange.fixes import RANGE_SD_M

IMUS = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2")  # best first
PRESSURES = ("SCALED_PRESSURE", "SCALED_PRESSURE2", "SCALED_PRESSURE3")  # by instance
SLOW = "raise the stream rate of RAW_IMU (SRn_RAW_SENS), or use the autopilot's own log (.BIN)"
MILLI_G = 9.80665e-3  # [m/s2]
MICROTESLA = {"milligauss": 0.1, "gauss": 100.0}
UNIX_USEC = 1e15  # times above this, in microseconds, are since 1970, those below since the start
NO_HDOP = 65535
FIX_3D = 3
DOWN = 25  # a rangefinder's orientation

COLUMNS: Mapping[str, tuple[str, ...]] = {
    "imu": ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z"),
    "mag": ("mag_x", "mag_y", "mag_z"),
    "ahrs": ("ahrs_yaw", "ahrs_roll", "ahrs_pitch"),
    "rates": ("gyr_x", "gyr_y", "gyr_z"),  # of the autopilot's attitude
    "pressure": ("pressure",),  # [Pa]
    "fix": ("fix_lat", "fix_lon", "fix_sd"),  # [deg], [deg], [m]
    "dvl": ("dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid"),
    "dvl_altitude": ("dvl_altitude",),
    "outputs": tuple(f"servo{k}" for k in range(1, 17)),  # pulse widths [us]
}
_ACC, _GYR, _MAG = (tuple(f"{axis}{kind}" for axis in "xyz") for kind in ("acc", "gyro", "mag"))


class Said(NamedTuple):
    """One sensor's measurement.

    Attributes
    ----------
    sensor : key of `COLUMNS`
    values : in its order
    """

    sensor: str
    values: tuple[float, ...]


def usec(message: Any) -> float:
    """When a measurement was made [us]: since 1970 above `UNIX_USEC`, else since the sender's start; 0 = not said.

    What holds over an interval is of its middle.
    """
    if hasattr(message, "time_boot_ms"):
        return 1e3 * float(message.time_boot_ms)
    stamp = float(message.time_usec if hasattr(message, "time_usec") else getattr(message, "usec", 0))
    return max(0.0, stamp - 0.5 * getattr(message, "time_delta_usec", 0)) if stamp else 0.0


def scaled_imu(message: Any) -> list[Said]:
    """Of RAW_IMU or SCALED_IMU, mg, mrad/s and mgauss; a sensor that is not there says zeros."""
    acc, gyr, mag = (tuple(float(getattr(message, n)) for n in names) for names in (_ACC, _GYR, _MAG))
    found = [Said("imu", (*(MILLI_G * a for a in acc), *(1e-3 * g for g in gyr)))] if any(acc) else []
    return found + ([Said("mag", tuple(MICROTESLA["milligauss"] * m for m in mag))] if any(mag) else [])


def highres_imu(message: Any) -> list[Said]:
    """Of HIGHRES_IMU, SI and gauss: what it says is new."""
    found = []
    if message.fields_updated & 0x03F == 0x03F:
        found.append(Said("imu", tuple(float(getattr(message, n)) for n in _ACC + _GYR)))
    if message.fields_updated & 0x1C0 == 0x1C0:
        found.append(Said("mag", tuple(MICROTESLA["gauss"] * float(getattr(message, n)) for n in _MAG)))
    return found


def attitude(message: Any) -> list[Said]:
    """Of ATTITUDE."""
    rates = message.rollspeed, message.pitchspeed, message.yawspeed
    return [Said("ahrs", (message.yaw, message.roll, message.pitch)), Said("rates", rates)]


def pressure(message: Any) -> list[Said]:
    """Of SCALED_PRESSURE, hPa."""
    return [Said("pressure", (100.0 * message.press_abs,))]


def fix(message: Any) -> list[Said]:
    """Of GPS_RAW_INT, where there is one; sd: the receiver's own, else by its dilution of precision, else NaN."""
    if message.fix_type < FIX_3D or message.lat == message.lon == 0:
        return []
    sd = RANGE_SD_M * 1e-2 * message.eph if 0 < message.eph < NO_HDOP else math.nan
    if getattr(message, "h_acc", 0) > 0:
        sd = 1e-3 * float(message.h_acc)
    return [Said("fix", (1e-7 * message.lat, 1e-7 * message.lon, sd))]


def velocity(message: Any) -> list[Said]:
    """Of VISION_POSITION_DELTA: mean velocity over its own interval; without confidence it is a lost ping."""
    valid = message.confidence > 0.0 and message.time_delta_usec > 0
    way = message.position_delta if valid else (math.nan,) * 3
    return [Said("dvl", (*(x / (1e-6 * message.time_delta_usec or 1.0) for x in way), float(valid)))]


def velocity_estimate(message: Any) -> list[Said]:
    """Of VISION_SPEED_ESTIMATE; along which axes, the message does not say."""
    return [Said("dvl", (message.x, message.y, message.z, 1.0))]


def altitude(message: Any) -> list[Said]:
    """Of DISTANCE_SENSOR, cm, one that looks down and has an echo."""
    if message.orientation != DOWN or not message.min_distance <= message.current_distance <= message.max_distance:
        return []
    return [Said("dvl_altitude", (1e-2 * message.current_distance,))]


def outputs(message: Any) -> list[Said]:
    """Of SERVO_OUTPUT_RAW, of the first port."""
    if message.port != 0:
        return []
    return [Said("outputs", tuple(float(getattr(message, f"servo{k}_raw", 0)) for k in range(1, 17)))]


READERS: Mapping[str, Callable[[Any], list[Said]]] = {
    "HIGHRES_IMU": highres_imu,
    **dict.fromkeys(("RAW_IMU", "SCALED_IMU", "SCALED_IMU2", "SCALED_IMU3"), scaled_imu),
    "ATTITUDE": attitude,
    **dict.fromkeys(PRESSURES, pressure),
    "GPS_RAW_INT": fix,
    "VISION_POSITION_DELTA": velocity,
    "VISION_SPEED_ESTIMATE": velocity_estimate,
    "DISTANCE_SENSOR": altitude,
    "SERVO_OUTPUT_RAW": outputs,
}
