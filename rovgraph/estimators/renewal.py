"""A filter's newest keyframe as the graph of the dive so far has it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.estimators.error_recursion import ErrorStateRecursion, Gaussian
from rovgraph.graph.assembly import Interval
from rovgraph.graph.batch import make_problem, make_values, newest_covariance, solve
from rovgraph.state import State


def renewed(recursion: ErrorStateRecursion, intervals: Sequence[Interval], states: State) -> Gaussian:
    """The newest keyframe, with every factor of the dive linearised at the optimum.

    Parameters
    ----------
    recursion : the filter's
    intervals : the dive so far
    states : State of all its keyframes to begin with; its newest calibration is taken
    """
    b = recursion.beginning
    problem = make_problem(intervals, b.start, b.config, recursion.beliefs, b.instruments)
    calibration = {name: value if value.ndim == 1 else value[-1] for name, value in states.calibration.items()}
    solution = solve(problem, make_values(problem, states, calibration))
    newest = problem.states(solution.values).at([problem.count - 1])
    calibration = {name: value.reshape(-1) for name, value in newest.calibration.items()}
    columns = recursion.error.columns
    known = np.concatenate([np.arange(15)] + [np.r_[columns[name]] for name in problem.unknowns.estimated])
    P = recursion.start().P  # of what no sensor has shown yet
    P[np.ix_(known, known)] = newest_covariance(problem, solution)
    return Gaussian(replace(newest, calibration=calibration), P)
