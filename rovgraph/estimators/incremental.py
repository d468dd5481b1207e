"""Incremental smoothing: iSAM2 over the whole dive, behind the error-state filter.

The filter goes ahead, keeps out what disagrees, and gives iSAM2 its initial values; iSAM2
takes the keyframes in portions and smooths all of them. A constant that all keyframes share
would make every update touch the whole tree, so each constant of the calibration is a row of
nearly equal ones, one for each segment of time.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

from rovgraph.calibration import Belief
from rovgraph.config import beliefs
from rovgraph.engine.assembly import Assembler
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.unknowns import unknowns
from rovgraph.estimators.error_state import REINITIALISE_AT_S, ErrorStateFilter
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.filter_step import Gaussian, ProcessedMeasurement
from rovgraph.estimators.initialise import InitialConditions
from rovgraph.estimators.smoother import smoothed
from rovgraph.graph.batch import make_problem, solution_at
from rovgraph.graph.factors import drift, landmark_prior, motion, priors
from rovgraph.graph.incremental import Incremental
from rovgraph.graph.measurements import make_block
from rovgraph.graph.places import Optimum, insert_places, settled
from rovgraph.graph.values import insert_calibration, state_values
from rovgraph.log import Measurement
from rovgraph.state import State, stack_states

UPDATE_S = 1.0  # of the dive, between updates of iSAM2
STIFF = 2e-4  # walk of a constant, as a part of its prior's sd per root second


@dataclass
class IncrementalEstimator:
    """iSAM2 over the whole dive, fed measurement by measurement, or with keyframes of a filter.

    Attributes
    ----------
    beginning : of `rovgraph.estimators.initialise.initialise`
    update_s : of the dive, between updates of iSAM2 [s]
    intervals : the dive, as far as it has been taken
    updated : newest keyframe that iSAM2 has, -1 = none
    """

    beginning: InitialConditions
    update_s: float = UPDATE_S

    def __post_init__(self) -> None:
        b = self.beginning
        self.beliefs = {name: _stiff(belief) for name, belief in beliefs(b.config).items()}
        self.unknowns = unknowns(self.beliefs, b.instruments)
        self.engine = Incremental(self.unknowns)
        self.assembler = Assembler(b.config, b.instruments, b.start.state.bias[0])
        self.intervals: list[KeyframeInterval] = []
        self._filter: ErrorStateFilter | None = None
        self._places: set[int] = set()  # that iSAM2 knows
        self._begun = 0.0  # when the newest segment began [s]
        self.updated = -1

    def add(self, measurement: Measurement) -> list[KeyframeInterval]:
        """Take a measurement; times must not decrease."""
        return self._take(self.assembler.add(measurement))

    def finish(self) -> list[KeyframeInterval]:
        """Close the last interval."""
        done = self._take(self.assembler.finish())
        self.update()
        return done

    def step(self, interval: KeyframeInterval) -> None:
        """Take an interval by way of a filter of its own."""
        if self._filter is None:
            self._filter = ErrorStateFilter(self.beginning, REINITIALISE_AT_S)
        used = self._filter.step(interval)
        self.take(interval, self._filter.filtered[-1], used)

    def take(self, interval: KeyframeInterval, known: Gaussian, used: Sequence[ProcessedMeasurement]) -> None:
        """Take a keyframe of a filter.

        Parameters
        ----------
        interval : the keyframe's
        known : the filter's estimate of it
        used : what the filter let in, or kept out
        """
        b, segment = self.beginning, interval.segment
        factors = motion(interval, self.unknowns) if self.intervals else priors(b.start, self.beliefs, self.unknowns)
        values = state_values(interval.index, known.state)
        if not self.intervals or segment > self.intervals[-1].segment:
            factors += drift(self.unknowns, segment, interval.time - self._begun)
            insert_calibration(values, known.state.calibration, self.unknowns, segment)
            self._begun = interval.time
        for one in used:
            landmark = one.measurement.landmark
            if one.weight > 0.0 or landmark is not None:  # a place that fits none of its name is one by itself
                instrument = b.instruments[one.measurement.sensor]
                block = make_block([one.measurement], instrument, b.config.environment.gravity_mps2, self.unknowns)
                factors.append(block.custom_factor())
                if landmark is not None and landmark.number not in self._places:
                    self._places.add(landmark.number)
                    insert_places(values, block, one.state)
                    factors.append(landmark_prior(landmark.number))
        self.engine.add(factors, values)
        if any(a.landmark for a in interval.measurements):
            interval = replace(interval, measurements=[one.measurement for one in used])
        self.intervals.append(interval)
        if interval.time - self.intervals[max(self.updated, 0)].time >= self.update_s:
            self.update()

    def update(self) -> None:
        """Have iSAM2 take what has come since."""
        self.engine.update()
        self.updated = len(self.intervals) - 1

    def latest(self) -> State:
        """The newest keyframe that iSAM2 has taken, at the IMU, calibration included."""
        newest = self.intervals[self.updated]
        return self.engine.state(newest.index, newest.segment)

    def states(self) -> State:
        """All keyframes that iSAM2 has taken, from all data so far."""
        return stack_states([self.engine.state(i.index, i.segment) for i in self.intervals[: self.updated + 1]])

    def solve(self) -> Estimate:
        """The smoothed trajectory with its uncertainty."""
        self.update()
        b = self.beginning
        intervals = settled(self.intervals)
        problem = make_problem(intervals, b.start, b.config, self.beliefs, b.instruments)
        return smoothed(Optimum(intervals, problem, solution_at(problem, self.engine.values())), b)

    def _take(self, intervals: list[KeyframeInterval]) -> list[KeyframeInterval]:
        for interval in intervals:
            self.step(interval)
        return intervals


def _stiff(belief: Belief) -> Belief:
    """What is constant, as something that hardly walks."""
    return belief if belief.walk else replace(belief, walk=STIFF * belief.sd)
