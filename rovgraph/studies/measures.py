"""The measures of one estimate against a reference: a row of runs.csv.

Position errors and their consistency are those of `rovgraph.evaluate`, at the reference's
epochs; docs/compare.md says what each column means.
"""

from typing import Any

import numpy as np
import pandas as pd

from rovgraph.config import Config
from rovgraph.estimators.estimate import Estimate
from rovgraph.evaluate import WITHIN_ELLIPSE, evaluate, normalised_error
from rovgraph.geometry import Array, wrap_angle
from rovgraph.studies.estimator_chains import EstimatorSpec
from rovgraph.studies.runs import Case
from rovgraph.trajectory import Trajectory

MOST_EPOCHS = 1000  # of a history that is kept for figures

NUMBERS = (
    "epochs", "coverage", "distance_m", "end_m", "rms_m", "max_m", "heading_rms_deg", "nees",
)  # fmt: skip


def measures(estimate: Estimate, case: Case, named: EstimatorSpec) -> dict[str, Any]:
    """Every number of one estimate on one run, by the names of runs.csv's columns.

    Parameters
    ----------
    estimate, case, named : what was estimated, on what, by what

    Raises
    ------
    InputError : fewer than two epochs of the reference lie within the estimate
    FloatingPointError : the estimate is not finite
    """
    track = estimate.trajectory
    if not (np.isfinite(track.p_n).all() and np.isfinite(track.v_n).all()):
        raise FloatingPointError("diverged: the trajectory is not finite")
    metrics = evaluate(track, case.reference).as_dict()
    return {
        **{name: metrics[name] for name in NUMBERS},
        "inside_track": metrics["inside_ellipse"],
        "velocity_rms_mps": _velocity_rms(track, case.reference),
        **_end(track, case.reference),
        **_misalignment(estimate, case),
        **_fit(estimate, named),
    }


def _common(track: Trajectory, reference: Trajectory) -> Array:
    """Epochs of the reference within the track, as `evaluate` takes them."""
    inside = (reference.time >= track.time[0]) & (reference.time <= track.time[-1])
    return np.asarray(reference.time[inside])


def _velocity_rms(track: Trajectory, reference: Trajectory) -> float | None:
    """Horizontal, where the reference has a velocity [m/s]."""
    time = _common(track, reference)
    error = (track.at(time).v_n - reference.at(time).v_n)[:, :2]
    known = error[np.isfinite(error).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else None


def _end(track: Trajectory, reference: Trajectory) -> dict[str, float | bool | None]:
    """Error and covariance at the last common epoch."""
    time = _common(track, reference)[-1:]
    estimate = track.at(time)
    error = (estimate.p_n - reference.at(time).p_n)[:, :2]
    covariance = estimate.cov_p[:, :2, :2]
    nees = float(normalised_error(error, covariance)[0])
    return {
        "end_north_m": float(error[0, 0]),
        "end_east_m": float(error[0, 1]),
        "end_cov_north_m2": float(covariance[0, 0, 0]),
        "end_cov_east_m2": float(covariance[0, 1, 1]),
        "end_cov_north_east_m2": float(covariance[0, 0, 1]),
        "nees_end": nees,
        "inside_end": bool(nees <= WITHIN_ELLIPSE) if np.isfinite(nees) else None,
    }


def _misalignment(estimate: Estimate, case: Case) -> dict[str, float]:
    """Yaw of the DVL beyond its mounting at the end, where it is estimated [deg]."""
    entry = next((c for c in estimate.calibration if c.label == "dvl_yaw" and c.estimated), None)
    if entry is None:
        return {}
    true = np.rad2deg(wrap_angle(case.true_yaw - _mount_yaw(case.config)))
    return {
        "misalignment_deg": float(np.rad2deg(wrap_angle(entry.value - _mount_yaw(case.config)))),
        "misalignment_sd_deg": float(np.rad2deg(entry.sd)),
        "misalignment_true_deg": float(true),
    }


def _mount_yaw(config: Config) -> float:
    return float(np.deg2rad(config.dvl.mount_rpy_deg[2]))


def _fit(estimate: Estimate, named: EstimatorSpec) -> dict[str, float]:
    """Per sensor the mean NIS over its dimension, or where that is not known, the mean square of the residuals.

    What was rejected is left out.
    """
    stated = {} if named.smoothing else estimate.summary.get("nis", {})
    if stated:
        return {f"nis_{sensor}": nis["mean"] / nis["dim"] for sensor, nis in stated.items() if nis["count"]}
    prefix = "nis" if named.whitened else "fit"
    rows = estimate.residuals[estimate.residuals["weight"] > 0]
    square = rows["normalised"].astype(float).pow(2).groupby(rows["sensor"]).mean()
    return {f"{prefix}_{sensor}": float(value) for sensor, value in square.items()}


def misalignment_history(estimate: Estimate, case: Case) -> pd.DataFrame | None:
    """Yaw of the DVL beyond its mounting against time, None where it is not estimated.

    Returns
    -------
    DataFrame : time [s] since the start, value_deg, sd_deg
    """
    history = estimate.history.get("dvl_yaw")
    if history is None:
        return None
    some = thinned(len(history.time))
    value = wrap_angle(history.value[some, 0] - _mount_yaw(case.config))
    columns = {"time": history.time[some] - case.reference.time[0], "value_deg": np.rad2deg(value)}
    return pd.DataFrame({**columns, "sd_deg": np.rad2deg(history.sd[some, 0])})


def velocity_history(track: Trajectory, start: float) -> pd.DataFrame:
    """Velocity over ground against time.

    Returns
    -------
    DataFrame : time [s] since ``start``, v_north, v_east [m/s]
    """
    some = thinned(len(track))
    columns = {"time": track.time[some] - start, "v_north": track.v_n[some, 0], "v_east": track.v_n[some, 1]}
    return pd.DataFrame(columns)


def thinned(n: int) -> Array:
    """At most `MOST_EPOCHS` indices spread over n, both ends kept."""
    return np.unique(np.linspace(0, n - 1, min(n, MOST_EPOCHS)).round().astype(np.int64))
