"""A whole dive: from a log and a configuration to its estimates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from rovgraph.config import Config
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.estimators.error_state import PROGRESS_EVERY, REINITIALISE_AT_S, ErrorStateFilter, replay
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.incremental import IncrementalEstimator
from rovgraph.estimators.initialise import InitialConditions, initialise
from rovgraph.estimators.smoother import BatchSmoother
from rovgraph.log import Log
from rovgraph.workers import starting, workers

Progress = Callable[[str, float], None]


def no_progress(what: str, done: float) -> None:
    """Shows nothing. ``what`` is being done, ``done`` goes from 0 to 1."""


@dataclass(frozen=True)
class Dive:
    """The estimates of a dive.

    Attributes
    ----------
    estimates : "smoothed" and "filtered" as asked for, and "dead_reckoning"
    beginning : effective configuration, start and assumptions
    left_out : (sensor, reason) -> count of measurements that never reached the graph
    """

    estimates: list[Estimate]
    beginning: InitialConditions
    left_out: dict[tuple[str, str], int]

    @property
    def assumptions(self) -> list[str]:
        """What was assumed and what was left out, a line each."""
        counts = sorted(self.left_out.items())
        return self.beginning.assumptions + [f"left out {n} of {sensor}: {why}" for (sensor, why), n in counts]


def smooth(
    log: Log, config: Config, estimate: str = "both", progress: Progress = no_progress, parallel: bool = False
) -> Dive:
    """Estimate a dive: what ``rovgraph smooth`` does.

    Parameters
    ----------
    log, config : the dive, and what is believed of vehicle and sensors
    estimate : "smoothed", "filtered" or "both"
    progress : called now and then
    parallel : filter in a second process while this one smooths

    Raises
    ------
    InputError : the log lacks what is needed, or does not determine some variable
    """
    beginning = initialise(log, config)
    if estimate == "both" and parallel:
        with workers(1) as pool:
            with starting():
                filtering = pool.submit(_filtered, log, beginning)
            batch = assemble(log, beginning)
            estimates = [_solve(batch, progress)]
            progress("filtering", 0.9)
            estimates.append(filtering.result())
    else:
        batch, estimates = assemble(log, beginning), []
        if estimate != "filtered":
            estimates.append(_solve(batch, progress))
        if estimate != "smoothed":
            estimates.append(_filter(batch, progress))
    return Dive([*estimates, batch.dead_reckoning()], beginning, dict(batch.assembler.left_out))


def assemble(log: Log, beginning: InitialConditions) -> BatchSmoother:
    """All keyframes of a log and what lies between them."""
    batch = BatchSmoother(beginning)
    batch.take(log)
    return batch


def _solve(batch: BatchSmoother, progress: Progress) -> Estimate:
    progress("smoothing", 0.1)
    if batch.beginning.config.graph.solver == "isam2":
        solver = run(batch.intervals, batch.beginning, progress)
        anew = batch.placed_again(solver.latest().calibration)
        return (solver if anew is None else run(anew.intervals, anew.beginning, progress)).solve()
    return batch.solve()


def _filtered(log: Log, beginning: InitialConditions) -> Estimate:
    return _filter(assemble(log, beginning))


def _filter(batch: BatchSmoother, progress: Progress = no_progress) -> Estimate:
    filtering = partial(progress, "filtering")
    measurements = batch.measurements
    if not measurements:
        return replay(batch.intervals, batch.beginning, REINITIALISE_AT_S, filtering).solve()
    estimator = ErrorStateFilter(batch.beginning, REINITIALISE_AT_S)  # learns how late they are while they come
    for k, measurement in enumerate(measurements):
        if estimator.add(measurement) and len(estimator.intervals) % PROGRESS_EVERY == 0:
            filtering(k / len(measurements))
    estimator.finish()
    return estimator.solve()


def run(
    intervals: Sequence[KeyframeInterval], beginning: InitialConditions, progress: Progress = no_progress
) -> IncrementalEstimator:
    """Feed intervals to iSAM2."""
    estimator = IncrementalEstimator(beginning)
    for interval in intervals:
        estimator.step(interval)
        if interval.index % PROGRESS_EVERY == 0:
            progress("incremental smoothing", interval.index / len(intervals))
    estimator.update()
    return estimator
