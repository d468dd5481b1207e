"""Calibration of a magnetometer from a log in which the vehicle was turned: by an ellipsoid, or as in the thesis.

    field = matrix (sample - centre)

in IMU axes: hard iron and soft iron, (3.2) with a full matrix where the method gives one. The unit stays
the log's: the determinant of the matrix is 1, or the field gets the length
``environment.field_norm`` where the configuration gives it.

**Ellipsoid.** Turned through all directions, magnetometer samples y lie on

    |M (y - c)| = 1

c is the hard iron, M, symmetric, soft iron and scale: (3.2) with a full matrix. The fit is least squares
on the field's length, which are the units of the error, with a robust loss; it begins at the
sphere that linear least squares give. A rotation between magnetometer and IMU does not change lengths,
so it cannot be observed here.

**Thesis**: a turn about z and a turn about x (3.2)-(3.9).

    H = gamma y + kappa,    gamma diagonal

From the turn about z, gamma_x = max(1, Y/X), gamma_y = max(1, X/Y) with the ranges X, Y of the samples,
and kappa takes off the middle of each range; from the turn about x, with x and y calibrated,
gamma_z = Y/Z. The turns are found in the log: by the gyro, or where there is none by the field,
whose component along the axis of a turn does not change.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d  # type: ignore[attr-defined]
from scipy.optimize import least_squares

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle
from rovgraph.lab.calibrate.disturbances import Disturbance, find_disturbances, make_bins, turned
from rovgraph.lab.calibrate.piece import Piece, digits
from rovgraph.log import Log, Stream
from rovgraph.model.config import Config, mount_matrix

AXES = ("x", "y", "z")
TURNING = 0.05  # scatter of the samples, of their length, below which nothing turned
FLAT = 0.1  # scatter across a plane, of that in it, below which it turned about one axis only
KNOWN_SD = 0.05  # of the field: a centre less certain than this is refused
STRETCHED = 3.0  # longest over shortest radius, beyond which it is no magnetometer's ellipsoid
BEND = 0.02  # residual at which the robust loss bends, of the field
CELL = 0.1  # side of the cells of the unit sphere that samples are averaged over
BLOCKS = 50  # stretches of the log whose errors are taken as independent of each other


@dataclass(frozen=True)
class Ellipsoid:
    """``|matrix (sample - centre)| = 1``.

    Attributes
    ----------
    centre, centre_sd : ndarray, shape (3,) [log's unit]
    matrix : ndarray, shape (3, 3), symmetric [1 / log's unit]
    """

    centre: Array
    centre_sd: Array
    matrix: Array

    @property
    def radii(self) -> Array:
        """Semi-axes, longest first, shape (3,) [log's unit]."""
        return np.sort(1.0 / np.linalg.eigvalsh(self.matrix))[::-1]


def require_turning(samples: Array, source: str) -> None:
    """Refuse samples that no calibration can come from.

    Parameters
    ----------
    samples : ndarray, shape (n, 3)
    source : name of the log

    Raises
    ------
    InputError : the log does not turn, or turns about one axis only, which is named
    """
    values, vectors = np.linalg.eigh(np.cov(samples.T))
    scatter = np.sqrt(np.maximum(values, 0.0))  # smallest first
    if scatter[1] < TURNING * np.median(np.linalg.norm(samples, axis=1)):
        raise InputError(
            f"{source}: does not turn: the field's direction in the IMU's axes hardly changes; "
            "turn the vehicle a full turn about each axis while logging"
        )
    if scatter[0] < FLAT * scatter[2]:
        turned = AXES[int(np.argmax(np.abs(vectors[:, 0])))]
        missing = " or ".join(a for a in AXES if a != turned)
        raise InputError(
            f"{source}: turns about the IMU's {turned} axis only, the centre along {turned} stays unknown; "
            f"turn it about {missing} as well, a full turn"
        )


def fit_ellipsoid(samples: Array, source: str) -> Ellipsoid:
    """Least-squares ellipsoid on the field's length.

    Parameters
    ----------
    samples : ndarray, shape (n, 3), in the order of time
    source : name of the log

    Raises
    ------
    InputError : samples that do not determine an ellipsoid
    """
    require_turning(samples, source)
    scale = 0.5 * float(np.ptp(samples, axis=0).max())
    centre = _sphere_centre(samples / scale)
    y = _means_by_direction(samples / scale, centre)
    start = np.concatenate([centre, np.eye(3)[_UPPER]])

    def misfit(p: Array) -> Array:
        return np.asarray(np.linalg.norm((y - p[:3]) @ _symmetric(p[3:]), axis=1) - 1.0)

    fit = least_squares(misfit, start, loss="cauchy", f_scale=BEND)  # type: ignore[operator]
    matrix = _symmetric(fit.x[3:])
    jacobian = least_squares(misfit, fit.x, max_nfev=1).jac  # type: ignore[operator]  # the robust loss bends fit.jac
    values, sd = np.abs(np.linalg.eigvalsh(matrix)), _clustered_sd(jacobian, fit.fun)[:3]
    inverse_radius = float(np.cbrt(np.prod(values)))
    if values.max() > STRETCHED * values.min() or sd.max() * inverse_radius > KNOWN_SD:
        worst = AXES[int(np.argmax(sd))]
        raise InputError(
            f"{source}: does not turn far enough to determine an ellipsoid, least along the IMU's {worst} axis; "
            "turn the vehicle a full turn about all three axes, or take the method of turns (one about z, one about x)"
        )
    return Ellipsoid(scale * fit.x[:3], scale * sd, _positive(matrix) / scale)


_UPPER = np.triu_indices(3)


def _symmetric(p: Array) -> Array:
    """The symmetric matrix with the upper triangle ``p``, shape (3, 3)."""
    out = np.zeros((3, 3))
    out[_UPPER] = p
    return np.asarray(out + out.T - np.diag(np.diag(out)))


def _positive(matrix: Array) -> Array:
    """The positive definite matrix that gives the same lengths."""
    values, vectors = np.linalg.eigh(matrix)
    return np.asarray((vectors * np.abs(values)) @ vectors.T)


def _means_by_direction(y: Array, centre: Array) -> Array:
    """Means of samples in the same direction, in the order of time: where it rested counts once."""
    away = y - centre
    place = np.floor(away / (CELL * np.linalg.norm(away, axis=1, keepdims=True))).astype(int)
    _, first, cell, count = np.unique(place, axis=0, return_index=True, return_inverse=True, return_counts=True)
    sums = np.column_stack([np.bincount(cell.ravel(), weights=column) for column in y.T])
    return np.asarray((sums / count[:, None])[np.argsort(first)])


def _sphere_centre(y: Array) -> Array:
    """Centre of the sphere that fits best in squares of lengths, |y|^2 = 2 y c + d; shape (3,)."""
    design = np.column_stack([2.0 * y, np.ones(len(y))])
    return np.asarray(np.linalg.lstsq(design, (y**2).sum(axis=1), rcond=None)[0][:3])


def _clustered_sd(J: Array, r: Array) -> Array:
    """Standard deviations of a robust fit whose errors are alike over stretches of the log.

    The sandwich estimator with clusters: samples that follow each other share the error of the
    model, and would count as far too many if taken as independent.

    Parameters
    ----------
    J, r : ndarray, shape (n, k), (n,), Jacobian and residuals at the optimum
    """
    weighted = J / (1.0 + (r / BEND) ** 2)[:, None]  # of Cauchy's loss
    begins = np.unique(np.linspace(0, len(r), BLOCKS, endpoint=False).astype(int))
    score = np.add.reduceat(weighted * r[:, None], begins, axis=0)
    bread = np.linalg.pinv(J.T @ weighted)
    return np.asarray(np.sqrt(np.diag(bread @ (score.T @ score) @ bread)))


SMOOTH_S = 0.5  # rates are averaged over this
GRID_S = 0.05
SLOW = 0.03  # slower is standing still [rad/s]
ALONG = 0.9  # part of the rate that is about the axis
PAUSE_S = 2.0  # a turn may pause this long
FULL = 0.97 * 2.0 * np.pi  # of the field's angle: what counts as a full turn [rad]


@dataclass(frozen=True)
class Turn:
    """A full turn about one of the vehicle's axes.

    Attributes
    ----------
    axis : "x" or "z"
    start, end : [s]
    """

    axis: str
    start: float
    end: float


def find_turn(axis: int, time: Array, samples: Array, rate: Array | None, source: str) -> Turn:
    """The longest stretch of a log that turns about an axis, a full turn at least.

    Parameters
    ----------
    axis : 0 = x, 2 = z
    time : ndarray, shape (n,) [s]
    samples : ndarray, shape (n, 3), magnetometer, body axes
    rate : ndarray, shape (n, 3), angular rate [rad/s], body axes; None = from the field
    source : name of the log

    Raises
    ------
    InputError : there is none
    """
    about = _about_axis(axis, time, samples, rate)
    runs = [run for run in _runs(time, about) if _swept(samples[run], axis) >= FULL]
    name = "xyz"[axis]
    if not runs:
        by = "field" if rate is None else "gyro"
        raise InputError(
            f"{source}: no full turn about the vehicle's {name} axis in it, by the {by}; "
            "the method needs a turn about z and one about x, each slow and about that axis alone"
        )
    longest = max(runs, key=lambda run: time[run[-1]] - time[run[0]])
    return Turn(name, float(time[longest[0]]), float(time[longest[-1]]))


def calibrate_turns(about_z: Array, about_x: Array) -> tuple[Array, Array]:
    """Centre and gains of (3.3)-(3.9), not normalised.

    Parameters
    ----------
    about_z, about_x : ndarray, shape (n, 3), samples of the two turns

    Returns
    -------
    centre : ndarray, shape (3,), -kappa / gamma
    gain : ndarray, shape (3,), the diagonal of gamma
    """
    centre, extent = np.empty(3), np.ptp(about_z, axis=0)
    gain = np.array([max(1.0, extent[1] / extent[0]), max(1.0, extent[0] / extent[1]), 1.0])
    centre[:2] = 0.5 * (about_z.max(axis=0) + about_z.min(axis=0))[:2]
    extent = np.ptp(about_x, axis=0)
    gain[2] = gain[1] * extent[1] / extent[2]
    centre[2] = 0.5 * (about_x[:, 2].max() + about_x[:, 2].min())
    return centre, gain


def _about_axis(axis: int, time: Array, samples: Array, rate: Array | None) -> NDArray[np.bool_]:
    """Where the rotation is about the axis alone, shape (n,).

    Without a gyro from the field y: dy = -w x y has no component along w, and a rate of
    at least |dy| / |y|. It has none for a moment in other turns too; those do not sweep a circle.
    """
    steps = np.arange(time[0], time[-1], GRID_S)
    width = max(round(SMOOTH_S / GRID_S), 1)
    signal = samples if rate is None else rate
    even = np.column_stack([uniform_filter1d(np.interp(steps, time, x), width) for x in signal.T])
    others = [i for i in range(3) if i != axis]
    if rate is None:
        change = np.gradient(uniform_filter1d(even, 2 * width, axis=0), GRID_S, axis=0)
        swing = np.linalg.norm(change[:, others], axis=1)
        reach = 0.5 * np.ptp(even, axis=0).max()
        turning = (swing > SLOW * 0.3 * reach) & (np.abs(change[:, axis]) < np.sqrt(1.0 - ALONG**2) * swing)
    else:
        length = np.linalg.norm(even, axis=1)
        turning = (length > SLOW) & (np.abs(even[:, axis]) > ALONG * length)
    at = np.clip(((time - steps[0]) / GRID_S).astype(int), 0, len(steps) - 1)
    return np.asarray(turning[at], dtype=bool)


def _runs(time: Array, flag: NDArray[np.bool_]) -> list[NDArray[np.int64]]:
    """Stretches where the flag is up, short pauses included; indices of each."""
    up = np.flatnonzero(flag)
    if not up.size:
        return []
    parts = np.split(up, np.flatnonzero(np.diff(time[up]) > PAUSE_S) + 1)
    return [np.arange(part[0], part[-1] + 1) for part in parts]


def _swept(samples: Array, axis: int) -> float:
    """Angle that the field swept across an axis, seen from the middle of its range [rad]."""
    across = np.delete(samples, axis, axis=1)
    across = across - 0.5 * (across.max(axis=0) + across.min(axis=0))
    angle = np.arctan2(across[:, 1], across[:, 0])
    total = np.concatenate([[0.0], np.cumsum(wrap_angle(np.diff(angle)))])
    return float(np.ptp(total))


METHODS = ("ellipsoid", "turns")
Method = Literal["ellipsoid", "turns"]
LEAST_SAMPLES = 200
# Least size of a disturbance, of the field, pass by pass: until soft iron is known, it looks like one.
PASSES = (0.12, 0.08, 0.05, 0.05)
MARGIN_S = 1.0  # around a disturbance, left out
GRAVITY_ONLY = 0.03  # specific force within this part of its median: good for the dip


@dataclass(frozen=True)
class SphereFit:
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
    """Result of a magnetometer's calibration.

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
    before: SphereFit
    after: SphereFit
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
        """Remarks for a reader of the piece, a line each."""
        before, after = 100.0 * self.before.length_rms, 100.0 * self.after.length_rms
        fit = f"scatter of the field's length {before:.2f} % of it, now {after:.2f} %"
        return [f"magnetometer calibrated from {self.source}, method {self.method}", fit]


@dataclass(frozen=True)
class _Shape:
    """Centre, matrix of any scale, and other results of a method."""

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
        SphereFit(_relative_scatter(field), None if dip is None else dip[1])
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
