"""The graph as lists of factors: priors, and what an interval adds.

Batch and iSAM2 consume the same lists.
"""

from collections.abc import Mapping
from dataclasses import replace

import gtsam
import numpy as np

from rovgraph.calibration import Belief
from rovgraph.engine.initial_conditions import StatePrior
from rovgraph.graph.assembly import KeyframeInterval
from rovgraph.graph.coasting import coasted, coasting_factor, in_outage
from rovgraph.engine.unknowns import Unknowns
from rovgraph.graph.keys import calibration_key, key
from rovgraph.graph.scale import SCALES, biased, scaled_factor
from rovgraph.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY, State

Factor = gtsam.NonlinearFactor
ANYWHERE_M = 1e5  # sd of the prior of a place, about the origin


def priors(prior: StatePrior, beliefs: Mapping[str, Belief], unknowns: Unknowns) -> list[Factor]:
    """Priors of the first keyframe and of the calibration variables."""
    state = prior.state
    R_nb, sigmas = state.R_nb[0], gtsam.noiseModel.Diagonal.Sigmas
    attitude = gtsam.noiseModel.Gaussian.Covariance(prior.covariance()[:3, :3])
    bias = gtsam.imuBias.ConstantBias(state.bias[0, :3], state.bias[0, 3:])
    return [
        gtsam.PoseRotationPrior3D(key(POSE, 0), gtsam.Rot3(R_nb), attitude),
        gtsam.PoseTranslationPrior3D(key(POSE, 0), state.p_n[0], sigmas(prior.p_sd)),
        gtsam.PriorFactorVector(key(VELOCITY, 0), state.v_n[0], sigmas(prior.v_sd)),
        gtsam.PriorFactorConstantBias(key(BIAS, 0), bias, sigmas(prior.bias_sd)),
        *(
            gtsam.PriorFactorVector(key(name), beliefs[name].mean, sigmas(np.full(b.variable.dim, b.sd)))
            for name, b in ((name, beliefs[name]) for name in unknowns.estimated)
        ),
    ]


def landmark_prior(number: int) -> Factor:
    """The prior of a place: it says next to nothing, and determines a place that all gates have shut out."""
    return gtsam.PriorFactorVector(
        key(PLACE, number), np.zeros(PLACE_DIM), gtsam.noiseModel.Isotropic.Sigma(PLACE_DIM, ANYWHERE_M)
    )


def motion(interval: KeyframeInterval, unknowns: Unknowns, index: int) -> list[Factor]:
    """The factor between the keyframe before and the one that ends the interval: the IMU's, or of coasting.

    ``index`` is that of the value which calibration that walks has there.
    """
    if interval.pim is None:
        return []
    if in_outage(interval):
        return [coasting_factor(interval)]
    if interval.scale_to_bias is None:
        return [unscaled(interval)]
    keys = {name: calibration_key(unknowns, name, index) for name in SCALES if name in unknowns.walks}
    return [scaled_factor(unscaled(interval), interval.scale_to_bias, unknowns.fixed, keys)]


def unscaled(interval: KeyframeInterval) -> gtsam.CombinedImuFactor:
    """GTSAM's own factor of an interval with motion, which knows no scales."""
    assert interval.pim is not None
    i, j = interval.index - 1, interval.index
    before, after = (key(POSE, i), key(VELOCITY, i)), (key(POSE, j), key(VELOCITY, j))
    return gtsam.CombinedImuFactor(*before, *after, key(BIAS, i), key(BIAS, j), interval.pim)


def drift(unknowns: Unknowns, index: int, duration: float) -> list[Factor]:
    """The random walk of calibration variables to a value from the one before, over ``duration`` [s]."""
    if index == 0:
        return []
    return [
        gtsam.BetweenFactorVector(
            calibration_key(unknowns, name, index - 1),
            calibration_key(unknowns, name, index),
            np.zeros(len(unknowns.fixed[name])),
            gtsam.noiseModel.Isotropic.Sigma(len(unknowns.fixed[name]), unknowns.walks[name] * np.sqrt(duration)),
        )
        for name in unknowns.begun_by(index)
    ]


def predict(interval: KeyframeInterval, state: State) -> State:
    """The state at the end of an interval, from the IMU alone, or from nothing while it is silent.

    Parameters
    ----------
    interval : with motion
    state : State of one epoch, of the keyframe before
    """
    if in_outage(interval):
        return coasted(interval, state)
    assert interval.pim is not None
    scale_to_bias = state if interval.scale_to_bias is None else biased(state, interval.scale_to_bias[None])
    bias = gtsam.imuBias.ConstantBias(scale_to_bias.bias[0, :3], scale_to_bias.bias[0, 3:])
    before = gtsam.NavState(gtsam.Rot3(state.R_nb[0]), state.p_n[0], state.v_n[0])
    after = interval.pim.predict(before, bias)
    # in rows: products of matrices in columns round otherwise, and filters side by side are to be as each alone
    R_nb = np.ascontiguousarray(after.attitude().matrix())
    return replace(state, R_nb=R_nb[None], p_n=after.position()[None], v_n=after.velocity()[None])
