"""A trajectory with its uncertainty, and its files.

CSV columns are those of the log's contract: ``time, north, east, down, roll, pitch, yaw,
v_north, v_east, v_down``, a ``_sd`` for each, and ``cov_north_east``. TUM files hold
``time x y z qx qy qz qw`` in n, for tools such as ``evo_ape``.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation, Slerp

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy, rpy_from_matrix, rpy_jacobian, transpose

POSITION = ["north", "east", "down"]
ATTITUDE = ["roll", "pitch", "yaw"]
VELOCITY = ["v_north", "v_east", "v_down"]
COLUMNS = ["time", *POSITION, *ATTITUDE, *VELOCITY]


@dataclass(frozen=True)
class Trajectory:
    """Poses and velocities of the body's origin at n epochs.

    Attributes
    ----------
    time : ndarray, shape (n,) [s], increasing
    p_n, v_n : ndarray, shape (n, 3) [m, m/s]
    R_nb : ndarray, shape (n, 3, 3)
    cov_p, cov_v, cov_theta : ndarray, shape (n, 3, 3), of position, velocity and of a
        small rotation, all in n [m^2, m^2/s^2, rad^2]; NaN where unknown
    """

    time: Array
    p_n: Array
    R_nb: Array
    v_n: Array
    cov_p: Array
    cov_theta: Array
    cov_v: Array

    def __len__(self) -> int:
        return len(self.time)

    @staticmethod
    def certain(time: Array, p_n: Array, R_nb: Array, v_n: Array) -> "Trajectory":
        """A trajectory without uncertainty, such as a simulator's truth."""
        unknown = np.full((len(time), 3, 3), np.nan)
        return Trajectory(time, p_n, R_nb, v_n, unknown, unknown, unknown)

    @property
    def rpy(self) -> Array:
        """Roll, pitch, yaw [rad], shape (n, 3)."""
        return rpy_from_matrix(self.R_nb)

    @property
    def rpy_sd(self) -> Array:
        """Standard deviation of roll, pitch, yaw [rad], shape (n, 3)."""
        J = rpy_jacobian(self.rpy)
        return _sd(J @ self.cov_theta @ transpose(J))

    @property
    def p_sd(self) -> Array:
        """Standard deviation of north, east, down [m], shape (n, 3)."""
        return _sd(self.cov_p)

    @property
    def v_sd(self) -> Array:
        """Standard deviation of the velocity [m/s], shape (n, 3)."""
        return _sd(self.cov_v)

    @property
    def distance(self) -> float:
        """Length of the track over ground [m]."""
        return float(np.linalg.norm(np.diff(self.p_n, axis=0), axis=1).sum())

    def every(self, step: int) -> "Trajectory":
        """Every ``step``-th epoch and the last one."""
        index = np.unique(np.append(np.arange(0, len(self), step), len(self) - 1))
        return Trajectory(*(getattr(self, f.name)[index] for f in fields(self)))

    def at(self, time: Array) -> "Trajectory":
        """Interpolated to ``time`` (linear; rotations along the shortest arc).

        Epochs outside the trajectory are clamped to its ends.
        """
        t = np.clip(time, self.time[0], self.time[-1])

        def linear(x: Array) -> Array:
            flat = x.reshape(len(x), -1)
            columns = [np.interp(t, self.time, column) for column in flat.T]
            return np.stack(columns, axis=-1).reshape(len(t), *x.shape[1:])

        R_nb = Slerp(self.time, Rotation.from_matrix(self.R_nb))(t).as_matrix()
        covariances = linear(self.cov_p), linear(self.cov_theta), linear(self.cov_v)
        return Trajectory(np.asarray(time, float), linear(self.p_n), R_nb, linear(self.v_n), *covariances)

    def to_frame(self) -> pd.DataFrame:
        """The columns of the contract, one row per epoch."""
        values = np.column_stack([self.p_n, self.rpy, self.v_n])
        frame = pd.DataFrame(values, columns=pd.Index(COLUMNS[1:]))
        frame.insert(0, "time", self.time)
        sds = np.column_stack([self.p_sd, self.rpy_sd, self.v_sd])
        for name, sd in zip(COLUMNS[1:], sds.T, strict=True):
            frame[name + "_sd"] = sd
        frame["cov_north_east"] = self.cov_p[:, 0, 1]
        return frame

    def write_csv(self, path: Path) -> None:
        """Write the columns of the contract that are known; time to the millisecond's tenth."""
        frame = self.to_frame().dropna(axis="columns", how="all").round(12) + 0.0  # no -0
        frame["time"] = frame["time"].map("{:.4f}".format)
        frame.to_csv(path, index=False, float_format="%.7g")

    def write_tum(self, path: Path) -> None:
        """Write a TUM file: ``time x y z qx qy qz qw``, n axes."""
        quat = Rotation.from_matrix(self.R_nb).as_quat()
        rows = np.column_stack([self.time, self.p_n, quat])
        np.savetxt(path, rows, fmt=["%.4f"] + ["%.6f"] * 3 + ["%.9f"] * 4)


def _sd(covariance: Array) -> Array:
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a trajectory or reference CSV: ``time, north, east``, the rest optional.

    Columns that are missing are NaN in the result (rotations too), so that what a
    reference does not know cannot be mistaken for a zero.

    Raises
    ------
    InputError : no such file, no CSV, a required column missing, time not increasing
    """
    try:
        frame = pd.read_csv(path)
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as CSV ({str(error).splitlines()[0]})") from None
    missing = [c for c in ("time", "north", "east") if c not in frame]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing, a trajectory has time, north, east")
    try:
        frame = frame.astype({c: float for c in frame.columns if c in COLUMNS or c.endswith("_sd")})
    except ValueError as error:
        raise InputError(f"{path}: {error}") from None
    frame = frame.dropna(subset=["time", "north", "east"])
    if len(frame) < 2:
        raise InputError(f"{path}: {len(frame)} rows with time, north and east, at least 2 are needed")
    time = frame["time"].to_numpy()
    if (np.diff(time) <= 0).any():
        row = int(np.argmax(np.diff(time) <= 0))
        raise InputError(f"{path}: time does not increase at {time[row + 1]:.3f} s (data row {row + 2}); sort the file")

    def take(names: list[str]) -> Array:
        return np.column_stack([frame[c] if c in frame else np.full(len(frame), np.nan) for c in names])

    def diagonal(names: list[str]) -> Array:
        return np.eye(3) * take([c + "_sd" for c in names])[:, None, :] ** 2

    rpy = take(ATTITUDE)
    cov_p, R_nb = diagonal(POSITION), matrix_from_rpy(rpy)
    if "cov_north_east" in frame:
        cov_p[:, 0, 1] = cov_p[:, 1, 0] = frame["cov_north_east"]
    J_inv = np.linalg.inv(np.where(np.isfinite(rpy_jacobian(rpy)), rpy_jacobian(rpy), np.eye(3)))
    cov_theta = J_inv @ diagonal(ATTITUDE) @ transpose(J_inv)
    return Trajectory(time, take(POSITION), R_nb, take(VELOCITY), cov_p, cov_theta, diagonal(VELOCITY))
