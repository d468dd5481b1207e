"""Incremental smoothing: iSAM2 over the whole dive, or over a fixed lag.

iSAM2 (Kaess et al. 2012) with QR, as Cholesky finds preintegrated IMU factors indefinite
now and then, and thresholds of relinearisation per kind of variable. Over a whole dive
the measurements' factors call back into Python; the reference to the linearisation point
that is kept here lets the bindings hand them that object instead of a copy, without which
the cost of a callback grows with the dive.
"""

from collections.abc import Iterable
from typing import Any

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


def isam2_params(relinearise: bool) -> gtsam.ISAM2Params:
    """Parameters of an engine; without relinearisation where all factors are linear."""
    params = gtsam.ISAM2Params()
    params.setFactorization("QR")
    params.relinearizeSkip = 1
    params.findUnusedFactorSlots = True
    params.enableRelinearization = relinearise
    params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(WILDFIRE))
    thresholds = gtsam.ISAM2ThresholdMap()
    for letter, changes in THRESHOLDS.items():
        thresholds.insert((letter, np.array(changes)))
    for variable in TABLE.values():
        thresholds.insert((variable.letter, np.full(variable.dim, CALIBRATION_THRESHOLD)))
    params.setRelinearizeThreshold(thresholds)
    return params


class Incremental:
    """One interface to iSAM2 and to the fixed-lag smoother.

    Parameters
    ----------
    lag : length of the window [s], or None for the whole dive
    unknowns : the calibration variables
    """

    def __init__(self, lag: float | None, unknowns: Unknowns) -> None:
        self.lag, self._unknowns = lag, unknowns
        params = isam2_params(relinearise=lag is None)
        self._engine: Any = gtsam.ISAM2(params) if lag is None else gtsam.IncrementalFixedLagSmoother(lag, params)
        self._theta = self._engine.getLinearizationPoint()

    def update(self, factors: Iterable[gtsam.NonlinearFactor], values: gtsam.Values, time: float, segment: int) -> None:
        """Add a step's factors and the initial values of its new variables.

        Parameters
        ----------
        factors : of the step
        values : of the variables that are new
        time, segment : of the newest keyframe

        Raises
        ------
        InputError : the data do not determine some variable, which is named
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in factors:
            graph.add(factor)
        stamps: tuple[dict[int, float], ...] = ()
        if self.lag is not None:
            stamps = (dict.fromkeys([*values.keys(), *self._calibration_keys(segment)], time),)
        try:
            self._engine.update(graph, values, *stamps)
        except RuntimeError as error:
            raise InputError(indeterminate(error)) from None

    def _calibration_keys(self, segment: int) -> list[int]:
        return [self._unknowns.key(name, segment) for name in self._unknowns.estimated]

    def restart(
        self, linear: gtsam.GaussianFactorGraph, values: gtsam.Values, keyframes: Iterable[tuple[int, float, int]]
    ) -> None:
        """Begin anew with a dive so far, linearised at its optimum; only with a lag.

        Parameters
        ----------
        linear : all factors, linearised at ``values``
        values : of all variables
        keyframes : index, time [s] and segment of each, in order
        """
        self._engine = gtsam.IncrementalFixedLagSmoother(self.lag or 0.0, isam2_params(relinearise=False))
        stamps: dict[int, float] = {}
        for index, time, segment in keyframes:
            stamps |= dict.fromkeys([*(key(v, index) for v in DIMENSION), *self._calibration_keys(segment)], time)
        self._engine.update(gtsam.LinearContainerFactor.ConvertLinearGraph(linear, values), values, stamps)
        self._theta = self._engine.getLinearizationPoint()

    def state(self, index: int, segment: int) -> State:
        """Estimate of a keyframe within the lag, as a `State` of one epoch, calibration included."""
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
        isam = self._engine if self.lag is None else self._engine.getISAM2()
        joint = isam.jointMarginalCovariance(list(keys.values()))  # one sweep for all of them
        return {v: np.asarray(joint.at(k, k)) for v, k in keys.items()}

    def values(self) -> gtsam.Values:
        """Estimates of all variables that are still in the graph."""
        values: gtsam.Values = self._engine.calculateEstimate()
        return values
