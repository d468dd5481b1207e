"""Observability of the calibration: the information that a dive adds, and a verdict on every component.

Everything is in units of the prior's sd: with D the information that the data add, the
covariance of the calibration is (1 + D)^-1 and an sd of 1 is the prior repeated.

A graph is linearised at its noisy estimate. A velocity that is constant in truth trembles in the estimate, the
linearisation takes the trembling for accelerations, and these seem to show the DVL's misalignment and scale: spurious
information, even along a straight line. It is found by adding the same noise again (simulation extrapolation; Cook and
Stefanski 1994): noise of the states is drawn from the graph's own posterior, added to the estimate with both signs, and
the information gained by that is subtracted once. The effect of the gyro's noise through the DVL's lever arm is
subtracted by its equation (`rovgraph.inference.rate_noise`).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from rovgraph.geometry import Array
from rovgraph.inference.optimum import NEWEST, Optimum, estimated_parts, joint_prior_sd
from rovgraph.inference.rate_noise import ARM, rate_noise_moves_arm, score_of_rate_noise
from rovgraph.problem.calibration_roles import CalibrationRoles

# sd after the dive over sd before. Below 0.3 more than nine tenths of the variance are gone and
# the data outweigh the prior ten to one, so a wrong prior does no harm. Above 0.8 the data have less
# than 0.6 of the prior's weight: such values mostly repeat the prior, and are no basis for action.
OBSERVABLE_BELOW, UNOBSERVABLE_ABOVE = 0.3, 0.8
OBSERVABLE, WEAK, UNOBSERVABLE = "observable", "weak", "unobservable"
SPURIOUSLY_OBSERVABLE = (
    "dvl_roll",
    "dvl_pitch",
    "dvl_yaw",
    "dvl_scale",
)  # by noise: multiplied by the velocity in what is measured
DOUBTFUL_ABOVE = 0.15  # an sd of these below it is not noise: half an hour straight ahead takes it to 0.43

STILL = 0.95  # of the prior's sd: above it noise has little effect


def verdict(ratio: float) -> str:
    """Verdict on an sd, as a part of the prior's."""
    if ratio > UNOBSERVABLE_ABOVE:
        return UNOBSERVABLE
    return OBSERVABLE if ratio < OBSERVABLE_BELOW else WEAK


def data_information(covariance: Array, prior_sd: Array) -> Array:
    """Information that the data add to the prior, in units of its sd.

    Parameters
    ----------
    covariance : ndarray, shape (..., c, c), after the dive
    prior_sd : ndarray, shape (c,)
    """
    relative = covariance / np.outer(prior_sd, prior_sd)
    return np.asarray(np.linalg.inv(relative) - np.eye(len(prior_sd)))


def relative_covariance(information: Array) -> Array:
    """Covariance after the dive in units of the prior's sd; ``information`` has shape (..., c, c)."""
    return np.asarray(np.linalg.inv(np.eye(information.shape[-1]) + information))


def without_spurious_information(best: Optimum, keyframes: Sequence[int], information: Array, sd: Array) -> Array:
    """Information without the spurious part from noise in the estimate.

    Parameters
    ----------
    best : the dive
    keyframes : at which the information was found, m
    information : ndarray, shape (m, c, c), of the data, linearised at the optimum
    sd : ndarray, shape (m, c), of the prior
    """
    more = np.zeros_like(information)
    for noisier in best.noisier(keyframes):
        more += 0.5 * np.array([data_information(P, s) for P, s in zip(noisier.calibration, sd, strict=True)])
    return not_negative(2.0 * information - more - _by_rate_noise(best, keyframes, sd))


def not_negative(information: Array) -> Array:
    """Without directions that would be known less than before, shape (..., c, c): `smooth` holds them at their priors.

    Considered variables make such an estimate worse than its prior.
    """
    value, axes = np.linalg.eigh(information)
    return np.asarray((axes * np.maximum(value, 0.0)[..., None, :]) @ np.swapaxes(axes, -1, -2))


def _by_rate_noise(best: Optimum, keyframes: Sequence[int], sd: Array) -> Array:
    """Spurious information of the DVL's arm, which grows with the dive, shape (m, c, c)."""
    out = np.zeros((*sd.shape, sd.shape[1]))
    if best.unknowns.walks.get(ARM) == 0.0:
        arm = np.r_[estimated_parts(best)[ARM]]
        until = (np.array(keyframes) + 1.0) / len(best.problem)
        out[:, arm, arm] = until[:, None] * score_of_rate_noise(best).information * sd[:, arm] ** 2
    return out


def relative_sd(best: Optimum, covariance: Array, prior: Mapping[str, Array]) -> dict[str, Array]:
    """sd of the calibration at the end as a part of the prior's, without spurious information.

    That is looked for only where it could change a verdict.

    Parameters
    ----------
    best : the dive
    covariance : ndarray, shape (c, c), of the estimated variables at the end
    prior : name -> ndarray, shape (dim,), their sd before

    Returns
    -------
    dict : name -> ndarray, shape (dim,)
    """
    ratio = {name: sd / prior[name] for name, sd in _sds(covariance, prior).items()}
    if best.unknowns.walks.get(ARM) == 0.0:
        ratio[ARM] = np.minimum(score_of_rate_noise(best).sd(ratio[ARM] * prior[ARM]) / prior[ARM], 1.0)
    at_stake = [r for name in SPURIOUSLY_OBSERVABLE if name in ratio for r in ratio[name]]
    if not any(DOUBTFUL_ABOVE < r <= UNOBSERVABLE_ABOVE for r in at_stake):
        return ratio
    end, before = [len(best.problem) - 1], np.concatenate([prior[name] for name in ratio])
    seen = data_information(covariance[None], before)
    without = _sds(relative_covariance(without_spurious_information(best, end, seen, before[None]))[0], prior)
    return without | {name: ratio[name] for name in ratio if name == ARM}


def shown(best: Optimum) -> list[str]:
    """Considered variables that the dive shows, so that they should be estimated."""
    if not best.unknowns.considered:
        return []
    relative = best.relative_sd()
    if ARM in relative and rate_noise_moves_arm(best, relative[ARM] * best.beliefs[ARM].sd):
        del relative[ARM]
    return [name for name, ratio in relative.items() if (ratio < shown_below(best, name)).all()]


def shown_below(best: Optimum, name: str) -> float:
    """The sd of a constant, as a part of the prior's, below which a dive shows it: less with spurious information."""
    if name == "dvl_scale" and "fix" in best.blocks:  # which noise does not make spurious
        return OBSERVABLE_BELOW
    return DOUBTFUL_ABOVE if name in SPURIOUSLY_OBSERVABLE else OBSERVABLE_BELOW


def spuriously_observable(
    unknowns: CalibrationRoles, claimed: Mapping[str, Array], relative: Mapping[str, Array]
) -> list[str]:
    """Constant variables that are unobservable, and that noise can have moved all the same.

    Parameters
    ----------
    unknowns : of the dive
    claimed, relative : name -> ndarray, shape (dim,), sd as a part of the prior's, as the smoother has
        it and without spurious information
    """
    constant = [name for name in SPURIOUSLY_OBSERVABLE if name in relative and not unknowns.walks[name]]
    return [n for n in constant if (relative[n] > UNOBSERVABLE_ABOVE).all() and (claimed[n] < STILL).any()]


def without_what_noise_moves(best: Optimum) -> tuple[Optimum, dict[str, Array]]:
    """The optimum, and the sd of its calibration at the end as a part of the prior's, without spurious information.

    What noise moves further than the data justify is considered.

    Returns
    -------
    Optimum : the dive
    dict : name -> ndarray, shape (dim,), of what was estimated
    """
    before = joint_prior_sd(best, len(best.problem) - 1)
    of_calibration = slice(NEWEST, NEWEST + sum(map(len, before.values())))
    covariance = best.newest_covariance()[of_calibration, of_calibration]
    relative = relative_sd(best, covariance, before)
    claimed = {name: sd / before[name] for name, sd in _sds(covariance, before).items()}
    held = spuriously_observable(best.unknowns, claimed, relative)
    return (best.considering(held) if held else best), relative


def _sds(covariance: Array, variables: Mapping[str, Array]) -> dict[str, Array]:
    """sd of each variable, shape (dim,), from the joint covariance of all in their order."""
    dims = [len(values) for values in variables.values()]
    return dict(zip(variables, np.split(np.sqrt(np.diag(covariance)), np.cumsum(dims)[:-1]), strict=False))
