"""The graph as lists of factors: priors, and what an interval adds.

Batch and iSAM2 consume the same lists.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import gtsam
import numpy as np

from rovgraph.calibration import Belief
from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array, transpose
from rovgraph.graph.keys import calibration_key, key
from rovgraph.graph.motion_factors import motion_factor
from rovgraph.state import BIAS, PLACE, PLACE_DIM, POSE, VELOCITY, State

Factor = gtsam.NonlinearFactor
ANYWHERE_M = 1e5  # sd of the prior of a place, about the origin


@dataclass(frozen=True)
class Start:
    """What is believed at the first keyframe.

    Attributes
    ----------
    state : State of one epoch, at the IMU
    rpy_sd, p_sd, v_sd : ndarray, shape (3,) [rad, m, m/s]; attitude about n's axes, as
        roll and pitch are small
    bias_sd : ndarray, shape (6,)
    """

    state: State
    rpy_sd: Array
    p_sd: Array
    v_sd: Array
    bias_sd: Array


def priors(start: Start, beliefs: Mapping[str, Belief], unknowns: Unknowns) -> list[Factor]:
    """Priors of the first keyframe and of the calibration variables."""
    state = start.state
    R_nb, sigmas = state.R_nb[0], gtsam.noiseModel.Diagonal.Sigmas
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = transpose(R_nb) @ np.diag(start.rpy_sd**2) @ R_nb
    covariance[3:, 3:] = transpose(R_nb) @ np.diag(start.p_sd**2) @ R_nb
    pose = gtsam.Pose3(gtsam.Rot3(R_nb), state.p_n[0])
    bias = gtsam.imuBias.ConstantBias(state.bias[0, :3], state.bias[0, 3:])
    return [
        gtsam.PriorFactorPose3(key(POSE, 0), pose, gtsam.noiseModel.Gaussian.Covariance(covariance)),
        gtsam.PriorFactorVector(key(VELOCITY, 0), state.v_n[0], sigmas(start.v_sd)),
        gtsam.PriorFactorConstantBias(key(BIAS, 0), bias, sigmas(start.bias_sd)),
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


def motion(interval: KeyframeInterval, unknowns: Unknowns) -> list[Factor]:
    """The factor between the keyframe before and the one that ends the interval, where there is one."""
    return [] if interval.motion is None else [motion_factor(interval, unknowns)]


def drift(unknowns: Unknowns, segment: int, duration: float) -> list[Factor]:
    """The random walk of calibration variables into a segment from the one before, which lasted ``duration`` [s]."""
    if segment == 0:
        return []
    return [
        gtsam.BetweenFactorVector(
            calibration_key(unknowns, name, segment - 1),
            calibration_key(unknowns, name, segment),
            np.zeros(len(unknowns.fixed[name])),
            gtsam.noiseModel.Isotropic.Sigma(len(unknowns.fixed[name]), unknowns.walks[name] * np.sqrt(duration)),
        )
        for name in unknowns.begun_by(segment)
    ]
