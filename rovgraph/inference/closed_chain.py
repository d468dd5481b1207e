"""The optimum of a chain, given loop closures: a low-rank update of the joint covariance of all its variables.

With e the error of north and east at some keyframes, closures say that every variable x of the chain moves by

    x <- x + cov(x, e) pull,   P <- P - V V',   V = cov(x, e) root

(`rovgraph.inference.crossovers.Drift.shows`). The covariances with e are solves with the chain's factor, forwards and
backwards in time. What is considered keeps its value and its prior, as in the filter of Schmidt.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from rovgraph.geometry import Array, exp_and_right_jacobian, transpose
from rovgraph.inference.chain import ChainStep
from rovgraph.inference.chain_information import SquareRoot
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.model.state import State
from rovgraph.problem.problem import Index

TOGETHER = 16  # columns of V, of 2 kB each per keyframe


@dataclass(eq=False, kw_only=True)
class ClosedChain(ChainOptimum):
    """A chain given loop closures: `state` and covariances are those after them, all else is the chain's own.

    Attributes
    ----------
    keyframes : ndarray of int, shape (m,), those of e
    root : ndarray, shape (2 m, r), see above
    noise : ndarray, shape (2 m, r), square root of the part of root root' that e does not explain
    step : of all variables, from the chain's optimum
    """

    keyframes: Index
    root: Array
    noise: Array
    step: ChainStep

    @staticmethod
    def of(best: ChainOptimum, keyframes: Index, P: Array, pull: Array, root: Array) -> "ClosedChain":
        """The chain given closures.

        Parameters
        ----------
        best : the chain
        keyframes : ndarray of int, shape (m,), increasing, those of e
        P : ndarray, shape (2 m, 2 m), covariance of e
        pull, root : ndarrays, shapes (2 m,) and (2 m, r)
        """
        noise = root @ np.linalg.cholesky(np.eye(root.shape[1]) - root.T @ P @ root)
        none, known = ChainStep(np.empty((0, 0)), np.empty(0)), (best.chain, best.solution, best.begun)
        own = ClosedChain(*known, keyframes=keyframes, root=root, noise=noise, step=none)
        own.wide = best.wide
        ((x, y),) = own._covariances_with(pull[:, None])
        y[len(y) - len(own.believed) :] = 0.0
        own.step = ChainStep(x[..., 0].copy(), y[:, 0])
        return own

    @cached_property
    def state(self) -> State:
        """After the closures."""
        return self.wide.moved(self.solution.point, self.step, 1.0)

    def _covariances_with(self, columns: Array, root: SquareRoot | None = None) -> Iterator[tuple[Array, Array]]:
        """Covariances of the chain's keyframes and its border with combinations of e, `TOGETHER` at a time.

        Parameters
        ----------
        columns : ndarray, shape (2 m, k)
        """
        root = self.eliminated() if root is None else root
        P_y, shape = root.border_covariance(self.believed), root.conditionals.shape[:2]
        of_body = transpose(self.solution.point.R_nb[self.keyframes, :2])
        by_position = of_body @ columns.reshape(len(of_body), 2, -1)
        for begin in range(0, columns.shape[1], TOGETHER):
            own = by_position[..., begin : begin + TOGETHER]
            x = np.zeros((*shape, own.shape[2]))
            x[self.keyframes, 3:6] = own
            yield x, root.covariance_with(P_y, x)

    def _about_state(self, keyframes: Sequence[int] | slice) -> Array:
        """Derivative of errors about `state` by those about the chain's optimum, shape (q, d, d)."""
        x = self.step.x[keyframes]
        out = np.tile(np.eye(x.shape[1]), (len(x), 1, 1))
        turned, out[:, :3, :3] = exp_and_right_jacobian(x[:, :3])
        out[:, 3:6, 3:6] = transpose(turned)
        return out

    def _marginals(self) -> tuple[Array, Array]:
        less, less_y = np.zeros((*self.step.x.shape, self.step.x.shape[1])), np.zeros((len(self.step.y),) * 2)
        for x, y in self._covariances_with(self.root):
            less += x @ transpose(x)
            less_y += y @ y.T
        P, P_y = super()._marginals()
        P -= less
        del less
        turn = self._about_state(slice(None))
        return turn @ P @ transpose(turn), self._lessened(P_y, less_y)

    def newest_covariance(self, places: Sequence[int] = ()) -> Array:
        """As `rovgraph.inference.optimum.Optimum`."""
        return self._newest

    @cached_property
    def _newest(self) -> Array:
        return super().newest_covariance()

    def given(self, P: Array, keyframes: Sequence[int], root: SquareRoot | None = None) -> Array:
        """As `ChainOptimum`."""
        parts = self._covariances_with(self.root, root)
        V = np.hstack([np.vstack([x[keyframes].reshape(-1, x.shape[2]), y]) for x, y in parts])
        turn, d = np.eye(len(P)), self.step.x.shape[1]
        for a, own in enumerate(self._about_state(keyframes)):
            turn[a * d : (a + 1) * d, a * d : (a + 1) * d] = own
        return np.asarray(turn @ self._lessened(P, V @ V.T) @ turn.T)

    def _lessened(self, P: Array, less: Array) -> Array:
        """A covariance that ends with what is considered, without its low-rank part."""
        held = len(P) - len(self.believed)
        less[held:, held:] = 0.0
        return np.asarray(P - less)

    def drawn(self, x: Array, y: Array, root: SquareRoot, rng: np.random.Generator) -> Iterator[State]:
        """As `ChainOptimum`; each draw is conditioned on closures that are drawn with it (Matheron's rule)."""
        rows, held = self.solution.point.R_nb[self.keyframes, :2], len(y) - len(self.believed)
        e = (rows @ x[self.keyframes, 3:6]).reshape(len(self.root), -1)
        off = self.root @ (self.root.T @ e) + self.noise @ rng.standard_normal((self.noise.shape[1], x.shape[2]))
        for begin, (by_x, by_y) in enumerate(self._covariances_with(off, root)):
            own = slice(begin * TOGETHER, begin * TOGETHER + by_x.shape[2])
            by_y[held:] = 0.0
            moved_x, moved_y = self.step.x[..., None] - by_x, self.step.y[:, None] - by_y
            yield from super().drawn(x[..., own] + moved_x, y[:, own] + moved_y, root, rng)
