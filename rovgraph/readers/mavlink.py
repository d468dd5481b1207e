"""MAVLink messages of an autopilot as readings of its sensors, for live links and for recordings.

Sources: the message definitions at https://mavlink.io/en/messages/common.html; units of RAW_IMU as ArduPilot fills
it. Values come in the order of `COLUMNS`, in SI and radians; vectors along the vehicle's axes, forward, starboard,
down; headings from true north. `MavlinkRows` collects recorded messages as arrays.

`MavlinkFrames` finds frames in a stream of bytes and in telemetry logs. A frame begins with a marker and its length;
after a byte that only looks like a marker, the search continues at the next byte, so that noise costs no good frame. In
a telemetry log (``.tlog``) a time precedes each frame.
"""

import math
import mmap
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log.disk_columns import FlatTable, computed, taken
from rovgraph.readers.ardupilot import RANGE_SD_M

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


class MavlinkReading(NamedTuple):
    """One sensor's measurement.

    Attributes
    ----------
    sensor : key of `COLUMNS`
    values : in its order
    """

    sensor: str
    values: tuple[float, ...]


def usec(message: Any) -> float:
    """When a measurement was made [us]: since 1970 above `UNIX_USEC`, else since the sender's start; 0 = not stated.

    What holds over an interval is of its middle.
    """
    if hasattr(message, "time_boot_ms"):
        return 1e3 * float(message.time_boot_ms)
    stamp = float(message.time_usec if hasattr(message, "time_usec") else getattr(message, "usec", 0))
    return max(0.0, stamp - 0.5 * getattr(message, "time_delta_usec", 0)) if stamp else 0.0


def scaled_imu(message: Any) -> list[MavlinkReading]:
    """Of RAW_IMU or SCALED_IMU, mg, mrad/s and mgauss; zeros for a sensor that is not there."""
    acc, gyr, mag = (tuple(float(getattr(message, n)) for n in names) for names in (_ACC, _GYR, _MAG))
    found = [MavlinkReading("imu", (*(MILLI_G * a for a in acc), *(1e-3 * g for g in gyr)))] if any(acc) else []
    return found + ([MavlinkReading("mag", tuple(MICROTESLA["milligauss"] * m for m in mag))] if any(mag) else [])


def highres_imu(message: Any) -> list[MavlinkReading]:
    """Of HIGHRES_IMU, SI and gauss: the fields that it marks as new."""
    found = []
    if message.fields_updated & 0x03F == 0x03F:
        found.append(MavlinkReading("imu", tuple(float(getattr(message, n)) for n in _ACC + _GYR)))
    if message.fields_updated & 0x1C0 == 0x1C0:
        found.append(MavlinkReading("mag", tuple(MICROTESLA["gauss"] * float(getattr(message, n)) for n in _MAG)))
    return found


def attitude(message: Any) -> list[MavlinkReading]:
    """Of ATTITUDE."""
    rates = message.rollspeed, message.pitchspeed, message.yawspeed
    return [MavlinkReading("ahrs", (message.yaw, message.roll, message.pitch)), MavlinkReading("rates", rates)]


def pressure(message: Any) -> list[MavlinkReading]:
    """Of SCALED_PRESSURE, hPa."""
    return [MavlinkReading("pressure", (100.0 * message.press_abs,))]


def fix(message: Any) -> list[MavlinkReading]:
    """Of GPS_RAW_INT, where there is one; sd: the receiver's own, else by its dilution of precision, else NaN."""
    if message.fix_type < FIX_3D or message.lat == message.lon == 0:
        return []
    sd = RANGE_SD_M * 1e-2 * message.eph if 0 < message.eph < NO_HDOP else math.nan
    if getattr(message, "h_acc", 0) > 0:
        sd = 1e-3 * float(message.h_acc)
    return [MavlinkReading("fix", (1e-7 * message.lat, 1e-7 * message.lon, sd))]


def velocity(message: Any) -> list[MavlinkReading]:
    """Of VISION_POSITION_DELTA: mean velocity over its own interval; without confidence it is a lost ping."""
    valid = message.confidence > 0.0 and message.time_delta_usec > 0
    way = message.position_delta if valid else (math.nan,) * 3
    return [MavlinkReading("dvl", (*(x / (1e-6 * message.time_delta_usec or 1.0) for x in way), float(valid)))]


def velocity_estimate(message: Any) -> list[MavlinkReading]:
    """Of VISION_SPEED_ESTIMATE, whose message does not state the axes."""
    return [MavlinkReading("dvl", (message.x, message.y, message.z, 1.0))]


def altitude(message: Any) -> list[MavlinkReading]:
    """Of DISTANCE_SENSOR, cm, one that looks down and has an echo."""
    if message.orientation != DOWN or not message.min_distance <= message.current_distance <= message.max_distance:
        return []
    return [MavlinkReading("dvl_altitude", (1e-2 * message.current_distance,))]


def outputs(message: Any) -> list[MavlinkReading]:
    """Of SERVO_OUTPUT_RAW, of the first port."""
    if message.port != 0:
        return []
    return [MavlinkReading("outputs", tuple(float(getattr(message, f"servo{k}_raw", 0)) for k in range(1, 17)))]


READERS: Mapping[str, Callable[[Any], list[MavlinkReading]]] = {
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


OF_PARAMETERS = "PARAM_VALUE", "SENSOR_OFFSETS"
WANTED = {*READERS, *OF_PARAMETERS}
Sender = tuple[int, int]  # system, component


@dataclass(frozen=True)
class MavlinkRows:
    """The values of one sensor from messages of one sender and name.

    Attributes
    ----------
    sender : system and component
    name : of the message
    place : ndarray of int, shape (n,), numbers of the messages
    received : ndarray, shape (n,), by the receiver's clock [s]
    stamp : ndarray, shape (n,), by the sender's [s]; NaN = none
    columns : column -> ndarray, shape (n,)
    """

    sender: Sender
    name: str
    place: NDArray[np.int64]
    received: Array
    stamp: Array
    columns: dict[str, Array]

    def __len__(self) -> int:
        return len(self.place)

    def take(self, keep: NDArray[np.bool_]) -> "MavlinkRows":
        """Some of them, by a mask."""
        columns = {name: taken(values, keep) for name, values in self.columns.items()}
        place, received, stamp = (taken(values, keep) for values in (self.place, self.received, self.stamp))
        return replace(self, place=place, received=received, stamp=stamp, columns=columns)

    def within(self, first: int, end: int) -> "MavlinkRows":
        """Those of the messages first, ..., end - 1."""
        return self.take(computed(lambda place: (place >= first) & (place < end), self.place))

    def interleaved(self, names: Sequence[str], other: "MavlinkRows") -> "MavlinkRows":
        """Columns of one, and all of the other, in the order of messages; values missing in a row are NaN."""
        order = np.argsort(np.concatenate([self.place, other.place]), kind="stable")
        of_self = {name: np.concatenate([self.columns[name], np.full(len(other), np.nan)]) for name in names}
        others = {name: np.concatenate([np.full(len(self), np.nan), v]) for name, v in other.columns.items()}
        place, received, stamp = (
            np.concatenate([getattr(self, name), getattr(other, name)])[order]
            for name in ("place", "received", "stamp")
        )
        columns = {name: values[order] for name, values in (of_self | others).items()}
        return MavlinkRows(self.sender, f"{self.name} with {other.name}", place, received, stamp, columns)


def _rows(sender: Sender, name: str, sensor: str, flat: FlatTable) -> MavlinkRows:
    table = flat.table()
    columns = dict(zip(COLUMNS[sensor], table[:, 3:].T, strict=True))
    place = computed(lambda numbers: numbers.astype(np.int64), table[:, 0])
    return MavlinkRows(sender, name, place, table[:, 1], table[:, 2], columns)


class Gatherer:
    """Takes messages one by one.

    Attributes
    ----------
    counts : sender and name of a message -> how many were received, of all
    unreadable : reason -> how many could not be read
    parameters : sender -> its parameters, as they were first
    """

    def __init__(self) -> None:
        self.counts: Counter[tuple[Sender, str]] = Counter()
        self.unreadable: Counter[str] = Counter()
        self.parameters: dict[Sender, dict[str, float]] = {}
        self._flat: dict[tuple[Sender, str, str], FlatTable] = {}
        self._taken = 0

    def take(self, sender: Sender, name: str, message: Any, received: float) -> None:
        """A message of `WANTED`.

        Parameters
        ----------
        message : with its fields as attributes
        received : [s], by the receiver's clock
        """
        self._taken += 1
        if name in OF_PARAMETERS:
            known = self.parameters.setdefault(sender, {})
            parameter = name == "PARAM_VALUE"
            value = float(message.param_value if parameter else message.mag_declination)
            if math.isfinite(value):
                known.setdefault(message.param_id if parameter else "COMPASS_DEC", value)
            return
        stamp = 1e-6 * usec(message) or np.nan
        for reading in READERS[name](message):
            row, key = (self._taken, received, stamp, *reading.values), (sender, name, reading.sensor)
            if (rows := self._flat.get(key)) is None:
                rows = self._flat[key] = FlatTable(len(row))
            rows.append(row)

    def rows(self) -> dict[tuple[Sender, str, str], MavlinkRows]:
        """All rows taken: sender, name of the message and sensor -> Rows."""
        return {key: _rows(*key, flat) for key, flat in self._flat.items()}


Content = bytes | mmap.mmap
V1, V2 = 0xFE, 0xFD
MARKERS = (bytes([V1]), bytes([V2]))
SIGNED = 0x01
SIGNATURE = 13  # bytes
TIME = 8  # bytes of a time in a telemetry log: microseconds since 1970, big-endian
EARLIEST, LATEST = 946_684_800.0, 4_102_444_800.0  # 2000 and 2100, seconds since 1970
JUMP_S = 60.0  # a message's time alone may not be further off than this


def dialect() -> Any:
    """ArduPilot's messages.

    Raises
    ------
    InputError : pymavlink is not installed
    """
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError:
        raise InputError("mavlink: needs pymavlink; install it with: pip install 'rovgraph[online]'") from None
    return ardupilotmega


def frame_length(data: Content | bytearray, start: int) -> int | None:
    """Bytes of the frame that begins with the marker at ``start``; None where there are too few."""
    if len(data) < start + 3:
        return None
    payload, flags = data[start + 1], data[start + 2]
    if data[start] == V1:
        return payload + 8
    return payload + 12 + (SIGNATURE if flags & SIGNED else 0)


class MavlinkFrames:
    """Cuts messages out of bytes.

    Parameters
    ----------
    mavlink : pymavlink's dialect
    notify : takes warnings; "bad data" once per stretch of bytes between messages
    """

    def __init__(self, mavlink: Any, notify: Callable[[str, str], None]) -> None:
        self._parser = mavlink.MAVLink(None)
        self._notify = notify
        self._rest = bytearray()
        self._sane = True  # whether a message has just ended

    def restart(self) -> None:
        """Forget a frame that has only begun."""
        if self._rest:
            self._bad()
        self._rest.clear()
        self._sane = True

    def messages(self, data: bytes) -> Iterator[Any]:
        """Messages that are complete now."""
        self._rest += data
        start = 0
        while start < len(self._rest):
            if self._rest[start] not in (V1, V2):
                self._bad()
                start = self._next_marker(start)
                continue
            length = frame_length(self._rest, start)
            if length is None or start + length > len(self._rest):
                break
            message = self._decoded(start, start + length)
            if message is None:
                self._bad()
                start += 1
                continue
            self._sane = True
            start += length
            yield message
        del self._rest[:start]

    def _decoded(self, start: int, end: int) -> Any:
        """The message between two places, or None.

        One of a kind unknown to the dialect has no checksum that could be checked; it is believed between
        two that are known.
        """
        try:
            message = self._parser.decode(self._rest[start:end])
        except Exception:  # whatever a library of others meets in bytes of others
            return None
        if message.get_type().startswith("UNKNOWN"):
            return message if self._sane and (end == len(self._rest) or self._rest[end] in (V1, V2)) else None
        return message

    def _next_marker(self, start: int) -> int:
        found = (place for place in (self._rest.find(marker, start) for marker in MARKERS) if place >= 0)
        return min(found, default=len(self._rest))

    def _bad(self) -> None:
        if self._sane:
            self._notify("bad data", "bytes that are no message, skipped; a wrong baud rate, or a noisy line?")
        self._sane = False


def frames_with_times(content: Content) -> Iterator[tuple[bytes, float]]:
    """Frames of a telemetry log with the times of their arrival [s]; what stands between them comes too."""
    start = lost = 0
    arrival = 0.0
    while start + TIME < len(content):
        if not begins(content, start):
            start += 1
            continue
        end = start + TIME + (frame_length(content, start + TIME) or len(content))
        if end < len(content) and not begins(content, end) and _begins_within(content, start + 1, end):
            start += 1  # a time and a marker by chance, or a frame that lost bytes
            continue
        time = _arrival(content, start, end, arrival)
        if lost < start:
            yield content[lost:start], arrival or time
        arrival = time
        yield content[start + TIME : end], arrival
        start = lost = end
    if lost < len(content):
        yield content[lost:], arrival


def _arrival(content: Content, start: int, end: int, before: float) -> float:
    """The time of a frame [s]; that of the one before it where neither that nor the next is near."""
    time = _time(content, start)
    near = [before] + ([_time(content, end)] if begins(content, end) else [])
    return time if not before or min(abs(time - other) for other in near) < JUMP_S else before


def _time(content: Content, start: int) -> float:
    return 1e-6 * int.from_bytes(content[start : start + TIME], "big")


def begins(content: Content, start: int) -> bool:
    """Whether a time and the beginning of a frame may stand here."""
    marker = content[start + TIME : start + TIME + 1]
    return marker in MARKERS and EARLIEST < _time(content, start) < LATEST


def _begins_within(content: Content, start: int, end: int) -> bool:
    return any(begins(content, at) for at in range(start, end))
