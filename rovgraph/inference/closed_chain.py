"""The optimum of a chain, given loop closures: a low-rank update of the joint covariance of all its variables.

With e the error of north and east at some keyframes, closures say that every variable x of the chain moves by

    x <- x + cov(x, e) pull,   P <- P - V V',   V = cov(x, e) root

(`rovgraph.inference.drift.Drift.shows`). The covariances with e are solves with the chain's factor, forwards and
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

TOGETHER = 16  # columns of V at a time, 2 kB a keyframe
PART = 1024  # keyframes whose V V' are calculated at a time


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
        own.step, own._less = own._solved(pull)
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

    @cached_property
    def _less(self) -> tuple[Array, Array]:
        """V V' of each keyframe, shape (n, d, d), and V of the newest keyframe and the border."""
        return self._solved(np.zeros(len(self.root)))[1]

    def _solved(self, pull: Array) -> tuple[ChainStep, tuple[Array, Array]]:
        """`step` and `_less`, in one pass."""
        V: list[Array] = []
        for x, y in self._covariances_with(np.column_stack([pull, self.root])):
            if not V:
                y[len(y) - len(self.believed) :, 0] = 0.0
                step, less = ChainStep(x[..., 0].copy(), y[:, 0].copy()), np.zeros((*x.shape[:2], x.shape[1]))
                x[..., 0], y[:, 0] = 0.0, 0.0
            for own in (slice(begin, begin + PART) for begin in range(0, len(x), PART)):
                less[own] += x[own] @ transpose(x[own])
            V.append(np.vstack([x[-1], y]))
        return step, (less, np.hstack(V))

    def _marginals(self) -> tuple[Array, Array]:
        (P, P_y), (less, V), turn = super()._marginals(), self._less, self._about_state(slice(None))
        P -= less
        of_border = V[P.shape[1] :]
        return turn @ P @ transpose(turn), self._lessened(P_y, of_border @ of_border.T)

    def given(self, P: Array, keyframes: Sequence[int], root: SquareRoot | None = None) -> Array:
        """As `ChainOptimum`."""
        if root is None:
            V = self._less[1]
        else:
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
