"""Association of landmarks: which sightings of one name belong to one place.

A camera that mistakes one rock for another would tie two spots together, and a robust loss does not help: minutes of
drift lie between two sightings, known to metres only, so the track follows a false match and leaves no residual. A
false match shows only against a track that does not use it. So the dive is solved without places first. That gives
the joint covariance of the vehicle's positions at all sightings, and in the order of time each sighting is compared
with the places of its name: the innovation squared over its covariance (NIS) decides, as it does in the filter. A
sighting that fits no place of its name begins another place. A place seen once adds no information, so a false first
sighting does not harm the following ones. Each accepted sighting narrows the joint covariance for the next (joint
compatibility, Neira and Tardos 2001, one landmark at a time).

In the end the place of a name is the one that most of its sightings agree on. Sightings that agree with no other start
as rejected ones of that place: `rovgraph.inference.graph.batch` begins without them, and admits them if they lie within
their gate at its optimum.
"""

from collections import Counter
from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.filter import ORIGIN
from rovgraph.inference.gauss_newton import GaussNewtonResult
from rovgraph.inference.graph.batch import DiveGraph, make_graph, make_values, solve
from rovgraph.inference.graph.optimum import GraphOptimum, eliminate
from rovgraph.inference.graph.values import key
from rovgraph.model.state import DIMENSION, PLACE, PLACE_DIM, POSE, State
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.measurements import Measurements
from rovgraph.problem.motion import gravity
from rovgraph.problem.problem import Problem
from rovgraph.sensors.instruments import Instrument


def smooth_graph(
    problem: Problem,
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
) -> GraphOptimum:
    """Solve a dive: without the places that it sees, where it sees any, and then with them.

    Parameters
    ----------
    problem, initial : the dive
    states, calibration : of the keyframes to begin with, as `make_values` takes them
    """
    config, instruments, beliefs = initial.config, initial.instruments, initial.beliefs
    given, seen = (initial.prior, config, beliefs, instruments), problem.of_sensor(PLACE)
    apart = problem.without(PLACE) if len(seen) else problem
    graph = make_graph(apart, *given)
    solution = solve(graph, make_values(graph, states, calibration))
    if not len(seen):
        return GraphOptimum(apart, initial, beliefs, graph, solution)
    numbers = recognised(problem, instruments[PLACE], gravity(config), graph, solution)
    dive = resolved(problem, numbers)
    together = make_graph(dive, *given)
    values = gtsam.Values(solution.point)
    block = together.blocks[PLACE]
    insert_places(values, block, graph.states(solution.point).at(block.keyframe))
    return GraphOptimum(dive, initial, beliefs, together, solve(together, values))


def associated_optimum(
    problem: Problem,
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
) -> GraphOptimum:
    """Solve a dive whose landmarks have been given to their places.

    Parameters
    ----------
    problem, initial : the dive
    states, calibration : of the keyframes to begin with, as `make_values` takes them
    """
    beliefs = initial.beliefs
    graph = make_graph(problem, initial.prior, initial.config, beliefs, initial.instruments)
    values = make_values(graph, states, calibration)
    if (block := graph.blocks.get(PLACE)) is not None:
        insert_places(values, block, graph.states(values).at(block.keyframe))
    return GraphOptimum(problem, initial, beliefs, graph, solve(graph, values))


def recognised(
    problem: Problem,
    instrument: Instrument,
    gravity: float,
    graph: DiveGraph,
    solution: GaussNewtonResult[gtsam.Values],
) -> NDArray[np.int64]:
    """Number of the place that each landmark of a dive is of, shape (k,).

    Parameters
    ----------
    problem : the dive
    instrument : of the places
    gravity : [m/s^2]
    graph, solution : the dive without places, and its optimum
    """
    seen = problem.of_sensor(PLACE)
    names, numbers = problem.names[seen], problem.number[seen].copy()
    _, place, often = np.unique(names, return_inverse=True, return_counts=True)
    again = often[place] > 1
    if again.any():
        block = Measurements(problem, seen[again], instrument, gravity, graph.unknowns)
        where, covariance = _where(block, graph, solution)
        numbers[again] = matched(names[again], numbers[again], where, covariance, instrument.gate_sd)
    return numbers


def resolved(problem: Problem, numbers: NDArray[np.int64]) -> Problem:
    """A dive whose landmarks are of the places of some numbers, shape (k,).

    One that agrees with no other is not believed, where others of its name agree.
    """
    seen = problem.of_sensor(PLACE)
    names, count = problem.names[seen].tolist(), Counter(numbers.tolist())
    chief: dict[float, int] = {}
    for name, number in zip(names, numbers.tolist(), strict=True):
        if count[number] > count.get(chief.get(name, -1), 1):
            chief[name] = number
    alone = np.array([count[number] == 1 for number in numbers.tolist()]) & np.isin(names, [*chief])
    found = [chief[name] if out else n for name, n, out in zip(names, numbers.tolist(), alone.tolist(), strict=True)]
    return problem.sighting(np.array(found), seen[alone])


def insert_places(values: gtsam.Values, block: Measurements, states: State) -> None:
    """Insert the places of landmarks that have none yet, each where the first landmark that is believed has it.

    Parameters
    ----------
    values : gets the new ones
    block : n landmarks
    states : State, n, of the landmarks' keyframes
    """
    where = block.predicted(states.seeing(ORIGIN))
    for k in np.flatnonzero(block.believed).tolist():
        if not values.exists(place_key := key(PLACE, int(block.place[k]))):
            values.insert(place_key, where[k])


def matched(
    names: Array, alone: NDArray[np.int64], where: Array, covariance: Array, gate_sd: float | None
) -> list[int]:
    """Number of the place that each of m landmarks is of, which are in the order of time.

    Parameters
    ----------
    names, alone : shape (m,), of the landmarks, and the numbers of the places that they are of by themselves
    where : ndarray, shape (m, 2), north and east of each place if its landmark is believed alone [m]
    covariance : ndarray, shape (2 m, 2 m), joint
    gate_sd : beyond which two landmarks are not of one place, or None
    """
    gate = np.inf if gate_sd is None else gate_sd
    mean, P = where.ravel().copy(), covariance.copy()
    numbers: list[int] = []
    newest: dict[float, dict[int, int]] = {}  # name -> number of each of its places -> its newest landmark
    for k, name in enumerate(names.tolist()):
        places, here = newest.setdefault(name, {}), _rows(k)
        best, least = None, gate**2
        for number, other in places.items():
            there = _rows(other)
            apart = mean[here] - mean[there]
            S = P[here, here] + P[there, there] - P[here, there] - P[there, here]
            nis = float(apart @ np.linalg.solve(S, apart))
            if nis <= least:
                best, least = number, nis
        if best is None:
            best = int(alone[k])
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


def _where(block: Measurements, graph: DiveGraph, solution: GaussNewtonResult[gtsam.Values]) -> tuple[Array, Array]:
    """Place of each landmark if it is believed alone, shape (m, 2), and their joint covariance, shape (2 m, 2 m).

    The motion from a keyframe to its landmark is short, and taken as exact.
    """
    states = graph.states(solution.point).at(block.keyframe)
    where, H = block.predict(states.seeing(ORIGIN))
    frames, column = np.unique(block.keyframe, return_inverse=True)
    linear = graph.linearize(solution.point, solution.gates)
    _, root = eliminate(linear, [key(POSE, int(frame)) for frame in frames])
    by_poses = np.zeros((len(block), PLACE_DIM, len(frames), DIMENSION[POSE]))
    by_poses[np.arange(len(block)), :, column] = H[POSE]
    spread = by_poses.reshape(-1, len(root)) @ root
    noise = np.linalg.inv(block.W)
    covariance = spread @ spread.T
    for k in range(len(block)):
        covariance[_rows(k), _rows(k)] += noise[k] @ noise[k].T
    return where, covariance


def _rows(k: int) -> slice:
    return slice(PLACE_DIM * k, PLACE_DIM * (k + 1))
