"""A trajectory with its uncertainty, and its files.

CSV columns are those of the log's contract: ``time, north, east, down, roll, pitch, yaw,
v_north, v_east, v_down``, a ``_sd`` for each, and ``cov_north_east``; at the end ``unix_time`` if the log's clock is
Unix time, ``lat, lon`` if the origin of n on Earth is known, with a map grid ``easting, northing, grid_north,
grid_scale``, and what else is known at its epochs. TUM files hold ``time x y z qx qy qz qw`` in n, for tools such as
``evo_ape``.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from rovgraph.dates import YEAR_FIRST, DateRules, Moments, is_unix, seconds_of_moments
from rovgraph.errors import InputError, as_path, warn
from rovgraph.geometry import (
    Array,
    matrix_from_rpy,
    quaternion_from_matrix,
    rpy_axes,
    rpy_from_matrix,
    rpy_jacobian,
    slerp,
    transpose,
)
from rovgraph.log import tables
from rovgraph.log.csv_writer import write_csv
from rovgraph.model.grids import PLACE_DECIMALS, place_columns
from rovgraph.model.origin import Origin, lat_lon

if TYPE_CHECKING:
    import xarray

FAR = 1000.0  # from the origin, in which seven digits are a tenth of a millimetre [m]
TUM = ".ned.tum"  # end of the name of a TUM file, with its frame
TUM_FRAME = "time [s], position in north, east, down [m], quaternion x y z w from forward, starboard, down to those"
POSITION = ["north", "east", "down"]
ATTITUDE = ["roll", "pitch", "yaw"]
VELOCITY = ["v_north", "v_east", "v_down"]
COLUMNS = ["time", *POSITION, *ATTITUDE, *VELOCITY]


@dataclass(frozen=True, repr=False)
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

    def __repr__(self) -> str:
        span = f", {self.time[0]:.1f} to {self.time[-1]:.1f} s" if len(self) else ""
        return f"<Trajectory of {len(self)} epochs{span}>"

    @staticmethod
    def certain(time: Array, p_n: Array, R_nb: Array, v_n: Array) -> "Trajectory":
        """A trajectory without uncertainty, such as a simulator's truth."""
        unknown = np.full((len(time), 3, 3), np.nan)
        return Trajectory(time, p_n, R_nb, v_n, unknown, unknown, unknown)

    @property
    def position(self) -> Array:
        """North, east, down [m], shape (n, 3): ``p_n``."""
        return self.p_n

    @property
    def velocity(self) -> Array:
        """Over ground, north, east, down [m/s], shape (n, 3): ``v_n``."""
        return self.v_n

    @property
    def covariance(self) -> Array:
        """Of the position, north, east, down [m^2], shape (n, 3, 3): ``cov_p``."""
        return self.cov_p

    @property
    def rpy(self) -> Array:
        """Roll, pitch, yaw [rad], shape (n, 3); a copy, so that it may be changed."""
        return self._rpy.copy()

    @cached_property
    def _rpy(self) -> Array:
        return rpy_from_matrix(self.R_nb)

    @property
    def rpy_sd(self) -> Array:
        """Standard deviation of roll, pitch, yaw [rad], shape (n, 3)."""
        J = rpy_jacobian(self._rpy)
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
        return self.take(np.unique(np.append(np.arange(0, len(self), step), len(self) - 1)))

    def take(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> "Trajectory":
        """Some of its epochs, by index or by mask."""
        return self[index]

    def __getitem__(self, index: int | slice | NDArray[np.intp] | NDArray[np.bool_]) -> "Trajectory":
        """Some of its epochs, by number, slice, indices or mask: ``track[10:20]``; one number gives one epoch."""
        if isinstance(index, int | np.integer):
            at = range(len(self))[index]  # IndexError, where it has none
            index = slice(at, at + 1)
        return Trajectory(*(getattr(self, f.name)[index] for f in fields(self)))

    def between(self, first: Moments, last: Moments) -> "Trajectory":
        """The epochs from one time to another, both included.

        Parameters
        ----------
        first, last : [s], or dates where the track's clock is Unix time

        Raises
        ------
        InputError : neither times nor dates, no epoch between them
        """
        begin, end = (seconds_of_moments(time, self.time, "time") for time in (first, last))
        found = self[(self.time >= begin) & (self.time <= end)]
        if not len(found):
            raise InputError(f"no epoch of the track from {begin} to {end} s; {_span(self.time)}")
        return found

    def at(self, time: Moments) -> "Trajectory":
        """Interpolated to some times (linear; rotations along the shortest arc).

        Parameters
        ----------
        time : a number or an array [s]; or dates where the track's clock is Unix time: of pandas, numpy or datetime or
            as ISO text, in UTC without a zone

        Returns
        -------
        Trajectory, an epoch for each time, one for a number; NaN beyond the ends, and between epochs of
            which one is not known

        Raises
        ------
        InputError : neither numbers nor dates, more than one dimension, dates where the clock is not Unix time

        Warns
        -----
        DataWarning : times beyond the ends
        """
        at = np.atleast_1d(seconds_of_moments(time, self.time, "time"))
        if at.ndim > 1:
            raise InputError(f"time: has shape {at.shape}, expected a number or one dimension")
        outside = ~((at >= self.time[0]) & (at <= self.time[-1]))
        found = self.clamped(np.where(np.isnan(at), self.time[0], at))
        if outside.any():
            warn(f"{int(outside.sum())} of {len(at)} times lie beyond the track and give NaN; {_span(self.time)}")
            values = {f.name: getattr(found, f.name) for f in fields(found)}
            for value in values.values():
                value[outside] = np.nan
            found = Trajectory(**values | {"time": at})
        return found

    def clamped(self, time: Array) -> "Trajectory":
        """As `at`, of numbers; beyond the ends the track stands still."""
        t = np.clip(time, self.time[0], self.time[-1])

        def linear(x: Array) -> Array:
            flat = x.reshape(len(x), -1)
            columns = [np.interp(t, self.time, column) for column in flat.T]
            return np.stack(columns, axis=-1).reshape(len(t), *x.shape[1:])

        R_nb = _slerp(self.time, self.R_nb, t)
        covariances = linear(self.cov_p), linear(self.cov_theta), linear(self.cov_v)
        return Trajectory(np.array(time, float), linear(self.p_n), R_nb, linear(self.v_n), *covariances)

    def columns(self) -> dict[str, Array]:
        """The columns of the contract, each of shape (n,)."""
        values, sds = (self.p_n, self._rpy, self.v_n), (self.p_sd, self.rpy_sd, self.v_sd)
        known = dict(zip(COLUMNS[1:], np.concatenate(values, axis=1).T, strict=True))
        known |= zip([f"{name}_sd" for name in COLUMNS[1:]], np.concatenate(sds, axis=1).T, strict=True)
        return {"time": self.time, **known, "cov_north_east": self.cov_p[:, 0, 1]}

    def to_frame(self) -> pd.DataFrame:
        """The columns of the contract, one row per epoch."""
        return pd.DataFrame(self.columns())

    def to_xarray(self) -> "xarray.Dataset":
        """The same as an xarray Dataset along ``time``, with units; axes are ``n`` and ``b``.

        Raises
        ------
        InputError : xarray is not installed
        """
        try:
            import xarray
        except ImportError:
            raise InputError("to_xarray: xarray is not installed: pip install xarray") from None
        n, b, t = ("n", ["north", "east", "down"]), ("b", ["forward", "starboard", "down"]), "time"
        matrix = (t, "n", "n2")
        variables = {
            "position": ((t, "n"), self.p_n, "m"),
            "velocity": ((t, "n"), self.v_n, "m/s"),
            "rpy": ((t, "angle"), self.rpy, "rad"),
            "R_nb": ((t, "n", "b"), self.R_nb, "1"),
            "cov_position": (matrix, self.cov_p, "m^2"),
            "cov_rotation": (matrix, self.cov_theta, "rad^2"),
            "cov_velocity": (matrix, self.cov_v, "m^2/s^2"),
        }
        made = {name: (dims, value, {"units": unit}) for name, (dims, value, unit) in variables.items()}
        coords = {t: (t, self.time, {"units": "s"}), n[0]: n[1], "n2": n[1], b[0]: b[1], "angle": ATTITUDE}
        return xarray.Dataset(made, coords)

    def geodetic(self, origin: Origin) -> tuple[Array, Array]:
        """Latitude and longitude [deg], each of shape (n,).

        Parameters
        ----------
        origin : latitude and longitude [deg] of north = east = 0
        """
        return lat_lon(self.p_n[:, 0], self.p_n[:, 1], origin)

    def write_csv(
        self,
        path: Path | str,
        more: bool = False,
        origin: Origin | None = None,
        unix: bool | None = None,
        also: Mapping[str, Array] | None = None,
        grid: str | None = None,
    ) -> None:
        """Write the columns of the contract that are known; time to the millisecond's tenth.

        Parameters
        ----------
        path : the file
        more : rows for the end of a file that has the same columns
        origin : latitude and longitude [deg] of north = east = 0, for columns ``lat`` and ``lon``; None = without
        unix : whether there is a column ``unix_time``, empty for other times; None = if the time is Unix time
        also : further columns, such as the bottom under the track, ndarray, shape (n,); NaN is an empty cell
        grid : of `rovgraph.model.grids.grid_columns`, for its columns too where the origin is known; None = without
        """
        rounded = {name: np.round(own, 12) + 0.0 for name, own in self.columns().items()}  # no -0
        known = {name: own for name, own in rounded.items() if not np.isnan(own).all()}
        decimals = {"time": 4}
        far = [name for name in POSITION if name in known and np.abs(known[name]).max() >= FAR]  # none where one is NaN
        decimals |= dict.fromkeys(far, 4)  # seven digits of a grid's northing are a metre
        dated = is_unix(self.time)
        if unix or (unix is None and dated):
            known["unix_time"] = known["time"] if dated else np.full(len(self), np.nan)
            decimals |= {"unix_time": 4} if dated else {}
        known |= place_columns(self.p_n[:, 0], self.p_n[:, 1], origin, grid)
        known |= {name: own for name, own in (also or {}).items() if not np.isnan(own).all()}
        write_csv(known, as_path(path, "path"), append=more, decimals=decimals | PLACE_DECIMALS)

    def write_tum(self, path: Path | str) -> None:
        """Write a TUM file: ``time x y z qx qy qz qw``, n axes; its first line states them (its name should: `TUM`)."""
        rows = np.column_stack([self.time, self.p_n, quaternion_from_matrix(self.R_nb)])
        line = "%.4f" + " %.6f" * 3 + " %.9f" * 4 + "\n"
        poses = line * len(rows) % tuple(rows.ravel().tolist())
        as_path(path, "path").write_text(f"# {TUM_FRAME}\n{poses}", encoding="utf-8", newline="")


def _span(time: Array) -> str:
    return f"the track has {float(time[0]):.10g} to {float(time[-1]):.10g} s" if len(time) else "the track is empty"


def _sd(covariance: Array) -> Array:
    return np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))


def _slerp(time: Array, R: Array, at: Array) -> Array:
    """Rotations interpolated along the shortest arc; NaN beside a NaN.

    Parameters
    ----------
    time : ndarray, shape (n,), increasing
    R : ndarray, shape (n, 3, 3)
    at : ndarray, shape (m,), within ``time``

    Returns
    -------
    ndarray, shape (m, 3, 3)
    """
    known = np.asarray(np.isfinite(R).all(axis=(1, 2)))
    if known.all() and len(time) > 1:
        return slerp(time, R, at)
    filled = _slerp(time, np.where(known[:, None, None], R, np.eye(3)), at) if len(time) > 1 else R[[0] * len(at)]
    gap = np.interp(at, time, np.where(known, 0.0, 1.0))
    filled[gap > 0.0] = np.nan
    return filled


def read_trajectory(path: Path | str) -> Trajectory:
    """Read a trajectory CSV: ``time, north, east``, the rest optional.

    Columns that are missing are NaN in the result (rotations too), so that a missing value
    cannot be mistaken for a zero.

    Raises
    ------
    InputError : no such file, no CSV, a required column missing, time not increasing
    """
    return parse_trajectory(read_table(path), str(path))


def read_table(path: Path | str) -> pd.DataFrame:
    """The columns of a trajectory file as numbers, other columns left out.

    Raises
    ------
    InputError : no such file, no CSV, a required column missing, a cell that is not a number
    """
    path = as_path(path, "trajectory")
    if path.is_dir():
        likely = ("trajectory_s*.csv", "trajectory_*.csv", "truth.csv*", "reference.csv*")
        inside = [found for pattern in likely for found in sorted(path.glob(pattern))]
        such = f", such as {inside[0]}" if inside else ""
        raise InputError(f"{path}: is a directory, expected a CSV file; give one in it{such}")
    table = tables.read_table(path)
    missing = [c for c in ("time", "north", "east") if c not in table.names]
    if missing:
        raise InputError(f"{path}: column {missing[0]} is missing, a trajectory has time, north, east")
    wanted = [*COLUMNS, *(c + "_sd" for c in COLUMNS[1:]), "cov_north_east"]
    time, how = table.times("time", DateRules(remedy=YEAR_FIRST))
    table.warn_how(how)
    values = {c: time if c == "time" else table.numbers(c) for c in wanted if c in table.names}
    return pd.DataFrame({c: np.where(np.isfinite(column), column, np.nan) for c, column in values.items()})


def parse_trajectory(table: pd.DataFrame, source: str) -> Trajectory:
    """A trajectory from a table of its columns; ``source`` names it in messages.

    Rows without time, north or east are left out with a `DataWarning`.

    Raises
    ------
    InputError : fewer than two rows, time not increasing
    """
    frame = table.dropna(subset=["time", "north", "east"])
    if len(frame) < 2:
        raise InputError(f"{source}: {len(frame)} rows with time, north and east, at least 2 are needed")
    if len(frame) < len(table):
        count = len(table) - len(frame)
        warn(f"{source}: {count} rows without time, north or east were left out")
    time = frame["time"].to_numpy(dtype=float)
    back = np.flatnonzero(np.diff(time) <= 0)
    if len(back):
        line = int(frame.index[back[0] + 1]) + 2
        raise InputError(f"{source} line {line}: time does not increase at {time[back[0] + 1]:.3f} s; sort the file")

    def take(names: list[str]) -> Array:
        return np.column_stack([frame[c] if c in frame else np.full(len(frame), np.nan) for c in names])

    def diagonal(names: list[str]) -> Array:
        return np.asarray(np.eye(3) * take([c + "_sd" for c in names])[:, None, :] ** 2)

    rpy, cov_p = take(ATTITUDE), diagonal(POSITION)
    if "cov_north_east" in frame:
        cov_p[:, 0, 1] = cov_p[:, 1, 0] = frame["cov_north_east"]
    axes = rpy_axes(rpy)
    cov_theta = axes @ diagonal(ATTITUDE) @ transpose(axes)
    R_nb = matrix_from_rpy(rpy)
    return Trajectory(time, take(POSITION), R_nb, take(VELOCITY), cov_p, cov_theta, diagonal(VELOCITY))
