"""What a study runs its estimators on: a recorded dive, or one that is simulated where it is needed."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import pandas as pd

from rovgraph.config import Config
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.log.streams import OPTIONAL
from rovgraph.simulate import Truth, scenario, simulate
from rovgraph.simulate.files import known
from rovgraph.trajectory import Trajectory

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
        """The case as it was given."""
        return self.case


@dataclass(frozen=True)
class Simulated:
    """A dive of a scenario, simulated where it is loaded.

    Attributes
    ----------
    scenario : key of `rovgraph.simulate.SCENARIOS`
    seed : the same one gives the same dive
    config : of vehicle and sensors
    duration : [s], None = the scenario's own
    """

    scenario: str
    seed: int
    config: Config
    duration: float | None = None

    @property
    def name(self) -> str:
        return f"{self.scenario} {self.seed}"

    def load(self) -> Case:
        """The dive, and what an estimator may know of it.

        Raises
        ------
        InputError : no such scenario, a duration that it cannot have
        """
        path = scenario(self.scenario, self.duration)
        dive = simulate(path, Truth(self.config), np.random.default_rng(self.seed))
        step = max(round(1.0 / (REFERENCE_RATE * float(np.median(np.diff(dive.truth.time))))), 1)
        yaw = float(dive.hidden["calibration"]["dvl_yaw"][0])
        return Case(log_of(dive.log_frame, self.name), known(dive, self.config), dive.truth.every(step), yaw)


def log_of(frame: pd.DataFrame, source: str) -> Log:
    streams = {}
    for sensor, columns in STREAMS.items():
        required = [c for c in columns if c not in OPTIONAL]
        if not set(required) <= set(frame.columns):
            continue
        kept = frame.dropna(subset=required)
        data = kept.reindex(columns=list(columns)).to_numpy(float)
        if sensor == "dvl":
            data[:, 3] = np.nan_to_num(data[:, 3], nan=1.0)
        rows = kept.index.to_numpy(dtype=np.int64) + 2
        streams[sensor] = Stream(sensor, columns, kept["time"].to_numpy(float), data, rows)
    return Log(source, streams)
