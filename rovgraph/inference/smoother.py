"""Batch smoothing of a whole dive.

`optimum` solves a chain where no place is seen twice, and GTSAM's graph where loops are closed.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import isfinite
from typing import Any

import numpy as np

from rovgraph.geometry import Array
from rovgraph.inference.chain_optimum import ChainOptimum, smooth_chain
from rovgraph.inference.dead_reckoning import dead_reckon
from rovgraph.inference.estimate import (
    Estimate,
    bias_histories,
    body_trajectory,
    calibration_estimates,
    calibration_history,
    current_frame,
    reply_frame,
    residual_frame,
    velocity_covariance,
)
from rovgraph.inference.faulty_intervals import CLEAR, Searches
from rovgraph.inference.gauss_newton import rejects
from rovgraph.inference.observability import shown, shown_below, without_what_noise_moves
from rovgraph.inference.optimum import NEWEST, Optimum, joint_prior_sd, residual_state
from rovgraph.inference.posterior import Posterior
from rovgraph.inference.rate_noise import ARM, rate_noise_moves_arm, without_rate_noise
from rovgraph.inference.resolve import unseen
from rovgraph.log import Log
from rovgraph.model.calibration import WATER_LAYER
from rovgraph.model.state import BIAS, MOTION_STATE, PLACE, POSE, State
from rovgraph.problem.admission import TimeOffsets
from rovgraph.problem.assembly import assembly_of
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.motion import has_constant_velocity
from rovgraph.problem.problem import Problem
from rovgraph.process import stage
from rovgraph.rules import CONTRADICTED, RULES


def optimum(
    problem: Problem,
    initial: InitialConditions,
    states: State,
    calibration: Mapping[str, Array] | None = None,
    searches: Searches | None = None,
) -> Optimum:
    """Solve a dive; considered variables are estimated where the dive shows them.

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
        from rovgraph.inference.graph.places import smooth_graph  # GTSAM is slow to load, and not everywhere to be had

        best: Optimum = smooth_graph(problem, initial, states, calibration)
    else:
        best = smooth_chain(problem, initial, states, calibration, searches)
    hidden = unseen(best.blocks) if has_constant_velocity(initial.config) else []
    if isinstance(best, ChainOptimum) and best.unknowns.considered and _contradicted(best):
        free = smooth_chain(problem, initial, states, calibration, freed=True)
        if _explains(free, best):
            return without_rate_noise(_with_what_is_shown(free, best.unknowns.considered, hidden))
    seen = [name for name in shown(best) if name not in hidden]
    return without_rate_noise(best.estimating(seen) if seen else best)


def _contradicted(best: ChainOptimum) -> bool:
    """Whether many measurements of a sensor are rejected, as those of a DVL whose mounting is held where it is not.

    An excluded interval is an explanation of its own.
    """
    return not best.solution.stretches and rejects(best.solution.gates, CONTRADICTED)


def _explains(free: ChainOptimum, best: ChainOptimum) -> bool:
    """Whether considered variables, within their priors, explain rejections of a dive that holds them.

    What is further off than that is named wrongly rather than known badly.
    """
    beliefs = [best.beliefs[name] for name in best.unknowns.considered]
    away = [np.abs(free.state.calibration[b.variable.name] - b.mean).max() / b.sd for b in beliefs]
    return free.solution.cost < best.solution.cost - CLEAR and max(away) < RULES["moved"].doubtful


def _with_what_is_shown(free: ChainOptimum, considered: Sequence[str], hidden: Collection[str]) -> ChainOptimum:
    """The optimum with those considered variables estimated that the dive shows, from one with all estimated.

    Where what is left contradicts the dive again, all but what noise moves is.
    """
    P = free.covariances()
    sd = {name: np.sqrt(np.diag(P[name][-1])) for name in considered}
    moved = [name for name in considered if name in hidden or (name == ARM and rate_noise_moves_arm(free, sd[ARM]))]
    rest = [
        name
        for name in considered
        if name in moved or not (sd[name] < shown_below(free, name) * free.beliefs[name].sd).all()
    ]
    best = free.considering(rest) if rest else free
    if best.solution.cost < free.solution.cost + CLEAR:
        return best
    return free.considering(moved) if moved else free


MAX_PLACINGS = 4  # solutions, each with late measurements put where the one before has found them to belong
PLACED_WITHIN_S = 0.02  # the IMU adds next to no noise over that time
CENTRED_REACH_S = 0.1  # around the time_offset that was found


@dataclass(frozen=True)
class BatchSmoother:
    """A dive that is solved at once.

    Attributes
    ----------
    initial : of `rovgraph.inference.initialise.initialise`
    log : the dive
    problem : the same as arrays
    left_out : (sensor, reason) -> count of measurements that never reach it
    time_offsets : how late stamps are
    searches : for faulty intervals, shared by all that solve the same dive
    """

    initial: InitialConditions
    log: Log
    problem: Problem
    left_out: Mapping[tuple[str, str], int]
    time_offsets: TimeOffsets
    searches: Searches

    def without_covariances(self) -> "BatchSmoother":
        """The same without what the chain does not need; GTSAM's graph of a dive that sees places does."""
        return self if PLACE in self.problem.used else replace(self, problem=self.problem.without_covariances())

    def solve(self, states: State | None = None) -> Estimate:
        """The smoothed trajectory with its uncertainty; ``states`` as `optimum` takes them."""
        return smoothed(self.optimum(states), self.initial)

    def optimum(self, states: State | None = None) -> Optimum:
        """The dive's optimum.

        Parameters
        ----------
        states : State of its keyframes to begin with, calibration at the end of the dive; None = dead reckoning
        """
        b = self.initial
        dive, priors = self, b.beliefs
        calibration = None if states is None else newest_calibration(states.calibration)
        for _ in range(MAX_PLACINGS):
            if states is None:
                states = dead_reckon(dive.problem, b, {name: belief.mean for name, belief in priors.items()})
            best = optimum(dive.problem, b, states, calibration, dive.searches)
            found = best.state.calibration
            again = dive.placed_again(found)
            if again is None:
                break
            dive, states, calibration = again, None, newest_calibration(found)
        return best

    def placed_again(self, calibration: Mapping[str, Array]) -> "BatchSmoother | None":
        """The same dive with its measurements where late stamps were found to belong; None = they are there already.

        Parameters
        ----------
        calibration : name -> ndarray, shape (dim,) or (n, dim), what was found
        """
        if self.time_offsets.off(calibration) < PLACED_WITHIN_S:
            return None
        return assemble(self.log, self.initial, self.time_offsets.centred(calibration, CENTRED_REACH_S))

    def dead_reckoning(self) -> Estimate:
        """Dead reckoning over the same intervals: the baseline."""
        b = self.initial
        means = {name: belief.mean for name, belief in b.beliefs.items()}
        states = dead_reckon(self.problem, b, means)
        trajectory = body_trajectory(self.problem.keyframes, states, b)
        return Estimate("dead_reckoning", trajectory, [], {}, residual_frame())


@stage
def assemble(
    log: Log,
    initial: InitialConditions,
    time_offsets: TimeOffsets | None = None,
    searches: Searches | None = None,
) -> BatchSmoother:
    """All keyframes of a log and what lies between them; ``time_offsets`` None = as configured."""
    assembly = assembly_of(initial, time_offsets)
    assembly.take(log)
    assembly.extend(finish=True)
    known = assembly.left_out, assembly.time_offsets, searches or Searches()
    return BatchSmoother(initial, log, assembly.problem, *known)


def newest_calibration(calibration: Mapping[str, Array]) -> dict[str, Array]:
    """The last of values of shape (n, dim) or (dim,), shape (dim,)."""
    return {name: value.reshape(-1, value.shape[-1])[-1] for name, value in calibration.items()}


@stage
def smoothed(best: Optimum, b: InitialConditions) -> Estimate:
    """The optimum with its marginal covariances; variables that noise may bias and the dive does not show are held."""
    return estimate_of(*without_what_noise_moves(best), b)


def estimate_of(best: Optimum, relative: Mapping[str, Array], b: InitialConditions) -> Estimate:
    """An optimum with its marginal covariances; ``relative`` is that of `without_what_noise_moves`."""
    states, problem = best.state, best.problem
    covariances = best.covariances()
    velocity = velocity_covariance(problem.keyframes, states, b, covariances[MOTION_STATE])
    trajectory = body_trajectory(problem.keyframes, states, b, covariances[POSE], velocity)
    bias_sd = np.sqrt(np.diagonal(covariances[BIAS], axis1=1, axis2=2))
    history = bias_histories(trajectory.time, states.bias, bias_sd, b.streams)
    final, spread = dict(best.unknowns.fixed), {}
    held = [name for name in best.unknowns.considered if best.beliefs[name].estimate]
    n, segment = len(problem), problem.segment
    ends, begun = np.array([0, n - 1]), np.flatnonzero(np.diff(segment)) + 1
    for name, walk in best.unknowns.walks.items():
        rows = np.concatenate([[0], begun, [n - 1]]) if walk else ends
        P = covariances[name]
        value = np.broadcast_to(states.calibration[name], (n, P.shape[1]))[rows]
        history[name] = calibration_history(
            name, trajectory.time[rows], value, np.sqrt(np.diagonal(P[rows], axis1=1, axis2=2))
        )
        final[name], spread[name] = value[-1], P[-1]
    for name in held:
        spread[name] = covariances[name][-1]
        both = np.tile(final[name], (2, 1)), np.tile(np.sqrt(np.diag(spread[name])), (2, 1))
        history[name] = calibration_history(name, trajectory.time[ends], *both)
    return Estimate(
        "smoothed",
        trajectory,
        calibration_estimates(
            best.beliefs, [s for s in b.streams if s in {*best.blocks, "imu"}], final, spread, relative
        ),
        history,
        residual_frame((s, b, residual_state(best, b), best.weights[s]) for s, b in best.blocks.items()),
        {
            "keyframes": n,
            "cost": best.solution.cost,
            "iterations": best.solution.iterations,
            "converged": best.solution.converged,
            "stretches_taken_out": [asdict(stretch) for stretch in best.solution.stretches],
            "runner_up": best.solution.runner_up if isfinite(best.solution.runner_up) else None,
            "bridged_intervals": int(problem.bridged.sum()),
            "calibration_covariance": _joint_calibration(best),
            "held_at_prior": held,
            "considered": [name for name in best.unknowns.considered if name not in held],
        },
        Posterior.of(best, b, relative) if isinstance(best, ChainOptimum) else None,
        reply_frame(best.blocks.items(), b.config),
        current_frame(history, best.blocks.get(WATER_LAYER), b.config.water.knot_m),
    )


def _joint_calibration(best: Optimum) -> dict[str, Any] | None:
    """Joint estimate of the calibration at the end of the dive; None without estimated variables.

    Returns
    -------
    dict : ``labels`` (c), ``prior_sd`` (c) and ``covariance`` (c x c), radians and SI
    """
    names = best.unknowns.estimated
    if not names:
        return None
    prior = joint_prior_sd(best, len(best.problem) - 1)
    sd = np.concatenate([prior[name] for name in names])
    of_calibration = slice(NEWEST, NEWEST + len(sd))
    return {
        "labels": [label for name in names for label in best.beliefs[name].variable.labels],
        "prior_sd": sd.tolist(),
        "covariance": best.newest_covariance()[of_calibration, of_calibration].tolist(),
    }
