"""Water Linked A50 and A125, live: reports over TCP, which `rovgraph.interchange.waterlinked_reports` reads."""

from typing import Any

import numpy as np

from rovgraph.interchange.lines import Refused, json_object, shown
from rovgraph.interchange.waterlinked_reports import STAMPED, VELOCITIES, Report, velocity_report
from rovgraph.live.message import Message, Reading
from rovgraph.live.sources.lines import LineDecoder
from rovgraph.live.sources.source import Notify

PORT = 16171
LONGEST_LATENCY_S = 5.0  # between validity and transmission; more is no latency


def waterlinked(url: str, notify: Notify) -> LineDecoder:
    """Decoder of a Water Linked DVL's reports."""
    return LineDecoder(lambda line, arrival: report_message(json_object(line), url, arrival, notify), notify)


def report_message(row: dict[str, Any], url: str, arrival: float, notify: Notify) -> Message | None:
    """What a report says; None where it is about no measurement.

    Raises
    ------
    Refused : the report is to be skipped
    """
    if row.get("type") in VELOCITIES and not str(row.get("format")).startswith(STAMPED):
        text = f"format {shown(str(row.get('format')))}, expected {STAMPED}; update the DVL's software"
        raise Refused("unknown format", text)
    report = velocity_report(row)
    if report is None:
        return None
    if report.fault:
        notify("status", "the DVL reports a fault, such as being too hot; its velocities are used as long as valid")
    readings = _readings(report)
    return Message(url, arrival, report.validity, readings, latency=_latency(report)) if readings else None


def _latency(report: Report) -> float | None:
    if report.validity is None or report.transmission is None:
        return None
    latency = report.transmission - report.validity
    return latency if 0.0 <= latency < LONGEST_LATENCY_S else None


def _readings(report: Report) -> tuple[Reading, ...]:
    """Velocity, and altitude where there is one."""
    if report.water:
        return () if report.velocity is None else (Reading("dvl_water", np.array(report.velocity)),)
    if report.velocity is None:
        return (Reading("dvl", np.array([np.nan, np.nan, np.nan, 0.0, np.nan])),)
    found = [Reading("dvl", np.array([*report.velocity, 1.0, report.sd]))]
    if report.altitude is not None:
        found.append(Reading("dvl_altitude", np.array([report.altitude])))
    return tuple(found)
