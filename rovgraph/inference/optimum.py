"""The optimum of a dive and its covariances, whichever solver found it."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.gauss_newton import GaussNewtonResult
from rovgraph.model.calibration import Belief
from rovgraph.model.state import State
from rovgraph.problem.calibration_roles import CalibrationRoles
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.measurements import Measurements
from rovgraph.problem.problem import Problem

NEWEST = 15  # components of `Optimum.newest_covariance` before those of the calibration
OTHERS = 9  # components of `Knowledge.covariance` before those of the calibration


@dataclass(frozen=True)
class Knowledge:
    """Estimates of the calibration at m keyframes, from all data up to each.

    Attributes
    ----------
    keyframe : ndarray of int, shape (m,)
    covariance : ndarray, shape (m, 9 + c, 9 + c), joint of the newest bias (6), of the first
        keyframe's attitude (3), body axes, and of the calibration (c) in the order of
        `CalibrationRoles`, of what walks the newest value
    """

    keyframe: NDArray[np.int64]
    covariance: Array

    @property
    def calibration(self) -> Array:
        """Covariance of the calibration alone, shape (m, c, c)."""
        return self.covariance[:, OTHERS:, OTHERS:]


class Optimum(Protocol):
    """A dive of n keyframes, solved.

    Attributes
    ----------
    problem, initial : the dive, each landmark given to its place, and how it begins
    beliefs, unknowns : the calibration variables
    blocks : sensor -> its measurements
    state : State of n epochs; calibration that walks has shape (n, dim), all other (dim,)
    weights : sensor -> weights of its measurements, shape (m,)
    solution : gates, cost and iterations; its point is in the solver's own form
    places : number of a place -> ndarray, shape (2,), north and east [m]
    """

    @property
    def problem(self) -> Problem: ...
    @property
    def initial(self) -> InitialConditions: ...
    @property
    def beliefs(self) -> Mapping[str, Belief]: ...
    @property
    def unknowns(self) -> CalibrationRoles: ...
    @property
    def blocks(self) -> Mapping[str, Measurements]: ...
    @property
    def state(self) -> State: ...
    @property
    def weights(self) -> Mapping[str, Array]: ...
    @property
    def solution(self) -> GaussNewtonResult[Any]: ...
    @property
    def places(self) -> Mapping[int, Array]: ...

    def covariances(self) -> Mapping[str, Array]:
        """Marginal covariances at every keyframe, by state or calibration variable, shape (n, d, d).

        The joint one of pose, velocity and bias is that of `rovgraph.model.state.MOTION_STATE`.
        What is considered has that of its prior. They are large, and calculated each time.
        """
        ...

    def newest_covariance(self, places: Sequence[int] = ()) -> Array:
        """Joint covariance of the newest keyframe, of the calibration there, and of places.

        Returns
        -------
        ndarray, shape (d, d), pose, velocity, bias, then the calibration in the order of `CalibrationRoles`, first what
            is estimated, then what is considered, then the places in the order of their numbers as given
        """
        ...

    def knowledge(self, keyframes: Sequence[int]) -> Knowledge:
        """Estimates of the calibration from the data up to each of some keyframes, increasing, the first beyond 0."""
        ...

    def noisier(self, keyframes: Sequence[int], seed: int = 1) -> tuple[Knowledge, Knowledge]:
        """The same, linearised where the data's noise moves the states once more, with either sign.

        A draw of the error that the noise leaves in the states, calibration held, is put onto the optimum.
        """
        ...

    def considering(self, names: Sequence[str]) -> "Optimum":
        """The optimum with some of the estimated constants considered: at their means, as uncertain as their priors.

        With K the derivative of the optimum by what is considered, P = P(that is known) + K P(prior) K', the
        Schmidt-Kalman filter's covariance.
        """
        ...

    def relative_sd(self) -> dict[str, Array]:
        """The sd of considered variables if estimated, as a part of the prior's: name -> ndarray, shape (dim,)."""
        ...

    def estimating(self, names: Sequence[str]) -> "Optimum":
        """The optimum with some of what is considered estimated."""
        ...


def residual_state(optimum: Optimum, block: Measurements) -> State:
    """State of each measurement's keyframe, with the place that it sees, where it sees one."""
    return block.with_places(optimum.state.at(block.keyframe), optimum.places)


def estimated_parts(optimum: Optimum) -> dict[str, slice]:
    """Name -> where it stands among all that is estimated."""
    dims = [optimum.beliefs[name].variable.dim for name in optimum.unknowns.estimated]
    ends = np.cumsum(dims).tolist()
    return {n: slice(end - dim, end) for n, dim, end in zip(optimum.unknowns.estimated, dims, ends, strict=True)}


def joint_prior_sd(optimum: Optimum, keyframe: int) -> dict[str, Array]:
    """sd of the estimated calibration before any data, at a keyframe to which what walks has walked.

    Returns
    -------
    dict : name -> ndarray, shape (dim,)
    """
    seconds = float(optimum.problem.time[keyframe] - optimum.problem.time[0])
    beliefs = optimum.beliefs
    out = {}
    for name in optimum.unknowns.estimated:
        belief, (kept, walked) = beliefs[name], optimum.unknowns.walked(name, seconds)
        stepped = belief.sd * np.sqrt(len(belief.changes))
        out[name] = np.full(belief.variable.dim, np.linalg.norm([kept * belief.first_sd, walked, stepped]))
    return out
