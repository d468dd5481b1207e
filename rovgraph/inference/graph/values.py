"""Between GTSAM's `Values` and the arrays of a `State`.

Keys of the graph's variables: x pose, v velocity, b bias, n place, one letter per calibration.
"""

from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.model.calibration import TABLE
from rovgraph.model.state import BIAS, DIMENSION, PLACE, PLACE_DIM, POSE, VELOCITY, State
from rovgraph.problem.calibration_roles import CalibrationRoles

CALIBRATION = "calibration"  # all of it in a segment of time, as iSAM2 has it
_LETTER = {POSE: "x", VELOCITY: "v", BIAS: "b", PLACE: "n", CALIBRATION: "C"}
_NAMES = {ord(letter): variable for variable, letter in _LETTER.items()}
_SIZE = DIMENSION | {PLACE: PLACE_DIM}
_INDICES = 1 << 56  # of a letter
_PLACES = ord(_LETTER[PLACE])
_STATES = {ord(_LETTER[variable]) for variable in DIMENSION}


def key(variable: str, index: int = 0) -> int:
    """Key of a state variable at a keyframe, or of a calibration variable.

    Parameters
    ----------
    variable : "pose", "velocity", "bias", "place" or a name of the calibration table
    index : keyframe; number of a place; for calibration that walks its value, else 0
    """
    letter = _LETTER[variable] if variable in _LETTER else TABLE[variable].letter
    return ord(letter) * _INDICES + index  # as gtsam.symbol makes them


def dimension(key: int) -> int:
    """Of the variable that a key is of, in its tangent space."""
    variable = _variable(key // _INDICES)
    return _SIZE[variable] if variable in _SIZE else TABLE[variable].dim


def is_place(key: int) -> bool:
    """Whether a key is of a place."""
    return key // _INDICES == _PLACES


def key_index(key: int) -> tuple[bool, int]:
    """Whether a key is of a keyframe's state, and the index of its keyframe, else of its value."""
    letter, index = divmod(key, _INDICES)
    return letter in _STATES, index


def key_name(key: int) -> str:
    """A key in words, for messages."""
    letter, index = divmod(key, _INDICES)
    variable = _variable(letter)
    if variable == PLACE:
        return f"place {index}"
    return f"{variable} of keyframe {index}" if variable in DIMENSION else variable


def _variable(letter: int) -> str:
    """Whose letter it is."""
    if letter in _NAMES:
        return _NAMES[letter]
    return next(variable.name for variable in TABLE.values() if ord(variable.letter) == letter)


def calibration_key(unknowns: CalibrationRoles, name: str, index: int) -> int:
    """Key of an estimated calibration variable: of its value with that index, where it walks."""
    return key(name, index if unknowns.walks[name] else 0)


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
    values: gtsam.Values, calibration: Mapping[str, Array], unknowns: CalibrationRoles, segment: int = 0
) -> None:
    """Insert the calibration variables that a segment begins."""
    for name in unknowns.begun_by(segment):
        values.insert(calibration_key(unknowns, name, segment), np.array(calibration[name], dtype=float).ravel())


def state_at(values: gtsam.Values, index: int, segment: int, unknowns: CalibrationRoles) -> State:
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


def states_from(values: gtsam.Values, segment: NDArray[np.int64], unknowns: CalibrationRoles) -> State:
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
