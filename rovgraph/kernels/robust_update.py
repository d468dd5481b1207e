"""A Kalman filter's update with gates and robust losses, for one keyframe.

Innovations r and Jacobians H are whitened, so their noise is I. With S = H P H' and W the weights of the losses,

    d = P H' W^1/2 (W^1/2 S W^1/2 + I)^-1 W^1/2 r,   w_j = rho'(|e_j|) / |e_j|,   e = r - H d

are iterated (Huber 1964; Zhang 1997): weights follow from the residuals after the update, as in the smoother's
cost, not from the innovations, which a prior that knows little makes large. The covariance is Joseph's,
P <- (I - K H) P (I - K H)' + K K', multiplied out so that it costs products of rank m only.

What is considered is uncertain and never corrected, nor does it move a gain or a gate. Its part of the estimate's error
is B y, y white and of unit variance, so that the covariance of the estimate is P + B B'. With H_y the Jacobian by y,

    B <- B - K (H B + H_y)                                              the covariance analysis of Schmidt (1966)

Shapes: P (n, n), B (n, h).
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper
from rovgraph.kernels.weighting import loss_weight

Lines = NDArray[np.int64]

MAX_REWEIGHTINGS = 20
SETTLED = 1e-3  # change of a weight
RIDGE = 1e-12  # of the trace, that keeps least squares of what a sensor hardly sees solvable


class Innovations(NamedTuple):
    """Whitened innovations of k measurements, m rows in all.

    Attributes
    ----------
    first : shape (k + 1,), the row where each measurement begins
    r, H, H_y : shapes (m,), (m, n), (m, h), innovations and their Jacobians by the error and by y
    HP, S : shapes (m, n), (m, m), H P and H P H'
    """

    first: Lines
    r: Array
    H: Array
    H_y: Array
    HP: Array
    S: Array


class Weights(NamedTuple):
    """Weights of k measurements, and what they follow from.

    Attributes
    ----------
    loss, bend : shape (k,), of each measurement, of `rovgraph.kernels.weighting`
    weight : shape (k,), of each measurement
    root : shape (m,), square roots of the rows' weights
    inverse : shape (m, m), (W^1/2 S W^1/2 + I)^-1
    """

    loss: Lines
    bend: Array
    weight: Array
    root: Array
    inverse: Array


@helper
def innovation_covariance(P: Array, found: Innovations) -> None:
    """H P and S = H P H'."""
    H, HP_out, S_out = found.H, found.HP, found.S
    m, n = H.shape
    HP_out.fill(0.0)
    for a in range(m):
        for j in range(n):
            h = H[a, j]
            if h != 0.0:
                for i in range(n):
                    HP_out[a, i] += h * P[j, i]
    for a in range(m):
        for b in range(a + 1):
            total = 0.0
            for j in range(n):
                total += H[b, j] * HP_out[a, j]
            S_out[a, b] = S_out[b, a] = total


@helper
def cholesky(A: Array, L_out: Array) -> bool:
    """L with L L' = A, lower triangular; False where A is not positive definite."""
    for i in range(A.shape[0]):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L_out[i, k] * L_out[j, k]
            if j < i:
                L_out[i, j] = total / L_out[j, j]
            elif total > 0.0:
                L_out[i, i] = math.sqrt(total)
            else:
                return False
    return True


@helper
def solve_cholesky(L: Array, x: Array) -> None:
    """(L L')^-1 x, in place."""
    n = L.shape[0]
    for i in range(n):
        total = x[i]
        for k in range(i):
            total -= L[i, k] * x[k]
        x[i] = total / L[i, i]
    for i in range(n - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, n):
            total -= L[k, i] * x[k]
        x[i] = total / L[i, i]


@helper
def normalised_squared(S: Array, r: Array, begin: int, end: int) -> float:
    """r' (S + I)^-1 r of rows ``begin`` to ``end``: the normalised innovation squared (NIS)."""
    if end == begin + 1:
        nis: float = r[begin] * r[begin] / (S[begin, begin] + 1.0)
        return nis
    n = end - begin
    A, x = np.empty((n, n)), np.empty(n)
    for i in range(n):
        x[i] = r[begin + i]
        for j in range(n):
            A[i, j] = S[begin + i, begin + j]
        A[i, i] += 1.0
    L = np.empty_like(A)
    cholesky(A, L)
    solve_cholesky(L, x)
    total = 0.0
    for i in range(n):
        total += r[begin + i] * x[i]
    return total


@helper
def leave_out(found: Innovations, j: int) -> None:
    """Make nothing of the rows of measurement ``j``."""
    r, H, H_y, HP, S = found.r, found.H, found.H_y, found.HP, found.S
    for a in range(found.first[j], found.first[j + 1]):
        r[a] = 0.0
        H[a].fill(0.0)
        H_y[a].fill(0.0)
        HP[a].fill(0.0)
        for b in range(len(r)):
            S[a, b] = S[b, a] = 0.0


@helper
def inflate(P: Array, found: Innovations, measurement: int, seen: Array, spread: Array) -> None:
    """Let something that no model knows have moved what a sensor sees, by as much as its measurement shows.

    As a knock does to velocity and position: P += |x|^2 (seen seen' + spread spread'), x the least squares solution
    of H seen x = r. The directions ``seen``, shape (n, s), are those of the error that the sensor sees, with what has
    followed from it; ``spread``, shape (n, s), is how far that is uncertain. H P and S are out of date after it.
    """
    n, s = seen.shape
    r, H, A, x = found.r, found.H, np.zeros((s, s)), np.zeros(s)
    row = np.empty(s)
    for a in range(found.first[measurement], found.first[measurement + 1]):
        for j in range(s):
            row[j] = 0.0
            for i in range(n):
                row[j] += H[a, i] * seen[i, j]
        for j in range(s):
            x[j] += row[j] * r[a]
            for k in range(s):
                A[j, k] += row[j] * row[k]
    trace = 0.0
    for j in range(s):
        trace += A[j, j]
    for j in range(s):
        A[j, j] += RIDGE * trace
    L = np.empty_like(A)
    if not cholesky(A, L):
        return
    solve_cholesky(L, x)
    square = 0.0
    for j in range(s):
        square += x[j] * x[j]
    for i in range(n):
        for k in range(n):
            for j in range(s):
                P[i, k] += square * (seen[i, j] * seen[k, j] + spread[i, j] * spread[k, j])


@helper
def reweight(found: Innovations, weights: Weights) -> None:
    """Iterate the weights until they rest."""
    first, r, S, loss, bend = found.first, found.r, found.S, weights.loss, weights.bend
    weight_out, root_out, inverse_out = weights.weight, weights.root, weights.inverse
    k, m = len(weight_out), len(r)
    A, L, gain = np.empty((m, m)), np.empty((m, m)), np.empty(m)
    weight_out.fill(1.0)
    root_out.fill(1.0)
    for _ in range(MAX_REWEIGHTINGS):
        for a in range(m):
            for b in range(m):
                A[a, b] = root_out[a] * S[a, b] * root_out[b]
            A[a, a] += 1.0
        cholesky(A, L)
        for a in range(m):
            gain[a] = root_out[a] * r[a]
        solve_cholesky(L, gain)
        for a in range(m):
            gain[a] *= root_out[a]
        change = 0.0
        for j in range(k):
            square = 0.0
            for a in range(first[j], first[j + 1]):
                residual = r[a]
                for b in range(m):
                    residual -= S[a, b] * gain[b]
                square += residual * residual
            weight = loss_weight(square, loss[j], bend[j])
            change = max(change, abs(weight - weight_out[j]))
            weight_out[j] = weight
        if change < SETTLED:
            break
        for j in range(k):
            for a in range(first[j], first[j + 1]):
                root_out[a] = math.sqrt(weight_out[j])
    inverse_out.fill(0.0)
    for a in range(m):
        inverse_out[a, a] = 1.0
        solve_cholesky(L, inverse_out[a])  # symmetric: a row is a column


@helper
def correction(found: Innovations, weights: Weights, delta_out: Array) -> None:
    """The correction by itself: d = P H' W^1/2 (W^1/2 S W^1/2 + I)^-1 W^1/2 r."""
    r, HP, root, inverse = found.r, found.HP, weights.root, weights.inverse
    delta_out.fill(0.0)
    for a in range(len(r)):
        share = 0.0
        for b in range(len(r)):
            share += inverse[a, b] * root[b] * r[b]
        for i in range(len(delta_out)):
            delta_out[i] += HP[a, i] * root[a] * share


@helper
def joseph(P: Array, B: Array, found: Innovations, weights: Weights, delta_out: Array) -> None:
    """The correction, and P and B after it in place; HP and H become W^1/2 times what they were."""
    r, H, H_y, HP, root, inverse = found.r, found.H, found.H_y, found.HP, weights.root, weights.inverse
    m, n = HP.shape
    Kt, HA = np.zeros((m, n)), np.zeros((m, n))  # K', and H times the transpose of A = (I - K H) P
    for a in range(m):
        for i in range(n):
            HP[a, i] *= root[a]
            H[a, i] *= root[a]
    delta_out.fill(0.0)
    for a in range(m):
        for b in range(m):
            share = inverse[a, b]
            for i in range(n):
                Kt[a, i] += share * HP[b, i]
        for i in range(n):
            delta_out[i] += Kt[a, i] * root[a] * r[a]
    for k in range(B.shape[1]):
        for a in range(m):
            off = root[a] * H_y[a, k]
            for i in range(n):
                off += H[a, i] * B[i, k]
            HA[a, 0] = off
        for i in range(n):
            for a in range(m):
                B[i, k] -= Kt[a, i] * HA[a, 0]
    HA.fill(0.0)
    for i in range(n):  # P <- A'
        for a in range(m):
            share = HP[a, i]
            for j in range(n):
                P[i, j] -= share * Kt[a, j]
    for a in range(m):
        for i in range(n):
            h = H[a, i]
            if h != 0.0:
                for j in range(n):
                    HA[a, j] += h * P[i, j]
        for j in range(n):
            HA[a, j] = Kt[a, j] - HA[a, j]
    for i in range(n):  # A (I - K H)' + K K'
        for a in range(m):
            share = Kt[a, i]
            for j in range(n):
                P[i, j] += share * HA[a, j]
    for i in range(n):
        for j in range(i):
            P[i, j] = P[j, i] = 0.5 * (P[i, j] + P[j, i])
