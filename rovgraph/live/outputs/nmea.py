"""NMEA 0183 sentences for chart plotters: GGA (position) and HDT (true heading)."""

import math
from collections.abc import Iterator
from functools import reduce
from operator import xor

from rovgraph.live.outputs.receiver import SATELLITES, dilution
from rovgraph.live.outputs.udp import UdpOutput
from rovgraph.live.solution import Solution

TALKER = "GP"  # what the oldest plotter understands
ESTIMATED = 6  # quality of a GGA: dead reckoning


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
    """Position, with quality 6 (estimated); "" where it is not known.

    Time is that of day, UTC where the solution's time counts from 1970; the altitude is that
    over the surface, negative in a dive. The geoid stays empty, dilution where the sd is not known.
    """
    lat, lon, down = solution.latitude, solution.longitude, float(solution.position[2])
    if lat is None or lon is None or not all(map(math.isfinite, (lat, lon, down, solution.time))):
        return ""
    day = round(solution.time * 100) % 8_640_000  # [0.01 s], so that 59.999 s does not become 60.00
    clock = f"{day // 360_000:02d}{day // 6000 % 60:02d}{day % 6000 / 100:05.2f}"
    lon = (lon + 180.0) % 360.0 - 180.0
    north_south, east_west = "N" if lat >= 0 else "S", "E" if lon >= 0 else "W"
    sd = math.hypot(*solution.position_sd[:2].tolist())
    hdop = f"{min(dilution(sd), 99.9):.1f}" if math.isfinite(sd) else ""
    fields = (
        f"{clock},{_degrees_minutes(lat, 2)},{north_south},{_degrees_minutes(lon, 3)},{east_west},"
        f"{ESTIMATED},{SATELLITES},{hdop},{-down:.2f},M,,M,,"
    )
    return _sentence(f"{TALKER}GGA,{fields}")


def hdt(solution: Solution) -> str:
    """True heading, clockwise from north in [0, 360) degrees; "" where it is not known."""
    yaw = float(solution.rpy[2])
    if not math.isfinite(yaw):
        return ""
    return _sentence(f"{TALKER}HDT,{round(math.degrees(yaw), 2) % 360.0:.2f},T")


def _degrees_minutes(angle: float, digits: int) -> str:
    """``ddmm.mmmmm``, to two centimetres."""
    minutes = round(abs(angle) * 60.0, 5)
    return f"{int(minutes // 60):0{digits}d}{minutes % 60.0:08.5f}"


def _sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode('ascii')):02X}\r\n"
