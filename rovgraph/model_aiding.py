"""What a vehicle's hydrodynamics say of its velocity, as a measurement model.

Thrusters and drag explain the specific force that the accelerometer feels; as drag depends
on the velocity through the water, that force measures the velocity when nothing else does
(Hegrenæs and Hallingstad 2011, Model-aided INS with sea current estimation). With the IMU at
the lever arm l, v the velocity relative to the water and a(v, w) the acceleration of (2.18)
without thrust,

    v = R_bn (v_n - c_n) - w x l,    w = rate - b_g
    f = a(v, w) + w x v - R_bn g_n + w x (w x l) + b_a

The measurement is the mean specific force of an interval between keyframes less what thrust
and angular acceleration give, M^-1 F + alpha x l, and belongs to the interval's middle. The
accelerometer also drives the IMU's factor; its noise is far below the model's error, so
using it twice does no harm.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array, cross, rotate, skew, transpose
from rovgraph.state import BIAS, POSE, VELOCITY, Jacobians, State
from rovgraph.vehicle import Hydrodynamics


@dataclass(frozen=True)
class ModelAiding:
    """Specific force that drag and motion explain, body axes (2.18).

    Attributes
    ----------
    vehicle : Hydrodynamics
    lever_arm_b : ndarray, shape (3,), of the IMU, which is the state's origin, from the centre of mass [m]
    gravity : [m/s^2]
    """

    vehicle: Hydrodynamics
    lever_arm_b: Array
    gravity: float
    sensor = "thruster"
    dim = 3
    angular = False
    state = (POSE, VELOCITY, BIAS)
    calibration = ("drag_linear", "drag_quadratic", "current")

    def measured(self, specific_force_b: Array, signals: Array, alpha_b: Array) -> Array:
        """The measurement, from means over an interval.

        Parameters
        ----------
        specific_force_b : ndarray, shape (3,) [m/s^2]
        signals : ndarray, shape (k, m), of the thrusters over the interval [percent]
        alpha_b : ndarray, shape (3,), angular acceleration [rad/s^2]
        """
        force_b, _ = self.vehicle.force_and_moment(signals)
        thrust = force_b.mean(axis=0) / self.vehicle.mass
        return np.asarray(specific_force_b - thrust - cross(alpha_b, self.lever_arm_b))

    def predict(self, state: State, rate_b: Array) -> tuple[Array, Jacobians]:
        n, l_b = len(state), self.lever_arm_b
        R_bn = transpose(state.R_nb)
        w = rate_b - state.bias[:, 3:]
        water_n = np.zeros((n, 3))
        water_n[:, :2] = state.calibration["current"]
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
        }
        return a + cross(w, v) - g_b + cross(w, swing) + state.bias[:, :3], H
