"""The results of a study: runs, or what is left of them; their rows on disk; and a row per cell.

`Ledger` keeps the rows as they come, so that an interrupted study continues. `cell_table` compares the estimator's sds
with its errors. The error of N independent runs with the right sd has a mean NEES (error / sd squared, one component)
that is chi-square with N degrees of freedom over N (Bar-Shalom et al. 2001, 5.4.2), and the number of runs within their
95 % interval is binomial.
"""

import contextlib
import csv
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.errors import InputError, in_one_line
from rovgraph.lab.executors import Executor, Local
from rovgraph.lab.misalignment.plan import Cell, Study
from rovgraph.lab.misalignment.run import HISTORY_COLUMNS, RUN_COLUMNS, CellTask, Done, one_run
from rovgraph.model.config import parse_model, read_yaml

BAND = 0.95
CELL_COLUMNS = [
    "cell", *Cell.model_fields, "runs", "failed", "bias_deg", "sd_deg", "rms_deg", "predicted_sd_deg", "sd_ratio",
    "coverage", "coverage_low", "coverage_high", "nees", "nees_low", "nees_high", "converged", "verdict",
    "reached_1deg", "time_to_1deg_s", "track_rms_m", "track_rms_held_m", "cpu_s",
]  # fmt: skip


def cell_table(runs: pd.DataFrame, cells: Sequence[Cell]) -> pd.DataFrame:
    """One row per cell that has runs, in the order given; docs/studies.md describes the columns.

    Parameters
    ----------
    runs : a row per run, columns of runs.csv
    cells : of the study
    """
    by_cell = dict(list(runs.groupby("cell", sort=False)))
    rows = [_row(cell, by_cell[cell.id]) for cell in cells if cell.id in by_cell]
    return pd.DataFrame(rows, columns=pd.Index(CELL_COLUMNS))


def _row(cell: Cell, runs: pd.DataFrame) -> dict[str, Any]:
    from scipy.stats import binomtest, chi2  # type: ignore[attr-defined]  # a second to load, which no worker needs

    good = runs[runs["failure"].isna()]
    row = {"cell": cell.id, **cell.model_dump(), "runs": len(runs), "failed": len(runs) - len(good)}
    if not len(good):
        return row
    error, sd = good["error_deg"].to_numpy(float), good["sd_deg"].to_numpy(float)
    rms = float(np.sqrt(np.mean(error**2)))
    inside = int(good["inside_95"].astype(bool).sum())
    covered = binomtest(inside, len(good)).proportion_ci(BAND)
    nees_low, nees_high = chi2.interval(BAND, len(good)) / np.float64(len(good))
    return row | {
        "bias_deg": error.mean(),
        "sd_deg": error.std(ddof=1) if len(good) > 1 else np.nan,
        "rms_deg": rms,
        "predicted_sd_deg": float(np.median(sd)),
        "sd_ratio": float(np.sqrt(np.mean(sd**2))) / rms,
        "coverage": inside / len(good),
        "coverage_low": covered.low,
        "coverage_high": covered.high,
        "nees": good["nees"].mean(),
        "nees_low": nees_low,
        "nees_high": nees_high,
        "converged": good["converged"].astype(float).mean(),
        "verdict": good["verdict"].mode().iloc[0],
        **_time(good["time_to_1deg_s"].astype(float).dropna()),
        "track_rms_m": _rms(good["track_rms_m"]),
        "track_rms_held_m": _rms(good["track_rms_held_m"]),
        "cpu_s": good["cpu_s"].mean(),
    }


def _time(reached: pd.Series) -> dict[str, float]:
    """Share of the runs that got there, and the median time over all of them, infinite where less than half did."""
    if not len(reached):
        return {}
    return {"reached_1deg": float(np.isfinite(reached).mean()), "time_to_1deg_s": float(reached.median())}


def _rms(values: pd.Series) -> float:
    return float(np.sqrt(values.astype(float).pow(2).mean()))


class Ledger:
    """A CSV file to which rows are added, each on disk before the next.

    Parameters
    ----------
    path : of the file; where it is not, it is made with its header
    columns : of the file
    order : columns that a row is found by

    Raises
    ------
    InputError : the file cannot be read or written, or has other columns
    """

    def __init__(self, path: Path, columns: Sequence[str], order: Sequence[str]) -> None:
        self.path, self.columns, self.order = path, list(columns), list(order)
        if path.exists():
            self._mend()
        else:
            self._write(pd.DataFrame(columns=pd.Index(self.columns)))

    def _mend(self) -> None:
        """Cut off a row that was not written to its end."""
        with kept_so_far(self.path), self.path.open("rb+") as file:
            content = file.read()
            file.truncate(content.rfind(b"\n") + 1)

    def add(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Append rows; what a column lacks is left empty."""
        with kept_so_far(self.path), self.path.open("a", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, self.columns, lineterminator="\n")
            writer.writerows(rows)
            file.flush()

    def read(self) -> pd.DataFrame:
        """All rows, each once."""
        with kept_so_far(self.path):
            try:
                frame = pd.read_csv(self.path, engine="python", dtype={"cell": str})  # floats exactly as written
            except ValueError as error:
                raise InputError(f"{self.path}: not what a study wrote ({str(error).splitlines()[0]})") from None
        if list(frame) != self.columns:
            raise InputError(f"{self.path}: not what this version of rovgraph wrote; choose another --out")
        return frame.drop_duplicates(self.order, keep="last")

    def settle(self, cells: Sequence[str]) -> pd.DataFrame:
        """Write all rows in their order, and return them; ``cells`` are ids in the order of the study."""
        rank = {cell: i for i, cell in enumerate(cells)}
        frame = self.read().sort_values(
            self.order, key=lambda c: c.map(rank) if c.name == "cell" else c, kind="stable", ignore_index=True
        )
        self._write(frame)
        return frame

    def _write(self, frame: pd.DataFrame) -> None:
        fresh = self.path.with_suffix(".new")
        with kept_so_far(self.path):
            frame.to_csv(fresh, index=False)
            fresh.replace(self.path)


@contextlib.contextmanager
def kept_so_far(path: Path) -> Iterator[None]:
    """Turn an error of the file system into an `InputError` that states how to continue."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"{path}: {reason}; what was written before is kept, --resume goes on") from None


STUDY_FILE = "study.yaml"
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Tables:
    """Results of a study; docs/studies.md describes the columns.

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

    def add(self, task: CellTask, result: Done | BaseException) -> None:
        """Keep the results of a run; its own row comes last, so that a run with a row is complete."""
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
    engine: Executor | None = None,
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
    stored = results.runs.read()
    known = set(zip(stored["cell"], stored["run"], strict=True))
    tasks = [CellTask(plan, cell, run) for run in range(plan.runs) for cell in cells if (cell.id, run) not in known]
    total, left = plan.runs * len(cells), len(tasks)

    def finished(task: CellTask, result: Done | BaseException) -> None:
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
    of_study = runs[runs["cell"].isin(ids) & (runs["run"] < plan.runs)].reset_index(drop=True)
    history = results.history.settle(ids).merge(of_study[["cell", "run"]], on=["cell", "run"])
    return Tables(plan, of_study, cell_table(of_study, cells), history)
