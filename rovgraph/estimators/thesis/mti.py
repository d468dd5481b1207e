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
from rovgraph.estimators.thesis.core import Linearized, Polynomials, times
from rovgraph.estimators.thesis.epochs import Epochs, Index
from rovgraph.estimators.thesis.known import KnownMotion
from rovgraph.estimators.thesis.processes import Layout, centripetal, length
from rovgraph.estimators.thesis.quaternion import Turn
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
        R_sb, a, w, q = R_bs.T, places["a"], places["w"], places["q"]
        turn = 0.5 * Turn(inverse=True, left=R_sb).second  # R_sn = R_sb + q' turn q
        g_n = np.array([0.0, 0.0, gravity])
        force, rate, field = slice(0, 3), slice(3, 6), slice(6, 9)
        self._samples = samples = Polynomials(self.dim, length(places))
        for rows, bias in zip((force, rate, field), BIASES, strict=True):
            samples.add(rows, _EYE, places[bias])
        samples.add(rate, R_sb, w)
        samples.add(field, R_sb @ field_n)
        samples.add(field, np.einsum("ijkl,j->ikl", turn, field_n), q, q)
        samples.add(force, np.einsum("ij,jkl->ikl", R_sb, _swing(lever_arm_b)), w, w)
        samples.add(force, -R_sb @ g_n)
        samples.add(force, -np.einsum("ijkl,j->ikl", turn, g_n), q, q)
        samples.add(force, R_sb, a)
        if not body:
            samples.add(force, turn, a, q, q)

    @classmethod
    def together(cls, members: Sequence[Self]) -> Self:
        whole = copy.copy(members[0])
        whole._samples = Polynomials.together([m._samples for m in members])
        return whole

    def __call__(self, x: Array, epoch: Index) -> Linearized:
        """Predicted samples, shape (..., 9), and H, shape (..., 9, n)."""
        return self._samples(x)


def _swing(lever_arm_b: Array) -> Array:
    """w x (w x l) = w (w.l) - l (w.w) as a quadratic form of w, shape (3, 3, 3)."""
    along = np.einsum("ij,k->ijk", _EYE, lever_arm_b)
    return np.asarray(along - np.einsum("i,jk->ijk", lever_arm_b, _EYE))


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
