"""ROS messages of sensors as columns of a log.

Values stay in the axes of the message's frame; each type's own definition states what a covariance of -1 means.
Units of ROS are SI (REP 103): https://www.ros.org/reps/rep-0103.html.

Messages of a Nortek Nucleus are its packets, which the maker's driver passes on unchanged. They have no header:
``timestamp`` and ``microseconds`` are the instrument's, ``system_timestamp`` the driver's. Axes and units are those of
`rovgraph.readers.nucleus`. Source: github.com/NortekSupport/nucleus_driver, ros2/src/interfaces/msg; the package is
called ``interfaces``, so messages of others may have its types.
"""

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from rovgraph.geometry import matrix_from_rpy, quaternion_from_matrix
from rovgraph.readers.nortek import LONGEST_DELAY_S
from rovgraph.readers.nucleus import GAUSS
from rovgraph.sensors.dvl_beam import BEAMS

IMU = ("acc_x", "acc_y", "acc_z", "gyr_x", "gyr_y", "gyr_z")
QUATERNION = ("q_x", "q_y", "q_z", "q_w")
COLUMNS = {
    "imu": IMU,
    "ahrs": QUATERNION,
    "mag": ("mag_x", "mag_y", "mag_z"),
    "depth": ("pressure",),
    "fix": ("fix_lat", "fix_lon", "fix_sd", "fix_east_sd", "fix_cov_ne"),
    "dvl": ("dvl_vx", "dvl_vy", "dvl_vz", "dvl_valid", "dvl_sd"),
    "dvl_water": ("dvl_water_vx", "dvl_water_vy", "dvl_water_vz"),
    "dvl_altitude": ("dvl_altitude",),
    BEAMS: tuple(f"dvl_beam_{what}_{k}" for k in range(5) for what in ("valid", "velocity", "range", "sd")),
}
BOTTOM, WATER = 1, 2  # velocity modes
INSTRUMENT = 1  # coordinate mode
LONGEST_LATENCY_S = 5.0
PHASED_ARRAY = 1  # type of a DVL
UNIT_LENGTH, SPREAD, SAME_ANGLE_DEG = 0.02, 0.1, 0.5  # of vectors that are where beams point


class RosReading(NamedTuple):
    """The values of a sensor in a message.

    Attributes
    ----------
    sensor : key of `COLUMNS`
    values : of its columns
    """

    sensor: str
    values: tuple[float, ...]


class Unusable(Exception):
    """A message that is left, and why."""


def _imu(message: Any) -> Iterator[RosReading]:
    acc, gyr, q = message.linear_acceleration, message.angular_velocity, message.orientation
    xyz = (acc.x, acc.y, acc.z) if message.linear_acceleration_covariance[0] != -1.0 else (math.nan,) * 3
    rate = (gyr.x, gyr.y, gyr.z) if message.angular_velocity_covariance[0] != -1.0 else (math.nan,) * 3
    yield RosReading("imu", (*xyz, *rate))
    if message.orientation_covariance[0] != -1.0 and (q.x or q.y or q.z or q.w):  # zeros: not filled
        yield RosReading("ahrs", (q.x, q.y, q.z, q.w))


def _mag(message: Any) -> Iterator[RosReading]:
    field = message.magnetic_field
    yield RosReading("mag", (1e6 * field.x, 1e6 * field.y, 1e6 * field.z))


def _pressure(message: Any) -> Iterator[RosReading]:
    yield RosReading("depth", (message.fluid_pressure,))


def _fix(message: Any) -> Iterator[RosReading]:
    if message.status.status < 0 or not (math.isfinite(message.latitude) and math.isfinite(message.longitude)):
        raise Unusable("no fix")
    east, covariance, north = (float(message.position_covariance[k]) for k in (0, 1, 4))
    known = message.position_covariance_type != 0 and north > 0.0 and east > 0.0
    noise = (math.sqrt(north), math.sqrt(east), covariance) if known else (math.nan,) * 3
    yield RosReading("fix", (message.latitude, message.longitude, *noise))


def _velocity(xyz: Any, valid: bool, sd: float, water: bool = False) -> Iterator[RosReading]:
    velocity = (xyz.x, xyz.y, xyz.z)
    valid = valid and all(math.isfinite(v) for v in velocity)
    if water:
        if valid:
            yield RosReading("dvl_water", velocity)
    elif valid:
        yield RosReading("dvl", (*velocity, 1.0, sd))
    else:
        yield RosReading("dvl", (math.nan, math.nan, math.nan, 0.0, math.nan))


def _altitude(message: Any, valid: bool = True) -> Iterator[RosReading]:
    if valid and math.isfinite(message.altitude) and message.altitude > 0.0:
        yield RosReading("dvl_altitude", (message.altitude,))


def _beams(measured: Mapping[int, tuple[float, float, float]]) -> Iterator[RosReading]:
    """Velocity, range and sd of beams by their numbers from 0 to 4; NaN = none."""
    if any(math.isfinite(v) for values in measured.values() for v in values[:2]):
        cells: list[float] = []
        for k in range(5):
            velocity, far, sd = measured.get(k, (math.nan,) * 3)
            valid = float(math.isfinite(velocity) or math.isfinite(far)) if k in measured else math.nan
            cells += [valid, velocity, far, sd]
        yield RosReading(BEAMS, tuple(cells))


def _marine_beams(message: Any) -> Iterator[RosReading]:
    """Beams 1 to 4; velocities that are zero throughout were not filled in."""
    moves = message.beam_velocities_valid and any(message.beam_velocity)
    measured = {}
    for k, velocity, far, variance in zip(
        (1, 2, 3, 4), message.beam_velocity, message.range, message.beam_velocity_covar, strict=True
    ):
        measured[k] = (
            float(velocity) if moves else math.nan,
            float(far) if message.beam_ranges_valid and far > 0.0 else math.nan,
            math.sqrt(variance) if moves and variance > 0.0 else math.nan,
        )
    yield from _beams(measured)


def beam_settings(message: Any) -> dict[str, Any]:
    """Where a ``marine_acoustic_msgs/Dvl`` says that its beams point, as ``dvl.beams``; {} = it does not."""
    if getattr(message, "velocity_mode", WATER) != BOTTOM or not getattr(message, "beam_velocities_valid", False):
        return {}
    d = np.array([(v.x, v.y, v.z) for v in message.beam_unit_vec])
    length = np.linalg.norm(d, axis=1)
    around = np.column_stack([d[:, :2], np.ones(len(d))])
    if (np.abs(length - 1.0) > UNIT_LENGTH).any() or np.linalg.svd(around, compute_uv=False)[-1] < SPREAD:
        return {}
    angle = np.rad2deg(np.arccos(np.clip(d[:, 2] / length, -1.0, 1.0)))
    if np.ptp(angle) > SAME_ANGLE_DEG or angle.max() >= 90.0:
        return {}
    azimuth = np.rad2deg(np.arctan2(d[:, 1], d[:, 0])) % 360.0
    stated = {"angle_deg": round(float(angle.mean()), 3), "azimuth_deg": [round(float(a), 2) for a in azimuth]}
    return stated | ({"phased": True} if message.dvl_type == PHASED_ARRAY else {})


def _dvl_msgs(message: Any) -> Iterator[RosReading]:
    """``dvl_msgs/DVL`` and its forebear of the A50's driver: fields of Water Linked's report."""
    sd = _sd(getattr(message, "covariance", ()), 3)
    sd = message.fom if math.isnan(sd) and message.fom > 0.0 else sd
    yield from _velocity(message.velocity, message.velocity_valid, sd)
    yield from _altitude(message, message.velocity_valid)
    measured = {}
    for beam in getattr(message, "beams", ()):
        if 0 <= beam.id < 5 and beam.valid:
            measured[beam.id] = beam.velocity, beam.distance if beam.distance > 0.0 else math.nan, math.nan
        elif 0 <= beam.id < 5:
            measured[beam.id] = (math.nan,) * 3
    yield from _beams(measured)


def _marine(message: Any) -> Iterator[RosReading]:
    """``marine_acoustic_msgs/Dvl`` and ``ds_sensor_msgs/Dvl``: a covariance of -1 is not known."""
    if getattr(message, "coordinate_mode", INSTRUMENT) != INSTRUMENT:
        raise Unusable("not in the instrument's axes")
    water = message.velocity_mode == WATER
    v = message.velocity
    valid = message.num_good_beams >= 3 or bool(v.x or v.y or v.z)  # some drivers do not count beams
    yield from _velocity(v, valid, _sd(message.velocity_covar, 3), water)
    if not water:
        yield from _altitude(message, valid)
        if hasattr(message, "beam_velocities_valid"):
            yield from _marine_beams(message)


def _simulated(message: Any) -> Iterator[RosReading]:
    """``uuv_sensor_ros_plugins_msgs/DVL`` and its like: a covariance of -1 is not valid, of 0 not known."""
    valid = message.velocity_covariance[0] >= 0.0
    yield from _velocity(message.velocity, valid, _sd(message.velocity_covariance, 3))
    yield from _altitude(message, valid)


def _twist(message: Any) -> Iterator[RosReading]:
    """``geometry_msgs/TwistWithCovarianceStamped`` and ``nav_msgs/Odometry``."""
    yield from _velocity(message.twist.twist.linear, True, _sd(message.twist.covariance, 6))


def _sd(covariance: Any, size: int) -> float:
    """Per axis [m/s]; NaN where the covariance is not stated."""
    if len(covariance) != size * size:
        return math.nan
    variances = [float(covariance[k * (size + 1)]) for k in range(3)]
    known = all(math.isfinite(v) and v >= 0.0 for v in variances) and sum(variances) > 0.0
    return math.sqrt(sum(variances) / 3.0) if known else math.nan


READERS: dict[str, Callable[[Any], Iterator[RosReading]]] = {
    "sensor_msgs/msg/Imu": _imu,
    "sensor_msgs/msg/MagneticField": _mag,
    "sensor_msgs/msg/FluidPressure": _pressure,
    "sensor_msgs/msg/NavSatFix": _fix,
    "dvl_msgs/msg/DVL": _dvl_msgs,
    "waterlinked_a50_ros_driver/msg/DVL": _dvl_msgs,
    "marine_acoustic_msgs/msg/Dvl": _marine,
    "acoustic_msgs/msg/Dvl": _marine,
    "ds_sensor_msgs/msg/Dvl": _marine,
    "uuv_sensor_ros_plugins_msgs/msg/DVL": _simulated,
    "stonefish_msgs/msg/DVL": _simulated,
    "stonefish_ros/msg/DVL": _simulated,
    "geometry_msgs/msg/TwistWithCovarianceStamped": _twist,
    "nav_msgs/msg/Odometry": _twist,
}
GENERAL = ("geometry_msgs/msg/TwistWithCovarianceStamped", "nav_msgs/msg/Odometry")  # velocities of anything
# z down, by definition; the last are those of a Nucleus
DOWN = ("dvl_msgs/", "waterlinked_a50_ros_driver/", "marine_acoustic_msgs/", "acoustic_msgs/", "interfaces/")
LATER = ("dvl_msgs/msg/DVL",)  # their header is of arrival, and they state the delay of the report


def latency(message: Any) -> float:
    """From validity to transmission [s] by the DVL's clock; 0 where it is not stated, or the header is of validity."""
    took = 1e-6 * (message.time_of_transmission - message.time_of_validity)
    if message.time_of_validity <= 0 or not 0.0 <= took < LONGEST_LATENCY_S:
        return 0.0
    header = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
    return 0.0 if abs(header - 1e-6 * message.time_of_validity) < 0.5 * took else took


_HEADER = "std_msgs/Header header\n"
DEFINITIONS = {  # of bags that carry none: as far as they are needed to find the end of a message
    "dvl_msgs/msg/DVLBeam": "int64 id\nfloat64 velocity\nfloat64 distance\nfloat64 rssi\nfloat64 nsd\nbool valid\n",
    "dvl_msgs/msg/DVL": _HEADER + "float64 time\ngeometry_msgs/Vector3 velocity\nfloat64 fom\nfloat64[] covariance\n"
    "float64 altitude\nDVLBeam[] beams\nbool velocity_valid\nint64 status\nint64 time_of_validity\n"
    "int64 time_of_transmission\nstring form\n",
    "marine_acoustic_msgs/msg/Dvl": _HEADER + "uint8 velocity_mode\nuint8 dvl_type\ngeometry_msgs/Vector3 velocity\n"
    "float64[9] velocity_covar\nfloat64 altitude\nfloat64 course_gnd\nfloat64 speed_gnd\nuint8 num_good_beams\n"
    "float32 sound_speed\nbool beam_ranges_valid\nbool beam_velocities_valid\ngeometry_msgs/Vector3[4] beam_unit_vec\n"
    "float64[4] range\nfloat32[4] range_covar\nfloat32[4] beam_quality\nfloat32[4] beam_velocity\n"
    "float32[4] beam_velocity_covar\n",
    **{
        f"{package}/msg/DVL{part}": text
        for package in ("uuv_sensor_ros_plugins_msgs", "stonefish_msgs")
        for part, text in (
            ("Beam", "float64 range\nfloat64 range_covariance\nfloat64 velocity\nfloat64 velocity_covariance\n"
             "geometry_msgs/PoseStamped pose\n"),
            ("", _HEADER + "geometry_msgs/Vector3 velocity\nfloat64[9] velocity_covariance\nfloat64 altitude\n"
             "DVLBeam[] beams\n"),
        )
    },
}  # fmt: skip


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
    """The angle that the instrument has added to its heading; 0 where it is not stated."""
    declination = float(getattr(message, "declination", 0.0))
    return declination if math.isfinite(declination) else 0.0


def _nucleus_imu(message: Any) -> Iterator[RosReading]:
    values = [getattr(message, f"{name}_{axis}") for name in ("accelerometer", "gyro") for axis in "xyz"]
    yield RosReading("imu", tuple(values) if message.is_valid else (math.nan,) * 6)


def _magnetometer(message: Any) -> Iterator[RosReading]:
    x, y, z = (GAUSS * getattr(message, f"magnetometer_{axis}") for axis in "xyz")
    yield RosReading("mag", (x, y, z))


def _ahrs(message: Any) -> Iterator[RosReading]:
    """Heading without the declination that the instrument has added."""
    angles = message.roll, message.pitch, message.heading - declination_deg(message)
    if all(map(math.isfinite, angles)):
        R_ns = matrix_from_rpy([math.radians(angle) for angle in angles])
        yield RosReading("ahrs", tuple(quaternion_from_matrix(R_ns).tolist()))
    if math.isfinite(message.depth):
        yield RosReading("depth", (message.depth,))


def _nucleus_velocity(message: Any) -> tuple[float, float, float]:
    valid = all(getattr(message, f"{axis}_velocity_valid") for axis in "xyz")
    x, y, z = (getattr(message, f"velocity_{axis}") if valid else math.nan for axis in "xyz")
    return x, y, z


def _bottom(message: Any) -> Iterator[RosReading]:
    velocity = _nucleus_velocity(message)
    valid = all(map(math.isfinite, velocity))
    known = valid and all(getattr(message, f"{axis}_fom_valid") for axis in "xyz")
    sd = math.sqrt(sum(getattr(message, f"fom_{axis}") ** 2 for axis in "xyz") / 3.0) if known else math.nan
    yield RosReading("dvl", (*(velocity if valid else (math.nan,) * 3), float(valid), sd))
    seen = [getattr(message, f"distance_beam_{k}") for k in (1, 2, 3) if getattr(message, f"beam_{k}_distance_valid")]
    if seen:
        yield RosReading("dvl_altitude", (sum(seen) / len(seen),))


def _water(message: Any) -> Iterator[RosReading]:
    velocity = _nucleus_velocity(message)
    if all(map(math.isfinite, velocity)):
        yield RosReading("dvl_water", velocity)


NUCLEUS_READERS: dict[str, Callable[[Any], Iterator[RosReading]]] = {
    "interfaces/msg/IMU": _nucleus_imu,
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
NUCLEUS_DEFINITIONS = {  # of bags that carry none, as those of ROS 2 Humble
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
