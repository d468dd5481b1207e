"""A motion driven through the thrusters: the equations of motion, integrated at 100 Hz.

`rovgraph.vehicle` states the equations; here they stand once more in plain floats, since a
step of a hundredth of a second is too short for arrays (a test compares the two). With c the
velocity of the water and v that of the vehicle relative to it, body axes,

    M v' = F + D(v) - w x M v
    J w' = tau + D(w) + r_cb x B - w x J w + M v x v
    p_n' = R_nb v + c_n,   (roll, pitch, yaw)' = E w

integrated by the rule of Adams and Bashforth of second order. Water that accelerates tilts
the pressure, and with it the direction of buoyancy: B = -m (g - c_n').
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import cos, sin

import numpy as np
from numpy.typing import ArrayLike

from rovgraph.errors import InputError
from rovgraph.geometry import Array, matrix_from_rpy
from rovgraph.simulate.path import Path, Thrusters
from rovgraph.simulate.sea import GRAVITY, Sea
from rovgraph.vehicle import Hydrodynamics

STEP_S = 0.01  # Ts of (2.26)
CONTROL_S = 0.1  # between two signals
SETTLING_S = 40.0  # driven before the log begins, so that it begins on station
RISE_S = 0.12  # from 10 to 90 percent of a thruster's signal, below (2.22)
LAG_S = RISE_S / 3.36  # time constant of each of two first-order lags that rise so

WILDEST = 50.0  # velocity or angular rate beyond which the integration has failed [m/s, rad/s]

_SUBSTEPS = round(CONTROL_S / STEP_S)
Vector = tuple[float, ...]


@dataclass(frozen=True)
class Craft:
    """What a pilot sees of the vehicle.

    Attributes
    ----------
    time : [s], negative before the log begins
    p_n : ndarray, shape (3,) [m]
    rpy : ndarray, shape (3,) [rad], yaw unwrapped
    v_b : ndarray, shape (3,), velocity over ground [m/s]
    w_b : ndarray, shape (3,) [rad/s]
    """

    time: float
    p_n: Array
    rpy: Array
    v_b: Array
    w_b: Array


Pilot = Callable[[Craft], Array]  # signals of the thrusters, shape (m,) [percent]


def drive(vehicle: Hydrodynamics, sea: Sea, pilot: Pilot, start: ArrayLike, duration: float) -> Path:
    """The path of a vehicle that a pilot drives.

    Parameters
    ----------
    vehicle : Hydrodynamics, as it truly is
    sea : Sea
    pilot : gives the signals every `CONTROL_S`, from `SETTLING_S` before the log begins
    start : array_like, shape (4,), north, east, down [m] and yaw [rad], at rest
    duration : [s], rounded up to whole `CONTROL_S`

    Returns
    -------
    Path, with the signals of its thrusters

    Raises
    ------
    InputError : the motion leaves all bounds, as with drag too large for the mass
    """
    ticks, settling = int(np.ceil(duration / CONTROL_S - 1e-9)), round(SETTLING_S / CONTROL_S)
    time = CONTROL_S * np.arange(-settling, ticks + 1)
    fine: Array = STEP_S * np.arange(-settling * _SUBSTEPS, (ticks + 1) * _SUBSTEPS, dtype=float)
    water, pull = sea.velocity(fine), np.array([0.0, 0.0, GRAVITY]) - sea.acceleration(fine)
    north, east, down, yaw = (float(x) for x in np.asarray(start, float))
    state: Vector = (*(-water[0]).tolist(), 0.0, 0.0, 0.0, north, east, down, 0.0, 0.0, yaw)
    rates, before = _rates(vehicle), None
    lag = _Lag(len(vehicle.thruster_positions))
    signals, states = [], []
    for k, now in enumerate(time):
        part = slice(k * _SUBSTEPS, (k + 1) * _SUBSTEPS)
        signals.append(np.clip(pilot(_craft(now, state, water[part.start])), -100.0, 100.0))
        force, moment = vehicle.force_and_moment(lag.follow(signals[-1]))
        inputs = zip(force.tolist(), moment.tolist(), water[part].tolist(), pull[part].tolist(), strict=True)
        for F, tau, c, g in inputs:
            states.append(state)
            rate = rates(state, F, tau, c, g)
            before = before or rate
            state = tuple([x + STEP_S * (1.5 * a - 0.5 * b) for x, a, b in zip(state, rate, before, strict=True)])
            before = rate
            if not -WILDEST < min(state[:6]) <= max(state[:6]) < WILDEST:
                raise InputError(
                    f"vehicle: at {now:.1f} s the motion diverges; steps of {STEP_S} s are too long "
                    "for drag, inertia or thrust as large or small as these"
                )
    first, last = settling * _SUBSTEPS, (settling + ticks) * _SUBSTEPS
    motion = np.array(states[first : last + 1])
    thrusters = Thrusters(np.round(time[settling:], 4), np.array(signals[settling:]))
    return Path.through(grid(len(motion)), motion[:, 6:9], motion[:, 9:], rest=False, thrusters=thrusters)


def grid(n: int) -> Array:
    """Times of n steps of the integration, from 0, shape (n,) [s]."""
    return np.asarray(STEP_S * np.arange(n), float)


class _Lag:
    """Two first-order lags in a row between a signal and the thruster's turning."""

    def __init__(self, thrusters: int) -> None:
        self.first, self.second = np.zeros(thrusters), np.zeros(thrusters)
        t = STEP_S * np.arange(_SUBSTEPS + 1)[:, None] / LAG_S
        self.decay, self.ramp = np.exp(-t), t * np.exp(-t)

    def follow(self, signals: Array) -> Array:
        """The delayed signals at the steps until the next signal, shape (steps, m)."""
        first, second = self.first - signals, self.second - signals
        delayed = signals + self.decay * second + self.ramp * first
        self.first, self.second = signals + self.decay[-1] * first, delayed[-1]
        return np.asarray(delayed[:-1])


def _craft(time: float, state: Vector, water_n: Array) -> Craft:
    values = np.array(state)
    v_b = values[:3] + matrix_from_rpy(values[9:]).T @ water_n
    return Craft(float(time), values[6:9], values[9:], v_b, values[3:6])


def _rates(vehicle: Hydrodynamics) -> Callable[[Vector, Vector, Vector, Vector, Vector], Vector]:
    """The right-hand side of the equations of motion for one vehicle, in plain floats.

    It takes velocity relative to the water, angular rate, position, roll, pitch, yaw (12 in
    all), thrust and its moment, velocity of the water and gravity less its acceleration.
    """
    (mx, my, mz), (jx, jy, jz) = vehicle.mass.tolist(), vehicle.inertia.tolist()
    (ax, ay, az), (bx, by, bz) = vehicle.drag_linear.tolist(), vehicle.drag_quadratic.tolist()
    (dx, dy, dz), (ex, ey, ez) = vehicle.turning_drag_linear.tolist(), vehicle.turning_drag_quadratic.tolist()
    lift = vehicle.buoyancy / GRAVITY
    rx, ry, rz = (lift * vehicle.centre_of_buoyancy).tolist()

    def rates(state: Vector, F: Vector, tau: Vector, c: Vector, g: Vector) -> Vector:
        vx, vy, vz, wx, wy, wz, _, _, _, roll, pitch, yaw = state
        sr, cr, sp, cp, sy, cy = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
        px, py, pz = mx * vx, my * vy, mz * vz
        qx, qy, qz = jx * wx, jy * wy, jz * wz
        # R_nb by its rows
        r11, r12, r13 = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
        r21, r22, r23 = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
        r31, r32, r33 = -sp, cp * sr, cp * cr
        gx, gy, gz = (
            r11 * g[0] + r21 * g[1] + r31 * g[2],
            r12 * g[0] + r22 * g[1] + r32 * g[2],
            r13 * g[0] + r23 * g[1] + r33 * g[2],
        )
        turn = (wy * sr + wz * cr) / cp
        return (
            (F[0] - (ax + bx * abs(vx)) * vx - wy * pz + wz * py) / mx,
            (F[1] - (ay + by * abs(vy)) * vy - wz * px + wx * pz) / my,
            (F[2] - (az + bz * abs(vz)) * vz - wx * py + wy * px) / mz,
            (tau[0] - (dx + ex * abs(wx)) * wx - ry * gz + rz * gy - wy * qz + wz * qy + py * vz - pz * vy) / jx,
            (tau[1] - (dy + ey * abs(wy)) * wy - rz * gx + rx * gz - wz * qx + wx * qz + pz * vx - px * vz) / jy,
            (tau[2] - (dz + ez * abs(wz)) * wz - rx * gy + ry * gx - wx * qy + wy * qx + px * vy - py * vx) / jz,
            r11 * vx + r12 * vy + r13 * vz + c[0],
            r21 * vx + r22 * vy + r23 * vz + c[1],
            r31 * vx + r32 * vy + r33 * vz + c[2],
            wx + turn * sp,
            wy * cr - wz * sr,
            turn,
        )

    return rates
