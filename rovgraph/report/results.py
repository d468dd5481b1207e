"""The files of a results folder other than the figures; docs/results.md describes them.

Files for programs (trajectories, residuals, history) keep the units of the program, with a column ``unit`` where rows
differ; files for a person (calibration, summary) are in degrees, and state it. The folder includes the part of the log
that its page needs.
"""

import hashlib
import json
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from rovgraph.diagnosis.alarm import Alarm, verdict_of
from rovgraph.diagnosis.check.clocks import timing
from rovgraph.geometry import Array
from rovgraph.inference.bottom import bottom_of
from rovgraph.inference.estimate import REPLY_COLUMNS, RESIDUAL_COLUMNS, CalibrationEstimate, Estimate, History
from rovgraph.inference.trajectory import TUM, Trajectory
from rovgraph.log import Log
from rovgraph.log.companions import columns_beside
from rovgraph.log.csv_writer import write_csv
from rovgraph.log.frozen import FrozenStretch, are_in
from rovgraph.log.units import shown
from rovgraph.model.config import Config
from rovgraph.model.grids import PLACE_DECIMALS, place_columns
from rovgraph.report.folder import ACOUSTICS_FILE, CURRENT_FILE, SOUNDINGS_FILE, STAMP, SUMMARY
from rovgraph.report.units import key_suffix
from rovgraph.sensors import SENSORS
from rovgraph.sensors.dvl_beam import BEAMS, error_velocity

LIBRARIES = ("numpy", "scipy", "pandas", "numba", "gtsam")
NEAREST_S = 1.0  # longest time between an altitude and its ping


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
    frozen : invalid measurements: such a ping saw no bottom
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
    """Altitude at each time, from the nearest measurement [m]; NaN without one near."""
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
    frozen : invalid measurements
    """
    parts = [*_refused(log, config, frozen), _rejected(residuals, stretches)]
    whole = pd.concat(parts, ignore_index=True)
    return whole.sort_values("time", kind="stable", ignore_index=True)


def _refused(log: Log, config: Config, frozen: Sequence[FrozenStretch]) -> list[pd.DataFrame]:
    """Invalid measurements, and those that a sensor's own rules keep out; the first reason that holds counts."""
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


CHI2_99 = 9.21  # of two degrees of freedom, so sqrt(9.21) semi-axes hold 99 %
BEAMS_FILE = f"{BEAMS}.csv"
_ORDER = ("smoothed", "filtered", "dead_reckoning")


def main_first(estimates: Sequence[Estimate]) -> list[Estimate]:
    """Smoothed, filtered, dead reckoning, others; the first is what figures are about."""
    if not estimates:
        raise ValueError("no estimates to report")
    return sorted(estimates, key=lambda e: _ORDER.index(e.kind) if e.kind in _ORDER else len(_ORDER))


class Remarks(NamedTuple):
    """Remarks on a dive beside its estimates.

    Attributes
    ----------
    assumptions : what was taken for granted, a sentence each
    alarms : of the estimates, and advice
    warnings : on the log, a line each
    """

    assumptions: Sequence[str] = ()
    alarms: Sequence[Alarm] = ()
    warnings: Sequence[str] = ()


def write_results(
    folder: Path,
    estimates: Sequence[Estimate],
    log: Log,
    config: Config,
    seconds: dict[str, float],
    remarks: Remarks,
    frozen: Sequence[FrozenStretch] = (),
) -> dict[str, Any]:
    """Write every file of a results folder but the figures and the page.

    Parameters
    ----------
    folder : an existing folder, such as `results_folder` yields
    estimates : of one log; the smoothed one leads where there is one
    log, config : what they were made from
    seconds : stage of the work -> wall time [s]
    remarks : on the dive beside them
    frozen : invalid measurements

    Returns
    -------
    dict : what summary.json holds
    """
    estimates = main_first(estimates)
    for estimate in estimates:
        bottom = bottom_of(log, config, estimate)
        under = None if bottom is None else bottom.under(estimate.trajectory)
        path = folder / f"trajectory_{estimate.kind}.csv"
        estimate.trajectory.write_csv(path, origin=log.origin, also=under, grid=config.environment.grid)
        estimate.trajectory.write_tum(folder / f"trajectory_{estimate.kind}{TUM}")
    write_csv(calibration_frame(estimates), folder / "calibration.csv")
    write_csv(estimates[0].residuals[RESIDUAL_COLUMNS], folder / "residuals.csv", decimals={"time": 4})
    if len(estimates[0].replies):
        write_csv(estimates[0].replies[REPLY_COLUMNS], folder / ACOUSTICS_FILE, decimals={"time": 4})
    if len(estimates[0].current):
        write_csv(estimates[0].current, folder / CURRENT_FILE, decimals={"time": 4})
    write_csv(_history_frame(estimates), folder / "history.csv", decimals={"time": 4})
    _write_of_log(folder, estimates[0], log, config, frozen)
    (folder / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")
    summary = {
        **summarise(estimates, log, config, [*remarks.assumptions], seconds, remarks.alarms),
        "warnings": [*remarks.warnings],
        "input": input_file(log.source),
        "versions": versions(),
    }
    (folder / SUMMARY).write_text(
        json.dumps(summary, indent=2, allow_nan=False, ensure_ascii=False) + "\n", encoding="utf-8"
    )
    return summary


def _write_of_log(folder: Path, main: Estimate, log: Log, config: Config, frozen: Sequence[FrozenStretch]) -> None:
    """Write left_out.csv, and of a DVL dvl.csv, dvl_beams.csv and soundings.csv, as far as each is known."""
    pings = dvl_frame(log, frozen)
    if pings is not None:
        write_csv(pings, folder / "dvl.csv", decimals={"time": 4})
    if BEAMS in log:
        error = error_velocity(log[BEAMS].data, config.dvl)
        frame = pd.DataFrame(columns_beside(log[BEAMS]))
        frame = frame if np.isnan(error).all() else frame.assign(error_velocity=error)
        write_csv(frame, folder / BEAMS_FILE, decimals={"time": 4})
    bottom = bottom_of(log, config, main)
    if bottom is not None:
        found = bottom.soundings
        north, east = (found[name].to_numpy(float) for name in ("north", "east"))
        found = found.assign(**place_columns(north, east, log.origin, config.environment.grid))
        write_csv(found, folder / SOUNDINGS_FILE, decimals={"time": 4, **PLACE_DECIMALS})
    left_out = left_out_frame(log, config, main.residuals, main.summary.get("stretches_taken_out", []), frozen)
    write_csv(left_out, folder / "left_out.csv", decimals={"time": 4})


def summarise(
    estimates: Sequence[Estimate],
    log: Log,
    config: Config,
    assumptions: list[str],
    seconds: Mapping[str, float],
    alarms: Sequence[Alarm] = (),
) -> dict[str, Any]:
    """Content of summary.json: plain values, units in the key names, null for unknown."""
    estimates = main_first(estimates)
    main = estimates[0]
    summary = {
        **STAMP,
        "name": config.name,
        "log": log.source,
        "verdict": verdict_of(alarms),
        **{name: [_alarm_numbers(a, main.trajectory.time[0]) for a in some] for name, some in _parted(alarms).items()},
        "frame": config.environment.frame,
        "origin": None if log.origin is None else {"lat_deg": log.origin[0], "lon_deg": log.origin[1]},
        "start_time_s": main.trajectory.time[0],
        "main_estimate": main.kind,
        **_trajectory_numbers(main.trajectory),
        "sensors": _sensors(main, log),
        "calibration": {c.label: _calibration_numbers(c) for c in main.calibration},
        "assumptions": list(assumptions),
        "seconds": dict(seconds),
        "estimates": {
            e.kind: {**e.summary, **_trajectory_numbers(e.trajectory), "sensors": sensor_counts(e.residuals)}
            for e in estimates
        },
    }
    plain: dict[str, Any] = to_plain(summary)
    return plain


def to_plain(value: Any) -> Any:
    """Only types of JSON: NumPy becomes Python, keys become text, NaN and infinity None.

    Raises
    ------
    TypeError : an object of another kind; it is not printed, it might be a whole graph
    """
    if isinstance(value, Mapping):
        return {str(k): to_plain(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return to_plain(value.tolist())
    if isinstance(value, list | tuple | set):
        return [to_plain(v) for v in value]
    if value is None or isinstance(value, str):
        return value
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    raise TypeError(f"a summary cannot hold a {type(value).__name__}")


def ellipse_axes(covariance: Array) -> tuple[Array, Array, Array]:
    """99 % ellipses of north and east.

    Parameters
    ----------
    covariance : ndarray, shape (n, 3, 3) or (n, 2, 2), north and east first [m^2]

    Returns
    -------
    major, minor : ndarray, shape (n,), semi-axes [m]
    bearing : ndarray, shape (n,), of the major axis, clockwise from north [rad]
    """
    values, vectors = np.linalg.eigh(covariance[:, :2, :2])
    axes = np.sqrt(CHI2_99 * np.clip(values, 0.0, None))
    return axes[:, 1], axes[:, 0], np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])


def calibration_frame(estimates: Sequence[Estimate]) -> pd.DataFrame:
    """Rows of calibration.csv: one per estimate and scalar component, angles in degrees."""
    columns = [
        "estimate", "label", "unit", "estimated", "value", "sd", "prior_mean", "prior_sd",
        "moved", "moved_in_prior_sd", "narrowing", "verdict", "about",
    ]  # fmt: skip
    rows = []
    for estimate in estimates:
        for c in estimate.calibration:
            factor, unit = shown(c.unit)
            value, sd, mean, prior_sd = (factor * x for x in (c.value, c.sd, c.prior_mean, c.prior_sd))
            moved = value - mean
            believed = prior_sd if prior_sd > 0 else np.nan
            relative = (moved / believed, narrowing(c))
            row = (estimate.kind, c.label, unit, c.estimated, value, sd, mean, prior_sd, moved, *relative)
            rows.append((*row, c.verdict, c.about))
    return pd.DataFrame(rows, columns=pd.Index(columns))


def narrowing(entry: CalibrationEstimate) -> float:
    """sd after the dive over sd before; NaN where held."""
    return entry.sd / entry.prior_sd if entry.estimated and entry.prior_sd > 0 else float("nan")


def history_labels(variable: str, history: History) -> list[str]:
    """Names of a history's components that stand alone, such as ``gyr_bias_x``."""
    if len(history.labels) == 1:
        return [history.labels[0] or variable]
    return [s if s.startswith(variable) else f"{variable}_{s.lstrip('_')}" for s in history.labels]


def sensor_counts(residuals: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Per sensor: measurements used, weighted down and rejected, and how they fitted.

    A measurement counts as rejected when any of its components has weight 0. The mean
    square is that of the normalised innovations of the others; about 1 where the
    believed noise is true.
    """
    counts: dict[str, dict[str, Any]] = {}
    for sensor, rows in residuals.groupby("sensor", sort=False):
        weight = rows.groupby(["time", "row"], dropna=False)["weight"].transform("min")
        share = weight[~rows.duplicated(["time", "row"])]
        fitted = rows.loc[weight > 0, "normalised"].to_numpy(float)
        fitted = fitted[np.isfinite(fitted)]
        counts[str(sensor)] = {
            "used": int((share > 0).sum()),
            "weighted_down": int(((share > 0) & (share < 1)).sum()),
            "rejected": int((share <= 0).sum()),
            "mean_square_normalised": float(np.mean(fitted**2)) if len(fitted) else float("nan"),
        }
    return counts


def _sensors(estimate: Estimate, log: Log) -> dict[str, dict[str, Any]]:
    """Counts of every sensor of the log, those the estimate left aside too."""
    counts = sensor_counts(estimate.residuals)
    came = timings(log)
    recorded = {name: {"recorded": len(stream), **came.get(name, {})} for name, stream in log.streams.items()}
    return {name: {**recorded.get(name, {}), **counts.get(name, {})} for name in {**recorded, **counts}}


def _trajectory_numbers(track: Trajectory) -> dict[str, Any]:
    """Duration, distance and where it ended."""
    major, minor, bearing = _end_ellipse(track)
    rpy, rpy_sd = np.rad2deg(track.rpy[-1]), np.rad2deg(track.rpy_sd[-1])
    end: dict[str, Any] = {}
    for i, name in enumerate(("north", "east", "down")):
        end[f"{name}_m"], end[f"{name}_sd_m"] = track.p_n[-1, i], track.p_sd[-1, i]
    end["heading_deg"], end["heading_sd_deg"] = rpy[2] % 360.0, rpy_sd[2]
    end |= {"ellipse99_major_m": major, "ellipse99_minor_m": minor, "ellipse99_bearing_deg": bearing}
    return {
        "duration_s": track.time[-1] - track.time[0],
        "distance_m": track.distance,
        "keyframes": len(track),
        "end": end,
    }


def _end_ellipse(track: Trajectory) -> tuple[float, float, float]:
    if not np.isfinite(track.cov_p[-1, :2, :2]).all():
        return float("nan"), float("nan"), float("nan")
    major, minor, bearing = ellipse_axes(track.cov_p[-1:])
    return float(major[0]), float(minor[0]), float(np.rad2deg(bearing[0])) % 180.0


def _parted(alarms: Sequence[Alarm]) -> dict[str, list[Alarm]]:
    """Evidence of error, and advice."""
    return {
        "alarms": [alarm for alarm in alarms if alarm.severity != "advice"],
        "advice": [alarm for alarm in alarms if alarm.severity == "advice"],
    }


def _alarm_numbers(alarm: Alarm, start: float) -> dict[str, Any]:
    """An alarm as summary.json holds it; times are seconds since the dive began."""
    return {
        "kind": alarm.kind,
        "sensor": alarm.sensor,
        "severity": alarm.severity,
        "from_s": alarm.begin - start,
        "to_s": alarm.end - start,
        "figure": alarm.figure,
        "limit": alarm.limit,
        "text": alarm.text,
    }


def _calibration_numbers(entry: CalibrationEstimate) -> dict[str, Any]:
    factor, unit = shown(entry.unit)
    tail = key_suffix(unit)
    numbers = {name + tail: factor * getattr(entry, name) for name in ("value", "sd", "prior_mean", "prior_sd")}
    return {
        "estimated": entry.estimated,
        **numbers,
        "narrowing": narrowing(entry),
        "verdict": entry.verdict or None,
        "about": entry.about,
    }


def _history_frame(estimates: Sequence[Estimate]) -> pd.DataFrame:
    """Rows of history.csv: one per estimate, epoch and scalar component."""
    frames = []
    for estimate in estimates:
        for variable, history in estimate.history.items():
            for i, label in enumerate(history_labels(variable, history)):
                columns = {
                    "time": history.time,
                    "variable": label,
                    "value": history.value[:, i],
                    "sd": history.sd[:, i],
                }
                frames.append(pd.DataFrame({"estimate": estimate.kind, **columns, "unit": history.unit}))
    if not frames:
        return pd.DataFrame(columns=pd.Index(["estimate", "time", "variable", "value", "sd", "unit"]))
    return pd.concat(frames, ignore_index=True)
