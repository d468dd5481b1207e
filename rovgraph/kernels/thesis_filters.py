"""The arithmetic of the thesis's filters, of several side by side.

    y_r = sum of c x_i x_j x_k,  J = dy/dx          polynomials: (2.8), (2.9) and (3.14) are of the third order at most
    x <- x + dt y(x),  F = I + dt J                 forward Euler (2.26)
    P <- F P F' + Q
    L L' = H P H' + R,  W = L^-1 H P,  e = L^-1 (z - h)
    x <- x + W' e,  P <- P - W' W

The whitened innovation e has unit covariance if the filter is consistent, and its sum of squares is the normalised
innovation squared (Bar-Shalom, Li and Kirubarajan 2001, 5.4). P stays symmetric to the last bit. A leading axis is that
of the filters; what comes out of one does not depend on the others, to the last bit.

Polynomials are c, shape (filters, t) or (1, t) where all have the same, the place of y that each of t terms belongs to,
shape (t,), and the components of x that it is a product of, shape (t, 3), -1 = none. F and H are sparse.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.kernels.compile import FlagMatrix, Matrices, Matrix, kernel, view_helper

Index = NDArray[np.int64]


@view_helper
def _add_terms(c: Array, places: Index, factors: Index, x: Array, y: Array, J: Array) -> None:
    """Value and Jacobian of polynomials of one filter, added to ``y`` and ``J``."""
    for t in range(len(places)):
        r, i, j, k = places[t], factors[t, 0], factors[t, 1], factors[t, 2]
        a = x[i] if i >= 0 else 1.0
        b = x[j] if j >= 0 else 1.0
        d = x[k] if k >= 0 else 1.0
        y[r] += c[t] * (a * b * d)
        if i >= 0:
            J[r, i] += c[t] * (b * d)
        if j >= 0:
            J[r, j] += c[t] * (a * d)
        if k >= 0:
            J[r, k] += c[t] * (a * b)


@kernel("void(f8[:, ::1], i8[::1], i8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, :, ::1])")
def evaluate_polynomials(c: Array, places: Index, factors: Index, x: Array, y_out: Array, J_out: Array) -> None:
    """y, shape (filters, m), and J, shape (filters, m, n), at states x, shape (filters, n)."""
    y_out[:], J_out[:] = 0.0, 0.0
    for f in range(len(x)):
        _add_terms(c[f if len(c) > 1 else 0], places, factors, x[f], y_out[f], J_out[f])


@kernel("void(f8[:, ::1], i8[::1], i8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, :, ::1])")
def step_polynomials(c: Array, places: Index, factors: Index, x: Array, dt: Array, x_out: Array, F_out: Array) -> None:
    """Forward Euler of x' = y(x) over times of each filter, shape (filters,) [s]; shapes (filters, n), (.., n, n)."""
    n = x.shape[1]
    x_out[:], F_out[:] = 0.0, 0.0
    for f in range(len(x)):
        _add_terms(c[f if len(c) > 1 else 0], places, factors, x[f], x_out[f], F_out[f])
        for i in range(n):
            x_out[f, i] = x[f, i] + dt[f] * x_out[f, i]
            for j in range(n):
                F_out[f, i, j] *= dt[f]
            F_out[f, i, i] += 1.0


@view_helper
def _add_product(A: Array, rows: int, inner: int, B: Array, C: Array) -> None:
    """C += A B of the first ``rows`` of A and ``inner`` of B; what is zero in A is skipped."""
    for i in range(rows):
        for k in range(inner):
            a = A[i, k]
            if a != 0.0:
                for j in range(B.shape[1]):
                    C[i, j] += a * B[k, j]


@kernel("void(f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1], i8, f8[:, :, ::1])")
def propagate_covariances(P: Array, F: Array, Q: Array, moving: int, P_out: Array) -> None:
    """P <- F P F' + Q.

    Parameters
    ----------
    P, F : shape (filters, n, n)
    Q : shape (filters, n), its diagonal
    moving : beyond the first so many, the state stands still: F is the identity there
    """
    n = P.shape[1]
    spread = np.empty((moving, n))
    for f in range(len(P)):
        spread[:] = 0.0
        _add_product(F[f], moving, moving, P[f], spread)
        for i in range(n):
            for j in range(n):
                P_out[f, i, j] = spread[i, j] if i < moving else P[f, i, j]
        for j in range(moving):
            for i in range(j + 1):
                total = 0.0
                for k in range(moving):
                    if F[f, j, k] != 0.0:
                        total += spread[i, k] * F[f, j, k]
                P_out[f, i, j] = P_out[f, j, i] = total
            for i in range(moving, n):
                P_out[f, i, j] = spread[j, i]
        for i in range(n):
            P_out[f, i, i] += Q[f, i]


@view_helper
def _whiten(S: Array, W: Array, e: Array) -> bool:
    """L with L L' = S in the place of S, L^-1 W and L^-1 e in that of W and e; False = S is not positive definite."""
    for i in range(len(S)):
        for j in range(i):
            for k in range(j):
                S[i, j] -= S[i, k] * S[j, k]
            S[i, j] /= S[j, j]
            S[i, i] -= S[i, j] * S[i, j]
        if not S[i, i] > 0.0:
            return False
        S[i, i] = math.sqrt(S[i, i])
        for j in range(i):
            e[i] -= S[i, j] * e[j]
            for k in range(W.shape[1]):
                W[i, k] -= S[i, j] * W[j, k]
        e[i] /= S[i, i]
        for k in range(W.shape[1]):
            W[i, k] /= S[i, i]
    return True


class FilterInnovations(NamedTuple):
    """One measurement of several filters.

    Attributes
    ----------
    residual : shape (filters, m), measured minus predicted
    H, R : shapes (filters, m, n), (filters, m, m)
    measured : shape (filters, m); what is not changes nothing
    """

    residual: Matrix
    H: Matrices
    R: Matrices
    measured: FlagMatrix


@kernel()
def update(
    x: Matrix,
    P: Matrices,
    found: FilterInnovations,
    x_out: Matrix,
    P_out: Matrices,
    normalised_out: Matrix,
    sd_out: Matrix,
) -> None:
    """One measurement; not finite where the innovation's covariance is not positive definite: the filter has diverged.

    What is not measured has no row in H, an innovation of zero and a noise of one, which changes nothing.

    Parameters
    ----------
    x, P : shapes (filters, n), (filters, n, n)
    normalised_out, sd_out : shape (filters, m), whitened innovation and its sd before
    """
    residual, H, R, measured = found
    m, n = H.shape[1], H.shape[2]
    S, W, e, row = np.empty((m, m)), np.empty((m, n)), np.empty(m), np.empty((1, n))
    for f in range(len(x)):
        W[:] = 0.0
        for i in range(m):
            e[i] = residual[f, i] if measured[f, i] else 0.0
            if measured[f, i]:
                _add_product(H[f, i : i + 1], 1, n, P[f], W[i : i + 1])
        for i in range(m):
            for j in range(i + 1):
                S[i, j] = 1.0 if i == j else 0.0
                if measured[f, i] and measured[f, j]:
                    S[i, j] = R[f, i, j]
                    for k in range(n):
                        if H[f, j, k] != 0.0:
                            S[i, j] += W[i, k] * H[f, j, k]
            sd_out[f, i] = math.sqrt(S[i, i]) if S[i, i] >= 0.0 else math.nan
        certain = _whiten(S, W, e)
        for j in range(n):
            row[0, j] = 0.0
        for i in range(m):
            normalised_out[f, i] = e[i] if certain else math.nan
            for j in range(n):
                row[0, j] += W[i, j] * e[i]
        for i in range(n):
            x_out[f, i] = x[f, i] + row[0, i] if certain else math.nan
            for j in range(n):
                P_out[f, i, j] = P[f, i, j] if certain else math.nan
        for k in range(m):
            for i in range(n):
                w = W[k, i]
                if w != 0.0:
                    for j in range(n):
                        P_out[f, i, j] -= w * W[k, j]
