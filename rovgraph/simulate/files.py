"""A simulated dive as files.

``log.csv`` is the vehicle's recording, with ``log.dvl_beams.csv`` where the configuration says how the DVL's beams
point and ``log.adcp.csv`` where it profiles the water, and ``config.yaml`` the estimator's configuration; ``truth.csv``
and ``truth.json`` are hidden from the estimator; ``summary.json`` lists the options.
"""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.log.companions import CELL_PREFIX, PREFIX
from rovgraph.log.tables import table_beside
from rovgraph.model.config import Config, with_priors_stated
from rovgraph.sensors import SENSORS
from rovgraph.sensors.dvl_beam import BEAMS
from rovgraph.sensors.water_layer import CELLS
from rovgraph.simulate.dive import Dive

TRUTH_RATE = 10.0  # rows per second of truth.csv
DECIMALS = {
    "time": 4,
    "acc": 4,
    "gyr": 5,
    "mag": 4,
    "ahrs": 5,
    "dvl": 4,
    "dvl_heading": 5,
    "depth": 3,
    "fix": 3,
    "thruster": 2,
}


def write_dive(folder: Path, dive: Dive, config: Config, summary: dict[str, Any]) -> None:
    """Write all files of a dive into an existing folder.

    Parameters
    ----------
    folder : Path
    dive : Dive
    config : the configuration that the dive was simulated with; the start that is written
        is the planned one
    summary : entries of ``summary.json`` beside the figures of the dive
    """
    log = dive.log_frame
    for name, prefix in ((BEAMS, PREFIX), (CELLS, CELL_PREFIX)):
        single = [column for column in map(str, log) if column.startswith(prefix)]
        if single:
            beside = log.loc[log[single].notna().any(axis=1), ["time", *single]]
            beside.columns = pd.Index([str(column).removeprefix(prefix) for column in beside])
            beside.round(DECIMALS["time"]).to_csv(table_beside(folder / "log.csv", name), index=False)
            log = log.drop(columns=single)
    write_log(log.dropna(how="all", subset=[name for name in log if name != "time"]), folder / "log.csv")
    step = max(round(1.0 / (TRUTH_RATE * float(np.median(np.diff(dive.truth.time))))), 1)
    dive.truth.every(step).write_csv(folder / "truth.csv")
    (folder / "config.yaml").write_text(known(dive, config).to_yaml(), encoding="utf-8")
    _write_json(folder / "truth.json", secrets(dive))
    _write_json(folder / "summary.json", {**summary, **figures(dive)})


def write_log(log_frame: pd.DataFrame, path: Path) -> None:
    """Write a log as CSV (compressed where the name ends in .gz), rounded below its noise."""
    decimals = {c: DECIMALS.get(c, DECIMALS.get(c.split("_")[0], 6)) for c in log_frame.columns}
    for whole in ("dvl_valid", "place_id"):
        decimals.pop(whole, None)
    log_frame.round(decimals).to_csv(path, index=False)


def known(dive: Dive, config: Config) -> Config:
    """The estimator's configuration, with the planned start, for a log in rovgraph's own columns.

    The simulated magnetometer needs no calibration, and stamps are not late. Compasses err by their priors, from
    which their errors were drawn.
    """
    north, east, _ = dive.truth.p_n[0] - dive.hidden["start_offset"]
    return with_priors_stated(config.as_recorded()).with_values(
        start={"north_m": float(north), "east_m": float(east)},
        environment={} if math.isnan(dive.path.latitude) else {"frame": "earth"},
        columns={},
        units={},
    )


def secrets(dive: Dive) -> dict[str, Any]:
    """Values hidden from an estimator: calibration, biases and the start's error."""
    return {
        "units": "radians and SI; bias: accelerometer x y z, gyro x y z, body axes",
        "calibration": {name: value.tolist() for name, value in dive.hidden["calibration"].items()},
        "bias_first": dive.hidden["bias"][0].tolist(),
        "bias_last": dive.hidden["bias"][-1].tolist(),
        "start_offset_m": dive.hidden["start_offset"].tolist(),
        **{name: np.asarray(value).tolist() for name, value in dive.hidden["world"].items()},
    }


def figures(dive: Dive) -> dict[str, Any]:
    """Length of the dive and number of measurements of each sensor."""
    log = dive.log_frame
    first = {s.name: s.column_names[0] for s in SENSORS.values() if s.columns} | {"thruster": "thruster_1"}
    counts = {sensor: int(log[c].notna().sum()) for sensor, c in first.items() if c in log}
    moved = dive.truth.p_n.max(axis=0) - dive.truth.p_n.min(axis=0)
    return {
        "duration_s": float(dive.truth.time[-1] - dive.truth.time[0]),
        "distance_m": round(dive.truth.distance, 3),
        "extent_m": np.round(moved, 3).tolist(),
        "measurements": counts,
    }


def _write_json(path: Path, content: dict[str, Any]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
