"""How far two clocks are apart, by the motion that both recordings show.

Every lag is searched first (`comparisons`). The best one counts where it explains the motion far better than any
other, and least squares then give the offset and the drift with their standard deviations, these by leaving out one
part of the dive after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rovgraph.check.lags import PARTS, normal_equations, spread
from rovgraph.geometry import Array
from rovgraph.interchange.comparisons import Comparison, coarse_step, comparisons
from rovgraph.interchange.motion import Motion
from rovgraph.rules import EPOCH_SD_S

LEAST_OVERLAP = 30.0  # [s]
OVERLAP = 0.3  # of the shorter recording
FOLLOWS = 0.3  # part of the motion's square that has to be explained
EVIDENCE = 40.0  # in chi-square, that the best lag is better than any other
DRIFT_SD = 1e-4  # of crystals, their prior
ITERATIONS = 20
HELD = 3  # of them with the lag held, until mountings fit
HOLD = 1e18  # information
LARGEST_STEP = 0.25  # windows of lag at a time
RIVAL = 0.6  # of the best evidence, from which a lag is refined, too
MOST_RIVALS = 10
FAR = 0.02  # of the best evidence, that others fall short
SAME = 4.0  # standard deviations between lags that are one
TINY = 1e-9  # information, that no step is undetermined
SETTLED = 1e-5  # [s]
CLIPPED = 5.0  # differences larger than so many times the usual one do not count
DIFFERENCE = 0.05  # over which derivatives with respect to the lag are taken [s]


@dataclass(frozen=True)
class Offset:
    """How much later clock B is than clock A: ``t_b = t_a + seconds + drift (t_a - at)``.

    Attributes
    ----------
    seconds, sd : at the time ``at`` of clock A [s]
    drift, drift_sd : of B against A
    at : middle of the overlap, by clock A [s]
    overlap : that both recordings know [s]
    explained : part of the motion's square that the two share
    how : what was compared
    """

    seconds: float
    sd: float
    drift: float
    drift_sd: float
    at: float
    overlap: float
    explained: float
    how: str

    def reversed(self) -> "Offset":
        """How much later clock A is than B."""
        at, drift = self.at + self.seconds, -self.drift / (1.0 + self.drift)
        return Offset(-self.seconds, self.sd, drift, self.drift_sd, at, self.overlap, self.explained, self.how)


def find_offset(a: Motion, b: Motion) -> Offset | None:
    """The offset of two recordings' clocks, by all quantities that both show; None where these do not tell.

    Candidates are the lags at which all together agree best; each is refined by every quantity. The best candidate
    counts if it explains the motion far better than any other, and the quantity with the least sd gives its offset.
    """
    searched = [_search(comparison, sign) for comparison, sign in comparisons(a, b) if _long_enough(comparison)]
    if not searched:
        return None
    step = min(coarse_step(each.comparison) for each in searched)
    lags = np.arange(min(each.lags[0] for each in searched), max(each.lags[-1] for each in searched), step)
    evidence = np.sum([np.interp(lags, each.lags, each.evidence, 0.0, 0.0) for each in searched], axis=0)
    peaks = _peaks(evidence)
    if not peaks.size:
        return None
    rivals = peaks[evidence[peaks] > RIVAL * evidence[peaks[0]]][:MOST_RIVALS]
    found = [(candidate, k) for k in rivals if (candidate := _candidate(searched, float(lags[k]))) is not None]
    found.sort(key=lambda each: -each[0][1])
    if not found:
        return None
    (offset, best), at = found[0]
    others = [total for (other, total), _ in found[1:] if _differ(other, offset)]
    unrefined = float(evidence[peaks[len(rivals)]]) if len(rivals) < len(peaks) else 0.0
    second = max([unrefined * best / float(evidence[at]), *others])  # refined, it may gain as much as the best one
    certain = offset.sd < EPOCH_SD_S and best - second > max(EVIDENCE, FAR * best)
    return offset if certain else None


@dataclass(frozen=True)
class _Searched:
    """One quantity, and how much better two recordings agree in it than by chance, in chi-square.

    Attributes
    ----------
    comparison : with the roles of both exchanged where sign is -1
    sign : of the comparison's lags
    lags, evidence : ndarray, shape (l,), lags as those of B against A, increasing [s]
    parameters : ndarray, shape (l, p)
    """

    comparison: Comparison
    sign: float
    lags: Array
    evidence: Array
    parameters: Array

    def refined(self, lag: float) -> tuple[Offset, float] | None:
        """The offset near a lag, and its evidence."""
        near = np.abs(self.lags - lag) <= self.comparison.window
        k = int(np.argmax(np.where(near, self.evidence, -np.inf)))
        fit = _refined(self.comparison, self.sign * float(self.lags[k]), self.parameters[k])
        if fit is None or fit[0].explained < FOLLOWS:
            return None
        return (fit[0] if self.sign > 0.0 else fit[0].reversed()), fit[1]


def _long_enough(comparison: Comparison) -> bool:
    return min(float(np.ptp(span)) for span in comparison.spans) >= LEAST_OVERLAP


def _search(comparison: Comparison, sign: float) -> _Searched:
    sums = comparison.search(coarse_step(comparison))
    least = max(LEAST_OVERLAP, OVERLAP * min(float(np.ptp(span)) for span in comparison.spans))
    evidence = np.log(sums.total / sums.error) * sums.seconds / comparison.window
    evidence = np.where(sums.seconds >= least, evidence, 0.0)
    order = slice(None) if sign > 0.0 else slice(None, None, -1)
    return _Searched(comparison, sign, sign * sums.lags[order], evidence[order], sums.parameters[order])


def _candidate(searched: Sequence[_Searched], lag: float) -> tuple[Offset, float] | None:
    """The most certain offset near a lag, and the evidence of all quantities that show the same one."""
    fits = [fit for each in searched if (fit := each.refined(lag)) is not None]
    if not fits:
        return None
    best = min(fits, key=lambda fit: fit[0].sd)[0]
    return best, sum(evidence for offset, evidence in fits if not _differ(offset, best))


def _differ(one: Offset, other: Offset) -> bool:
    """Whether two offsets are not the same within their sd, at the middle of the first."""
    apart = one.seconds - other.seconds - other.drift * (one.at - other.at)
    return abs(apart) > SAME * float(np.hypot(one.sd, other.sd))


def _peaks(evidence: Array) -> NDArray[np.int64]:
    """Indices of the local maxima, the largest first."""
    padded = np.concatenate([[-np.inf], evidence, [-np.inf]])
    maxima = np.flatnonzero((padded[1:-1] >= padded[:-2]) & (padded[1:-1] > padded[2:]) & (evidence > 0.0))
    return np.asarray(maxima[np.argsort(-evidence[maxima])])


def _refined(comparison: Comparison, lag: float, parameters: Array) -> tuple[Offset, float] | None:
    """Least squares from a lag, and its evidence; None where too little is known there."""
    (begin_a, end_a), (begin_b, end_b) = comparison.spans
    begin, end = max(begin_a, begin_b - lag), min(end_a, end_b - lag)
    step, at = coarse_step(comparison), 0.5 * (begin + end)
    times = np.arange(begin, end, step)
    shown = comparison.observed(times)
    seconds, drift, farthest = lag, 0.0, LARGEST_STEP * comparison.window
    fit = _step(comparison, times - at, times, shown, (seconds, drift), parameters, held=True)
    for k in range(ITERATIONS):
        if fit is None:
            return None
        seconds, drift = seconds + float(np.clip(fit.move[0], -farthest, farthest)), drift + float(fit.move[1])
        parameters = comparison.moved(parameters, fit.move[2:])
        settled = k > HELD and abs(fit.move[0]) < SETTLED
        fit = _step(comparison, times - at, times, shown, (seconds, drift), parameters, held=k < HELD)
        if settled:
            break
    if fit is None:
        return None
    overlap = fit.known * step
    sd, drift_sd = (float(value) for value in fit.sd)
    offset = Offset(seconds, sd, drift, drift_sd, at, overlap, fit.explained, comparison.name)
    return offset, -float(np.log(max(1.0 - fit.explained, 1e-9))) * overlap / comparison.window


@dataclass(frozen=True)
class _Fit:
    """One step of Gauss and Newton: of offset, drift and parameters, with the sd of the first two."""

    move: Array
    sd: Array
    explained: float
    known: int


def _step(
    comparison: Comparison,
    since: Array,
    times: Array,
    shown: tuple[Array, Array],
    clock: tuple[float, float],
    parameters: Array,
    held: bool,
) -> _Fit | None:
    """Linearise and solve, with the clock held or not; None where too little is known."""
    others = times + clock[0] + clock[1] * since
    y, shown_too = shown
    X, earlier, later = (comparison.regressors(shown_too, others + h * DIFFERENCE) for h in (0.0, -0.5, 0.5))
    known = np.isfinite(y).all(axis=1) & np.isfinite(X + earlier + later).all(axis=(1, 2))
    if np.count_nonzero(known) < 4 * PARTS:
        return None
    left = y[known] - X[known] @ parameters
    by_lag = (later - earlier)[known] @ parameters / DIFFERENCE
    J = np.concatenate(
        [by_lag[..., None], (since[known, None] * by_lag)[..., None], X[known] @ comparison.tangent(parameters)], axis=2
    )
    size = np.sum(left**2, axis=1)
    usable = size <= CLIPPED**2 * max(float(np.median(size)), 1e-12)
    J, left, seen = J[usable], left[usable], y[known][usable]
    variance = max(float(np.mean(left**2)), 1e-18)
    H, g = normal_equations(J, left, variance)
    prior = TINY + np.concatenate([[0.0, 0.0], comparison.information])
    information = H.sum(axis=0) + np.diag(prior)
    without = np.linalg.solve(information - H, (g.sum(axis=0) - g)[..., None])[:, 0, 0]
    sd = np.hypot(spread(without), comparison.floor_s)
    wider = max(1.0, float(sd) / float(np.sqrt(np.linalg.inv(information)[0, 0]))) ** 2
    prior[1] += DRIFT_SD**-2
    prior[:2] += HOLD if held else 0.0
    information = H.sum(axis=0) / wider + np.diag(prior)
    towards = g.sum(axis=0) / wider
    towards[1] -= clock[1] * DRIFT_SD**-2
    move, covariance = np.linalg.solve(information, towards), np.linalg.inv(information)
    explained = 1.0 - float(np.sum(left**2)) / max(float(np.sum((seen - seen.mean(axis=0)) ** 2)), 1e-18)
    return _Fit(move, np.sqrt(np.diag(covariance)[:2]), explained, int(np.count_nonzero(known)))
