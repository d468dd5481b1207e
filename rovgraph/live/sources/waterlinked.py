"""Water Linked A50 and A125: the DVL's own TCP protocol, JSON lines of the format json_v3.

Source: the protocol's description at https://docs.waterlinked.com/dvl/dvl-protocol: ``time_of_validity`` is that of the
reflection at the bottom, ``time_of_transmission`` when the report leaves the DVL, both in microseconds of its clock.
"""

import math
from typing import Any

import numpy as np

from rovgraph.live.message import Message, Reading
from rovgraph.live.sources.lines import LineDecoder, Refused, json_number, json_object, shown
from rovgraph.live.sources.source import Notify

PORT = 16171
FORMAT = "json_v3"  # minor versions, as json_v3.1, only add to it
LONGEST_LATENCY_S = 5.0  # between validity and transmission; more is no latency
IGNORED = ("position_local", "response")


def waterlinked(url: str, notify: Notify) -> LineDecoder:
    """Decoder of a Water Linked DVL's reports."""
    return LineDecoder(lambda line, arrival: report_message(json_object(line), url, arrival, notify), notify)


def is_report(row: dict[str, Any]) -> bool:
    """Whether a JSON object is one of this protocol."""
    return row.get("type") in ("velocity", *IGNORED) and "format" in row


def report_message(report: dict[str, Any], url: str, arrival: float, notify: Notify) -> Message | None:
    """What a report says; None where it is about no measurement.

    Raises
    ------
    Refused : the report is to be skipped
    """
    if report.get("type") in IGNORED:
        return None
    _check(report)
    if report.get("status"):
        notify("status", "the DVL reports a fault, such as being too hot; its velocities are used as long as valid")
    stamp, sent = _time(report, "time_of_validity"), _time(report, "time_of_transmission")
    latency = None if stamp is None or sent is None or not 0.0 <= sent - stamp < LONGEST_LATENCY_S else sent - stamp
    return Message(url, arrival, stamp, _readings(report), latency=latency)


def _check(report: dict[str, Any]) -> None:
    if report.get("type") != "velocity":
        raise Refused("unknown report", f"a report of type {shown(str(report.get('type')))} is ignored")
    if not str(report.get("format")).startswith(FORMAT):
        text = f"format {shown(str(report.get('format')))}, expected {FORMAT}; update the DVL's software"
        raise Refused("unknown format", text)
    if not isinstance(report.get("velocity_valid"), bool):
        raise Refused("malformed", "a velocity report without velocity_valid is skipped")


def _time(report: dict[str, Any], name: str) -> float | None:
    """A time by the DVL's clock [s]."""
    time = report.get(name)
    return None if time is None else 1e-6 * json_number(name, time)


def _readings(report: dict[str, Any]) -> tuple[Reading, ...]:
    """Velocity, and altitude where there is one."""
    if not report["velocity_valid"]:
        return (Reading("dvl", np.array([np.nan, np.nan, np.nan, 0.0, np.nan])),)
    velocity = [json_number(name, report.get(name)) for name in ("vx", "vy", "vz")]
    found = [Reading("dvl", np.array([*velocity, 1.0, _velocity_sd(report)]))]
    altitude = report.get("altitude")
    if altitude is not None and json_number("altitude", altitude) > 0.0:  # -1 = none
        found.append(Reading("dvl_altitude", np.array([float(altitude)])))
    return tuple(found)


def _velocity_sd(report: dict[str, Any]) -> float:
    """Sd of the velocity per axis: of the covariance's trace, else the figure of merit, else NaN [m/s]."""
    try:
        variances = [json_number("covariance", report["covariance"][i][i]) for i in range(3)]
        if min(variances) >= 0.0 and sum(variances) > 0.0:
            return math.sqrt(sum(variances) / 3.0)
    except (Refused, LookupError, TypeError):
        pass
    try:
        merit = json_number("fom", report.get("fom"))
    except Refused:
        merit = 0.0
    return merit if merit > 0.0 else math.nan
