"""A dive whose truth is known: what ``rovgraph simulate`` does."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rovgraph.config import Config
from rovgraph.errors import as_path
from rovgraph.log import Log
from rovgraph.simulate import Choices, Dive, simulated
from rovgraph.simulate.files import figures, write_dive
from rovgraph.trajectory import Trajectory

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
        """What the vehicle recorded; the log that `save` writes has fewer digits."""
        return Log.from_frame(self.dive.log_frame, self.config, f"{self.scenario} {self.seed}")

    @property
    def truth(self) -> Trajectory:
        """The true motion."""
        return self.dive.truth

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
