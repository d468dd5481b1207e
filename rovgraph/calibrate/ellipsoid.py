"""The ellipsoid that magnetometer samples lie on when the vehicle is turned through all directions.

    |M (y - c)| = 1

c is the hard iron, M, symmetric, soft iron and scale: (3.2) with a full matrix. The fit is least squares
on the field's length, which are the units of the error, with a robust loss; it begins at the
sphere that linear least squares give. A rotation between magnetometer and IMU does not change lengths,
so it cannot be seen here.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from rovgraph.errors import InputError
from rovgraph.geometry import Array

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
