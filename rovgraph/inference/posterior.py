"""Joint covariance of a smoothed dive at any times, and draws of whole trajectories from it.

From the conditionals R_k x_k + S_k x_{k+1} + T_k y = white noise of the chain (`rovgraph.kernels.chain`), the
covariance of keyframes i <= j is

    P_ij = G_i G_{i+1} ... G_{j-1} H_j + X_i P_y X_j',   G_k = -R_k^-1 S_k

with H the covariance where the border is held, X = dx/dy and P_y that of the border, in which what is considered has
its prior. H, X and the products of gains are kept at every `BLOCK`-th keyframe, so that any two keyframes take the
conditionals of two blocks and a product for each block between.

A time t between keyframes has the IMU's motion from the keyframe before and to the keyframe after. Eliminated from the
rows of both, x_t = B_k x_k + B_{k+1} x_{k+1} + D y + noise; the rows that are left are those of the whole motion,
which the chain has already.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array, cross, exp_rotation, log_rotation, rotate, skew
from rovgraph.inference.assumptions import rests_on_doubtful_compass
from rovgraph.inference.chain import MOTION
from rovgraph.inference.chain_information import SquareRoot, solve_upper
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.closed_chain import ClosedChain
from rovgraph.kernels import chain_posterior
from rovgraph.kernels.assembly import FIRST, LAST
from rovgraph.kernels.motion_residual import motion_errors, motion_weights
from rovgraph.kernels.preintegration import SNAPSHOT, preintegrate
from rovgraph.kernels.states import States
from rovgraph.model.state import POSE, State
from rovgraph.problem.initial_conditions import InitialConditions
from rovgraph.problem.motion import SCALES
from rovgraph.problem.problem import Index

BLOCK = 64  # keyframes between those whose H and X are kept
KEPT = 25_000  # keyframes whose conditionals are kept, an hour at 7 Hz: some 7 kB each
HERE_S = 1e-6  # from a keyframe, within which a time is the keyframe's
LINEARISATIONS = 2  # between keyframes, the first where states are interpolated
DRAWN = 250_000  # states that are drawn at a time

ROTATION, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)


def displaced_by_heading(cov_p_heading: Array) -> Array:
    """Where the second-order part of a heading error puts a position, one sd, shape (n, 2) [m].

    `rovgraph.inference.estimate.second_order` is its square; all epochs move together.

    Parameters
    ----------
    cov_p_heading : ndarray, shape (n, 2), covariance of north and east with the heading [m rad]
    """
    return np.asarray(np.sqrt(0.75) * cov_p_heading[:, ::-1] * (1.0, -1.0))


@dataclass(frozen=True)
class ChainMarginals:
    """An eliminated chain of n keyframes, from which the joint covariance of some follows quickly.

    Attributes
    ----------
    root : its square-root information, all conditionals
    P_y : ndarray, shape (c, c), covariance of the border
    stops : ndarray of int, shape (s,), increasing, every `BLOCK`-th keyframe and the last
    H, X : ndarray, shapes (s, d, d), (s, d, c), covariance where the border is held and derivative by it, there
    gain : ndarray, shape (s - 1, d, d), derivative by the next stop where the border is held
    """

    root: SquareRoot
    P_y: Array
    stops: Index
    H: Array
    X: Array
    gain: Array

    @staticmethod
    def of(root: SquareRoot, P_y: Array) -> "ChainMarginals":
        """What follows from a square root with all conditionals, in one pass backwards."""
        (n, d), c, last = root.conditionals.shape[:2], len(P_y), root.conditionals[-1]
        stops = np.unique(np.append(np.arange(0, n, BLOCK), n - 1))
        H, X, gain = np.empty((len(stops), d, d)), np.empty((len(stops), d, c)), np.empty((len(stops) - 1, d, d))
        inverse = np.asarray(np.linalg.inv(last[:, :d]))
        H[-1], X[-1] = inverse @ inverse.T, -inverse @ last[:, 2 * d : 2 * d + c]
        chain_posterior.propagate_back(root.conditionals, stops, H, X, gain)
        return ChainMarginals(root, P_y, stops, H, X, gain)

    def joint(self, keyframes: Sequence[int]) -> Array:
        """Joint covariance of m keyframes, increasing, and the border, shape (m d + c, m d + c)."""
        H, X, gains = self._at(keyframes)
        m, d, c = X.shape
        S = X.reshape(m * d, c)
        cross_y = S @ self.P_y
        P = np.block([[cross_y @ S.T, cross_y], [cross_y.T, self.P_y]])
        for j in range(m):
            own, held = slice(j * d, (j + 1) * d), H[j]
            P[own, own] += held
            for i in range(j - 1, -1, -1):
                held = gains[i] @ held
                P[i * d : (i + 1) * d, own] += held
                P[own, i * d : (i + 1) * d] += held.T
        return P

    def _at(self, keyframes: Sequence[int]) -> tuple[Array, Array, list[Array]]:
        """H, X and the gains between each two of them."""
        H, X, gains = [], [], []
        end, product = int(self.stops[-1]), np.eye(self.H.shape[1])
        blocks = np.searchsorted(self.stops[:-1], [keyframes[0], keyframes[-1]], side="right") - 1
        for block in range(blocks[0], blocks[1] + 1):
            begin, close = self.stops[block : block + 2].tolist()
            own = [k for k in keyframes if begin <= k < close or k == close == end]
            if not own:
                product = product @ self.gain[block]
                continue
            stops = np.unique([begin, *own, close])
            H_own, X_own = (np.repeat(whole[[block + 1]], len(stops), axis=0) for whole in (self.H, self.X))
            gain = np.empty((len(stops) - 1, *product.shape))
            chain_posterior.propagate_back(self.root.conditionals, stops, H_own, X_own, gain)
            for place, k in enumerate(stops.tolist()):
                if k in own:
                    gains.append(product)
                    H.append(H_own[place])
                    X.append(X_own[place])
                    product = np.eye(len(product))
                if place < len(gain):
                    product = product @ gain[place]
        return np.array(H), np.array(X), gains[1:]


@dataclass(eq=False)
class Posterior:
    """The smoothed dive as a normal distribution of all its states, to be asked at any times.

    Nothing is computed until it is asked. Conditionals of dives of up to `KEPT` keyframes are kept then; longer dives
    are eliminated for every question, and H, X and gains are kept.

    Attributes
    ----------
    optimum, initial : the dive
    relative_sd : name -> ndarray, shape (dim,), sd of the calibration as a part of the prior's, as
        `rovgraph.inference.observability.without_what_noise_moves` has it
    displaced : ndarrays, shape (n, 2), one sd each of errors in north and east that move all keyframes together, such
        as where another explanation of the data puts them [m]
    """

    optimum: ChainOptimum
    initial: InitialConditions
    relative_sd: Mapping[str, Array] = field(default_factory=dict)
    displaced: tuple[Array, ...] = ()
    _kept: ChainMarginals | None = field(default=None, repr=False)

    @staticmethod
    def of(
        best: ChainOptimum, initial: InitialConditions, relative_sd: Mapping[str, Array] | None = None
    ) -> "Posterior":
        """That of an optimum, without the memory of its elimination."""
        own = replace(best, at_hand=None)
        own.wide = best.wide
        return Posterior(own, initial, relative_sd or {})

    def also(self, displaced: Array) -> "Posterior":
        """With one more of `displaced`."""
        return replace(self, displaced=(*self.displaced, displaced))

    @property
    def time(self) -> Array:
        """Of the keyframes, shape (n,) [s]."""
        return self.optimum.problem.time

    def at(self, time: Array) -> tuple[Array, Array]:
        """Joint covariance of the body's origin at some times, and its attitude.

        Parameters
        ----------
        time : ndarray, shape (q,), within the keyframes' [s]

        Returns
        -------
        P : ndarray, shape (15 q, 15 q), rotation, position, velocity, accelerometer and gyro bias of each time, in the
            tangent space of `rovgraph`
        R_nb : ndarray, shape (q, 3, 3)
        """
        times, which = np.unique(time, return_inverse=True)
        marginals = self._marginals()
        layout = self.optimum.wide.layout
        before, inside = self._places(times)
        keyframes = sorted({*before.tolist(), *(before[inside] + 1).tolist()})
        place = {k: slice(a * layout.d, a * layout.d + MOTION) for a, k in enumerate(keyframes)}
        q, border = len(times), len(keyframes) * layout.d
        L, noise, states = np.zeros((q, MOTION, border + layout.c)), np.zeros((q * MOTION,) * 2), []
        for k in np.unique(before).tolist():
            own = np.flatnonzero((before == k) & inside)
            for a in np.flatnonzero((before == k) & ~inside):
                L[a, :, place[k]] = np.eye(MOTION)
                states.append(self._state(k, self.time[k : k + 1]))
            if len(own):
                state, step = self._state(k, times[own]), np.zeros((len(own), MOTION))
                for _ in range(LINEARISATIONS):
                    state = _moved(state, step)
                    B, D, Q, step = self._between(k, times[own], state)
                L[own, :, place[k]], L[own, :, place[k + 1]] = B[..., :MOTION], B[..., MOTION:]
                if D is not None:
                    targets = np.concatenate([layout.target(name) for name in SCALES if name in layout.places])
                    columns = np.where(targets < layout.d, place[k].start + targets, border + targets - layout.d)
                    for a, by_scale in zip(own, D, strict=True):
                        L[a][:, columns] += by_scale
                rows = (own[:, None] * MOTION + np.arange(MOTION)).ravel()
                noise[np.ix_(rows, rows)] = Q
                states.append(state)
        by_known = L.reshape(q * MOTION, -1)
        joint = self.optimum.given(marginals.joint(keyframes), keyframes, marginals.root)
        P = by_known @ joint @ by_known.T + noise
        R_nb, bias = (np.concatenate([getattr(s, name) for s in states]) for name in ("R_nb", "bias"))
        P = self._at_origin(P, times, R_nb, bias)
        P = self._displaced(P, times, R_nb)
        rows = (which.reshape(-1)[:, None] * MOTION + np.arange(MOTION)).ravel()
        return P[np.ix_(rows, rows)], R_nb[which.reshape(-1)]

    def horizontal(self, keyframes: Sequence[int]) -> Array:
        """Joint covariance of the IMU's north and east at m keyframes, increasing, shape (2 m, 2 m) [m^2]."""
        P, best = self.of_chain(keyframes), self.optimum
        if isinstance(best, ClosedChain):
            every = np.union1d(keyframes, best.keyframes)
            whole, closed = self.of_chain(every.tolist()), 2 * np.searchsorted(every, best.keyframes)
            own = 2 * np.searchsorted(every, keyframes)
            V = whole[np.ix_((own[:, None] + (0, 1)).ravel(), (closed[:, None] + (0, 1)).ravel())] @ best.root
            P -= V @ V.T
        for one in self._all_displaced():
            u = one[np.asarray(keyframes)].ravel()
            P += np.outer(u, u)
        return P

    def of_chain(self, keyframes: Sequence[int]) -> Array:
        """As `horizontal`, of the chain without closures and without `displaced`."""
        known, R_nb = self._marginals(), self.optimum.solution.point.R_nb
        H, X, gains = known._at(keyframes)
        m, rows = len(keyframes), R_nb[np.asarray(keyframes), :2]
        S = (rows @ X[:, POSITION]).reshape(2 * m, -1)
        P, later = S @ known.P_y @ S.T, np.empty((H.shape[1], 0))
        for k in range(m - 1, -1, -1):
            own = H[k][:, POSITION] @ rows[k].T
            later = np.hstack([own, gains[k] @ later if k < m - 1 else later])
            held = rows[k] @ later[POSITION]
            P[2 * k : 2 * k + 2, 2 * k :] += held
            P[2 * k + 2 :, 2 * k : 2 * k + 2] += held[:, 2:].T
        return P

    def draw(self, count: int, rng: np.random.Generator) -> Iterator[tuple[State, Array]]:
        """States at the IMU from the distribution, and the displacement of their positions in n, shape (n, 3)."""
        root, wide, believed = self._marginals().root, self.optimum.wide, self._believed
        n, d, held = len(self.time), wide.layout.d, len(believed)
        free, R = len(root.border) - held, root.border
        known = self._all_displaced()
        while count > 0:
            some = min(count, max(DRAWN // n, 1))
            y = rng.standard_normal((len(R), some))
            y[free:] *= np.sqrt(np.diagonal(believed))[:, None]
            if free:
                y[:free] = solve_upper(R[:free, :free], y[:free] - R[:free, free:-1] @ y[free:])
            x = rng.standard_normal((n, d, some))
            chain_posterior.back_substitute(root.conditionals, y, x)
            for state in self.optimum.drawn(x, y, root, rng):
                moved = np.zeros((n, 3))
                for one in known:
                    moved[:, :2] += rng.standard_normal() * one
                yield state, moved
            count -= some

    def _marginals(self) -> ChainMarginals:
        known = self._kept
        if known is not None and len(known.root.conditionals):
            return known
        root = self.optimum.eliminated()
        self.optimum.at_hand = None  # it is kept here, or nowhere
        known = replace(known, root=root) if known else ChainMarginals.of(root, root.border_covariance(self._believed))
        short = len(self.time) <= KEPT
        self._kept = known if short else replace(known, root=replace(root, conditionals=root.conditionals[:0].copy()))
        return known

    @property
    def _believed(self) -> Array:
        return self.optimum.believed

    def _places(self, times: Array) -> tuple[Index, NDArray[np.bool_]]:
        """Keyframe at each time or before it, and whether the time lies between keyframes."""
        known = self.time
        nearest = np.clip(np.searchsorted(known, times - HERE_S), 0, len(known) - 1)
        here = np.abs(known[nearest] - times) <= HERE_S
        before = np.where(here, nearest, np.searchsorted(known, times, side="right") - 1)
        return before.astype(np.int64), np.logical_not(here)

    def _state(self, k: int, times: Array) -> State:
        """States at times from keyframe k to the next, interpolated."""
        state, last = self.optimum.state, min(k + 1, len(self.time) - 1)
        share = ((times - self.time[k]) / max(self.time[last] - self.time[k], HERE_S))[:, None]
        turn = log_rotation(state.R_nb[k].T @ state.R_nb[last])
        p, v, bias = (a[k] + share * (a[last] - a[k]) for a in (state.p_n, state.v_n, state.bias))
        return State(state.R_nb[k] @ exp_rotation(share * turn), p, v, bias, {})

    def _between(self, k: int, times: Array, state: State) -> tuple[Array, Array | None, Array, Array]:
        """States at q times between keyframe k and the next, as these have it, linearised at some.

        Returns
        -------
        B : ndarray, shape (q, 15, 30), derivative by both keyframes
        D : ndarray, shape (q, 15, 6), derivative by the IMU's scales, or None where they are exact
        Q : ndarray, shape (15 q, 15 q), covariance of what the IMU's noise adds
        step : ndarray, shape (q, 15), to where the IMU has them
        """
        problem, whole, q = self.optimum.wide.problem, self.optimum.state, len(times)
        ends, order = whole.at(slice(k, k + 2)), [0, *range(2, q + 2), 1]
        stack = [np.concatenate([a, b])[order] for a, b in zip(_arrays(ends), _arrays(state), strict=True)]
        scaled = len(problem.scales) > 0
        if scaled:
            scales = [np.broadcast_to(whole.calibration[name], (len(self.time), 3))[k] for name in SCALES]
            stack[3] = stack[3] + problem.scales[k] @ np.concatenate(scales)
        motions, S, W = np.repeat(problem.motions[[k]], q + 1, axis=0), *np.empty((2, q + 1, MOTION, MOTION))
        first, last = (problem.keyframes[k + 1, [FIRST, LAST]].astype(int) - problem.forgotten).tolist()
        imu, none, stops = np.ascontiguousarray(problem.imu[first:last]), np.empty(0), np.empty((0, SNAPSHOT))
        at = [float(self.time[k]), *times.tolist(), float(self.time[k + 1])]
        for a in range(q + 1):
            preintegrate(imu, at[a], at[a + 1], none, motions[a], S[a], stops)
        motion_weights(motions, S, W)
        r, A_i, A_j = np.empty((q + 1, MOTION)), *np.empty((2, q + 1, MOTION, MOTION))
        R_nb, p_n, v_n, bias = (np.ascontiguousarray(a) for a in stack)
        none_estimated = np.empty((1, 0))
        before = States(R_nb[:-1], p_n[:-1], v_n[:-1], bias[:-1], none_estimated)
        after = States(R_nb[1:], p_n[1:], v_n[1:], bias[1:], none_estimated)
        motion_errors(motions, before, after, r, A_i, A_j)
        rows = np.zeros((q + 1, MOTION, q + 2, MOTION))
        for a in range(q + 1):
            rows[a, :, a], rows[a, :, a + 1] = W[a] @ A_i[a], W[a] @ A_j[a]
        by_bias = W @ (A_i + A_j)[..., 9:]
        own, size = [*range(1, q + 1), 0, q + 1], q * MOTION
        whitened = -W @ r[..., None]
        J = np.concatenate(
            [
                rows[:, :, own].reshape(*rows.shape[:2], -1),
                *([by_bias @ problem.scales[k]] if scaled else []),
                whitened,
            ],
            axis=2,
        )
        R: Array = np.asarray(np.linalg.qr(J.reshape(-1, J.shape[2]), mode="r"))[:size]
        root = np.asarray(np.linalg.inv(R[:, :size]))
        gain = (-root @ R[:, size:-1]).reshape(q, MOTION, -1)
        known = [n for n in SCALES if n in self.optimum.wide.layout.places]
        columns = [2 * MOTION + 3 * SCALES.index(name) + i for name in known for i in range(3)]
        by_scale = gain[..., columns] if scaled and known else None
        return gain[..., : 2 * MOTION], by_scale, root @ root.T, (root @ R[:, -1]).reshape(q, MOTION)

    def _at_origin(self, P: Array, times: Array, R_nb: Array, bias: Array) -> Array:
        """From the IMU to the body's origin, as `rovgraph.inference.estimate.body_trajectory` takes states there."""
        arm, problem = np.asarray(self.initial.config.imu.lever_arm_m, float), self.optimum.problem
        rate_b = np.stack([np.interp(times, self.time, axis) for axis in problem.rate_b.T], axis=-1) - bias[:, 3:]
        rate_sd = np.interp(times, self.time, problem.rate_sd)
        moves, noise = np.eye(len(times) * MOTION), np.zeros((len(times) * MOTION, len(times) * MOTION))
        for k, (R, velocity_b, sd) in enumerate(zip(R_nb, cross(rate_b, arm), rate_sd, strict=True)):
            own = slice(k * MOTION, (k + 1) * MOTION)
            A, Q = moves[own, own], noise[own, own]
            A[POSITION, ROTATION] = skew(arm)
            A[VELOCITY, ROTATION], A[VELOCITY, 12:] = R @ skew(velocity_b), -R @ skew(arm)
            Q[VELOCITY, VELOCITY] = sd**2 * (R @ skew(arm)) @ (R @ skew(arm)).T
        return np.asarray(moves @ P @ moves.T + noise)

    def _displaced(self, P: Array, times: Array, R_nb: Array) -> Array:
        """With what displaces all positions together, to what `body_trajectory` has."""
        q, known = len(times), []
        if rests_on_doubtful_compass(self.initial):
            blocks = [P[a * MOTION : (a + 1) * MOTION][:, a * MOTION : (a + 1) * MOTION] for a in range(q)]
            both = [R @ own[POSITION, ROTATION] @ R.T for R, own in zip(R_nb, blocks, strict=True)]
            known.append(displaced_by_heading(np.array(both)[:, :2, 2]))
        for one in self.displaced:
            known.append(np.stack([np.interp(times, self.time, axis) for axis in one.T], axis=-1))
        for one in known:
            u = np.zeros((q, MOTION))
            u[:, POSITION] = rotate(np.swapaxes(R_nb, 1, 2), np.column_stack([one, np.zeros(q)]))
            P = P + np.outer(u, u)
        return P

    def _all_displaced(self) -> list[Array]:
        """The same at all keyframes, shape (n, 2) each."""
        if not rests_on_doubtful_compass(self.initial):
            return [*self.displaced]
        P = self.optimum.covariances()[POSE]
        self.optimum.at_hand = None
        R, arm = self.optimum.state.R_nb, skew(np.asarray(self.initial.config.imu.lever_arm_m))
        both = R @ (arm @ P[:, :3, :3] + P[:, 3:, :3]) @ np.swapaxes(R, 1, 2)
        return [displaced_by_heading(both[:, :2, 2]), *self.displaced]


def _moved(state: State, step: Array) -> State:
    """States of n epochs moved by steps of shape (n, 15)."""
    p_n = state.p_n + rotate(state.R_nb, step[:, POSITION])
    v_n, bias = state.v_n + step[:, VELOCITY], state.bias + step[:, 9:]
    return State(state.R_nb @ exp_rotation(step[:, ROTATION]), p_n, v_n, bias, state.calibration)


def _arrays(state: State) -> tuple[Array, Array, Array, Array]:
    return state.R_nb, state.p_n, state.v_n, state.bias
