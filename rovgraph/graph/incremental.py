"""Incremental smoothing over a whole dive: iSAM2 (Kaess et al. 2012).

With QR, as Cholesky finds preintegrated IMU factors indefinite now and then, and thresholds
of relinearisation per kind of variable. The measurements' factors call back into Python; the
reference to the linearisation point that is kept here lets the bindings hand them that object
instead of a copy, without which the cost of a callback grows with the dive.
"""

from collections.abc import Iterable, Sequence

import gtsam
import numpy as np

from rovgraph.calibration import TABLE
from rovgraph.engine.unknowns import Unknowns
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.graph.batch import indeterminate
from rovgraph.graph.keys import calibration_key, key
from rovgraph.state import BIAS, PLACE, POSE, VELOCITY, State

# Changes beyond which iSAM2 relinearises a variable. Positions and velocities too: the IMU's
# factor multiplies them with the attitude.
THRESHOLDS = {
    "x": [0.02, 0.02, 0.02, 1.0, 1.0, 1.0],  # [rad, m]
    "v": [0.05, 0.05, 0.05],  # [m/s]
    "b": [0.01] * 6,  # [m/s^2, rad/s]
    "n": [1.0, 1.0],  # [m], of a place
}
CALIBRATION_THRESHOLD = 0.01  # [rad, 1]
WILDFIRE = 1e-2  # change of an estimate below which it is not propagated


def isam2_params() -> gtsam.ISAM2Params:
    """Parameters of the engine."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.relinearizeSkip = 10
    params.enablePartialRelinearizationCheck = True  # down the tree, as far as anything has moved
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
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def add(self, factors: Iterable[gtsam.NonlinearFactor], values: gtsam.Values) -> None:
        """Have factors, and the initial values of their new variables, wait for the next update."""
        for factor in factors:
            self._graph.add(factor)
        self._values.insert(values)

    def update(self) -> None:
        """Take what has been added.

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        graph, values = self._graph, self._values
        self._graph, self._values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        try:
            self._engine.update(graph, values)
        except RuntimeError as error:
            raise InputError(indeterminate(error)) from None

    def copy_values(self) -> None:
        """Let the bindings copy all values for each callback, as they do by themselves: to measure what that costs."""
        del self._theta

    def state(self, index: int, segment: int) -> State:
        """Estimate of a keyframe, as a `State` of one epoch, calibration included."""
        engine, unknowns = self._engine, self._unknowns
        pose = engine.calculateEstimatePose3(key(POSE, index))
        names = unknowns.estimated
        calibration = {name: engine.calculateEstimateVector(calibration_key(unknowns, name, segment)) for name in names}
        return State(
            pose.rotation().matrix()[None],
            pose.translation()[None],
            engine.calculateEstimateVector(key(VELOCITY, index))[None],
            engine.calculateEstimateConstantBias(key(BIAS, index)).vector()[None],
            {**unknowns.fixed, **calibration},
        )

    def newest(self, index: int, segment: int, places: Sequence[int]) -> tuple[State, Array, list[Array]]:
        """The newest keyframe, its joint covariance with the calibration there and with places, and where these are.

        Parameters
        ----------
        index, segment : of the keyframe
        places : numbers of places

        Returns
        -------
        state : State of one epoch
        P : ndarray, shape (d, d), pose, velocity, bias, calibration in the order of `Unknowns`, places
        positions : ndarray, shape (2,), for each place
        """
        keys = [key(v, index) for v in (POSE, VELOCITY, BIAS)]
        keys += [calibration_key(self._unknowns, name, segment) for name in self._unknowns.estimated]
        keys += [key(PLACE, number) for number in places]
        P = self._engine.jointMarginalCovariance(keys).fullMatrix()
        return (
            self.state(index, segment),
            P,
            [self._engine.calculateEstimateVector(k) for k in keys[len(keys) - len(places) :]],
        )

    def values(self) -> gtsam.Values:
        """Estimates of all variables."""
        values: gtsam.Values = self._engine.calculateBestEstimate()
        return values
