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

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.chart import ChartFile, DepthChart, SmoothedChart
from rovgraph.model.origin import Origin

if TYPE_CHECKING:
    from rovgraph.inference.bottom import Bottom
    from rovgraph.inference.estimate import Estimate

CELL_M = 2.0  # of a line, along and across, within which soundings are averaged
SCATTER = 4.0  # sd of a cell's soundings over what is usual, from which they are no bottom's: fish
LINE_M, LINE_S = 20.0, 15.0  # shortest line
STRAIGHT_S, STRAIGHT = 10.0, 0.98  # a line: mean resultant of the heading around each moment
BEND = np.cos(np.pi / 4.0)  # from where it began, at which a line ends
PIECE_M, CHART_PIECE_M = 25.0, 50.0  # of a line that is run again, or on a chart, matched by itself
CHART = -1  # "earlier line" of a crossing
BESIDE_M = 6.0  # from the crossing and the range of the search, soundings that show something
LEAST_CELLS, MOST = 4, 80  # soundings of either line at a crossing
LENGTHS_M = np.geomspace(1.0, 30.0, 6)  # of relief
NOISES = np.geomspace(1e-3, 10.0, 7)  # variance of a sounding over that of the relief
AVERAGED = [(0.0, 2 / 3), (-CELL_M / 2**0.5, 1 / 6), (CELL_M / 2**0.5, 1 / 6)]  # of two cells: how far apart, weight
STRETCH, STRETCHES = 32, 60  # cells of a stretch, and stretches, to which relief is fitted
HEIGHT, TILT = 3.0, 0.02  # sd of a line's own height [m] and slope about a crossing: tide, depth sensor, trim
SLOPE = 0.3  # of the bottom there, beside its relief
GRID, STEPS_M = 0.2, (0.4, 1.2)  # step of a field: of the relief's length, its limits
SIGMAS, FARTHEST_M, CHART_M = 3.5, 40.0, 250.0  # range of the search about what is predicted, and on a chart
KEPT = 100  # combinations
SEEN = 0.5  # share of a piece's soundings that a chart must have
FALSE = 0.05  # part of crossings whose soundings are not those of the bottom
LEAD = 10.0  # nats
ENOUGH = 3  # crossings
SAME_M = 2.5  # shifts closer than that are the same
ROUNDS = 3  # of the search, each with lines where the one before has them
KNOT_S, KNOTS = 10.0, 1000  # between knots of the drift, and how many at most
BETWEEN_M = 0.02  # sd of the drift between them
SHOWS = 1.0  # nats, of a crossing that counts
REPEATS, ENOUGH_PAIRS = 0.8, 100  # rise of the correlation of lines with themselves, and cells it needs: sand waves
MISFIT = 1.5  # of the soundings' squared residuals, over what is expected


@dataclass(frozen=True)
class Line:
    """Soundings along a straight part of a track, averaged in cells.

    Attributes
    ----------
    time : ndarray, shape (n,) [s]
    along, across : ndarray of int, shape (n,), of each cell
    place : ndarray, shape (n, 2), north and east [m]
    depth : ndarray, shape (n,) [m]
    noise : sd of a depth by the scatter of its soundings [m]
    """

    time: Array
    along: NDArray[np.int64]
    across: NDArray[np.int64]
    place: Array
    depth: Array
    noise: float = 0.0

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
    square = np.bincount(which, (depth - mean[which, 5]) ** 2, len(count)) / np.maximum(count - 1, 1)
    usual = float(np.median(square[count > 1])) if (count > 1).any() else 0.0
    good = (count >= 0.25 * np.median(count)) & (square <= SCATTER**2 * max(usual, 1e-9)) if len(count) else count > 0
    noise = float(np.sqrt((square / np.maximum(count, 1))[good].mean())) if good.any() else 0.0
    mean = mean[good]
    along, across = np.round(mean[:, 1:3].T).astype(np.int64)
    return Line(mean[:, 0], along, across, mean[:, 3:5], mean[:, 5], noise)


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

    def relief(log: Array) -> Relief:
        length, noise = np.exp(log)
        k = sum(w * _matern(np.abs(r + off) / length) for off, w in AVERAGED)
        score, variance = likelihood(k + noise * unit)
        return Relief(float(np.sqrt(variance)), float(length), float(np.sqrt(noise * variance)), score - none)

    start = max((np.log(pair) for pair in product(LENGTHS_M, NOISES)), key=lambda log: relief(log).gain)
    bounds = np.log([(LENGTHS_M[0], LENGTHS_M[-1]), (NOISES[0], NOISES[-1])])
    from scipy.optimize import minimize

    best = relief(minimize(lambda log: -relief(log).gain, start, method="Nelder-Mead", bounds=bounds).x)
    return replace(best, noise=max(best.noise, float(np.median([line.noise for line in lines]))))


def own_of(line: Line, cells: NDArray[np.intp]) -> tuple[Array, Array]:
    """Places and depths of some cells."""
    return line.place[cells], line.depth[cells]


@dataclass(frozen=True)
class Crossing:
    """Where a line crosses an earlier one, or runs over a piece of it again, or a piece of a line on a chart.

    Attributes
    ----------
    line, earlier : numbers of the lines, `CHART` of the chart
    knots : when it was there, of `Drift`
    centre : ndarray, shape (2,), north and east of the earlier line, or of the piece [m]
    time : of the later line there [s]
    """

    line: int
    earlier: int
    knots: tuple[int, int]
    centre: Array
    time: float


@dataclass(frozen=True)
class Tie:
    """What soundings say of the errors of a track at two knots, in information form.

    Attributes
    ----------
    knots : a, b
    information : ndarray, shape (2, 2), of e(a) - e(b) [1/m^2]
    pull : ndarray, shape (2,), information times shift [1/m]
    """

    knots: tuple[int, int]
    information: Array
    pull: Array


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

    def beside(self, sd: float) -> "Drift":
        """With one more knot, never reached: the error of a chart's place, north and east."""
        P = np.pad(self.P, (0, 2))
        P[-2:, -2:] = max(sd, 1e-3) ** 2 * np.eye(2)
        return Drift(np.append(self.time, np.inf), np.append(self.mean, [0.0, 0.0]), P)

    def knot(self, time: float) -> int:
        """The one next to a time."""
        return int(np.abs(self.time - time).argmin())

    def at(self, time: Array) -> Array:
        """The mean at some times, shape (n, 2) [m]."""
        return np.stack([np.interp(time, self.time, axis) for axis in self.mean.reshape(-1, 2).T], axis=-1)

    def between(self, crossings: Sequence[Crossing]) -> "Shifts":
        """Of the errors at k crossings."""
        a, b = ((np.array([c.knots[end] for c in crossings])[:, None] * 2 + [0, 1]).ravel() for end in (0, 1))
        moved = self.P[a] - self.P[b]
        return Shifts(self.mean[a] - self.mean[b], moved[:, a] - moved[:, b] + BETWEEN_M**2 * np.eye(len(a)))

    def tied(self, ties: Sequence[Tie]) -> "Drift":
        """What is left when ties are known."""
        mean, P = self.mean, self.P
        for tie in ties:
            a, b = (slice(2 * knot, 2 * knot + 2) for knot in tie.knots)
            column = P[:, a] - P[:, b]
            gain = column @ np.linalg.inv(np.eye(2) + tie.information @ (column[a] - column[b]))
            mean = mean + gain @ (tie.pull - tie.information @ (mean[a] - mean[b]))
            P = P - gain @ tie.information @ column.T
        return Drift(self.time, mean, 0.5 * (P + P.T))


@dataclass(frozen=True)
class Shifts:
    """Shifts at k crossings: a normal distribution.

    Attributes
    ----------
    mean : ndarray, shape (2 k,) [m]
    P : ndarray, shape (2 k, 2 k) [m^2]
    """

    mean: Array
    P: Array

    def of(self, k: int) -> tuple[Array, Array]:
        """Mean and covariance of one."""
        own = slice(2 * k, 2 * k + 2)
        return self.mean[own], self.P[own, own]

    def given(self, k: int, information: Array, pull: Array) -> "Shifts":
        """With what soundings say of one."""
        m, V = self.of(k)
        column = self.P[:, 2 * k : 2 * k + 2]
        gain = column @ np.linalg.inv(np.eye(2) + information @ V)
        return Shifts(self.mean + gain @ (pull - information @ m), self.P - gain @ information @ column.T)


@dataclass(frozen=True)
class Crossovers:
    """What crossings of a survey's lines say.

    Attributes
    ----------
    relief : of the bottom
    crossings : of its lines
    ties : of those that were matched
    refused : why nothing is used, or ""
    chart : why the chart is not, or ""
    misfit : squared residuals over what is expected, where they contradict a match
    """

    relief: Relief
    crossings: Sequence[Crossing] = ()
    ties: Sequence[Tie] = ()
    refused: str = ""
    chart: str = ""
    misfit: float = 0.0

    def as_dict(self) -> dict[str, object]:
        """For summary.json."""
        knots = {tie.knots for tie in self.ties}
        return {
            "relief_sd_m": self.relief.sd,
            "relief_length_m": self.relief.length,
            "time_s": [c.time for c in self.crossings],
            "matched": [c.knots in knots for c in self.crossings],
        }

    @property
    def text(self) -> str:
        """One line for people."""
        chart = f"; the chart is not used: {self.chart}" if self.chart else ""
        if self.refused:
            return f"crossovers: nothing is used: {self.refused}{chart}"
        r, knots = self.relief, {tie.knots for tie in self.ties}
        charted, crossed = (
            [c.knots in knots for c in self.crossings if (c.earlier == CHART) == on] for on in (True, False)
        )
        counts = [f"{sum(crossed)} of {len(crossed)} crossings of the survey's lines"] if crossed else []
        counts += [f"{sum(charted)} of {len(charted)} pieces on the chart"] if charted else []
        return f"crossovers: {' and '.join(counts)} matched, by relief of {r.sd:.2f} m over {r.length:.1f} m{chart}"


def with_crossovers(
    estimate: "Estimate", bottom: "Bottom", chart: ChartFile | None = None, origin: Origin = (0.0, 0.0)
) -> "tuple[Estimate, Crossovers]":
    """A smoothed track corrected where its soundings show its drift, and what they showed.

    The correction and what it leaves of the covariance are exact at the knots of the drift, and interpolated between
    them. Velocities follow; attitude, calibration and their sds stay as they are.

    Parameters
    ----------
    estimate : smoothed, with its joint covariance
    bottom : under it
    chart, origin : of the same bottom, and latitude and longitude of north = east = 0
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
    around = None
    if chart is not None:
        drift = drift.beside(chart.settings.position_sd_m)
        reach = min(SIGMAS * float(np.sqrt(np.diag(drift.P).max())), CHART_M) + PIECE_M
        around = chart.around(track.p_n[:, :2].min(axis=0) - reach, track.p_n[:, :2].max(axis=0) + reach, origin)
    found = match(lines, drift, around)
    if not found.ties:
        return estimate, found
    left = drift.tied(found.ties)
    if chart is not None:
        drift, left = (Drift(d.time[:-1], d.mean[:-2], d.P[:-2, :-2]) for d in (drift, left))
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


def match(lines: Sequence[Line], drift: Drift, chart: DepthChart | None = None) -> Crossovers:
    """Match all crossings of a survey's lines together.

    Parameters
    ----------
    lines : in the order of time
    drift : of the track; with a chart, its last knot is that of the chart
    chart : of the same bottom
    """
    relief, track = fit_relief(lines), drift
    off = ""
    if chart is not None and lines:
        off = chart.refused(np.concatenate([x.place for x in lines]), np.concatenate([x.depth for x in lines]))
    known = None if chart is None or off else chart.smoothed(relief.covariance, relief.length)
    pieces = [c for k in range(len(lines)) for c in pieces_of(lines, k, drift)] if known is not None else []
    for _ in range(ROUNDS):
        crossings = pieces + [c for k in range(1, len(lines)) for c in crossings_of(lines, k, track)]
        found = replace(_match(lines, crossings, drift, relief, known), chart=off)
        if found.misfit > MISFIT:
            relief = replace(relief, noise=relief.noise * found.misfit)  # or relief that its model does not describe
            continue
        if not found.ties:
            break
        before, track = track, drift.tied(found.ties)
        if np.abs(track.mean - before.mean).max() < BESIDE_M:
            break
    return found


def _match(
    lines: Sequence[Line], crossings: Sequence[Crossing], drift: Drift, relief: Relief, chart: SmoothedChart | None
) -> Crossovers:
    if len(crossings) < ENOUGH:
        return Crossovers(relief, crossings, refused=f"lines cross or run again fewer than {ENOUGH} times")
    if not relief.shows:
        why = f"the bottom's relief of {relief.sd:.2f} m is not above the noise of its soundings"
        why = why if relief.gain > LEAD else "the bottom shows no relief above the noise of its soundings"
        return Crossovers(relief, crossings, refused=why)
    matches, reach = associate(lines, crossings, drift.between(crossings), relief, chart)
    if _repetition(lines, 2.0 * reach) > REPEATS:
        return Crossovers(relief, crossings, refused="the bottom repeats itself, as sand waves do")
    best = matches[0]
    if best.score < LEAD:
        return Crossovers(relief, crossings, refused="soundings of its lines do not match")
    likely = np.array([m.shifts.mean for m in matches if m.score > best.score - LEAD]).reshape(-1, len(crossings), 2)
    spread = np.linalg.norm(likely - likely[0], axis=2).max(axis=0)
    ties = [tie for k, tie in best.ties.items() if spread[k] < SAME_M]
    if len(ties) < ENOUGH:
        return Crossovers(relief, crossings, refused="another match is nearly as likely")
    if best.misfit > MISFIT:
        why = "its soundings contradict the match"
        return Crossovers(relief, crossings, refused=why, misfit=best.misfit)
    return Crossovers(relief, crossings, ties)


def crossings_of(lines: Sequence[Line], k: int, drift: Drift) -> list[Crossing]:
    """Crossings of a line with earlier ones, where the drift has them."""
    t, p, width = lines[k].centre
    p = p + drift.at(t)
    out = []
    for j in range(k):
        t_b, own_b, width_b = lines[j].centre
        p_b = own_b + drift.at(t_b)
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
                out.append(Crossing(k, j, (drift.knot(t[a]), drift.knot(t_b[b])), own_b[b], float(t[a])))
    return out


def pieces_of(lines: Sequence[Line], k: int, drift: Drift) -> list[Crossing]:
    """Pieces of a line that are on a chart."""
    t, p, _ = lines[k].centre
    count = max(round(len(t) * CELL_M / CHART_PIECE_M), 1)
    middle = [own[len(own) // 2] for own in np.array_split(np.arange(len(t)), count)]
    return [Crossing(k, CHART, (drift.knot(t[a]), len(drift.time) - 1), p[a], float(t[a])) for a in middle]


class Field:
    """Log likelihood of the shift at a crossing over that of no common relief.

    Heights and slopes of both lines there differ by what tide and trim do; the bottom's own slope is common.
    """

    def __init__(self, a: tuple[Array, Array], b: tuple[Array, Array], relief: Relief) -> None:
        (self._x, z), (self._y, w), self._relief = a, b, relief
        own = [
            self._common(p, p, np.zeros((1, 2)))[0] + relief.noise**2 * np.eye(len(p)) + _of_plane(p)
            for p in (self._x, self._y)
        ]
        self._own, self._z = own[0], z - z.mean()
        self._root = np.linalg.inv(np.linalg.cholesky(own[1]))
        self._known = self._root @ (w - w.mean())
        self._none = self._likelihood(np.zeros((1, len(z), len(w))))[0][0]

    def _common(self, x: Array, y: Array, shifts: Array) -> Array:
        """Covariance of the bottom's depth at places x + shift and y, shape (g, n, m)."""
        r = np.linalg.norm((x[:, None] - y) + shifts[:, None, None], axis=-1)
        return self._relief.covariance(r) + SLOPE**2 * x @ y.T  # of what a slope does over the shift, see heights

    def _likelihood(self, common: Array) -> tuple[Array, Array]:
        """Of g covariances of both lines, and squared residuals by their number."""
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
            out[part], misfit[part] = self._likelihood(self._common(self._x, self._y, shifts[part]))
        return out - self._none, misfit


def _of_plane(p: Array) -> Array:
    """Covariance of what height and slope of a line do at some places."""
    away = p - p.mean(axis=0)
    return np.asarray(HEIGHT**2 + TILT**2 * away @ away.T)


class ChartField:
    """As `Field`, of a piece of a line on a chart; soundings in its holes do not count."""

    def __init__(self, x: Array, z: Array, chart: SmoothedChart, relief: Relief) -> None:
        self._x, self._z, self._chart = x, z, chart
        own = relief.noise**2 * np.eye(len(x)) + _of_plane(x)
        r, away = np.linalg.norm(x[:, None] - x, axis=-1), x - x.mean(axis=0)
        self._known, self._alone = own + chart.covariance(r), own + relief.covariance(r) + SLOPE**2 * away @ away.T

    def at(self, shifts: Array) -> tuple[Array, Array]:
        """The field and squared residuals by their number at g shifts, shape (g,) each."""
        off = self._z - self._chart.at(self._x + shifts[:, None])
        seen = np.isfinite(off)
        share = seen.mean(axis=1)
        whole, some = np.flatnonzero(share == 1.0), np.flatnonzero((share > SEEN) & (share < 1.0))
        out, misfit = np.zeros(len(shifts)), np.ones(len(shifts))
        for rows in (whole, *np.array_split(some, len(some) // 512 + 1)):
            use = seen[rows[:1]] if rows is whole else seen[rows]
            with_chart, chi2 = _log_normal(self._known, np.where(seen[rows], off[rows], 0.0), use)
            alone, _ = _log_normal(self._alone, use * (self._z - self._z.mean()), use)
            out[rows], misfit[rows] = with_chart - alone, chi2 / seen[rows].sum(axis=1)
        return out, misfit


def _log_normal(covariance: Array, off: Array, use: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Log densities of residuals that are used, shape (g, n), without their constant, and squares of the white ones."""
    L = np.linalg.cholesky(np.where(use[:, :, None] & use[:, None], covariance, np.eye(len(covariance))))
    white = (np.linalg.inv(L) @ off[..., None])[..., 0] if len(L) == 1 else np.linalg.solve(L, off[..., None])[..., 0]
    chi2 = (white**2).sum(axis=-1)
    return -0.5 * chi2 - np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1), chi2


def _soundings_at(
    lines: Sequence[Line],
    crossing: Crossing,
    predicted: Array,
    reach: float,
    relief: Relief,
    chart: SmoothedChart | None,
) -> Field | ChartField:
    """The field of soundings in reach of a crossing."""
    if crossing.earlier == CHART and chart is not None:
        line = lines[crossing.line]
        own = np.linalg.norm(line.place - crossing.centre, axis=1) < CHART_PIECE_M / 2.0
        return ChartField(line.place[own], line.depth[own], chart, relief)
    sides = []
    for line, moved in ((lines[crossing.line], predicted), (lines[crossing.earlier], np.zeros(2))):
        off = np.linalg.norm(line.place + moved - crossing.centre, axis=1)
        own = np.argsort(off)[: np.clip((off < reach).sum(), LEAST_CELLS, MOST)]
        sides.append((line.place[own] - crossing.centre, line.depth[own]))
    return Field(sides[0], sides[1], relief)


@dataclass(frozen=True)
class Match:
    """A combination of peaks, one of each field so far.

    Attributes
    ----------
    shifts : of all crossings, with what the peaks say
    score : log likelihood of the soundings with the match over that without
    ties : number of a crossing -> what its peak says
    misfits : squared residuals at the peaks, by their number
    """

    shifts: Shifts
    score: float = 0.0
    ties: Mapping[int, Tie] = field(default_factory=dict)
    misfits: tuple[float, ...] = ()

    @property
    def misfit(self) -> float:
        """Mean of those of fields that show something."""
        return float(np.nanmean(self.misfits))

    def far(self, k: int, shifts: Array) -> Array:
        """Distances of shifts of a crossing from what is predicted [sd]."""
        m, V = self.shifts.of(k)
        away = shifts - m
        return np.asarray(np.sqrt((away @ np.linalg.inv(V) * away).sum(axis=-1)))

    def peaks(self, k: int, cells: Array, values: Array, misfit: Array) -> "list[tuple[float, Peak]]":
        """Where a field puts the shift of a crossing, with the score that each place would have.

        Parameters
        ----------
        cells : ndarray, shape (n, n, 2), shifts [m]
        values, misfit : ndarray, shape (n, n), the field there
        """
        V = self.shifts.of(k)[1]
        from scipy.ndimage import maximum_filter  # type: ignore[attr-defined]
        from scipy.spatial import KDTree

        step = cells[1, 0, 0] - cells[0, 0, 0]
        density = np.where(np.isfinite(values), _robust(values), -np.inf) - 0.5 * self.far(k, cells) ** 2
        density += np.log(step**2 / (2.0 * np.pi)) - 0.5 * np.linalg.slogdet(V)[1]
        size = 2 * int(SAME_M / step) + 1
        tops = np.argwhere((density == maximum_filter(density, size)) & (density > density.max() - 2.0 * LEAD))
        tops = tops[np.argsort(-density[tuple(tops.T)])[:KEPT]]
        near = density.ravel() > density.max() - 3.0 * LEAD
        flat, weight = cells.reshape(-1, 2)[near], np.exp(density.ravel()[near] - density.max())
        own = KDTree(cells[tuple(tops.T)]).query(flat)[1]

        def mean(x: Array) -> Array:
            return np.asarray(np.bincount(own, weight * x, len(tops)) / mass)

        mass = np.bincount(own, weight, len(tops))
        place = np.stack([mean(x) for x in flat.T], axis=-1)
        off = flat - place[own]
        spread = np.array([[mean(a * b) for b in off.T] for a in off.T]).transpose(2, 0, 1) + step**2 / 12.0 * np.eye(2)
        off = np.where(mean(values.ravel()[near]) > SHOWS, mean(misfit.ravel()[near]), np.nan)
        score = self.score + np.log(mass) + density.max()
        return [(float(score[j]), Peak(place[j], spread[j], float(off[j]))) for j in range(len(tops))]

    def given(self, k: int, crossing: Crossing, score: float, peak: "Peak") -> "Match":
        """With a peak of one more field."""
        m, V = self.shifts.of(k)
        before, after = np.linalg.inv(V), np.linalg.inv(peak.spread)
        value, axes = np.linalg.eigh(after - before)
        information = (axes * np.maximum(value, 0.0)) @ axes.T
        pull = information @ m + (information + before) @ (peak.mean - m)
        tie = Tie(crossing.knots, information, pull)
        shifts = self.shifts.given(k, information, pull)
        return Match(shifts, score, {**self.ties, k: tie}, (*self.misfits, peak.misfit))


@dataclass(frozen=True)
class Peak:
    """Of a field times what is predicted: mean [m], covariance [m^2], and squared residuals of its soundings."""

    mean: Array
    spread: Array
    misfit: float


def associate(
    lines: Sequence[Line], crossings: Sequence[Crossing], prior: Shifts, relief: Relief, chart: SmoothedChart | None
) -> tuple[list[Match], float]:
    """The best combinations of peaks, best first, and how far was looked for [m].

    Next comes the crossing that those before predict best.
    """
    step = float(np.clip(GRID * relief.length, *STEPS_M))
    matches, widest, left = [Match(prior)], 0.0, set(range(len(crossings)))
    while left:
        unsure = {k: np.linalg.eigvalsh(matches[0].shifts.of(k)[1])[-1] for k in left}
        k = min(unsure, key=lambda k: unsure[k])
        far = max(SIGMAS * float(np.sqrt(unsure[k])), SAME_M)
        most = CHART_M if crossings[k].earlier == CHART else FARTHEST_M
        if far > most:
            break
        left.remove(k)
        widest = max(widest, far)
        predicted = np.array([match.shifts.of(k)[0] for match in matches])
        spread = float(np.linalg.norm(predicted - predicted[0], axis=1).max())
        reach = min(far + spread, FARTHEST_M) + BESIDE_M
        own = _soundings_at(lines, crossings[k], predicted[0], reach, relief, chart)
        axis = np.arange(-int(far / step) - 1, int(far / step) + 2)
        window = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)
        cells = np.round(predicted / step).astype(int)[:, None, None] + window
        inside = np.array([m.far(k, step * own) for m, own in zip(matches, cells, strict=True)]) < SIGMAS
        known, which = np.unique(cells[inside], axis=0, return_inverse=True)
        field = np.full((2, *inside.shape), -np.inf)
        field[:, inside] = np.array(own.at(np.asarray(known * step, float)))[:, which.reshape(-1)]
        found = [
            (score, peak, match)
            for match, places, values, misfit in zip(matches, cells * step, *field, strict=True)
            for score, peak in match.peaks(k, places, values, misfit)
        ]
        found.sort(key=lambda one: -one[0])
        best = [one for one in found[:KEPT] if one[0] > found[0][0] - 2.0 * LEAD]
        matches = [match.given(k, crossings[k], score, peak) for score, peak, match in best]
    return matches, widest


def _robust(field: Array) -> Array:
    """A field of soundings that may be no bottom's."""
    return np.asarray(np.logaddexp(np.log1p(-FALSE) + field, np.log(FALSE)))


def _repetition(lines: Sequence[Line], far: float) -> float:
    """How far the correlation of lines of one direction with themselves rises again further on."""
    way = np.array([np.arctan2(*(line.place[-1] - line.place[0])) for line in lines])
    direction = np.round(way / (np.pi / 4.0)).astype(int) % 4
    lags = np.arange(1, int(far / CELL_M) + 1)
    most = 0.0
    for some in range(4):
        product, square, pairs = np.zeros((3, len(lags)))
        for line in (lines[k] for k in np.flatnonzero(direction == some).tolist()):
            for side in np.unique(line.across):
                own = line.across == side
                z = np.full(np.ptp(line.along[own]) + 1, np.nan)
                z[line.along[own] - line.along[own].min()] = line.depth[own]
                known = np.flatnonzero(np.isfinite(z))
                if len(known) < STRETCH // 2:
                    continue
                z[known] -= np.polyval(np.polyfit(known, z[known], 1), known)
                for j, lag in enumerate(lags[lags <= len(z) // 2]):
                    u, v = z[:-lag], z[lag:]
                    both = np.isfinite(u) & np.isfinite(v)
                    product[j] += u[both] @ v[both]
                    square[j] += 0.5 * (u[both] @ u[both] + v[both] @ v[both])
                    pairs[j] += both.sum()
        alike = (product / np.maximum(square, 1e-12))[pairs > ENOUGH_PAIRS]
        most = max(most, float((alike - np.minimum.accumulate(alike)).max(initial=0.0)))
    return most
