"""A whole dive: from a log and a configuration to its estimates."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from rovgraph.check import Finding
from rovgraph.config import Config
from rovgraph.diagnosis import (
    Alarm,
    Evidence,
    Statistic,
    Verdict,
    find_advice,
    find_alarms,
    statistics,
    verdict_of,
)
from rovgraph.diagnosis.unstated_noise import UnstatedNoise, find_errors, find_noise
from rovgraph.engine.chain_optimum import ChainOptimum
from rovgraph.engine.constant_velocity import LONGEST_CRUISED_S
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.lasting import Rival
from rovgraph.engine.optimum import Optimum
from rovgraph.engine.stretches import Searches
from rovgraph.engine.unknowns import unknowns
from rovgraph.engine.variance_sources import variance_sources
from rovgraph.estimators.attitude_gaps import AttitudeGap, without_attitude_gaps
from rovgraph.estimators.eskf.error_state import REINITIALISE_AT_S, ErrorStateFilter, replay
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.initialise import initialise
from rovgraph.estimators.smoother import BatchSmoother, smoothed
from rovgraph.log import Log
from rovgraph.log.frozen import FrozenStretch, without_frozen
from rovgraph.process import give_back
from rovgraph.progress import Progress, no_progress
from rovgraph.state import State
from rovgraph.trajectory import Trajectory

if TYPE_CHECKING:
    from rovgraph.estimators.incremental import IncrementalEstimator


@dataclass(frozen=True)
class Dive:
    """The estimates of a dive.

    Attributes
    ----------
    estimates : "smoothed" and "filtered" as requested, and "dead_reckoning"
    initial : effective configuration, start and assumptions
    left_out : (sensor, reason) -> count of measurements that never reached the graph
    frozen : measurements that are none, such as values that repeat; ignored too
    statistics : numbers that healthy dives keep small
    """

    estimates: list[Estimate]
    initial: InitialConditions
    left_out: dict[tuple[str, str], int]
    frozen: list[FrozenStretch]
    statistics: list[Statistic]

    @cached_property
    def alarms(self) -> list[Alarm]:
        """Alarms of the dive, causes before their consequences."""
        return find_alarms(self.statistics, float(self.estimates[0].trajectory.time[0]))

    @cached_property
    def advice(self) -> list[Alarm]:
        """What could be stated better, which is no evidence of error."""
        return find_advice(self.statistics)

    @property
    def verdict(self) -> Verdict:
        """trusted, doubtful or wrong."""
        return verdict_of(self.alarms)

    @property
    def warnings(self) -> list[str]:
        """The alarms, a line each with cause and remedy."""
        return [alarm.text for alarm in self.alarms]

    @property
    def assumptions(self) -> list[str]:
        """Assumptions and counts of ignored measurements, a line each."""
        counts = sorted(self.left_out.items())
        left_out = [f"left out {n} of {sensor}: {why}" for (sensor, why), n in counts]
        return self.initial.assumptions + _taken_as_exact(self.initial) + left_out


def smooth(
    log: Log,
    config: Config,
    estimate: str = "both",
    progress: Progress = no_progress,
    findings: Sequence[Finding] = (),
) -> Dive:
    """Estimate a dive: what ``rovgraph smooth`` does.

    Parameters
    ----------
    log, config : the dive, and what is believed of vehicle and sensors
    estimate : "smoothed", "filtered" or "both"
    progress : called now and then
    findings : of the check of the log, which the verdict counts

    Raises
    ------
    InputError : the log lacks what is needed, or does not determine some variable
    """
    log, frozen = without_frozen(log, config)
    log, gaps = without_attitude_gaps(log, config)
    known = _Known(log, initialise(log, config), frozen, gaps, findings)
    dive, best = _solve(known, estimate, progress)
    for search in (find_noise, find_errors) if config.graph.find_noise else ():
        if not isinstance(best, ChainOptimum):
            break
        found, rivals = search(best, dive.initial.config, dive.alarms)
        if found:
            known = known.with_found(found, rivals, best.state, dive.estimates[0].trajectory)
            del dive, best  # a long dive is not kept twice
            dive, best = _solve(known, estimate, progress)
    if isinstance(best, ChainOptimum):
        best = best.without_what_is_at_hand()
        give_back()
        dive = _with_main(dive, variance_sources=_sources_where_largest(dive.estimates[0].trajectory, best))
    return _saying(dive, known.found) if known.found else dive


@dataclass(frozen=True)
class _Known:
    """A dive, and what its earlier solutions have revealed.

    Attributes
    ----------
    log, initial, frozen, gaps, findings : the dive
    found, rivals : what is believed since, and what would explain it as clearly
    states, before : of the solution before: State of its keyframes, and its track; None = there is none
    """

    log: Log
    initial: InitialConditions
    frozen: list[FrozenStretch]
    gaps: list[AttitudeGap]
    findings: Sequence[Finding]
    found: tuple[UnstatedNoise, ...] = ()
    rivals: tuple[Rival, ...] = ()
    states: State | None = None
    before: Trajectory | None = None

    def with_found(
        self, found: Sequence[UnstatedNoise], rivals: Sequence[Rival], states: State, before: Trajectory
    ) -> "_Known":
        """The same, with what its newest solution has revealed."""
        initial = self.initial
        for one in found:
            initial = initial.believing(one.beliefs)
        return replace(
            self,
            initial=initial,
            found=(*self.found, *found),
            rivals=(*self.rivals, *rivals),
            states=states,
            before=self.before or before,
        )


def _sources_where_largest(track: Trajectory, best: ChainOptimum) -> dict[str, object]:
    """What brings the horizontal variance, at the keyframe where it is largest; see `variance_sources`."""
    variance = track.cov_p[:, 0, 0] + track.cov_p[:, 1, 1]
    keyframe = int(np.searchsorted(best.problem.time, track.time[np.argmax(variance)]))
    keyframe = min(keyframe, len(best.problem) - 1)
    return {"time_s": float(best.problem.time[keyframe]), "m2": variance_sources(best, keyframe)}


def _with_main(dive: Dive, **more: object) -> Dive:
    """The dive with more in the summary of its main estimate."""
    main = dive.estimates[0]
    return replace(dive, estimates=[replace(main, summary={**main.summary, **more}), *dive.estimates[1:]])


def _solve(known: _Known, estimate: str, progress: Progress) -> tuple[Dive, Optimum | None]:
    """The dive as it is believed to be, and the optimum of its smoothed estimate where a batch solver found it."""
    initial, log = known.initial, known.log
    batch = assemble(log, initial)
    if known.states is not None and len(known.states) != len(batch.problem):  # stamps stand elsewhere than they did
        known = replace(known, states=None)
    if initial.config.graph.solver == "isam2":
        solver = _isam2(batch, progress)
        best = solver.optimum() if estimate != "filtered" else None
        estimates = [] if best is None else [smoothed(best, solver.initial)]
        if estimate != "smoothed":
            estimates.append(solver.filtered())
    else:
        estimates, states, best = [], known.states, None
        passed = _filter(batch, progress) if estimate != "smoothed" else None
        batch.forget_motion_covariances()
        if passed is not None:
            estimates.append(passed.solve())
            if states is None and not batch.time_offsets.lags:
                states = passed.states()  # where the filter went is close by
            passed = None  # of a long dive it is large
        give_back()
        if estimate != "filtered":
            progress("smoothing", 0.5)
            best = batch.optimum(states)
            del states
            estimates.insert(0, smoothed(best, initial))
            give_back()
    left_out = _left_out(batch, known.frozen, known.gaps)
    revealed = [(one.sensor, one.cause) for one in reversed(known.found)]  # what moves the track most: errors that last
    seen = known.frozen, log, known.gaps, left_out, known.findings, revealed, known.before, known.rivals
    numbers = statistics(Evidence(initial, estimates, (best or batch).problem, best, *seen))
    if any(one.kind == "rivals" and one.severity for one in numbers) and best is not None:
        estimates = [_covering(estimate, known.rivals, best) for estimate in estimates]
    return Dive([*estimates, batch.dead_reckoning()], initial, left_out, known.frozen, numbers), best


def _covering(estimate: Estimate, rivals: Sequence[Rival], best: Optimum) -> Estimate:
    """An estimate whose sd covers where rivals among the explanations put the track."""
    track = estimate.trajectory
    cov_p = track.cov_p.copy()
    for rival in rivals:
        if len(rival.p_n) == len(track):
            d = (rival.p_n - best.state.p_n)[:, :2]
            cov_p[:, :2, :2] += d[:, :, None] * d[:, None, :]
    return replace(estimate, trajectory=replace(track, cov_p=cov_p))


def _saying(dive: Dive, found: Sequence[UnstatedNoise]) -> Dive:
    """A dive that says what noise was found in it."""
    initial = replace(dive.initial, assumptions=[*(one.text for one in found), *dive.initial.assumptions])
    return replace(_with_main(dive, noise_found=[one.as_dict() for one in found]), initial=initial)


def assemble(log: Log, initial: InitialConditions, searches: Searches | None = None) -> BatchSmoother:
    """All keyframes of a log and what lies between them; ``searches`` as of `BatchSmoother`."""
    batch = BatchSmoother(initial, log, searches=searches or Searches())
    give_back()
    return batch


def _left_out(batch: BatchSmoother, frozen: list[FrozenStretch], gaps: list[AttitudeGap]) -> dict[tuple[str, str], int]:
    """What never reached the graph, and why."""
    counts = dict(batch.left_out)
    for stretch in frozen:
        why = (stretch.sensor, stretch.reason)
        counts[why] = counts.get(why, 0) + len(stretch.time)
    for gap in gaps:
        if gap.pings:
            why = ("dvl", f"no {gap.part} for more than {LONGEST_CRUISED_S:g} s")
            counts[why] = counts.get(why, 0) + gap.pings
    return counts


def _taken_as_exact(initial: InitialConditions) -> list[str]:
    """What iSAM2's filtered estimate does not doubt although the configuration does, in a line."""
    config = initial.config
    names = unknowns(initial.beliefs, initial.instruments).considered if config.graph.solver == "isam2" else ()
    return (
        [f"the filtered estimate of iSAM2 takes these considered variables as exact: {', '.join(names)}"]
        if names
        else []
    )


def _filter(batch: BatchSmoother, progress: Progress) -> ErrorStateFilter:
    filtering = partial(progress, "filtering")
    if not batch.time_offsets.lags:
        return replay(batch.problem, batch.initial, REINITIALISE_AT_S, filtering)
    estimator = ErrorStateFilter(batch.initial, REINITIALISE_AT_S)
    estimator.take(batch.log, filtering)  # learns how late stamps are while it goes on
    return estimator


def _isam2(batch: BatchSmoother, progress: Progress) -> "IncrementalEstimator":
    """One pass of iSAM2, or two where late stamps were found to belong elsewhere."""
    from rovgraph.estimators.incremental import run_isam2  # GTSAM is slow to load, and not everywhere to be had

    progress("incremental smoothing", 0.0)
    report = partial(progress, "incremental smoothing")
    solver = run_isam2(batch.problem, batch.initial, report)
    again = batch.placed_again(solver.latest().calibration)
    if again is not None:
        solver = run_isam2(again.problem, again.initial, report)
    return solver
