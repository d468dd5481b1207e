"""iSAM2 over a whole dive: an incremental graph that is a filter at its newest keyframe and a smoother behind it.

Each interval is predicted with the IMU from the graph's own newest keyframe, and measurements are gated by their
innovations against the graph's own joint covariance there (`FilterEngine.step`, from what iSAM2 knows); what was let
in becomes factors, and after the update the newest keyframe is the filtered estimate. In the end all keyframes
are smoothed. A constant that all keyframes share would make every update touch the whole tree, so each constant of
the calibration is a row of nearly equal ones, one for each segment of time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from rovgraph.calibration import Belief
from rovgraph.config import beliefs
from rovgraph.engine.assembly import Assembler
from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import FilterStep, Gates, Gaussian, ProcessedMeasurement
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement
from rovgraph.engine.scale import SCALES
from rovgraph.engine.unknowns import unknowns
from rovgraph.estimators.eskf.history import FilterHistory
from rovgraph.estimators.estimate import Estimate
from rovgraph.estimators.smoother import smoothed
from rovgraph.graph.factors import Factor, drift, landmark_prior, motion, priors
from rovgraph.graph.incremental import Incremental
from rovgraph.graph.keys import key
from rovgraph.graph.measurement_factors import keyframe_factor, measurement_factor
from rovgraph.graph.optimum import GraphOptimum
from rovgraph.graph.places import apart_from, insert_places, resolved_associations, segmented_optimum
from rovgraph.graph.values import insert_calibration, state_values
from rovgraph.log import Measurement
from rovgraph.state import PLACE, State

UPDATE_S = 1.0  # of the dive, between updates of iSAM2, where it need not tell of every keyframe
# since the start [s], all factors: in between, iSAM2 finds too late that the heading has moved, and claims too much
RELINEARISE_AT_S = (5.0, 7.0, 10.0, 14.0, 20.0, 24.0, 28.0, 34.0, 40.0, 50.0, 60.0, 80.0)
STIFF = 2e-4  # walk of a constant, as a part of its prior's sd per root second


@dataclass
class IncrementalEstimator:
    """iSAM2 over the whole dive, fed measurement by measurement or interval by interval.

    Attributes
    ----------
    beginning : of `rovgraph.estimators.initialise.initialise`
    update_s : of the dive, between updates of iSAM2; in between, the filter goes on from it [s]
    intervals : the dive, as far as it has been taken
    known : Gaussian of the newest keyframe
    history : the filtered estimate of every keyframe
    updated : newest keyframe that iSAM2 has, -1 = none
    """

    beginning: InitialConditions
    update_s: float = 0.0

    def __post_init__(self) -> None:
        b = self.beginning
        self.filter = FilterEngine(b)
        self.known = self.filter.start()
        self.history = FilterHistory(self.filter)
        self.gates: Gates = {}
        self.beliefs = {name: _stiff(belief) for name, belief in beliefs(b.config).items()}
        self.unknowns = unknowns(self.beliefs, b.instruments)
        self.engine = Incremental(self.unknowns)
        self.assembler = Assembler(b.config, b.instruments, b.prior.state.bias[0])
        self.intervals: list[KeyframeInterval] = []
        self._places: set[int] = set()  # that iSAM2 knows
        self._own_places: dict[float, int] = {}  # time of a landmark -> number of the place that it is by itself
        self._native: list[list[Factor]] = []  # of each keyframe, those that are no measurements
        self._due = list(RELINEARISE_AT_S)
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

    def step(self, interval: KeyframeInterval) -> FilterStep:
        """Take an interval: predicted and gated from what iSAM2 knows of the keyframe before, then given to it."""
        done = self.filter.step(interval, self.known, self.gates)
        self.take(interval, done.filtered, done.processed)
        self.history.append(interval, self.known, done.processed)
        return done

    def take(self, interval: KeyframeInterval, known: Gaussian, processed: Sequence[ProcessedMeasurement]) -> None:
        """Take a keyframe with what of its measurements was let in.

        Parameters
        ----------
        interval : the keyframe's
        known : where to linearise it at first
        processed : its measurements
        """
        self.known = known
        values = state_values(interval.index, known.state)
        if not self.intervals or interval.segment > self.intervals[-1].segment:
            insert_calibration(values, known.state.calibration, self.unknowns, interval.segment)
        # a place that fits none of its name is one by itself
        admitted = [p.measurement for p in processed if p.weight > 0.0 or p.measurement.landmark is not None]
        for m in admitted:
            if m.landmark is not None and m.landmark.number not in self._places:
                insert_places(values, self.filter.block([m], self.unknowns), known.state)
        self._native.append(self._motion(interval))
        self.engine.add([*self._native[-1], *self._factors(admitted)], values)
        own = {m.time: m.landmark.number for m in interval.measurements if m.landmark is not None}
        if own:
            self._own_places |= own
            interval = replace(interval, measurements=[one.measurement for one in processed])
        self.intervals.append(interval)
        if self._due and interval.time - self.intervals[0].time >= self._due[0]:
            self.update()
            self._due.pop(0)
            self._relinearise()
        elif interval.time - self.intervals[max(self.updated, 0)].time >= self.update_s:
            self.update()

    def update(self) -> None:
        """Have iSAM2 take what has come since; the filter goes on from its newest keyframe."""
        if self.updated == len(self.intervals) - 1:
            return
        self.engine.update()
        self.updated = len(self.intervals) - 1
        self._know()

    def _know(self) -> None:
        """The newest keyframe as iSAM2 has it."""
        newest = self.intervals[-1]
        places = [place for place in self.known.places if place.number in self._places]
        state, P, positions = self.engine.newest(newest.index, newest.segment, [place.number for place in places])
        remembered = tuple(replace(p, position=q) for p, q in zip(places, positions, strict=True))
        self.known = Gaussian.of(state, P, remembered)

    def latest(self) -> State:
        """The newest keyframe's state, at the IMU, calibration included."""
        return self.known.state

    def states(self) -> list[State]:
        """Of each keyframe that iSAM2 has taken, from all data so far."""
        return [self.engine.state(i.index, i.segment) for i in self.intervals[: self.updated + 1]]

    def filtered(self) -> Estimate:
        """What was known of each keyframe when it was the newest."""
        return self.history.estimate("filtered")

    def solve(self) -> Estimate:
        """The smoothed trajectory with its uncertainty."""
        self.update()
        return smoothed(self._optimum(), self.beginning)

    def _optimum(self) -> GraphOptimum:
        """All of the dive so far, from iSAM2's estimate on; a landmark beyond its gate there is of no other's place."""
        given = self.beginning, self.beliefs, [factor for own in self._native for factor in own]
        best = segmented_optimum(resolved_associations(self.intervals), *given, self.engine.values())
        block = best.blocks.get(PLACE)
        if block is None or not (out := block.time[block.believed & ~best.solution.gates[PLACE]]).size:
            return best
        apart = [apart_from(interval, {t: self._own_places[t] for t in out.tolist()}) for interval in self.intervals]
        return segmented_optimum(resolved_associations(apart), *given, self.engine.values())

    def _relinearise(self) -> None:
        """Go on from the optimum of the dive so far, with all factors linearised there, and what it lets in."""
        best = self._optimum()
        self.engine = Incremental(self.unknowns)
        before, self._places = self._places | set(best.places), set()
        gates = {sensor: iter(gate.tolist()) for sensor, gate in best.solution.gates.items()}
        factors: list[Factor] = []
        for interval, native in zip(best.intervals, self._native, strict=True):
            admitted = [m for m in interval.measurements if next(gates[m.sensor])]
            factors += [*native, *self._factors(admitted)]
        values = best.solution.point
        for number in before - self._places:
            values.erase(key(PLACE, number))
        self.engine.add(factors, values)
        self.engine.update()
        self._know()

    def _motion(self, interval: KeyframeInterval) -> list[Factor]:
        """What ties a keyframe to the one before, or to what is believed at first."""
        segment, unknowns = interval.segment, self.unknowns
        if not self.intervals:
            factors = priors(self.beginning.prior, self.beliefs, unknowns)
        else:
            factors = motion(interval, unknowns, segment)
        if not self.intervals or segment > self.intervals[-1].segment:
            factors += drift(unknowns, segment, interval.time - self._begun)
            self._begun = interval.time
        return factors

    def _factors(self, measurements: Sequence[KeyframeMeasurement]) -> list[Factor]:
        """Factors of measurements, those that the kernels know of one keyframe in one."""
        factors: list[Factor] = []
        together: dict[tuple[int, int], list[KeyframeMeasurement]] = {}
        for m in measurements:
            if self.filter.knows(m.sensor):
                together.setdefault((m.keyframe, m.segment), []).append(m)
                continue
            factors.append(measurement_factor(self.filter.block([m], self.unknowns), m.segment))
            if m.landmark is not None and m.landmark.number not in self._places:
                self._places.add(m.landmark.number)
                factors.append(landmark_prior(m.landmark.number))
        return factors + [self._factor(own, *at) for at, own in together.items()]

    def _factor(self, measurements: Sequence[KeyframeMeasurement], keyframe: int, segment: int) -> Factor:
        """All measurements of a keyframe that the kernels know."""
        filter, unknowns = self.filter, self.unknowns
        instruments = [self.beginning.instruments[m.sensor] for m in measurements]
        touched = {name for instrument in instruments for name in instrument.calibration}
        if measurements[0].scale_to_bias is not None:
            touched.update(SCALES)
        names = [name for name in unknowns.estimated if name in touched]
        return keyframe_factor(filter.rows(measurements), filter.layout, unknowns, names, keyframe, segment)

    def _take(self, intervals: list[KeyframeInterval]) -> list[KeyframeInterval]:
        for interval in intervals:
            self.step(interval)
        return intervals


def run_isam2(
    intervals: Sequence[KeyframeInterval],
    beginning: InitialConditions,
    progress: Callable[[float], None] = lambda done: None,
    update_s: float = 0.0,
) -> IncrementalEstimator:
    """iSAM2 that has taken the intervals of a dive; ``progress`` is told 0 to 1 now and then."""
    estimator = IncrementalEstimator(beginning, update_s)
    for interval in intervals:
        estimator.step(interval)
        if interval.index % 50 == 0:
            progress(interval.index / len(intervals))
    estimator.update()
    return estimator


def _stiff(belief: Belief) -> Belief:
    """What is constant, as something that hardly walks."""
    return belief if belief.walk else replace(belief, walk=STIFF * belief.sd)
