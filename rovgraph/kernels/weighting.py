"""Weights of measurements: square-root information and robust losses.

    W' W = (S + G G' rate_sd^2)^-1, W lower triangular                   S: diag(sd^2), and the covariance of two
                                                                         G: the rate's way into the measurement
    huber    rho = d^2 / 2, beyond k: k (d - k / 2)                      (Huber 1964)
    cauchy   rho = k^2 / 2 log(1 + d^2 / k^2)                            (Zhang 1997)

with the weight rho'(d) / d of a measurement of normalised length d.
"""

import math

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.compile import kernel, readonly_array, view_helper

LOSSES = ("none", "huber", "cauchy")  # in the order of the numbers below
NONE, HUBER, CAUCHY = range(3)


@view_helper
def whiten(noise: Array, rate_covariance: Array, rate_sd: float, W_out: Array) -> None:
    """Inverse of the Cholesky factor of S + rate_covariance rate_sd^2, all of shape (dim, dim).

    ``noise`` are the sds of the components, and of two of them their covariance. ``rate_covariance`` is G G': the
    covariance of the measurement where that of the rate is the unit matrix.
    """
    dim = len(W_out)
    for i in range(dim):  # first the factor L
        for j in range(i + 1):
            rest = rate_covariance[i, j] * rate_sd * rate_sd
            if i > j and dim == 2:
                rest += noise[2]
            for k in range(j):
                rest -= W_out[i, k] * W_out[j, k]
            W_out[j, i] = 0.0
            W_out[i, j] = math.sqrt(noise[i] * noise[i] + rest) if i == j else rest / W_out[j, j]
    for i in range(dim):  # then its inverse in its place
        for j in range(i):
            rest = 0.0
            for k in range(j, i):
                rest -= W_out[i, k] * W_out[k, j]
            W_out[i, j] = rest / W_out[i, i]
        W_out[i, i] = 1.0 / W_out[i, i]


@kernel(f"void({readonly_array(2)}, f8[:, ::1], {readonly_array(1)}, f8[:, :, ::1])")
def whiten_many(noise: Array, rate_covariance: Array, rate_sd: Array, W_out: Array) -> None:
    """`whiten` of n measurements of one sensor: ``noise`` of shape (n, dim), of two (n, 3), ``rate_sd`` of (n,)."""
    one = np.empty(noise.shape[1])
    for k in range(len(noise)):
        for i in range(len(one)):
            one[i] = noise[k, i]
        whiten(one, rate_covariance, rate_sd[k], W_out[k])


@view_helper
def loss_weight(d2: float, loss: int, threshold: float) -> float:
    """Weight of a measurement of squared normalised length ``d2``; the loss bends at ``threshold``."""
    if loss == HUBER:
        length = math.sqrt(d2)
        return 1.0 if length <= threshold else threshold / length
    if loss == CAUCHY:
        return 1.0 / (1.0 + d2 / (threshold * threshold))
    return 1.0


@view_helper
def robust_cost(d2: float, loss: int, threshold: float) -> float:
    """Cost rho of a measurement of squared normalised length ``d2``."""
    if loss == HUBER and d2 > threshold * threshold:
        return threshold * (math.sqrt(d2) - 0.5 * threshold)
    if loss == CAUCHY:
        return 0.5 * threshold * threshold * math.log1p(d2 / (threshold * threshold))
    return 0.5 * d2


@kernel(f"void({readonly_array(1)}, i8, f8, f8[::1], f8[::1])")
def weight_many(d2: Array, loss: int, threshold: float, rho_out: Array, weight_out: Array) -> None:
    """`robust_cost` and `loss_weight` of n measurements."""
    for k in range(len(d2)):
        rho_out[k] = robust_cost(d2[k], loss, threshold)
        weight_out[k] = loss_weight(d2[k], loss, threshold)
