"""A chain, eliminated: each keyframe given the next one and the border, and what follows from that.

    R_k x_k + S_k x_{k+1} + T_k y = z_k + white noise,  R_y y = z_y + white noise
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.linalg import solve_triangular

from rovgraph.geometry import Array
from rovgraph.kernels import chain


@dataclass(frozen=True)
class Conditionals:
    """Of n keyframes with d components and a border with c, as `rovgraph.kernels.chain.eliminate` writes them.

    Attributes
    ----------
    conditionals : ndarray, shape (n, d, 2 d + c + 1), columns R_k, S_k, T_k, z_k
    border : ndarray, shape (c, c + 1), columns R_y, z_y
    filtered : ndarray, shape (f, d + c, d + c + 1), rows of some keyframes and the border, of data up to each
    left_out : ndarray, shape (1,), sum of squares at the minimum
    """

    conditionals: Array
    border: Array
    filtered: Array
    left_out: Array

    @staticmethod
    def empty(n: int, d: int, c: int, stops: Sequence[int]) -> "Conditionals":
        """Room for them."""
        joint = np.empty((len(stops), d + c, d + c + 1))
        return Conditionals(np.empty((n, d, 2 * d + c + 1)), np.empty((c, c + 1)), joint, np.empty(1))

    @property
    def c(self) -> int:
        return len(self.border)

    def solution(self) -> tuple[Array, Array]:
        """Keyframes, shape (n, d), and border, shape (c,)."""
        y = solve_triangular(self.border[:, :-1], self.border[:, -1]) if self.c else np.empty(0)
        x = self.conditionals[:, :, -1:].copy()
        chain.back_substitute(self.conditionals, y[:, None], x)
        return x[..., 0], y

    def draw(self, rng: np.random.Generator) -> Array:
        """A draw of the error of the keyframes, shape (n, d), the border being held."""
        n, d, _ = self.conditionals.shape
        x = rng.standard_normal((n, d, 1))
        chain.back_substitute(self.conditionals, np.zeros((self.c, 1)), x)
        return x[..., 0]

    @cached_property
    def by_border(self) -> Array:
        """Derivative of the keyframes by the border, shape (n, d, c)."""
        n, d, _ = self.conditionals.shape
        x = np.zeros((n, d, self.c))
        chain.back_substitute(self.conditionals, np.eye(self.c), x)
        return x

    @cached_property
    def border_covariance(self) -> Array:
        """Covariance of the border, shape (c, c)."""
        root = covariance_root(self.border[:, :-1])
        return root @ root.T

    @cached_property
    def cross_covariances(self) -> Array:
        """Covariance of the keyframes with the border, shape (n, d, c)."""
        return self.by_border @ self.border_covariance

    @cached_property
    def covariances(self) -> Array:
        """Marginal covariances of the keyframes, shape (n, d, d)."""
        n, d, _ = self.conditionals.shape
        P = np.empty((n, d, d))
        chain.covariances(self.conditionals, self.by_border, self.cross_covariances, P, np.empty((0, d, d)))
        return P

    def newest_covariance(self) -> Array:
        """Joint covariance of the last keyframe and the border, shape (d + c, d + c)."""
        last = self.conditionals[-1]
        d, c = len(last), self.c
        R = np.zeros((d + c, d + c))
        R[:d, :d], R[:d, d:], R[d:, d:] = last[:, :d], last[:, 2 * d : 2 * d + c], self.border[:, :-1]
        root = covariance_root(R)
        return root @ root.T

    def filtered_covariances(self) -> Array:
        """Joint covariances of keyframes and border from the data up to each, shape (f, d + c, d + c)."""
        roots = [covariance_root(rows[:, :-1]) for rows in self.filtered]
        return np.array([root @ root.T for root in roots])

    def border_by_last(self, given: Array) -> Array:
        """How the optimum of the whole border moves with some of its components, shape (c, k)."""
        others = np.setdiff1d(np.arange(self.c), given)
        R = np.linalg.qr(self.border[:, [*others, *given]], mode="r")
        out, split = np.zeros((self.c, len(given))), len(others)
        out[given] = np.eye(len(given))
        if split:
            out[others] = -solve_triangular(R[:split, :split], R[:split, split:])
        return out


def covariance_root(R: Array) -> Array:
    """R^-1 of an upper triangular square root of an information matrix."""
    return np.asarray(solve_triangular(R, np.eye(len(R)))) if len(R) else np.empty((0, 0))
