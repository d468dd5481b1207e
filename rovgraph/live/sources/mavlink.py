"""MAVLink: what an autopilot tells of its sensors.

Sources: the message definitions at https://mavlink.io/en/messages/common.html; units of RAW_IMU
as ArduPilot fills it.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.geometry import wrap_angle
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.sources.mavlink_frames import Frames
from rovgraph.live.sources.preferred import Preferred
from rovgraph.live.sources.source import Chunk, Notify

IMUS = ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2")  # best first
MILLI_G = 9.80665e-3  # [m/s2]
MICROTESLA = {"milligauss": 0.1, "gauss": 100.0}
UNIX_USEC = 1e15  # times above this, in microseconds, are since 1970, those below since the start
RANGE_SD_M = 3.0  # of a satellite's range; with the dilution of precision that of a fix
NO_HDOP = 65535
VEHICLE_COMPONENT = 1

_ACC, _GYR, _MAG = (tuple(f"{axis}{kind}" for axis in "xyz") for kind in ("acc", "gyro", "mag"))


@dataclass(frozen=True)
class Options:
    """What a URL may say.

    Attributes
    ----------
    system, component : whose messages are read; system None = the first one heard
    imu : one of `IMUS`, None = the best one heard
    pressure : 1 to 3, the sensor of SCALED_PRESSURE, SCALED_PRESSURE2, SCALED_PRESSURE3
    surface : pressure at depth 0 [hPa], None = the first one heard
    density : of the water [kg/m3]
    """

    system: int | None = None
    component: int = VEHICLE_COMPONENT
    imu: str | None = None
    pressure: int = 2
    surface: float | None = None
    density: float = 1025.0


class MavlinkDecoder:
    """From bytes to messages.

    Parameters
    ----------
    url : of the source
    notify : takes warnings
    config : for declination and gravity
    options : of the URL

    Raises
    ------
    InputError : pymavlink is not installed
    """

    def __init__(self, url: str, notify: Notify, config: Config, options: Options) -> None:
        self._url = url
        self._notify = notify
        self._options = options
        self._frames = Frames(_dialect(), notify)
        self._system = options.system
        self._surface = options.surface
        self._density_gravity = options.density * config.environment.gravity_mps2
        self._declination = np.deg2rad(config.environment.declination_deg)
        self._imus = Preferred(IMUS if options.imu is None else (options.imu,), notify)
        self._fix_time: int | None = None
        pressure = "SCALED_PRESSURE" + (str(options.pressure) if options.pressure > 1 else "")
        self._read: dict[str, Callable[[Any, float], Message | None]] = {
            **dict.fromkeys(IMUS, self._imu),
            "ATTITUDE": self._attitude,
            pressure: self._pressure,
            "GPS_RAW_INT": self._fix,
            "VISION_POSITION_DELTA": self._velocity,
        }

    def feed(self, chunk: Chunk) -> Iterator[Message]:
        if chunk.fresh:
            self._frames.restart()
        for message in self._frames.messages(chunk.data):
            read = self._read.get(message.get_type())
            if read is not None and self._of_vehicle(message):
                said = read(message, chunk.arrival)
                if said is not None:
                    yield said

    def _of_vehicle(self, message: Any) -> bool:
        """Whether the vehicle's autopilot says this. A DVL's velocity is said to it, by anyone."""
        if message.get_type() == "VISION_POSITION_DELTA":
            return True
        if self._system is None and message.get_srcComponent() == self._options.component:
            self._system = message.get_srcSystem()
        if message.get_srcComponent() == self._options.component and message.get_srcSystem() != self._system:
            other = f"system {message.get_srcSystem()} is heard too and ignored, {self._system} is read"
            self._notify("another system", f"{other}; say which with ?system=", once=True)
        return self._from_autopilot(message)

    def _from_autopilot(self, message: Any) -> bool:
        sender = message.get_srcSystem(), message.get_srcComponent()
        return bool(sender == (self._system, self._options.component))

    def _said(self, arrival: float, seconds: float, *found: Reading, clock: str = "boot") -> Message | None:
        """A message of the readings that are finite but for what is optional in them."""
        good = tuple(r for r in found if _whole(r))
        if len(good) < len(found):
            self._notify("not finite", "a value that is no number is left out")
        return Message(self._url, arrival, seconds or None, good, clock if seconds else "") if good else None

    def _said_usec(self, arrival: float, usec: float, *found: Reading, sender: str = "") -> Message | None:
        """As `_said`, of a time that is since 1970 or since the start, by the clock of whoever sends it."""
        return self._said(arrival, 1e-6 * usec, *found, clock=("unix" if usec > UNIX_USEC else "boot") + sender)

    def _imu(self, message: Any, arrival: float) -> Message | None:
        kind = message.get_type()
        found = _highres_imu(message) if kind == "HIGHRES_IMU" else _scaled_imu(message)
        if not any(r.sensor == "imu" for r in found) or not self._imus.takes(kind, arrival):
            return None
        usec = 1e3 * message.time_boot_ms if kind == "SCALED_IMU2" else message.time_usec
        return self._said_usec(arrival, usec, *found)

    def _attitude(self, message: Any, arrival: float) -> Message | None:
        yaw = float(wrap_angle(message.yaw - self._declination))  # from true to magnetic north, as a compass has it
        attitude = Reading("ahrs", np.array([yaw, message.roll, message.pitch]))
        return self._said(arrival, 1e-3 * message.time_boot_ms, attitude)

    def _pressure(self, message: Any, arrival: float) -> Message | None:
        if self._surface is None and math.isfinite(message.press_abs):
            self._surface = message.press_abs
            self._notify("surface", f"the first pressure, {message.press_abs:.1f} hPa, is taken as that at the surface")
        depth = 100.0 * (message.press_abs - (self._surface or math.nan)) / self._density_gravity
        return self._said(arrival, 1e-3 * message.time_boot_ms, Reading("depth", np.array([depth])))

    def _fix(self, message: Any, arrival: float) -> Message | None:
        if message.fix_type < 3 or message.time_usec == self._fix_time != 0 or message.lat == message.lon == 0:
            return None
        self._fix_time = message.time_usec
        if abs(message.lat) > 90e7 or abs(message.lon) > 180e7:
            self._notify("out of range", "a fix that is nowhere on Earth is left out")
            return None
        fix = np.array([1e-7 * message.lat, 1e-7 * message.lon, _fix_sd(message)])
        return self._said_usec(arrival, message.time_usec, Reading(GEODETIC, fix))

    def _velocity(self, message: Any, arrival: float) -> Message | None:
        """Mean velocity over an interval, which is that of its middle."""
        velocity, valid = np.full(3, np.nan), message.confidence > 0.0 and message.time_delta_usec > 0
        if valid:
            velocity = np.array(message.position_delta) / (1e-6 * message.time_delta_usec)
        middle = max(0.0, message.time_usec - 0.5 * message.time_delta_usec)
        sender = "" if self._from_autopilot(message) else f" of {message.get_srcSystem()}/{message.get_srcComponent()}"
        return self._said_usec(arrival, middle, Reading("dvl", np.array([*velocity, valid, np.nan])), sender=sender)


_REQUIRED = {"imu": 6, "mag": 3, "ahrs": 3, "dvl": 4, "depth": 1, GEODETIC: 2}


def _whole(reading: Reading) -> bool:
    """Whether everything that is required is finite; a ping without bottom lock needs no velocity."""
    lost = reading.sensor == "dvl" and reading.values[3] == 0.0
    return lost or bool(np.isfinite(reading.values[: _REQUIRED[reading.sensor]]).all())


def _scaled_imu(message: Any) -> list[Reading]:
    """Of RAW_IMU or SCALED_IMU2, mg, mrad/s and mgauss; a sensor that is not there says zeros."""
    acc, gyr, mag = (np.array([getattr(message, n) for n in names], dtype=float) for names in (_ACC, _GYR, _MAG))
    found = [Reading("imu", np.concatenate([MILLI_G * acc, 1e-3 * gyr]))] if acc.any() else []
    return found + ([Reading("mag", MICROTESLA["milligauss"] * mag)] if mag.any() else [])


def _highres_imu(message: Any) -> list[Reading]:
    """Of HIGHRES_IMU, SI and gauss: what it says is new."""
    found = []
    if message.fields_updated & 0x03F == 0x03F:
        found.append(Reading("imu", np.array([getattr(message, n) for n in _ACC + _GYR], dtype=float)))
    if message.fields_updated & 0x1C0 == 0x1C0:
        mag = np.array([getattr(message, n) for n in _MAG], dtype=float)
        found.append(Reading("mag", MICROTESLA["gauss"] * mag))
    return found


def _fix_sd(message: Any) -> float:
    """Of a fix, north and east: the receiver's own, else by its dilution of precision, else NaN [m]."""
    if getattr(message, "h_acc", 0) > 0:
        return 1e-3 * float(message.h_acc)
    return RANGE_SD_M * 1e-2 * message.eph if 0 < message.eph < NO_HDOP else math.nan


def _dialect() -> Any:
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError:
        raise InputError("mavlink: needs pymavlink; install it with: pip install 'rovgraph[online]'") from None
    return ardupilotmega
