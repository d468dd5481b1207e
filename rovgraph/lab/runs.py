"""Dives for the runs of a study: recorded, or simulated where they are needed."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from rovgraph.inference.attitude_gaps import without_attitude_gaps
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import Log
from rovgraph.log.frozen import without_frozen
from rovgraph.model.config import Config
from rovgraph.simulate import Choices, simulated

REFERENCE_RATE = 10.0  # epochs per second at which a simulated truth is compared


@dataclass(frozen=True)
class Case:
    """A dive ready to be estimated.

    Attributes
    ----------
    log, config : what an estimator is given
    reference : Trajectory that it is compared with
    true_yaw : true yaw of the DVL's mounting [rad], NaN where it is not known
    """

    log: Log
    config: Config
    reference: Trajectory
    true_yaw: float = float("nan")


class Run(Protocol):
    """A dive by name; a small object that travels to a worker, which loads it there."""

    @property
    def name(self) -> str: ...

    def load(self) -> Case: ...


@dataclass(frozen=True)
class Recorded:
    """A log with its reference.

    Attributes
    ----------
    name : of the run in tables
    case : Case
    """

    name: str
    case: Case

    def load(self) -> Case:
        """The case as it was given, without frozen measurements and those of unknown attitude."""
        log, _ = without_frozen(self.case.log, self.case.config)
        return replace(self.case, log=without_attitude_gaps(log, self.case.config)[0])


@dataclass(frozen=True)
class Simulated:
    """A dive of a scenario, simulated where it is loaded.

    Attributes
    ----------
    scenario : key of `rovgraph.simulate.SCENARIOS`
    seed : the same one gives the same dive
    config : of vehicle and sensors; None = the scenario's own
    duration : [s], None = the scenario's own
    """

    scenario: str
    seed: int
    config: Config | None = None
    duration: float | None = None

    @property
    def name(self) -> str:
        return f"{self.scenario} {self.seed}"

    def load(self) -> Case:
        """The dive, and the configuration for an estimator.

        Raises
        ------
        InputError : no such scenario, a duration that it cannot have
        """
        dive, config = simulated(self.scenario, self.seed, self.config, Choices(duration=self.duration))
        step = max(round(1.0 / (REFERENCE_RATE * float(np.median(np.diff(dive.truth.time))))), 1)
        yaw = float(dive.hidden["calibration"]["dvl_yaw"][0])
        return Case(Log.from_frame(dive.log_frame, source=self.name), config, dive.truth.every(step), yaw)
