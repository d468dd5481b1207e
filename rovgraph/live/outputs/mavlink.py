"""Solutions as MAVLink 2 messages, to an autopilot over any connection of pymavlink.

Fields: https://mavlink.io/en/messages/common.html, GPS_INPUT (232) and VISION_POSITION_ESTIMATE
(102). Both take north, east, down and forward, starboard, down, as a solution does.
"""

import math
import re
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any, ClassVar

import numpy as np

from rovgraph.dates import gps_of_unix
from rovgraph.errors import InputError
from rovgraph.live.outputs.nmea import SATELLITES, dilution
from rovgraph.live.outputs.output import Background, Output, Url
from rovgraph.live.solution import Solution
from rovgraph.live.warnings import Warnings

UNIX = 1e9  # a time beyond this counts from 1970 [s]


def gps_input(solution: Solution) -> Any:
    """GPS_INPUT of a solution, None where latitude and longitude are not known.

    Heights are over the surface. What is not known is marked in ``ignore_flags``.
    """
    from pymavlink.dialects.v20 import common as m

    s = solution
    down, down_sd = float(s.position[2]), float(s.position_sd[2])
    if s.latitude is None or s.longitude is None or not np.isfinite([s.latitude, s.longitude, s.time]).all():
        return None
    horizontal_sd, speed_sd = math.hypot(*s.position_sd[:2].tolist()), math.hypot(*s.velocity_sd.tolist())
    flags = {
        m.GPS_INPUT_IGNORE_FLAG_ALT: down,
        m.GPS_INPUT_IGNORE_FLAG_HDOP | m.GPS_INPUT_IGNORE_FLAG_HORIZONTAL_ACCURACY: horizontal_sd,
        m.GPS_INPUT_IGNORE_FLAG_VDOP | m.GPS_INPUT_IGNORE_FLAG_VERTICAL_ACCURACY: down_sd,
        m.GPS_INPUT_IGNORE_FLAG_VEL_HORIZ: math.hypot(*s.velocity[:2].tolist()),
        m.GPS_INPUT_IGNORE_FLAG_VEL_VERT: float(s.velocity[2]),
        m.GPS_INPUT_IGNORE_FLAG_SPEED_ACCURACY: speed_sd,
    }
    week, of_week = gps_of_unix(s.time) if s.time > UNIX else (0, 0.0)
    north, east, downwards = (_finite(v) for v in s.velocity.tolist())
    return m.MAVLink_gps_input_message(
        time_usec=_microseconds(s.time),
        gps_id=0,
        ignore_flags=sum(flag for flag, value in flags.items() if not math.isfinite(value)),
        time_week_ms=int(of_week * 1000),
        time_week=int(week),
        fix_type=m.GPS_FIX_TYPE_3D_FIX if math.isfinite(down) else m.GPS_FIX_TYPE_2D_FIX,
        lat=round(s.latitude * 1e7),
        lon=round(((s.longitude + 180.0) % 360.0 - 180.0) * 1e7),
        alt=-_finite(down),
        hdop=dilution(_finite(horizontal_sd)),
        vdop=dilution(_finite(down_sd)),
        vn=north,
        ve=east,
        vd=downwards,
        speed_accuracy=_finite(speed_sd),
        horiz_accuracy=_finite(horizontal_sd),
        vert_accuracy=_finite(down_sd),
        satellites_visible=SATELLITES,
        yaw=_centidegrees(float(s.rpy[2])),
    )


def vision_position_estimate(solution: Solution) -> Any:
    """VISION_POSITION_ESTIMATE of a solution, None where position or attitude are not known.

    The covariance holds variances and that of north with east; the first is NaN where it is
    not known, as the message wants it.
    """
    from pymavlink.dialects.v20 import common as m

    pose = [*solution.position.tolist(), *solution.rpy.tolist()]
    if not np.isfinite([solution.time, *pose]).all():
        return None
    covariance = np.diag(np.square([*solution.position_sd.tolist(), *solution.rpy_sd.tolist()]))
    covariance[0, 1] = solution.cov_north_east
    upper = covariance[np.triu_indices(6)]
    if not np.isfinite(upper).all():
        upper[:] = [np.nan, *[0.0] * 20]
    x, y, z, roll, pitch, yaw = pose
    return m.MAVLink_vision_position_estimate_message(
        _microseconds(solution.time), x, y, z, roll, pitch, yaw, covariance=upper.tolist()
    )


# name -> (from a solution to the message, or None; component that sends it: GPS, visual odometry)
MESSAGES: dict[str, tuple[Callable[[Solution], Any], int]] = {
    "GPS_INPUT": (gps_input, 220),
    "VISION_POSITION_ESTIMATE": (vision_position_estimate, 197),
}


def _microseconds(seconds: float) -> int:
    return max(round(seconds * 1e6), 0)


def _centidegrees(yaw: float) -> int:
    """Heading in (0, 36000], where 36000 is north and 0 is not known [0.01 deg]."""
    if not math.isfinite(yaw):
        return 0
    return round(math.degrees(yaw) * 100.0) % 36_000 or 36_000


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


QUEUED = 4  # solutions; an autopilot wants the newest
HEARTBEAT_S = 1.0
RETRY_S = 2.0
CLOSE_S = 0.5

NETWORK = re.compile(r"(udpout|udpin|udpbcast|tcp):[^:]+:\d+")
SERIAL = re.compile(r"(/|COM\d).*", re.IGNORECASE)


class MavlinkOutput(Output):
    """One message per solution, and a heartbeat a second, by a thread of its own.

    Parameters
    ----------
    url : ``mavlink:CONNECTION?message=GPS_INPUT`` or ``VISION_POSITION_ESTIMATE``; connections as
        pymavlink writes them. Further options: ``system`` (1, the autopilot's), ``component``, ``rate``
    warnings : where warnings go

    Raises
    ------
    InputError : an unknown message or form of connection, or pymavlink is missing
    """

    OPTIONS: ClassVar[tuple[str, ...]] = ("message", "rate", "system", "component")

    def __init__(self, url: Url, warnings: Warnings | None = None) -> None:
        super().__init__(url, warnings)
        name = url.options.get("message", "GPS_INPUT")
        if name not in MESSAGES:
            raise InputError(f"output {url.text!r}: unknown message {name!r}; known are {', '.join(MESSAGES)}")
        _require_connection(url)
        self._message, component = MESSAGES[name]
        self._system = int(url.number("system", 1, 1, 255) or 1)
        self._component = int(url.number("component", component, 1, 255) or component)
        self._link: Any = None
        self._mav: Any = None
        self._opened = self._beaten = -math.inf
        self._background = Background(self._transmit, QUEUED, f"output: {url.text}")

    def _send(self, solution: Solution) -> None:
        lost = self._background.put(solution)
        if lost:
            self._drop(lost, "slow reader", "the connection is slower than the solutions; lower rate")

    def close(self) -> None:
        left = self._background.close(CLOSE_S)
        if left:
            self._drop(left, "slow reader", "the connection does not take what is left")

    def _transmit(self, solution: Solution) -> None:
        try:
            message = self._message(solution)
            if message is None:
                self._complain("not known", "not sent: needs more than is known (GPS_INPUT: an origin or a fix)")
                return
            if self._link is None and not self._open():
                self._drop(1, "connection", "not connected, still trying")
                return
            self._beat()
            self._mav.send(message)
            _drain(self._link)
        except Exception as error:  # whatever a foreign library makes of a far side that is gone
            self._give_up(error)

    def _open(self) -> bool:
        """Connect, unless that was tried a moment ago; whether it did."""
        if time.monotonic() - self._opened < RETRY_S:
            return False
        self._opened = time.monotonic()
        from pymavlink import mavutil
        from pymavlink.dialects.v20 import common

        self._link = mavutil.mavlink_connection(self.url.place, retries=1)
        # pymavlink would print to standard output, where lines of JSON may go
        self._link.handle_eof = self._link.handle_disconnect = _gone
        self._link.portdead = True
        self._mav = common.MAVLink(_Whole(self._link), srcSystem=self._system, srcComponent=self._component)
        return True

    def _beat(self) -> None:
        """Announce this component to routers and autopilots."""
        if time.monotonic() - self._beaten < HEARTBEAT_S:
            return
        self._beaten = time.monotonic()
        from pymavlink.dialects.v20 import common as m

        self._mav.heartbeat_send(m.MAV_TYPE_ONBOARD_CONTROLLER, m.MAV_AUTOPILOT_INVALID, 0, 0, m.MAV_STATE_ACTIVE)

    def _give_up(self, error: Exception) -> None:
        """Let the link go; the next solution tries again."""
        link, self._link = self._link, None
        self._drop(1, "connection", f"cannot be sent ({str(error) or type(error).__name__}), still trying")
        if link is not None:
            try:
                link.close()
            except Exception:
                return


class _Whole:
    """What pymavlink's messages are written to; it raises where a link only reports that it failed."""

    def __init__(self, link: Any) -> None:
        self._link = link

    def write(self, data: bytes) -> None:
        if self._link.write(data) == -1:
            raise ConnectionError("the serial port does not take it")


def _gone() -> None:
    raise ConnectionError("the far side has closed the connection")


def _drain(link: Any) -> None:
    """Take what comes in: it fills the system's buffers, and from it ``udpin`` learns the address to send to."""
    for _ in range(100):
        if not link.recv(4096):
            return


def _require_connection(url: Url) -> None:
    """The connection has a form that can be written to, and what it needs is installed."""
    serial = SERIAL.fullmatch(url.place)
    if not serial and not NETWORK.fullmatch(url.place):
        raise InputError(
            f"output {url.text!r}: unknown connection {url.place!r}; "
            "known are udpout:host:port, udpin:host:port, udpbcast:host:port, tcp:host:port, /dev/tty...,baud"
        )
    try:
        import_module("pymavlink.mavutil")
        if serial:
            import_module("serial")
    except ImportError as error:
        raise InputError(
            f"output {url.text!r}: needs {error.name}; install it with: pip install 'rovgraph[online]'"
        ) from None
