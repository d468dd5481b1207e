"""The optimum of a dive: a chain where no place is seen twice, and GTSAM's graph where loops are closed."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from rovgraph.engine.chain_optimum import ChainOptimum, smooth_chain
from rovgraph.engine.constant_velocity import has_constant_velocity
from rovgraph.engine.gauss_newton import rejects
from rovgraph.engine.initial_conditions import InitialConditions
from rovgraph.engine.optimum import Optimum
from rovgraph.engine.problem import Problem
from rovgraph.engine.rate_noise import ARM, noise_moves_arm, with_arm_of_rates
from rovgraph.engine.stretches import CLEAR, Searches
from rovgraph.estimators.observability import shown, shown_below
from rovgraph.estimators.without_imu import unseen
from rovgraph.geometry import Array
from rovgraph.rules import CONTRADICTED, RULES
from rovgraph.state import PLACE, State


def optimum(
    problem: Problem,
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
    searches: Searches | None = None,
) -> Optimum:
    """Solve a dive; what is considered is estimated where the dive shows it.

    Parameters
    ----------
    problem, initial : the dive
    states : State of its keyframes to begin with
    calibration : to begin with, its prior means where it is None
    searches : of other solutions of the dive, as configured the same

    Raises
    ------
    InputError : the data do not determine some variable, which is named
    """
    if PLACE in problem.used:
        from rovgraph.graph.places import smooth_graph  # GTSAM is slow to load, and not everywhere to be had

        best: Optimum = smooth_graph(problem, initial, states, calibration)
    else:
        best = smooth_chain(problem, initial, states, calibration, searches)
    hidden = unseen(best.blocks) if has_constant_velocity(initial.config) else []
    if isinstance(best, ChainOptimum) and best.unknowns.considered and _contradicted(best):
        free = smooth_chain(problem, initial, states, calibration, freed=True)
        if _explains(free, best):
            return with_arm_of_rates(_with_what_is_shown(free, best.unknowns.considered, hidden))
    seen = [name for name in shown(best) if name not in hidden]
    return with_arm_of_rates(best.estimating(seen) if seen else best)


def _contradicted(best: ChainOptimum) -> bool:
    """Whether many measurements of a sensor are rejected, as those of a DVL whose mounting is held where it is not.

    A stretch that was taken out is an explanation of its own.
    """
    return not best.solution.stretches and rejects(best.solution.gates, CONTRADICTED)


def _explains(free: ChainOptimum, best: ChainOptimum) -> bool:
    """Whether what is considered explains, within its priors, what a dive rejects that holds it.

    What is further off than that is named wrongly rather than known badly.
    """
    beliefs = [best.beliefs[name] for name in best.unknowns.considered]
    away = [np.abs(free.state.calibration[b.variable.name] - b.mean).max() / b.sd for b in beliefs]
    return free.solution.cost < best.solution.cost - CLEAR and max(away) < RULES["moved"].doubtful


def _with_what_is_shown(free: ChainOptimum, considered: Sequence[str], hidden: Collection[str]) -> ChainOptimum:
    """The optimum with what is considered estimated as far as the dive shows it, from where all of it is.

    Where what is left contradicts the dive again, all but what noise moves is.
    """
    P = free.covariances()
    sd = {name: np.sqrt(np.diag(P[name][-1])) for name in considered}
    moved = [name for name in considered if name in hidden or (name == ARM and noise_moves_arm(free, sd[ARM]))]
    rest = [
        name
        for name in considered
        if name in moved or not (sd[name] < shown_below(free, name) * free.beliefs[name].sd).all()
    ]
    best = free.considering(rest) if rest else free
    if best.solution.cost < free.solution.cost + CLEAR:
        return best
    return free.considering(moved) if moved else free
