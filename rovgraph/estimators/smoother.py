"""Batch smoothing of a whole dive."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from math import isfinite
from typing import Any

import numpy as np

from rovgraph.engine.assembly import Assembler
from rovgraph.engine.constant_velocity import has_constant_velocity
from rovgraph.engine.dive_rows import DiveRows
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.log_assembly import assemble_log
from rovgraph.engine.optimum import NEWEST, Optimum, joint_prior_sd, residual_state
from rovgraph.engine.stretches import Searches
from rovgraph.engine.time_offsets import TimeOffsets
from rovgraph.estimators.dead_reckoning import dead_reckon
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.observability import without_what_noise_moves
from rovgraph.estimators.optimum import optimum
from rovgraph.estimators.results import (
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    residual_frame,
)
from rovgraph.geometry import Array
from rovgraph.log import Log, Measurement
from rovgraph.state import BIAS, PLACE, POSE, VELOCITY, State

MAX_PLACINGS = 4  # solutions, each with late measurements put where the one before has found them to belong
PLACED_WITHIN_S = 0.02  # the IMU adds next to no noise over that time
CENTRED_REACH_S = 0.1  # around the time_offset that was found


@dataclass
class BatchSmoother:
    """Collects a dive and solves it at once.

    Attributes
    ----------
    initial : of `rovgraph.estimators.initialise.initialise`
    time_offsets : how late they are; None = as the configuration believes
    searches : for stretches of wrong measurements, shared with whoever solves the same dive
    intervals : the dive, as far as it has been taken
    """

    initial: InitialConditions
    time_offsets: TimeOffsets | None = None
    searches: Searches = field(default_factory=Searches)

    def __post_init__(self) -> None:
        b = self.initial
        self.assembler = Assembler(
            b.config, b.instruments, b.prior.state.bias[0], believed=b.beliefs, assumed=self.time_offsets
        )
        self.intervals: list[KeyframeInterval] = []
        self._log: Log | None = None
        self._rows: DiveRows | None = None
        self._measurements: list[Measurement] = []

    def take(self, log: Log) -> list[KeyframeInterval]:
        """Take a whole log, before anything else: what `add` of each of its measurements and `finish` give."""
        self._log = log
        b, assembler = self.initial, self.assembler
        if has_constant_velocity(b.config):  # every measurement may make a keyframe, and no samples lie between
            for measurement in log.measurements():
                self.intervals += assembler.add(measurement)
            return self.finish()
        bias, offsets, left_out = b.prior.state.bias[0], assembler.time_offsets, assembler.left_out
        dive = assemble_log(log, b.config, b.instruments, bias, offsets, left_out, b.beliefs)
        self.intervals, self._rows = dive.intervals, dive.rows
        return dive.intervals

    @property
    def measurements(self) -> list[Measurement]:
        """The dive as it came, where the time offset of a sensor is estimated; else none."""
        if self._log is None or not self.assembler.time_offsets.lags:
            return self._measurements
        return list(self._log.measurements())

    @property
    def rows(self) -> DiveRows:
        """The dive as arrays, as far as it has been taken."""
        if self._rows is None or len(self._rows) != len(self.intervals):
            self._rows = DiveRows.of(self.intervals, [*self.initial.instruments])
        return self._rows

    def forget_motion_covariances(self) -> None:
        """Free the memory of what a filter needs, and GTSAM's graph of a dive that sees places, but not the chain."""
        if self._rows is not None and PLACE not in self._rows.used:
            self._rows = self._rows.without_covariances(self.intervals)

    def add(self, measurement: Measurement) -> list[KeyframeInterval]:
        """Take a measurement; times must not decrease."""
        if self.assembler.time_offsets.lags:
            self._measurements.append(measurement)
        done = self.assembler.add(measurement)
        self.intervals += done
        return done

    def finish(self) -> list[KeyframeInterval]:
        """Close the last interval."""
        done = self.assembler.finish()
        self.intervals += done
        return done

    def solve(self, states: State | None = None) -> Estimate:
        """The smoothed trajectory with its uncertainty; ``states`` as `optimum` takes them."""
        return smoothed(self.optimum(states), self.initial)

    def optimum(self, states: State | None = None) -> Optimum:
        """The dive and its optimum.

        Parameters
        ----------
        states : State of its keyframes to begin with, calibration at the end of the dive; None = dead reckoning
        """
        b = self.initial
        dive, priors = self, b.beliefs
        calibration = None if states is None else newest_calibration(states.calibration)
        for _ in range(MAX_PLACINGS):
            if states is None:
                states = dead_reckon(dive.intervals, b, {name: belief.mean for name, belief in priors.items()})
            best = optimum(dive.intervals, b, states, calibration, dive.rows, dive.searches)
            found = best.state.calibration
            again = dive.placed_again(found)
            if again is None:
                break
            dive, states, calibration = again, None, newest_calibration(found)
        return best

    def placed_again(self, calibration: Mapping[str, Array]) -> "BatchSmoother | None":
        """The same dive with its measurements where late stamps were found to belong; None = they are there already.

        Parameters
        ----------
        calibration : name -> ndarray, shape (dim,) or (n, dim), what was found
        """
        if self.assembler.time_offsets.off(calibration) < PLACED_WITHIN_S:
            return None
        again = BatchSmoother(self.initial, self.assembler.time_offsets.centred(calibration, CENTRED_REACH_S))
        if self._log is not None:
            again.take(self._log)
            return again
        for measurement in self._measurements:
            again.add(measurement)
        again.finish()
        return again

    def dead_reckoning(self) -> Estimate:
        """Dead reckoning over the same intervals: the baseline."""
        b = self.initial
        means = {name: belief.mean for name, belief in b.beliefs.items()}
        states = dead_reckon(self.intervals, b, means)
        trajectory = body_trajectory(self.intervals, states, b)
        return Estimate("dead_reckoning", trajectory, [], {}, residual_frame())


def newest_calibration(calibration: Mapping[str, Array]) -> dict[str, Array]:
    """The last of values of shape (n, dim) or (dim,), shape (dim,)."""
    return {name: value.reshape(-1, value.shape[-1])[-1] for name, value in calibration.items()}


def smoothed(best: Optimum, b: InitialConditions) -> Estimate:
    """The optimum with its marginal covariances; what the dive does not show is held, where noise may move it."""
    best, relative = without_what_noise_moves(best)
    states, intervals = best.state, best.intervals
    trajectory = body_trajectory(intervals, states, b, best.covariances(POSE), best.covariances(VELOCITY))
    bias_sd = np.sqrt(np.diagonal(best.covariances(BIAS), axis1=1, axis2=2))
    history = bias_histories(trajectory.time, states.bias, bias_sd, b.streams)
    final, spread = dict(best.unknowns.fixed), {}
    held = [name for name in best.unknowns.considered if best.beliefs[name].estimate]
    n, segment = len(intervals), np.array([i.segment for i in intervals])
    ends, begun = np.array([0, n - 1]), np.flatnonzero(np.diff(segment)) + 1
    for name, walk in best.unknowns.walks.items():
        rows = np.concatenate([[0], begun, [n - 1]]) if walk else ends
        P = best.covariances(name)
        value = np.broadcast_to(states.calibration[name], (n, P.shape[1]))[rows]
        history[name] = calibration_history(
            name, trajectory.time[rows], value, np.sqrt(np.diagonal(P[rows], axis1=1, axis2=2))
        )
        final[name], spread[name] = value[-1], P[-1]
    for name in held:
        spread[name] = best.covariances(name)[-1]
        both = np.tile(final[name], (2, 1)), np.tile(np.sqrt(np.diag(spread[name])), (2, 1))
        history[name] = calibration_history(name, trajectory.time[ends], *both)
    best.forget_covariances()  # of a long dive they are large
    return Estimate(
        "smoothed",
        trajectory,
        calibration_estimates(
            best.beliefs, [s for s in b.streams if s in {*best.blocks, "imu"}], final, spread, relative
        ),
        history,
        residual_frame((s, b, residual_state(best, b), best.weights[s]) for s, b in best.blocks.items()),
        {
            "keyframes": n,
            "cost": best.solution.cost,
            "iterations": best.solution.iterations,
            "converged": best.solution.converged,
            "stretches_taken_out": [asdict(stretch) for stretch in best.solution.stretches],
            "runner_up": best.solution.runner_up if isfinite(best.solution.runner_up) else None,
            "bridged_intervals": sum(i.bridged for i in intervals),
            "calibration_covariance": _joint_calibration(best),
            "held_at_prior": held,
            "considered": [name for name in best.unknowns.considered if name not in held],
        },
    )


def _joint_calibration(best: Optimum) -> dict[str, Any] | None:
    """What is estimated, jointly, at the end of the dive; None where nothing is.

    Returns
    -------
    dict : ``labels`` (c), ``prior_sd`` (c) and ``covariance`` (c x c), radians and SI
    """
    names = best.unknowns.estimated
    if not names:
        return None
    prior = joint_prior_sd(best, len(best.intervals) - 1)
    sd = np.concatenate([prior[name] for name in names])
    own = slice(NEWEST, NEWEST + len(sd))
    return {
        "labels": [label for name in names for label in best.beliefs[name].variable.labels],
        "prior_sd": sd.tolist(),
        "covariance": best.newest_covariance()[own, own].tolist(),
    }
