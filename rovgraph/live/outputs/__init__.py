"""Outputs of navigation solutions: a name or URL becomes an `Output`. docs/online-output.md describes each.

An output never blocks, and a fault of the receiver never raises an error: solutions that cannot be sent are dropped,
counted, and reported once per kind and minute. May import what `rovgraph.live` may. Begin with `output` (what all
share), then `json_lines`.
"""

from rovgraph.errors import InputError
from rovgraph.live.outputs.json_lines import StandardOutput, TcpOutput, UdpOutput
from rovgraph.live.outputs.mavlink import MavlinkOutput
from rovgraph.live.outputs.nmea import NmeaOutput
from rovgraph.live.outputs.output import Output, parsed
from rovgraph.live.warnings import Warnings

__all__ = ["FORMS", "Output", "open_output"]

FORMS = {
    "-": "-",
    "udp": "udp://host:port",
    "tcp": "tcp://[host]:port",
    "nmea-udp": "nmea-udp://host:port",
    "mavlink": "mavlink:connection",
}
_OUTPUTS: dict[str, type[Output]] = {
    "udp": UdpOutput,
    "tcp": TcpOutput,
    "nmea-udp": NmeaOutput,
    "mavlink": MavlinkOutput,
}


def open_output(url: str, warnings: Warnings | None = None, patient: bool = False) -> Output:
    """Open an output.

    Parameters
    ----------
    url : one of `FORMS`, with options as in ``udp://host:port?rate=5``
    warnings : receives later errors, from other threads too
    patient : standard output waits for its reader instead of dropping lines, as a replay may

    Raises
    ------
    InputError : an unknown form or option, a host or port that cannot be used, a library that is missing
    """
    where = parsed(url)
    if where.scheme == "-":
        return StandardOutput(where, warnings, patient)
    if where.scheme not in _OUTPUTS:
        raise InputError(f"output {url!r} is of an unknown form; known are {', '.join(FORMS.values())}")
    return _OUTPUTS[where.scheme](where, warnings)
