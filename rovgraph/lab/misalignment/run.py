"""One run of a cell: simulates a dive, estimates it, and returns the error of the misalignment."""

import math
import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rovgraph.errors import in_one_line
from rovgraph.geometry import Array, wrap_angle
from rovgraph.inference.estimate import CalibrationEstimate, Estimate
from rovgraph.lab.estimators import ESTIMATORS, EstimatorSpec, Outcome, outcomes
from rovgraph.lab.evaluate import evaluate
from rovgraph.lab.misalignment.plan import Cell, Study, believed
from rovgraph.log import Log
from rovgraph.model.config import Config
from rovgraph.simulate import CALM, Dive, Style, Truth, scenario, simulate
from rovgraph.simulate.files import known

WITHIN_95 = 1.959964  # sd on either side of the mean
CONVERGED_SD = 0.5  # of the prior's
CONVERGED_ERROR = 3.0  # predicted sd
REACHED_DEG = 1.0
HISTORY_TIMES = 30  # of a run
REFERENCE_STEP = 10  # samples of the IMU between epochs at which tracks are compared
PASSING = (MemoryError, OSError)  # what another attempt may not meet again

CHAINS = {  # estimator: with the misalignment estimated, and held
    "smoothed": ("graph-smoothed-misalignment", "graph-smoothed-a"),
    "filtered": ("graph-filtered-misalignment", "graph-filtered-a"),
    "ekf": ("ekf-misalignment", "ekf-a"),
    "rts": ("rts-misalignment", "rts-a"),
    "4.5": ("4.5", "4.3a"),
}
RUN_COLUMNS = [
    "cell", "run", "seed", *Cell.model_fields, "prior_mean_deg", "estimate_deg", "error_deg", "sd_deg",
    "inside_95", "nees", "converged", "verdict", "time_to_1deg_s", "track_rms_m", "track_rms_held_m", "failure",
    "cpu_s",
]  # fmt: skip
HISTORY_COLUMNS = ["cell", "run", "time_s", "error_deg", "sd_deg"]


@dataclass(frozen=True)
class CellTask:
    """One run; small, it travels to a worker."""

    study: Study
    cell: Cell
    run: int

    @property
    def seed(self) -> int:
        return self.cell.seed(self.study.seed, self.run)

    @property
    def begun(self) -> dict[str, Any]:
        """The entries of its row before the run."""
        return {"cell": self.cell.id, "run": self.run, "seed": self.seed, **self.cell.model_dump()}


@dataclass(frozen=True)
class Done:
    """Rows of runs.csv and history.csv, by their columns."""

    row: dict[str, Any]
    history: list[dict[str, Any]]


def one_run(task: CellTask) -> Done:
    """Simulate, estimate, and measure; an estimator that fails has a row with the reason.

    Raises
    ------
    MemoryError, OSError : which another attempt may not meet again
    """
    began = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of one dive of thousands
        done = _Run(task).done()
    done.row["cpu_s"] = round(time.process_time() - began, 3)
    return done


class _Run:
    """The dive of a task and what is asked of it."""

    def __init__(self, task: CellTask) -> None:
        self.task, cell = task, task.cell
        self.prior_mean_deg = 0.0
        if cell.prior == "honest":
            draw = np.random.default_rng([task.seed, 1]).standard_normal()
            self.prior_mean_deg = cell.misalignment_deg + cell.prior_sd_deg * float(draw)
        self.true_yaw = math.radians(task.study.vehicle.dvl.mount_rpy_deg[2] + cell.misalignment_deg)

    def done(self) -> Done:
        """Its rows."""
        row = {**self.task.begun, "prior_mean_deg": self.prior_mean_deg}
        dive, config = self._dive()
        asked = self._asked()
        made = dict(zip(asked, outcomes(list(asked.values()), self._log(dive), config), strict=True))
        for outcome in made.values():
            if isinstance(outcome.error, PASSING):
                raise outcome.error
        try:
            numbers = self._numbers(_of(made["estimated"]), dive)
        except Exception as error:  # whatever an estimator runs into is a result of the study
            return Done({**row, "failure": in_one_line(error)}, [])
        history = self._history(made)
        reached = {"time_to_1deg_s": _time_to(history)} if history else {}
        held = made["held"].estimate if "held" in made else None
        if held is not None:
            numbers["track_rms_held_m"] = _track_rms(held, dive)
        return Done({**row, **numbers, **reached}, history)

    def _dive(self) -> tuple[Dive, Config]:
        """The dive, and the configuration for its estimator."""
        cell = self.task.cell
        prior = (self.prior_mean_deg, cell.prior_sd_deg)
        errors = (cell.heading_error, cell.heading_error_sd_deg)
        config = believed(self.task.study.vehicle, cell.imu, cell.heading, *errors, cell.fix_sd_m, prior)
        path = scenario(cell.manoeuvre, cell.duration_s, cell.speed_mps, Style() if cell.waves else Style(waves=CALM))
        truth = Truth(
            config,
            calibration={"dvl_yaw": np.array([self.true_yaw])},
            ahrs_rate=10.0 if "ahrs" in cell.heading else None,
            fix_interval=None if cell.fix_sd_m is None else cell.fix_interval_s,
        )
        dive = simulate(path, truth, np.random.default_rng(self.task.seed))
        if cell.cut_s:
            dive = dive.between(cell.cut_s, cell.duration_s - cell.cut_s)
        return dive, known(dive, config)

    def _log(self, dive: Dive) -> Any:
        return Log.from_frame(dive.log_frame, source=f"cell {self.task.cell.id}, run {self.task.run}")

    def _asked(self) -> dict[str, EstimatorSpec]:
        """Estimators that the study wants, what shares its keyframes side by side."""
        estimated, held = CHAINS[self.task.cell.estimator]
        asked = {"estimated": _own_headings(estimated)}
        if self.task.study.history and self.task.cell.estimator in ("smoothed", "rts"):
            asked["history"] = _own_headings(CHAINS["filtered"][0])
        if self.task.study.held_track:
            asked["held"] = _own_headings(held)
        return asked

    def _numbers(self, estimate: Estimate, dive: Dive) -> dict[str, Any]:
        """The estimated misalignment against the truth."""
        entry: CalibrationEstimate = next(c for c in estimate.calibration if c.label == "dvl_yaw")
        error, sd = (math.degrees(x) for x in (float(wrap_angle(entry.value - self.true_yaw)), entry.sd))
        if not (math.isfinite(error) and sd > 0.0):
            raise FloatingPointError("diverged: the misalignment is not finite")
        return {
            "estimate_deg": self.task.cell.misalignment_deg + error,
            "error_deg": error,
            "sd_deg": sd,
            "inside_95": abs(error) <= WITHIN_95 * sd,
            "nees": (error / sd) ** 2,
            "converged": abs(error) < CONVERGED_ERROR * sd and sd < CONVERGED_SD * self.task.cell.prior_sd_deg,
            "verdict": entry.verdict,
            "track_rms_m": _track_rms(estimate, dive),
        }

    def _history(self, made: dict[str, Outcome]) -> list[dict[str, Any]]:
        """Error and sd against time, of the filter that was asked for; none of a smoother."""
        outcome = made.get("history") or made["estimated"]
        if outcome.estimate is None or (
            outcome is made["estimated"] and self.task.cell.estimator in ("smoothed", "rts")
        ):
            return []
        known_yaw = outcome.estimate.history["dvl_yaw"]
        since = known_yaw.time - known_yaw.time[0]
        times = self.task.cell.duration_s * np.arange(1, HISTORY_TIMES + 1) / HISTORY_TIMES
        at = np.maximum(np.searchsorted(since, times, side="right") - 1, 0)
        error = np.rad2deg(wrap_angle(known_yaw.value[at, 0] - self.true_yaw))
        columns = (times.tolist(), error.tolist(), np.rad2deg(known_yaw.sd[at, 0]).tolist())
        first = {"cell": self.task.cell.id, "run": self.task.run}
        return [{**first, "time_s": t, "error_deg": e, "sd_deg": sd} for t, e, sd in zip(*columns, strict=True)]


def _own_headings(name: str) -> EstimatorSpec:
    """An estimator with the heading sources of the configuration; the thesis's have their own."""
    named = ESTIMATORS[name]
    return named if named.family == "thesis" else replace(named, headings="")


def _of(outcome: Outcome) -> Estimate:
    if outcome.error is not None:
        raise outcome.error
    assert outcome.estimate is not None
    return outcome.estimate


def _track_rms(estimate: Estimate, dive: Dive) -> float:
    return float(evaluate(estimate.trajectory, dive.truth.every(REFERENCE_STEP)).as_dict()["rms_m"])


def _time_to(history: Sequence[dict[str, Any]]) -> float:
    """From when error and sd stay below `REACHED_DEG` to the end [s]; infinite where they do not."""
    largest: Array = np.array([max(abs(h["error_deg"]), h["sd_deg"]) for h in history])
    beyond = np.flatnonzero(largest >= REACHED_DEG)
    after = int(beyond[-1]) + 1 if len(beyond) else 0
    return float(history[after]["time_s"]) if after < len(history) else math.inf
