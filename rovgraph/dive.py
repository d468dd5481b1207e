"""A whole dive: from a log and a configuration to all its estimates and the verdict."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from rovgraph.diagnosis.acoustics import find_head_errors
from rovgraph.diagnosis.alarm import Alarm, Statistic, Verdict, verdict_of
from rovgraph.diagnosis.beacons import BeaconPlaces, MirroredBeacon, find_beacons
from rovgraph.diagnosis.check import Finding
from rovgraph.diagnosis.evidence import Evidence
from rovgraph.diagnosis.statistics import find_advice, find_alarms, statistics
from rovgraph.diagnosis.trilateration import SAME_M
from rovgraph.diagnosis.unstated_noise import UnstatedNoise, find_errors, find_noise
from rovgraph.geometry import Array
from rovgraph.inference.attitude_gaps import AttitudeGap, without_attitude_gaps
from rovgraph.inference.bottom import bottom_of
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.chart import ChartFile, read_chart
from rovgraph.inference.correlated_noise import Rival
from rovgraph.inference.crossovers import Crossovers, with_crossovers
from rovgraph.inference.error_state import REINITIALISE_AT_S, ErrorStateFilter, replay
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.initialise import initialise
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.smoother import BatchSmoother, assemble, smoothed
from rovgraph.inference.trajectory import Trajectory
from rovgraph.inference.variance_sources import variance_sources
from rovgraph.log import Log
from rovgraph.log.frozen import FrozenStretch, without_frozen
from rovgraph.model.calibration import ACOUSTICS
from rovgraph.model.config import Config
from rovgraph.model.state import State
from rovgraph.problem.calibration_roles import unknowns
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.motion import LONGEST_CRUISED_S
from rovgraph.process import Progress, no_progress, stage

if TYPE_CHECKING:
    from rovgraph.inference.graph.isam2 import IncrementalEstimator


Search = Callable[[ChainOptimum, Config, Sequence[Alarm]], tuple[list[UnstatedNoise], list[Rival]]]


@dataclass(frozen=True)
class DiveEstimates:
    """The estimates of a dive.

    Attributes
    ----------
    estimates : "smoothed" and "filtered" as requested, and "dead_reckoning"
    initial : effective configuration, start and assumptions
    left_out : (sensor, reason) -> count of measurements that never reached the graph
    frozen : invalid values of a frozen sensor, such as values that repeat; ignored too
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
        """Advice on values that could be stated better, no evidence of error."""
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
) -> DiveEstimates:
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
    chart = read_chart(config.chart, log.origin)
    solver = _Solver(log, initialise(log, config), frozen, gaps, findings, estimate, progress, chart)
    solver.look_ahead()
    solver.solve()
    for search in (find_noise, find_errors) if config.graph.find_noise else ():
        if solver.learns_by(search):
            solver.solve()
    return solver.result()


@dataclass
class _Solver:
    """A dive that is solved, and solved again where its solution has revealed what was not believed.

    Attributes
    ----------
    log, frozen, gaps, findings, estimate, progress, chart : the dive, and what is asked for
    initial : how it begins, with what is believed
    found, rivals : what was revealed, and what would explain it as clearly
    beacons : where those may be whose places nobody stated
    mirrors : second places of these that the dive does not exclude
    before : the track that was smoothed before
    estimates, left_out, statistics : of the newest solution
    best : the optimum of its smoothed estimate, where a batch solver found it
    """

    log: Log
    initial: InitialConditions
    frozen: list[FrozenStretch]
    gaps: list[AttitudeGap]
    findings: Sequence[Finding]
    estimate: str
    progress: Progress
    chart: ChartFile | None = None
    found: tuple[UnstatedNoise, ...] = ()
    rivals: tuple[Rival, ...] = ()
    beacons: list[BeaconPlaces] = field(default_factory=list)
    mirrors: list[MirroredBeacon] = field(default_factory=list)
    before: Trajectory | None = None
    estimates: list[Estimate] = field(default_factory=list)
    left_out: dict[tuple[str, str], int] = field(default_factory=dict)
    statistics: list[Statistic] = field(default_factory=list)
    best: Optimum | None = None

    def look_ahead(self) -> None:
        """Believe what dead reckoning shows of an acoustic system, before the dive is solved."""
        if self.initial.instruments.keys().isdisjoint(ACOUSTICS):
            return
        problem = assemble(self.log, self.initial).problem
        beacons = find_beacons(self.log, problem, self.initial)
        found = find_head_errors(self.log, problem, self.initial) if self.initial.config.graph.find_noise else []
        for one in found:
            self.initial, self.found = self.initial.believing(one.beliefs), (*self.found, one)
        for beacon in beacons:
            self.initial = self.initial.believing(beacon.beliefs(self.initial, beacon.best))
            self.initial.assumptions.append(beacon.text)
        self.beacons = beacons

    def solve(self) -> None:
        """Estimate the dive as it is believed to be, from where the last optimum stands."""
        states = None if self.best is None else self.best.state
        self.estimates, self.best = [], None  # a long dive is not kept twice
        batch = assemble(self.log, self.initial)
        if states is not None and len(states) != len(batch.problem):  # stamps stand elsewhere than they did
            states = None
        if self.initial.config.graph.solver == "isam2":
            solver = _isam2(batch, self.progress)
            if self.estimate != "filtered":
                self.best = solver.optimum()
                self.estimates.append(smoothed(self.best, solver.initial))
            if self.estimate != "smoothed":
                self.estimates.append(solver.filtered())
        else:
            if self.estimate != "smoothed":
                filtered, passed = _filtered(batch, self.progress)
                self.estimates, states = [filtered], passed if states is None else states
            if not self.beacons:
                batch = batch.without_covariances()
            if self.estimate != "filtered" or any(beacon.other is not None for beacon in self.beacons):
                self.progress("smoothing", 0.5)
                self.best = batch.optimum(states)
                moved = self._mirrored(batch)
                if moved is not batch and self.estimates:
                    self.estimates = [_filtered(moved, self.progress)[0]]
                batch = moved
                if self.estimate != "filtered":
                    self.estimates.insert(0, smoothed(self.best, self.initial))
        self._judge(batch)

    def _mirrored(self, batch: BatchSmoother) -> BatchSmoother:
        """Solve the dive with the other place of beacons that may lie on either side of it; keep the likelier one."""
        self.mirrors = []
        for k, beacon in enumerate(self.beacons):
            if beacon.other is None or not isinstance(self.best, ChainOptimum):
                continue
            initial = self.initial.believing(beacon.beliefs(self.initial, beacon.other))
            other = replace(batch, initial=initial).optimum()
            if other.solution.cost < self.best.solution.cost:
                self.best, other, self.initial = other, self.best, initial
                batch = replace(batch, initial=initial)
                self.beacons[k] = replace(beacon, best=beacon.other, other=beacon.best)  # if the dive is solved again
            places = [np.reshape(one.state.calibration[beacon.variable], (-1, 2))[-1] for one in (self.best, other)]
            margin, apart = other.solution.cost - self.best.solution.cost, places[0] - places[1]
            if np.linalg.norm(apart) > SAME_M:
                mirror = MirroredBeacon(beacon.name, beacon.variable, places[1], apart, margin, other.state.p_n)
                self.mirrors += [mirror] if mirror.ambiguous else []
        return batch

    def _judge(self, batch: BatchSmoother) -> None:
        """Figures of the verdict; sds cover where rivals put the track."""
        self.left_out, best = _left_out(batch, self.frozen, self.gaps), self.best
        revealed = [(one.sensor, one.cause) for one in reversed(self.found)]  # first what moves the track most
        seen = self.frozen, self.log, self.gaps, self.left_out, self.findings, revealed, self.before, self.rivals
        unclear = [("range", mirror.cause, mirror.margin) for mirror in self.mirrors]
        self.statistics = statistics(
            Evidence(self.initial, self.estimates, (best or batch).problem, best, *seen, unclear)
        )
        if best is not None and any(one.kind == "rivals" and one.severity for one in self.statistics):
            self.estimates = [_covering(estimate, [r.p_n for r in self.rivals], best) for estimate in self.estimates]
        if best is not None and self.mirrors:
            tracks = [mirror.p_n for mirror in self.mirrors]
            self.estimates = [_covering_both(_covering(e, tracks, best), self.mirrors) for e in self.estimates]
        self.estimates.append(batch.dead_reckoning())

    def learns_by(self, search: Search) -> bool:
        """Whether a search finds in the optimum what was not believed, or a rival; it is believed from now on."""
        if not isinstance(self.best, ChainOptimum):
            return False
        found, rivals = search(self.best, self.initial.config, self.dive({}).alarms)
        for one in found:
            self.initial = self.initial.believing(one.beliefs)
        self.found, self.rivals = (*self.found, *found), (*self.rivals, *rivals)
        if found:
            self.before = self.before or self.estimates[0].trajectory
        return bool(found or rivals)

    def result(self) -> DiveEstimates:
        """The dive, with what brings its variance, and what was found in it."""
        more: dict[str, object] = {}
        if self.found:
            more["noise_found"] = [one.as_dict() for one in self.found]
        assumptions, found = [*(one.text for one in self.found), *self.initial.assumptions], None
        if self.initial.config.matches_bottom:
            text, found = self._cross()
            assumptions.insert(0, text)
            more |= {} if found is None else {"crossovers": found.as_dict()}
        if isinstance(self.best, ChainOptimum) and not (found and found.closures):  # they leave other sources
            more["variance_sources"] = _sources_where_largest(self.estimates[0].trajectory, self.best)
        return replace(self.dive(more), initial=replace(self.initial, assumptions=assumptions))

    def _cross(self) -> tuple[str, Crossovers | None]:
        """Correct the smoothed estimate by its crossovers; one line on what was used, and what they showed."""
        first, why = self.estimates[0], ""
        if first.kind != "smoothed" or first.posterior is None:
            why = "they need a smoothed track of a dive without places or iSAM2"
        elif self.rivals or self.mirrors:
            why = "another explanation of the dive is as likely"
        elif (verdict := self.dive({}).verdict) != "trusted":
            why = f"the verdict is {verdict}, and they would make the track more certain of its error"
        elif (bottom := bottom_of(self.log, self.initial.config, first)) is None:
            why = "the log has no ranges to the bottom"
        else:
            about = self.initial.beliefs, self.chart, self.log.origin or (0.0, 0.0)
            self.estimates[0], found = with_crossovers(first, bottom, *about)
            return found.text, found
        return f"crossovers: nothing is used: {why}", None

    def dive(self, more: Mapping[str, object]) -> DiveEstimates:
        """As it is believed to be, with more in the summary of its main estimate."""
        main, *others = self.estimates
        main = replace(main, summary={**main.summary, **more})
        return DiveEstimates([main, *others], self.initial, self.left_out, self.frozen, self.statistics)


def _sources_where_largest(track: Trajectory, best: ChainOptimum) -> dict[str, object]:
    """What brings the horizontal variance, at the keyframe where it is largest; see `variance_sources`."""
    variance = track.cov_p[:, 0, 0] + track.cov_p[:, 1, 1]
    keyframe = int(np.searchsorted(best.problem.time, track.time[np.argmax(variance)]))
    keyframe = min(keyframe, len(best.problem) - 1)
    return {"time_s": float(best.problem.time[keyframe]), "m2": variance_sources(best, keyframe)}


def _covering_both(estimate: Estimate, mirrors: Sequence[MirroredBeacon]) -> Estimate:
    """An estimate whose sds of beacons cover both of their places."""
    apart = {f"{m.variable}{tail}": m.apart[k] for m in mirrors for k, tail in enumerate(("_north", "_east"))}
    entries = [
        replace(entry, sd=float(np.hypot(entry.sd, apart.get(entry.label, 0.0)))) for entry in estimate.calibration
    ]
    return replace(estimate, calibration=entries)


def _covering(estimate: Estimate, rivals: Sequence[Array], best: Optimum) -> Estimate:
    """An estimate whose sd covers other places of the keyframes, shape (n, 3) each."""
    track, posterior = estimate.trajectory, estimate.posterior
    cov_p = track.cov_p.copy()
    for p_n in rivals:
        if len(p_n) == len(track):
            d = (p_n - best.state.p_n)[:, :2]
            cov_p[:, :2, :2] += d[:, :, None] * d[:, None, :]
            posterior = posterior and posterior.also(d)
    return replace(estimate, trajectory=replace(track, cov_p=cov_p), posterior=posterior)


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


@stage
def _filtered(batch: BatchSmoother, progress: Progress) -> tuple[Estimate, State | None]:
    """The filtered estimate, and where it went, close by the optimum; None where stamps moved meanwhile."""
    filtering = partial(progress, "filtering")
    if batch.time_offsets.lags:
        estimator = ErrorStateFilter(batch.initial, REINITIALISE_AT_S)
        estimator.take(batch.log, filtering)  # learns how late stamps are while it goes on
        return estimator.solve(), None
    estimator = replay(batch.problem, batch.initial, REINITIALISE_AT_S, filtering)
    return estimator.solve(), estimator.states()


def _isam2(batch: BatchSmoother, progress: Progress) -> "IncrementalEstimator":
    """One pass of iSAM2, or two where late stamps were found to belong elsewhere."""
    from rovgraph.inference.graph.isam2 import run_isam2  # GTSAM is slow to load, and not everywhere to be had

    progress("incremental smoothing", 0.0)
    report = partial(progress, "incremental smoothing")
    solver = run_isam2(batch.problem, batch.initial, report)
    again = batch.placed_again(solver.latest().calibration)
    if again is not None:
        solver = run_isam2(again.problem, again.initial, report)
    return solver
