"""What a filter has found on its way through a dive, and the estimate that comes of it."""

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import FilterRun, Gaussian, MetStates, ProcessedMeasurement, stack_states, states_of
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.measurement_table import MeasurementTable
from rovgraph.engine.measurements import Block
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.results import (
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    residual_frame,
)
from rovgraph.geometry import Array
from rovgraph.process import give_back
from rovgraph.state import BIAS, POSE, VELOCITY, State

# of some keyframes, their number first in every shape: state, calibration, covariances of pose and velocity, sd of the
# error
Columns = tuple[Array, Array, Array, Array, Array]


class _Met(NamedTuple):
    """Measurements of one sensor as the filter met them in a row.

    Attributes
    ----------
    states : returns x and c of each, as of `ProcessedMeasurement`, shapes (n, 21), (n, C)
    nis, weight, places : as of it, of each
    """

    states: Callable[[], tuple[Array, Array]]
    nis: Sequence[float]
    weight: Sequence[float]
    places: Sequence[Array] = ()


class FilterHistory:
    """Keyframes as far as results need them, and the measurements as the filter met them.

    Parameters
    ----------
    engine : the filter's

    Attributes
    ----------
    intervals : the dive, as far as it has been taken
    """

    def __init__(self, engine: FilterEngine) -> None:
        self._engine = engine
        self._pieces: list[Columns] = []
        self._met: dict[str, list[_Met]] = {}
        self.intervals: list[KeyframeInterval] = []

    def __len__(self) -> int:
        return len(self.intervals)

    def append(self, interval: KeyframeInterval, known: Gaussian, processed: Sequence[ProcessedMeasurement]) -> None:
        """Take the next keyframe."""
        self.intervals.append(interval)
        self._pieces.append(self._columns(known))
        for one in processed:
            places = () if one.place is None else (one.place,)
            met = _Met(partial(_state_of, one), (one.nis,), (one.weight,), places)
            self._met.setdefault(one.measurement.sensor, []).append(met)

    def extend(self, intervals: Sequence[KeyframeInterval], run: FilterRun) -> None:
        """Take the intervals that a filter has run through."""
        found = run.filtered
        for which in dict.fromkeys(run.which.tolist()):
            own = np.flatnonzero(run.which == which)
            of_keyframes = run.before, found.x, found.c, found.predicted_x, found.predicted_c
            states = MetStates(*of_keyframes, run.interval[own], run.between[own])
            met = _Met(states, found.nis[own].tolist(), found.weight[own].tolist())
            self._met.setdefault(run.sensors[which], []).append(met)
        self.intervals += intervals
        if len(intervals):
            self._pieces.append((found.x, found.c, found.pose, found.velocity, found.sd))

    def replace_last(self, known: Gaussian) -> None:
        """Take another estimate of the newest keyframe."""
        x, c, pose, velocity, sd = self._pieces.pop()
        self._pieces += [(x[:-1], c[:-1], pose[:-1], velocity[:-1], sd[:-1]), self._columns(known)]

    @property
    def states(self) -> State:
        """Of n keyframes; calibration has shape (n, dim)."""
        x, c = (np.concatenate([piece[column] for piece in self._pieces]) for column in range(2))
        return states_of(x, c)

    def estimate(self, kind: str) -> Estimate:
        """The filtered estimate of every keyframe."""
        self._pieces = [_joined(self._pieces)]  # of a long dive they are not kept twice
        give_back()
        return self._estimate(kind, self._pieces[0], None)

    def smoothed(self, kind: str, known: Sequence[Gaussian]) -> Estimate:
        """The estimate of every keyframe that a smoother has found."""
        return self._estimate(kind, _joined([self._columns(one) for one in known]), stack_states(known))

    def _columns(self, known: Gaussian) -> Columns:
        """Of one keyframe."""
        size, columns, P = self._engine.layout.size, self._engine.layout.columns, known.covariance
        pose, velocity = (P[columns[v], columns[v]].copy() for v in (POSE, VELOCITY))
        return known.x[None], known.c[None], pose[None], velocity[None], np.sqrt(np.diagonal(P)[:size])[None]

    def _estimate(self, kind: str, found: Columns, smoothed: State | None) -> Estimate:
        """An estimate; residuals are those before the measurements entered where nothing was smoothed."""
        x, c, pose, velocity, sd = found
        engine, states = self._engine, states_of(x, c)
        columns, estimated = engine.layout.columns, engine.unknowns.estimated
        trajectory = body_trajectory(self.intervals, states, engine.initial, pose, velocity)
        history = bias_histories(trajectory.time, states.bias, sd[:, columns[BIAS]], engine.initial.streams)
        for name in estimated:
            history[name] = calibration_history(name, trajectory.time, states.calibration[name], sd[:, columns[name]])
        final = {name: np.diag(sd[-1, columns[name]] ** 2) for name in estimated}
        sensors = [s for s in engine.initial.streams if s in {*self._met, "imu"}]
        last = {name: value[-1] for name, value in states.calibration.items()}
        calibration = calibration_estimates(engine.beliefs, sensors, last, final)
        residuals = residual_frame(self._measured(smoothed))
        return Estimate(kind, trajectory, calibration, history, residuals, self._summary())

    def _measured(self, smoothed: State | None) -> Iterator[tuple[str, Block, State, Array]]:
        """Each sensor's measurements, the states they are compared with, and their weights."""
        measured = MeasurementTable.of_dive(self.intervals)
        for sensor, parts in self._met.items():
            block = self._engine.block(measured.of_sensor(sensor))
            if smoothed is None:
                x, c = (np.concatenate(column) for column in zip(*(part.states() for part in parts), strict=True))
                here = states_of(x, c)
            else:
                here = smoothed.at(block.keyframe)
            places = [place for part in parts for place in part.places]
            if places:
                here = here.seeing(np.array(places))
            yield sensor, block, here, np.array([weight for part in parts for weight in part.weight])

    def _summary(self) -> dict[str, Any]:
        """Count of keyframes, and of every sensor its mean NIS, which is its dimension where noise is as believed."""
        nis = {}
        for sensor, parts in self._met.items():
            found = np.array([value for part in parts for value in part.nis])
            weight = np.array([value for part in parts for value in part.weight])
            admitted = found[weight > 0.0]
            nis[sensor] = {
                "mean": float(np.mean(admitted)) if len(admitted) else None,
                "dim": self._engine.initial.instruments[sensor].model.dim,
                "count": len(admitted),
                "rejected": len(found) - len(admitted),
            }
        bridged = sum(interval.bridged for interval in self.intervals)
        return {"keyframes": len(self.intervals), "nis": nis, "bridged_intervals": bridged}


def _state_of(one: ProcessedMeasurement) -> tuple[Array, Array]:
    """x and c of one measurement."""
    return one.x[None], one.c[None]


def _joined(pieces: Sequence[Columns]) -> Columns:
    """Of all keyframes."""
    x, c, pose, velocity, sd = (np.concatenate(column) for column in zip(*pieces, strict=True))
    return x, c, pose, velocity, sd
