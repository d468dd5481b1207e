"""Square-root information of a chain of keyframes with a border of constants: solution, covariances, sensitivities.

This is the interface to `rovgraph.kernels.chain` and `rovgraph.kernels.chain_posterior`. Right-hand sides are minus the
residuals where a Gauss-Newton step is wanted. Considered variables (Schmidt) come last in the border:
`SquareRoot.solve` and `SquareRoot.border_covariance` take their number, or their covariance. `eliminate` takes whitened
rows that are given, for studies of the solver.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from rovgraph.geometry import Array, transpose
from rovgraph.kernels import chain, chain_posterior
from rovgraph.kernels.chain import Elimination, PlacedRows, Walks
from rovgraph.kernels.compile import Index
from rovgraph.kernels.elimination import LinearMotions
from rovgraph.kernels.elimination import eliminate as eliminate_rows

EVERY = slice(None)


class UndeterminedError(Exception):
    """The rows do not determine some component.

    Attributes
    ----------
    keyframe : its keyframe, or None where it belongs to the border
    component : within the keyframe or the border
    """

    def __init__(self, keyframe: int | None, component: int) -> None:
        where = "the border" if keyframe is None else f"keyframe {keyframe}"
        super().__init__(f"the rows do not determine component {component} of {where}")
        self.keyframe, self.component = keyframe, component


class MeasurementRows:
    """Whitened rows of measurements at n keyframes, of any number of sensors.

    A prior of a keyframe is a measurement of it.

    Parameters
    ----------
    n, s : number of keyframes, and of their components that rows have columns for
    keyframes : for each sensor an ndarray of int, shape (m,)
    dims : for each sensor the dimension of a measurement
    others : the largest number of other columns that any sensor has

    Attributes
    ----------
    values, targets, first : as `rovgraph.kernels.elimination.eliminate` takes them
    """

    def __init__(self, n: int, s: int, keyframes: Sequence[Index], dims: Sequence[int], others: int) -> None:
        keyframe = np.concatenate([np.zeros(0, dtype=np.int64), *keyframes])
        dim = np.repeat(np.array(dims, dtype=np.int64), [len(k) for k in keyframes])
        order = np.argsort(keyframe, kind="stable")
        begins = np.empty(len(keyframe), dtype=np.int64)
        begins[order] = np.cumsum(dim[order]) - dim[order]
        self._begins = np.split(begins, np.cumsum([len(k) for k in keyframes])[:-1])
        self.first = np.concatenate([[0], np.cumsum(np.bincount(keyframe, dim, n))]).astype(np.int64)
        self.values = np.zeros((self.first[-1], s + others + 1))
        self.targets = np.full((self.first[-1], others), -1, dtype=np.int64)

    def put(
        self, sensor: int, r: Array, J: Array, C: Array, targets: Index, weight: Array, part: slice = EVERY
    ) -> None:
        """Rows of a sensor's measurements, in place of those it had.

        Parameters
        ----------
        sensor : its place in ``keyframes``
        r : ndarray, shape (m, dim), right-hand sides
        J : ndarray, shape (m, dim, s), Jacobians by the keyframe
        C, targets : ndarray, shapes (m, dim, e) and (e,), Jacobians by other columns
        weight : ndarray, shape (m,), of squares: 0 takes a measurement out
        part : which of the sensor's measurements they are
        """
        packed = np.ascontiguousarray
        begins, rows = self._begins[sensor][part], (self.values, self.targets)
        chain.place_rows(packed(r), packed(J), packed(C), packed(targets), packed(weight), begins, *rows)


@dataclass(frozen=True)
class SquareRoot:
    """Square-root information of n keyframes of d components and a border of c.

    Attributes
    ----------
    conditionals : ndarray, shape (n, d, 2 d + c + 1), R, S, T and z of every keyframe, or (1, ...) of the last one, or
        (n, d, 1), R's diagonal alone
    border : ndarray, shape (c, c + 1), R and z of the border
    left : sum of squares at the minimum
    filtered : ndarray, shape (f, d + c, d + c + 1), R and z of a keyframe and the border, of the data up to it
    """

    conditionals: Array
    border: Array
    left: float
    filtered: Array = field(repr=False)

    def solve(self, held: int = 0) -> tuple[Array, Array]:
        """Where the sum of squares is least, the border's last components held at 0.

        Returns
        -------
        ndarray, shape (n, d), of the keyframes
        ndarray, shape (c,), of the border
        """
        free, y = len(self.border) - held, np.zeros(len(self.border))
        y[:free] = solve_upper(self.border[:free, :free], self.border[:free, -1])
        return self.followed(y), y

    def followed(self, y: Array) -> Array:
        """Keyframes where the sum of squares is least with a border of shape (c,), shape (n, d)."""
        x = self.conditionals[:, :, -1:].copy()
        chain_posterior.back_substitute(self.conditionals, y[:, None], x)
        return x[..., 0]

    def border_with(self, free: Index, y: Array, score: Array | None = None, unforced: bool = False) -> Array:
        """The border where the sum of squares is least, less twice its product with a score; shape (c,).

        Parameters
        ----------
        free : ndarray of int, components that may move
        y : ndarray, shape (c,), where the others are held; what it has of the free ones is ignored
        score : ndarray, shape (c,), log likelihood of a unit of each beyond that of the rows
        unforced : of rows without right-hand sides: by how much the others move for those that are held
        """
        out, R, z = y.copy(), self.border[:, :-1], self.border[:, -1]
        out[free] = 0.0
        Q, R_free = np.linalg.qr(R[:, free])
        rest = Q.T @ ((0.0 if unforced else z) - R @ out)
        if score is not None:
            rest += np.linalg.solve(R_free.T, score[free])
        out[free] = solve_upper(R_free, rest)
        return out

    def move_to(self, y: Array) -> None:
        """Count errors from a border y, shape (c,), and the keyframes that follow it (`followed`), in place."""
        self.conditionals[:, :, -1] = 0.0
        self.border[:, -1] -= self.border[:, :-1] @ y

    def explained(self, held: int = 0) -> float:
        """Half of what the minimum takes off the sum of squares, the border's last components held; of all
        conditionals."""
        z, z_y = self.conditionals[:, :, -1], self.border[: len(self.border) - held, -1]
        return 0.5 * float(np.sum(z * z) + z_y @ z_y)

    @cached_property
    def x_by_y(self) -> Array:
        """Derivative of the keyframes' optimum by the border, shape (n, d, c)."""
        n, d, c = *self.conditionals.shape[:2], len(self.border)
        out = np.zeros((n, d, c))
        chain_posterior.back_substitute(self.conditionals, np.eye(c), out)
        return out

    def border_covariance(self, believed: Array | None = None) -> Array:
        """Covariance of the border, shape (c, c).

        Parameters
        ----------
        believed : ndarray, shape (h, h), covariance of its last components, which are held and not estimated
        """
        held = 0 if believed is None else len(believed)
        free = len(self.border) - held
        R = self.border[:free, :free]
        root = solve_upper(R, np.eye(free))
        P = np.zeros((len(self.border), len(self.border)))
        P[:free, :free] = root @ root.T
        if believed is not None:
            gain = np.vstack([-solve_upper(R, self.border[:free, free:-1]), np.eye(held)])
            P += gain @ believed @ gain.T
        return P

    def covariance_with(self, P_y: Array, x: Array) -> Array:
        """Covariance of the border with m combinations of keyframes, shape (c, m); that of the keyframes in place of x.

        Parameters
        ----------
        P_y : ndarray, shape (c, c), of the border
        x : ndarray, shape (n, d, m), the combinations
        """
        y = np.zeros((len(P_y), x.shape[2]))
        chain_posterior.forward_substitute(self.conditionals, x, y)
        y = np.ascontiguousarray(P_y @ y)
        chain_posterior.back_substitute(self.conditionals, y, x)
        return y

    def covariances(self, P_y: Array) -> Array:
        """Marginal covariances of the keyframes, shape (n, d, d).

        Parameters
        ----------
        P_y : ndarray, shape (c, c), of the border
        """
        return self._covariances(P_y, 0, 0)[0]

    def turn_into_covariances(self, P_y: Array) -> Array:
        """As `covariances`, in the memory of ``conditionals``, which are lost: of a long dive both would be large.

        They are written from the last keyframe backwards into the end of it, over conditionals that have been read.
        """
        (n, d), values = self.conditionals.shape[:2], self.conditionals.reshape(-1)
        size, none = n * d * d, np.empty((0, d, d))
        P = values[-size:].reshape(n, d, d)
        cross = np.empty((0, d, len(self.border)))
        chain_posterior.covariances(self.conditionals, np.ascontiguousarray(P_y), P, cross, none)
        values[:size] = values[-size:]
        self.conditionals.resize((n, d, d), refcheck=False)
        return self.conditionals

    def joint_covariances(self, P_y: Array) -> tuple[Array, Array, Array]:
        """As `covariances`, with the border, shape (n, d, c), and with keyframes after them, shape (n - 1, d, d)."""
        n = len(self.conditionals)
        return self._covariances(P_y, n, n - 1)

    def _covariances(self, P_y: Array, crosses: int, followings: int) -> tuple[Array, Array, Array]:
        (n, d), c = self.conditionals.shape[:2], len(self.border)
        P, cross, following = np.empty((n, d, d)), np.empty((crosses, d, c)), np.empty((followings, d, d))
        chain_posterior.covariances(self.conditionals, np.ascontiguousarray(P_y), P, cross, following)
        return P, cross, following

    def filtered_covariances(self, held: Sequence[int] = (), believed: Array | None = None) -> Array:
        """Joint covariances of a keyframe and the border, of the data up to it, shape (f, d + c, d + c).

        Parameters
        ----------
        held, believed : components that are held and not estimated, and their covariance, shape (h, h)
        """
        R = self.filtered[:, :, :-1]
        if believed is None or not len(held):
            root = np.asarray(np.linalg.inv(R), dtype=float)
            return root @ transpose(root)
        free, out = np.setdiff1d(np.arange(R.shape[1]), held), np.zeros_like(R)
        R = np.asarray(np.linalg.qr(R[:, :, [*free, *held]], mode="r"), dtype=float)
        of_free = slice(0, len(free))
        root = np.asarray(np.linalg.inv(R[:, of_free, of_free]), dtype=float)
        gain = np.asarray(-root @ R[:, of_free, len(free) :], dtype=float)
        out[:, free[:, None], free] = root @ transpose(root) + gain @ believed @ transpose(gain)
        out[:, np.array(held)[:, None], held] = believed
        return out

    def newest_covariance(self, P_y: Array) -> Array:
        """Joint covariance of the last keyframe and the border, shape (d + c, d + c); ``P_y`` is that of the border."""
        last, c = self.conditionals[-1], len(self.border)
        d = len(last)
        root = solve_upper(last[:, :d], np.eye(d))
        X = -root @ last[:, 2 * d : 2 * d + c]
        cross = X @ P_y
        return np.block([[root @ root.T + cross @ X.T, cross], [cross.T, P_y]])

    def draw(self, white: Array) -> Array:
        """A draw of the keyframes' error where the border is held, from white noise, shape (n, d)."""
        out = white[:, :, None].copy()
        chain_posterior.back_substitute(self.conditionals, np.zeros((len(self.border), 1)), out)
        return out[..., 0]

    def log_determinant(self, held: int = 0) -> float:
        """Of the information of keyframes and border, the border's last components held."""
        R = self.conditionals[:, :, : self.conditionals.shape[1]]
        diagonals = R[:, :, 0] if R.shape[2] == 1 else np.einsum("kii->ki", R)
        border = np.diagonal(self.border)[: len(self.border) - held]
        return 2.0 * float(np.log(np.abs(diagonals)).sum() + np.log(np.abs(border)).sum())

    def least(self, held: int = 0) -> float:
        """The least sum of squares, the border's last components held at 0."""
        z = self.border[len(self.border) - held :, -1]
        return self.left + float(z @ z)


def square_root(
    n: int,
    d: int,
    c: int,
    stops: int,
    fill: Callable[[Array, Array, Array, Array], int],
    kept: int | None = None,
    diagonal: bool = False,
) -> SquareRoot:
    """Square-root information of n keyframes of d components and a border of c.

    Parameters
    ----------
    stops : number of keyframes at which to keep what is known
    fill : writes ``conditionals_out`` to ``left_out`` and returns, as `rovgraph.kernels.elimination.eliminate`
    kept : keyframes whose conditionals are kept, None = all, 1 = the last
    diagonal : nothing is kept of them but R's diagonal

    Raises
    ------
    UndeterminedError : the rows do not determine some component
    """
    width = 1 if diagonal else 2 * d + c + 1
    conditionals, border = np.empty((n if kept is None else kept, d, width)), np.empty((c, c + 1))
    filtered, left = np.empty((stops, d + c, d + c + 1)), np.empty(1)
    failing = fill(conditionals, border, filtered, left)
    if failing >= n * d:
        raise UndeterminedError(None, failing - n * d)
    if failing >= 0:
        raise UndeterminedError(*divmod(failing, d))
    return SquareRoot(conditionals, border, float(left[0]), filtered)


def solve_upper(R: Array, rhs: Array) -> Array:
    """R^-1 of a right-hand side, R upper triangular: LU leaves such a matrix as it is."""
    return np.asarray(np.linalg.solve(R, rhs))


@dataclass(frozen=True)
class MotionRows:
    """Whitened rows of the motions between n keyframes, of s components that move and d - s that walk.

    Attributes
    ----------
    A : ndarray, shape (n - 1, s, 2 (s + 1)), columns of the keyframe before, right-hand sides, columns of the keyframe
        after, and one that is not read
    C, targets : ndarray, shapes (n - 1, s, e) and (e,), Jacobians by other columns (see `rovgraph.kernels.chain`)
    walk, kept, walk_r : ndarray, shape (n - 1, d - s), one over the sd of a walk, what it keeps of the value before,
        and right-hand sides
    """

    A: Array
    C: Array
    targets: Index
    walk: Array
    kept: Array
    walk_r: Array

    @staticmethod
    def of_states(A_i: Array, A_j: Array, r: Array) -> "MotionRows":
        """Rows of motions without random walks and without columns of the border.

        Parameters
        ----------
        A_i, A_j : ndarray, shape (n - 1, s, s), Jacobians by the keyframes before and after
        r : ndarray, shape (n - 1, s), right-hand sides
        """
        count, s = r.shape
        A, none = np.concatenate([A_i, r[..., None], A_j, np.zeros((count, s, 1))], axis=2), np.zeros((count, 0))
        return MotionRows(A, np.zeros((count, s, 0)), np.zeros(0, dtype=np.int64), none, none, none)


def eliminate(
    motions: MotionRows, measurements: MeasurementRows, border_rows: Array, stops: Sequence[int] = ()
) -> SquareRoot:
    """Eliminate the keyframes in the order of time, then the border.

    Parameters
    ----------
    motions, measurements : the rows of n keyframes
    border_rows : ndarray, shape (p, c + 1), priors of the border with their right-hand sides
    stops : increasing, keyframes at which to keep the information of the rows so far (`SquareRoot.filtered`)

    Raises
    ------
    UndeterminedError : the rows do not determine some component
    """
    m, n, c = motions, len(measurements.first) - 1, border_rows.shape[1] - 1
    rows = PlacedRows(measurements.values, measurements.targets, measurements.first)
    kept_at = np.array(stops, dtype=np.int64)

    def fill(conditionals: Array, border: Array, filtered: Array, left: Array) -> int:
        linear, walks = LinearMotions(m.A, m.C, m.targets), Walks(m.walk, m.kept, m.walk_r)
        return eliminate_rows(
            linear, walks, rows, border_rows, Elimination(kept_at, conditionals, border, filtered, left)
        )

    return square_root(n, m.A.shape[1] + m.walk.shape[1], c, len(stops), fill)
