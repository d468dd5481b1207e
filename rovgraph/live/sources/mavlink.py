"""MAVLink, live: an autopilot's sensors; `rovgraph.readers.mavlink` reads the messages."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rovgraph.geometry import wrap_angle
from rovgraph.live.message import GEODETIC, Message, Reading
from rovgraph.live.sources.source import Chunk, Notify, Preferred
from rovgraph.model.config import Config
from rovgraph.readers.ardupilot import water_settings
from rovgraph.readers.mavlink import IMUS, PRESSURES, READERS, SLOW, UNIX_USEC, MavlinkFrames, dialect, usec
from rovgraph.readers.recording import too_slow
from rovgraph.sensors.compass import TRUE_NORTH, declination, turns_true_headings

VEHICLE_COMPONENT = 1
ENOUGH = 20  # samples of an IMU that give its rate


@dataclass(frozen=True)
class MavlinkOptions:
    """Options of a URL.

    Attributes
    ----------
    system, component : whose messages are read; system None = the first one heard
    imu : one of `IMUS`, None = the best one heard
    pressure : 1 to 3, the sensor of SCALED_PRESSURE, SCALED_PRESSURE2, SCALED_PRESSURE3
    """

    system: int | None = None
    component: int = VEHICLE_COMPONENT
    imu: str | None = None
    pressure: int = 2


class MavlinkDecoder:
    """From bytes to messages.

    Parameters
    ----------
    url : of the source
    notify : takes warnings
    config : for the declination, and what it states of surface and water
    options : of the URL

    Raises
    ------
    InputError : pymavlink is not installed
    """

    def __init__(self, url: str, notify: Notify, config: Config, options: MavlinkOptions) -> None:
        self._url = url
        self._notify = notify
        self._options = options
        self._frames = MavlinkFrames(dialect(), notify)
        self._system = options.system
        self._depth = config.depth
        self._samples: list[float] = []  # when the first ones were made [s]
        self._declination, self._turns = declination(config, "ahrs"), turns_true_headings(config)
        self._imus = Preferred(IMUS if options.imu is None else (options.imu,), notify)
        self._fix_time: int | None = None
        self._read: dict[str, Callable[[Any, float], Message | None]] = {
            **dict.fromkeys(IMUS, self._imu),
            "ATTITUDE": self._attitude,
            PRESSURES[options.pressure - 1]: self._pressure,
            "GPS_RAW_INT": self._fix,
            "VISION_POSITION_DELTA": self._velocity,
            "PARAM_VALUE": self._parameter,
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
        """Whether the vehicle's autopilot sent this. A DVL's velocity may come from any sender."""
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
            self._notify("not finite", "a value that is not a number is left out")
        return Message(self._url, arrival, seconds or None, good, clock if seconds else "") if good else None

    def _said_usec(self, arrival: float, usec: float, *found: Reading, sender: str = "") -> Message | None:
        """As `_said`, of a time that is since 1970 or since the start, by the sender's clock."""
        return self._said(arrival, 1e-6 * usec, *found, clock=("unix" if usec > UNIX_USEC else "boot") + sender)

    def _imu(self, message: Any, arrival: float) -> Message | None:
        kind = message.get_type()
        found = [Reading(sensor, np.array(values)) for sensor, values in READERS[kind](message)]
        if not any(r.sensor == "imu" for r in found) or not self._imus.takes(kind, arrival):
            return None
        if len(self._samples) < ENOUGH:
            self._samples.append(1e-6 * usec(message) or arrival)
            if len(self._samples) == ENOUGH:
                for text in too_slow(np.array(self._samples), kind, SLOW):
                    self._notify("slow", text, once=True)
        return self._said_usec(arrival, usec(message), *found)

    def _attitude(self, message: Any, arrival: float) -> Message | None:
        if not self._turns:
            self._notify("true north", f"ATTITUDE is left out: {TRUE_NORTH}", once=True)
            return None
        yaw, roll, pitch = READERS["ATTITUDE"](message)[0].values
        heading = float(wrap_angle(yaw - self._declination))  # from true north to that of the log
        return self._said_usec(arrival, usec(message), Reading("ahrs", np.array([heading, roll, pitch])))

    def _parameter(self, message: Any, arrival: float) -> None:
        """Of the autopilot, which sends them on request: what it states of surface and water is told, not used."""
        name = message.param_id
        name = name.rstrip("\0") if isinstance(name, str) else name.decode("ascii", "replace")
        stated, _ = water_settings(self._options.pressure - 1, {name: float(message.param_value)})
        for key, value in stated.items():
            if getattr(self._depth, key) is None:
                said = f"the autopilot states {name}; if that is right, state depth: {{{key}: {value:g}}}"
                self._notify(f"not stated: {key}", said, once=True)

    def _pressure(self, message: Any, arrival: float) -> Message | None:
        found = READERS["SCALED_PRESSURE"](message)
        return self._said_usec(arrival, usec(message), Reading("pressure", np.array(found[0].values)))

    def _fix(self, message: Any, arrival: float) -> Message | None:
        found = READERS["GPS_RAW_INT"](message)
        if not found or message.time_usec == self._fix_time != 0:
            return None
        self._fix_time = message.time_usec
        lat, lon, _ = found[0].values
        if abs(lat) > 90.0 or abs(lon) > 180.0:
            self._notify("out of range", "a fix that is nowhere on Earth is left out")
            return None
        return self._said_usec(arrival, usec(message), Reading(GEODETIC, np.array(found[0].values)))

    def _velocity(self, message: Any, arrival: float) -> Message | None:
        found = Reading("dvl", np.array([*READERS["VISION_POSITION_DELTA"](message)[0].values, np.nan]))
        sender = "" if self._from_autopilot(message) else f" of {message.get_srcSystem()}/{message.get_srcComponent()}"
        return self._said_usec(arrival, usec(message), found, sender=sender)


_REQUIRED = {"imu": 6, "mag": 3, "ahrs": 3, "dvl": 4, "pressure": 1, GEODETIC: 2}


def _whole(reading: Reading) -> bool:
    """Whether everything that is required is finite; a ping without bottom lock needs no velocity."""
    lost = reading.sensor == "dvl" and reading.values[3] == 0.0
    return lost or bool(np.isfinite(reading.values[: _REQUIRED[reading.sensor]]).all())
