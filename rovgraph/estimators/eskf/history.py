"""What a filter has found on its way through a dive, and the estimate that comes of it."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import FilterRun, Gaussian, Met, stack_states, states_of
from rovgraph.engine.measurements import Measurements
from rovgraph.engine.problem import Problem
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.results import (
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    residual_frame,
)
from rovgraph.geometry import Array
from rovgraph.process import stage
from rovgraph.state import BIAS, PLACE, POSE, VELOCITY, State

# of some keyframes, their number first in every shape: state, calibration, covariances of pose and velocity, sd of the
# error
Columns = tuple[Array, Array, Array, Array, Array]


class _Part(NamedTuple):
    """Measurements in a row, as the filter met them.

    Attributes
    ----------
    states : returns x and c of each, as of `Met`, shapes (n, 21), (n, C)
    nis, weight, place : as of it, of each; place is shape (0, 2) where no place is among them
    """

    states: Callable[[], tuple[Array, Array]]
    nis: Array
    weight: Array
    place: Array


class FilterHistory:
    """Keyframes as far as results need them, and the measurements as the filter met them.

    Parameters
    ----------
    engine : the filter's
    """

    def __init__(self, engine: FilterEngine) -> None:
        self._engine = engine
        self._pieces: list[Columns] = []
        self._met: list[_Part] = []
        self._count = 0

    def __len__(self) -> int:
        """Count of keyframes."""
        return self._count

    def append(self, known: Gaussian, met: Met) -> None:
        """Take the next keyframe."""
        self._count += 1
        self._pieces.append(self._columns(known))
        if len(met):
            place = met.place if (met.number >= 0).any() else met.place[:0]
            self._met.append(_Part(met.states, met.nis, met.weight, place))

    def extend(self, run: FilterRun) -> None:
        """Take the intervals that a filter has run through."""
        if not len(run):
            return
        found = run.filtered
        self._met.append(_Part(run.states, found.nis, found.weight, np.empty((0, 2))))
        self._count += len(run)
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

    def estimate(self, problem: Problem, kind: str) -> Estimate:
        """The filtered estimate of every keyframe."""
        self._join()
        return self._estimate(problem, kind, self._pieces[0], None)

    @stage
    def _join(self) -> None:
        """Keep what was found in one piece; of a long dive it is not kept twice."""
        self._pieces = [_joined(self._pieces)]

    def smoothed(self, problem: Problem, kind: str, known: Sequence[Gaussian]) -> Estimate:
        """The estimate of every keyframe that a smoother has found."""
        return self._estimate(problem, kind, _joined([self._columns(one) for one in known]), stack_states(known))

    def _columns(self, known: Gaussian) -> Columns:
        """Of one keyframe."""
        size, columns, P = self._engine.layout.size, self._engine.layout.columns, known.covariance
        pose, velocity = (P[columns[v], columns[v]].copy() for v in (POSE, VELOCITY))
        return known.x[None], known.c[None], pose[None], velocity[None], np.sqrt(np.diagonal(P)[:size])[None]

    def _estimate(self, problem: Problem, kind: str, found: Columns, smoothed: State | None) -> Estimate:
        """An estimate; residuals are those before the measurements entered where nothing was smoothed."""
        x, c, pose, velocity, sd = found
        engine, states = self._engine, states_of(x, c)
        columns, estimated = engine.layout.columns, engine.unknowns.estimated
        trajectory = body_trajectory(problem.keyframes, states, engine.initial, pose, velocity)
        history = bias_histories(trajectory.time, states.bias, sd[:, columns[BIAS]], engine.initial.streams)
        for name in estimated:
            history[name] = calibration_history(name, trajectory.time, states.calibration[name], sd[:, columns[name]])
        final = {name: np.diag(sd[-1, columns[name]] ** 2) for name in estimated}
        sensors = [s for s in engine.initial.streams if s in {*problem.used, "imu"}]
        last = {name: value[-1] for name, value in states.calibration.items()}
        calibration = calibration_estimates(engine.beliefs, sensors, last, final)
        residuals = residual_frame(self._measured(problem, smoothed))
        return Estimate(kind, trajectory, calibration, history, residuals, self._summary(problem))

    def _measured(self, problem: Problem, smoothed: State | None) -> Iterator[tuple[str, Measurements, State, Array]]:
        """Each sensor's measurements, the states they are compared with, and their weights."""
        weight = np.concatenate([np.empty(0), *(part.weight for part in self._met)])
        if problem.used and PLACE in problem.used:
            place = [part.place if len(part.place) else np.full((len(part.nis), 2), np.nan) for part in self._met]
        for sensor in problem.used:
            own = problem.of_sensor(sensor)
            block = self._engine.measurements(problem, own)
            here = smoothed.at(block.keyframe) if smoothed is not None else states_of(*self._states(own))
            if sensor == PLACE:
                here = here.seeing(np.concatenate(place)[own])
            yield sensor, block, here, weight[own]

    def _states(self, index: NDArray[np.int64]) -> tuple[Array, Array]:
        """x and c of some measurements, in order, as the filter met them; of a long dive all of them are large."""
        found, begin = [], 0
        for part in self._met:
            end = begin + len(part.nis)
            own = index[slice(*index.searchsorted([begin, end]))] - begin
            if len(own):
                x, c = part.states()
                found.append((x[own], c[own]))
            begin = end
        x, c = (np.concatenate(column) for column in zip(*found, strict=True))
        return x, c

    def _summary(self, problem: Problem) -> dict[str, Any]:
        """Count of keyframes, and of every sensor its mean NIS, which is its dimension where noise is as believed."""
        every = np.concatenate([np.empty(0), *(part.nis for part in self._met)])
        weight, nis = np.concatenate([np.empty(0), *(part.weight for part in self._met)]), {}
        for sensor in problem.used:
            own = problem.of_sensor(sensor)
            admitted = every[own][weight[own] > 0.0]
            nis[sensor] = {
                "mean": float(np.mean(admitted)) if len(admitted) else None,
                "dim": self._engine.initial.instruments[sensor].model.dim,
                "count": len(admitted),
                "rejected": len(own) - len(admitted),
            }
        return {"keyframes": len(self), "nis": nis, "bridged_intervals": int(problem.bridged.sum())}


def _joined(pieces: Sequence[Columns]) -> Columns:
    """Of all keyframes."""
    x, c, pose, velocity, sd = (np.concatenate(column) for column in zip(*pieces, strict=True))
    return x, c, pose, velocity, sd
