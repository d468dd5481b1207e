"""The result of an estimator: `Estimate`, made from states and covariances at the IMU, for the body's origin."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from rovgraph.geometry import Array, cross, rotate, skew, transpose
from rovgraph.inference.assumptions import rests_on_doubtful_compass
from rovgraph.inference.observability import verdict
from rovgraph.inference.trajectory import Trajectory
from rovgraph.kernels.assembly import RATE_B, SPREAD, TIME
from rovgraph.model.calibration import CONSIDERED, TABLE, Belief
from rovgraph.model.state import State
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.measurements import Measurements
from rovgraph.sensors import innovation

RESIDUAL_COLUMNS = [
    "time", "sensor", "component", "measured", "predicted", "innovation", "sd", "normalised", "weight", "row",
]  # fmt: skip


@dataclass(frozen=True)
class History:
    """A variable against time.

    Attributes
    ----------
    labels : names of the components, d of them
    unit : unit inside the program ("rad" is shown in degrees)
    time : ndarray, shape (n,) [s]
    value, sd : ndarray, shape (n, d)
    """

    labels: tuple[str, ...]
    unit: str
    time: Array
    value: Array
    sd: Array


@dataclass(frozen=True)
class CalibrationEstimate:
    """One scalar calibration component after the dive.

    Attributes
    ----------
    label, unit, about : from the table of calibration variables
    estimated : False = held at its mean
    value, sd, prior_mean, prior_sd : [unit]; sd is that of the prior where considered, and 0 where exact
    verdict : observable, weak or unobservable where estimated; considered; empty where exact, or not known
    """

    label: str
    unit: str
    about: str
    estimated: bool
    value: float
    sd: float
    prior_mean: float
    prior_sd: float
    verdict: str = ""


@dataclass(frozen=True, repr=False)
class Estimate:
    """A trajectory, the calibration and the residuals of the measurements.

    Attributes
    ----------
    kind : "smoothed", "filtered" or "dead_reckoning"
    trajectory : Trajectory of the body's origin, one epoch per keyframe
    calibration : one entry per scalar component of the sensors in use
    history : variable -> History; acc_bias and gyr_bias, and the estimated calibration
        variables (the filter's against time; a smoother's constants at both ends)
    residuals : columns `RESIDUAL_COLUMNS`; component is x, y, z or a name, normalised is
        innovation / sd, weight is 1 for a full measurement and 0 for a rejected one
    summary : numbers about the solution, ready for JSON
    """

    kind: str
    trajectory: Trajectory
    calibration: list[CalibrationEstimate]
    history: dict[str, History]
    residuals: pd.DataFrame
    summary: dict[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"<Estimate, {self.kind}: {self.trajectory!r}>"


_XYZ = ("_x", "_y", "_z")


def body_trajectory(
    keyframes: Array,
    states: State,
    initial: InitialConditions,
    cov_pose: Array | None = None,
    cov_velocity: Array | None = None,
) -> Trajectory:
    """Trajectory of the body's origin from states at the IMU.

    Parameters
    ----------
    keyframes : ndarray, shape (n, KEYFRAME), of `rovgraph.kernels.assembly`
    states : State of n epochs, at the IMU
    initial : of the dive
    cov_pose : ndarray, shape (n, 6, 6), in GTSAM's tangent space, or None
    cov_velocity : ndarray, shape (n, 3, 3), in n, or None
    """
    R, lever_arm_b = np.ascontiguousarray(states.R_nb), np.asarray(initial.config.imu.lever_arm_m)
    time, rate_b = keyframes[:, TIME].copy(), keyframes[:, RATE_B : RATE_B + 3]
    rate_sd = keyframes[:, SPREAD, None, None]
    p_n = states.p_n - rotate(R, lever_arm_b)
    v_n = states.v_n - rotate(R, cross(rate_b - states.bias[:, 3:], lever_arm_b))
    if cov_pose is None or cov_velocity is None:
        return Trajectory.certain(time, p_n, R, v_n)
    arm = R @ skew(lever_arm_b)
    J = np.concatenate([arm, R], axis=-1)  # p - R l, right perturbation
    cov_p = J @ cov_pose @ transpose(J)
    if rests_on_doubtful_compass(initial):
        by_rotation = J @ cov_pose[..., :3] @ transpose(R)
        cov_p[:, :2, :2] += second_order(by_rotation[:, :2, 2])
    return Trajectory(
        time,
        p_n,
        R,
        v_n,
        cov_p=cov_p,
        cov_theta=R @ cov_pose[:, :3, :3] @ transpose(R),
        cov_v=cov_velocity + rate_sd**2 * arm @ transpose(arm),
    )


def second_order(cov_p_heading: Array) -> Array:
    """Second-order part of a heading error in the covariance of a position, shape (n, 2, 2) [m^2].

    An error theta that lasts the whole way turns it about the start, and what is d from there moves by

        R(theta) d - d = theta J d - theta^2 / 2 d + ...,   J = (0 -1; 1 0)

    The linear part has the covariance c = s^2 J d with a theta of variance s^2, and nothing along d. The other has the
    second moment 3/4 s^4 d d' = 3/4 (J c)(J c)' of a normal theta, and is not correlated with the first. It is the
    moment about the estimate, which is not moved by the mean, -s^2 / 2 d: a shorter way would contradict the DVL. What
    of the heading's error does not last has next to no part in c, and neither has a position that a fix shows.

    Parameters
    ----------
    cov_p_heading : ndarray, shape (n, 2), covariance of north and east with the heading [m rad]
    """
    along = cov_p_heading[:, ::-1] * (1.0, -1.0)
    return np.asarray(0.75 * along[:, :, None] * along[:, None, :])


def calibration_estimates(
    beliefs: Mapping[str, Belief],
    sensors: Sequence[str],
    values: Mapping[str, Array],
    covariance: Mapping[str, Array],
    relative_sd: Mapping[str, Array] | None = None,
) -> list[CalibrationEstimate]:
    """One entry per component of every variable of a sensor that is used.

    Parameters
    ----------
    beliefs : all calibration variables
    sensors : in use, "imu" among them where the motion is the IMU's
    values : name -> ndarray, shape (dim,)
    covariance : name -> ndarray, shape (dim, dim), of those that were estimated; others that are believed to be
        considered keep the sd of their prior
    relative_sd : name -> ndarray, shape (dim,), sd as a part of the prior's, where it is known better than
        from ``covariance``
    """
    out = []
    for name, belief in beliefs.items():
        if not set(belief.variable.sensors) & set(sensors):
            continue
        estimated = name in covariance
        considered = belief.considered and not estimated
        sd = np.full(belief.variable.dim, belief.sd if considered else 0.0)
        sd = np.sqrt(np.diag(covariance[name])) if estimated else sd
        for k, label in enumerate(belief.variable.labels):
            v = belief.variable
            numbers = (
                float(values[name][k]),
                float(sd[k]),
                float(belief.mean[k]),
                belief.sd if estimated or considered else 0.0,
            )
            better = relative_sd.get(name) if relative_sd and estimated else None
            ratio = float(sd[k]) / belief.sd if better is None else float(better[k])
            known = verdict(ratio) if estimated else CONSIDERED if considered else ""
            out.append(CalibrationEstimate(label, v.unit, v.about, estimated, *numbers, known))
    return out


def bias_histories(time: Array, bias: Array, sd: Array, sensors: Sequence[str]) -> dict[str, History]:
    """Accelerometer and gyro bias against time where there is an IMU; ``bias`` and ``sd`` have shape (n, 6)."""
    if "imu" not in sensors:
        return {}
    acc, gyr = (tuple(f"{s}_bias{c}" for c in _XYZ) for s in ("acc", "gyr"))
    return {
        "acc_bias": History(acc, "m/s2", time, bias[:, :3].copy(), sd[:, :3].copy()),
        "gyr_bias": History(gyr, "rad/s", time, bias[:, 3:].copy(), sd[:, 3:].copy()),
    }


def calibration_history(name: str, time: Array, value: Array, sd: Array) -> History:
    """A calibration variable against time; ``value`` and ``sd`` have shape (n, dim)."""
    # copies: views would keep all the rest of what a filter has found
    return History(TABLE[name].labels, TABLE[name].unit, time, value.copy(), sd.copy())


def residual_frame(measured: Iterable[tuple[str, Measurements, State, Array]] = ()) -> pd.DataFrame:
    """Innovation, normalised innovation and weight of every measurement, in order of time.

    Parameters
    ----------
    measured : sensor, its n measurements, State of each one's keyframe, their weights of shape (n,); they may be made
        one after the other, as those of a long dive are large
    """
    parts: dict[str, list[ArrayLike]] = {}
    for sensor, block, state, weight in measured:
        predicted = block.predicted(state)
        nu = innovation(block.instrument.model, block.z, predicted)
        normalised = np.einsum("nij,nj->ni", block.W, nu)
        sd = np.sqrt(np.diagonal(np.linalg.inv(transpose(block.W) @ block.W), axis1=1, axis2=2))
        for k, component in enumerate(block.instrument.components):
            columns = {
                "time": block.time,
                "sensor": np.full(len(block), sensor, object),
                "component": np.full(len(block), component, object),
                "measured": block.z[:, k],
                "predicted": predicted[:, k],
                "innovation": nu[:, k],
                "sd": sd[:, k],
                "normalised": normalised[:, k],
                "weight": weight,
                "row": block.line,
            }
            for name, values in columns.items():
                parts.setdefault(name, []).append(values)
    if not parts:
        return pd.DataFrame(columns=pd.Index(RESIDUAL_COLUMNS))
    order = np.argsort(np.concatenate(parts["time"]), kind="stable")
    # column by column: of a long dive, sorting frames takes several times its memory
    return pd.DataFrame({name: np.concatenate(parts.pop(name))[order] for name in [*parts]})
