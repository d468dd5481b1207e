"""Which landmarks of a name are of one place.

A camera that takes one rock for another would tie two spots together, and a robust loss does
not help: between two landmarks lie minutes of drift, known to metres only, so the track follows
a false match and leaves no residual. What tells one is that the vehicle cannot have been there,
as long as the match is not believed yet. So the dive is solved without places first. That gives
the joint covariance of where the vehicle was at every landmark, and in the order of time each
landmark is compared with the places of its name: the innovation squared over its covariance
(NIS) decides, as it does in the filter. One that fits no place of its name begins another; a
place that is seen once says nothing, so a false first landmark spoils none of those that
follow. Each that is accepted narrows the joint covariance for the next (joint compatibility,
Neira and Tardos 2001, one landmark at a time).

In the end the place of a name is the one that most of its landmarks agree on, and those that agree
with nothing else are kept as landmarks of it that are not believed: `rovgraph.graph.batch` begins
without them, and lets them in if its optimum finds them within their gate after all.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import gtsam
import numpy as np

from rovgraph.engine.constant_velocity import gravity
from rovgraph.engine.filter import ORIGIN
from rovgraph.engine.gauss_newton import Solution
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement, LandmarkObservation
from rovgraph.engine.measurement_table import MeasurementTable
from rovgraph.engine.measurements import Block, make_block
from rovgraph.geometry import Array
from rovgraph.graph.batch import Problem, make_problem, make_values, solve
from rovgraph.graph.information import eliminate
from rovgraph.graph.keys import key
from rovgraph.graph.optimum import GraphOptimum
from rovgraph.instruments import Instrument
from rovgraph.state import DIMENSION, PLACE, PLACE_DIM, POSE, State


def smooth_graph(
    intervals: Sequence[KeyframeInterval],
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
) -> GraphOptimum:
    """Solve a dive: without the places that it sees, where it sees any, and then with them.

    Parameters
    ----------
    intervals, initial : the dive
    states, calibration : of the keyframes to begin with, as `make_values` takes them
    """
    config, instruments, beliefs = initial.config, initial.instruments, initial.beliefs
    given = initial.prior, config, beliefs, instruments
    apart = _apart(intervals)
    problem = make_problem(apart, *given)
    solution = solve(problem, make_values(problem, states, calibration))
    seen = _landmarks(intervals)
    if not seen:
        return GraphOptimum(apart, initial, beliefs, problem, solution)
    found = recognised(seen, instruments["place"], gravity(config), problem, solution)
    recognised_dive = _given(intervals, found)
    together = make_problem(recognised_dive, *given)
    values = gtsam.Values(solution.point)
    block = together.blocks["place"]
    insert_places(values, block, problem.states(solution.point).at(block.keyframe))
    return GraphOptimum(recognised_dive, initial, beliefs, together, solve(together, values))


def associated_optimum(
    intervals: Sequence[KeyframeInterval],
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
) -> GraphOptimum:
    """Solve a dive whose landmarks have been given to their places.

    Parameters
    ----------
    intervals, initial : the dive
    states, calibration : of the keyframes to begin with, as `make_values` takes them
    """
    beliefs = initial.beliefs
    problem = make_problem(intervals, initial.prior, initial.config, beliefs, initial.instruments)
    values = make_values(problem, states, calibration)
    if (block := problem.blocks.get(PLACE)) is not None:
        insert_places(values, block, problem.states(values).at(block.keyframe))
    return GraphOptimum(list(intervals), initial, beliefs, problem, solve(problem, values))


def recognised(
    seen: Sequence[KeyframeMeasurement],
    instrument: Instrument,
    gravity: float,
    problem: Problem,
    solution: Solution[gtsam.Values],
) -> dict[float, KeyframeMeasurement]:
    """Sightings of what is seen more than once, by their times, each given to its place.

    Parameters
    ----------
    seen : all landmarks, in the order of time
    instrument : of the places
    gravity : [m/s^2]
    problem, solution : the dive without places, and its optimum
    """
    often = Counter(_name(a) for a in seen)
    again = [a for a in seen if often[_name(a)] > 1]
    if not again:
        return {}
    block = make_block(MeasurementTable.of(again), instrument, gravity, problem.unknowns)
    where, covariance = _where(block, problem, solution)
    return _resolved(again, matched(again, where, covariance, instrument.gate_sd))


def resolved_associations(intervals: Sequence[KeyframeInterval]) -> list[KeyframeInterval]:
    """A dive whose landmarks have been given to places one by one: what fits no other of its name is not believed."""
    seen = _landmarks(intervals)
    return _given(intervals, _resolved(seen, [_number(a) for a in seen]))


def apart_from(interval: KeyframeInterval, numbers: Mapping[float, int]) -> KeyframeInterval:
    """An interval whose landmarks of some times are each of the place of that number."""
    found = {
        a.time: replace(a, landmark=a.landmark._replace(number=numbers[a.time]))
        for a in interval.measurements
        if a.landmark is not None and a.time in numbers
    }
    return _given([interval], found)[0]


def insert_places(values: gtsam.Values, block: Block, states: State) -> None:
    """Insert the places of landmarks that have none yet, each where the first landmark that is believed has it.

    Parameters
    ----------
    values : gets the new ones
    block : n landmarks
    states : State, n, of the landmarks' keyframes
    """
    where = block.predicted(states.seeing(ORIGIN))
    for k in np.flatnonzero(block.believed).tolist():
        if not values.exists(own := key(PLACE, int(block.place[k]))):
            values.insert(own, where[k])


def matched(seen: Sequence[KeyframeMeasurement], where: Array, covariance: Array, gate_sd: float | None) -> list[int]:
    """Number of the place that each landmark is of.

    Parameters
    ----------
    seen : m landmarks in the order of time
    where : ndarray, shape (m, 2), north and east of each place if its landmark is believed alone [m]
    covariance : ndarray, shape (2 m, 2 m), joint
    gate_sd : beyond which two landmarks are not of one place, or None
    """
    gate = np.inf if gate_sd is None else gate_sd
    mean, P = where.ravel().copy(), covariance.copy()
    numbers: list[int] = []
    newest: dict[float, dict[int, int]] = {}  # name -> number of each of its places -> its newest landmark
    for k, a in enumerate(seen):
        places, here = newest.setdefault(_name(a), {}), _rows(k)
        best, least = None, gate**2
        for number, other in places.items():
            there = _rows(other)
            apart = mean[here] - mean[there]
            S = P[here, here] + P[there, there] - P[here, there] - P[there, here]
            nis = float(apart @ np.linalg.solve(S, apart))
            if nis <= least:
                best, least = number, nis
        if best is None:
            best = _number(a)
        else:  # the two are one: condition on that
            there = _rows(places[best])
            H = np.zeros((PLACE_DIM, len(mean)))
            H[:, here], H[:, there] = np.eye(PLACE_DIM), -np.eye(PLACE_DIM)
            PHt = P @ H.T
            gain = np.linalg.solve(H @ PHt, PHt.T).T
            mean, P = mean - gain @ (H @ mean), P - gain @ PHt.T
        places[best] = k
        numbers.append(best)
    return numbers


def _resolved(seen: Sequence[KeyframeMeasurement], numbers: Sequence[int]) -> dict[float, KeyframeMeasurement]:
    """Sightings by their times; one that agrees with no other is not believed, where others of its name agree.

    Parameters
    ----------
    seen : landmarks
    numbers : of the place that each is of
    """
    count = Counter(numbers)
    chief: dict[float, int] = {}
    for a, number in zip(seen, numbers, strict=True):
        if count[number] > count.get(chief.get(_name(a), -1), 1):
            chief[_name(a)] = number
    out = {}
    for a, number in zip(seen, numbers, strict=True):
        alone = count[number] == 1 and _name(a) in chief
        landmark = LandmarkObservation(_name(a), chief[_name(a)] if alone else number, not alone)
        out[a.time] = replace(a, landmark=landmark)
    return out


def _given(intervals: Sequence[KeyframeInterval], found: Mapping[float, KeyframeMeasurement]) -> list[KeyframeInterval]:
    """The dive with landmarks replaced by those that were found, by their times."""
    return [
        replace(i, measurements=[found.get(a.time, a) if a.landmark else a for a in i.measurements])
        if _landmarks([i])
        else i
        for i in intervals
    ]


def _where(block: Block, problem: Problem, solution: Solution[gtsam.Values]) -> tuple[Array, Array]:
    """Place of each landmark if it is believed alone, shape (m, 2), and their joint covariance, shape (2 m, 2 m).

    The motion from a keyframe to its landmark is short, and taken as exact.
    """
    states = problem.states(solution.point).at(block.keyframe)
    where, H = block.predict(states.seeing(ORIGIN))
    frames, column = np.unique(block.keyframe, return_inverse=True)
    linear = problem.linearize(solution.point, solution.gates)
    _, root = eliminate(linear, [key(POSE, int(frame)) for frame in frames])
    by_poses = np.zeros((len(block), PLACE_DIM, len(frames), DIMENSION[POSE]))
    by_poses[np.arange(len(block)), :, column] = H[POSE]
    spread = by_poses.reshape(-1, len(root)) @ root
    own = np.linalg.inv(block.W)
    covariance = spread @ spread.T
    for k in range(len(block)):
        covariance[_rows(k), _rows(k)] += own[k] @ own[k].T
    return where, covariance


def _landmarks(intervals: Sequence[KeyframeInterval]) -> list[KeyframeMeasurement]:
    return [a for interval in intervals for a in interval.measurements if a.landmark is not None]


def _apart(intervals: Sequence[KeyframeInterval]) -> list[KeyframeInterval]:
    """The same dive without places."""
    return [
        replace(i, measurements=[a for a in i.measurements if a.landmark is None]) if _landmarks([i]) else i
        for i in intervals
    ]


def _rows(k: int) -> slice:
    return slice(PLACE_DIM * k, PLACE_DIM * (k + 1))


def _name(a: KeyframeMeasurement) -> float:
    assert a.landmark is not None
    return a.landmark.name


def _number(a: KeyframeMeasurement) -> int:
    assert a.landmark is not None
    return a.landmark.number
