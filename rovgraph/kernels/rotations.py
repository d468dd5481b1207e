"""Small vectors, matrices and rotations.

    S(v) a = v x a                                                        (2.2)
    Exp(r) = I + sin a / a S + (1 - cos a) / a^2 S^2,  a = |r|            (2.1)
    Jr(r)  = I - (1 - cos a) / a^2 S + (a - sin a) / a^3 S^2              (Forster et al. 2017, eq. 8)

Vectors have shape (3,), matrices (3, 3) unless said; all are written into ``_out``, which must not be an input.
"""

import math

from rovgraph.geometry import Array
from rovgraph.kernels.compile import helper

SMALL = 1e-4  # angle squared below which series are exact to rounding [rad^2]


@helper
def dot(a: Array, b: Array) -> float:
    """a . b of two vectors."""
    product: float = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return product


@helper
def cross(a: Array, b: Array, c_out: Array) -> None:
    """a x b."""
    c_out[0] = a[1] * b[2] - a[2] * b[1]
    c_out[1] = a[2] * b[0] - a[0] * b[2]
    c_out[2] = a[0] * b[1] - a[1] * b[0]


@helper
def skew(v: Array, S_out: Array) -> None:
    """S(v), so that S(v) a = v x a (2.2)."""
    S_out[0, 0], S_out[0, 1], S_out[0, 2] = 0.0, -v[2], v[1]
    S_out[1, 0], S_out[1, 1], S_out[1, 2] = v[2], 0.0, -v[0]
    S_out[2, 0], S_out[2, 1], S_out[2, 2] = -v[1], v[0], 0.0


@helper
def rotate(A: Array, v: Array, w_out: Array) -> None:
    """A v."""
    for i in range(3):
        w_out[i] = A[i, 0] * v[0] + A[i, 1] * v[1] + A[i, 2] * v[2]


@helper
def rotate_back(A: Array, v: Array, w_out: Array) -> None:
    """A' v."""
    for i in range(3):
        w_out[i] = A[0, i] * v[0] + A[1, i] * v[1] + A[2, i] * v[2]


@helper
def multiply(A: Array, B: Array, C_out: Array) -> None:
    """A B."""
    for i in range(3):
        for j in range(3):
            C_out[i, j] = A[i, 0] * B[0, j] + A[i, 1] * B[1, j] + A[i, 2] * B[2, j]


@helper
def multiply_transposed(A: Array, B: Array, C_out: Array) -> None:
    """A' B."""
    for i in range(3):
        for j in range(3):
            C_out[i, j] = A[0, i] * B[0, j] + A[1, i] * B[1, j] + A[2, i] * B[2, j]


@helper
def rodrigues(r: Array) -> tuple[float, float, float]:
    """sin a / a, (1 - cos a) / a^2 and (a - sin a) / a^3 of the angle a = |r|."""
    square = dot(r, r)
    if square < SMALL:
        return (
            1.0 - square / 6.0 * (1.0 - square / 20.0 * (1.0 - square / 42.0)),
            0.5 * (1.0 - square / 12.0 * (1.0 - square / 30.0 * (1.0 - square / 56.0))),
            (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0))) / 6.0,
        )
    angle = math.sqrt(square)
    sine, half = math.sin(angle), math.sin(0.5 * angle)
    return sine / angle, 2.0 * half * half / square, (angle - sine) / (square * angle)


@helper
def _series(r: Array, first: float, second: float, M_out: Array) -> None:
    """I + first S(r) + second S(r)^2."""
    square = dot(r, r)
    for i in range(3):
        for j in range(3):
            M_out[i, j] = second * r[i] * r[j]
        M_out[i, i] += 1.0 - second * square
    M_out[0, 1] -= first * r[2]
    M_out[1, 0] += first * r[2]
    M_out[0, 2] += first * r[1]
    M_out[2, 0] -= first * r[1]
    M_out[1, 2] -= first * r[0]
    M_out[2, 1] += first * r[0]


@helper
def exp_rotation(r: Array, R_out: Array) -> None:
    """Exp(r) of a rotation vector [rad]."""
    sine, cosine, _ = rodrigues(r)
    _series(r, sine, cosine, R_out)


@helper
def exp_and_left_jacobian(r: Array, R_out: Array, J_out: Array) -> None:
    """Exp(r), and Jl(r) with Exp(r + d) = Exp(Jl d) Exp(r) to first order in d."""
    sine, cosine, cubic = rodrigues(r)
    _series(r, sine, cosine, R_out)
    _series(r, cosine, cubic, J_out)


@helper
def right_jacobian(r: Array, J_out: Array) -> None:
    """Jr(r), with Exp(r + d) = Exp(r) Exp(Jr d) to first order in d."""
    _, cosine, cubic = rodrigues(r)
    _series(r, -cosine, cubic, J_out)


@helper
def inverse_right_jacobian(r: Array, J_out: Array) -> None:
    """Jr(r)^-1, with Log(Exp(r) Exp(d)) = r + Jr^-1 d to first order in d."""
    square = dot(r, r)
    if square < SMALL:
        second = (1.0 + square / 60.0 * (1.0 + square / 42.0)) / 12.0
    else:
        angle = math.sqrt(square)
        second = (1.0 - 0.5 * angle / math.tan(0.5 * angle)) / square
    _series(r, 0.5, second, J_out)


@helper
def _curvature(square: float) -> tuple[float, float]:
    """(1 - a / 2 cot(a / 2)) / a^2 of an angle a, and its derivative by a^2."""
    if square < 0.5:  # the series of the cotangent, exact to rounding
        s = square
        value = 1.0 / 47900160.0 + s * (691.0 / 1307674368000.0 + s * (1.0 / 74724249600.0 + s * CURVATURE_8))
        value = 1.0 / 12.0 + s * (1.0 / 720.0 + s * (1.0 / 30240.0 + s * (1.0 / 1209600.0 + s * value)))
        slope = 5.0 * 691.0 / 1307674368000.0 + s * (6.0 / 74724249600.0 + s * 7.0 * CURVATURE_8)
        slope = 3.0 / 1209600.0 + s * (4.0 / 47900160.0 + s * slope)
        return value, 1.0 / 720.0 + s * (2.0 / 30240.0 + s * slope)
    angle = math.sqrt(square)
    sine, cosine = math.sin(0.5 * angle), math.cos(0.5 * angle)
    value = (1.0 - 0.5 * angle * cosine / sine) / square
    return value, (0.125 / (sine * sine) + 0.25 * cosine / (sine * angle) - 1.0 / square) / square


CURVATURE_8 = 3617.0 / 10670622842880000.0


@helper
def inverse_jacobian_with_slope(r: Array, v: Array, half: float, J_out: Array, slope_out: Array) -> None:
    """J = I + half S(r) + c S(r)^2, which is Jr(r)^-1 with half = 1/2 and Jl(r)^-1 with -1/2, and d(J v)/dr."""
    c, by_square = _curvature(dot(r, r))
    _series(r, half, c, J_out)
    along, across = dot(r, v), dot(r, r)
    for i in range(3):
        twice = r[i] * along - v[i] * across  # r x (r x v)
        for j in range(3):
            slope_out[i, j] = 2.0 * by_square * twice * r[j] + c * (r[i] * v[j] - 2.0 * v[i] * r[j])
        slope_out[i, i] += c * along
    slope_out[0, 1] += half * v[2]
    slope_out[1, 0] -= half * v[2]
    slope_out[0, 2] -= half * v[1]
    slope_out[2, 0] += half * v[1]
    slope_out[1, 2] += half * v[0]
    slope_out[2, 1] -= half * v[0]


@helper
def log_rotation(R: Array, r_out: Array) -> None:
    """Rotation vector of a rotation matrix, of an angle in [0, pi] [rad], by way of its quaternion."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    x, y, z = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    if trace > 0.0:
        w = 1.0 + trace
    elif R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2]:
        w, x, y, z = x, 1.0 + R[0, 0] - R[1, 1] - R[2, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]
    elif R[1, 1] >= R[2, 2]:
        w, x, y, z = y, R[0, 1] + R[1, 0], 1.0 + R[1, 1] - R[0, 0] - R[2, 2], R[1, 2] + R[2, 1]
    else:
        w, x, y, z = z, R[0, 2] + R[2, 0], R[1, 2] + R[2, 1], 1.0 + R[2, 2] - R[0, 0] - R[1, 1]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-10 * w else 2.0 / w
    r_out[0], r_out[1], r_out[2] = scale * x, scale * y, scale * z
