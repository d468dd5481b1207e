"""Re-initialises the filter from the smoothed dive so far, which a thread computes while measurements arrive.

The smoothed dive also shows wrong constants and errors that last, which the filter cannot show. It is examined for
alarms, as `rovgraph smooth` examines a whole dive. Where crossovers were asked for, it is also smoothed after each line
and matched (`rovgraph.live.crossovers`).
"""

import time as host
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np

from rovgraph.diagnosis.alarm import Statistic, Verdict
from rovgraph.diagnosis.constants import contradicted_constants_in, earth_rate_of
from rovgraph.diagnosis.statistics import find_alarms
from rovgraph.diagnosis.unstated_noise import unstated
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.error_state import REINITIALISE_AT_S, reinitialised
from rovgraph.inference.filter import FilterEngine
from rovgraph.inference.filter_step import Gaussian, states_of
from rovgraph.inference.fixed_lag import FilterSnapshot, FixedLag
from rovgraph.inference.optimum import Optimum
from rovgraph.inference.score_test import as_chain
from rovgraph.inference.trajectory import Trajectory
from rovgraph.live.crossovers import NOT_COMPUTED, LiveCrossovers, LiveMatch, LiveSurvey
from rovgraph.model.origin import Origin
from rovgraph.model.state import BIAS, COLUMNS, VELOCITY
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.problem import Problem
from rovgraph.rules import RULES

Keyframe = tuple[int, Array, Array]  # its index, state vector and calibration vector
_Smoothed = tuple[Gaussian, list[Statistic], Optimum]
_Work = tuple[LiveMatch | None, _Smoothed | None]

SEARCHED_UNTIL_S = 500.0  # for noise, which takes seconds of a core in longer dives, and has shown by then
FREED = 20  # keyframes, after each new one, once no re-initialisation needs them: thousands at once take 40 ms


@dataclass(frozen=True)
class Adopted:
    """A keyframe from which the filter continues.

    Attributes
    ----------
    smoothed, filtered : by the smoothed dive so far, and as the filter had it
    shown : what the smoothed dive shows of constants and noise
    time, p_n : ndarray, shapes (n,), (n, 3), of the smoothed dive's keyframes, and where they are, at the IMU
    """

    smoothed: Trajectory
    filtered: Trajectory
    shown: list[Statistic]
    time: Array
    p_n: Array


@dataclass
class Reinitialisations:
    """Smooths the dive so far at the times of `REINITIALISE_AT_S`, and hands the result to the filter.

    Attributes
    ----------
    patient : wait for the thread, so that a replay can be repeated
    crossovers : None = nothing is matched
    news : what went wrong, one line each, since it was last emptied
    adopted, crossed : what the filter continues from, and what crossovers said, until these are taken
    waited : for the thread, which only a replay does that is faster than it [s]
    """

    patient: bool
    crossovers: LiveCrossovers | None = None
    news: list[str] = field(default_factory=list)
    adopted: "Adopted | None" = None
    crossed: LiveMatch | None = None
    waited: float = 0.0

    def __post_init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="reinitialisation")
        self._due = list(REINITIALISE_AT_S)
        self._passed: list[Keyframe] = []
        self._shown: list[Statistic] = []  # by the newest smoothed dive
        self._running: tuple[int, bool, Future[_Work]] | None = None

    def take(self, snapshot: FilterSnapshot) -> None:
        """Remember a keyframe that the lag has passed, as long as any reinitialisation is to come."""
        if self.pending:
            self._passed.append(_keyframe(snapshot))
        if self.crossovers is not None:
            self.crossovers.passed(snapshot)

    def step(self, engine: FixedLag, dvl_contradicted: bool, origin: Origin | None, verdict: Verdict) -> float:
        """After a keyframe of the engine; the time waited for the thread, as only a fast replay does [s].

        Parameters
        ----------
        engine : the filter
        dvl_contradicted : of `_smoothed`
        origin, verdict : of the dive so far, for `LiveCrossovers.survey`
        """
        before = self.waited
        if self._running is None and self.pending:
            self._begin(engine, dvl_contradicted, origin, verdict)
        if self._running is not None:
            try:
                self._adopt(engine, *self._running)
            except InputError as error:
                self.news.append(f"the filter is reinitialised no more ({error}); it goes on as it is")
                self._stop()
        if not self.pending:
            del self._passed[-FREED:]
        return self.waited - before

    @property
    def pending(self) -> bool:
        """Whether any reinitialisation is to come, so that the dive has to be kept."""
        return bool(self._due) or self.crossovers is not None

    def again(self) -> None:
        """Start the smoothing again, for a filter with more sensors."""
        if self._running is not None and self.crossovers is not None:
            self.crossovers.due = True
        self._running = None

    def anew(self, engine: FixedLag) -> None:
        """Smooth at once, and now and then as from the start, for a filter that has found what lies far off."""
        since = engine.oldest().time - float(engine.assembly.problem.time[0])
        if self._due:
            self._due = sorted({*self._due, since, *(since + after for after in REINITIALISE_AT_S)})

    def close(self) -> None:
        """Wait for nothing any more; no keyframe comes after it."""
        self._stop()
        self._passed = []

    def _stop(self) -> None:
        """Smooth no more; `step` frees the keyframes."""
        self._due, self._running, self.crossovers = [], None, None
        self._thread.shutdown(wait=False, cancel_futures=True)

    def _begin(self, engine: FixedLag, dvl_contradicted: bool, origin: Origin | None, verdict: Verdict) -> None:
        """Have the dive up to the oldest keyframe smoothed that the filter can continue from, if it is due."""
        oldest, dive, crossovers = engine.oldest(), engine.assembly.problem, self.crossovers
        due = bool(self._due) and oldest.time - float(dive.time[0]) >= self._due[0]
        if not due and (crossovers is None or crossovers.held or not crossovers.due):
            return
        survey = None if crossovers is None else crossovers.survey(origin, verdict)
        waiting = [_keyframe(snapshot) for snapshot in engine.snapshots if snapshot.index <= oldest.index]
        keyframes, dive = [*self._passed, *waiting], dive.upto(engine.place(oldest) + 1)
        about = self._shown, dvl_contradicted, survey, due
        self._running = oldest.index, due, self._thread.submit(_smoothed, engine.filter, dive, keyframes, *about)

    def _adopt(self, engine: FixedLag, index: int, due: bool, future: "Future[_Work]") -> None:
        """Continue from the thread's result, if ready; the keyframes that the lag has passed since are filtered."""
        if not self.patient and not future.done():
            return
        began = host.perf_counter()
        self.crossed, found = future.result()
        self.waited += host.perf_counter() - began
        self._running = None
        if due:
            self._due.pop(0)
        if found is not None:
            known, self._shown, best = found
            oldest, gates, dive = engine.oldest().index, dict[str, float](), engine.assembly.problem
            for k in range(index + 1, oldest + 1):
                known = engine.filter.step(dive, k - engine.assembly.forgotten, known, gates).filtered
            newest = max(index, oldest)
            before = next((snapshot for snapshot in engine.snapshots if snapshot.index == newest), None)
            if engine.adopt(newest, known) and before is not None:
                after, filtered = (engine.trajectory([before.keyframe], [one]) for one in (known, before.known))
                self.adopted = Adopted(after, filtered, self._shown, best.problem.time, best.state.p_n)
        if not self.pending:
            self._stop()


def _keyframe(snapshot: FilterSnapshot) -> Keyframe:
    return snapshot.index, snapshot.known.x, snapshot.known.c


def _smoothed(
    engine: FilterEngine,
    dive: Problem,
    keyframes: Sequence[Keyframe],
    before: list[Statistic],
    dvl_contradicted: bool,
    survey: LiveSurvey | None,
    due: bool,
) -> _Work:
    """The newest of some keyframes, from all data so far, and what these show.

    Parameters
    ----------
    dive, keyframes : the dive so far
    before : what fewer keyframes have shown
    dvl_contradicted : the DVL's axes or clock are wrong, which looks like noise and like another place of the DVL
    survey : to be matched
    due : the dive is to be smoothed whether there is anything to match or not

    Returns
    -------
    what crossovers say; the keyframe, what is shown, and the smoothed dive, None where the filter goes on as it is
    """
    states = states_of(np.array([x for _, x, _ in keyframes]), np.array([c for _, _, c in keyframes]))
    crossed = None if survey is None else survey.refused(engine.initial, dive, states)
    if not due and crossed is not None:
        return crossed, None
    known, best = reinitialised(engine, dive, states)
    shown = _shown(best, engine.initial, before, dvl_contradicted)
    if survey is not None and crossed is None:
        crossed = NOT_COMPUTED
        with suppress(InputError, np.linalg.LinAlgError):
            crossed = survey.match(engine, best, shown)
        if not due and not survey.used and crossed.known is None:
            return crossed, None
    return crossed, (known if crossed is None or crossed.known is None else crossed.known, shown, best)


def _shown(
    best: Optimum, initial: InitialConditions, before: list[Statistic], dvl_contradicted: bool
) -> list[Statistic]:
    """Constants at wrong values and unstated noise, by the smoothed dive so far."""
    begin, end = float(best.problem.time[0]), float(best.problem.time[-1])
    if end - begin < RULES["held"].from_s:
        return []
    config, variance = initial.config, np.diag(best.newest_covariance())
    v_sd = float(np.sqrt(np.median(variance[COLUMNS[VELOCITY]])))
    bias_sd = float(np.sqrt(variance[COLUMNS[BIAS]][3:].min()))
    held: list[Statistic] = []
    noise: list[Statistic] = []
    # what the dive does not determine shows nothing either, and an examination that fails is no reason to stop
    with suppress(InputError, np.linalg.LinAlgError):
        held += contradicted_constants_in(as_chain(best, initial), config, v_sd, begin, end)
    with suppress(InputError, np.linalg.LinAlgError):
        if end - begin > SEARCHED_UNTIL_S:
            noise += [one for one in before if one.kind == "unstated"]
        elif config.graph.find_noise and isinstance(best, ChainOptimum) and not dvl_contradicted:
            rivals = [*held] if config.environment.earth_rotation else [*held, earth_rate_of(bias_sd, begin, end)]
            noise += unstated(best, config, find_alarms(rivals, begin))
    found = {one.sensor for one in noise}  # likelier than what is held
    return [*(one for one in held if one.sensor not in found), *noise]
