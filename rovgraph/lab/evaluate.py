"""Errors of a trajectory against a reference.

The trajectory is interpolated to the reference's epochs. Errors are estimate minus
reference, in n. By default both are taken to be in the same frame, since a navigator needs absolute
errors. With ``align`` a turn about down and a shift in the horizontal (least squares, Umeyama 1991
without scale) are removed first.

Consistency uses the normalised error e' P^-1 e of north and east, which is chi-square with
two degrees of freedom (mean 2) for a P that is right.
"""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from rovgraph.errors import InputError, kind_of, warn
from rovgraph.geometry import Array, exp_rotation, rotate, wrap_angle
from rovgraph.inference.trajectory import Trajectory, parse_trajectory, read_table

ELLIPSE = 0.99
WITHIN_ELLIPSE = -2.0 * float(np.log(1.0 - ELLIPSE))  # quantile of chi-square, 2 degrees of freedom
MIN_COVARIANCE = 1e-12  # [m^2]: a smaller determinant's root is a fixed position, not an estimate


@dataclass(frozen=True)
class Metrics:
    """Errors of a trajectory relative to a reference; None = not known.

    Attributes
    ----------
    epochs : reference epochs compared
    duration_s : from the first to the last of them
    coverage : part of the reference's epochs (of ``--from`` to ``--to``) that were compared
    distance_m : length of the reference's track, horizontal
    rms_m, mean_m, max_m : horizontal distance
    max_at_s : time of the largest horizontal distance
    end_m : horizontal distance at the last epoch
    drift_percent : ``end_m`` in percent of ``distance_m``
    rms_3d_m, rms_down_m : where the reference has ``down``
    heading_rms_deg, heading_mean_deg : where the reference has ``yaw``
    nees : mean normalised error squared of north and east, 2 for consistent covariances
    inside_ellipse : part of the epochs inside the 99 % ellipse
    aligned : whether the trajectory was aligned with the reference first
    turned_deg, shift_north_m, shift_east_m : rotation and shift of the alignment
    """

    epochs: int
    duration_s: float
    coverage: float
    distance_m: float
    rms_m: float
    mean_m: float
    max_m: float
    max_at_s: float
    end_m: float
    drift_percent: float | None
    rms_3d_m: float | None
    rms_down_m: float | None
    heading_rms_deg: float | None
    heading_mean_deg: float | None
    nees: float | None
    inside_ellipse: float | None
    aligned: bool = False
    turned_deg: float | None = None
    shift_north_m: float | None = None
    shift_east_m: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)


def evaluate(
    trajectory: Trajectory, reference: Trajectory, start: float = 0.0, align: bool = False, end: float = np.inf
) -> Metrics:
    """Compare a trajectory with a reference.

    Parameters
    ----------
    trajectory : Trajectory
    reference : Trajectory; unknown quantities are NaN
    start : skip this time after the trajectory's first epoch [s]
    align : rotate and shift the trajectory onto the reference first
    end : skip everything later than this after the trajectory's first epoch [s]

    Raises
    ------
    InputError : not a `Trajectory`; a start before or after the trajectory; an end before the start; fewer than two
        reference epochs inside the rest of it
    """
    for name, track in (("trajectory", trajectory), ("reference", reference)):
        if not isinstance(track, Trajectory):
            raise InputError(f"{name}: expected a Trajectory, as read_{name} gives it, found {kind_of(track)}")
    if not start >= 0.0:
        raise InputError(f"comparing from {start:g} s on: expected 0 or more after the trajectory's first epoch")
    if (lasts := float(trajectory.time[-1] - trajectory.time[0])) < start:
        raise InputError(f"comparing from {start:g} s on: the trajectory lasts only {lasts:.1f} s")
    if not end > start:
        raise InputError(f"comparing from {start:g} to {end:g} s: the end is not after the start")
    first, last = trajectory.time[0] + start, trajectory.time[0] + end
    wanted = (reference.time >= first) & (reference.time <= last)
    common = np.flatnonzero(wanted & (reference.time >= trajectory.time[0]) & (reference.time <= trajectory.time[-1]))
    if len(common) < 2:
        until = "on" if np.isinf(end) else f"to {last:.1f} s"
        raise InputError(
            f"the reference ({_span(reference)}) has {len(common)} epochs within the trajectory "
            f"({_span(trajectory)}) from {first:.1f} s {until}, at least 2 are needed; are both on the same clock?"
        )
    truth = reference.take(common)
    estimate = trajectory.clamped(truth.time)
    removed: dict[str, Any] = {}
    if align:
        estimate, removed = aligned(estimate, truth)
    coverage = len(common) / int(wanted.sum())
    return Metrics(**_position(estimate, truth), **_known(estimate, truth), coverage=coverage, **removed)


def _span(trajectory: Trajectory) -> str:
    return f"{trajectory.time[0]:.1f} to {trajectory.time[-1]:.1f} s"


def _rms(x: Array) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


def _position(estimate: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """Errors in the horizontal plane."""
    error = np.linalg.norm((estimate.p_n - truth.p_n)[:, :2], axis=1)
    distance = float(np.linalg.norm(np.diff(truth.p_n[:, :2], axis=0), axis=1).sum())
    worst = int(np.argmax(error))
    return {
        "epochs": len(truth),
        "duration_s": float(truth.time[-1] - truth.time[0]),
        "distance_m": distance,
        "rms_m": _rms(error),
        "mean_m": float(error.mean()),
        "max_m": float(error[worst]),
        "max_at_s": float(truth.time[worst]),
        "end_m": float(error[-1]),
        "drift_percent": 100.0 * float(error[-1]) / distance if distance > 0 else None,
    }


def _known(estimate: Trajectory, truth: Trajectory) -> dict[str, Any]:
    """Errors of what only some references and trajectories have."""
    error = estimate.p_n - truth.p_n
    down = np.isfinite(error[:, 2])
    turn = wrap_angle(estimate.rpy[:, 2] - truth.rpy[:, 2])
    turn = np.rad2deg(turn[np.isfinite(turn)])
    normalised = normalised_error(error[:, :2], estimate.cov_p[:, :2, :2])
    known = normalised[np.isfinite(normalised)]
    return {
        "rms_3d_m": _rms(np.linalg.norm(error[down], axis=1)) if down.any() else None,
        "rms_down_m": _rms(error[down, 2]) if down.any() else None,
        "heading_rms_deg": _rms(turn) if len(turn) else None,
        "heading_mean_deg": float(turn.mean()) if len(turn) else None,
        "nees": float(known.mean()) if len(known) else None,
        "inside_ellipse": float(np.mean(known <= WITHIN_ELLIPSE)) if len(known) else None,
    }


def normalised_error(error: Array, covariance: Array) -> Array:
    """e' P^-1 e for each epoch; NaN where P is not known or not positive definite.

    Parameters
    ----------
    error : ndarray, shape (n, 2)
    covariance : ndarray, shape (n, 2, 2)

    Returns
    -------
    ndarray, shape (n,)
    """
    (a, b), c = covariance[:, 0].T, covariance[:, 1, 1]
    determinant = a * c - b**2
    usable = (determinant > MIN_COVARIANCE**2) & (a > 0)  # False for NaN
    x, y = error.T
    value = (c * x**2 - 2.0 * b * x * y + a * y**2) / np.where(usable, determinant, 1.0)
    return np.where(usable, value, np.nan)


def aligned(estimate: Trajectory, truth: Trajectory) -> tuple[Trajectory, dict[str, Any]]:
    """The estimate rotated about down and shifted horizontally for the best fit to the truth.

    Parameters
    ----------
    estimate, truth : Trajectory at the same epochs

    Returns
    -------
    Trajectory, and the turn and shift that were removed, by the names of `Metrics`
    """
    mean_e, mean_t = estimate.p_n[:, :2].mean(axis=0), truth.p_n[:, :2].mean(axis=0)
    e, t = estimate.p_n[:, :2] - mean_e, truth.p_n[:, :2] - mean_t
    angle = float(np.arctan2((e[:, 0] * t[:, 1] - e[:, 1] * t[:, 0]).sum(), (e * t).sum()))
    R = exp_rotation([0.0, 0.0, angle])
    shift = np.append(mean_t - R[:2, :2] @ mean_e, 0.0)
    turned = {name: R @ getattr(estimate, name) @ R.T for name in ("cov_p", "cov_theta", "cov_v")}
    result = replace(
        estimate,
        p_n=rotate(R, estimate.p_n) + shift,
        v_n=rotate(R, estimate.v_n),
        R_nb=R @ estimate.R_nb,
        **turned,
    )
    removed = {"turned_deg": float(np.rad2deg(angle)), "shift_north_m": shift[0], "shift_east_m": shift[1]}
    return result, {"aligned": True, **{k: float(v) for k, v in removed.items()}}


def read_reference(path: Path | str) -> Trajectory:
    """Read a reference CSV, also as other tools write it.

    Rows without time, north or east and repeated times are ignored with a `DataWarning`;
    rows out of order are sorted.

    Raises
    ------
    InputError : as `rovgraph.inference.trajectory.read_trajectory`
    """
    table = read_table(path)
    known = table.dropna(subset=["time", "north", "east"])
    known = known.sort_values("time", kind="stable")
    single = known.drop_duplicates("time")
    _warn(path, len(table) - len(known), "without time, north or east")
    _warn(path, len(known) - len(single), "with a repeated time")
    return parse_trajectory(pd.DataFrame(single), str(path))


def _warn(path: Path | str, count: int, what: str) -> None:
    if count:
        warn(f"{path}: {count} rows {what} were left out")
