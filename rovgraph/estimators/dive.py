"""A whole dive: from a log and a configuration to its estimates."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rovgraph.config import Config
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.incremental import IncrementalEstimator
from rovgraph.estimators.initialise import Beginning, initialise
from rovgraph.estimators.smoother import BatchSmoother
from rovgraph.graph.assembly import Interval
from rovgraph.log import Log

Progress = Callable[[str, float], None]
PROGRESS_EVERY = 50  # keyframes


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
    beginning: Beginning
    left_out: dict[tuple[str, str], int]

    @property
    def assumptions(self) -> list[str]:
        """What was assumed and what was left out, a line each."""
        counts = sorted(self.left_out.items())
        return self.beginning.assumptions + [f"left out {n} of {sensor}: {why}" for (sensor, why), n in counts]


def smooth(log: Log, config: Config, estimate: str = "both", progress: Progress = no_progress) -> Dive:
    """Estimate a dive: what ``rovgraph smooth`` does.

    Parameters
    ----------
    log, config : the dive, and what is believed of vehicle and sensors
    estimate : "smoothed", "filtered" or "both"
    progress : called now and then

    Raises
    ------
    InputError : the log lacks what is needed, or does not determine some variable
    """
    beginning = initialise(log, config)
    batch = BatchSmoother(beginning)
    progress("reading the log's motion", 0.0)
    for measurement in log.measurements():
        batch.add(measurement)
    batch.finish()
    estimates: list[Estimate] = []
    if estimate in ("smoothed", "both"):
        progress("smoothing", 0.0)
        isam2 = config.graph.solver == "isam2"
        estimates.append(batch.solve(run(batch.intervals, beginning, None, progress) if isam2 else None))
    if estimate in ("filtered", "both"):
        estimates.append(run(batch.intervals, beginning, config.graph.lag_s, progress).solve())
    progress("dead reckoning", 1.0)
    estimates.append(batch.dead_reckoning())
    return Dive(estimates, beginning, dict(batch.assembler.left_out))


def run(
    intervals: Sequence[Interval], beginning: Beginning, lag: float | None, progress: Progress = no_progress
) -> IncrementalEstimator:
    """Feed intervals to an incremental estimator: a replay of online."""
    estimator = IncrementalEstimator(beginning, lag)
    for interval in intervals:
        estimator.step(interval)
        if interval.index % PROGRESS_EVERY == 0:
            progress("filtering" if lag else "incremental smoothing", interval.index / len(intervals))
    return estimator
