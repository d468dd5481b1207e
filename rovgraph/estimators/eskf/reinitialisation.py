"""A filter's newest keyframe as the smoother has it, from the whole of the dive so far."""

from dataclasses import replace

import numpy as np

from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import Gaussian
from rovgraph.engine.optimum import Optimum
from rovgraph.engine.problem import Problem
from rovgraph.engine.remembered_places import RememberedPlace
from rovgraph.estimators.observability import without_what_noise_moves
from rovgraph.estimators.optimum import optimum
from rovgraph.kernels.measurement_row import TIME
from rovgraph.state import PLACE, PLACE_DIM, State


def reinitialised(engine: FilterEngine, problem: Problem, states: State) -> tuple[Gaussian, Optimum]:
    """The newest keyframe, with every factor of the dive linearised at the optimum.

    Parameters
    ----------
    engine : the filter's
    problem : the dive so far
    states : State of all its keyframes to begin with; its newest calibration is taken

    Returns
    -------
    Gaussian : of the newest keyframe
    Optimum : of the dive so far
    """
    initial, layout = engine.initial, engine.layout
    calibration = {name: value if value.ndim == 1 else value[-1] for name, value in states.calibration.items()}
    best, _ = without_what_noise_moves(optimum(problem, initial, states, calibration))
    names, size = (*best.unknowns.estimated, *best.unknowns.considered), layout.size
    known = np.concatenate([np.arange(15)] + [np.r_[layout.columns[name]] for name in names])
    places = remembered(best, initial.config.place.remembered)
    # the covariance of all, what is considered at the end: of what no sensor has shown yet, that of the start
    start, more = engine.start(), PLACE_DIM * len(places)
    joint = np.zeros((layout.width + more, layout.width + more))
    joint[:size, :size], joint[size + more :, size + more :] = start.P, start.L @ start.L.T
    known = np.concatenate([known + more * (known >= size), np.arange(size, size + more)])
    joint[np.ix_(known, known)] = best.newest_covariance([place.number for place in places])
    own = slice(0, size + more)
    L = np.asarray(np.linalg.cholesky(joint[size + more :, size + more :]), dtype=float)
    B = np.asarray(np.linalg.solve(L, joint[size + more :, own]).T, dtype=float)
    state = best.state.at([len(problem) - 1])
    calibration = {name: value.reshape(-1) for name, value in state.calibration.items()}
    newest = State(state.R_nb, state.p_n, state.v_n, state.bias, calibration)
    return replace(Gaussian.of(newest, joint[own, own] - B @ B.T, places), B=B, L=L), best


def remembered(best: Optimum, most: int) -> tuple[RememberedPlace, ...]:
    """The places that were seen last, of those that anything says where they are."""
    seen: dict[int, RememberedPlace] = {}
    problem, believed = best.problem, best.problem.believed
    for row in problem.of_sensor(PLACE).tolist() if best.places else ():
        if believed[row]:
            number, name, time = int(problem.number[row]), float(problem.names[row]), float(problem.rows[row, TIME])
            seen[number] = RememberedPlace(name, number, best.places[number], time)
    return tuple(sorted(seen.values(), key=lambda place: place.time)[-most:])
