"""Velocity from thrust and drag, as a measurement model.

Thrusters and drag explain the specific force that the accelerometer measures; as drag depends
on the velocity through the water, that force measures the velocity when no other sensor does
(Hegrenæs and Hallingstad 2011, Model-aided INS with sea current estimation). With the IMU at
the lever arm l, v the velocity relative to the water and a(v, w) the acceleration of (2.18)
without thrust,

    v = R_bn (v_n - c_n - o_n) - w x l,    w = rate - b_g
    f = a(v, w) + w x v - R_bn g_n + w x (w x l) + b_a

with the current c and the oscillation o in waves: the vehicle moves with both, so they cause no drag. Their
accelerations are in the noise.

The measurement is the mean specific force of a short piece of time less what thrust and
angular acceleration give, M^-1 F + alpha x l, and belongs to the piece's middle. The
accelerometer also drives the IMU's factor; its noise is far below the model's error, so
using it twice does no harm.

A thruster follows its signal late (120 ms from 10 to 90 percent, below (2.22)). The thesis
neglects that; but where thrust is reversed the whole of it differs, with the sign of the
velocity, so the drag coefficients would absorb it. Here a thruster's turning is the mean of its
signal over the time that a linear rise lasts, `RISE_SHARE` of which lies between 10 and 90
percent.
"""

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rovgraph.errors import InputError
from rovgraph.geometry import Array, cross, rotate, skew, transpose
from rovgraph.kernels.measurements import WATER_VELOCITY
from rovgraph.model.config import Config
from rovgraph.model.hydrodynamics import Hydrodynamics
from rovgraph.model.state import BIAS, POSE, VELOCITY, Jacobians, State
from rovgraph.sensors.model import evaluate
from rovgraph.sensors.sensor import Instrument, Observed, Sensor, instrument

RISE_SHARE = 0.8
AT_ONCE_S = 1e-3  # a shorter rise is taken as this long


@dataclass(frozen=True)
class ModelAiding:
    """Specific force that drag and motion explain, body axes (2.18).

    Attributes
    ----------
    vehicle : Hydrodynamics
    lever_arm_b : ndarray, shape (3,), of the IMU, which is the state's origin, from the centre of mass [m]
    gravity : [m/s^2]
    rise : time in which a thruster goes from 10 to 90 percent of a change of its signal [s]
    """

    vehicle: Hydrodynamics
    lever_arm_b: Array
    gravity: float
    rise: float = 0.0
    sensor = "thruster"
    dim = 3
    angular = False
    state = (POSE, VELOCITY, BIAS)
    calibration = ("drag_linear", "drag_quadratic", "current", "water_oscillation")

    @property
    def memory(self) -> float:
        """Time for which a signal still acts after the next one has come [s]."""
        return max(self.rise / RISE_SHARE, AT_ONCE_S)

    def turning(self, signal_time: Array, signals: Array, time: Array) -> Array:
        """How thrusters turn that follow their signals with a linear rise.

        Parameters
        ----------
        signal_time : ndarray, shape (k,), ascending; a signal holds until the next [s]
        signals : ndarray, shape (k, m) [percent]
        time : ndarray, shape (n,), at least `memory` after the first signal [s]

        Returns
        -------
        ndarray, shape (n, m) [percent]
        """
        edges = np.append(signal_time, max(float(time[-1]), signal_time[-1]))
        total = np.vstack([np.zeros(signals.shape[1]), np.cumsum(np.diff(edges)[:, None] * signals, axis=0)])
        late = time - self.memory
        mean = [(np.interp(time, edges, sum_) - np.interp(late, edges, sum_)) / self.memory for sum_ in total.T]
        return np.column_stack(mean)

    def measured(self, specific_force_b: Array, turning: Array, alpha_b: Array) -> Array:
        """The measurement, from means over a piece of time.

        Parameters
        ----------
        specific_force_b : ndarray, shape (3,) [m/s^2]
        turning : ndarray, shape (k, m), of the thrusters, evenly over the piece [percent]
        alpha_b : ndarray, shape (3,), angular acceleration [rad/s^2]
        """
        force_b, _ = self.vehicle.force_and_moment(turning)
        thrust = force_b.mean(axis=0) / self.vehicle.mass
        return np.asarray(specific_force_b - thrust - cross(alpha_b, self.lever_arm_b))

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        n, l_b = len(state), self.lever_arm_b
        R_bn = transpose(state.R_nb)
        w = rate_b - state.bias[:, 3:]
        water_n = np.zeros((n, 3)) + state.calibration["water_oscillation"]
        water_n[:, :2] += state.calibration["current"]
        through_b = rotate(R_bn, state.v_n - water_n)
        swing = cross(w, l_b)
        v = through_b - swing
        change = np.zeros((n, 6))
        change[:, :3], change[:, 3:] = state.calibration["drag_linear"], state.calibration["drag_quadratic"]
        a, by = self.vehicle.acceleration(v, w, np.zeros((n, 3)), change)
        g_b = self.gravity * R_bn[..., 2]

        by_v = by["velocity"] + skew(w)
        by_w = by["rate"] - skew(v) - skew(swing) - skew(w) @ skew(l_b)
        pose, bias = np.zeros((n, 3, 6)), np.zeros((n, 3, 6))
        pose[..., :3] = by_v @ skew(through_b) - skew(g_b)
        bias[..., :3] = np.eye(3)
        bias[..., 3:] = -by_v @ skew(l_b) - by_w
        H = {
            POSE: pose,
            VELOCITY: by_v @ R_bn,
            BIAS: bias,
            "drag_linear": by["drag"][..., :3],
            "drag_quadratic": by["drag"][..., 3:],
            "current": -by_v @ R_bn[..., :2],
            "water_oscillation": -by_v @ R_bn,
        }
        return a + cross(w, v) - g_b + cross(w, swing) + state.bias[:, :3], H


@dataclass(frozen=True)
class WaterVelocity:
    """Forward and starboard components of the water's velocity: what drag shows of a current.

    No instrument measures it by itself; it is linear in the current, and turns with the vehicle.
    """

    sensor = "thruster"
    dim = 2
    angular = False
    state = (POSE,)
    calibration = ("current",)
    kind = WATER_VELOCITY

    @cached_property
    def packed(self) -> Array:
        """None."""
        return np.zeros((1, 0))

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        return evaluate(self, self.state, state, rate_b)


def hydrodynamics(config: Config) -> Hydrodynamics:
    """The vehicle of a configuration, as a body in water; the body's origin is its centre of mass.

    Raises
    ------
    InputError : a thruster without a direction
    """
    vehicle = config.vehicle
    directions = np.array([t.direction for t in vehicle.thrusters], float).reshape(-1, 3)
    idle = np.flatnonzero(~directions.any(axis=1))
    if idle.size:
        raise InputError(f"vehicle.thrusters.{idle[0]}.direction: 0, 0, 0 points nowhere; any other length will do")
    return Hydrodynamics(
        mass=vehicle.mass_kg + np.array(vehicle.added_mass_kg),
        inertia=np.array(vehicle.inertia_kgm2) + np.array(vehicle.added_inertia_kgm2),
        drag_linear=np.array(vehicle.drag_linear),
        drag_quadratic=np.array(vehicle.drag_quadratic),
        turning_drag_linear=np.array(vehicle.turning_drag_linear),
        turning_drag_quadratic=np.array(vehicle.turning_drag_quadratic),
        centre_of_buoyancy=np.array(vehicle.centre_of_buoyancy_m),
        buoyancy=vehicle.mass_kg * config.environment.gravity,
        thrust_curve=np.array(vehicle.thrust),
        thruster_positions=np.array([t.position_m for t in vehicle.thrusters], float).reshape(-1, 3),
        thruster_directions=directions / np.linalg.norm(directions, axis=1, keepdims=True),
    )


def thrusters(config: Config, origin_b: Array) -> Instrument:
    """Thrust and drag; the sd is that of a mean over one second."""
    vehicle = config.vehicle
    model = ModelAiding(hydrodynamics(config), origin_b, config.environment.gravity, vehicle.thrust_rise_s)
    return instrument(vehicle, model, vehicle.acceleration_sd_mps2, ("x", "y", "z"))


def _of_mean(values: Array, believed: Instrument, config: Config) -> Array:
    """Of a mean over ``values[3]`` seconds."""
    return believed.sd / math.sqrt(values[3])


THRUSTER = Sensor(
    "thruster",
    (),  # as many as the vehicle has
    thrusters,
    standard_deviation=_of_mean,
    observes=Observed("velocity"),
    linear_in="current",
    may_begin_later=True,
)
