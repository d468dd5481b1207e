"""Where to linearise an attitude that is hardly known, as after a silence of all sensors.

A heading that may be off by half a right angle cannot be corrected along a tangent: a magnetic field
that turns by forty degrees there grows by a third, which the filter would take for hard iron and
tilt. So gravity and the compasses are looked at first, and the estimate is turned to where they fit.
That is no measurement: the covariance stays, and they enter afterwards as they always do.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rovgraph.estimators.linearization import Linearization
from rovgraph.estimators.passage import Gaussian
from rovgraph.geometry import Array, exp_rotation, identity, skew, transpose
from rovgraph.graph.assembly import Attached, Interval
from rovgraph.state import State

HEADINGS = {"mag", "ahrs", "dvl_heading"}
VAGUE_TILT, VAGUE_HEADING = np.deg2rad(5.0), np.deg2rad(15.0)  # sd from which a tangent does harm
STEP, REACH_SD = np.deg2rad(3.0), 3.0  # of the headings that are tried
AT_REST = 0.2  # share of gravity by which a mean specific force may differ from it and still show where down is


def aligned(
    known: Gaussian, interval: Interval, between: Sequence[Attached], measurements: Linearization, gravity: float
) -> Gaussian:
    """The keyframe before an interval, levelled and turned if its attitude is vague.

    Parameters
    ----------
    known : its estimate
    interval : with motion
    between : measurements that belong to the keyframe
    measurements : of the filter
    gravity : [m/s^2]
    """
    if float(known.P[0, 0] + known.P[1, 1] + known.P[2, 2]) < VAGUE_TILT**2:
        return known
    known = _turned(known, _levelling(known, interval, gravity))
    compasses = [a for a in between if a.sensor in HEADINGS]
    return _turned(known, _turning(known, compasses, measurements)) if compasses else known


def _levelling(known: Gaussian, interval: Interval, gravity: float) -> Array:
    """The rotation about n's axes, shape (3,), by which a vague tilt becomes that of the mean specific force."""
    R_nb, nothing = known.state.R_nb[0], np.zeros(3)
    tilt = np.diag(R_nb @ known.P[:3, :3] @ R_nb.T)[:2]
    if interval.pim is None or interval.bridged or tilt.max() < VAGUE_TILT**2:
        return nothing
    excess = known.state.bias[0, :3] - interval.pim.biasHat().accelerometer()
    force_n = R_nb @ (interval.pim.deltaVij() / interval.pim.deltaTij() - excess)
    length = float(np.linalg.norm(force_n))
    if abs(length / gravity - 1.0) > AT_REST:
        return nothing
    axis = np.cross(force_n, [0.0, 0.0, -1.0])
    sine = float(np.linalg.norm(axis))
    return axis * (np.arctan2(sine, -force_n[2]) / sine) if sine > 0.0 else nothing


def _turning(known: Gaussian, compasses: Sequence[Attached], measurements: Linearization) -> Array:
    """The rotation about n's axes, shape (3,), by which a vague heading becomes the one that compasses make likeliest.

    Headings all around the believed one are tried, calibration and tilt being as sure as they are.
    """
    P, nothing = known.P[: measurements.size, : measurements.size], np.zeros(3)
    down_b = known.state.R_nb[0, 2]
    by_heading = P[:, :3] @ down_b
    variance = float(down_b @ by_heading[:3])
    if variance < VAGUE_HEADING**2:
        return nothing
    reach = min(REACH_SD * np.sqrt(variance), np.pi)
    angles = np.linspace(-reach, reach, 2 * int(np.ceil(reach / STEP)) + 1)
    turns = np.column_stack([0.0 * angles, 0.0 * angles, angles])
    R_nb = exp_rotation(turns) @ known.state.R_nb
    r, H, _ = measurements.linearize(replace(known.state.at([0] * len(angles)), R_nb=R_nb), [compasses] * len(angles))
    misfit, by = np.array(r), np.array(H)
    S = by @ (P - np.outer(by_heading, by_heading) / variance) @ transpose(by) + identity(misfit.shape[1])
    nis = (misfit * np.linalg.solve(S, misfit[..., None])[..., 0]).sum(axis=1)
    likeliest = (nis + np.linalg.slogdet(S)[1] + angles**2 / variance).argmin()
    return np.asarray(turns[likeliest])


def _turned(known: Gaussian, turn_n: Array) -> Gaussian:
    """Turned about n's axes by a rotation vector, shape (3,); the covariance of its attitude stays along the body's.

    A velocity that is better known along the body's axes turns with them.
    """
    if not turn_n.any():
        return known
    state, turn = known.state, exp_rotation(turn_n)
    R_nb, v_n = turn @ state.R_nb[0], state.v_n[0]
    basis = np.eye(len(known.P))
    basis[3:6, 3:6] = R_nb.T @ state.R_nb[0]  # position stays along n's
    along_body = np.concatenate([skew(v_n) @ state.R_nb[0], np.eye(3)], axis=1)
    columns = [0, 1, 2, 6, 7, 8]
    if np.trace(along_body @ known.P[np.ix_(columns, columns)] @ along_body.T) < np.trace(known.P[6:9, 6:9]):
        v_n, basis[6:9, 6:9] = turn @ v_n, turn
    turned = State(R_nb[None], state.p_n, v_n[None], state.bias, state.calibration)
    return replace(known, state=turned, P=basis @ known.P @ basis.T)
