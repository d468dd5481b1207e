"""The thesis's calibration of the magnetometer: a turn about z and a turn about x (3.2)-(3.9).

    H = gamma y + kappa,    gamma diagonal

From the turn about z, gamma_x = max(1, Y/X), gamma_y = max(1, X/Y) with the ranges X, Y of the samples,
and kappa takes off the middle of each range; from the turn about x, with x and y calibrated,
gamma_z = Y/Z. The turns are found in the log: by the gyro, or where there is none by the field,
whose component along the axis of a turn does not change.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter1d  # type: ignore[attr-defined]

from rovgraph.errors import InputError
from rovgraph.geometry import Array, wrap_angle

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
