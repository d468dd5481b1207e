"""Hydrodynamics of a small underwater vehicle: thrust, drag, added mass, buoyancy (2.16)-(2.24).

In body axes, with v the velocity relative to the water, w the angular rate, M = mI + M_a
and J = I + I_a diagonal,

    M v' = F + D(v) - w x M v                                   (2.18)
    J w' = tau + D(w) + r_cb x B - w x J w                      (2.19), (2.20)
    D(v) = -(c_lin + c_quad |v|) v, each axis by itself         (2.23), (2.24)

The thesis prints drag without a sign; it opposes motion. Weight equals buoyancy, so no net
force of either is left, only the moment that rights the vehicle.

The first equation holds for the velocity relative to water that moves as one, even where the
water accelerates, as in waves: a neutrally buoyant vehicle is accelerated by the pressure
that accelerates the water in its place. The velocity over ground is v plus the water's.

The second lacks the moment that belongs to w x M v when the axes' added masses differ;
`Hydrodynamics.munk_moment` gives it (Munk 1924; Lamb, Hydrodynamics, art. 124). Without it
kinetic energy is not conserved.
"""

from dataclasses import dataclass

import numpy as np

from rovgraph.geometry import Array, cross, skew
from rovgraph.model.state import Jacobians

NO_CHANGE = np.zeros(6)


@dataclass(frozen=True)
class Hydrodynamics:
    """A vehicle in water; the origin is the centre of mass, axes forward, starboard, down.

    `acceleration` takes many vehicles too, mass and drag with leading axes.

    Relative changes of drag coefficients, ``change``, are of shape (..., 6): linear x, y, z,
    then quadratic x, y, z; the coefficients are multiplied by ``1 + change``.

    Attributes
    ----------
    mass : ndarray, shape (3,), mass and added mass along each axis [kg]
    inertia : ndarray, shape (3,), moment of inertia and its added part about each axis [kg m^2]
    drag_linear, drag_quadratic : ndarray, shape (3,) [N s/m, N s^2/m^2]
    turning_drag_linear, turning_drag_quadratic : ndarray, shape (3,) [N m s, N m s^2]
    centre_of_buoyancy : ndarray, shape (3,), from the centre of mass [m]
    buoyancy : equal to the weight [N]
    thrust_curve : ndarray, shape (3,), a, b, c of the thrust a u + b |u| u + c u^3 [N]
    thruster_positions : ndarray, shape (m, 3) [m]
    thruster_directions : ndarray, shape (m, 3), unit vectors of the force for a positive signal
    """

    mass: Array
    inertia: Array
    drag_linear: Array
    drag_quadratic: Array
    turning_drag_linear: Array
    turning_drag_quadratic: Array
    centre_of_buoyancy: Array
    buoyancy: float
    thrust_curve: Array
    thruster_positions: Array
    thruster_directions: Array

    def thrust(self, signals: Array) -> Array:
        """Force of each thruster along its direction (2.21).

        Parameters
        ----------
        signals : ndarray, shape (..., m), drive signals [percent]

        Returns
        -------
        ndarray, shape (..., m) [N]
        """
        a, b, c = self.thrust_curve
        return np.asarray(signals * (a + np.abs(signals) * b + c * signals**2))

    @property
    def allocation(self) -> Array:
        """Force and moment of a newton of each thruster (2.22), shape (6, m)."""
        moments = cross(self.thruster_positions, self.thruster_directions)
        return np.hstack([self.thruster_directions, moments]).T

    def force_and_moment(self, signals: Array) -> tuple[Array, Array]:
        """Force and moment of all thrusters, body axes (2.21), (2.22).

        Parameters
        ----------
        signals : ndarray, shape (..., m) [percent]

        Returns
        -------
        force_b, moment_b : ndarray, shape (..., 3) [N, N m]
        """
        both = self.thrust(signals) @ self.allocation.T
        return both[..., :3], both[..., 3:]

    def drag(self, velocity_b: Array, change: Array = NO_CHANGE) -> tuple[Array, Jacobians]:
        """Drag of a velocity relative to the water (2.23).

        Parameters
        ----------
        velocity_b : ndarray, shape (..., 3) [m/s]
        change : ndarray, shape (..., 6), relative change of the coefficients

        Returns
        -------
        force_b : ndarray, shape (..., 3) [N]
        jacobians : "velocity" (..., 3, 3), "drag" (..., 3, 6) by ``change``
        """
        return _drag(velocity_b, self.drag_linear, self.drag_quadratic, change, ("velocity", "drag"))

    def turning_drag(self, w_b: Array, change: Array = NO_CHANGE) -> tuple[Array, Jacobians]:
        """Drag of an angular rate (2.24).

        Parameters
        ----------
        w_b : ndarray, shape (..., 3) [rad/s]
        change : ndarray, shape (..., 6), relative change of the coefficients

        Returns
        -------
        moment_b : ndarray, shape (..., 3) [N m]
        jacobians : "rate" (..., 3, 3), "turning_drag" (..., 3, 6) by ``change``
        """
        names = ("rate", "turning_drag")
        return _drag(w_b, self.turning_drag_linear, self.turning_drag_quadratic, change, names)

    def acceleration(
        self, velocity_b: Array, w_b: Array, force_b: Array, change: Array = NO_CHANGE
    ) -> tuple[Array, Jacobians]:
        """Derivative of the components of velocity in body axes (2.18), drag included.

        The acceleration in n is R_nb (result + w x velocity), and that of the water.

        Parameters
        ----------
        velocity_b : ndarray, shape (..., 3), relative to the water [m/s]
        w_b : ndarray, shape (..., 3) [rad/s]
        force_b : ndarray, shape (..., 3), of the thrusters [N]
        change : ndarray, shape (..., 6), relative change of the drag coefficients

        Returns
        -------
        ndarray, shape (..., 3) [m/s^2]
        jacobians : "velocity", "rate", "force" (..., 3, 3), "drag" (..., 3, 6)
        """
        drag, H = self.drag(velocity_b, change)
        momentum = self.mass * velocity_b
        inverse = 1.0 / self.mass
        by = {
            "velocity": H["velocity"] - skew(w_b) * self.mass[..., None, :],
            "rate": skew(momentum),
            "force": _diagonal(np.ones_like(drag)),
            "drag": H["drag"],
        }
        a = inverse * (force_b + drag - cross(w_b, momentum))
        return a, {name: inverse[..., None] * J for name, J in by.items()}

    def turning_acceleration(
        self, w_b: Array, down_b: Array, moment_b: Array, change: Array = NO_CHANGE
    ) -> tuple[Array, Jacobians]:
        """Angular acceleration, drag and buoyancy's moment included (2.19), (2.20).

        The simulator integrates the same equations in plain floats, for speed; this is the
        reference that tests compare it with.

        Parameters
        ----------
        w_b : ndarray, shape (..., 3) [rad/s]
        down_b : ndarray, shape (..., 3), the vertical: third row of R_nb
        moment_b : ndarray, shape (..., 3), of the thrusters [N m]
        change : ndarray, shape (..., 6), relative change of the turning drag's coefficients

        Returns
        -------
        ndarray, shape (..., 3) [rad/s^2]
        jacobians : "rate", "down", "moment" (..., 3, 3), "turning_drag" (..., 3, 6)
        """
        drag, H = self.turning_drag(w_b, change)
        spin = self.inertia * w_b
        inverse = 1.0 / self.inertia
        righting = -self.buoyancy * cross(self.centre_of_buoyancy, down_b)
        by_down = -self.buoyancy * skew(self.centre_of_buoyancy)
        by = {
            "rate": H["rate"] + skew(spin) - skew(w_b) * self.inertia,
            "down": np.broadcast_to(by_down, (*drag.shape, 3)),
            "moment": _diagonal(np.ones_like(drag)),
            "turning_drag": H["turning_drag"],
        }
        alpha = inverse * (moment_b + drag + righting - cross(w_b, spin))
        return alpha, {name: inverse[:, None] * J for name, J in by.items()}

    def munk_moment(self, velocity_b: Array) -> Array:
        """Moment of a flow along no axis of the added mass, which the thesis leaves out.

        Parameters
        ----------
        velocity_b : ndarray, shape (..., 3), relative to the water [m/s]

        Returns
        -------
        ndarray, shape (..., 3) [N m]
        """
        return cross(self.mass * velocity_b, velocity_b)

    def energy(self, velocity_b: Array, w_b: Array, down_b: Array) -> Array:
        """Kinetic energy with the water that moves along, and that of righting; shape (...) [J]."""
        kinetic = 0.5 * ((self.mass * velocity_b**2).sum(-1) + (self.inertia * w_b**2).sum(-1))
        return np.asarray(kinetic + self.buoyancy * (down_b @ self.centre_of_buoyancy))


def _drag(v: Array, linear: Array, quadratic: Array, change: Array, names: tuple[str, str]) -> tuple[Array, Jacobians]:
    """Drag of each axis by itself, and its derivatives by the motion and by relative changes."""
    first, second = -linear * v, -quadratic * np.abs(v) * v
    scaled = (1.0 + change[..., :3]) * linear, (1.0 + change[..., 3:]) * quadratic
    by_motion = -scaled[0] - 2.0 * scaled[1] * np.abs(v)
    by_change = np.concatenate([_diagonal(first), _diagonal(second)], axis=-1)
    total = -(scaled[0] + scaled[1] * np.abs(v)) * v
    return total, {names[0]: _diagonal(by_motion), names[1]: by_change}


def _diagonal(v: Array) -> Array:
    """Diagonal matrices, shape (..., 3, 3)."""
    return np.asarray(v[..., None] * _EYE)


_EYE = np.eye(3)
