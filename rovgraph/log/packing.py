"""Measurements as a few arrays, for files and between processes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rovgraph.log.streams import Measurement


def pack(measurements: Sequence[Measurement]) -> dict[str, dict[str, Any]]:
    """Arrays of each sensor: place in the sequence, time, row and values."""
    by_sensor: dict[str, list[int]] = {}
    for k, m in enumerate(measurements):
        by_sensor.setdefault(m.sensor, []).append(k)
    return {
        sensor: {
            "place": np.array(places),
            "time": np.array([measurements[k].time for k in places]),
            "row": np.array([measurements[k].row for k in places]),
            "values": np.array([measurements[k].values for k in places]),
        }
        for sensor, places in by_sensor.items()
    }


def unpack(packed: Mapping[str, Mapping[str, Any]]) -> list[Measurement]:
    """The inverse of `pack`."""
    out: list[tuple[int, Measurement]] = []
    for sensor, arrays in packed.items():
        columns = (arrays[name].tolist() for name in ("place", "time", "row"))
        for place, time, row, values in zip(*columns, arrays["values"], strict=True):
            out.append((place, Measurement(time, sensor, values, row)))
    return [m for _, m in sorted(out, key=lambda pair: pair[0])]
