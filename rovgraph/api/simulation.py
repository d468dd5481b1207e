"""Dives with known truth: the work of ``rovgraph simulate`` and ``rovgraph demo``."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rovgraph.api.logs import read_log
from rovgraph.api.smoothing import Result, smooth
from rovgraph.errors import as_path
from rovgraph.inference.trajectory import Trajectory
from rovgraph.lab.evaluate import Metrics, evaluate, read_reference
from rovgraph.log import Log
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config, load_config
from rovgraph.process import Progress, no_progress
from rovgraph.simulate import Choices, Dive, simulated
from rovgraph.simulate.files import figures, write_dive
from rovgraph.simulate.named import falcon

OWN = Choices()


@dataclass(frozen=True, repr=False)
class SimulatedDive:
    """A simulated dive with its truth and the configuration for an estimator.

    Attributes
    ----------
    scenario, seed, choices : as given to `rovgraph.simulate`
    dive : everything, including the hidden truth
    config : for an estimator
    """

    scenario: str
    seed: int
    choices: Choices
    dive: Dive
    config: Config

    def __repr__(self) -> str:
        return f"<SimulatedDive {self.scenario}, seed {self.seed}: {self.truth!r}>"

    @cached_property
    def log(self) -> Log:
        """The vehicle's recording; the log that `save` writes has fewer digits."""
        return Log.from_frame(self.dive.log_frame, self.config, f"{self.scenario} {self.seed}")

    @property
    def truth(self) -> Trajectory:
        """The true motion."""
        return self.dive.truth

    @property
    def calibration(self) -> dict[str, float]:
        """Label of each scalar component -> its true value, SI and radians: what `Result.calibration` estimates."""
        known = self.dive.hidden["calibration"]
        return {
            label: float(value)
            for name, values in known.items()
            for label, value in zip(TABLE[name].labels, values, strict=True)
        }

    @property
    def figures(self) -> dict[str, Any]:
        """Length of the dive and number of measurements of each sensor."""
        return figures(self.dive)

    def save(self, path: Path | str, force: bool = False) -> None:
        """Write the folder of ``rovgraph simulate`` (docs/simulation.md), complete or not at all.

        Raises
        ------
        InputError : the folder exists and ``force`` is not given, or cannot be written
        """
        from rovgraph.report.folder import STAMP, results_folder

        with results_folder(as_path(path, "path"), force) as folder:
            settings = {**STAMP, "scenario": self.scenario, "seed": self.seed, **self.choices.summary()}
            write_dive(folder, self.dive, self.config, settings)


def simulate(scenario: str, config: Config | None = None, seed: int = 1, choices: Choices = OWN) -> SimulatedDive:
    """Simulate a dive.

    Parameters
    ----------
    scenario : such as "lawnmower" or "vattern" (docs/simulation.md)
    config : of vehicle and sensors; None = the thesis's Falcon if driven by thrusters, else all defaults
    seed : 0 or more; the same seed gives the same dive
    choices : duration, speed, current and so on, to replace the scenario's

    Raises
    ------
    InputError : an unknown scenario, or a choice that it does not have
    """
    dive, believed = simulated(scenario, seed, config, choices)
    return SimulatedDive(scenario, seed, choices, dive, believed)


SCENARIO, SEED, CHOICES = "falcon", 1, Choices(outliers=0.01)  # the dive of data/falcon


@dataclass(frozen=True)
class Demo:
    """The demonstration dive, its estimates and their errors.

    Attributes
    ----------
    folder : holds the dive, and its results in ``results``
    dive : the log and the truth
    result : what `rovgraph.smooth` returned
    summary : what ``summary.json`` of the results holds
    metrics : errors of the smoothed track
    """

    folder: Path
    dive: SimulatedDive
    result: Result
    summary: dict[str, Any]
    metrics: Metrics

    @property
    def results(self) -> Path:
        """The results folder."""
        return self.folder / "results"


def demo(path: Path | str = "demo", force: bool = False, progress: Progress = no_progress) -> Demo:
    """Write the demonstration dive into a folder, smooth it and evaluate the track.

    The dive is simulated: eight minutes around a structure with the sensors of a Falcon, always the same.

    Parameters
    ----------
    path : the folder to create: the files of ``rovgraph simulate``, and those of ``rovgraph smooth`` in ``results``
    force : replace an older folder
    progress : called at times with the current task and its progress from 0 to 1

    Raises
    ------
    InputError : the folder exists and ``force`` is not given, or cannot be written
    """
    from rovgraph.report.folder import check_writable

    folder = as_path(path, "path")
    check_writable(folder, force)
    progress("simulating the dive", 0.0)
    dive = simulate(SCENARIO, falcon(), SEED, CHOICES)
    dive.save(folder, force)
    config = load_config(folder / "config.yaml")
    result = smooth(read_log(folder / "log.csv", config), config, progress=progress)
    summary = result.save(folder / "results")
    metrics = evaluate(result.smoothed.trajectory, read_reference(folder / "truth.csv"))
    return Demo(folder, dive, result, summary, metrics)
