"""Where to linearise an attitude that is hardly known, as after a silence of all sensors.

A heading that may be off by half a right angle cannot be corrected along a tangent: a magnetic field
that turns by forty degrees there grows by a fifth, which the filter would take for hard iron and
tilt. So gravity and the compasses are looked at first, and the estimate is turned to where they fit.
That is no measurement: the covariance stays, and they enter afterwards as they always do. It is what the
iterated Kalman filter does (Bell and Cathey 1993), for the attitude alone, and begun where it can converge.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from rovgraph.engine.filter_step import Gaussian
from rovgraph.engine.problem import Index, Problem
from rovgraph.geometry import (
    Array,
    exp_rotation,
    identity,
    level_from_force,
    matrix_from_rpy,
    rpy_from_matrix,
    skew,
    transpose,
)
from rovgraph.instruments import HEADING_STREAMS
from rovgraph.kernels import motion_row
from rovgraph.kernels.filtering import attitude_variances_of
from rovgraph.state import PLACE_DIM

POORLY_KNOWN = np.deg2rad([4.0, 10.0]) ** 2  # variances of tilt and heading from which a tangent does harm [rad^2]
STEP, REACH_SD = np.deg2rad(3.0), 3.0  # of the headings that are tried
AT_REST = 0.2  # share of gravity by which a mean specific force may differ from it and still show where down is

Linearize = Callable[[Gaussian, Problem, Index], tuple[Array, Array]]


def poorly_known(known: Gaussian) -> bool:
    """Whether tilt or heading is hardly known."""
    tilt, heading = attitude_variances_of(known.x, known.P)
    return bool(tilt > POORLY_KNOWN[0] or heading > POORLY_KNOWN[1])


def aligned(
    known: Gaussian, problem: Problem, k: int, between: slice, linearize: Linearize, gravity: float
) -> Gaussian:
    """The keyframe before keyframe k, levelled and turned to its compasses where it is `poorly_known`.

    Parameters
    ----------
    known : its estimate
    problem, between : the dive, and its measurements between the two
    linearize : from an estimate and measurements to whitened innovations and Jacobians
    gravity : [m/s^2]
    """
    tilt, heading = attitude_variances_of(known.x, known.P)
    if tilt > POORLY_KNOWN[0]:
        known = with_attitude(known, _levelled(known, problem, k, gravity))
    which = [n for n, sensor in enumerate(problem.sensors) if sensor in HEADING_STREAMS]
    compasses = between.start + np.flatnonzero(np.isin(problem.which[between], which))
    if len(compasses) and heading > POORLY_KNOWN[1]:
        known = with_attitude(known, _towards(known, problem, compasses, linearize))
    return known


def with_attitude(known: Gaussian, R_nb: Array) -> Gaussian:
    """The same with another attitude, shape (3, 3); the covariance of attitude stays along the body's axes.

    A velocity that is better known along these axes turns with them.
    """
    x, columns = known.x.copy(), [0, 1, 2, 6, 7, 8]
    before, v_n, basis = known.state.R_nb[0], known.state.v_n[0], np.eye(len(known.P))
    basis[3:6, 3:6] = R_nb.T @ before  # position stays along n's
    along_body = np.concatenate([skew(v_n) @ before, np.eye(3)], axis=1)
    if np.trace(along_body @ known.P[np.ix_(columns, columns)] @ along_body.T) < np.trace(known.P[6:9, 6:9]):
        basis[6:9, 6:9] = turn = R_nb @ before.T
        x[12:15] = turn @ v_n
    x[:9] = R_nb.ravel()
    B = basis @ known.B if known.B.size else known.B
    return replace(known, x=x, P=basis @ known.P @ basis.T, B=B)


def _levelled(known: Gaussian, problem: Problem, k: int, gravity: float) -> Array:
    """The attitude whose down is that of the interval's mean specific force, where that can be gravity's."""
    R_nb: Array = known.state.R_nb[0]
    if problem.bridged[k]:
        return R_nb
    motion = problem.motions[k - 1]
    excess = known.state.bias[0, :3] - motion[motion_row.BIAS : motion_row.BIAS + 3]
    force_b = motion[motion_row.VELOCITY] / motion[motion_row.DURATION] - excess
    if abs(float(np.linalg.norm(force_b)) / gravity - 1.0) > AT_REST:
        return R_nb
    return matrix_from_rpy([*level_from_force(force_b), rpy_from_matrix(R_nb)[2]])


def _towards(known: Gaussian, problem: Problem, compasses: Index, linearize: Linearize) -> Array:
    """The attitude with the heading that compasses make likeliest.

    Headings all around the believed one are tried, calibration and tilt being as sure as they are.
    """
    R_nb = known.state.R_nb[0]
    size = len(known.P) - PLACE_DIM * len(known.places)
    P = known.P[:size, :size]
    by_heading = P[:, :3] @ R_nb[2]
    variance = float(R_nb[2] @ by_heading[:3])
    reach = min(REACH_SD * np.sqrt(variance), np.pi)
    angles = np.linspace(-reach, reach, 2 * int(np.ceil(reach / STEP)) + 1)
    turned = exp_rotation(np.column_stack([0.0 * angles, 0.0 * angles, angles])) @ R_nb
    rows = [linearize(replace(known, x=np.concatenate([R.ravel(), known.x[9:]])), problem, compasses) for R in turned]
    misfit, by = np.array([r for r, _ in rows]), np.array([H[:, :size] for _, H in rows])
    S = by @ (P - np.outer(by_heading, by_heading) / variance) @ transpose(by) + identity(misfit.shape[1])
    nis = (misfit * np.linalg.solve(S, misfit[..., None])[..., 0]).sum(axis=1)
    likeliest = (nis + np.linalg.slogdet(S)[1] + angles**2 / variance).argmin()
    return np.asarray(turned[likeliest])
