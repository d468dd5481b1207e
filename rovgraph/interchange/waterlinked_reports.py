"""Reports of Water Linked's DVLs, as they send them (JSON over TCP) or as they were written into a file.

Source: https://docs.waterlinked.com/dvl/dvl-protocol: ``time_of_validity`` is that of the reflection,
``time_of_transmission`` when the report leaves the DVL, both in microseconds of its clock; ``time`` is the
milliseconds since the last report, and no stamp.
"""

import math
from dataclasses import dataclass
from typing import Any

from rovgraph.interchange.lines import Refused, json_number, shown

VELOCITIES = ("velocity", "velocity_water")
FORMATS = ("json_v1", "json_v2", "json_v3")  # minor versions, as json_v3.2, only add to them
STAMPED = "json_v3"  # the first with a time of validity
_OTHERS = ("position_local", "response")


@dataclass(frozen=True)
class Report:
    """A velocity report.

    Attributes
    ----------
    water : of the velocity relative to the water, not to the bottom
    velocity : x, y, z of the instrument's axes [m/s]; None = not valid
    sd : of the velocity, per axis [m/s]; NaN = not known
    altitude : [m]; None = not known
    validity, transmission : by the DVL's clock [s]; None = not reported
    fault : the DVL reports one, such as being too hot
    """

    water: bool
    velocity: tuple[float, float, float] | None
    sd: float
    altitude: float | None
    validity: float | None
    transmission: float | None
    fault: bool


def is_report(row: dict[str, Any]) -> bool:
    """Whether a JSON object is one of this protocol."""
    return row.get("type") in (*VELOCITIES, *_OTHERS) and "format" in row


def velocity_report(row: dict[str, Any]) -> Report | None:
    """What a report says of a velocity; None where it is a report of something else.

    Raises
    ------
    Refused : it is to be skipped
    """
    if row.get("type") in _OTHERS:
        return None
    _check(row)
    water = row.get("type") == "velocity_water" or row.get("tracking_mode") == "water"
    velocity = sd = altitude = None
    if row["velocity_valid"]:
        x, y, z = (json_number(name, row.get(name)) for name in ("vx", "vy", "vz"))
        velocity, sd = (x, y, z), _velocity_sd(row)
        altitude = None if water or row.get("altitude") is None else json_number("altitude", row["altitude"])
    return Report(
        water,
        velocity,
        math.nan if sd is None else sd,
        altitude if altitude is not None and altitude > 0.0 else None,  # -1 = none
        _time(row, "time_of_validity"),
        _time(row, "time_of_transmission"),
        bool(row.get("status")),
    )


def _check(row: dict[str, Any]) -> None:
    if row.get("type") not in VELOCITIES:
        raise Refused("unknown report", f"a report of type {shown(str(row.get('type')))} is ignored")
    if not str(row.get("format")).startswith(FORMATS):
        text = f"format {shown(str(row.get('format')))}, expected {STAMPED}"
        raise Refused("unknown format", text)
    if not isinstance(row.get("velocity_valid"), bool):
        raise Refused("malformed", "a velocity report without velocity_valid is skipped")


def _time(row: dict[str, Any], name: str) -> float | None:
    time = row.get(name)
    return None if time is None else 1e-6 * json_number(name, time)


def _velocity_sd(row: dict[str, Any]) -> float:
    """Of the covariance's trace, else the figure of merit, else NaN."""
    try:
        variances = [json_number("covariance", row["covariance"][i][i]) for i in range(3)]
        if min(variances) >= 0.0 and sum(variances) > 0.0:
            return math.sqrt(sum(variances) / 3.0)
    except (Refused, LookupError, TypeError):
        pass
    try:
        merit = json_number("fom", row.get("fom"))
    except Refused:
        merit = 0.0
    return merit if merit > 0.0 else math.nan
