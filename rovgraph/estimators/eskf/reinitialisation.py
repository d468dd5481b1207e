"""A filter's newest keyframe as the smoother has it, from the whole of the dive so far."""

from collections.abc import Sequence

import numpy as np

from rovgraph.engine.dive_rows import DiveRows
from rovgraph.engine.filter import FilterEngine
from rovgraph.engine.filter_step import Gaussian
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.optimum import Optimum
from rovgraph.engine.remembered_places import RememberedPlace
from rovgraph.estimators.optimum import optimum
from rovgraph.state import PLACE_DIM, State


def reinitialised(
    engine: FilterEngine, intervals: Sequence[KeyframeInterval], states: State, rows: DiveRows | None = None
) -> tuple[Gaussian, State]:
    """The newest keyframe, with every factor of the dive linearised at the optimum.

    Parameters
    ----------
    engine : the filter's
    intervals : the dive so far
    states : State of all its keyframes to begin with; its newest calibration is taken
    rows : the dive as arrays, where they are at hand

    Returns
    -------
    Gaussian : of the newest keyframe
    State : of all keyframes, to begin with the next time
    """
    initial, layout = engine.initial, engine.layout
    calibration = {name: value if value.ndim == 1 else value[-1] for name, value in states.calibration.items()}
    best = optimum(intervals, initial, states, calibration, rows)
    newest = best.state.at([len(intervals) - 1])
    known = np.concatenate([np.arange(15)] + [np.r_[layout.columns[name]] for name in best.unknowns.estimated])
    places = remembered(best, initial.config.place.remembered)
    size = layout.size + PLACE_DIM * len(places)
    P = np.zeros((size, size))
    P[: layout.size, : layout.size] = engine.start().P  # of what no sensor has shown yet
    known = np.concatenate([known, np.arange(layout.size, size)])
    P[np.ix_(known, known)] = best.newest_covariance([place.number for place in places])
    newest = State(
        newest.R_nb,
        newest.p_n,
        newest.v_n,
        newest.bias,
        {name: value.reshape(-1) for name, value in newest.calibration.items()},
    )
    return Gaussian.of(newest, P, places), best.state


def remembered(best: Optimum, most: int) -> tuple[RememberedPlace, ...]:
    """The places that were seen last, of those that anything says where they are."""
    seen: dict[int, RememberedPlace] = {}
    for interval in best.intervals:
        for m in interval.measurements:
            if m.landmark is not None and m.landmark.believed:
                number = m.landmark.number
                seen[number] = RememberedPlace(m.landmark.name, number, best.places[number], m.time)
    return tuple(sorted(seen.values(), key=lambda place: place.time)[-most:])
