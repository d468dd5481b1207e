"""Estimators against each other: what ``rovgraph compare`` does."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from rovgraph.api.logs import given, prepared
from rovgraph.config import Config
from rovgraph.errors import InputError, as_path, kind_of
from rovgraph.evaluate import read_reference
from rovgraph.log import Log
from rovgraph.progress import Progress, no_progress
from rovgraph.simulate.named import require_known
from rovgraph.studies import compare as comparisons
from rovgraph.studies.choices import listed
from rovgraph.studies.compare import Comparison
from rovgraph.studies.estimators import select
from rovgraph.studies.runs import Case, Recorded, Run, Simulated
from rovgraph.trajectory import Trajectory

SEEDS = range(1, 31)
THESIS = "vattern"  # the scenario of the thesis, whose numbers are shown beside ours


@dataclass(frozen=True)
class ComparisonResult:
    """Errors, consistency and cost of each estimator.

    Attributes
    ----------
    comparison : all tables; docs/compare.md describes their columns
    title : log or scenario
    thesis : whether the thesis has numbers for it
    about : its inputs, for ``summary.json``
    """

    comparison: Comparison
    title: str
    thesis: bool
    about: dict[str, Any]

    @property
    def table(self) -> pd.DataFrame:
        """A row per estimator."""
        return self.comparison.table

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the folder of ``rovgraph compare`` (docs/compare.md), complete or not at all.

        Raises
        ------
        InputError : the folder exists and ``force`` is not given, or cannot be written
        """
        from rovgraph.pages.reporting import write_page
        from rovgraph.report.comparison import write_comparison
        from rovgraph.report.figure_compare import draw_comparison
        from rovgraph.report.folder import results_folder

        with results_folder(as_path(path, "path"), force) as folder:
            draw_comparison(folder, self.comparison, self.title, self.thesis)
            write_comparison(folder, self.comparison, self.about)
            write_page(folder)


def compare(
    log: Log | None = None,
    config: Config | None = None,
    reference: Trajectory | Path | str | None = None,
    scenario: str | None = None,
    seeds: Sequence[int] = SEEDS,
    duration: float | None = None,
    estimators: str | Sequence[str] | None = None,
    jobs: int | None = None,
    progress: Progress = no_progress,
) -> ComparisonResult:
    """Run estimators on a log with its reference, or on many simulated dives.

    Parameters
    ----------
    log : as read with the configuration
    config : of vehicle and sensors; None = all defaults, or the scenario's
    reference : the track that the log's estimates are compared with, or its file
    scenario : simulate dives of this one instead of a log
    seeds : of the simulated dives
    duration : of a simulated dive [s]; None = the scenario's
    estimators : names or patterns, such as "graph-*", a list or separated by commas; None = all that need no thrusters
    jobs : processes; None = one per core
    progress : called at times with the current task and its progress from 0 to 1

    Raises
    ------
    InputError : neither or both of log and scenario, an unknown estimator, a log that cannot be used

    Warns
    -----
    DataWarning : findings of the check
    """
    names = None if estimators is None else listed(estimators)
    select(names)
    require_one(log, reference, scenario, seeds, duration)
    runs: list[Run]
    about: dict[str, Any]
    if scenario is not None:
        require_known(scenario)
        runs = [Simulated(scenario, seed, config, duration) for seed in seeds]
        about = {"scenario": scenario, "seeds": [*seeds], "duration_s": duration}
        title = f"{scenario}, {len(seeds)} seeds"
    else:
        assert log is not None
        assert reference is not None
        config, title, about = given(log, config), Path(log.source).name, {"log": log.source}
        if isinstance(reference, Path | str):
            about["reference"] = str(reference)
            reference = read_reference(reference)
        if not isinstance(reference, Trajectory):
            raise InputError(f"reference: expected a path or a Trajectory, found {kind_of(reference)}")
        runs = [Recorded(title, Case(prepared(log, config)[0], config, reference))]
    began = time.perf_counter()
    comparison = comparisons.compare(runs, names, jobs, lambda done: progress("comparing", done))
    about["seconds"] = time.perf_counter() - began
    return ComparisonResult(comparison, title, scenario == THESIS, about)


def require_one(
    log: object, reference: object, scenario: str | None, seeds: Sequence[int], duration: float | None
) -> None:
    """Either a log with its reference, or a scenario.

    Raises
    ------
    InputError : anything else
    """
    if (log is None) == (scenario is None):
        raise InputError("compare wants either a log with its reference, or a scenario to simulate")
    if scenario is not None:
        if reference is not None:
            raise InputError("a reference goes with a log; a simulated dive has its own")
        if not (isinstance(seeds, Sequence) and len(seeds)):
            raise InputError(f"seeds: expected a list or range of at least one, found {seeds!r}")
        return
    if duration is not None:
        raise InputError("a duration goes with a scenario; a log has its own")
    if reference is None:
        source = log.source if isinstance(log, Log) else log
        raise InputError(f"{source}: a reference (CSV with time, north, east) is needed to compare with")
