"""NMEA 0183 sentences for chart plotters: GGA (position), HDT (true heading) and VTG (course and speed).

The output imitates a GPS receiver, for programs that read only one.
"""

import math
from collections.abc import Iterator
from functools import reduce
from operator import xor

from rovgraph.live.outputs.json_lines import UdpOutput
from rovgraph.live.solution import Solution

SATELLITES = 10  # autopilots refuse fewer than six
RANGE_ERROR = 5.0  # per unit of dilution of precision [m]


def dilution(sd: float) -> float:
    """Dilution of precision with which a receiver would be as uncertain as ``sd`` [m]."""
    return sd / RANGE_ERROR


TALKER = "GP"  # what the oldest plotter understands
ESTIMATED = 6  # quality of a GGA: dead reckoning
KNOT = 1852.0 / 3600.0  # [m/s]


class NmeaOutput(UdpOutput):
    """GGA and HDT, a datagram each; only HDT as long as latitude and longitude are not known."""

    def _datagrams(self, solution: Solution) -> Iterator[bytes]:
        position, heading = gga(solution), hdt(solution)
        if position:
            yield position.encode("ascii")
        else:
            self._complain(
                "no origin",
                "latitude and longitude are not known: GGA is not sent; state environment.origin_lat_deg and "
                "origin_lon_deg, or give a fix",
            )
        if heading:
            yield heading.encode("ascii")


def gga(solution: Solution) -> str:
    """Position of a solution, see `position_sentence`; "" where it is not known."""
    if solution.latitude is None or solution.longitude is None:
        return ""
    sd = math.hypot(*solution.position_sd[:2].tolist())
    return position_sentence(solution.time, solution.latitude, solution.longitude, float(solution.position[2]), sd)


def hdt(solution: Solution) -> str:
    """True heading of a solution, see `heading_sentence`."""
    return heading_sentence(float(solution.rpy[2]))


def position_sentence(time: float, lat: float, lon: float, down: float, sd: float) -> str:
    """GGA with quality 6 (estimated); "" where anything but the sd is not known.

    Time is that of day, UTC where it counts from 1970; the altitude is that over the surface, negative in a dive.
    The geoid stays empty, dilution where the sd is not known.

    Parameters
    ----------
    time : [s]
    lat, lon : [deg]
    down, sd : depth and horizontal sd [m]
    """
    if not all(map(math.isfinite, (lat, lon, down, time))):
        return ""
    day = round(time * 100) % 8_640_000  # [0.01 s], so that 59.999 s does not become 60.00
    clock = f"{day // 360_000:02d}{day // 6000 % 60:02d}{day % 6000 / 100:05.2f}"
    lon = (lon + 180.0) % 360.0 - 180.0
    north_south, east_west = "N" if lat >= 0 else "S", "E" if lon >= 0 else "W"
    hdop = f"{min(dilution(sd), 99.9):.1f}" if math.isfinite(sd) else ""
    fields = (
        f"{clock},{_degrees_minutes(lat, 2)},{north_south},{_degrees_minutes(lon, 3)},{east_west},"
        f"{ESTIMATED},{SATELLITES},{hdop},{-down:.2f},M,,M,,"
    )
    return _sentence(f"{TALKER}GGA,{fields}")


def heading_sentence(yaw: float) -> str:
    """HDT of a heading [rad], clockwise from north in [0, 360) degrees; "" where it is not known."""
    if not math.isfinite(yaw):
        return ""
    return _sentence(f"{TALKER}HDT,{_bearing(yaw)},T")


def course_sentence(v_north: float, v_east: float) -> str:
    """VTG of a velocity over ground [m/s]; "" where it is not known."""
    if not (math.isfinite(v_north) and math.isfinite(v_east)):
        return ""
    speed = math.hypot(v_north, v_east)
    course = _bearing(math.atan2(v_east, v_north))
    return _sentence(f"{TALKER}VTG,{course},T,,M,{speed / KNOT:.2f},N,{3.6 * speed:.2f},K,E")


def _bearing(angle: float) -> str:
    return f"{round(math.degrees(angle), 2) % 360.0:.2f}"


def _degrees_minutes(angle: float, digits: int) -> str:
    """``ddmm.mmmmmm``, to two millimetres."""
    minutes = round(abs(angle) * 60.0, 6)
    return f"{int(minutes // 60):0{digits}d}{minutes % 60.0:09.6f}"


def _sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode('ascii')):02X}\r\n"
