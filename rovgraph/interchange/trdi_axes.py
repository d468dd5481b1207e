"""Velocities of Teledyne's Doppler instruments, from any of their coordinate systems to forward, starboard, down.

An instrument has X from beam 1 to beam 2, Y from beam 4 to beam 3 and Z away from the bottom it looks at; a ship has X
to starboard, Y forward and Z up the mast; Earth has east, north, up. Source: Teledyne RD Instruments, ADCP Coordinate
Transformation, P/N 951-6079-00.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, matrix_from_rpy

BEAM, INSTRUMENT, SHIP, EARTH = range(4)
SYSTEMS = "beam", "instrument", "ship", "earth"
FORWARD = np.array([1, 0, 2])  # places of forward, starboard and the vertical in a triple
DOWN = np.array([1.0, 1.0, -1.0])  # the vertical turned downwards


@dataclass(frozen=True)
class Attitude:
    """How each of n velocities was measured.

    Attributes
    ----------
    rpy : ndarray, shape (n, 3), roll, pitch, heading that the instrument computed with [rad]
    tilted : ndarray of bool, shape (n,), roll and pitch were used for ship or Earth axes
    upward : ndarray of bool, shape (n,), the instrument looks up
    beam_angle : ndarray, shape (n,), of the beams against its axis [rad]
    convex : ndarray of bool, shape (n,), the beams diverge
    """

    rpy: Array
    tilted: NDArray[np.bool_]
    upward: NDArray[np.bool_]
    beam_angle: Array
    convex: NDArray[np.bool_]


def forward_starboard_down(values: Array, system: NDArray[np.integer], attitude: Attitude) -> tuple[Array, Array]:
    """Velocities along axes forward (Y), starboard (X) and down (-Z) of the instrument, upwards ones turned over.

    Parameters
    ----------
    values : ndarray, shape (n, 4), four beams, or three axes and the error velocity; NaN = not measured [m/s]
    system : ndarray, shape (n,), `BEAM`, `INSTRUMENT`, `SHIP` or `EARTH`

    Returns
    -------
    velocity, shape (n, 3), and error velocity, shape (n,) [m/s]
    """
    values = np.where((system == BEAM)[:, None], _of_beams(values, attitude), values)
    velocity = values[:, FORWARD] * DOWN
    own = (system == BEAM) | (system == INSTRUMENT)
    velocity[own & attitude.upward] *= [1.0, -1.0, -1.0]  # turned over about the forward axis
    angles = attitude.rpy * np.column_stack([attitude.tilted, attitude.tilted, system == EARTH])
    velocity[:] = np.where(own[:, None], velocity, (velocity[:, None] @ matrix_from_rpy(angles))[:, 0])
    return velocity, values[:, 3]


def _of_beams(beams: Array, attitude: Attitude) -> Array:
    """X, Y, Z and error velocity of beams, shape (n, 4); one beam that is missing is what gives no error."""
    missing = np.isnan(beams)
    signs = np.array([1.0, 1.0, -1.0, -1.0])
    rest = np.nansum(beams * signs, axis=1, keepdims=True)
    three = missing.sum(axis=1, keepdims=True) == 1
    beams = np.where(missing & three, -rest * signs, beams)
    b1, b2, b3, b4 = beams.T
    across = 1.0 / (2.0 * np.sin(attitude.beam_angle))
    sign = np.where(attitude.convex, 1.0, -1.0)
    error = np.where(three[:, 0], np.nan, across / np.sqrt(2.0) * (b1 + b2 - b3 - b4))
    vertical = (b1 + b2 + b3 + b4) / (4.0 * np.cos(attitude.beam_angle))
    return np.column_stack([sign * across * (b1 - b2), sign * across * (b4 - b3), vertical, error])
