"""Any set of estimators on any set of dives: the work of ``rovgraph compare``.

`measures` makes a row of runs.csv from one estimate and a reference: position errors and their consistency are those of
`rovgraph.lab.evaluate`, at the reference's epochs; docs/compare.md describes the columns. `aggregate` makes a row per
estimator of these rows. The mean NEES of N independent runs at their ends, 2 components each, is chi-square with 2 N
degrees of freedom over N for covariances that are right (Bar-Shalom et al. 2001, 5.4.2). Along a track errors are
correlated, so the mean there has no such band.
"""

import math
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import gammaincinv

from rovgraph.errors import InputError, in_one_line
from rovgraph.geometry import Array, wrap_angle
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.estimators import ChainTask, EstimatorSpec, Outcome, outcomes_of_dives, select
from rovgraph.lab.evaluate import WITHIN_ELLIPSE, evaluate, normalised_error
from rovgraph.lab.executors import cores, in_workers
from rovgraph.lab.runs import Case, Run
from rovgraph.model import thesis
from rovgraph.model.config import Config

BAND = 0.95


def aggregate(runs: pd.DataFrame, estimators: Sequence[EstimatorSpec]) -> pd.DataFrame:
    """One row per estimator, in the order given; numbers are over the runs that did not fail.

    Parameters
    ----------
    runs : a row per run and estimator, columns of runs.csv
    estimators : those compared
    """
    rows = [_summary(named, runs[runs["estimator"] == named.name]) for named in estimators]
    return pd.DataFrame(rows)


def _summary(named: EstimatorSpec, runs: pd.DataFrame) -> dict[str, Any]:
    good = runs[runs["error"].isna()]
    return {
        "estimator": named.name,
        "family": named.family,
        "about": named.about,
        "headings": named.headings,
        "misalignment_estimated": named.misalignment,
        "runs": len(runs),
        "failed": (len(runs) - len(good)) / len(runs),
        "end_mean_m": good["end_m"].mean(),
        "end_sd_m": good["end_m"].std(),
        "rms_m": _rms(good["rms_m"]),
        "max_m": good["max_m"].max(),
        "heading_rms_deg": _rms(good["heading_rms_deg"]),
        "velocity_rms_mps": _rms(good["velocity_rms_mps"]),
        "nees_mean": good["nees"].mean(),
        **_consistency(good["nees_end"].dropna()),
        "inside_end": good["inside_end"].astype(float).mean(),
        "inside_track": good["inside_track"].mean(),
        **_misalignment_summary(good),
        **{name: good[name].mean() for name in map(str, good) if name.startswith(("nis_", "fit_"))},
        "cpu_per_s": good["cpu_per_s"].mean(),
        "thesis_end_mean_m": thesis.MEAN_END_ERROR_M.get(named.name, np.nan),
    }


def _rms(values: pd.Series) -> float:
    """Root of the mean of the squares, NaN without any."""
    return float(np.sqrt(values.pow(2).mean()))


def nees_band(runs: int) -> tuple[float, float]:
    """The 95 % band of the mean NEES of two components, over independent runs."""
    low, high = (2.0 * float(gammaincinv(runs, p)) / runs for p in ((1.0 - BAND) / 2.0, (1.0 + BAND) / 2.0))
    return low, high


def _consistency(nees: pd.Series) -> dict[str, Any]:
    """Mean NEES at the end, its band, and where it lies."""
    if not len(nees):
        return {"nees_end_mean": np.nan, "nees_end_low": np.nan, "nees_end_high": np.nan, "nees_end_band": ""}
    mean, (low, high) = float(nees.mean()), nees_band(len(nees))
    place = "below" if mean < low else "above" if mean > high else "within"
    return {"nees_end_mean": mean, "nees_end_low": low, "nees_end_high": high, "nees_end_band": place}


def _misalignment_summary(good: pd.DataFrame) -> dict[str, float]:
    if "misalignment_deg" not in good:
        return {}
    error = good["misalignment_deg"] - good["misalignment_true_deg"]
    return {
        "misalignment_mean_deg": good["misalignment_deg"].mean(),
        "misalignment_sd_deg": _rms(good["misalignment_sd_deg"]),
        "misalignment_error_mean_deg": error.mean(),
        "misalignment_error_rms_deg": _rms(error),
    }


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
    error = (track.clamped(time).v_n - reference.clamped(time).v_n)[:, :2]
    known = error[np.isfinite(error).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else None


def _end(track: Trajectory, reference: Trajectory) -> dict[str, float | bool | None]:
    """Error and covariance at the last common epoch."""
    time = _common(track, reference)[-1:]
    estimate = track.clamped(time)
    error = (estimate.p_n - reference.clamped(time).p_n)[:, :2]
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


Progress = Callable[[float], None]
SIDE_BY_SIDE = 8  # runs of a task: more of them gain little, and a worker holds them all
TASKS_EACH = 2  # of a process at least, so that all end at about the same time
REFERENCE = "reference"  # in the place of an estimator's name

# columns that every row has, in the order of the file; others follow as far as any row has them
RUN_COLUMNS = [
    "run", "estimator", "error", "duration_s", "epochs", "coverage", "distance_m", "end_m", "end_north_m",
    "end_east_m", "end_cov_north_m2", "end_cov_east_m2", "end_cov_north_east_m2", "rms_m", "max_m",
    "heading_rms_deg", "velocity_rms_mps", "nees", "nees_end", "inside_track", "inside_end", "cpu_per_s",
]  # fmt: skip


@dataclass(frozen=True)
class Comparison:
    """Tables of a comparison; docs/compare.md describes their columns.

    Attributes
    ----------
    table : a row per estimator
    runs : a row per run and estimator
    misalignment : a row per run, estimator and epoch: run, estimator, time [s], value_deg,
        sd_deg, true_deg
    velocity : velocities of the first run, a row per estimator and epoch: estimator, time [s], v_north,
        v_east [m/s]; the reference is among the estimators
    config : the configuration of the estimators on the first run
    """

    table: pd.DataFrame
    runs: pd.DataFrame
    misalignment: pd.DataFrame
    velocity: pd.DataFrame
    config: Config


@dataclass(frozen=True)
class _Task:
    """Some estimators on some runs; ``first``: their first is that of all runs, whose velocity is kept."""

    runs: tuple[Run, ...]
    names: tuple[str, ...]
    first: bool


@dataclass(frozen=True)
class _Result:
    """Rows and histories of one task, and the configuration of its first run."""

    config: Config
    rows: list[dict[str, Any]]
    misalignment: list[pd.DataFrame]
    velocity: list[pd.DataFrame]


def compare(
    runs: Sequence[Run],
    estimators: Sequence[str] | None = None,
    jobs: int | None = None,
    progress: Progress = lambda done: None,
) -> Comparison:
    """Run estimators on dives, in parallel, and measure them.

    The result does not depend on ``jobs``, the time it took aside. An estimator that fails
    on a run has a row with the reason.

    Parameters
    ----------
    runs : the dives
    estimators : names of `rovgraph.lab.estimators.ESTIMATORS`, all by default
    jobs : processes, by default one per core
    progress : called with the share that is done

    Raises
    ------
    InputError : no runs, an unknown estimator, less than one job; a dive that cannot be made
    """
    named = select(estimators)
    jobs = cores() if jobs is None else jobs
    if not runs:
        raise InputError("nothing to compare on: no log and no seeds")
    if jobs < 1:
        raise InputError(f"{jobs} jobs: at least 1 is expected")
    groups = [tuple(n.name for n in named)] if len(runs) >= jobs else _sharing(named)
    size = min(math.ceil(len(runs) / (TASKS_EACH * jobs)), SIDE_BY_SIDE)
    tasks = [_Task(tuple(runs[k : k + size]), group, k == 0) for k in range(0, len(runs), size) for group in groups]
    results = in_workers(_work, tasks, jobs, progress)
    by_run = {run.name: i for i, run in enumerate(runs)}
    by_name = {n.name: i for i, n in enumerate(named)} | {REFERENCE: -1}

    def stacked(frames: list[pd.DataFrame], keys: list[str]) -> pd.DataFrame:
        """In the order of runs and estimators, whichever task they came from."""
        if not frames:
            return pd.DataFrame()
        order = {"run": by_run, "estimator": by_name}
        whole = pd.concat(frames, ignore_index=True)
        return whole.sort_values(keys, key=lambda c: c.map(order[str(c.name)]), kind="stable", ignore_index=True)

    rows = stacked([pd.DataFrame(r.rows) for r in results], ["run", "estimator"])
    rows = rows.reindex(columns=[*RUN_COLUMNS, *sorted(set(map(str, rows)) - set(RUN_COLUMNS))])
    velocity = stacked([f for r in results for f in r.velocity], ["estimator"]).drop_duplicates(ignore_index=True)
    misalignment = stacked([f for r in results for f in r.misalignment], ["run", "estimator"])
    return Comparison(aggregate(rows, named), rows, misalignment, velocity, results[0].config)


def _sharing(estimators: Sequence[EstimatorSpec]) -> list[tuple[str, ...]]:
    """Names grouped by what they share, so that it is made once."""
    groups: dict[Hashable, list[str]] = {}
    for n in estimators:
        groups.setdefault(n.sharing_key, []).append(n.name)
    return [tuple(names) for names in groups.values()]


def _work(task: _Task) -> _Result:
    """In a worker: load the dives, run the estimators, measure them."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of one estimator of many; what matters is in its row
        cases = [run.load() for run in task.runs]
        dives = [ChainTask(case.log, case.config) for case in cases]
        result = _Result(cases[0].config, [], [], [])
        for group in _sharing(select(task.names)):  # what one made is forgotten before the next
            for k, outcome in outcomes_of_dives(select(group), dives):
                result.rows.append(_row(task.runs[k].name, outcome, cases[k]))
                if result.rows[-1]["error"] is None:
                    _keep_histories(result, outcome, cases[k], task.first and k == 0)
    if task.first:
        track = velocity_history(cases[0].reference, cases[0].reference.time[0])
        result.velocity.append(track.assign(estimator=REFERENCE))
    return result


def _row(run: str, outcome: Outcome, case: Case) -> dict[str, Any]:
    """A row of runs.csv."""
    duration = float(case.reference.time[-1] - case.reference.time[0])
    row = {"run": run, "estimator": outcome.named.name, "error": None, "duration_s": duration}
    try:
        if outcome.error is not None:
            return {**row, "error": in_one_line(outcome.error)}
        assert outcome.estimate is not None
        numbers = measures(outcome.estimate, case, outcome.named)
        return {**row, **numbers, "cpu_per_s": outcome.seconds / _recorded_s(case)}
    except Exception as error:
        return {**row, "error": in_one_line(error)}


def _recorded_s(case: Case) -> float:
    streams = case.log.streams.values()
    return float(max(stream.time[-1] for stream in streams) - min(stream.time[0] for stream in streams))


def _keep_histories(result: _Result, outcome: Outcome, case: Case, first: bool) -> None:
    assert outcome.estimate is not None
    name, row = outcome.named.name, result.rows[-1]
    history = misalignment_history(outcome.estimate, case)
    if history is not None:
        true = row.get("misalignment_true_deg")
        result.misalignment.append(history.assign(run=row["run"], estimator=name, true_deg=true))
    if first:
        track = outcome.estimate.trajectory
        result.velocity.append(velocity_history(track, case.reference.time[0]).assign(estimator=name))
