"""Crossovers: where a survey crosses its own lines, or runs one again, its soundings must agree.

The bottom is a Gaussian process, z(x) = relief + plane, with a Matern covariance

    k(r) = s^2 (1 + q) exp(-q),   q = sqrt(3) r / l

whose sd s and length l are fitted to the soundings along the lines first, with their noise; relief that does not exceed
it is of no use. A crossing of a line A with an earlier line B has the unknown shift d = e(a) - e(b), the difference of
the track's errors, north and east, when it was where they cross. Its likelihood is a field over d,

    L(d) = log p(z_A | z_B, d) - log p(z_A | z_B, no common relief)

in which heights and slopes of both lines about the crossing are their own: tide, depth sensor and trim. One field has
many peaks, a third to a half of the highest are wrong. So a line is matched as a whole with all earlier ones: shifts
of all its crossings are correlated by the joint covariance of the track, and the search keeps the `KEPT` best
combinations of peaks. Used is what all combinations within `LEAD` of the best have in common, at three crossings or
more. What a field says of its crossing's shift, beside what the track and the other crossings say of it, is found by
expectation propagation (Minka 2001): its moments about the match, not the curvature at its peak, are the noise of a
tie between two keyframes.

Rotation and scale of the whole track leave no shift where it crosses itself: crossovers cannot see them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array

if TYPE_CHECKING:
    from rovgraph.inference.bottom import Bottom
    from rovgraph.inference.estimate import Estimate

CELL_M = 2.0  # of a line, along and across, within which soundings are averaged
LINE_M, LINE_S = 20.0, 15.0  # shortest line
STRAIGHT_S, STRAIGHT = 10.0, 0.98  # a line: mean resultant of the heading around each moment
BEND = np.cos(np.pi / 4.0)  # from where it began, at which a line ends
PIECE_M = 25.0  # of a line that is run again, matched by itself
BESIDE_M = 6.0  # from the crossing and the range of the search, soundings that show something
MOST = 60  # soundings of either line at a crossing
LENGTHS_M = np.geomspace(1.0, 30.0, 12)  # of relief
NOISES = np.geomspace(1e-3, 10.0, 17)  # variance of a sounding over that of the relief
STRETCH, STRETCHES = 32, 60  # cells of a stretch, and stretches, to which relief is fitted
PLANE, SLOPE = 10.0, 0.1  # sd of a line's plane about a crossing: height over that of the relief, slope
GRID, FINEST_M, COARSEST_M = 0.2, 0.4, 1.2  # step of a field: of the relief's length, its limits
SIGMAS, FARTHEST_M = 3.5, 20.0  # range of the search about what is predicted
KEPT = 100  # combinations
PEAK_SD = 0.3  # of a peak on the grid [m]
FALSE = 0.05  # part of crossings whose soundings are not those of the bottom
LEAD = 10.0  # nats
ENOUGH = 3  # crossings
SAME_M = 2.5  # shifts closer than that are the same
KNOT_S, KNOTS = 10.0, 1000  # between knots of the drift, and how many at most
SHOWS = 1.0  # nats, of a crossing that counts
ALIKE = 0.6  # correlation of a profile with itself further on, from which the bottom repeats itself
MISFIT = 1.5  # of the soundings' squared residuals, over what is expected
FINE_M = 0.25  # step of a field about its match
LEAST = 1e-6  # information that a field may have [1/m^2]


@dataclass(frozen=True)
class Line:
    """Soundings along a straight part of a track, averaged in cells.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    along, across : ndarray of int, shape (n,), of each cell
    place : ndarray, shape (n, 2), north and east [m]
    depth : ndarray, shape (n,) [m]
    """

    time: Array
    along: NDArray[np.int64]
    across: NDArray[np.int64]
    place: Array
    depth: Array

    @cached_property
    def centre(self) -> tuple[Array, Array, Array]:
        """Time, place and half width of the swath, cell by cell along the line, shapes (m,), (m, 2) and ()."""
        cells, which, count = np.unique(self.along, return_inverse=True, return_counts=True)
        columns = np.column_stack([self.time, self.place])
        mean = np.stack([np.bincount(which, c, len(cells)) for c in columns.T], axis=-1) / count[:, None]
        off = np.linalg.norm(self.place - mean[which, 1:], axis=1)
        return mean[:, 0], mean[:, 1:], np.asarray(np.quantile(off, 0.9))


def lines_of(time: Array, heading: Array, position: Array, at: Array, place: Array, depth: Array) -> list[Line]:
    """Straight parts of a track, with their soundings.

    Parameters
    ----------
    time, heading, position : ndarray, shapes (n,), (n,), (n, 2), of the track
    at, place, depth : ndarray, shapes (m,), (m, 2), (m,), of the soundings, in the order of time
    """
    t = np.arange(time[0], time[-1], 1.0)
    e = np.interp(t, time, np.cos(heading)) + 1j * np.interp(t, time, np.sin(heading))
    e /= np.maximum(np.abs(e), 1e-9)
    width = int(STRAIGHT_S)
    total = np.concatenate([[0.0], np.cumsum(e)])
    low, high = np.maximum(np.arange(len(t)) - width // 2, 0), np.minimum(np.arange(len(t)) + width // 2 + 1, len(t))
    straight = np.abs((total[high] - total[low]) / (high - low)) > STRAIGHT
    p = np.stack([np.interp(t, time, axis) for axis in position.T], axis=-1)
    arc = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    lines, first = [], 0
    while first < len(t):
        last = first
        while last < len(t) and straight[last] and (e[last] * np.conj(e[first])).real > BEND:
            last += 1
        if last - first > LINE_S and arc[last - 1] - arc[first] > LINE_M:
            own = slice(*np.searchsorted(at, (t[first], t[last - 1])).tolist())
            line = _cells(t[first:last], p[first:last], arc[first:last], at[own], place[own], depth[own])
            lines += [line] if len(line.time) > STRETCH // 2 else []
        first = max(last, first + 1)
    return lines


def _cells(t: Array, p: Array, arc: Array, at: Array, place: Array, depth: Array) -> Line:
    """Soundings of a line, averaged."""
    way = p[-1] - p[0]
    way = way / np.linalg.norm(way)
    here = np.stack([np.interp(at, t, axis) for axis in p.T], axis=-1)
    off = place - here
    along = np.floor((np.interp(at, t, arc) + off @ way) / CELL_M).astype(np.int64)
    across = np.round(off @ (-way[1], way[0]) / CELL_M).astype(np.int64)
    _, which, count = np.unique(np.column_stack([along, across]), axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    columns = np.column_stack([at, along, across, place, depth])
    mean = np.stack([np.bincount(which, c, len(count)) for c in columns.T], axis=-1) / np.maximum(count, 1)[:, None]
    mean = mean[count >= 0.25 * np.median(count)] if len(count) else mean
    along, across = np.round(mean[:, 1:3].T).astype(np.int64)
    return Line(mean[:, 0], along, across, mean[:, 3:5], mean[:, 5])


@dataclass(frozen=True)
class Relief:
    """The bottom as soundings along lines show it.

    Attributes
    ----------
    sd, length : of the relief [m]
    noise : sd of a cell's depth [m]
    gain : log likelihood over that of noise on planes
    """

    sd: float
    length: float
    noise: float
    gain: float

    @property
    def shows(self) -> bool:
        """Whether it is more than the noise of the soundings."""
        return self.gain > LEAD and self.sd > self.noise

    def covariance(self, r: Array) -> Array:
        """Of the relief at some distances."""
        return self.sd**2 * _matern(r / self.length)


def _matern(r: Array) -> Array:
    q = np.sqrt(3.0) * r
    return np.asarray((1.0 + q) * np.exp(-q))


def fit_relief(lines: Sequence[Line]) -> Relief:
    """The relief that makes the soundings along the lines likeliest, on planes of their own in stretches."""
    stretches = []
    for line in lines:
        for side in np.unique(line.across):
            own = np.flatnonzero(line.across == side)
            own = own[np.argsort(line.along[own])]
            stretches += [own_of(line, own[k : k + STRETCH]) for k in range(0, len(own) - STRETCH + 1, STRETCH)]
    if len(stretches) < 2:
        return Relief(0.0, 1.0, 1.0, 0.0)
    some = np.linspace(0, len(stretches) - 1, min(len(stretches), STRETCHES)).round().astype(int)
    x, z = (np.array([stretches[k][part] for k in some]) for part in (0, 1))
    basis = np.concatenate([np.ones((*x.shape[:2], 1)), x - x.mean(axis=1, keepdims=True)], axis=2)
    Q = np.array([np.linalg.svd(b)[0][:, np.linalg.matrix_rank(b, 1e-3) :][:, : STRETCH - 3] for b in basis])
    z = np.einsum("sij,si->sj", Q, z)
    r = np.linalg.norm(x[:, :, None] - x[:, None], axis=-1)

    def likelihood(K: Array) -> tuple[float, float]:
        L = np.linalg.cholesky(np.swapaxes(Q, 1, 2) @ K @ Q)
        white = np.linalg.solve(L, z[..., None])[..., 0]
        variance = float(np.mean(white**2))
        spread = 2.0 * float(np.log(np.diagonal(L, axis1=1, axis2=2)).sum())
        return -0.5 * (z.size * np.log(max(variance, 1e-12)) + spread), variance

    unit = np.eye(STRETCH)
    none, _ = likelihood(np.broadcast_to(unit, r.shape))
    best = Relief(0.0, 1.0, 1.0, -np.inf)
    for length in LENGTHS_M:
        k = _matern(r / length)
        for noise in NOISES:
            score, variance = likelihood(k + noise * unit)
            if score - none > best.gain:
                best = Relief(float(np.sqrt(variance)), length, float(np.sqrt(noise * variance)), score - none)
    return best


def own_of(line: Line, cells: NDArray[np.intp]) -> tuple[Array, Array]:
    """Places and depths of some cells."""
    return line.place[cells], line.depth[cells]


@dataclass(frozen=True)
class Crossing:
    """Where a line crosses an earlier one, or runs over a piece of it again.

    Attributes
    ----------
    line, earlier : numbers of the lines
    knots : when it was there, of `Drift`
    centre : ndarray, shape (2,), north and east [m]
    """

    line: int
    earlier: int
    knots: tuple[int, int]
    centre: Array


@dataclass(frozen=True)
class Tie:
    """What soundings say of the errors of a track at two knots: e(a) - e(b) = shift.

    Attributes
    ----------
    knots : a, b
    shift : ndarray, shape (2,), north and east [m]
    information : ndarray, shape (2, 2) [1/m^2]
    """

    knots: tuple[int, int]
    shift: Array
    information: Array

    def rows(self, count: int) -> tuple[Array, Array]:
        """Whitened Jacobian by the errors of all knots, shape (2, 2 count), and right-hand side, shape (2,)."""
        value, axes = np.linalg.eigh(self.information)
        W = np.sqrt(np.maximum(value, 0.0))[:, None] * axes.T
        J = np.zeros((2, count, 2))
        J[:, self.knots[0]], J[:, self.knots[1]] = W, -W
        return J.reshape(2, -1), W @ self.shift


@dataclass(frozen=True)
class Drift:
    """Errors of a track at m knots, north and east.

    Attributes
    ----------
    time : ndarray, shape (m,) [s]
    mean : ndarray, shape (2 m,) [m]
    P : ndarray, shape (2 m, 2 m) [m^2]
    """

    time: Array
    mean: Array
    P: Array

    def knot(self, time: float) -> int:
        """The one next to a time."""
        return int(np.abs(self.time - time).argmin())

    def at(self, time: Array) -> Array:
        """The mean at some times, shape (n, 2) [m]."""
        return np.stack([np.interp(time, self.time, axis) for axis in self.mean.reshape(-1, 2).T], axis=-1)

    def between(self, crossings: Sequence[Crossing]) -> tuple[Array, Array]:
        """Mean and covariance of the shifts at k crossings, shapes (2 k,) and (2 k, 2 k)."""
        a, b = ((np.array([c.knots[end] for c in crossings])[:, None] * 2 + [0, 1]).ravel() for end in (0, 1))
        moved = self.P[a] - self.P[b]
        return self.mean[a] - self.mean[b], moved[:, a] - moved[:, b]

    def tied(self, ties: Sequence[Tie]) -> "Drift":
        """What is left when ties are known."""
        rows = [tie.rows(len(self.time)) for tie in ties]
        J, z = np.concatenate([r[0] for r in rows]), np.concatenate([r[1] for r in rows])
        PJ = self.P @ J.T
        gain = np.linalg.solve(J @ PJ + np.eye(len(z)), PJ.T).T
        P = self.P - gain @ PJ.T
        return Drift(self.time, self.mean + gain @ (z - J @ self.mean), 0.5 * (P + P.T))


@dataclass(frozen=True)
class Crossovers:
    """What crossings of a survey's lines say.

    Attributes
    ----------
    relief : of the bottom
    ties : of matched crossings
    lines, matched : how many lines cross or run over three earlier pieces or more, and how many of them were matched
    crossings : how many they have
    refused : reason -> count of lines that were not
    """

    relief: Relief
    ties: list[Tie] = field(default_factory=list)
    lines: int = 0
    matched: int = 0
    crossings: int = 0
    refused: dict[str, int] = field(default_factory=dict)

    @property
    def text(self) -> str:
        """One line for people."""
        if self.ties:
            r = self.relief
            return (
                f"crossovers: {self.matched} of {self.lines} lines matched with earlier ones at {len(self.ties)} of "
                f"{self.crossings} crossings, by relief of {r.sd:.2f} m over {r.length:.1f} m"
            )
        if self.lines and not self.relief.shows:
            why = f"the bottom's relief of {self.relief.sd:.2f} m is not above the noise of its soundings"
            why = why if self.relief.gain > LEAD else "the bottom shows no relief above the noise of its soundings"
        elif self.lines:
            why = "; ".join(f"{count} of {self.lines} lines: {why}" for why, count in self.refused.items())
        else:
            why = f"no line crosses, or runs again over, {ENOUGH} pieces of earlier ones"
        return f"crossovers: nothing is used: {why}"


def with_crossovers(estimate: "Estimate", bottom: "Bottom") -> "tuple[Estimate, Crossovers]":
    """A smoothed track corrected where its soundings show its drift, and what they showed.

    The correction and what it leaves of the covariance are exact at the knots of the drift, and interpolated between
    them. Velocities follow; attitude, calibration and their sds stay as they are.

    Parameters
    ----------
    estimate : smoothed, with its joint covariance
    bottom : under it
    """
    track, posterior = estimate.trajectory, estimate.posterior
    assert posterior is not None
    apart = max(KNOT_S, (track.time[-1] - track.time[0]) / KNOTS)
    times = np.append(np.arange(track.time[0], track.time[-1], apart), track.time[-1])
    keyframes = np.unique(np.searchsorted(track.time, times).clip(max=len(track) - 1))
    used = bottom.soundings[bottom.soundings["used"] == 1]
    at, place, depth = (used[names].to_numpy() for names in ("time", ["north", "east"], "depth"))
    lines = lines_of(track.time, track.rpy[:, 2], track.p_n[:, :2], at, place, depth)
    drift = Drift(track.time[keyframes], np.zeros(2 * len(keyframes)), posterior.horizontal(keyframes.tolist()))
    found = match(lines, drift)
    if not found.ties:
        return estimate, found
    left = drift.tied(found.ties)
    moved, rate = left.at(track.time), np.diff(left.mean.reshape(-1, 2), axis=0) / np.diff(left.time)[:, None]
    interval = np.clip(np.searchsorted(left.time, track.time, side="right") - 1, 0, len(rate) - 1)
    p_n, v_n, cov_p = track.p_n.copy(), track.v_n.copy(), track.cov_p.copy()
    p_n[:, :2] += moved
    v_n[:, :2] += rate[interval]
    before, after = (
        np.array([d.P[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] for k in range(len(d.time))]) for d in (drift, left)
    )
    for i in range(2):
        for j in range(2):
            cov_p[:, i, j] -= np.interp(track.time, left.time, (before - after)[:, i, j])
    corrected = replace(track, p_n=p_n, v_n=v_n, cov_p=cov_p)
    return replace(estimate, trajectory=corrected, posterior=None), found


def match(lines: Sequence[Line], drift: Drift) -> Crossovers:
    """Match each line, as a whole, with all earlier ones.

    Parameters
    ----------
    lines : in the order of time
    drift : of the track
    """
    relief = fit_relief(lines)
    out = Crossovers(relief)
    todo = list(range(1, len(lines)))
    counts: dict[int, int] = {}
    reasons: dict[int, str] = {}
    ties: list[Tie] = []
    done: set[int] = set()
    for _ in range(2):  # what an accepted line has tied may make an earlier one clear
        before = len(done)
        for k in todo:
            if k in done:
                continue
            crossings = crossings_of(lines, k, drift)
            if len(crossings) < ENOUGH:
                continue
            counts[k] = len(crossings)
            if not relief.shows:
                continue
            found = _Search(lines, crossings, drift, relief).ties()
            if isinstance(found, str):
                reasons[k] = found
                continue
            reasons.pop(k, None)
            done.add(k)
            ties += found
            drift = drift.tied(found)
        if len(done) in (before, 0):
            break
    refused: dict[str, int] = {}
    for why in reasons.values():
        refused[why] = refused.get(why, 0) + 1
    return replace(
        out, ties=ties, lines=len(counts), matched=len(done), crossings=sum(counts.values()), refused=refused
    )


def crossings_of(lines: Sequence[Line], k: int, drift: Drift) -> list[Crossing]:
    """Crossings of a line with earlier ones, where the drift has them."""
    t, p, width = lines[k].centre
    p = p + drift.at(t)
    out = []
    for j in range(k):
        t_b, p_b, width_b = lines[j].centre
        p_b = p_b + drift.at(t_b)
        reach = float(width + width_b) + CELL_M
        low, high = p_b.min(axis=0) - reach, p_b.max(axis=0) + reach
        near = ((p >= low) & (p <= high)).all(axis=1)
        if not near.any():
            continue
        apart = np.full((len(p), len(p_b)), np.inf)
        apart[near] = np.linalg.norm(p[near, None] - p_b, axis=-1)
        least = apart.min(axis=1)
        ends = np.flatnonzero(np.diff(np.concatenate([[False], least < reach, [False]]).astype(int)))
        for first, last in ends.reshape(-1, 2).tolist():
            pieces = max(round((last - first) * CELL_M / PIECE_M), 1)
            for own in np.array_split(np.arange(first, last), pieces):
                a = own[least[own].argmin()] if pieces == 1 else own[len(own) // 2]
                b = int(apart[a].argmin())
                out.append(Crossing(k, j, (drift.knot(t[a]), drift.knot(t_b[b])), 0.5 * (p[a] + p_b[b])))
    return out


class _Field:
    """Log likelihood of the shift at a crossing; heights and slopes of both lines there are their own."""

    def __init__(self, a: tuple[Array, Array], b: tuple[Array, Array], relief: Relief) -> None:
        (self._x, z), (self._y, w), self._relief = a, b, relief
        own = [
            relief.covariance(_apart(p, p)) + relief.noise**2 * np.eye(len(p)) + _of_plane(p, relief.sd)
            for p in (self._x, self._y)
        ]
        self._own, self._z = own[0], z - z.mean()
        self._root = np.linalg.inv(np.linalg.cholesky(own[1]))
        self._known = self._root @ (w - w.mean())
        self._none = self._likelihood(np.zeros((1, len(z), len(w))))[0][0]

    def _likelihood(self, common: Array) -> tuple[Array, Array]:
        """Of g covariances of the relief at both lines, and squared residuals by their number."""
        V = common @ self._root.T
        L = np.linalg.cholesky(self._own - V @ np.swapaxes(V, 1, 2))
        white = np.linalg.solve(L, (self._z - V @ self._known)[..., None])[..., 0]
        chi2 = (white**2).sum(axis=1)
        return -0.5 * chi2 - np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1), chi2 / len(self._z)

    def at(self, shifts: Array) -> tuple[Array, Array]:
        """The field and squared residuals by their number at g shifts, shape (g,) each."""
        out, misfit = np.empty(len(shifts)), np.empty(len(shifts))
        for first in range(0, len(shifts), 256):
            part = slice(first, first + 256)
            moved = self._x[None] + shifts[part, None]
            out[part], misfit[part] = self._likelihood(self._relief.covariance(_apart(moved, self._y)))
        return out - self._none, misfit


def _of_plane(p: Array, sd: float) -> Array:
    away = p - p.mean(axis=0)
    return np.asarray((PLANE * sd) ** 2 + SLOPE**2 * away @ away.T)


def _apart(x: Array, y: Array) -> Array:
    return np.asarray(np.sqrt(((x[..., :, None, :] - y[..., None, :, :]) ** 2).sum(axis=-1)))


class _Search:
    """A line against all earlier ones."""

    def __init__(self, lines: Sequence[Line], crossings: Sequence[Crossing], drift: Drift, relief: Relief) -> None:
        self._lines, self._drift, self._relief = lines, drift, relief
        mean, P = drift.between(crossings)
        order = _clearest_first(P)
        self._crossings = [crossings[k] for k in order]
        own = (np.array(order)[:, None] * 2 + [0, 1]).ravel()
        self._mean, self._P = mean[own], P[np.ix_(own, own)]
        self._fields: list[_Field] = []
        self._range = 0.0
        self._step = float(np.clip(GRID * relief.length, FINEST_M, COARSEST_M))

    def ties(self) -> list[Tie] | str:
        """What all likely combinations have in common, or why nothing is used."""
        shifts, score = self._combinations()
        likely = shifts[score > score[0] - LEAD]
        spread = np.linalg.norm(likely - likely[0], axis=2).max(axis=0)
        clear = np.flatnonzero(spread < SAME_M)
        if len(clear) < ENOUGH:
            return "another match is nearly as likely"
        if self._repeats():
            return "the bottom repeats itself"
        found, gain, shown, misfit = self._propagated(shifts[0], clear)
        if gain < LEAD or (shown > SHOWS).sum() < ENOUGH:
            return "its soundings do not match"
        if misfit > MISFIT:
            return "its soundings contradict the match"
        return found

    def _field(self, k: int, predicted: Array, reach: float) -> _Field:
        """Of a crossing, from soundings in reach of where it is predicted."""
        c, sides = self._crossings[k], []
        centre = c.centre - self._drift.mean.reshape(-1, 2)[c.knots[1]]  # where the earlier line's soundings have it
        for line, moved in ((self._lines[c.line], predicted), (self._lines[c.earlier], np.zeros(2))):
            off = np.linalg.norm(line.place + moved - centre, axis=1)
            own = np.flatnonzero(off < reach)
            own = own[np.argsort(off[own])[:MOST]]
            sides.append((line.place[own] - centre, line.depth[own]))
        return _Field(sides[0], sides[1], self._relief)

    def _combinations(self) -> tuple[Array, Array]:
        """The best combinations of shifts, shape (h, k, 2), best first, and their log likelihoods, shape (h,)."""
        shifts, score = np.zeros((1, 0, 2)), np.zeros(1)
        noise = PEAK_SD**2
        for k in range(len(self._crossings)):
            own, seen = slice(2 * k, 2 * k + 2), slice(0, 2 * k)
            gain = np.linalg.solve(self._P[seen, seen] + noise * np.eye(2 * k), self._P[seen, own]).T
            C = self._P[own, own] - gain @ self._P[seen, own] + noise * np.eye(2)
            predicted = self._mean[own] + (shifts.reshape(len(shifts), -1) - self._mean[seen]) @ gain.T
            far = min(SIGMAS * np.sqrt(np.linalg.eigvalsh(C)[-1]), FARTHEST_M)
            self._range = max(self._range, far)
            reach = far + np.linalg.norm(predicted - predicted[0], axis=1).clip(max=FARTHEST_M).max()
            axis = np.arange(-np.ceil(reach / self._step), np.ceil(reach / self._step) + 1) * self._step
            grid = predicted[0] + np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
            flat = grid.reshape(-1, 2)
            near = (np.linalg.norm(flat[:, None] - predicted, axis=2) < far + self._step).any(axis=1)
            values = np.full(len(flat), -np.inf)
            self._fields.append(self._field(k, predicted[0], min(reach, FARTHEST_M) + BESIDE_M))
            values[near] = _robust(self._fields[-1].at(flat[near])[0])
            away = flat - predicted[:, None]
            white = np.linalg.solve(np.linalg.cholesky(C), np.swapaxes(away, 1, 2))
            both = values - 0.5 * (white**2).sum(axis=1) - 0.5 * np.linalg.slogdet(C)[1]
            peaks = _peaks(both.reshape(len(shifts), len(axis), len(axis))).reshape(len(shifts), -1)
            total = np.where(peaks, score[:, None] + both, -np.inf).ravel()
            best = np.argsort(-total)[:KEPT]
            best = best[total[best] > total[best[0]] - 2.5 * LEAD]
            before, cell = np.divmod(best, len(flat))
            shifts = np.concatenate([shifts[before], flat[cell][:, None]], axis=1)
            score = total[best]
        return shifts, score

    def _repeats(self) -> bool:
        """Whether the line, or all those that it crosses, look alike further on."""
        earlier = [self._lines[k] for k in sorted({c.earlier for c in self._crossings})]
        return any(
            _most_alike(some, self._relief, 2.0 * self._range) > ALIKE
            for some in ([self._lines[self._crossings[0].line]], earlier)
        )

    def _propagated(self, shifts: Array, clear: NDArray[np.intp]) -> tuple[list[Tie], float, Array, float]:
        """Ties at some crossings, the log likelihood of the match, that of each crossing, and the residuals' excess."""
        own = (clear[:, None] * 2 + [0, 1]).ravel()
        mean, prior = self._mean[own], np.linalg.inv(self._P[np.ix_(own, own)] + 1e-4 * np.eye(len(own)))
        axis = np.arange(-SAME_M, SAME_M + FINE_M / 2, FINE_M)
        around = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
        grids = [shifts[k] + around for k in clear]
        found = [self._fields[k].at(grid) for k, grid in zip(clear, grids, strict=True)]
        values = [_robust(field) for field, _ in found]
        count, sites = len(clear), [np.eye(2) / SAME_M**2] * len(clear)
        pulls = [site @ shifts[k] for site, k in zip(sites, clear, strict=True)]
        shown, misfit = np.zeros(count), np.zeros(count)
        for _ in range(6):
            for j in range(count):
                part = slice(2 * j, 2 * j + 2)
                others = prior.copy()
                pull = prior @ mean
                for i in range(count):
                    if i != j:
                        others[2 * i : 2 * i + 2, 2 * i : 2 * i + 2] += sites[i]
                        pull[2 * i : 2 * i + 2] += pulls[i]
                P = np.linalg.inv(others)
                C, m = P[part, part], (P @ pull)[part]
                away = grids[j] - m
                inverse = np.linalg.inv(C)
                density = values[j] - 0.5 * np.einsum("gi,ij,gj->g", away, inverse, away)
                weight = np.exp(density - density.max())
                weight /= weight.sum()
                centre = weight @ grids[j]
                spread = (grids[j] - centre).T @ ((grids[j] - centre) * weight[:, None]) + FINE_M**2 / 12.0 * np.eye(2)
                value, axes = np.linalg.eigh(np.linalg.inv(spread) - inverse)
                sites[j] = (axes * np.maximum(value, LEAST)) @ axes.T
                pulls[j] = np.linalg.inv(spread) @ centre - inverse @ m if value[0] > LEAST else sites[j] @ centre
                shown[j], misfit[j] = weight @ found[j][0], weight @ found[j][1]
        ties = [
            Tie(self._crossings[k].knots, np.linalg.solve(site, pull), site)
            for k, site, pull in zip(clear, sites, pulls, strict=True)
        ]
        return ties, self._gain(clear, sites, pulls), shown, self._misfit(misfit, shown)

    @staticmethod
    def _misfit(misfit: Array, shown: Array) -> float:
        return float(np.mean(misfit[shown > SHOWS])) if (shown > SHOWS).any() else 0.0

    def _gain(self, clear: NDArray[np.intp], sites: Sequence[Array], pulls: Sequence[Array]) -> float:
        """Log likelihood of the soundings with the match over that without, by Laplace's method."""
        own = (clear[:, None] * 2 + [0, 1]).ravel()
        P, information = self._P[np.ix_(own, own)], np.zeros((len(own), len(own)))
        for j, site in enumerate(sites):
            information[2 * j : 2 * j + 2, 2 * j : 2 * j + 2] = site
        pull = np.concatenate(pulls) - information @ self._mean[own]
        spread = np.eye(len(own)) + P @ information
        away = np.linalg.solve(spread, P @ pull)  # of the match from what was predicted
        at = (self._mean[own] + away).reshape(-1, 2)
        shown = sum(float(_robust(self._fields[k].at(shift[None])[0])[0]) for k, shift in zip(clear, at, strict=True))
        return shown - 0.5 * float(away @ np.linalg.solve(P, away)) - 0.5 * float(np.linalg.slogdet(spread)[1])


def _robust(field: Array) -> Array:
    """A field of soundings that may be no bottom's."""
    return np.asarray(np.logaddexp(np.log1p(-FALSE) + field, np.log(FALSE)))


def _peaks(values: Array) -> NDArray[np.bool_]:
    """Local maxima of fields, shape (h, n, m)."""
    wide = np.pad(values, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    n, m = values.shape[1:]
    out = np.isfinite(values)
    for i in range(3):
        for j in range(3):
            out &= values >= wide[:, i : i + n, j : j + m]
    return out


def _clearest_first(P: Array) -> list[int]:
    """An order of crossings: next comes what those before predict best."""
    left = P.copy()
    order: list[int] = []
    count = len(P) // 2
    while len(order) < count:
        unsure = [np.inf if k in order else left[2 * k, 2 * k] + left[2 * k + 1, 2 * k + 1] for k in range(count)]
        k = int(np.argmin(unsure))
        order.append(k)
        own = slice(2 * k, 2 * k + 2)
        gain = np.linalg.solve(left[own, own] + PEAK_SD**2 * np.eye(2), left[own]).T
        left = left - gain @ left[own]
    return order


def _most_alike(lines: Sequence[Line], relief: Relief, far: float) -> float:
    """The largest correlation of profiles with themselves, further on than relief of their length lets expect."""
    first = int(np.ceil(max(2.0 * relief.length, 3.0 * CELL_M) / CELL_M))
    last = int(far / CELL_M)
    product, square, pairs = np.zeros((3, max(last + 1, 1)))
    for line in lines:
        for side in np.unique(line.across):
            own = line.across == side
            z = np.full(np.ptp(line.along) + 1, np.nan)
            z[line.along[own] - line.along.min()] = line.depth[own]
            known = np.flatnonzero(np.isfinite(z))
            if len(known) < STRETCH // 2:
                continue
            z[known] -= np.polyval(np.polyfit(known, z[known], 1), known)
            for lag in range(first, min(last + 1, len(z) // 2 + 1)):
                u, v = z[:-lag], z[lag:]
                both = np.isfinite(u) & np.isfinite(v)
                product[lag] += u[both] @ v[both]
                square[lag] += 0.5 * (u[both] @ u[both] + v[both] @ v[both])
                pairs[lag] += both.sum()
    enough = pairs > 15
    return float((product[enough] / np.maximum(square[enough], 1e-12)).max()) if enough.any() else 0.0
