"""Evidence for alarms: the estimates of a dive, its optimum, and the residuals of every sensor as arrays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import pandas as pd

from rovgraph.diagnosis.check import Finding
from rovgraph.geometry import Array
from rovgraph.inference.attitude_gaps import AttitudeGap
from rovgraph.inference.correlated_noise import Rival
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import Log
from rovgraph.log.frozen import FrozenStretch
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.problem import Problem

MINUTE = 60.0  # [s]


@dataclass(frozen=True)
class SensorResiduals:
    """The residuals of n measurements of one sensor.

    Attributes
    ----------
    sensor, components : its name, and those of its k components
    time : ndarray, shape (n,) [s]
    normalised : ndarray, shape (n, k), innovations in units of their sd
    weight : ndarray, shape (n,), 0 where it was rejected
    shared : ndarray, shape (n, k), variance of an error that successive ones share and that is allowed for, in units
        of their own; None = without one
    """

    sensor: str
    components: tuple[str, ...]
    time: Array
    normalised: Array
    weight: Array
    shared: Array | None = None


@dataclass(frozen=True)
class Evidence:
    """A dive that was estimated.

    Attributes
    ----------
    initial : configuration, instruments and prior
    estimates : smoothed, filtered or both
    problem : of the estimates' keyframes
    optimum : of the smoothed estimate, where a batch solver found it
    frozen : measurements left out as invalid
    log : of the dive
    attitude_gaps : times without heading or tilt, of a dive without an IMU
    left_out : (sensor, reason) -> count of measurements that never reached the graph
    findings : of the check of the log
    revealed : sensor and cause of what the dive revealed, with which it was solved again
    before : track before it was; None = it was not
    rivals : what explains the dive as clearly as what was found
    ambiguities : what explains it nearly as well, in words, with the cost that it has more; sensor, cause, cost
    """

    initial: InitialConditions
    estimates: Sequence[Estimate]
    problem: Problem
    optimum: Optimum | None
    frozen: Sequence[FrozenStretch]
    log: Log
    attitude_gaps: Sequence[AttitudeGap] = ()
    left_out: Mapping[tuple[str, str], int] = field(default_factory=dict)
    findings: Sequence[Finding] = ()
    revealed: Sequence[tuple[str, str]] = ()
    before: Trajectory | None = None
    rivals: Sequence[Rival] = ()
    ambiguities: Sequence[tuple[str, str, float]] = ()

    def estimate(self, kind: str) -> Estimate | None:
        """The estimate of a kind, if it was made."""
        return next((e for e in self.estimates if e.kind == kind), None)

    @cached_property
    def main(self) -> Estimate:
        """The smoothed estimate, or else the filtered one."""
        return self.estimate("smoothed") or self.estimates[0]

    @property
    def start(self) -> float:
        """Time of the first keyframe [s]."""
        return float(self.main.trajectory.time[0])

    @property
    def end(self) -> float:
        """Time of the last keyframe [s]."""
        return float(self.main.trajectory.time[-1])

    @cached_property
    def residuals(self) -> dict[str, SensorResiduals]:
        """Of the main estimate, by sensor."""
        return residuals_by_sensor(self.main.residuals)

    @cached_property
    def innovations(self) -> dict[str, SensorResiduals]:
        """Of the filtered estimate, by sensor; empty where it was not made."""
        filtered = self.estimate("filtered")
        return {} if filtered is None else residuals_by_sensor(filtered.residuals)

    def since(self, time: float) -> float:
        """Seconds since the dive began."""
        return time - self.start

    def span(self, begin: float, end: float) -> str:
        """A time as a person looks for it."""
        return span(begin, end, self.start)


def span(begin: float, end: float, start: float) -> str:
    """A time in seconds since the dive began, as "60 to 120 s"."""
    return f"{begin - start:.0f} to {end - start:.0f} s"


def residuals_by_sensor(frame: pd.DataFrame) -> dict[str, SensorResiduals]:
    """Rows of `RESIDUAL_COLUMNS`, one per component, as one entry per sensor."""
    out, sensor, component = {}, frame["sensor"].to_numpy(), frame["component"].to_numpy()
    columns = {name: frame[name].to_numpy(float) for name in ("time", "normalised", "weight")}
    for name in pd.unique(frame["sensor"]).tolist():
        rows = np.flatnonzero(sensor == name)
        labels = tuple(pd.unique(component[rows]).tolist())
        first = [rows[component[rows] == label] for label in labels]
        normalised = np.column_stack([columns["normalised"][index] for index in first])
        out[name] = SensorResiduals(name, labels, columns["time"][first[0]], normalised, columns["weight"][first[0]])
    return out


def windows(time: Array, start: float, seconds: float) -> Array:
    """Number of the window of a length that each time lies in, from 0, shape (n,) of int."""
    return np.maximum((time - start) // seconds, 0).astype(np.int64)
