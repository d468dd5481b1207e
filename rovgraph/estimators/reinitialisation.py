"""A filter's newest keyframe as the graph of the dive so far has it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.estimators.error_recursion import ErrorStateRecursion
from rovgraph.estimators.filter_step import Gaussian
from rovgraph.estimators.remembered_places import Place
from rovgraph.graph.keys import key
from rovgraph.graph.marginals import newest_covariance
from rovgraph.graph.places import Optimum, optimum
from rovgraph.state import PLACE, PLACE_DIM, State


def renewed(recursion: ErrorStateRecursion, intervals: Sequence[KeyframeInterval], states: State) -> Gaussian:
    """The newest keyframe, with every factor of the dive linearised at the optimum.

    Parameters
    ----------
    recursion : the filter's
    intervals : the dive so far
    states : State of all its keyframes to begin with; its newest calibration is taken
    """
    b = recursion.beginning
    calibration = {name: value if value.ndim == 1 else value[-1] for name, value in states.calibration.items()}
    best = optimum(intervals, b.start, b.config, recursion.beliefs, b.instruments, states, calibration)
    problem, solution = best.problem, best.solution
    newest = problem.states(solution.values).at([problem.count - 1])
    calibration = {name: value.reshape(-1) for name, value in newest.calibration.items()}
    columns = recursion.error.columns
    known = np.concatenate([np.arange(15)] + [np.r_[columns[name]] for name in problem.unknowns.estimated])
    places = remembered(best, b.config.place.remembered)
    size = recursion.error.size
    P = np.zeros((size + PLACE_DIM * len(places), size + PLACE_DIM * len(places)))
    P[:size, :size] = recursion.start().P  # of what no sensor has shown yet
    known = np.concatenate([known, np.arange(size, len(P))])
    P[np.ix_(known, known)] = newest_covariance(problem, solution, [place.number for place in places])
    return Gaussian(replace(newest, calibration=calibration), P, places)


def remembered(best: Optimum, most: int) -> tuple[Place, ...]:
    """The places that were seen last, of those that anything says where they are."""
    seen: dict[int, Place] = {}
    for interval in best.intervals:
        for a in interval.measurements:
            if a.landmark is not None and a.landmark.believed:
                number = a.landmark.number
                position = best.solution.values.atVector(key(PLACE, number))
                seen[number] = Place(a.landmark.name, number, position, a.time)
    return tuple(sorted(seen.values(), key=lambda place: place.time)[-most:])
