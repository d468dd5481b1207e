"""What an estimator returns."""

from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from rovgraph.geometry import Array
from rovgraph.trajectory import Trajectory

RESIDUAL_COLUMNS = [
    "time", "sensor", "component", "measured", "predicted", "innovation", "sd", "normalised", "weight", "row",
]  # fmt: skip


@dataclass(frozen=True)
class History:
    """A variable against time.

    Attributes
    ----------
    labels : names of the components, d of them
    unit : unit inside the program ("rad" is shown in degrees)
    time : ndarray, shape (n,) [s]
    value, sd : ndarray, shape (n, d)
    """

    labels: tuple[str, ...]
    unit: str
    time: Array
    value: Array
    sd: Array


@dataclass(frozen=True)
class CalibrationEstimate:
    """One scalar calibration component after the dive.

    Attributes
    ----------
    label, unit, about : from the table of calibration variables
    estimated : False = held at its mean
    value, sd, prior_mean, prior_sd : [unit]; sd is that of the prior where considered, and 0 where exact
    verdict : observable, weak or unobservable where estimated; considered; empty where exact, or not known
    """

    label: str
    unit: str
    about: str
    estimated: bool
    value: float
    sd: float
    prior_mean: float
    prior_sd: float
    verdict: str = ""


@dataclass(frozen=True, repr=False)
class Estimate:
    """A trajectory, the calibration and the residuals of the measurements.

    Attributes
    ----------
    kind : "smoothed", "filtered" or "dead_reckoning"
    trajectory : Trajectory of the body's origin, one epoch per keyframe
    calibration : one entry per scalar component of the sensors in use
    history : variable -> History; acc_bias and gyr_bias, and the estimated calibration
        variables (the filter's against time; a smoother's constants at both ends)
    residuals : columns `RESIDUAL_COLUMNS`; component is x, y, z or a name, normalised is
        innovation / sd, weight is 1 for a full measurement and 0 for a rejected one
    summary : numbers about the solution, ready for JSON
    """

    kind: str
    trajectory: Trajectory
    calibration: list[CalibrationEstimate]
    history: dict[str, History]
    residuals: pd.DataFrame
    summary: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Estimate, {self.kind}: {self.trajectory!r}>"
