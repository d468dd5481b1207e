"""Solutions as MAVLink 2 messages.

Fields: https://mavlink.io/en/messages/common.html, GPS_INPUT (232) and VISION_POSITION_ESTIMATE
(102). Both take north, east, down and forward, starboard, down, as a solution does.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from rovgraph.gps_time import gps_of_unix
from rovgraph.live.outputs.receiver import SATELLITES, dilution
from rovgraph.live.solution import Solution

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
