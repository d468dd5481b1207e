"""Correlated noise of sensors, found in a dive by its likelihood.

The configuration's noise is white. Here a sensor also gets an error that lasts, a first-order Gauss-Markov process of
some sd and time constant, and the likelihood tells whether it explains the dive better. With whitened rows of
priors, motions, walks and measurements, and the square root R of their information, it is

    -log L = cost + sum log |diag R| - sum log (weights of walks and priors)

which counts the error's additional freedom (Bar-Shalom et al. 2001, 11.4), so dives with and without it compare. The
likelihood also shows the part of the error that the estimate has followed, which the autocovariance of residuals does
not: fixes that are off for a minute pull the track with them.

One elimination at the optimum, with an error as large as the noise, tells whether to search; a healthy dive costs no
more. The most likely sd and time constant are those of the dive linearised at its optimum, and the dive is solved once
with them. Where the gain differs from the predicted one, the dive is linearised there for another search: fixes that
were rejected without the error are admitted with it.

A wrong constant makes residuals that look like an error that lasts, as a DVL's arm does in turns. Where a constant
makes the dive likelier, it is found instead, as an error of infinite time constant. One elimination with all constants
in the border gives the likelihood of other sds of any of them: it leaves the information and the score of the border
from all measurements. Priors are added to it, held constants are left out, and with S, s of the rest

    -2 log L = sum of the priors' squares - s' S^-1 s + log |S| + sum of log of the priors' variances

up to a term that is the same for all.

The likelihood alone prefers the most flexible error. So each error has a largest sd, by the instrument: a receiver of
1 m is not 5 m off for minutes, a moving bed easily reaches 0.3 m/s. Explanations that are each clear are rivals: the
difference of their likelihoods measures noise, not whether the right one is among them. Where rivals give different
tracks, the dive does not determine which is right.

An error may also step: a compass when a tool is carried, a depth that is zeroed, a receiver that switches its datum, a
DVL that locks onto a hull. Jumps of a sensor's residuals, rejected ones included, propose the times, and the likelihood
of the dive with these steps is compared with that of a Gauss-Markov error.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rovgraph.geometry import Array
from rovgraph.inference.chain import Chain
from rovgraph.inference.chain_optimum import ChainOptimum
from rovgraph.inference.faulty_intervals import resume
from rovgraph.inference.gauss_newton import GaussNewtonResult, rejects
from rovgraph.inference.rate_noise import ARM, rate_noise_moves_arm
from rovgraph.inference.widened_chain import begin_at, with_lasting
from rovgraph.model.calibration import TABLE
from rovgraph.model.gauss_markov import stationary_sd, stationary_walk
from rovgraph.model.state import State
from rovgraph.problem.measurements import Measurements
from rovgraph.rules import BENT

if TYPE_CHECKING:
    from scipy.optimize import OptimizeResult

WIDE = 10.0  # times the sd that a constant is believed to have, for the elimination: the measurements outweigh it


@dataclass(frozen=True)
class LinearConstants:
    """The border of a dive.

    Attributes
    ----------
    places : constant -> its components
    stated : sds of those that are estimated anyway [unit of the variable]
    off : ndarray, shape (c,), from where the dive is linearised to the means of their priors
    information, score : ndarray, shapes (c, c), (c,), by all but their priors
    """

    places: Mapping[str, slice]
    stated: Mapping[str, float]
    off: Array
    information: Array
    score: Array

    @staticmethod
    def of(chain: Chain, solution: GaussNewtonResult[State], names: Iterable[str]) -> "LinearConstants":
        """Of a dive at its optimum, with some more constants than it estimates."""
        wide = chain
        for name in names:
            if name not in chain.unknowns.walks:
                wide = with_lasting(wide, name, WIDE * chain.beliefs[name].sd, np.inf)
        point = begin_at(wide, solution.point)
        R = wide.eliminate(point, solution.gates, kept=1).border
        information, score = R[:, :-1].T @ R[:, :-1], R[:, :-1].T @ R[:, -1]
        places = {name: part for name, (border, part) in wide.layout.places.items() if border}
        off, weight = np.zeros((2, len(R)))
        for name, part in places.items():
            off[part] = wide.beliefs[name].mean - point.calibration[name]
            weight[part] = wide.beliefs[name].sd ** -2.0
        stated = {name: chain.beliefs[name].sd for name in places if name in chain.unknowns.walks}
        return LinearConstants(places, stated, off, information - np.diag(weight), score - weight * off)

    def gain(self, sds: Mapping[str, float]) -> float:
        """Of log likelihood, by constants of some sds."""
        return self._minus_log_likelihood(self.stated) - self._minus_log_likelihood({**self.stated, **sds})

    def _minus_log_likelihood(self, sds: Mapping[str, float]) -> float:
        chosen = np.concatenate([np.empty(0, np.int64), *(np.r_[self.places[name]] for name in sds)])
        sd = np.concatenate([np.empty(0), *(np.full(TABLE[name].dim, value) for name, value in sds.items())])
        off, scaled = self.off[chosen] / sd, np.outer(sd, sd)
        S = self.information[np.ix_(chosen, chosen)] * scaled + np.eye(len(sd))  # in units of the sds
        s = self.score[chosen] * sd + off
        return 0.5 * float(off @ off - s @ np.linalg.solve(S, s) + np.linalg.slogdet(S)[1])


# error -> its sensor; estimated where the dive shows it
LASTING = {name: v.sensors[0] for name, v in TABLE.items() if np.isfinite(v.time_constant) and not v.estimate}
ENOUGH = 30  # measurements
LIKELY = 3.0  # gain of log likelihood, at the optimum without the error, that is worth a look
WINDOW_S = 20.0  # over which residuals are summed
WORTH_A_LOOK = {
    "ahrs": 0.5,
    "dvl_heading": 0.5,
    "vehicle_heading": 0.5,
    "fix": 1.0,
    "depth": 0.4,  # healthy ones have at most 0.2, those with 3 cm of error that lasts 0.7
}  # least `window_chi2`; the track takes a DVL's error along
CLEAR = 8.0  # gain beyond chance: of healthy dives one in a hundred reaches 6
PART_OF_BEST = 0.25  # of the best explanation's gain, that a rival has: wrong ones had 0.46 of the right one's and more
SHORTEST = 5.0  # time constant in intervals between measurements: what is shorter is noise
SMALLEST = 0.01  # sd, in that of the table
# largest sd, in that of the table: a compass that is 10 degrees off for minutes is not swinging but broken or mirrored
LARGEST = {"dvl_error": 10.0, "depth_error": 10.0}
LARGEST_OF_OTHERS = 5.0
ROUGHLY = 2.0  # times as large an sd goes with the same error over a time constant that is longer
LARGEST_OF_FIXES = 4.6  # in their stated noise: of true ones 1.2 to 3.9 were found, where the bed moved 5.4 and more
CONSTANT = np.array([1.0, 3.0])  # sds of constants that may be the cause, in those they are believed to have
FIRST, LAST = 1.0, 0.1  # radius of the search, by logarithms
EVALUATIONS = 12  # of the likelihood in it
AS_PROMISED = 0.1  # of a gain, by which that of the linear dive may differ
STEPPING = {name: sensor for name, sensor in LASTING.items() if name != "dvl_error"}  # the bottom steps, not its slope
LARGEST_STEP = {"bottom_velocity": 1.0}  # of what else has none: a zero may be set anywhere [unit of the variable]
STEP_S, LEAST_OF_STEP = 5.0, 4  # medians of residuals that are compared: a time, and measurements
JUMP = 40.0  # of them, in chi-square
MOST_STEPS = 3
PART_OF_LARGEST = 0.1  # that a step has at least
CHANCES_OF_STEP, CHANCES_OF_SIZE = 5.0, 3.0  # logs of the times at which one may be, and of the sizes of a component
TOLERANCE = 0.3  # decrease of the cost that is left when likelihoods are compared


@dataclass(frozen=True)
class GaussMarkovError:
    """An error that was found.

    Attributes
    ----------
    sensor, variable : of `LASTING`, or a constant of that sensor
    sd, time_constant : of the process [unit of the variable, s]; infinite for a constant
    gain : of log likelihood
    steps : when it takes another value, and ndarray, shape (dim,), by how much, where it is constant otherwise
    """

    sensor: str
    variable: str
    sd: float
    time_constant: float
    gain: float
    steps: tuple[tuple[float, Array], ...] = ()


@dataclass(frozen=True)
class Rival:
    """An error that explains a dive clearly by itself.

    Attributes
    ----------
    error : so
    p_n : ndarray, shape (n, 3), where the keyframes are with it [m]
    """

    error: GaussMarkovError
    p_n: Array


def find_correlated_noise(
    best: ChainOptimum, without: Collection[str] = ()
) -> tuple[list[GaussMarkovError], list[Rival]]:
    """Errors that last, the clearest first, each sought beside those before it; and rival explanations.

    Parameters
    ----------
    best : the optimum; what it estimates is passed over
    without : calibration variables that are, too
    """
    found: list[GaussMarkovError] = []
    rivals: list[Rival] = []
    hidden = [name for name in _hidden_by_ranges(best.chain) if name not in without]
    now, passed = _Baseline.of(best), {*without, *hidden}
    while True:
        candidates = [_most_likely(now, probe) for probe in _probes(now, passed)]
        steps = _steps(now, passed)
        passed |= {c.variable for c in candidates if _implausible(now.chain, c)}  # they have another cause
        candidates = sorted((c for c in candidates if c.variable not in passed), key=lambda c: c.gain, reverse=True)
        fits = [*(_fit(now, one) for one in candidates), *(_with_steps(now, one) for one in steps)]
        fits += _reopened(now, passed) if rejects(now.solution.gates, BENT) else []
        clear = _clearest([one for one in fits if one[0].gain >= CLEAR])
        if not clear:
            break
        if not found:
            least = PART_OF_BEST * clear[0][0].gain
            rivals = [Rival(error, fitted.solution.point.p_n) for error, fitted in clear[1:] if error.gain > least]
        error, now = clear[0]
        found.append(error)
    beside = {error.variable for error in found}
    rivals = [rival for rival in rivals if rival.error.variable not in beside]
    probes = _probes(now, LASTING.keys() - {*hidden}) if hidden else []
    fits = [_fit(now, _most_likely(now, probe)) for probe in probes]
    return found, rivals + [Rival(error, fit.solution.point.p_n) for error, fit in fits if error.gain >= CLEAR]


def _hidden_by_ranges(chain: Chain) -> tuple[str, ...]:
    """The DVL's error of scale, where all else are ranges to beacons that nobody placed: it is a rival, never found.

    Such a beacon moves with the track, so the scales of the DVL and of the ranges (the speed of sound) are nearly one
    sum: both grew together to 4 % where a gyro's scale was wrong.
    """
    config, present = chain.initial.config, chain.blocks.keys()
    placed = config.ship.receivers or any(beacon.north_m is not None for beacon in config.beacons)
    return ("dvl_error",) if "range" in present and not placed and not present & {"fix", "usbl"} else ()


@dataclass(frozen=True)
class _Baseline:
    """A dive with the errors that were found so far.

    Attributes
    ----------
    chain, solution : the dive and its optimum; its point is where it is linearised
    log_determinant, least : of the information of the dive linearised there, and its least sum of squares
    """

    chain: Chain
    solution: GaussNewtonResult[State]
    log_determinant: float
    least: float

    @staticmethod
    def of(best: ChainOptimum) -> "_Baseline":
        """A dive as it was solved."""
        return _Baseline(best.chain, replace(best.solution, point=best.linearised_at), *best.linear)

    @property
    def minus_log_likelihood(self) -> float:
        return self.solution.cost + freedom(self.chain, self.log_determinant)

    def linear_gain(self, name: str, sd: float, time_constant: float) -> float:
        """Of log likelihood, by one more error, of the dive as it is linearised here."""
        wider = with_lasting(self.chain, name, sd, time_constant)
        root = wider.eliminate(begin_at(wider, self.solution.point), self.solution.gates, diagonal=True)
        without = 0.5 * self.least + freedom(self.chain, self.log_determinant)
        return without - 0.5 * root.left - freedom(wider, root.log_determinant())

    def with_error(self, name: str, sd: float, time_constant: float) -> "_Baseline":
        """The dive with one more error, solved from here."""
        wider = with_lasting(self.chain, name, sd, time_constant)
        return self._solved(wider, begin_at(wider, self.solution.point), self.solution)

    def reopened(self, chain: Chain, begin: State) -> "_Baseline":
        """The dive as another chain from a point, all measurements admitted to begin with.

        Without the error the estimate may have moved away from good ones, which their gate then rejects for good.
        """
        return self._solved(chain, begin, replace(self.solution, gates=chain.initial_gates(), stretches=()))

    @staticmethod
    def _solved(chain: Chain, begin: State, known: GaussNewtonResult[State]) -> "_Baseline":
        solution = resume(chain, begin, known, TOLERANCE)
        root = chain.eliminate(solution.point, solution.gates, diagonal=True)
        return _Baseline(chain, solution, root.log_determinant(), root.left)

    def with_steps(self, name: str, sd: float, steps: Sequence[tuple[float, Array]]) -> "_Baseline":
        """The dive with an error that takes other values at some times, solved from where that is so."""
        wider = with_lasting(self.chain, name, sd, np.inf, tuple(time for time, _ in steps))
        begin = begin_at(wider, self.solution.point)
        values = begin.calibration[name].copy()
        for time, step in steps:
            values[self.chain.problem.time >= time] += step
        return self.reopened(wider, replace(begin, calibration={**begin.calibration, name: values}))


def _clearest(fits: list[tuple[GaussMarkovError, _Baseline]]) -> list[tuple[GaussMarkovError, _Baseline]]:
    """The best explanation of each variable, the clearest first."""
    best: dict[str, tuple[GaussMarkovError, _Baseline]] = {}
    for one in sorted(fits, key=lambda fit: fit[0].gain, reverse=True):
        best.setdefault(one[0].variable, one)
    return [*best.values()]


def _steps(now: _Baseline, passed: Collection[str], beside: str = "") -> list[GaussMarkovError]:
    """Errors by which a sensor's residuals jump at some times, far more than they do otherwise.

    What is estimated is passed over, but for what has steps already.
    """
    out = []
    for name, sensor in STEPPING.items():
        block = now.chain.blocks.get(sensor)
        if block is None or len(block) < ENOUGH or name in {*now.chain.unknowns.estimated, *passed} - {beside}:
            continue
        state = now.solution.point.at(block.keyframe)
        steps = _jumps(block, state, block.by_calibration(state, name))
        if steps and max(np.linalg.norm(step) for _, step in steps) < LARGEST_STEP.get(name, np.inf):
            sd = float(np.sqrt(np.mean(np.square([step for _, step in steps]))))
            out.append(GaussMarkovError(sensor, name, sd, np.inf, 0.0, steps))
    return out


def _jumps(block: Measurements, state: State, H: Array) -> tuple[tuple[float, Array], ...]:
    """When the residuals of a sensor jump, and by how much as an error; in the order of time.

    Each measurement by itself gives the error. Medians of some seconds are compared with those after the
    next: over so short a time the IMU determines the motion, however far the estimate followed the sensor.

    Parameters
    ----------
    block, state : measurements, and their keyframes' states
    H : ndarray, shape (n, dim, k), whitened Jacobian by the error
    """
    usual = float(np.median(np.diff(block.time)))
    size = max(round(STEP_S / max(usual, 1e-3)), LEAST_OF_STEP)
    count = len(block) // size
    information = np.einsum("nij,nik->njk", H, H)[: count * size]
    if count < 2 * LEAST_OF_STEP or not np.median(np.linalg.det(information)) > 0.0:
        return ()
    single = _single(block, state, H)[: count * size]
    e = np.median(single.reshape(count, size, -1), axis=1)  # an outlier counts as one
    change = e[2:] - e[:-2]
    noise = 1.0 / (size * np.median(np.einsum("njj->nj", information), axis=0))
    variance = np.maximum((np.median(np.abs(change), axis=0) / 0.6745) ** 2, 2.0 * noise)
    clear = np.sum(change**2 / variance, axis=1)
    found: list[tuple[float, Array]] = []
    while len(found) < MOST_STEPS and clear.max(initial=0.0) > JUMP:
        k = int(np.argmax(clear))
        near = slice(k * size, (k + 3) * size)
        along = (single[near] - 0.5 * (e[k] + e[k + 2])) @ change[k]
        at = near.start + int(np.argmin(np.cumsum(np.sign(along)))) + 1
        when = 0.5 * float(block.time[at - 1] + block.time[min(at, len(block) - 1)])
        found.append((when, change[k]))
        clear[max(k - 3, 0) : k + 4] = 0.0
    return tuple(sorted(found, key=lambda one: one[0]))


def _single(block: Measurements, state: State, H: Array) -> Array:
    """How large the error is by each measurement alone, shape (n, k)."""
    r, information = block.normalised(state), np.einsum("nij,nik->njk", H, H)
    tiny = 1e-12 * np.trace(information, axis1=1, axis2=2).max() * np.eye(H.shape[2])
    return np.asarray(np.linalg.solve(information + tiny, np.einsum("nij,ni->nj", H, r)[..., None])[..., 0])


def _with_steps(now: _Baseline, error: GaussMarkovError) -> tuple[GaussMarkovError, _Baseline]:
    """Steps, with those that show only beside them, and the dive with them."""
    best = _fit_steps(now, error)
    while len(best[0].steps) < MOST_STEPS:
        more = [one for one in _steps(best[1], (), error.variable) if one.variable == error.variable]
        if not more:
            break
        steps = sorted([*best[0].steps, *more[0].steps], key=lambda one: one[0])[:MOST_STEPS]
        further = _fit_steps(now, replace(error, steps=tuple(steps)))
        if further[0].gain <= best[0].gain:
            break
        best = further
    return best


def _fit_steps(now: _Baseline, error: GaussMarkovError) -> tuple[GaussMarkovError, _Baseline]:
    """Steps with what they take off the cost, less their chances, and the dive with them.

    Costs compare where other measurements are excluded, which determinants do not.
    """
    stepped = now.with_steps(error.variable, error.sd, error.steps)
    path, time = stepped.solution.point.calibration[error.variable], now.chain.problem.time
    times = [when for when, _ in error.steps]
    after = np.minimum(time.searchsorted(times), len(path) - 1)
    sizes = path[after] - path[after - 1]
    size = np.linalg.norm(sizes, axis=1)
    real = size > PART_OF_LARGEST * size.max()
    steps = tuple((when, step) for when, step, kept in zip(times, sizes, real, strict=True) if kept)
    if not real.all():
        return _fit_steps(now, replace(error, steps=steps)) if steps else (replace(error, gain=-np.inf), stepped)
    price = len(steps) * (CHANCES_OF_STEP + CHANCES_OF_SIZE * sizes.shape[1])
    return replace(error, gain=now.solution.cost - stepped.solution.cost - price, steps=steps), stepped


def _reopened(now: _Baseline, passed: Collection[str]) -> list[tuple[GaussMarkovError, _Baseline]]:
    """Errors of the table's size, each with all measurements admitted to begin with, and the dives with them.

    Costs compare where other measurements are admitted; the likelihood where they are the same.
    """
    out, chain = [], now.chain
    plain = now.reopened(chain, now.solution.point)
    least = min(now.solution.cost, plain.solution.cost)
    for name, sensor in LASTING.items():
        if sensor not in chain.blocks or name in {*chain.unknowns.estimated, *passed}:
            continue
        sd = min(TABLE[name].sd, 0.5 * _largest(chain, name))
        seconds = float(np.clip(TABLE[name].time_constant, *_time_constants(chain, sensor)))
        wider = with_lasting(chain, name, sd, seconds)
        fitted = now.reopened(wider, begin_at(wider, now.solution.point))
        likely = _most_likely(fitted, GaussMarkovError(sensor, name, sd, seconds, 0.0))
        fitted = fitted.with_error(name, likely.sd, likely.time_constant)
        path = fitted.solution.point.calibration[name]
        if np.sqrt(np.mean(path**2)) > _largest(chain, name):
            continue
        same = chain.eliminate(now.solution.point, fitted.solution.gates, diagonal=True).log_determinant()
        price = freedom(fitted.chain, fitted.log_determinant) - freedom(chain, same)
        out.append((replace(likely, gain=least - fitted.solution.cost - price), fitted))
    return out


def _probes(now: _Baseline, passed: Collection[str]) -> list[GaussMarkovError]:
    """Errors as large as their sensors' noise with which the dive is more likely."""
    out, (chain, solution) = [], (now.chain, now.solution)
    for name, sensor in LASTING.items():
        block = chain.blocks.get(sensor)
        if block is None or len(block) < ENOUGH or name in {*chain.unknowns.estimated, *passed}:
            continue
        state = solution.point.at(block.keyframe)
        H = block.by_calibration(state, name)
        seen = np.sum(H**2, axis=(1, 2)) / H.shape[2]
        if not np.any(seen > 0.0) or window_chi2(block, state, H, solution.gates[sensor]) < WORTH_A_LOOK.get(
            sensor, 0.0
        ):
            continue
        sd = min(float(1.0 / np.sqrt(np.median(seen[seen > 0.0]))), 0.5 * _largest(chain, name))
        time_constant = float(np.clip(TABLE[name].time_constant, *_time_constants(chain, sensor)))
        gain = now.linear_gain(name, sd, time_constant)
        if gain > LIKELY:
            out.append(GaussMarkovError(sensor, name, sd, time_constant, gain))
    return out


def window_chi2(block: Measurements, state: State, H: Array, gate: NDArray[np.bool_]) -> float:
    """Correlation of a sensor's residuals over seconds: variance of sums over a time, 1 for independent noise.

    Parameters
    ----------
    block, state, gate : measurements, their keyframes' states, and which are admitted
    H : ndarray, shape (n, dim, k), whitened Jacobian by what the residuals are looked at as
    """
    r = block.normalised(state)
    r = r * (gate / np.sqrt(np.maximum(np.mean(r**2, axis=1), 1.0)))[:, None]  # an outlier counts as one
    score, information = np.einsum("nij,ni->nj", H, r), np.einsum("nij,nij->nj", H, H) * gate[:, None]
    window = ((block.time - block.time[0]) // WINDOW_S).astype(np.int64)
    sums = np.array([[np.bincount(window, column) for column in part.T] for part in (score, information)])
    windows = sums[:, sums[1] > 0.0]  # windows without admitted measurements give no value
    if not windows.size:
        return 1.0
    return float(np.mean(windows[0] ** 2 / np.maximum(windows[1], 0.1 * np.median(windows[1]))))


def _fit(now: _Baseline, candidate: GaussMarkovError) -> tuple[GaussMarkovError, _Baseline]:
    """The most likely error of a sensor, and the dive with it.

    Its gain is that over the same error as a constant, and over constants that are estimated but believed too well: a
    scale or an offset that is held wrongly is no error that lasts for a while. What of the sensor is considered is
    found instead, where that makes the dive likelier; of another sensor it is the cause, and stays considered: a DVL
    that is tilted drifts against the depth.
    """
    error, fitted = candidate, now.with_error(candidate.variable, candidate.sd, candidate.time_constant)
    gain = now.minus_log_likelihood - fitted.minus_log_likelihood
    if abs(gain - candidate.gain) > AS_PROMISED * candidate.gain:  # the optimum has moved, and with it what is likely
        error = _most_likely(fitted, replace(candidate, gain=0.0))
        fitted = fitted.with_error(error.variable, error.sd, error.time_constant)
    path = fitted.solution.point.calibration[error.variable]
    if np.sqrt(np.mean(path**2)) > _largest(now.chain, error.variable):
        return replace(error, gain=-np.inf), fitted
    gain = now.minus_log_likelihood - fitted.minus_log_likelihood
    unknowns = now.chain.unknowns
    considered = [n for n in unknowns.considered if not TABLE[n].time_offset]
    if ARM in considered and _noise_moves_arm(now):
        considered.remove(ARM)
    known = [n for n, walk in unknowns.walks.items() if walk == 0.0]
    rivals = [error.variable, *known]
    constants = LinearConstants.of(now.chain, now.solution, [*considered, *rivals])
    constant, held = _as_constant(now, error, considered, constants)
    if constant.gain >= max(gain, CLEAR):
        of_sensor = error.sensor in TABLE[constant.variable].sensors
        return (constant, held) if of_sensor else (replace(error, gain=-np.inf), fitted)
    return replace(error, gain=gain - _as_constant(now, error, rivals, constants)[0].gain), fitted


def _noise_moves_arm(now: _Baseline) -> bool:
    """Whether the gyro's noise would move the DVL's arm, were it estimated."""
    best = ChainOptimum(now.chain, now.solution)
    return rate_noise_moves_arm(best, best.relative_sd()[ARM] * best.beliefs[ARM].sd)


def _as_constant(
    now: _Baseline, error: GaussMarkovError, names: Collection[str], constants: LinearConstants
) -> tuple[GaussMarkovError, _Baseline]:
    """The constant that explains the dive best where an error might, its gain at least 0, and the dive with it."""
    rivals = [
        replace(error, variable=name, sd=sd, time_constant=np.inf, gain=constants.gain({name: sd}))
        for name in names
        for sd in (CONSTANT * now.chain.beliefs[name].sd).tolist()
        if name not in now.chain.unknowns.walks or sd > now.chain.beliefs[name].sd
    ]
    believed = now.chain.beliefs  # more than is believed must explain more
    best = max(
        rivals,
        key=lambda rival: rival.gain - LIKELY * (rival.sd > believed[rival.variable].sd),
        default=replace(error, gain=0.0),
    )
    if best.gain <= LIKELY:
        return replace(best, gain=0.0), now
    held = now.with_error(best.variable, best.sd, np.inf)
    return replace(best, gain=max(0.0, now.minus_log_likelihood - held.minus_log_likelihood)), held


def _most_likely(now: _Baseline, begin: GaussMarkovError) -> GaussMarkovError:
    """The error of a sensor that makes the linear dive the most likely, or one that is implausible and more likely.

    The data determine best how an error walks over short times, so that and the time constant are searched for: of
    sd and time constant the likelihood has a long ridge.
    """
    from scipy.optimize import minimize  # takes 0.1 s to load; healthy dives do not need it

    name, seconds = begin.variable, _time_constants(now.chain, begin.sensor)
    largest = ROUGHLY * _largest(now.chain, name)
    sds = min(SMALLEST * TABLE[name].sd, 0.1 * largest), largest
    walks = stationary_walk(sds[0], seconds[1]), stationary_walk(sds[1], seconds[0])

    def error(x: Array) -> GaussMarkovError:
        walk, time_constant = np.exp(x).tolist()
        return replace(begin, sd=stationary_sd(walk, time_constant), time_constant=time_constant)

    start = np.log([stationary_walk(begin.sd, begin.time_constant), begin.time_constant])

    def loss(x: Array) -> float:
        at = error(x)
        return -begin.gain if np.array_equal(x, start) else -now.linear_gain(name, at.sd, at.time_constant)

    def stop(intermediate_result: "OptimizeResult") -> None:
        if error(intermediate_result.x).sd > largest:
            raise StopIteration

    best = minimize(
        loss,
        start,
        method="COBYQA",
        bounds=np.log([walks, seconds]).tolist(),
        callback=stop,
        options={"initial_tr_radius": FIRST, "final_tr_radius": LAST, "maxfev": EVALUATIONS},
    )
    return replace(error(best.x), gain=-float(best.fun))


def _time_constants(chain: Chain, sensor: str) -> tuple[float, float]:
    """The shortest and the longest that is looked for [s]."""
    duration = float(chain.problem.time[-1] - chain.problem.time[0])
    shortest = SHORTEST * float(np.median(np.diff(chain.blocks[sensor].time)))
    return shortest, max(duration, shortest)


def _largest(chain: Chain, name: str) -> float:
    """The largest sd of an error that such a sensor can have."""
    if LASTING[name] == "fix":
        stated = 1.0 / np.abs(chain.blocks["fix"].W[:, 0, 0])
        return LARGEST_OF_FIXES * float(np.median(stated))
    return LARGEST.get(name, LARGEST_OF_OTHERS) * TABLE[name].sd


def _implausible(chain: Chain, error: GaussMarkovError) -> bool:
    """Whether an error has another cause: it is far larger than such a sensor's can be; its sd is known roughly."""
    return error.sd > ROUGHLY * _largest(chain, error.variable)


def freedom(chain: Chain, log_determinant: float) -> float:
    """Minus log likelihood of a dive less its cost, up to what does not change with what is estimated.

    Parameters
    ----------
    log_determinant : of its information
    """
    priors = sum(TABLE[n].dim * float(np.log(chain.beliefs[n].first_sd)) for n in chain.unknowns.estimated)
    return 0.5 * log_determinant - float(np.sum(np.log(chain.walk[0]))) + priors
