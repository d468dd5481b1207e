"""ROS messages of a Nortek Nucleus: its packets, as the maker's driver passes them on unchanged.

They have no header: ``timestamp`` and ``microseconds`` are the instrument's, ``system_timestamp`` the driver's. Axes
and units are those of `rovgraph.interchange.nucleus`. Source: github.com/NortekSupport/nucleus_driver,
ros2/src/interfaces/msg; the package is called ``interfaces``, so messages of others may have its types.
"""

import math
from collections.abc import Callable, Iterator
from typing import Any

from rovgraph.geometry import matrix_from_rpy, quaternion_from_matrix
from rovgraph.interchange.nortek_tracks import LONGEST_DELAY_S
from rovgraph.interchange.nucleus import GAUSS
from rovgraph.interchange.rosbag_messages import Said, Unusable

CLOCK = "the Nucleus's own"


def stamp(message: Any) -> float:
    """Of the instrument, for a track that of the echo [s].

    Raises
    ------
    Unusable : another message of that name
    """
    if not hasattr(message, "microseconds") or not hasattr(message, "posix_time"):
        raise Unusable("a message of that type, but not of a Nucleus")
    delay = float(getattr(message, "dt_xyz", math.nan))
    return (
        float(message.timestamp) + 1e-6 * float(message.microseconds) + (delay if abs(delay) < LONGEST_DELAY_S else 0.0)
    )


def declination_deg(message: Any) -> float:
    """What the instrument has added to its heading; 0 where it does not say."""
    declination = float(getattr(message, "declination", 0.0))
    return declination if math.isfinite(declination) else 0.0


def _imu(message: Any) -> Iterator[Said]:
    values = [getattr(message, f"{name}_{axis}") for name in ("accelerometer", "gyro") for axis in "xyz"]
    yield Said("imu", tuple(values) if message.is_valid else (math.nan,) * 6)


def _magnetometer(message: Any) -> Iterator[Said]:
    x, y, z = (GAUSS * getattr(message, f"magnetometer_{axis}") for axis in "xyz")
    yield Said("mag", (x, y, z))


def _ahrs(message: Any) -> Iterator[Said]:
    """Heading without the declination that the instrument has added."""
    angles = message.roll, message.pitch, message.heading - declination_deg(message)
    if all(map(math.isfinite, angles)):
        R_ns = matrix_from_rpy([math.radians(angle) for angle in angles])
        yield Said("ahrs", tuple(quaternion_from_matrix(R_ns).tolist()))
    if math.isfinite(message.depth):
        yield Said("depth", (message.depth,))


def _velocity(message: Any) -> tuple[float, float, float]:
    valid = all(getattr(message, f"{axis}_velocity_valid") for axis in "xyz")
    x, y, z = (getattr(message, f"velocity_{axis}") if valid else math.nan for axis in "xyz")
    return x, y, z


def _bottom(message: Any) -> Iterator[Said]:
    velocity = _velocity(message)
    valid = all(map(math.isfinite, velocity))
    known = valid and all(getattr(message, f"{axis}_fom_valid") for axis in "xyz")
    sd = math.sqrt(sum(getattr(message, f"fom_{axis}") ** 2 for axis in "xyz") / 3.0) if known else math.nan
    yield Said("dvl", (*(velocity if valid else (math.nan,) * 3), float(valid), sd))
    seen = [getattr(message, f"distance_beam_{k}") for k in (1, 2, 3) if getattr(message, f"beam_{k}_distance_valid")]
    if seen:
        yield Said("dvl_altitude", (sum(seen) / len(seen),))


def _water(message: Any) -> Iterator[Said]:
    velocity = _velocity(message)
    if all(map(math.isfinite, velocity)):
        yield Said("dvl_water", velocity)


READERS: dict[str, Callable[[Any], Iterator[Said]]] = {
    "interfaces/msg/IMU": _imu,
    "interfaces/msg/Magnetometer": _magnetometer,
    "interfaces/msg/AHRS": _ahrs,
    "interfaces/msg/BottomTrack": _bottom,
    "interfaces/msg/WaterTrack": _water,
}


def _fields(kind: str, *names: str) -> str:
    return "".join(f"{kind} {name}\n" for name in names)


_STAMPS = "builtin_interfaces/Time system_timestamp\n" + _fields("bool", "posix_time")
_STAMPS += _fields("uint32", "timestamp", "microseconds")
_TRACK = (
    _STAMPS
    + _fields("bool", *(f"beam_{k}_{what}_valid" for what in ("velocity", "distance", "fom") for k in (1, 2, 3)))
    + _fields("bool", *(f"{axis}_{what}_valid" for what in ("velocity", "fom") for axis in "xyz"))
    + _fields("uint32", "serial_number")
    + _fields("float32", "sound_speed", "temperature", "pressure")
    + _fields("float32", *(f"{what}_beam_{k}" for what in ("velocity", "distance", "fom", "dt", "time_vel")
                           for k in (1, 2, 3)))
    + _fields("float32", *(f"{what}_{axis}" for what in ("velocity", "fom") for axis in "xyz"), "dt_xyz")
)  # fmt: skip
_FAILURES = "sensor", "memory", "gyro_1", "gyro_2", "accelerometer"
DEFINITIONS = {  # of bags that carry none, as those of ROS 2 Humble
    "interfaces/msg/IMU": _STAMPS
    + _fields("bool", "is_valid", "has_data_path_overrun", "has_flash_update_failure", "has_spi_com_error")
    + _fields("bool", "has_low_voltage", *(f"has_{part}_failure" for part in _FAILURES))
    + _fields("float32", *(f"{what}_{axis}" for what in ("accelerometer", "gyro") for axis in "xyz"), "temperature"),
    "interfaces/msg/Magnetometer": _STAMPS
    + _fields("bool", "is_compensated_for_hard_iron", "dvl_active", "dvl_acoustics_active", "dvl_transmitter_active")
    + _fields("float32", *(f"magnetometer_{axis}" for axis in "xyz")),
    "interfaces/msg/AHRS": _STAMPS
    + "uint32 serial_number\nuint8 operation_mode\n"
    + _fields("float32", "fom_ahrs", "fom_fc1", "roll", "pitch", "heading", *(f"quaternion_{q}" for q in "wxyz"))
    + _fields("float32", *(f"rotation_matrix_{k}" for k in range(9)), "declination", "depth"),
    "interfaces/msg/BottomTrack": _TRACK,
    "interfaces/msg/WaterTrack": _TRACK,
}
