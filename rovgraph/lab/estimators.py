"""All estimators by name, as chains of stages, and how those of one dive or of many are run.

The first stage of a chain takes a log and a configuration, each of the others the result of the stage before.
Estimators whose chains begin alike share those results (filter and smoother of one pass, everything that needs the same
keyframes), those of one configuration the search for faulty intervals, and each is charged the time of its whole chain.
The thesis's filters of one kind, which have no chain, run side by side over all dives, and each is charged its share of
the time, by the seconds of its log.

Headings have the thesis's letters: a = magnetometer and the DVL's compass, b = the DVL's compass, c = the magnetometer.
"""

import difflib
import fnmatch
import itertools
import time
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from rovgraph.errors import InputError
from rovgraph.inference.error_state import REINITIALISE_AT_S, ErrorStateFilter, replay
from rovgraph.inference.estimate import Estimate
from rovgraph.inference.faulty_intervals import Searches
from rovgraph.inference.initialise import initialise
from rovgraph.inference.smoother import BatchSmoother, assemble
from rovgraph.lab.thesis import FILTERS, Filter, FilterJob, run_filters
from rovgraph.log import Log
from rovgraph.model.config import Config

Stage = Callable[[Any], Any]
Made = dict[tuple[object, ...], tuple[Any, float]]  # by chain of stages: what it made, and its processor time [s]

SHORTEST_S = 1e-3  # for which a log counts where time is shared


@dataclass(frozen=True)
class ChainTask:
    """Input of the first stage of a chain.

    Attributes
    ----------
    log, config : the dive, and what is believed of vehicle and sensors
    searches : for stretches of wrong measurements, of all estimators with the same configuration
    """

    log: Log
    config: Config
    searches: Searches = field(default_factory=Searches)


@dataclass(frozen=True)
class EstimatorSpec:
    """An estimator that can be asked for by name.

    Attributes
    ----------
    name : key of `ESTIMATORS`
    family : "dead reckoning", "thesis", "error state", "graph", "isam2"
    about : one line of what it is
    headings : "a", "b", "c", or "" for those of the configuration
    misalignment : whether the DVL's misalignment is estimated
    smoothing : whether an epoch is estimated from what came after it, too
    hydrodynamics : whether thrusters and drag are a source of velocity; False leaves it to the configuration
    whitened : its residuals are normalised by the innovation's own covariance, so that their
        squares sum to the NIS; otherwise by the measurement's noise alone
    stages : the chain, from `ChainTask` to `Estimate`
    variant : one of the thesis's filters, which has no chain
    """

    name: str
    family: str
    about: str
    headings: str
    misalignment: bool
    smoothing: bool
    stages: tuple[Stage, ...]
    whitened: bool = False
    hydrodynamics: bool = False
    variant: Filter | None = None

    @property
    def sharing_key(self) -> Hashable:
        """The same for estimators that are best asked for together."""
        return self.variant.kind if self.variant else (self.headings, self.misalignment, self.stages[0])

    @property
    def configuration_key(self) -> tuple[object, ...]:
        """The same for estimators that work with the same configuration."""
        return self.headings, self.misalignment, self.hydrodynamics

    def __call__(self, log: Log, config: Config) -> Estimate:
        """The estimate of one dive.

        Raises
        ------
        InputError : the log lacks what the estimator needs
        """
        outcome = next(outcomes([self], log, config))
        if outcome.error is not None:
            raise outcome.error
        assert outcome.estimate is not None
        return outcome.estimate

    def task(self, log: Log, config: Config, searches: Searches | None = None) -> ChainTask:
        """The log with the configuration that this estimator works with; ``searches`` as of `ChainTask`.

        Raises
        ------
        InputError : the log lacks a source of heading
        """
        if self.headings:
            config = with_headings(log, config, self.headings)
        if self.hydrodynamics:
            config = with_hydrodynamics(config)
        return ChainTask(log, with_misalignment(config, self.misalignment), searches or Searches())


@dataclass(frozen=True)
class Outcome:
    """Result of an estimator on one log.

    Attributes
    ----------
    named : the estimator
    estimate : or None where it failed
    error : why it failed, or None
    seconds : processor time of its chain, shared stages included, or its share of filters that
        ran side by side [s]
    """

    named: EstimatorSpec
    estimate: Estimate | None
    error: Exception | None
    seconds: float


def outcomes(estimators: Sequence[EstimatorSpec], log: Log, config: Config) -> Iterator[Outcome]:
    """Run estimators on one log; one that fails does not stop the others.

    Parameters
    ----------
    estimators : those of which `EstimatorSpec.sharing_key` is the same are best asked for together
    log, config : the dive, and what is believed of vehicle and sensors

    Yields
    ------
    Outcome : in the order of ``estimators``
    """
    return (outcome for _, outcome in outcomes_of_dives(estimators, [ChainTask(log, config)]))


def outcomes_of_dives(estimators: Sequence[EstimatorSpec], dives: Sequence[ChainTask]) -> Iterator[tuple[int, Outcome]]:
    """Run estimators on several logs, as `outcomes` does on one; so the filters of the thesis take less time.

    Yields
    ------
    index of the dive, Outcome : dive by dive, in the order of ``estimators``
    """
    side_by_side: dict[Filter, dict[tuple[int, str], Outcome]] = {}
    for k, dive in enumerate(dives):
        made: Made = {}
        searches: dict[Hashable, Searches] = defaultdict(Searches)
        for named in estimators:
            if named.variant is not None:
                kind = named.variant.kind
                if kind not in side_by_side:
                    those = [n for n in estimators if n.variant is not None and n.variant.kind == kind]
                    side_by_side[kind] = _side_by_side(those, dives)
                yield k, side_by_side[kind].pop((k, named.name))
                continue
            try:
                result, seconds = _run_chain(named, dive, made, searches[named.configuration_key])
                yield k, Outcome(named, result, None, seconds)
            except Exception as error:  # whatever an estimator runs into is a result of the comparison
                yield k, Outcome(named, None, error, float("nan"))


def _side_by_side(estimators: Sequence[EstimatorSpec], dives: Sequence[ChainTask]) -> dict[tuple[int, str], Outcome]:
    """Filters of one kind on all dives; by index of the dive and name."""
    out: dict[tuple[int, str], Outcome] = {}
    asked: dict[tuple[int, str], tuple[EstimatorSpec, FilterJob]] = {}
    for (k, dive), named in itertools.product(enumerate(dives), estimators):
        try:
            task = named.task(dive.log, dive.config)
            assert named.variant is not None
            asked[k, named.name] = named, FilterJob(named.variant, task.log, task.config)
        except Exception as error:
            out[k, named.name] = Outcome(named, None, error, float("nan"))
    began = time.process_time()
    done: list[Estimate | Exception]
    try:
        done = run_filters([a for _, a in asked.values()])
    except Exception as error:
        done = [error] * len(asked)
    spent = time.process_time() - began
    recorded = [
        0.0 if isinstance(d, Exception) else _recorded_s(a.log) for d, (_, a) in zip(done, asked.values(), strict=True)
    ]
    for (key, (named, _)), result, seconds in zip(asked.items(), done, recorded, strict=True):
        if isinstance(result, Exception):
            out[key] = Outcome(named, None, result, float("nan"))
        else:
            out[key] = Outcome(named, result, None, spent * seconds / sum(recorded))
    return out


def _recorded_s(log: Log) -> float:
    time = log["imu"].time
    return max(float(time[-1] - time[0]), SHORTEST_S)


def _run_chain(named: EstimatorSpec, dive: ChainTask, made: Made, searches: Searches) -> tuple[Any, float]:
    """The result of an estimator and its processor time; ``made`` keeps results by what led to them."""
    result: Any = named.task(dive.log, dive.config, searches)
    chain, total = named.configuration_key, 0.0
    for stage in named.stages:
        chain = (*chain, stage)
        if chain not in made:
            began = time.process_time() + searches.saved_s  # a search that was made before is charged again
            made[chain] = stage(result), time.process_time() + searches.saved_s - began
        result, seconds = made[chain]
        total += seconds
    return result, total


def with_headings(log: Log, config: Config, letter: str) -> Config:
    """A configuration with the heading sources that a letter stands for.

    The magnetometer's heading is the IMU's own (``ahrs``, which is made from it) where the
    log has no samples of the field, or the configuration prefers it.

    Raises
    ------
    InputError : the log lacks one of them
    """
    given = config.heading.sources or ()
    from_ahrs = "mag" not in log or ("ahrs" in given and "mag" not in given)
    magnetometer, compass = ("ahrs" if from_ahrs else "mag"), "dvl"
    if letter in "ac" and magnetometer not in log:
        raise InputError(f"{log.source}: no magnetometer (mag_x, mag_y, mag_z, or ahrs_yaw)")
    if letter in "ab" and "dvl_heading" not in log:
        raise InputError(f"{log.source}: no compass of the DVL (dvl_heading)")
    sources = {"a": (magnetometer, compass), "b": (compass,), "c": (magnetometer,)}[letter]
    return config.with_values(heading={"sources": sources})


def with_misalignment(config: Config, estimate: bool) -> Config:
    """A configuration that estimates the DVL's yaw, or holds it at its mean."""
    return config.with_values(calibration={"dvl_yaw": {"estimate": estimate}})


def with_hydrodynamics(config: Config) -> Config:
    """A configuration that uses thrusters and drag."""
    return config.with_values(graph={"hydrodynamics": True})


def assembled(task: ChainTask) -> BatchSmoother:
    """Keyframes of a log and what lies between them."""
    return assemble(task.log, initialise(task.log, task.config), searches=task.searches)


def stepped(batch: BatchSmoother) -> ErrorStateFilter:
    """The error-state filter over the same keyframes."""
    return replay(batch.problem, batch.initial)


def reinitialised(batch: BatchSmoother) -> ErrorStateFilter:
    """The same, going on from the smoothed dive so far now and then."""
    return replay(batch.problem, batch.initial, REINITIALISE_AT_S)


def incremental(batch: BatchSmoother) -> Any:
    """iSAM2 over the same keyframes: an `rovgraph.inference.graph.isam2.IncrementalEstimator`."""
    from rovgraph.inference.graph.isam2 import run_isam2  # GTSAM is slow to load, and not everywhere to be had

    return run_isam2(batch.problem, batch.initial, searches=batch.searches)


def filtered_by_isam2(estimator: Any) -> Estimate:
    """Each keyframe when it was the newest."""
    estimate: Estimate = estimator.filtered()
    return estimate


def smoothed_by_isam2(estimator: Any) -> Estimate:
    """All keyframes from the whole dive."""
    estimate: Estimate = estimator.solve()
    return estimate


_REINITIALISED = "filter reinitialised from the graph of the dive so far"
_LETTERS = {(True, True): "a", (False, True): "b", (True, False): "c"}  # magnetometer, compass
_WITH = {"a": "magnetometer and DVL compass", "b": "DVL compass alone", "c": "magnetometer alone"}


def _of_the_thesis(variant: Filter) -> EstimatorSpec:
    """One of the thesis's filters, which hold calibration at its means but for what are their states."""

    letter = _LETTERS.get((variant.magnetometer, variant.compass), "")
    about = (variant.about, letter, variant.misalignment, False)
    return EstimatorSpec(variant.name, "thesis", *about, stages=(), whitened=True, variant=variant)


def _variants(kind: str, family: str, about: str, smoothing: bool, *stages: Stage) -> list[EstimatorSpec]:
    """An estimator with each set of headings, and with the misalignment estimated."""
    held = [
        EstimatorSpec(f"{kind}-{letter}", family, f"{about}, {words}", letter, False, smoothing, (assembled, *stages))
        for letter, words in _WITH.items()
    ]
    words = f"{about}, misalignment estimated"
    return [*held, EstimatorSpec(f"{kind}-misalignment", family, words, "a", True, smoothing, (assembled, *stages))]


def _driven(kind: str, family: str, about: str, smoothing: bool, *stages: Stage) -> EstimatorSpec:
    """An estimator with thrusters and drag, and both headings."""
    name, words = f"{kind}-hydrodynamics", f"{about}, {_WITH['a']}, thrusters and drag"
    return EstimatorSpec(name, family, words, "a", False, smoothing, (assembled, *stages), hydrodynamics=True)


ESTIMATORS: dict[str, EstimatorSpec] = {
    named.name: named
    for named in (
        EstimatorSpec(
            "dead-reckoning",
            "dead reckoning",
            "DVL along the best compass, gyro levelled by gravity",
            "",
            False,
            False,
            (assembled, BatchSmoother.dead_reckoning),
        ),
        *(_of_the_thesis(variant) for variant in FILTERS.values()),
        *_variants("ekf", "error state", "error-state Kalman filter", False, stepped, ErrorStateFilter.solve),
        *_variants("rts", "error state", "its Rauch-Tung-Striebel smoother", True, stepped, ErrorStateFilter.smoothed),
        *_variants(
            "graph-filtered",
            "graph",
            _REINITIALISED,
            False,
            reinitialised,
            ErrorStateFilter.solve,
        ),
        *_variants("graph-smoothed", "graph", "factor graph, whole dive", True, BatchSmoother.solve),
        *_variants("isam2-filtered", "isam2", "iSAM2, each keyframe when new", False, incremental, filtered_by_isam2),
        *_variants("isam2-smoothed", "isam2", "iSAM2, whole dive at its end", True, incremental, smoothed_by_isam2),
        _driven("ekf", "error state", "error-state Kalman filter", False, stepped, ErrorStateFilter.solve),
        _driven("graph-smoothed", "graph", "factor graph, whole dive", True, BatchSmoother.solve),
    )
}


def select(names: Sequence[str] | None = None) -> list[EstimatorSpec]:
    """Estimators by name or pattern (``graph-*``), in the order of `ESTIMATORS`, each once.

    Without names all but those that need thrusters.

    Raises
    ------
    InputError : an unknown name; the message has the nearest and lists all
    """
    chosen = {name for name, named in ESTIMATORS.items() if names is None and not named.hydrodynamics}
    for name in names or ():
        matching = fnmatch.filter(ESTIMATORS, name)
        if not matching:
            near = difflib.get_close_matches(name, ESTIMATORS, 1, cutoff=0.0)
            raise InputError(f"unknown estimator {name!r}, nearest is {near[0]}; there are {', '.join(ESTIMATORS)}")
        chosen.update(matching)
    if not chosen:
        raise InputError(f"no estimator named; there are {', '.join(ESTIMATORS)}")
    return [named for name, named in ESTIMATORS.items() if name in chosen]
