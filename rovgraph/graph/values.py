"""Between GTSAM's `Values` and the arrays of a `State`."""

from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.engine.unknowns import Unknowns
from rovgraph.geometry import Array
from rovgraph.graph.keys import calibration_key, key
from rovgraph.state import BIAS, POSE, VELOCITY, State


def gtsam_state(state: State) -> tuple[gtsam.Pose3, Array, gtsam.imuBias.ConstantBias]:
    """Pose, velocity and bias of a `State` of one epoch."""
    pose = gtsam.Pose3(gtsam.Rot3(state.R_nb[0]), state.p_n[0])
    return pose, state.v_n[0], gtsam.imuBias.ConstantBias(state.bias[0, :3], state.bias[0, 3:])


def insert_state(values: gtsam.Values, index: int, state: State) -> None:
    """Insert pose, velocity and bias of a `State` of one epoch as keyframe ``index``."""
    pose, velocity, bias = gtsam_state(state)
    values.insert(j=key(POSE, index), pose3=pose)  # unnamed, the bindings try dozens of other types first
    values.insert(j=key(VELOCITY, index), vector=velocity)
    values.insert(j=key(BIAS, index), constant_bias=bias)


def state_values(index: int, state: State) -> gtsam.Values:
    """Values of one keyframe's state, without calibration."""
    values = gtsam.Values()
    insert_state(values, index, state)
    return values


def insert_calibration(
    values: gtsam.Values, calibration: Mapping[str, Array], unknowns: Unknowns, segment: int = 0
) -> None:
    """Insert the calibration variables that a segment begins."""
    for name in unknowns.begun_by(segment):
        values.insert(calibration_key(unknowns, name, segment), np.array(calibration[name], dtype=float).ravel())


def state_at(values: gtsam.Values, index: int, segment: int, unknowns: Unknowns) -> State:
    """The state at one keyframe, which lies in ``segment``, as a `State` of one epoch."""
    pose = values.atPose3(key(POSE, index))
    estimated = {name: values.atVector(calibration_key(unknowns, name, segment)) for name in unknowns.estimated}
    return State(
        pose.rotation().matrix()[None],
        pose.translation()[None],
        values.atVector(key(VELOCITY, index))[None],
        values.atConstantBias(key(BIAS, index)).vector()[None],
        {**unknowns.fixed, **estimated},
    )


def states_from(values: gtsam.Values, segment: NDArray[np.int64], unknowns: Unknowns) -> State:
    """The states at all keyframes, read in bulk.

    Parameters
    ----------
    values : of all variables
    segment : ndarray of int, shape (n,), of each keyframe, from 0 and by steps of 1
    unknowns : Unknowns; variables that walk come out per epoch, shape (n, dim)
    """
    poses = gtsam.utilities.extractPose3(values)  # in the order of keys: 9 of R by rows, then p
    biases = np.array([values.atConstantBias(key(BIAS, i)).vector() for i in range(len(segment))])
    calibration = dict(unknowns.fixed)
    for name, walk in unknowns.walks.items():
        if walk:
            per_segment = np.array([values.atVector(key(name, s)) for s in range(int(segment[-1]) + 1)])
            calibration[name] = per_segment[segment]
        else:
            calibration[name] = values.atVector(key(name))
    return State(
        poses[:, :9].reshape(-1, 3, 3), poses[:, 9:], gtsam.utilities.extractVectors(values, "v"), biases, calibration
    )
