"""Any set of estimators on any set of dives: what ``rovgraph compare`` does."""

import math
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from rovgraph.config import Config
from rovgraph.errors import InputError, in_one_line
from rovgraph.studies.aggregate import aggregate
from rovgraph.studies.estimator_chains import EstimatorSpec, Outcome, Task, outcomes_of_dives
from rovgraph.studies.estimators import select
from rovgraph.studies.measures import measures, misalignment_history, velocity_history
from rovgraph.studies.runs import Case, Run
from rovgraph.workers import cores, in_workers

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
    on a run has a row that says why.

    Parameters
    ----------
    runs : the dives
    estimators : names of `rovgraph.studies.estimators.ESTIMATORS`, all by default
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
        dives = [Task(case.log, case.config) for case in cases]
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
