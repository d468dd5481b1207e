"""What of a log goes into a results folder, so that the folder tells the dive without its log."""

import hashlib
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.check.times import timing
from rovgraph.config import Config
from rovgraph.geometry import Array
from rovgraph.log import Log
from rovgraph.log.frozen import FrozenStretch, are_in
from rovgraph.sensors import SENSORS

LIBRARIES = ("numpy", "scipy", "pandas", "numba", "gtsam")
NEAREST_S = 1.0  # an altitude belongs to a ping that is no further away


def versions() -> dict[str, str]:
    """Python and the libraries that results depend on -> version."""
    return {"python": platform.python_version(), **{name: version(name) for name in LIBRARIES}}


def input_file(path: str) -> dict[str, Any] | None:
    """Name, size and checksum of the log's file; None where it is no file, as of a log in memory."""
    if not Path(path).is_file():
        return None
    with Path(path).open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"path": path, "bytes": Path(path).stat().st_size, "sha256": digest}


def timings(log: Log) -> dict[str, dict[str, Any]]:
    """Sensor -> when its measurements came, relative to the first of the log; the keys carry the unit."""
    start = min((float(s.time[0]) for s in log.streams.values() if len(s)), default=0.0)
    found = {}
    for name, stream in log.streams.items():
        if len(stream):
            t = timing(stream)
            found[name] = {
                "rate_hz": t.rate,
                "from_s": t.first - start,
                "to_s": t.last - start,
                "longest_gap_s": t.gap,
                "longest_gap_at_s": t.gap_at - start,
                "jitter_s": t.jitter,
                "repeats": t.repeats,
            }
    return found


def dvl_frame(log: Log, frozen: Sequence[FrozenStretch] = ()) -> pd.DataFrame | None:
    """Rows of dvl.csv, one per ping; None where the log has no DVL.

    Parameters
    ----------
    frozen : measurements that are none: such a ping saw nothing
    """
    if "dvl" not in log:
        return None
    dvl = log["dvl"]
    return pd.DataFrame(
        {
            "time": dvl.time,
            "lock": ((dvl["dvl_valid"] != 0.0) & ~are_in(dvl, frozen)).astype(int),
            "altitude": _altitude(log, dvl.time),
            "figure_of_merit": dvl["dvl_sd"],
            "row": dvl.row,
        }
    )


def _altitude(log: Log, time: Array) -> Array:
    """Altitude at each time, from the nearest measurement [m]; NaN where there is none."""
    if "dvl_altitude" not in log:
        return np.full(len(time), np.nan)
    stream = log["dvl_altitude"]
    after = np.clip(np.searchsorted(stream.time, time), 1, max(len(stream) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stream) - 1)
    nearest = np.where(np.abs(stream.time[before] - time) <= np.abs(stream.time[after] - time), before, after)
    close = np.abs(stream.time[nearest] - time) <= NEAREST_S
    return np.where(close, stream["dvl_altitude"][nearest], np.nan)


def left_out_frame(
    log: Log,
    config: Config,
    residuals: pd.DataFrame,
    stretches: Sequence[Mapping[str, Any]],
    frozen: Sequence[FrozenStretch] = (),
) -> pd.DataFrame:
    """Rows of left_out.csv: measurements that did not count, and why.

    Parameters
    ----------
    log, config : of the dive
    residuals : of the main estimate, where a weight of 0 means rejected
    stretches : times in which a sensor contradicted all others (``sensor``, ``begin``, ``end``)
    frozen : measurements that are none
    """
    parts = [*_refused(log, config, frozen), _rejected(residuals, stretches)]
    whole = pd.concat(parts, ignore_index=True)
    return whole.sort_values("time", kind="stable", ignore_index=True)


def _refused(log: Log, config: Config, frozen: Sequence[FrozenStretch]) -> list[pd.DataFrame]:
    """What is none, and what a sensor's own rules keep out; the first reason that holds counts."""
    parts = []
    for name, stream in log.streams.items():
        if name not in SENSORS or not len(stream):
            continue
        taken = np.zeros(len(stream), bool)
        none = [(stretch.reason, are_in(stream, [stretch])) for stretch in frozen if stretch.sensor == name]
        for reason, bad in [*none, *SENSORS[name].refused(stream.data, config)]:
            new = bad & ~taken
            taken |= bad
            rows = {"time": stream.time[new], "sensor": name, "reason": reason, "row": stream.row[new]}
            parts.append(pd.DataFrame(rows))
    return parts


def _rejected(residuals: pd.DataFrame, stretches: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """What the estimate rejected."""
    rejected = residuals[residuals["weight"] <= 0].drop_duplicates(["sensor", "time", "row"])
    reason = np.full(len(rejected), "beyond its gate", object)
    time, sensor = rejected["time"].to_numpy(float), rejected["sensor"].to_numpy(object)
    for s in stretches:
        inside = (sensor == s["sensor"]) & (time >= s["begin"]) & (time <= s["end"])
        reason[inside] = "in a stretch that contradicts all other sensors"
    return rejected[["time", "sensor", "row"]].assign(reason=reason)[["time", "sensor", "reason", "row"]]
