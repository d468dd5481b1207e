"""The IMU's motion over an interval as a factor between its keyframes."""

from collections.abc import Mapping

import gtsam
import numpy as np

from rovgraph.engine.keyframes import KeyframeInterval
from rovgraph.engine.motion import Motion
from rovgraph.engine.scale import COLUMNS, SCALES
from rovgraph.engine.transition import residual, whitening
from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array
from rovgraph.graph.keys import calibration_key, key
from rovgraph.state import BIAS, POSE, VELOCITY, State

_ENDS = [6, 9, 15, 21, 24]  # of pose, velocity, bias of two keyframes side by side


def motion_factor(interval: KeyframeInterval, unknowns: Unknowns, index: int) -> gtsam.NonlinearFactor:
    """GTSAM's own factor of an interval with motion, or one of an IMU whose scale may be off, or of coasting."""
    motion, S = interval.motion, interval.scale_to_bias
    assert motion is not None
    if motion.coasted:
        return custom_factor(interval, unknowns.fixed, {})
    if S is not None:
        keys = {name: calibration_key(unknowns, name, index) for name in SCALES if name in unknowns.walks}
        return custom_factor(interval, unknowns.fixed, keys)
    pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j = _keys(interval)
    return gtsam.CombinedImuFactor(pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j, preintegrated(motion))


def preintegrated(motion: Motion) -> gtsam.PreintegratedCombinedMeasurements:
    """GTSAM's motion, integrated from the same steps."""
    params = gtsam.PreintegrationCombinedParams.MakeSharedD(motion.gravity)
    acc, gyr, acc_walk, gyr_walk, integration = motion.densities.tolist()
    params.setAccelerometerCovariance(np.eye(3) * acc**2)
    params.setGyroscopeCovariance(np.eye(3) * gyr**2)
    params.setBiasAccCovariance(np.eye(3) * acc_walk**2)
    params.setBiasOmegaCovariance(np.eye(3) * gyr_walk**2)
    params.setIntegrationCovariance(np.eye(3) * integration**2)
    if motion.earth_rate_n.any():
        params.setOmegaCoriolis(motion.earth_rate_n)
    bias = motion.bias
    pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias(bias[:3], bias[3:]))
    for step in motion.steps():
        pim.integrateMeasurement(step[2:5], step[5:8], step[1])
    return pim


def custom_factor(
    interval: KeyframeInterval, fixed: Mapping[str, Array], keys: Mapping[str, int]
) -> gtsam.CustomFactor:
    """The residual of `rovgraph.kernels.motion_residual` as a factor, which knows the IMU's scales.

    Parameters
    ----------
    interval : with motion
    fixed : name -> ndarray, shape (3,), values of the scales that are not estimated
    keys : of those that are
    """
    own, W, S = _keys(interval), whitening(interval), interval.scale_to_bias

    def state(values: gtsam.Values, pose: int, velocity: int, bias: int) -> State:
        at, v_n, b = values.atPose3(pose), values.atVector(velocity), values.atConstantBias(bias).vector()
        scales = {name: values.atVector(keys[name]) if name in keys else fixed[name] for name in SCALES}
        return State(at.rotation().matrix()[None], at.translation()[None], v_n[None], b[None], scales)

    def error(_: gtsam.CustomFactor, values: gtsam.Values, H: list[Array] | None) -> Array:
        before, after = state(values, own[0], own[1], own[4]), state(values, own[2], own[3], own[5])
        r, A_i, A_j = residual(interval, before, after)
        if H is not None:
            pose_i, velocity_i, bias_i, pose_j, velocity_j, bias_j = np.split(W @ np.hstack([A_i, A_j]), _ENDS, axis=1)
            for place, part in enumerate((pose_i, velocity_i, pose_j, velocity_j, bias_i, bias_j)):
                H[place] = part
            for place, name in enumerate(keys, 6):  # they move both states as a bias would, and not the bias itself
                assert S is not None
                H[place] = W[:, :9] @ A_i[:9, 9:] @ S[:, COLUMNS[name]]
        return np.asarray(W @ r)

    return gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(15), [*own, *keys.values()], error)


def _keys(interval: KeyframeInterval) -> list[int]:
    """In the order of GTSAM's factor."""
    i, j = interval.index - 1, interval.index
    return [key(POSE, i), key(VELOCITY, i), key(POSE, j), key(VELOCITY, j), key(BIAS, i), key(BIAS, j)]
