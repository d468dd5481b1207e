"""A first dive without a log of your own: what ``rovgraph demo`` does."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rovgraph.api.logs import read_log
from rovgraph.api.simulation import SimulatedDive, simulate
from rovgraph.api.smoothing import Result, smooth
from rovgraph.config import load_config
from rovgraph.errors import as_path
from rovgraph.evaluate import Metrics, evaluate, read_reference
from rovgraph.progress import Progress, no_progress
from rovgraph.simulate import Choices
from rovgraph.simulate.named import falcon

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
