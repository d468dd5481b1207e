"""States as kernels take them: of one epoch, and of many."""

from typing import NamedTuple

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import Matrices, Matrix, helper


class Epoch(NamedTuple):
    """The state at one epoch, which kernels may write to.

    Attributes
    ----------
    R, p, v : shapes (3, 3), (3,), (3,): R_nb, position and velocity over ground in n [m, m/s]
    b : shape (6,), biases of accelerometer and gyro, in b [m/s^2, rad/s]; with errors k of the IMU's scale that
        which is seen, b + S k
    c : shape (C,), calibration vector, in the order of `rovgraph.kernels.layout`
    """

    R: Array
    p: Array
    v: Array
    b: Array
    c: Array


class States(NamedTuple):
    """States of n epochs.

    Attributes
    ----------
    R, p, v, b : shapes (n, 3, 3), (n, 3), (n, 3), (n, 6)
    c : calibration vectors, shape (n, C), or (1, C) where nothing walks; (1, 0) where nothing depends on them
    """

    R: Matrices
    p: Matrix
    v: Matrix
    b: Matrix
    c: Matrix = np.zeros((1, 0))


# these give arrays away, so they are no `view_helper`, and none may call them: it writes ``Epoch(...)`` itself


@helper
def epoch(states: States, k: int) -> Epoch:
    """One of some states."""
    return Epoch(states.R[k], states.p[k], states.v[k], states.b[k], states.c[k if len(states.c) > 1 else 0])


@helper
def with_bias(state: Epoch, b: Array) -> Epoch:
    """The same with another bias."""
    return Epoch(state.R, state.p, state.v, b, state.c)


@helper
def epoch_in(x: Array, c: Array) -> Epoch:
    """The state that a filter's vector, shape (21,), holds: R_nb by rows, p_n, v_n, bias; a view of it."""
    return Epoch(x[0:9].reshape(3, 3), x[9:12], x[12:15], x[15:21], c)
