"""How the vehicle moves between two epochs, for each filter of the thesis.

Constant acceleration and rate in b (2.9) and in n (2.8):

    a' = -w x a    v' = a - w x v    p' = R_nb v    w' = 0    q' = 1/2 T(q) w
    a' = 0         v' = a            p' = v         w' = 0    q' = 1/2 T(q) w

attitude and rate given (4.1): the first three of (2.9), linear in the state. The same with
the hydrodynamic model (4.2), M = mI + M_a, F the forces of thrusters and drag:

    v' = M^-1 (F - w x M v)    p' = R_nb v

All are discretised by forward Euler (2.26), ``x <- x + dt x'``, ``F = I + dt A``.
"""

from typing import Protocol

import numpy as np

from rovgraph.estimators.kalman.core import Linearized, Quadratic
from rovgraph.estimators.kalman.known import KnownMotion
from rovgraph.estimators.kalman.quaternion import RATES, Turn, matrix
from rovgraph.estimators.kalman.variants import Filter, Numbers
from rovgraph.geometry import Array, cross, exp_rotation, right_jacobian, skew
from rovgraph.thesis import SAMPLE_S
from rovgraph.vehicle import Hydrodynamics

Layout = dict[str, slice]  # a, v, p, w, q, acc_bias, gyr_bias, mag_bias, mount -> place in the state

SIZES = {"a": 3, "v": 3, "p": 3, "w": 3, "q": 4, "acc_bias": 3, "gyr_bias": 3, "mag_bias": 3, "mount": 3}
_LEVI_CIVITA = np.moveaxis(skew(np.eye(3)), 0, -1)  # skew(u) = _LEVI_CIVITA @ u


def layout(*names: str) -> Layout:
    """The state made of these parts, in this order."""
    ends = np.cumsum([SIZES[n] for n in names]).tolist()
    return {n: slice(end - SIZES[n], end) for n, end in zip(names, ends, strict=True)}


def length(places: Layout) -> int:
    """Number of scalars of a state."""
    return sum(SIZES[name] for name in places)


class Process(Protocol):
    """A process model.

    Attributes
    ----------
    layout : of its state
    """

    @property
    def layout(self) -> Layout: ...

    def step(self, x: Array, dt: float, epoch: int) -> Linearized:
        """The state ``dt`` seconds on, from IMU epoch ``epoch``, and F, which the next call overwrites."""
        ...

    def noise(self, x: Array) -> Array:
        """Q of one second, shape (n, n) or the diagonal alone, shape (n,)."""
        ...


def noise_per_second(places: Layout, numbers: Numbers) -> Array:
    """Diagonal of Q of one second from the printed ones of a sample of 10 ms, shape (n,)."""
    q = np.zeros(length(places))
    values: dict[str, tuple[float, ...] | float] = {
        "a": numbers.acceleration,
        "w": numbers.rate,
        "acc_bias": numbers.acc_bias,
        "gyr_bias": numbers.gyr_bias,
        "mag_bias": numbers.mag_bias,
        "mount": numbers.mount,
    }
    if "a" not in places:
        values["v"] = numbers.acceleration
    for name, value in values.items():
        if name in places:
            q[places[name]] = value
    return q / SAMPLE_S


class ConstantAcceleration:
    """Acceleration and rate are constant in b (2.9) or n (2.8).

    Parameters
    ----------
    variant : Filter, motion "body" or "earth"
    """

    def __init__(self, variant: Filter) -> None:
        self._body = variant.motion == "body"
        self._exact = self._body and variant.coriolis == "exact"
        names = [n for n in SIZES if n != "mount" or variant.misalignment]
        self.layout = layout(*names)
        self._rhs = self._right_hand_side()
        self._turn = Turn()
        n = length(self.layout)
        self._F = np.eye(n)
        self._diagonal = self._F.reshape(-1)[:: n + 1]
        self._q = noise_per_second(self.layout, variant.numbers)
        own = "body" if self._body else "earth"
        isotropic = len(set(variant.numbers.acceleration)) == 1
        self._turned_noise = variant.noise_frame not in (None, own) and not isotropic

    def _right_hand_side(self) -> Quadratic:
        """x' but for (2.9)'s cubic R_nb v."""
        s, n = self.layout, length(self.layout)
        linear, second = np.zeros((n, n)), np.zeros((n, n, n))
        linear[s["v"], s["a"]] = np.eye(3)
        _bilinear(second, s["q"], s["q"], s["w"], 0.5 * np.swapaxes(RATES, 1, 2))
        if self._body:
            for moved in ("a", "v"):
                _bilinear(second, s[moved], s[moved], s["w"], -_LEVI_CIVITA)
        else:
            linear[s["p"], s["v"]] = np.eye(3)
        return Quadratic(np.zeros(n), linear, second)

    def step(self, x: Array, dt: float, epoch: int) -> Linearized:
        s = self.layout
        rhs, A = self._rhs(x)
        if self._body:
            R_nb, slope = self._turn(x[s["q"]])
            v_b = x[s["v"]]
            A[s["p"], s["v"]], A[s["p"], s["q"]] = R_nb, v_b @ slope
            rhs[s["p"]] = R_nb @ v_b
        np.multiply(A, dt, out=self._F)
        self._diagonal += 1.0
        new = x + dt * rhs
        if self._exact:
            self._turn_exactly(x, new, dt)
        return new, self._F

    def _turn_exactly(self, x: Array, new: Array, dt: float) -> None:
        """a <- E a, v <- E (v + dt a) with E = Exp(-w dt), in place of Euler's I - dt S(w)."""
        s, F = self.layout, self._F
        turn = -dt * x[s["w"]]
        E, Jr = exp_rotation(turn), right_jacobian(turn)
        a, v = x[s["a"]], x[s["v"]] + dt * x[s["a"]]
        new[s["a"]], new[s["v"]] = E @ a, E @ v
        F[s["a"], s["a"]] = F[s["v"], s["v"]] = E
        F[s["v"], s["a"]] = dt * E
        F[s["a"], s["w"]] = dt * (E @ skew(a) @ Jr)
        F[s["v"], s["w"]] = dt * (E @ skew(v) @ Jr)

    def noise(self, x: Array) -> Array:
        if not self._turned_noise:
            return self._q
        R_nb = matrix(x[self.layout["q"]])
        to_own = R_nb.T if self._body else R_nb
        Q, a = np.diag(self._q), self.layout["a"]
        Q[a, a] = to_own @ Q[a, a] @ to_own.T
        return Q


def _bilinear(second: Array, rows: slice, u: slice, w: slice, tensor: Array) -> None:
    """Enter ``sum over j, k of tensor[i, j, k] u_j w_k`` into a symmetric second derivative."""
    second[rows, u, w] += tensor
    second[rows, w, u] += np.swapaxes(tensor, 1, 2)


class KnownAttitude:
    """Acceleration constant in b, attitude and rate given (4.1).

    Parameters
    ----------
    variant : Filter
    known : attitude and rate at the IMU's epochs
    """

    def __init__(self, variant: Filter, known: KnownMotion) -> None:
        self.layout = layout("a", "v", "p", *(["acc_bias"] if variant.accelerometer else []))
        self._known = known
        self._F = np.eye(length(self.layout))
        self._q = noise_per_second(self.layout, variant.numbers)

    def step(self, x: Array, dt: float, epoch: int) -> Linearized:
        s, F = self.layout, self._F
        euler = np.eye(3) - dt * skew(self._known.w_b[epoch])
        F[s["a"], s["a"]] = F[s["v"], s["v"]] = euler
        F[s["v"], s["a"]] = dt * np.eye(3)
        F[s["p"], s["v"]] = dt * self._known.R_nb[epoch]
        return F @ x, F

    def noise(self, x: Array) -> Array:
        return self._q


class HydrodynamicModel:
    """Velocity from thrusters and drag, attitude and rate given (4.2).

    Parameters
    ----------
    variant : Filter
    known : attitude and rate at the IMU's epochs
    vehicle : Hydrodynamics
    force_b : ndarray, shape (n, 3), of the thrusters at the IMU's epochs [N]
    """

    def __init__(self, variant: Filter, known: KnownMotion, vehicle: Hydrodynamics, force_b: Array) -> None:
        self.layout = layout("v", "p")
        self._known, self._vehicle, self._force_b = known, vehicle, force_b
        self._F = np.eye(length(self.layout))
        self._q = noise_per_second(self.layout, variant.numbers)

    def step(self, x: Array, dt: float, epoch: int) -> Linearized:
        v, p = self.layout["v"], self.layout["p"]
        R_nb = self._known.R_nb[epoch]
        rhs, slopes = self._vehicle.acceleration(x[v], self._known.w_b[epoch], self._force_b[epoch])
        self._F[v, v] = np.eye(3) + dt * slopes["velocity"]
        self._F[p, v] = dt * R_nb
        return x + dt * np.concatenate([rhs, R_nb @ x[v]]), self._F

    def noise(self, x: Array) -> Array:
        return self._q


def centripetal(w_b: Array, lever_arm_b: Array) -> Array:
    """w x (w x l), shape (..., 3) [m/s^2]."""
    return cross(w_b, cross(w_b, lever_arm_b))
