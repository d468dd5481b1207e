"""Incremental smoothing over a whole dive: iSAM2 (Kaess et al. 2012).

With QR, as Cholesky finds preintegrated IMU factors indefinite now and then, and thresholds
of relinearisation per kind of variable. The measurements' factors call back into Python; the
reference to the linearisation point that is kept here lets the bindings hand them that object
instead of a copy, without which the cost of a callback grows with the dive.
"""

from collections.abc import Iterable

import gtsam
import numpy as np

from rovgraph.calibration import TABLE
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.graph.batch import indeterminate
from rovgraph.graph.keys import Unknowns, key
from rovgraph.state import BIAS, DIMENSION, POSE, VELOCITY, State

# Changes beyond which iSAM2 relinearises a variable. Positions and velocities too: the IMU's
# factor multiplies them with the attitude.
THRESHOLDS = {
    "x": [0.002, 0.002, 0.002, 0.005, 0.005, 0.005],  # [rad, m]
    "v": [0.005, 0.005, 0.005],  # [m/s]
    "b": [0.002] * 6,  # [m/s^2, rad/s]
}
CALIBRATION_THRESHOLD = 0.002  # [rad, 1]
WILDFIRE = 1e-5  # change of an estimate below which it is not propagated


def isam2_params() -> gtsam.ISAM2Params:
    """Parameters of the engine."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(WILDFIRE))
    thresholds = gtsam.ISAM2ThresholdMap()
    for letter, changes in THRESHOLDS.items():
        thresholds.insert((letter, np.array(changes)))
    for variable in TABLE.values():
        thresholds.insert((variable.letter, np.full(variable.dim, CALIBRATION_THRESHOLD)))
    params.setRelinearizeThreshold(thresholds)
    return params


class Incremental:
    """iSAM2 with the keys of a dive.

    Parameters
    ----------
    unknowns : the calibration variables
    """

    def __init__(self, unknowns: Unknowns) -> None:
        self._unknowns = unknowns
        self._engine = gtsam.ISAM2(isam2_params())
        self._theta = self._engine.getLinearizationPoint()

    def update(self, factors: Iterable[gtsam.NonlinearFactor], values: gtsam.Values) -> None:
        """Add a step's factors and the initial values of its new variables.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        try:
            self._engine.update(graph, values)
        except RuntimeError as error:
            raise InputError(indeterminate(error)) from None

    def state(self, index: int, segment: int) -> State:
        """Estimate of a keyframe, as a `State` of one epoch, calibration included."""
        engine, unknowns = self._engine, self._unknowns
        pose = engine.calculateEstimatePose3(key(POSE, index))
        names = unknowns.estimated
        calibration = {name: engine.calculateEstimateVector(unknowns.key(name, segment)) for name in names}
        return State(
            pose.rotation().matrix()[None],
            pose.translation()[None],
            engine.calculateEstimateVector(key(VELOCITY, index))[None],
            engine.calculateEstimateConstantBias(key(BIAS, index)).vector()[None],
            {**unknowns.fixed, **calibration},
        )

    def covariances(self, index: int, segment: int, names: Iterable[str]) -> dict[str, Array]:
        """Marginal covariances of a keyframe's state variables, and of the calibration variables ``names``."""
        keys = {v: key(v, index) for v in DIMENSION}
        keys |= {name: self._unknowns.key(name, segment) for name in names}
        joint = self._engine.jointMarginalCovariance(list(keys.values()))  # one sweep for all of them
        return {v: np.asarray(joint.at(k, k)) for v, k in keys.items()}

    def values(self) -> gtsam.Values:
        """Estimates of all variables."""
        values: gtsam.Values = self._engine.calculateEstimate()
        return values
