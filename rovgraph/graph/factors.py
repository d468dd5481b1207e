"""Priors and walks as lists of factors."""

from collections.abc import Mapping

import gtsam
import numpy as np

from rovgraph.calibration import Belief
from rovgraph.engine.initial_conditions import StatePrior
from rovgraph.engine.unknowns import Unknowns
from rovgraph.graph.keys import calibration_key, key
from rovgraph.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY

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


def drift(unknowns: Unknowns, index: int, duration: float) -> list[Factor]:
    """The walk of calibration variables to a value from the one before, over ``duration`` [s]."""
    return [] if index == 0 else [_walk(unknowns, name, index, duration) for name in unknowns.begun_by(index)]


def _walk(unknowns: Unknowns, name: str, index: int, duration: float) -> Factor:
    """Whitened, ``x' - mean = kept (x - mean)``."""
    mean, (kept, sd) = unknowns.fixed[name], unknowns.walked(name, duration)
    here, there = calibration_key(unknowns, name, index), calibration_key(unknowns, name, index - 1)
    if name not in unknowns.time_constants:
        return gtsam.BetweenFactorVector(there, here, 0.0 * mean, gtsam.noiseModel.Isotropic.Sigma(len(mean), sd))
    weight, origin = np.eye(len(mean)) / sd, gtsam.Values()
    origin.insert(here, np.zeros(len(mean)))
    origin.insert(there, np.zeros(len(mean)))
    off = (1.0 - kept) / sd * mean
    linear = gtsam.JacobianFactor(there, -kept * weight, here, weight, off, gtsam.noiseModel.Unit.Create(len(mean)))
    return gtsam.LinearContainerFactor(linear, origin)
