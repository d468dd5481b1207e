"""iSAM2 over a whole dive: an incremental graph that is a filter at its newest keyframe and a smoother behind it.

Each interval is predicted with the IMU from the graph's own newest keyframe, and measurements are gated by their
innovations against the graph's own joint covariance there (`FilterEngine.step`, from what iSAM2 knows); what was let
in becomes a factor, and after the update the newest keyframe is the filtered estimate. In the end all keyframes
are smoothed: the smoother's Gauss-Newton goes on from iSAM2's estimate until it rests.

Factors that were linearised at different headings and mountings claim to know what nothing has shown (Huang,
Mourikis and Roumeliotis 2010). So from time to time iSAM2's estimate is compared with the point of linearisation.
Where attitude or calibration are off by a part of their sd, all is relinearised from there on. A constant that all
keyframes share would make every update touch the whole tree, so each constant of the calibration is a row of nearly
equal ones, one for each segment of time.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from rovgraph.calibration import LAYOUT, TABLE, Belief
from rovgraph.engine.assembly import assembly_of
from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import FilterStep, Gates, Gaussian, Met, states_of
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.optimum import Optimum
from rovgraph.engine.problem import Problem
from rovgraph.engine.rate_noise import with_arm_of_rates
from rovgraph.engine.stretches import Searches
from rovgraph.estimators.eskf.history import FilterHistory
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.optimum import optimum
from rovgraph.estimators.smoother import newest_calibration, smoothed
from rovgraph.graph.incremental import Incremental
from rovgraph.graph.places import associated_optimum, resolved
from rovgraph.kernels.layout import MOTION
from rovgraph.log import Measurement
from rovgraph.state import PLACE, State

UPDATE_S = 1.0  # of the dive, between updates of iSAM2, where it need not tell of every keyframe
# since the start, when the dive so far is solved with all its measurements: a gate may have been wrong before [s]
OPTIMUM_AT_S = (5.0, 10.0, 20.0, 40.0, 80.0)
CHECK_S = 1.0  # of the dive, at least, between looks for what is linearised too far from the estimate
CHECK_SHARE = 0.03  # and as a part of the dive so far
ANGLE_TOLERANCE = 0.01  # how far that may be [rad]
TOLERANCE = 0.02  # of what is no angle [1, m, s...]
SHARE = 0.2  # or as a part of its sd: less than that is not worth it while little is known
RELINEARISATIONS = 2  # at a time
MOST = 1000  # newest keyframes that are relinearised, which bounds what an update takes
STIFF = 2e-4  # walk of a constant, as a part of its prior's sd per root second


@dataclass
class IncrementalEstimator:
    """iSAM2 over the whole dive, fed measurement by measurement or interval by interval.

    Attributes
    ----------
    initial : of `rovgraph.estimators.initialise.initialise`
    update_s : of the dive, between updates of iSAM2; in between, the filter goes on from it [s]
    searches : of other solutions of the dive, as configured the same
    problem : the dive, as far as it has been taken
    known : Gaussian of the newest keyframe
    history : the filtered estimate of every keyframe
    """

    initial: InitialConditions
    update_s: float = 0.0
    searches: Searches | None = None

    def __post_init__(self) -> None:
        b = self.initial
        self.filter = FilterEngine(b, considers=False)
        self.known = self.filter.start()
        self.history = FilterHistory(self.filter)
        self.gates: Gates = {}
        self.engine = Incremental(self.filter, {name: _stiff(belief) for name, belief in b.beliefs.items()})
        self.assembly = assembly_of(b)
        self.problem = self.assembly.problem
        self._count = 0  # keyframes that have been taken
        self._numbers = np.empty(0, np.int64)  # of the places that measurements are of, as the filter has it
        names = self.filter.unknowns.estimated
        tolerance = [np.full(v.dim, ANGLE_TOLERANCE if v.angular else TOLERANCE) for v in (TABLE[n] for n in names)]
        self._tolerance = np.concatenate([np.empty(0), *tolerance])
        self._optima = list(OPTIMUM_AT_S)
        self._due = -np.inf  # when to look for what is linearised too far from the estimate [s]

    @property
    def updated(self) -> int:
        """Newest keyframe that iSAM2 has, -1 = none."""
        return self.engine.updated

    def add(self, measurement: Measurement) -> int:
        """Take a measurement, whose time is not before that of others; how many keyframes it completes."""
        self.assembly.insert(measurement)
        return self._take(self.assembly.extend())

    def finish(self) -> int:
        """Close the last interval; how many keyframes that completes."""
        made = self._take(self.assembly.extend(finish=True))
        self.update()
        return made

    def step(self, problem: Problem, k: int) -> FilterStep:
        """Take an interval: predicted and gated from what iSAM2 knows of the keyframe before, then given to it."""
        done = self.filter.step(problem, k, self.known, self.gates)
        self.take(problem, k, done.filtered, done.met)
        self.history.append(self.known, done.met)
        return done

    def take(self, problem: Problem, k: int, known: Gaussian, met: Met) -> None:
        """Take a keyframe with what of its measurements was let in.

        Parameters
        ----------
        problem, k : the dive so far, and its keyframe
        known : where to linearise it at first
        met : its measurements
        """
        self.known, self.problem, self._count = known, problem, k + 1
        self._numbers = np.append(self._numbers, met.number)
        let_in = (met.weight > 0.0) | (met.number >= 0)
        self.engine.add(problem, k, known, met.index[let_in], self._numbers)
        if problem.time[k] - problem.time[max(self.updated, 0)] >= self.update_s:
            self.update()

    def update(self) -> None:
        """Have iSAM2 take what has come since; the filter goes on from its newest keyframe."""
        if self.updated == self._count - 1:
            return
        self.engine.update()
        self._know()
        now = float(self.problem.time[self._count - 1])
        since = now - float(self.problem.time[0])
        if self._optima and since >= self._optima[0]:
            self._optima.pop(0)
            self._restart()
        elif now >= self._due:
            self._due = now + max(CHECK_S, CHECK_SHARE * since)
            self._relinearise()

    def _relinearise(self) -> None:
        """Move the point to the estimate as far back as it is off."""
        for _ in range(RELINEARISATIONS):
            sd = np.sqrt(np.diagonal(self.known.P)[: self.filter.layout.size])
            turn = max(ANGLE_TOLERANCE, SHARE * float(sd[:3].max()))
            off = self.engine.off(turn, np.maximum(self._tolerance, SHARE * sd[MOTION:]), MOST)
            if off is None:
                return
            self.engine.relinearize(off)
            self._know()

    def _restart(self) -> None:
        """Go on from the optimum of the dive so far, with what it lets in."""
        best = self._optimum()
        n, state = self._count, best.state
        calibration = {name: np.broadcast_to(value, (n, value.shape[-1])) for name, value in state.calibration.items()}
        x = np.concatenate([state.R_nb.reshape(n, 9), state.p_n, state.v_n, state.bias], axis=1)
        c = np.concatenate([calibration[name] for name in LAYOUT], axis=1)
        self.engine.restart(best.problem, best.solution.gates, x, c)
        self._know()

    def _know(self) -> None:
        """The newest keyframe as iSAM2 has it."""
        places = [place for place in self.known.places if self.engine.knows(place.number)]
        x, c, P, positions = self.engine.newest([place.number for place in places])
        remembered = (replace(p, position=q) for p, q in zip(places, positions, strict=True))
        self.known = Gaussian(x, c, P, tuple(remembered))

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self.known.state

    def states(self) -> State:
        """Of each keyframe that iSAM2 has taken, from all data so far; calibration has shape (n, dim)."""
        return states_of(*self.engine.estimate())

    def filtered(self) -> Estimate:
        """What was known of each keyframe when it was the newest."""
        return self.history.estimate(self.problem, "filtered")

    def solve(self) -> Estimate:
        """The smoothed trajectory with its uncertainty."""
        return smoothed(self.optimum(), self.initial)

    def optimum(self) -> Optimum:
        """The optimum of all that was taken, which is where the smoothed trajectory comes from."""
        self.update()
        return self._optimum()

    def _optimum(self) -> Optimum:
        """All of the dive so far, from iSAM2's estimate on; a landmark beyond its gate there is of no other's place."""
        states, problem = self.states(), self.problem.upto(self._count)
        given = self.initial, states, newest_calibration(states.calibration)
        seen = problem.of_sensor(PLACE)
        if not len(seen):
            return optimum(problem, *given, searches=self.searches)
        best = associated_optimum(resolved(problem, self._numbers[seen]), *given)
        out = best.blocks[PLACE].believed & ~best.solution.gates[PLACE]
        if not out.any():
            return with_arm_of_rates(best)
        apart = np.where(out, problem.number[seen], self._numbers[seen])
        return with_arm_of_rates(associated_optimum(resolved(problem, apart), *given))

    def _take(self, count: int) -> int:
        """Take the newest keyframes of the assembly."""
        problem = self.assembly.problem
        for k in range(len(problem) - count, len(problem)):
            self.step(problem, k)
        return count


def run_isam2(
    problem: Problem,
    initial: InitialConditions,
    progress: Callable[[float], None] = lambda done: None,
    update_s: float = 0.0,
    searches: Searches | None = None,
) -> IncrementalEstimator:
    """iSAM2 that has taken the keyframes of a dive; ``progress`` is told 0 to 1 now and then."""
    estimator = IncrementalEstimator(initial, update_s, searches)
    for k in range(len(problem)):
        estimator.step(problem, k)
        if k % 50 == 0:
            progress(k / len(problem))
    estimator.update()
    return estimator


def _stiff(belief: Belief) -> Belief:
    """What is constant, as something that hardly walks."""
    return belief if belief.walk else replace(belief, walk=STIFF * belief.sd)
