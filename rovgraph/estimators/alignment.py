"""Where to linearise an attitude that is hardly known, as after a silence of all sensors.

A heading that may be off by half a right angle cannot be corrected along a tangent: a magnetic field
that turns by forty degrees there grows by a fifth, which the filter would take for hard iron and
tilt. So gravity and the compasses are looked at first, and the estimate is turned to where they fit.
That is no measurement: the covariance stays, and they enter afterwards as they always do. It is what the
iterated Kalman filter does (Bell and Cathey 1993), for the attitude alone, and begun where it can converge.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.engine.keyframes import KeyframeInterval, KeyframeMeasurement
from rovgraph.estimators.filter_step import Gaussian
from rovgraph.estimators.linearization import Linearization
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

POORLY_KNOWN_TILT, POORLY_KNOWN_HEADING = np.deg2rad(4.0), np.deg2rad(10.0)  # sd from which a tangent does harm
STEP, REACH_SD = np.deg2rad(3.0), 3.0  # of the headings that are tried
AT_REST = 0.2  # share of gravity by which a mean specific force may differ from it and still show where down is


def attitude_poorly_known(known: Gaussian) -> bool:
    """Whether tilt or heading is hardly known."""
    if known.P[0, 0] + known.P[1, 1] + known.P[2, 2] < POORLY_KNOWN_TILT**2:
        return False
    tilt, heading = _variances(known)
    return bool(tilt > POORLY_KNOWN_TILT**2 or heading > POORLY_KNOWN_HEADING**2)


def aligned(
    known: Gaussian,
    interval: KeyframeInterval,
    between: Sequence[KeyframeMeasurement],
    measurements: Linearization,
    gravity: float,
) -> Gaussian:
    """The keyframe before an interval, levelled and turned to its compasses where it is `attitude_poorly_known`.

    Parameters
    ----------
    known : its estimate
    interval : with motion
    between : measurements that belong to the keyframe
    measurements : of the filter
    gravity : [m/s^2]
    """
    tilt, heading = _variances(known)
    if tilt > POORLY_KNOWN_TILT**2:
        known = with_attitude(known, _levelled(known, interval, gravity))
    compasses = [a for a in between if a.sensor in HEADING_STREAMS]
    if compasses and heading > POORLY_KNOWN_HEADING**2:
        known = with_attitude(known, _towards(known, compasses, measurements))
    return known


def with_attitude(known: Gaussian, R_nb: Array) -> Gaussian:
    """The same with another attitude, shape (3, 3); the covariance of attitude stays along the body's axes.

    A velocity that is better known along these axes turns with them.
    """
    state, columns = known.state, [0, 1, 2, 6, 7, 8]
    before, v_n, basis = state.R_nb[0], state.v_n, np.eye(len(known.P))
    basis[3:6, 3:6] = R_nb.T @ before  # position stays along n's
    along_body = np.concatenate([skew(v_n[0]) @ before, np.eye(3)], axis=1)
    if np.trace(along_body @ known.P[np.ix_(columns, columns)] @ along_body.T) < np.trace(known.P[6:9, 6:9]):
        basis[6:9, 6:9] = turn = R_nb @ before.T
        v_n = v_n @ turn.T
    return replace(known, state=replace(state, R_nb=R_nb[None], v_n=v_n), P=basis @ known.P @ basis.T)


def _variances(known: Gaussian) -> tuple[float, float]:
    """Of the tilt, the larger one, and of the heading [rad^2]."""
    R_nb = known.state.R_nb[0]
    north, east, down = np.diag(R_nb @ known.P[:3, :3] @ R_nb.T).tolist()
    return max(north, east), down


def _levelled(known: Gaussian, interval: KeyframeInterval, gravity: float) -> Array:
    """The attitude whose down is that of the interval's mean specific force, where that can be gravity's."""
    R_nb: Array = known.state.R_nb[0]
    if interval.motion is None or interval.bridged:
        return R_nb
    excess = known.state.bias[0, :3] - interval.motion.bias[:3]
    force_b = interval.motion.dv / interval.motion.duration - excess
    if abs(float(np.linalg.norm(force_b)) / gravity - 1.0) > AT_REST:
        return R_nb
    return matrix_from_rpy([*level_from_force(force_b), rpy_from_matrix(R_nb)[2]])


def _towards(known: Gaussian, compasses: Sequence[KeyframeMeasurement], measurements: Linearization) -> Array:
    """The attitude with the heading that compasses make likeliest.

    Headings all around the believed one are tried, calibration and tilt being as sure as they are.
    """
    state, P = known.state, known.P[: measurements.size, : measurements.size]
    by_heading = P[:, :3] @ state.R_nb[0, 2]
    variance = float(state.R_nb[0, 2] @ by_heading[:3])
    reach = min(REACH_SD * np.sqrt(variance), np.pi)
    angles = np.linspace(-reach, reach, 2 * int(np.ceil(reach / STEP)) + 1)
    R_nb = exp_rotation(np.column_stack([0.0 * angles, 0.0 * angles, angles])) @ state.R_nb
    turned = replace(state.at([0] * len(angles)), R_nb=R_nb)
    r, H, _ = measurements.linearize(turned, [compasses] * len(angles))
    misfit, by = np.array(r), np.array(H)
    S = by @ (P - np.outer(by_heading, by_heading) / variance) @ transpose(by) + identity(misfit.shape[1])
    nis = (misfit * np.linalg.solve(S, misfit[..., None])[..., 0]).sum(axis=1)
    likeliest = (nis + np.linalg.slogdet(S)[1] + angles**2 / variance).argmin()
    return np.asarray(R_nb[likeliest])
