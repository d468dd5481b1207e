"""The result of an estimator: `Estimate`, made from states and covariances at the IMU, for the body's origin."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from rovgraph.dates import Moments, seconds_of_moments
from rovgraph.errors import InputError
from rovgraph.geometry import Array, cross, rotate, rpy_from_matrix, skew, transpose
from rovgraph.inference.assumptions import rests_on_doubtful_compass
from rovgraph.inference.observability import verdict
from rovgraph.inference.posterior import POSITION, ROTATION, Posterior, displaced_by_heading
from rovgraph.inference.trajectory import Trajectory
from rovgraph.kernels import measurement_row as at
from rovgraph.kernels.assembly import RATE_B, SPREAD, TIME
from rovgraph.model.calibration import CONSIDERED, LAYERS, LAYOUT, TABLE, Belief, beacon_names
from rovgraph.model.config import Config, mount_matrix
from rovgraph.model.origin import scale_at
from rovgraph.model.state import State
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.measurements import Measurements
from rovgraph.sensors import AcousticExchange, WaterLayer, innovation
from rovgraph.sensors.sensor import LARGEST_SD

RESIDUAL_COLUMNS = [
    "time", "sensor", "component", "measured", "predicted", "innovation", "sd", "normalised", "weight", "row",
]  # fmt: skip
CURRENT_COLUMNS = ["time", "depth", "north", "east", "north_sd", "east_sd"]
CURRENT_S = 10.0  # between profiles whose current is kept
REPLY_COLUMNS = [
    "time", "sensor", "beacon", "ship_north", "ship_east", "ship_heading", "range", "bearing", "elevation", "row",
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


_AXES = {"b": ("x", "y", "z"), "n": ("north", "east", "down")}


def state_names(axes: str = "b") -> tuple[str, ...]:
    """Names of the 15 components of a state's error, rotation and position in axes of b or n."""
    own, n, b = _AXES[axes], _AXES["n"], _AXES["b"]
    parts = ("rotation", own), ("position", own), ("velocity", n), ("acc_bias", b), ("gyr_bias", b)
    return tuple(f"{quantity}_{axis}" for quantity, axes_of in parts for axis in axes_of)


@dataclass(frozen=True)
class RelativePosition:
    """The position of a moment relative to another one.

    Attributes
    ----------
    axes : "n", or "b" for the body's axes at the other moment
    value : ndarray, shape (3,) [m]
    covariance : ndarray, shape (3, 3) [m^2]
    """

    axes: str
    value: Array
    covariance: Array

    @property
    def sd(self) -> Array:
        """Standard deviation of its components, shape (3,) [m]."""
        return np.sqrt(np.diagonal(self.covariance))

    def __repr__(self) -> str:
        shown = ", ".join(
            f"{axis} {value:.3f} ± {sd:.3f}"
            for axis, value, sd in zip(_AXES[self.axes], self.value, self.sd, strict=True)
        )
        return f"<RelativePosition {shown} m>"


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
    posterior : of a smoothed estimate of the chain: what `covariance`, `joint`, `relative` and `sample` come from
    replies : columns `REPLY_COLUMNS`, of each acoustic measurement, as `reply_frame` has them
    current : columns `CURRENT_COLUMNS`, of the water at its knots, as `current_frame` has them
    """

    kind: str
    trajectory: Trajectory
    calibration: list[CalibrationEstimate]
    history: dict[str, History]
    residuals: pd.DataFrame
    summary: dict[str, Any] = field(default_factory=dict)
    posterior: Posterior | None = field(default=None, compare=False)
    replies: pd.DataFrame = field(default_factory=lambda: reply_frame(()), compare=False)
    current: pd.DataFrame = field(default_factory=lambda: current_frame({}, None, 1.0), compare=False)

    def __repr__(self) -> str:
        return f"<Estimate, {self.kind}: {self.trajectory!r}>"

    def covariance(self, time: Moments, axes: str = "b") -> pd.DataFrame:
        """Covariance of the whole state at a time, between keyframes too.

        The state is that of the body's origin: rotation [rad], position [m], velocity [m/s], accelerometer bias
        [m/s^2] and gyro bias [rad/s]. The errors are those of GTSAM's tangent space: ``R_nb <- R_nb Exp(rotation)``,
        ``p_n <- p_n + R_nb position`` in body axes, velocity in n, biases in body axes. What is considered counts with
        its prior.

        Parameters
        ----------
        time : [s], or a date where the log's clock is Unix time
        axes : "b" as above; "n" for rotation and position in n, as the trajectory's ``cov_theta`` and ``cov_p`` are

        Returns
        -------
        DataFrame, shape (15, 15), with the components' names; ``to_numpy()`` gives the matrix

        Raises
        ------
        InputError : a time beyond the track, other axes, an estimate without a joint covariance
        """
        P = self._joint([time], axes)[0]
        names = pd.Index(state_names(axes))
        return pd.DataFrame(P, names, names)

    def joint(self, first: Moments, second: Moments, axes: str = "b") -> pd.DataFrame:
        """Joint covariance of the states at two times, in either order; parameters and errors are of `covariance`.

        Returns
        -------
        DataFrame, shape (30, 30), with the names of `covariance` under 1 for the first time and 2 for the second:
            ``joint.loc[1, 2]`` is the covariance of the first with the second
        """
        P = self._joint([first, second], axes)[0]
        names = pd.MultiIndex.from_product([(1, 2), state_names(axes)], names=("time", "component"))
        return pd.DataFrame(P, names, names)

    def relative(self, first: Moments, second: Moments, axes: str = "n") -> RelativePosition:
        """Position at the second time relative to the first, with its uncertainty.

        What both have in common, such as where the dive began, is not in it.

        Parameters
        ----------
        first, second : as ``time`` of `covariance`
        axes : "n", or "b" for the body's axes at the first time, whose attitude is uncertain too

        Raises
        ------
        InputError : of `covariance`
        """
        P, R_nb, seconds = self._joint([first, second], axes)
        p_n = np.stack([np.interp(seconds, self.trajectory.time, axis) for axis in self.trajectory.p_n.T], axis=-1)
        moved, J = p_n[1] - p_n[0], np.zeros((3, 30))
        if axes == "n":
            J[:, POSITION], J[:, 15 + POSITION.start : 15 + POSITION.stop] = -np.eye(3), np.eye(3)
            return RelativePosition(axes, moved, J @ P @ J.T)
        value = R_nb[0].T @ moved
        J[:, ROTATION], J[:, POSITION] = skew(value), -np.eye(3)
        J[:, 15 + POSITION.start : 15 + POSITION.stop] = R_nb[0].T @ R_nb[1]
        return RelativePosition(axes, value, J @ P @ J.T)

    def sample(self, count: int, seed: int | None = None) -> list[Trajectory]:
        """Draws of the whole trajectory, at its epochs: tracks that the data leave possible.

        Constants are drawn with them, considered ones from their priors.

        Parameters
        ----------
        count : how many
        seed : for the same draws again; None = others each time

        Returns
        -------
        list of Trajectory, without uncertainty of their own

        Raises
        ------
        InputError : a count below 1, an estimate without a joint covariance
        """
        if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
            raise InputError(f"count {count!r}: expected a whole number from 1")
        known, rng = self._known(), np.random.default_rng(seed)
        problem, out = known.optimum.problem, []
        arm = skew(np.asarray(known.initial.config.imu.lever_arm_m))
        for states, moved in known.draw(int(count), rng):
            one = body_trajectory(problem.keyframes, states, known.initial)
            turned = rng.standard_normal((len(problem), 3)) * problem.rate_sd[:, None] @ arm.T
            out.append(Trajectory.certain(one.time, one.p_n + moved, one.R_nb, one.v_n + rotate(one.R_nb, turned)))
        return out

    def _joint(self, times: Sequence[Moments], axes: str) -> tuple[Array, Array, Array]:
        """Joint covariance at some times, shape (15 q, 15 q), attitudes and times [s]."""
        if axes not in _AXES:
            raise InputError(f"axes {axes!r}: expected b or n")
        known, track = self._known(), self.trajectory
        each = [seconds_of_moments(time, track.time, "time") for time in times]
        if any(time.ndim for time in each):
            raise InputError("time: is an array, expected one time; ask for each by itself")
        seconds = np.array(each, dtype=float)
        first, last = float(track.time[0]), float(track.time[-1])
        outside = seconds[~((seconds >= first) & (seconds <= last))]
        if len(outside):
            raise InputError(f"time {outside[0]:.10g} s: beyond the track, which has {first:.10g} to {last:.10g} s")
        P, R_nb = known.at(seconds)
        if axes == "n":
            turn = np.eye(len(P))
            for a, R in enumerate(R_nb):
                for part in (ROTATION, POSITION):
                    rows = slice(15 * a + part.start, 15 * a + part.stop)
                    turn[rows, rows] = R
            P = turn @ P @ turn.T
        return P, R_nb, seconds

    def _known(self) -> Posterior:
        if self.posterior is None:
            why = (
                "places tie its keyframes in loops, or iSAM2 solved it"
                if self.kind == "smoothed"
                else "it is no smoother's"
            )
            raise InputError(f"the {self.kind} estimate has no joint covariance: {why}")
        return self.posterior


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
    cov_velocity : ndarray, shape (n, 3, 3), of `velocity_covariance`, or None
    """
    R, lever_arm_b = np.ascontiguousarray(states.R_nb), np.asarray(initial.config.imu.lever_arm_m)
    time, rate_b = keyframes[:, TIME].copy(), keyframes[:, RATE_B : RATE_B + 3]
    metres = scale_at(initial.config.environment.earth_latitude, states.p_n)
    p_n = states.p_n - metres * rotate(R, lever_arm_b)
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
        cov_v=cov_velocity,
    )


def velocity_covariance(keyframes: Array, states: State, initial: InitialConditions, P: Array) -> Array:
    """Covariance of the velocity of the body's origin, in n, shape (n, 3, 3) [m^2/s^2].

    v - R (w - b) x l: attitude turns the velocity of the arm, which the gyro's bias and noise make.

    Parameters
    ----------
    keyframes, states, initial : of `body_trajectory`
    P : ndarray, shape (n, 15, 15), of pose, velocity and bias, in GTSAM's tangent space
    """
    R, lever_arm_b = states.R_nb, np.asarray(initial.config.imu.lever_arm_m)
    arm, rate_b = R @ skew(lever_arm_b), keyframes[:, RATE_B : RATE_B + 3] - states.bias[:, 3:]
    J = np.zeros((len(P), 3, P.shape[1]))
    J[..., :3], J[..., 6:9], J[..., 12:15] = R @ skew(cross(rate_b, lever_arm_b)), np.eye(3), -arm
    rate_sd = keyframes[:, SPREAD, None, None]
    return np.asarray(J @ P @ transpose(J) + rate_sd**2 * arm @ transpose(arm))


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
    along = displaced_by_heading(cov_p_heading)
    return np.asarray(along[:, :, None] * along[:, None, :])


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
        if not belief.is_shown_by(sensors):
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


def current_frame(history: Mapping[str, History], layers: Measurements | None, knot_m: float) -> pd.DataFrame:
    """The current at the knots that the cells of profiles are near, a profile each `CURRENT_S` or so.

    Parameters
    ----------
    history : of the knots, over time
    layers : measurements of the sensor "water_layer"; None = none
    knot_m : depth from a knot to the next [m]
    """
    known = [name for name in LAYERS if name in history]
    if layers is None or not isinstance(layers.model, WaterLayer) or len(known) < 2:
        return pd.DataFrame(columns=pd.Index(CURRENT_COLUMNS))
    informs = layers.W[:, 0, 0] > 2.0 / LARGEST_SD
    context, measured = layers.model.context[informs], layers.time[informs]
    of = np.column_stack([context[:, at.ABOVE_AT], context[:, at.BELOW_AT]]).astype(np.int64)
    place = (of - LAYOUT[LAYERS[0]].start) // 2
    first = context[:, at.FIRST_KNOT].astype(np.int64)[:, None]
    knot = first + (place - first) % len(known)
    profile = np.unique(measured)
    profile = profile[np.diff(profile // CURRENT_S, prepend=-np.inf) > 0.0]
    chosen = np.isin(measured, profile)
    pairs = np.unique(np.column_stack([np.repeat(measured[chosen], 2), knot[chosen].ravel()]), axis=0)
    time, knots = pairs[:, 0], pairs[:, 1].astype(np.int64)
    values = np.full((len(pairs), 4), np.nan)
    for k, name in enumerate(known):
        here, walk = knots % len(known) == k, history[name]
        keyframe = np.clip(np.searchsorted(walk.time, time[here] - 1e-6), 0, len(walk.time) - 1)
        values[here] = np.column_stack([walk.value, walk.sd])[keyframe]
    return pd.DataFrame(np.column_stack([time, knot_m * knots, values]), columns=pd.Index(CURRENT_COLUMNS))


def reply_frame(measured: Iterable[tuple[str, Measurements]], config: Config | None = None) -> pd.DataFrame:
    """What each acoustic measurement says, and where the ship was, in order of time.

    ``beacon`` is the name of the other end, empty where that is the ship, whose place (that of its head or receiver)
    and heading then stand beside it. ``bearing`` (from north) and ``elevation`` (positive downwards) are those that a
    head on the ship measured, with its mounting as configured, level. Unknown numbers are NaN; m and rad.

    Parameters
    ----------
    measured : sensor and its n measurements; those of other sensors are passed over
    config : effective configuration
    """
    parts = []
    for sensor, block in measured:
        if config is None or not isinstance(block.model, AcousticExchange) or not len(block):
            continue
        x, usbl = block.model.context, config.usbl
        of_beacon, R_nf = x[:, at.BEACON_AT] >= 0.0, x[:, at.FRAME : at.FRAME + 9].reshape(-1, 3, 3)
        names = {LAYOUT[beacon_names(k)[0]].start: str(beacon.name) for k, beacon in enumerate(config.beacons)}
        by_head = sensor == "usbl" and usbl.head == "ship"
        u_n = rotate(R_nf @ mount_matrix(usbl.mount_rpy_deg), x[:, at.SEEN : at.SEEN + 3])
        heading = np.full(len(x), np.nan) if by_head and usbl.frame == "north" else rpy_from_matrix(R_nf)[:, 2]
        columns = {
            "time": block.time,
            "sensor": np.full(len(block), sensor, object),
            "beacon": np.array([names.get(int(place), "") for place in x[:, at.BEACON_AT]], object),
            "ship_north": np.where(of_beacon, np.nan, x[:, at.HEARD]),
            "ship_east": np.where(of_beacon, np.nan, x[:, at.HEARD + 1]),
            "ship_heading": np.where(of_beacon, np.nan, heading),
            "range": block.z[:, 0],
            "bearing": np.where(by_head, np.arctan2(u_n[:, 1], u_n[:, 0]), np.nan),
            "elevation": np.where(by_head, np.arcsin(np.clip(u_n[:, 2], -1.0, 1.0)), np.nan),
            "row": block.line,
        }
        parts.append(pd.DataFrame(columns))
    if not parts:
        return pd.DataFrame(columns=pd.Index(REPLY_COLUMNS))
    return pd.concat(parts, ignore_index=True).sort_values("time", kind="stable", ignore_index=True)
