"""Crossovers: where a survey crosses its own lines, or runs one again, its soundings must agree.

Soundings of a line A about its crossing with an earlier line B say how far the track's error e has changed between,
north and east: the shift d = e(a) - e(b). Its log likelihood is a field over d,

    L(d) = log p(z_A | z_B, d) - log p(z_A | z_B, no common relief)

with the relief of `rovgraph.inference.relief`, in which heights and slopes of both lines are free: tide, depth sensor
and trim. A piece of a line on a chart has such a field, too. One field has many peaks, of which a third to a half of
the highest are wrong. So all crossings of a survey are associated together, as in multiple hypothesis tracking: the
joint covariance of the track correlates their shifts, each hypothesis is a normal distribution of all shifts, and each
crossing splits it into one for every peak of its field, and one in which its soundings are not the bottom's. Used is
what all hypotheses within `LEAD` of the best agree about.

What a field says of a shift, beside the track and the other crossings, is found from moments about its peak
(expectation propagation, Minka 2001), not from its curvature there: the noise of a loop closure between two times.

Rotation and scale of the whole track leave no shift where it crosses itself: crossovers cannot see them.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

from rovgraph.geometry import Array
from rovgraph.inference.bottom import Bottom
from rovgraph.inference.chart import ChartField, ChartFile, DepthChart, SmoothedChart
from rovgraph.inference.closed_chain import ClosedChain
from rovgraph.inference.drift import Drift, LoopClosure, condition
from rovgraph.inference.estimate import Estimate, calibration_estimates
from rovgraph.inference.optimum import NEWEST, estimated_parts
from rovgraph.inference.posterior import Posterior
from rovgraph.inference.relief import CELL_M, SLOPE, Line, Relief, fit_relief, lines_of, repetition
from rovgraph.inference.smoother import estimate_of
from rovgraph.inference.trajectory import Trajectory
from rovgraph.model.calibration import CHART, CHART_PLACE, Belief
from rovgraph.model.origin import Origin

KNOT_S, KNOTS = 10.0, 1000  # between knots of the drift, and how many at most
PIECE_M, CHART_PIECE_M = 25.0, 50.0  # of a line that is run again, or on a chart, matched by itself
ON_CHART = -1  # "earlier line" of a crossing
BESIDE_M = 6.0  # from the crossing and the range of the search, soundings that show something
LEAST_CELLS, MOST_CELLS = 4, 80  # soundings of either line at a crossing
GRID, STEPS_M = 0.2, (0.4, 1.2)  # step of a field: of the relief's length, its limits
TOGETHER = 32  # shifts of a field, whose matrices fit into a processor's cache
SIGMAS, FARTHEST_M, CHART_M = 3.5, 40.0, 250.0  # range of the search about what is predicted, and on a chart
FALSE = 0.05  # prior share of crossings whose soundings are not those of the bottom
HYPOTHESES = 100  # at most
LEAD = 10.0  # log likelihood over the next hypothesis [nats]; those behind by twice as much are dropped
SAME_M = 2.5  # shifts closer than that are the same
ENOUGH = 3  # crossings
AGREE = 0.5  # share of the crossings about which all likely hypotheses must agree
REPEATS = 0.8  # rise of the correlation of lines with themselves: sand waves
ROUNDS = 3  # of the search, each with crossings where the one before has them


@dataclass(frozen=True)
class Crossing:
    """Where a line crosses an earlier one, or runs over a piece of it again, or a piece of a line on a chart.

    Attributes
    ----------
    line, earlier : numbers of the lines, `ON_CHART` of the chart
    times : of both there, inf of the chart [s]
    centre : ndarray, shape (2,), north and east of the earlier line, or of the piece [m]
    """

    line: int
    earlier: int
    times: tuple[float, float]
    centre: Array


@dataclass(frozen=True)
class Crossovers:
    """What crossings of a survey's lines say.

    Attributes
    ----------
    relief : of the bottom
    crossings : of its lines
    closures : of those that were matched
    refused : why nothing is used, or ""
    chart : why the chart is not, or ""
    """

    relief: Relief
    crossings: Sequence[Crossing] = ()
    closures: Sequence[LoopClosure] = ()
    refused: str = ""
    chart: str = ""

    @property
    def matched(self) -> list[bool]:
        """Which crossings were."""
        times = {closure.times for closure in self.closures}
        return [c.times in times for c in self.crossings]

    def as_dict(self) -> dict[str, object]:
        """For summary.json."""
        relief = {"relief_sd_m": self.relief.sd, "relief_length_m": self.relief.length}
        return {**relief, "time_s": [c.times[0] for c in self.crossings], "matched": self.matched}

    @property
    def text(self) -> str:
        """One line for people."""
        chart = f"; the chart is not used: {self.chart}" if self.chart else ""
        if self.refused:
            return f"crossovers: nothing is used: {self.refused}{chart}"
        counts = []
        for name, charted in (("crossings of the survey's lines", False), ("pieces on the chart", True)):
            own = [m for c, m in zip(self.crossings, self.matched, strict=True) if (c.earlier == ON_CHART) == charted]
            counts += [f"{sum(own)} of {len(own)} {name}"] if own else []
        relief = f"relief of {self.relief.sd:.2f} m over {self.relief.length:.1f} m"
        return f"crossovers: {' and '.join(counts)} matched, by {relief}{chart}"


def drift_of(estimate: Estimate, lines: Sequence[Line]) -> Drift:
    """Errors of a smoothed track at its knots, the ends of lines among them, by its joint covariance."""
    track, posterior = estimate.trajectory, estimate.posterior
    assert posterior is not None
    apart = max(KNOT_S, (track.time[-1] - track.time[0]) / KNOTS)
    times = np.append(np.arange(track.time[0], track.time[-1], apart), track.time[-1])
    ends = [end for line in lines for end in line.centre[0][[0, -1]]]
    keyframes = np.unique(np.searchsorted(track.time, [*times, *ends]).clip(max=len(track) - 1))
    return Drift(track.time[keyframes], np.zeros(2 * len(keyframes)), posterior.horizontal(keyframes.tolist()))


def with_crossovers(
    estimate: Estimate, bottom: Bottom, beliefs: Mapping[str, Belief], chart: ChartFile | None, origin: Origin
) -> tuple[Estimate, Crossovers]:
    """A smoothed dive corrected where its soundings show the drift of its track, and what they showed.

    Parameters
    ----------
    estimate : smoothed, with its joint covariance
    bottom : under it
    beliefs : calibration variables, `CHART_PLACE` among them
    chart, origin : of the same bottom, and latitude and longitude of north = east = 0
    """
    place = beliefs[CHART_PLACE]
    left, found = matched(estimate, bottom, beliefs, chart, origin)
    if found.closures:
        assert estimate.posterior is not None
        best, left = closed(estimate.posterior, left, found.closures)
        estimate = estimate_of(best, _relative_sd(best, estimate.posterior), estimate.posterior.initial)
    if chart is not None:
        shown = {CHART_PLACE: left.P[-2:, -2:]} if place.estimate else {}
        values = {CHART_PLACE: left.mean[-2:] if place.estimate else place.mean}
        rows = calibration_estimates({CHART_PLACE: place}, [CHART], values, shown)
        estimate = replace(estimate, calibration=[*estimate.calibration, *rows])
    return estimate, found


def closed(posterior: Posterior, drift: Drift, closures: Sequence[LoopClosure]) -> tuple[ClosedChain, Drift]:
    """A smoothed dive given loop closures, and what is left of its drift at the keyframes about their times.

    The second-order part of heading errors is no part of the chain. It follows from the covariance after the closures.

    Parameters
    ----------
    posterior : of the dive
    drift : of `matched`
    """
    ends = np.unique([c.times for c in closures])
    after = np.searchsorted(posterior.time, ends[np.isfinite(ends)]).clip(1, len(posterior.time) - 1)
    keyframes = np.union1d(after - 1, after)
    P = posterior.of_chain(keyframes.tolist())
    around = replace(drift, time=posterior.time[keyframes], mean=np.zeros(len(P)), P=P)
    if np.isinf(drift.time[-1]):
        around = around.beside(drift.mean[-2:], float(np.sqrt(drift.P[-1, -1])))
    pull, root = (a[: len(P)] for a in around.shows(closures))
    return ClosedChain.of(posterior.optimum, keyframes, P, pull, root), around.given(closures)


def _relative_sd(best: ClosedChain, before: Posterior) -> dict[str, Array]:
    """`Posterior.relative_sd`, of which closures leave as large a part as of the sd."""
    part = np.sqrt(np.diag(best.newest_covariance()) / np.diag(before.optimum.newest_covariance()))[NEWEST:]
    places = estimated_parts(best)
    return {name: sd * part[places[name]] for name, sd in before.relative_sd.items() if name in places}


def matched(
    estimate: Estimate, bottom: Bottom, beliefs: Mapping[str, Belief], chart: ChartFile | None, origin: Origin
) -> tuple[Drift, Crossovers]:
    """The drift of a smoothed track, and what its soundings show of it; parameters of `with_crossovers`.

    With a chart, the last knot of the drift is that of the chart.
    """
    track, lines = estimate.trajectory, lines_over(estimate.trajectory, bottom)
    drift = replace(drift_of(estimate, lines), beams_sd=_beams_sd(bottom, track))
    around, place = None, beliefs[CHART_PLACE]
    if chart is not None:
        drift = drift.beside(place.mean, place.sd if place.estimate or place.considered else 0.0)
        reach = min(SIGMAS * float(np.sqrt(np.diag(drift.P).max())), CHART_M) + PIECE_M
        around = chart.around(track.p_n[:, :2].min(axis=0) - reach, track.p_n[:, :2].max(axis=0) + reach, origin)
    return drift, match(lines, drift, around)


def lines_over(track: Trajectory, bottom: Bottom) -> list[Line]:
    """The straight parts of a track, with the soundings under it."""
    used = _used(bottom)
    soundings = (used[names].to_numpy() for names in ("time", ["north", "east"], "depth"))
    return lines_of(track.time, track.rpy[:, 2], track.p_n[:, :2], *soundings)


def _used(bottom: Bottom) -> pd.DataFrame:
    return bottom.soundings[bottom.soundings["used"] == 1]


def _beams_sd(bottom: Bottom, track: Trajectory) -> float:
    """Of where soundings are beside the track's error."""
    soundings = _used(bottom)
    variance = soundings["north_sd"] ** 2 + soundings["east_sd"] ** 2
    error = np.interp(soundings["time"], track.time, track.cov_p[:, 0, 0] + track.cov_p[:, 1, 1])
    return float(np.sqrt(np.median(np.maximum(variance - error, 0.0)) / 2.0))


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
    known = None if chart is None or off else chart.smoothed(relief)
    pieces = [c for k in range(len(lines)) for c in pieces_of(lines, k)] if known is not None else []
    for _ in range(ROUNDS):
        crossings = pieces + [c for k in range(1, len(lines)) for c in crossings_of(lines, k, track)]
        closures, refused = _match(lines, crossings, drift, relief, known)
        if not closures:
            break
        before, track = track, drift.given(closures)
        if np.abs(track.mean - before.mean).max() < BESIDE_M:
            break
    return Crossovers(relief, crossings, closures, refused, off)


def _match(
    lines: Sequence[Line], crossings: Sequence[Crossing], drift: Drift, relief: Relief, chart: SmoothedChart | None
) -> tuple[list[LoopClosure], str]:
    """Loop closures, or why there are none."""
    if len(crossings) < ENOUGH:
        return [], f"lines cross or run again fewer than {ENOUGH} times"
    if not relief.shows:
        return [], f"the bottom shows no relief above the noise of its soundings, {relief.noise:.2f} m"
    hypotheses, reach = associate(lines, crossings, drift, relief, chart)
    best = hypotheses[0]
    likely = np.array([h.mean for h in hypotheses if h.score > best.score - LEAD]).reshape(-1, len(crossings), 2)
    spread = np.linalg.norm(likely - likely[0], axis=2).max(axis=0)
    closures = [closure for k, closure in best.closures.items() if spread[k] < SAME_M]
    gates = (
        (repetition(lines, 2.0 * reach) > REPEATS, "the bottom repeats itself, as sand waves do"),
        (best.score < LEAD, "soundings of its lines do not match"),
        (len(closures) < max(ENOUGH, AGREE * best.seen), "another match is nearly as likely"),
    )
    refused = next((why for fails, why in gates if fails), "")
    return ([], refused) if refused else (closures, "")


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
                out.append(Crossing(k, j, (float(t[a]), float(t_b[b])), own_b[b]))
    return out


def pieces_of(lines: Sequence[Line], k: int) -> list[Crossing]:
    """Pieces of a line that are on a chart."""
    t, p, _ = lines[k].centre
    count = max(round(len(t) * CELL_M / CHART_PIECE_M), 1)
    middle = [own[len(own) // 2] for own in np.array_split(np.arange(len(t)), count)]
    return [Crossing(k, ON_CHART, (float(t[a]), np.inf), p[a]) for a in middle]


class Field:
    """Log likelihood of the shift at a crossing over that of no common relief; places count from the crossing."""

    def __init__(self, a: tuple[Array, Array], b: tuple[Array, Array], relief: Relief) -> None:
        (self._x, z), (self._y, w), self._relief = a, b, relief
        own = [relief.of_line(p) + self._common(p, p, np.zeros((1, 2)))[0] for p in (self._x, self._y)]
        self._own, self._z = own[0], z - z.mean()
        self._root = np.linalg.inv(np.linalg.cholesky(own[1]))
        self._known = self._root @ (w - w.mean())
        self._none = self._likelihood(np.zeros((1, len(z), len(w))))[0]

    def _common(self, x: Array, y: Array, shifts: Array) -> Array:
        """Covariance of the bottom's depth at places x + shift and y, shape (g, n, m)."""
        north, east = ((x[:, None, k] - y[:, k]) + shifts[:, None, None, k] for k in (0, 1))
        r = np.sqrt(north * north + east * east)
        return self._relief.covariance(r) + SLOPE**2 * x @ y.T  # what a slope does over the shift is height

    def _likelihood(self, common: Array) -> Array:
        """Of g covariances of both lines."""
        V, n = common @ self._root.T, len(self._z)
        off = self._z - V @ self._known
        bordered = np.empty((len(V), n + 1, n + 1))  # the last row of its root has the white residuals
        bordered[:, :n, :n] = self._own - V @ np.swapaxes(V, 1, 2)
        bordered[:, n, :n] = off
        bordered[:, n, n] = 1.0 + (off**2).sum(axis=1) / self._relief.noise**2
        L = np.linalg.cholesky(bordered)
        chi2 = (L[:, n, :n] ** 2).sum(axis=1)
        return np.asarray(-0.5 * chi2 - np.log(np.diagonal(L, axis1=1, axis2=2)[:, :n]).sum(axis=1))

    def at(self, shifts: Array) -> Array:
        """The field at g shifts, shape (g,)."""
        parts = [shifts[k : k + TOGETHER] for k in range(0, len(shifts), TOGETHER)]
        fields = [self._likelihood(self._common(self._x, self._y, part)) for part in parts]
        return np.asarray(np.concatenate(fields) - self._none)

    def expected_information(self) -> Array:
        """Fisher's information on the shift where there is none, shape (2, 2) [1/m^2]: what a match is worth."""
        h = 0.1 * self._relief.length
        shifts = h * np.array([(0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)])
        none, *moved = self._common(self._x, self._y, shifts)
        n, root = len(self._x), np.linalg.inv(self._root)
        weight = np.linalg.inv(np.block([[self._own, none], [none.T, root @ root.T]]))
        by = np.zeros((2, *weight.shape))
        for one, ahead, behind in zip(by, moved[::2], moved[1::2], strict=True):
            one[:n, n:] = (ahead - behind) / (2.0 * h)
            one[n:, :n] = one[:n, n:].T
        by = weight @ by
        return np.asarray(0.5 * np.einsum("aij,bji->ab", by, by))


def field_at(
    lines: Sequence[Line],
    crossing: Crossing,
    predicted: Array,
    reach: float,
    relief: Relief,
    chart: SmoothedChart | None,
) -> Field | ChartField:
    """Of soundings in reach of a crossing; where the depth of one line alone jumps, nearer than that: fish."""
    if crossing.earlier == ON_CHART and chart is not None:
        line = lines[crossing.line]
        own = np.linalg.norm(line.place - crossing.centre, axis=1) < CHART_PIECE_M / 2.0
        return ChartField(line.place[own], line.depth[own], chart, relief)
    both, cells = (lines[crossing.line], lines[crossing.earlier]), []
    for line, moved in zip(both, (predicted, np.zeros(2)), strict=True):
        off = np.linalg.norm(line.place + moved - crossing.centre, axis=1)
        cells.append(np.argsort(off)[: np.clip((off < reach).sum(), LEAST_CELLS, MOST_CELLS)])
    ends = [np.append(np.flatnonzero(line.jumps[own]), MOST_CELLS)[0] for line, own in zip(both, cells, strict=True)]
    if max(ends) == MOST_CELLS:  # of rocks and walls both lines show the ends
        cells = [own[: max(end, LEAST_CELLS)] for own, end in zip(cells, ends, strict=True)]
    a, b = ((line.place[own] - crossing.centre, line.depth[own]) for line, own in zip(both, cells, strict=True))
    return Field(a, b, relief)


@dataclass(frozen=True)
class Hypothesis:
    """Shifts at k crossings, with one peak of each field so far, or none: a normal distribution.

    Attributes
    ----------
    mean, P : ndarray, shapes (2 k,), (2 k, 2 k) [m, m^2]
    score : log likelihood of the soundings over that without common relief
    closures : number of a crossing -> what its peak says
    seen : crossings so far
    """

    mean: Array
    P: Array
    score: float = 0.0
    closures: Mapping[int, LoopClosure] = field(default_factory=dict)
    seen: int = 0

    @property
    def sd(self) -> Array:
        """Of each shift, shape (k,) [m]."""
        return np.asarray(np.sqrt(np.diag(self.P).reshape(-1, 2).sum(axis=1)))

    def shift(self, k: int) -> tuple[Array, Array]:
        """Mean and covariance at one crossing."""
        own = slice(2 * k, 2 * k + 2)
        return self.mean[own], self.P[own, own]

    def reach(self, k: int) -> float:
        """How far from there the shift may be [m]."""
        return SIGMAS * float(np.sqrt(np.linalg.eigvalsh(self.shift(k)[1])[-1]))

    def distance2(self, k: int, shifts: Array) -> Array:
        """Of shifts at a crossing from what is predicted [sd^2]."""
        m, V = self.shift(k)
        return np.asarray(((shifts - m) @ np.linalg.inv(V) * (shifts - m)).sum(axis=-1))

    def branches(
        self, k: int, times: tuple[float, float], step: float, places: Array, L: Array, far: Array
    ) -> "list[Hypothesis]":
        """One for each peak of a field times what is predicted, and one in which its soundings are not the bottom's.

        Parameters
        ----------
        k, times : the crossing
        step, places : of a lattice of shifts, and these, ndarray, shape (n, m, 2) [m]
        L, far : ndarray, shape (n, m), the field there (-inf where it is not known), and squared distances from what is
            predicted [sd^2]
        """
        from scipy.ndimage import maximum_filter  # type: ignore[attr-defined]
        from scipy.spatial import KDTree

        m, V = self.shift(k)
        density = L - 0.5 * far + np.log(step**2 / (2.0 * np.pi)) - 0.5 * np.linalg.slogdet(V)[1]
        local = density == maximum_filter(density, 2 * int(SAME_M / step) + 1)
        tops = np.argwhere(local & (density > density.max() - 2.0 * LEAD))
        near = density > density.max() - 3.0 * LEAD
        flat, weight = places[near], np.exp(density[near] - density.max())
        own = KDTree(places[tuple(tops.T)]).query(flat)[1]
        mass = np.bincount(own, weight, len(tops))

        def mean(x: Array) -> Array:
            return np.asarray(np.bincount(own, weight * x, len(tops)) / mass)

        place = np.stack([mean(x) for x in flat.T], axis=-1)
        off = flat - place[own]
        spread = np.array([[mean(a * b) for b in off.T] for a in off.T]).transpose(2, 0, 1) + step**2 / 12.0 * np.eye(2)
        score = self.score + np.log1p(-FALSE) + np.log(mass) + density.max()
        out = [replace(self, score=self.score + float(np.log(FALSE)), seen=self.seen + 1)]
        before, H = np.linalg.inv(V), np.eye(2, len(self.mean), 2 * k)
        for j in range(len(tops)):
            value, axes = np.linalg.eigh(np.linalg.inv(spread[j]) - before)
            information = (axes * np.maximum(value, 0.0)) @ axes.T
            pull = information @ m + (information + before) @ (place[j] - m)
            closures = {**self.closures, k: LoopClosure(times, information, pull)}
            moved = condition(self.mean, self.P, H, information, pull)
            out.append(Hypothesis(*moved, float(score[j]), closures, self.seen + 1))
        return out


def associate(
    lines: Sequence[Line], crossings: Sequence[Crossing], drift: Drift, relief: Relief, chart: SmoothedChart | None
) -> tuple[list[Hypothesis], float]:
    """Hypotheses about all shifts, best first, and how far was looked for the best one's [m].

    Next comes the crossing that the best hypothesis predicts best.
    """
    from scipy.ndimage import find_objects  # type: ignore[attr-defined]

    step = float(np.clip(GRID * relief.length, *STEPS_M))
    ends = [c.times for c in crossings]
    H = drift.between(ends)
    prior = Hypothesis(H @ drift.mean, H @ drift.P @ H.T + np.diag(drift.beams(ends)))
    hypotheses, widest, left = [prior], 0.0, set(range(len(crossings)))
    while left:
        k = min(left, key=lambda k: hypotheses[0].sd[k])
        most = CHART_M if crossings[k].earlier == ON_CHART else FARTHEST_M
        if hypotheses[0].reach(k) > most:
            break
        left.remove(k)
        widest = max(widest, hypotheses[0].reach(k))
        predicted = np.array([h.shift(k)[0] for h in hypotheses])
        reach = np.array([min(h.reach(k), most) for h in hypotheses])[:, None]
        low, high = (predicted - reach).min(axis=0), (predicted + reach).max(axis=0)
        axes = [step * np.arange(np.floor(a / step), np.ceil(b / step) + 1) for a, b in zip(low, high, strict=True)]
        shifts = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
        far = [h.distance2(k, shifts) for h in hypotheses]
        inside = [own <= max(SIGMAS**2, own.min()) for own in far]  # at least the nearest
        known = np.any(inside, axis=0)
        beyond = float(np.linalg.norm(shifts[known] - predicted[0], axis=1).max())
        near = field_at(lines, crossings[k], predicted[0], min(beyond, FARTHEST_M) + BESIDE_M, relief, chart)
        L, branches = np.full(known.shape, -np.inf), []
        L[known] = near.at(shifts[known])
        for hypothesis, own, distance2 in zip(hypotheses, inside, far, strict=True):
            (box,) = find_objects(own.astype(int))
            there = np.where(own[box], L[box], -np.inf)
            branches += hypothesis.branches(k, ends[k], step, shifts[box], there, distance2[box])
        hypotheses = _pruned(branches)
    return hypotheses, widest


def _pruned(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The best, best first, without those far behind and those that say the same as a better one."""
    hypotheses = sorted(hypotheses, key=lambda h: -h.score)
    hypotheses = [h for h in hypotheses if h.score > hypotheses[0].score - 2.0 * LEAD]
    mean = np.array([h.mean for h in hypotheses]).reshape(len(hypotheses), -1, 2)
    sd = np.array([h.sd for h in hypotheses])
    kept: list[int] = []
    for k in range(len(hypotheses)):
        beyond = np.linalg.norm(mean[kept] - mean[k], axis=2) + SIGMAS * (sd[k] - sd[kept]).clip(min=0.0)
        if not (beyond.max(axis=1) < SAME_M).any():
            kept.append(k)
        if len(kept) == HYPOTHESES:
            break
    return [hypotheses[k] for k in kept]
