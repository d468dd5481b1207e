"""Run a study, or what is left of it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from rovgraph.config import parse_model, read_yaml
from rovgraph.errors import InputError, in_one_line
from rovgraph.studies.engines import Engine, Local
from rovgraph.studies.misalignment.cells import cell_table
from rovgraph.studies.misalignment.ledger import Ledger
from rovgraph.studies.misalignment.plan import Cell, Study
from rovgraph.studies.misalignment.run import HISTORY_COLUMNS, RUN_COLUMNS, Done, Task, one_run

STUDY_FILE = "study.yaml"
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Tables:
    """What a study found; docs/studies.md describes the columns.

    Attributes
    ----------
    study : Study
    runs, cells : a row per run, a row per cell
    history : of filters, a row per run and time; empty where nothing was asked of one
    """

    study: Study
    runs: pd.DataFrame
    cells: pd.DataFrame
    history: pd.DataFrame


class Results:
    """The folder of a study: its rows as they come, and what was studied.

    Attributes
    ----------
    runs, history : Ledger
    """

    def __init__(self, folder: Path) -> None:
        self.runs = Ledger(folder / "runs.csv", RUN_COLUMNS, ["cell", "run"])
        self.history = Ledger(folder / "history.csv", HISTORY_COLUMNS, ["cell", "run", "time_s"])

    def add(self, task: Task, result: Done | BaseException) -> None:
        """Keep what came of a run; its own row comes last, so that a run with a row is whole."""
        if isinstance(result, BaseException):
            result = Done({**task.begun, "failure": in_one_line(result)}, [])
        self.history.add(result.history)
        self.runs.add([result.row])


def open_results(folder: Path, study: Study, resume: bool) -> Results:
    """The folder of a study, made for it or gone on with.

    Parameters
    ----------
    folder : where
    study : what is in it or will be
    resume : it may exist, from the same study with as many cells and runs, or fewer

    Raises
    ------
    InputError : it exists and is not to be resumed, or is another study's; it cannot be made
    """
    told = folder / STUDY_FILE
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            if not resume:
                raise InputError(f"{folder} exists; give --resume to go on with it, or choose another --out")
            if not told.is_file():
                raise InputError(f"{folder} holds no study to resume; choose another --out")
            if not parse_model(Study, read_yaml(told), str(told)).same_dives(study):
                raise InputError(
                    f"{folder} holds another study: seed, vehicle, history and held_track have to be as in {told}; "
                    "choose another --out"
                )
        folder.mkdir(parents=True, exist_ok=True)
        told.write_text(study.to_yaml(), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another --out") from None
    return Results(folder)


def study(
    plan: Study,
    results: Results,
    cells: Sequence[Cell] | None = None,
    engine: Engine | None = None,
    progress: Progress = lambda done: None,
) -> Tables:
    """Make the runs that are not there yet; the tables do not depend on how often it was interrupted.

    Parameters
    ----------
    plan : the study
    results : of `open_results`
    cells : some of its cells, None = all
    engine : where the runs are made, None = on this machine
    progress : called with the share of runs that are there

    Raises
    ------
    InputError : of the engine, or a disk that is full
    """
    cells = plan.all_cells() if cells is None else cells
    there = results.runs.read()
    known = set(zip(there["cell"], there["run"], strict=True))
    tasks = [Task(plan, cell, run) for run in range(plan.runs) for cell in cells if (cell.id, run) not in known]
    total, left = plan.runs * len(cells), len(tasks)

    def finished(task: Task, result: Done | BaseException) -> None:
        nonlocal left
        results.add(task, result)
        left -= 1
        progress(1.0 - left / total)

    progress(1.0 - left / total)
    if tasks:
        (engine or Local()).each(one_run, tasks, finished)
    return _tables(plan, results)


def _tables(plan: Study, results: Results) -> Tables:
    """Of the study's cells and runs; rows of others that are in the folder stay there."""
    cells = plan.all_cells()
    ids = [cell.id for cell in cells]
    runs = results.runs.settle(ids)
    own = runs[runs["cell"].isin(ids) & (runs["run"] < plan.runs)].reset_index(drop=True)
    history = results.history.settle(ids).merge(own[["cell", "run"]], on=["cell", "run"])
    return Tables(plan, own, cell_table(own, cells), history)
