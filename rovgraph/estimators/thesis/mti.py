"""The MTi at one epoch: specific force, angular rate and magnetic field (3.14).

    y = [R_sb (a_b + w x (w x l) - R_bn g) ; R_sb w ; R_sb R_bn H] + b

with the sign of gravity corrected, the field as a fraction of its length, and the nine
biases in the MTi's axes. ``rovgraph.sensors.MagneticField`` says the same of many epochs at
once; at 100 Hz that costs more than the filter itself. A test holds the two together.
"""

import copy
from collections.abc import Sequence
from typing import Protocol, Self

import numpy as np

from rovgraph.calibration import Belief
from rovgraph.estimators.thesis.core import Linearized, Quadratic, times
from rovgraph.estimators.thesis.epochs import Epochs, Index
from rovgraph.estimators.thesis.known import KnownMotion
from rovgraph.estimators.thesis.processes import Layout, centripetal, length
from rovgraph.estimators.thesis.quaternion import Turn, by_vector
from rovgraph.geometry import Array, rotate, transpose
from rovgraph.instruments import Instrument
from rovgraph.sensors import MagneticField, field_direction

BIASES = ("acc_bias", "gyr_bias", "mag_bias")
_EYE = np.eye(3)


def reference_field(instrument: Instrument, beliefs: dict[str, Belief]) -> Array:
    """Direction of the field in n that the thesis's filters hold fixed, shape (3,)."""
    model = instrument.model
    assert isinstance(model, MagneticField)
    offset, dip = beliefs["mag_offset"].mean[0], beliefs["field_dip"].mean[0]
    return field_direction(model.declination - offset, model.dip + dip)


class ImuModel(Protocol):
    """What the inertial unit measures.

    Attributes
    ----------
    dim : number of components
    """

    @property
    def dim(self) -> int: ...

    def __call__(self, x: Array, epoch: Index) -> Linearized:
        """Predicted samples, shape (..., m), and H, shape (..., m, n)."""
        ...

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        """The model of several filters side by side."""
        ...


class Mti:
    """All of (3.14) for a state with attitude and rate.

    Parameters
    ----------
    body : acceleration in b; False = in n
    places : layout of the state
    R_bs : ndarray, shape (3, 3), mounting
    lever_arm_b : ndarray, shape (3,) [m]
    gravity : [m/s^2]
    field_n : ndarray, shape (3,), reference field as a fraction of its length
    """

    dim = 9

    def __init__(
        self, body: bool, places: Layout, R_bs: Array, lever_arm_b: Array, gravity: float, field_n: Array
    ) -> None:
        self._places, self._body = places, body
        R_sb, n = R_bs.T, length(places)
        self._turn = Turn(inverse=True, left=R_sb)
        g_n = np.array([0.0, 0.0, gravity])
        linear, second = np.zeros((9, n)), np.zeros((9, n, n))
        for k, bias in enumerate(BIASES):
            linear[3 * k : 3 * k + 3, places[bias]] = _EYE
        linear[3:6, places["w"]] = R_sb
        if body:
            linear[:3, places["a"]] = R_sb
        second[:3, places["w"], places["w"]] = np.einsum("ij,jkl->ikl", R_sb, _swing(lever_arm_b))
        second[6:, places["q"], places["q"]] = np.einsum("ijkl,j->ikl", self._turn.second, field_n)
        constant = np.concatenate([np.zeros(6), R_sb @ field_n])
        if body:
            second[:3, places["q"], places["q"]] = -np.einsum("ijkl,j->ikl", self._turn.second, g_n)
            constant[:3] = -R_sb @ g_n
        self._g_n = g_n
        self._quadratic = Quadratic(constant, linear, second)

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        whole._g_n = np.stack([m._g_n for m in members])
        whole._turn = Turn.together([m._turn for m in members])
        whole._quadratic = Quadratic.together([m._quadratic for m in members])
        return whole

    def __call__(self, x: Array, epoch: Index) -> Linearized:
        """Predicted samples, shape (..., 9), and H, shape (..., 9, n)."""
        h, H = self._quadratic(x)
        if not self._body:  # cubic: R_sb R_bn (a_n - g)
            a, q = self._places["a"], self._places["q"]
            R_sn, slope = self._turn(x[..., q])
            force_n = x[..., a] - self._g_n
            h[..., :3] += times(R_sn, force_n)
            H[..., :3, a], H[..., :3, q] = R_sn, by_vector(force_n, slope)
        return h, H


def _swing(lever_arm_b: Array) -> Array:
    """Second derivative of w x (w x l) = w (w.l) - l (w.w) by w, shape (3, 3, 3)."""
    along = np.einsum("ij,k->ijk", _EYE, lever_arm_b)
    return np.asarray(along + np.swapaxes(along, 1, 2) - 2.0 * np.einsum("i,jk->ijk", lever_arm_b, _EYE))


class Accelerometer:
    """The first three of (3.14) where attitude and rate are given (4.1).

    Parameters
    ----------
    places : layout of the state
    R_bs, lever_arm_b, gravity : as of `Mti`
    known : attitude and rate at the IMU's epochs
    """

    dim = 3

    def __init__(self, places: Layout, R_bs: Array, lever_arm_b: Array, gravity: float, known: KnownMotion) -> None:
        g_n = np.array([0.0, 0.0, gravity])
        self._H = np.zeros((3, length(places)))
        self._H[:, places["a"]], self._H[:, places["acc_bias"]] = R_bs.T, _EYE
        force_b = centripetal(known.w_b, lever_arm_b) - rotate(transpose(known.R_nb), g_n)
        self._offset = Epochs(rotate(R_bs.T, force_b))

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        whole._H = np.stack([m._H for m in members])
        whole._offset = Epochs.together([m._offset for m in members])
        return whole

    def __call__(self, x: Array, epoch: Index) -> Linearized:
        """Predicted specific force, shape (..., 3), and H, shape (..., 3, n)."""
        return self._offset.at(epoch) + times(self._H, x), self._H
