"""Scale errors of accelerometer and gyro: over a short time they act as biases.

A sample is (1 + k) times what is so, component by component along the IMU's axes, and the bias
on top. Over an interval of a fraction of a second its k times the mean signal may stand for
k times each sample, so that the motion that was integrated without k serves with the bias
b + S k, where S holds the mean signal (`scale_to_bias`). The same S takes every derivative by the bias
to one by k.
"""

from collections.abc import Mapping

import numpy as np

from rovgraph.calibration import Belief
from rovgraph.geometry import Array
from rovgraph.state import State

SCALES = ("acc_scale", "gyr_scale")
COLUMNS = {"acc_scale": slice(0, 3), "gyr_scale": slice(3, 6)}


def wanted(beliefs: Mapping[str, Belief]) -> bool:
    """Whether any scale is estimated or considered, or known to be off."""
    return any(beliefs[name].estimate or beliefs[name].considered or beliefs[name].mean.any() for name in SCALES)


def scale_to_bias(signal_b: Array, R_bs: Array) -> Array:
    """Derivative by the scales of the bias that they act as.

    Parameters
    ----------
    signal_b : ndarray, shape (..., 6), mean specific force and rate, body axes, biases taken off
    R_bs : ndarray, shape (3, 3), mounting of the IMU

    Returns
    -------
    ndarray, shape (..., 6, 6), bias (accelerometer, gyro; body axes) by `SCALES`
    """
    S = np.zeros((*signal_b.shape, 6))
    for part in COLUMNS.values():
        S[..., part, part] = R_bs * (signal_b[..., part] @ R_bs)[..., None, :]
    return S


def biased(state: State, S: Array) -> State:
    """The state with the bias that the scales act as; ``S`` has shape (n, 6, 6)."""
    scales = [np.broadcast_to(state.calibration[name], (len(state), 3)) for name in SCALES]
    bias = state.bias + (S @ np.concatenate(scales, axis=-1)[..., None])[..., 0]
    return State(state.R_nb, state.p_n, state.v_n, bias, state.calibration)
