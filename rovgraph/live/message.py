"""Messages from live sources, and parsing of log rows into readings."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.log.streams import LAT_LON, SHIP_LAT_LON, THRUSTER
from rovgraph.sensors import SENSORS

# positions in latitude, longitude [deg] and noise [m], which become "fix" and "ship" once there is an origin
GEODETIC, SHIP_GEODETIC = "geodetic", "ship_geodetic"
ON_EARTH = {  # their columns
    GEODETIC: (*LAT_LON, *SENSORS["fix"].column_names[2:]),
    SHIP_GEODETIC: (*SHIP_LAT_LON, *SENSORS["ship"].column_names[2:]),
}


class Reading(NamedTuple):
    """One sensor's measurement without its time.

    Attributes
    ----------
    sensor : key of `SENSORS` or of `ON_EARTH`
    values : ndarray, shape (k,), SI, the stream's columns; what is optional and absent is NaN
        (``dvl_valid``: 1)
    """

    sensor: str
    values: Array


class Message(NamedTuple):
    """The readings of one source at one time.

    Attributes
    ----------
    source : the URL that a person gave
    arrival : by the host's clock, seconds since 1970
    stamp : time of validity by the source's own clock [s], None where it has none
    readings : one per sensor
    clock : which of the source's clocks the stamp is from, where it has several
    latency : time from validity to transmission, by the same clock [s]; None if the source does not report it
    """

    source: str
    arrival: float
    stamp: float | None
    readings: tuple[Reading, ...]
    clock: str = ""
    latency: float | None = None


def readings(cells: Mapping[str, float]) -> tuple[Reading, ...]:
    """Readings of a row: of every sensor whose required columns are all there and finite.

    Of thrusters: from the first on without a hole, or it would not be known whose signal it is.

    Parameters
    ----------
    cells : column of a log -> value in SI; NaN or an infinity counts as absent
    """
    cells = {name: value for name, value in cells.items() if np.isfinite(value)}
    found = []
    for sensor, known in SENSORS.items():
        if not any(name in cells for name in known.column_names):
            continue
        lost = sensor == "dvl" and cells.get("dvl_valid") == 0.0  # a ping without bottom lock needs no velocities
        if lost or all(c in cells for c in known.required):
            values = np.array([cells.get(c, 1.0 if c == "dvl_valid" else np.nan) for c in known.column_names])
            if known.complete is None or known.complete(values[None])[0]:
                found.append(Reading(sensor, values))
    for sensor, columns in ON_EARTH.items():
        if all(name in cells for name in columns[:2]):
            found.append(Reading(sensor, np.array([cells.get(name, np.nan) for name in columns])))
    thrusters = [f"thruster_{k + 1}" for k in range(sum(THRUSTER.fullmatch(n) is not None for n in cells))]
    if thrusters and all(name in cells for name in thrusters):
        found.append(Reading("thruster", np.array([cells[n] for n in thrusters])))
    return tuple(found)
