"""A solution as a line of JSON; docs/online-output.md is the contract."""

import json
import math
from typing import Any

from rovgraph.live.solution import Solution
from rovgraph.trajectory import ATTITUDE, POSITION, VELOCITY

_ENCODER = json.JSONEncoder(allow_nan=False, separators=(",", ":"))


def json_line(solution: Solution) -> bytes:
    """One line with its end, in ASCII; what is not known or not finite is null."""
    return (_ENCODER.encode(as_dict(solution)) + "\n").encode("ascii")


def as_dict(solution: Solution) -> dict[str, Any]:
    """The values of a solution under the names of the contract, as plain Python."""
    s = solution
    known: dict[str, Any] = {"time": _number(s.time, decimals=6)}
    for names, values in ((POSITION, s.position), (ATTITUDE, s.rpy), (VELOCITY, s.velocity)):
        known |= zip(names, map(_number, values.tolist()), strict=True)
    for names, sds in ((POSITION, s.position_sd), (ATTITUDE, s.rpy_sd), (VELOCITY, s.velocity_sd)):
        known |= zip([f"{name}_sd" for name in names], map(_number, sds.tolist()), strict=True)
    return known | {
        "cov_north_east": _number(s.cov_north_east),
        "latitude": _number(s.latitude, decimals=9),
        "longitude": _number(s.longitude, decimals=9),
        "distance": _number(s.distance),
        "predicted_s": _number(s.predicted_s),
        "latency_s": _number(s.latency_s),
        "update_s": _number(s.update_s),
        "calibration": {label: [_number(value), _number(sd)] for label, (value, sd) in s.calibration.items()},
        "sensors": {
            name: {"state": h.state, "age": _number(h.age), "used": int(h.used), "rejected": int(h.rejected)}
            for name, h in s.sensors.items()
        },
        "verdict": s.verdict,
        "alarms": [[a.kind, a.sensor, a.severity] for a in s.alarms],
        "events": [event.as_dict() for event in s.events],
    }


def _number(value: float | None, decimals: int | None = None) -> float | None:
    """With ``decimals``, or nine significant digits: lines that fit into fewer packets."""
    if value is None or not math.isfinite(value):
        return None
    return float(f"{value:.9g}") if decimals is None else round(float(value), decimals)
