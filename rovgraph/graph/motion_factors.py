"""The IMU's motion over an interval as a factor between its keyframes."""

from collections.abc import Mapping

import gtsam
import numpy as np

from rovgraph.engine.problem import Problem
from rovgraph.engine.scale import COLUMNS, SCALES, biased
from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array
from rovgraph.graph.keys import calibration_key, key
from rovgraph.kernels import motion_row as at
from rovgraph.kernels.motion_residual import motion_errors
from rovgraph.kernels.states import States
from rovgraph.state import BIAS, POSE, VELOCITY, State

_ENDS = [6, 9, 15, 21, 24]  # of pose, velocity, bias of two keyframes side by side


def motion_factor(problem: Problem, k: int, unknowns: Unknowns, index: int) -> gtsam.NonlinearFactor:
    """GTSAM's own factor of the motion to keyframe k, or one of an IMU whose scale may be off, or of coasting.

    ``index`` is that of the value which calibration that walks has there.
    """
    if problem.coasted[k]:
        return custom_factor(problem, k, unknowns.fixed, {})
    if len(problem.scales):
        keys = {name: calibration_key(unknowns, name, index) for name in SCALES if name in unknowns.walks}
        return custom_factor(problem, k, unknowns.fixed, keys)
    pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j = _keys(k)
    motion = preintegrated(problem.motions[k - 1], problem.steps(k))
    return gtsam.CombinedImuFactor(pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j, motion)


def preintegrated(motion: Array, steps: Array) -> gtsam.PreintegratedCombinedMeasurements:
    """GTSAM's motion, integrated from the same steps."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedD(float(motion[at.GRAVITY]))
    acc, gyr, acc_walk, gyr_walk, integration = motion[at.NOISE : at.GRAVITY].tolist()
    params.setAccelerometerCovariance(np.eye(3) * acc**2)
    params.setGyroscopeCovariance(np.eye(3) * gyr**2)
    params.setBiasAccCovariance(np.eye(3) * acc_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * gyr_walk**2)
    params.setIntegrationCovariance(np.eye(3) * integration**2)
    if (earth_rate_n := motion[at.EARTH_RATE : at.BY_BIAS]).any():
        params.setOmegaCoriolis(earth_rate_n)
    bias = motion[at.BIAS : at.NOISE]
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    for step in steps:
        pim.integrateMeasurement(step[2:5], step[5:8], step[1])
    return pim


def custom_factor(problem: Problem, k: int, fixed: Mapping[str, Array], keys: Mapping[str, int]) -> gtsam.CustomFactor:
    """The residual of `rovgraph.kernels.motion_residual` as a factor, which knows the IMU's scales.

    Parameters
    ----------
    problem, k : the motion to keyframe k
    fixed : name -> ndarray, shape (3,), values of the scales that are not estimated
    keys : of those that are
    """
    own, W, row = _keys(k), problem.weights[k - 1], problem.motions[k - 1 : k]
    S = problem.scales[k - 1] if len(problem.scales) else None

    def state(values: gtsam.Values, pose: int, velocity: int, bias: int) -> States:
        at_, v_n, b = values.atPose3(pose), values.atVector(velocity), values.atConstantBias(bias).vector()
        scales = {name: values.atVector(keys[name]) if name in keys else fixed[name] for name in SCALES}
        one = State(at_.rotation().matrix()[None], at_.translation()[None], v_n[None], b[None], scales)
        seen = one if S is None else biased(one, S[None])
        # copies: GTSAM's arrays may be read-only, which kernels do not take
        return States(*(np.array(a, order="C") for a in (seen.R_nb, seen.p_n, seen.v_n, seen.bias)))

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        r, A_i, A_j = np.empty((1, 15)), np.empty((1, 15, 15)), np.empty((1, 15, 15))
        ends = state(values, own[0], own[1], own[4]), state(values, own[2], own[3], own[5])
        motion_errors(row, *ends, r, A_i, A_j)
        if H is not None:
            J = W @ np.hstack([A_i[0], A_j[0]])
            pose_i, velocity_i, bias_i, pose_j, velocity_j, bias_j = np.split(J, _ENDS, axis=1)
            for place, part in enumerate((pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j)):
                H[place] = part
            for place, name in enumerate(keys, 6):  # they move both states as a bias would, and not the bias itself
                assert S is not None
                H[place] = W[:, :9] @ A_i[0, :9, 9:] @ S[:, COLUMNS[name]]
        return np.asarray(W @ r[0])

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(15), [*own, *keys.values()], error)


def _keys(k: int) -> list[int]:
    """In the order of GTSAM's factor."""
    i = k - 1
    return [key(POSE, i), key(VELOCITY, i), key(POSE, k), key(VELOCITY, k), key(BIAS, i), key(BIAS, k)]
