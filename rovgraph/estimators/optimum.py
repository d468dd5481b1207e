"""The optimum of a dive: a chain where no place is seen twice, and GTSAM's graph where loops are closed."""

from collections.abc import Mapping, Sequence

from rovgraph.engine.chain_optimum import smooth_chain
from rovgraph.engine.constant_velocity import has_constant_velocity
from rovgraph.engine.dive_rows import DiveRows
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.optimum import Optimum
from rovgraph.engine.rate_noise import with_arm_of_rates
from rovgraph.engine.stretches import Searches
from rovgraph.estimators.observability import shown
from rovgraph.estimators.without_imu import unseen
from rovgraph.geometry import Array
from rovgraph.state import PLACE, State


def optimum(
    intervals: Sequence[KeyframeInterval],
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
    rows: DiveRows | None = None,
    searches: Searches | None = None,
) -> Optimum:
    """Solve a dive; what is considered is estimated where the dive shows it.

    Parameters
    ----------
    intervals, initial : the dive
    states : State of its keyframes to begin with
    calibration : to begin with, its prior means where it is None
    rows : the dive as arrays, where they are at hand
    searches : of other solutions of the dive, as configured the same

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    used = rows.used if rows else {m.sensor for interval in intervals for m in interval.measurements}
    if PLACE in used:
        from rovgraph.graph.places import smooth_graph  # GTSAM is slow to load, and not everywhere to be had

        best: Optimum = smooth_graph(intervals, initial, states, calibration)
    else:
        best = smooth_chain(intervals, initial, states, calibration, rows, searches)
    hidden = unseen(best.blocks) if has_constant_velocity(initial.config) else []
    seen = [name for name in shown(best) if name not in hidden]
    return with_arm_of_rates(best.estimating(seen) if seen else best)
