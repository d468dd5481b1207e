"""Between GTSAM's `Values` and the arrays of a `State`."""

from collections.abc import Iterable, Mapping

import gtsam
import numpy as np

from rovgraph.geometry import Array
from rovgraph.graph.keys import key
from rovgraph.state import BIAS, POSE, VELOCITY, State


def insert_state(values: gtsam.Values, index: int, state: State) -> None:
    """Insert pose, velocity and bias of a `State` of one epoch as keyframe ``index``."""
    values.insert(key(POSE, index), gtsam.Pose3(gtsam.Rot3(state.R_nb[0]), state.p_n[0]))
    values.insert(key(VELOCITY, index), state.v_n[0])
    values.insert(key(BIAS, index), gtsam.imuBias.ConstantBias(state.bias[0, :3], state.bias[0, 3:]))


def insert_calibration(values: gtsam.Values, calibration: Mapping[str, Array], estimated: Iterable[str]) -> None:
    """Insert the calibration variables that are estimated."""
    for name in estimated:
        values.insert(key(name), np.array(calibration[name], dtype=float))


def calibration_from(values: gtsam.Values, fixed: Mapping[str, Array], estimated: Iterable[str]) -> dict[str, Array]:
    """All calibration variables: the estimated ones from ``values``, the rest from ``fixed``."""
    return {**fixed, **{name: values.atVector(key(name)) for name in estimated}}


def state_at(values: gtsam.Values, index: int, fixed: Mapping[str, Array], estimated: Iterable[str]) -> State:
    """The state at one keyframe, as a `State` of one epoch."""
    pose = values.atPose3(key(POSE, index))
    return State(
        pose.rotation().matrix()[None],
        pose.translation()[None],
        values.atVector(key(VELOCITY, index))[None],
        values.atConstantBias(key(BIAS, index)).vector()[None],
        calibration_from(values, fixed, estimated),
    )


def states_from(values: gtsam.Values, count: int, fixed: Mapping[str, Array], estimated: Iterable[str]) -> State:
    """The states at keyframes 0 to count - 1, read in bulk."""
    poses = gtsam.utilities.extractPose3(values)  # in the order of keys: 9 of R by rows, then p
    biases = np.array([values.atConstantBias(key(BIAS, i)).vector() for i in range(count)])
    return State(
        poses[:, :9].reshape(-1, 3, 3),
        poses[:, 9:],
        gtsam.utilities.extractVectors(values, "v"),
        biases,
        calibration_from(values, fixed, estimated),
    )
