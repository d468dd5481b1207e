"""Solution, sensitivities, draws and covariances of an eliminated chain, backwards in time.

From the conditionals of `rovgraph.kernels.elimination.eliminate`,

    R_k x_k + S_k x_{k+1} + T_k y = z_k + white noise

in the notation of that module. Covariances are sums of squares, as in the smoother of Rauch, Tung and Striebel
(1965) but without its subtraction.
"""

import numpy as np

from rovgraph.geometry import Array
from rovgraph.kernels.chain import padded
from rovgraph.kernels.compile import Index, Matrices, helper, kernel


@kernel("void(f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1])")
def back_substitute(conditionals: Array, y: Array, x_out: Array) -> None:
    """Solve R_k x_k = z_k - S_k x_{k+1} - T_k y backwards in time, for m right-hand sides.

    With z of the elimination and the border's solution, the solution; with zeros and a unit matrix, the derivative of
    the solution by the border; with white noise and zeros, a draw of the error where the border is held.

    Parameters
    ----------
    conditionals : shape (n, d, 2 d + c + 1), of `rovgraph.kernels.elimination.eliminate`
    y : shape (c, m)
    x_out : shape (n, d, m), z to begin with, then x
    """
    n, d, m, c = x_out.shape[0], x_out.shape[1], x_out.shape[2], y.shape[0]
    totals, known = np.zeros(m), np.zeros((2 * d + c, m))  # x_k, x_{k+1}, y, in the order of the conditionals' columns
    here = np.zeros((d, 2 * d + c))  # read forwards: backwards, a processor waits for its memory
    for j in range(c):
        for col in range(m):
            known[2 * d + j, col] = y[j, col]
    for k in range(n - 1, -1, -1):
        for i in range(d):
            for j in range(2 * d + c):
                here[i, j] = conditionals[k, i, j]
        for i in range(d - 1, -1, -1):
            if m == 1:  # a sum in a register, at a quarter of the time
                total = x_out[k, i, 0]
                for j in range(i + 1, 2 * d + c):
                    total -= here[i, j] * known[j, 0]
                known[i, 0] = total / here[i, i]
                continue
            for col in range(m):
                totals[col] = x_out[k, i, col]
            for j in range(i + 1, 2 * d + c):
                factor = here[i, j]
                for col in range(m):
                    totals[col] -= factor * known[j, col]
            for col in range(m):
                known[i, col] = totals[col] / here[i, i]
        for i in range(d):
            for col in range(m):
                x_out[k, i, col] = known[d + i, col] = known[i, col]


@kernel("void(f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1])")
def forward_substitute(conditionals: Array, x_out: Array, y_out: Array) -> None:
    """Solve R_k' u_k = x_k - S_{k-1}' u_{k-1} forwards in time, for m right-hand sides.

    With `back_substitute`, the product of their covariance with combinations of the keyframes.

    Parameters
    ----------
    conditionals : shape (n, d, 2 d + c + 1), of `rovgraph.kernels.elimination.eliminate`
    x_out : shape (n, d, m), x to begin with, then u
    y_out : shape (c, m), the sum of T_k' u_k is taken from it
    """
    n, d, m, c = x_out.shape[0], x_out.shape[1], x_out.shape[2], y_out.shape[0]
    rest = np.zeros((2 * d + c, m))  # of x_k, x_{k+1}, y, in the order of the conditionals' columns
    for k in range(n):
        for i in range(d):
            for col in range(m):
                rest[i, col] = rest[d + i, col] + x_out[k, i, col]
                rest[d + i, col] = 0.0
        for i in range(d):
            for col in range(m):
                rest[i, col] /= conditionals[k, i, i]
                x_out[k, i, col] = rest[i, col]
            for j in range(i + 1, 2 * d + c):
                factor = conditionals[k, i, j]
                for col in range(m):
                    rest[j, col] -= factor * rest[i, col]
    for j in range(c):
        for col in range(m):
            y_out[j, col] += rest[2 * d + j, col]


@helper
def multiply_padded(A: Array, B: Array, inner: int, upper: bool, C_out: Array) -> None:
    """A B of ``inner`` columns of A; those left of the diagonal count as 0 where A is ``upper`` triangular."""
    for i in range(C_out.shape[0]):
        for c in range(C_out.shape[1]):
            C_out[i, c] = 0.0
        for j in range(i if upper else 0, inner):
            factor = A[i, j]
            for c in range(C_out.shape[1]):
                C_out[i, c] += factor * B[j, c]


@helper
def invert_triangle(R: Array, inverse_out: Array) -> None:
    """Inverse of an upper triangular matrix."""
    d, width = inverse_out.shape
    for i in range(d - 1, -1, -1):
        for c in range(width):
            inverse_out[i, c] = 0.0
        inverse_out[i, i] = 1.0
        for j in range(i + 1, d):
            factor = R[i, j]
            for c in range(width):
                inverse_out[i, c] -= factor * inverse_out[j, c]
        for c in range(width):
            inverse_out[i, c] /= R[i, i]


@kernel("void(f8[:, :, ::1], f8[:, ::1], f8[:, :, ::1], f8[:, :, ::1], f8[:, :, ::1])")
def covariances(conditionals: Array, P_y: Array, P_out: Array, cross_out: Array, next_out: Array) -> None:
    """Marginal covariances of the keyframes, backwards in time.

        H_k = R^-1 (I + S H_{k+1} S') R^-T,   P_k = H_k + X_k P_y X_k',   P_{k,k+1} = -R^-1 S H_{k+1} + X_k P_y X_{k+1}'
        X_k = -R^-1 (S X_{k+1} + T)

    H is the covariance where the border is held and X = dx/dy, so covariances are sums of squares.

    Parameters
    ----------
    conditionals : shape (n, d, 2 d + c + 1), of `rovgraph.kernels.elimination.eliminate`
    P_y : shape (c, c), covariance of the border
    P_out : shape (n, d, d)
    cross_out : shape (n, d, c), of the keyframes (rows) with the border, X P_y; or (0, d, c)
    next_out : shape (n - 1, d, d), of a keyframe (rows) with that after it; or (0, d, d)
    """
    n, d, c = P_out.shape[0], P_out.shape[1], P_y.shape[0]
    width, factors, transposed = padded(d), np.zeros((d, 2 * d)), np.zeros((2 * d, padded(d)))
    inverse, S, H, gain = np.zeros((d, width)), np.zeros((d, width)), np.zeros((d, width)), np.zeros((d, width))
    gain_H, P = np.zeros((d, width)), np.zeros((d, width))
    T, X, moved, cross = (
        np.zeros((d, padded(c))),
        np.zeros((d, padded(c))),
        np.zeros((d, padded(c))),
        np.zeros((d, padded(c))),
    )
    padded_P_y = np.zeros((c, padded(c)))
    # of this keyframe, and right of it of that after it
    X_t, by_border = np.zeros((c, 2 * width)), np.zeros((d, 2 * width))
    for i in range(c):
        for j in range(c):
            padded_P_y[i, j] = P_y[i, j]
    for k in range(n - 1, -1, -1):
        invert_triangle(conditionals[k], inverse)
        if k < n - 1:
            for i in range(d):
                for j in range(d):
                    S[i, j] = conditionals[k, i, d + j]
            multiply_padded(inverse, S, d, True, gain)
            multiply_padded(gain, H, d, False, gain_H)
            multiply_padded(gain, X, d, False, moved)
        for i in range(d):
            for j in range(c):
                T[i, j] = conditionals[k, i, 2 * d + j]
        multiply_padded(inverse, T, d, True, X)
        for i in range(d):
            for j in range(d):
                factors[i, j], factors[i, d + j] = inverse[i, j], gain_H[i, j]
                transposed[j, i], transposed[d + j, i] = inverse[i, j], gain[i, j]
            for j in range(c):
                X[i, j] = -X[i, j] - moved[i, j]
                X_t[j, width + i] = X_t[j, i]
                X_t[j, i] = X[i, j]
        multiply_padded(factors, transposed, 2 * d, True, P)
        multiply_padded(X, padded_P_y, c, False, cross)
        multiply_padded(cross, X_t, c, False, by_border)
        for i in range(d):
            for j in range(i, d):
                H[i, j] = H[j, i] = P[i, j]
                P_out[k, i, j] = P_out[k, j, i] = P[i, j] + by_border[i, j]
        if k < cross_out.shape[0]:
            for i in range(d):
                for j in range(c):
                    cross_out[k, i, j] = cross[i, j]
        if k < next_out.shape[0]:
            for i in range(d):
                for j in range(d):
                    next_out[k, i, j] = by_border[i, width + j] - gain_H[i, j]


@kernel()
def propagate_back(conditionals: Matrices, stops: Index, H_out: Matrices, X_out: Matrices, gain_out: Matrices) -> None:
    """`covariances` at a few keyframes, and what ties them: with a held border, dx_i/dx_j = G_i G_{i+1} ... G_{j-1}.

    With G_k = -R^-1 S, the covariance of keyframes i <= j is G_i ... G_{j-1} H_j + X_i P_y X_j'.

    Parameters
    ----------
    conditionals : shape (n, d, 2 d + c + 1), of `rovgraph.kernels.elimination.eliminate`
    stops : shape (s,), increasing, the keyframes
    H_out, X_out : shapes (s, d, d), (s, d, c), given at the last stop
    gain_out : shape (s - 1, d, d), of a stop by the next
    """
    d, c, stop = H_out.shape[1], X_out.shape[2], len(stops) - 1
    width = padded(d)
    inverse, S, gain, H, total = (
        np.zeros((d, width)),
        np.zeros((d, width)),
        np.zeros((d, width)),
        np.zeros((d, width)),
        np.zeros((d, width)),
    )
    gain_H, moved_total, transposed = np.zeros((d, width)), np.zeros((d, width)), np.zeros((2 * d, width))
    factors, T, X, moved = (
        np.zeros((d, 2 * d)),
        np.zeros((d, padded(c))),
        np.zeros((d, padded(c))),
        np.zeros((d, padded(c))),
    )
    for i in range(d):
        total[i, i] = 1.0
        for j in range(d):
            H[i, j] = H_out[stop, i, j]
        for j in range(c):
            X[i, j] = X_out[stop, i, j]
    for k in range(stops[stop] - 1, stops[0] - 1, -1):
        invert_triangle(conditionals[k], inverse)
        for i in range(d):
            for j in range(d):
                S[i, j] = -conditionals[k, i, d + j]
            for j in range(c):
                T[i, j] = -conditionals[k, i, 2 * d + j]
        multiply_padded(inverse, S, d, True, gain)
        multiply_padded(gain, H, d, False, gain_H)
        for i in range(d):
            for j in range(d):
                factors[i, j], factors[i, d + j] = inverse[i, j], gain_H[i, j]
                transposed[j, i], transposed[d + j, i] = inverse[i, j], gain[i, j]
        multiply_padded(factors, transposed, 2 * d, True, H)
        multiply_padded(gain, X, d, False, moved)
        multiply_padded(inverse, T, d, True, X)
        multiply_padded(gain, total, d, False, moved_total)
        for i in range(d):
            for j in range(c):
                X[i, j] += moved[i, j]
            for j in range(d):
                total[i, j] = moved_total[i, j]
        if k == stops[stop - 1]:
            stop -= 1
            for i in range(d):
                for j in range(d):
                    H_out[stop, i, j], gain_out[stop, i, j] = 0.5 * (H[i, j] + H[j, i]), total[i, j]
                    total[i, j] = 1.0 if i == j else 0.0
                for j in range(c):
                    X_out[stop, i, j] = X[i, j]
