"""Calibration of a magnetometer from a log in which the vehicle was turned.

    field = matrix (sample - centre)

in IMU axes: hard iron and soft iron, (3.2) with a full matrix where the method gives one. The unit stays
the log's: the determinant of the matrix is 1, or the field gets the length
``environment.field_norm`` where the configuration gives it.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rovgraph.calibrate.disturbances import Disturbance, find_disturbances, make_bins, turned
from rovgraph.calibrate.ellipsoid import fit_ellipsoid, require_turning
from rovgraph.calibrate.piece import Piece, digits
from rovgraph.calibrate.turns import Turn, calibrate_turns, find_turn
from rovgraph.config import Config, mount_matrix
from rovgraph.errors import InputError
from rovgraph.geometry import Array
from rovgraph.log import Log, Stream

METHODS = ("ellipsoid", "turns")
Method = Literal["ellipsoid", "turns"]
LEAST_SAMPLES = 200
# Least size of a disturbance, of the field, pass by pass: until soft iron is known, it looks like one.
PASSES = (0.12, 0.08, 0.05, 0.05)
MARGIN_S = 1.0  # around a disturbance, left out
GRAVITY_ONLY = 0.03  # specific force within this part of its median: good for the dip


@dataclass(frozen=True)
class Fit:
    """How well samples lie on a sphere.

    Attributes
    ----------
    length_rms : scatter of the field's length, as a fraction of its mean
    dip_rms : scatter of the angle between field and horizontal [rad]; None without accelerometer
    """

    length_rms: float
    dip_rms: float | None


@dataclass(frozen=True)
class MagnetometerCalibration:
    """What a calibration found.

    Attributes
    ----------
    source : log
    method : of `METHODS`
    centre, centre_sd : ndarray, shape (3,) [log's unit]; the sd is NaN for the method of turns
    matrix : ndarray, shape (3, 3)
    radii : ndarray, shape (3,), semi-axes of the samples' ellipsoid, longest first [log's unit]
    length : mean length of the calibrated field [log's unit]
    dip : of the field, down positive [rad]; None without accelerometer
    before, after : of the samples that were used
    disturbances : in the order of time; None where there is no gyro to find them by
    turns : that the method of turns took
    time, samples : ndarray, shape (n,), (n, 3), of the log
    used : ndarray of bool, shape (n,), samples outside disturbances
    """

    source: str
    method: str
    centre: Array
    centre_sd: Array
    matrix: Array
    radii: Array
    length: float
    dip: float | None
    before: Fit
    after: Fit
    disturbances: list[Disturbance] | None
    turns: list[Turn]
    time: Array
    samples: Array
    used: NDArray[np.bool_]

    @property
    def field(self) -> Array:
        """The calibrated field of all samples, shape (n, 3)."""
        return np.asarray((self.samples - self.centre) @ self.matrix.T)

    @property
    def piece(self) -> Piece:
        """The keys of a configuration that hold this calibration."""
        centre = [digits(x, 6) for x in self.centre]
        return {"imu": {"mag": {"centre": centre, "matrix": [[digits(x, 6) for x in row] for row in self.matrix]}}}

    @property
    def remarks(self) -> list[str]:
        """What a reader of the piece should know, a line each."""
        before, after = 100.0 * self.before.length_rms, 100.0 * self.after.length_rms
        fit = f"scatter of the field's length {before:.2f} % of it, now {after:.2f} %"
        return [f"magnetometer calibrated from {self.source}, method {self.method}", fit]


@dataclass(frozen=True)
class _Shape:
    """Centre, matrix of any scale, and what else a method says."""

    centre: Array
    matrix: Array
    centre_sd: Array
    turns: list[Turn]


def calibrate_magnetometer(
    log: Log, config: Config | None = None, method: Method = "ellipsoid"
) -> MagnetometerCalibration:
    """Calibrate a magnetometer.

    Parameters
    ----------
    log : read without ``imu.mag``, whose successor this gives
    config : ``environment.field_norm`` of it is used, and ``imu.mount_rpy_deg`` for the method of turns
    method : "ellipsoid", or "turns" for the thesis's (3.3)-(3.9)

    Raises
    ------
    InputError : no magnetometer, too few samples, a log that does not turn about all it has to
    """
    config = config or Config()
    if method not in METHODS:
        raise InputError(f"method {method!r}: expected one of {', '.join(METHODS)}")
    if "mag" not in log:
        raise InputError(f"{log.source}: no magnetometer in it; columns mag_x, mag_y and mag_z are needed")
    mag = log["mag"]
    if len(mag) < LEAST_SAMPLES:
        raise InputError(f"{log.source}: {len(mag)} samples of the magnetometer, at least {LEAST_SAMPLES} are needed")
    require_turning(mag.data, log.source)
    imu = log.streams.get("imu")
    fit = _method(method, mag, imu, config, log.source)
    return _result(log, method, config, *_undisturbed(mag, imu, fit))


def _method(
    method: Method, mag: Stream, imu: Stream | None, config: Config, source: str
) -> Callable[[NDArray[np.bool_]], _Shape]:
    """The fit of some of the samples."""
    R_bs = mount_matrix(config.imu.mount_rpy_deg)

    def ellipsoid(used: NDArray[np.bool_]) -> _Shape:
        found = fit_ellipsoid(mag.data[used], source)
        return _Shape(found.centre, found.matrix, found.centre_sd, [])

    def turns(used: NDArray[np.bool_]) -> _Shape:
        """In body axes: a crew turns the vehicle, and an IMU a few degrees askew would see the dip in its turns."""
        time, samples = mag.time[used], mag.data[used] @ R_bs.T
        rate = None
        if imu is not None:
            rate = np.column_stack([np.interp(time, imu.time, w) for w in imu.data[:, 3:].T]) @ R_bs.T
        found = [find_turn(axis, time, samples, rate, source) for axis in (2, 0)]
        about_z, about_x = (samples[(time >= turn.start) & (time <= turn.end)] for turn in found)
        centre, gain = calibrate_turns(about_z, about_x)
        return _Shape(centre @ R_bs, R_bs.T @ np.diag(gain) @ R_bs, np.full(3, np.nan), found)

    return ellipsoid if method == "ellipsoid" else turns


def _undisturbed(
    mag: Stream, imu: Stream | None, fit: Callable[[NDArray[np.bool_]], _Shape]
) -> tuple[_Shape, list[Disturbance] | None, NDArray[np.bool_]]:
    """The fit to what is outside disturbances: first those that are plain without a calibration, then all."""
    used = np.ones(len(mag), dtype=bool)
    if imu is None or len(imu) < LEAST_SAMPLES:
        return fit(used), None, used
    R = turned(imu.time, imu.data[:, 3:])
    matrix = np.eye(3)
    for least in PASSES:
        field = mag.data @ matrix.T
        length = float(np.median(np.linalg.norm(field[used] - 0.5 * _middle(field[used]), axis=1)))
        disturbances = find_disturbances(make_bins(mag.time, field, imu.time, R), length, least * length)
        used = _outside(mag.time, disturbances)
        shape = fit(used)
        matrix = shape.matrix / np.cbrt(np.linalg.det(shape.matrix))
    return shape, disturbances, used


def _middle(field: Array) -> Array:
    """Sum of the extremes of each component, shape (3,)."""
    return np.asarray(field.max(axis=0) + field.min(axis=0))


def _outside(time: Array, disturbances: list[Disturbance]) -> NDArray[np.bool_]:
    out = np.ones(len(time), dtype=bool)
    for d in disturbances:
        out &= (time < d.start - MARGIN_S) | (time > d.end + MARGIN_S)
    return out


def _result(
    log: Log,
    method: str,
    config: Config,
    shape: _Shape,
    disturbances: list[Disturbance] | None,
    used: NDArray[np.bool_],
) -> MagnetometerCalibration:
    """The calibration at its scale, with how well it fits."""
    mag, imu = log["mag"], log.streams.get("imu")
    raw = mag.data[used]
    bare = np.linalg.norm((raw - shape.centre) @ shape.matrix.T, axis=1)
    wanted = config.environment.field_norm
    scale = 1.0 / np.cbrt(np.linalg.det(shape.matrix)) if wanted is None else wanted / bare.mean()
    matrix = scale * shape.matrix
    calibrated = (raw - shape.centre) @ matrix.T
    dips = [_dip(mag.time[used], field, imu) for field in (raw, calibrated)]
    before, after = (
        Fit(_relative_scatter(field), None if dip is None else dip[1])
        for field, dip in zip((raw, calibrated), dips, strict=True)
    )
    return MagnetometerCalibration(
        source=log.source,
        method=method,
        centre=shape.centre,
        centre_sd=shape.centre_sd,
        matrix=matrix,
        radii=np.sort(np.linalg.svd(np.linalg.inv(shape.matrix), compute_uv=False) * bare.mean())[::-1],
        length=float(np.linalg.norm(calibrated, axis=1).mean()),
        dip=None if dips[1] is None else dips[1][0],
        before=before,
        after=after,
        disturbances=disturbances,
        turns=shape.turns,
        time=mag.time,
        samples=mag.data,
        used=used,
    )


def _relative_scatter(field: Array) -> float:
    length = np.linalg.norm(field, axis=1)
    return float(length.std() / length.mean())


def _dip(time: Array, field: Array, imu: Stream | None) -> tuple[float, float] | None:
    """Mean and scatter of the field's dip against the specific force, where that is gravity alone [rad]."""
    if imu is None:
        return None
    force = np.column_stack([np.interp(time, imu.time, a) for a in imu.data[:, :3].T])
    strength = np.linalg.norm(force, axis=1)
    quiet = np.abs(strength / np.median(strength) - 1.0) < GRAVITY_ONLY
    cosine = -np.sum(force * field, axis=1) / (strength * np.linalg.norm(field, axis=1))
    dip = np.arcsin(np.clip(cosine[quiet], -1.0, 1.0))
    return float(dip.mean()), float(dip.std())
