"""Errors that last, found in a dive by its likelihood.

The configuration's noise is white. Here a sensor gets an error that lasts, too, a first-order Gauss-Markov process of
some sd and time constant, and the likelihood says whether the dive is better explained with it. With whitened rows of
priors, motions, walks and measurements, and the square root R of their information, it is

    -log L = cost + sum log |diag R| - sum log (weights of walks and priors)

which counts what the error's freedom costs (Bar-Shalom et al. 2001, 11.4), so dives with and without it compare. It
sees the error through all that the estimate has followed of it, where the autocovariance of residuals would not: fixes
that are off for a minute take the track along. One elimination at the optimum, with an error as large as the noise,
tells whether to look for more; that is all that a healthy dive costs.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from rovgraph.calibration import TABLE, stationary_walk
from rovgraph.engine.chain import Chain
from rovgraph.engine.chain_information import SquareRoot
from rovgraph.engine.chain_optimum import ChainOptimum
from rovgraph.engine.gauss_newton import Gates, Solution, minimise
from rovgraph.engine.measurements import Block
from rovgraph.geometry import Array
from rovgraph.state import State

LASTING = {v.sensors[0]: name for name, v in TABLE.items() if np.isfinite(v.time_constant)}  # sensor -> its error
ENOUGH = 30  # measurements
LIKELY = 3.0  # gain of log likelihood, at the optimum without the error, that is worth a look
WINDOW_S = 20.0  # over which residuals are summed
WORTH_A_LOOK = {"ahrs": 0.5, "dvl_heading": 0.5, "fix": 1.0}  # least `unity`; the track takes a DVL's error along
CLEAR = 8.0  # gain that is no chance: of healthy dives one in a hundred comes to 6
LONGEST = 1.0  # time constant, in the length of the dive
IMPLAUSIBLE = 10.0  # sd, in that of the table: a heading that is mirrored is no noise
NO_GROUND = 0.5  # the same of a velocity's fraction that is the IMU's own scale rather than the bottom
CONSTANT = np.array([1.0, 10.0])  # sds of the same error as a constant, in that of the table
SHORTEST = 5.0  # the same in intervals between measurements: what is shorter is noise
LARGEST = 100.0  # sd, in that of the table
SPREADS = (1.0, 0.3)  # of the search, of sd and time constant by their logarithms, each from an optimum
EVALUATIONS = 20  # of the likelihood in each
TOLERANCE = 0.3  # decrease of the cost that is left when likelihoods are compared


@dataclass(frozen=True)
class LastingError:
    """An error that was found.

    Attributes
    ----------
    sensor, variable : of `LASTING`
    sd, time_constant : of the process [unit of the variable, s]
    gain : of log likelihood
    """

    sensor: str
    variable: str
    sd: float
    time_constant: float
    gain: float


Fit = tuple[LastingError, Chain, Solution[State]]


def find_lasting(best: ChainOptimum, without: Collection[str] = ()) -> list[LastingError]:
    """Errors that last, the clearest first, each looked for beside those before it.

    Parameters
    ----------
    best : the optimum; what it estimates is passed over
    without : calibration variables that are, too
    """
    found: list[LastingError] = []
    chain, solution = best.chain, best.solution
    root = chain.eliminate(solution.point, solution.gates)
    while likely := _likely(chain, solution, root, without):
        known = _minus_log_likelihood(chain, root, solution.cost)
        fits = [_fit(chain, solution, sensor, known) for sensor in likely]
        clearest, fitted, after = max(fits, key=lambda fit: fit[0].gain)
        if clearest.gain < CLEAR:
            break
        found.append(clearest)
        chain, solution = fitted, after
        root = chain.eliminate(solution.point, solution.gates)
    return found


def _likely(chain: Chain, solution: Solution[State], root: SquareRoot, without: Collection[str]) -> list[str]:
    """Sensors with which an error that is as large as their noise makes the dive more likely."""
    known, out = _minus_log_likelihood(chain, root, 0.5 * root.left), []
    for sensor, name in LASTING.items():
        block = chain.blocks.get(sensor)
        if block is None or len(block) < ENOUGH or name in {*chain.unknowns.estimated, *without}:
            continue
        state = solution.point.at(block.keyframe)
        H = block.by_calibration(state, name)
        seen = np.sum(H**2, axis=(1, 2)) / H.shape[2]
        if not np.any(seen > 0.0) or unity(block, state, H, solution.gates[sensor]) < WORTH_A_LOOK.get(sensor, 0.0):
            continue
        wider = _with(chain, name, float(1.0 / np.sqrt(np.median(seen[seen > 0.0]))), TABLE[name].time_constant)
        if known - _linear(wider, solution.point, solution.gates) > LIKELY:
            out.append(sensor)
    return out


def unity(block: Block, state: State, H: Array, gate: NDArray[np.bool_]) -> float:
    """How far a sensor's residuals go together for seconds: variance of sums over a time, 1 for independent noise.

    Parameters
    ----------
    block, state, gate : measurements, their keyframes' states, and which are let in
    H : ndarray, shape (n, dim, k), whitened Jacobian by what the residuals are looked at as
    """
    r = block.normalised(state)
    r = r * (gate / np.sqrt(np.maximum(np.mean(r**2, axis=1), 1.0)))[:, None]  # an outlier counts as one
    score, information = np.einsum("nij,ni->nj", H, r), np.einsum("nij,nij->nj", H, H) * gate[:, None]
    window = ((block.time - block.time[0]) // WINDOW_S).astype(np.int64)
    sums = np.array([[np.bincount(window, column) for column in part.T] for part in (score, information)])
    return float(np.mean(sums[0] ** 2 / np.maximum(sums[1], 0.1 * np.median(sums[1]))))


def _fit(chain: Chain, solution: Solution[State], sensor: str, known: float) -> Fit:
    """The most likely error of a sensor, the chain with it among its unknowns, and the optimum of that.

    Its gain is that over the same error as a constant, where that is more likely than none: a scale or an offset that
    is held wrongly is no error that lasts for a while.
    """
    name, interval = LASTING[sensor], float(np.median(np.diff(chain.blocks[sensor].time)))
    duration = float(chain.rows.time[-1] - chain.rows.time[0])
    shortest = SHORTEST * interval
    least, wider, after = _most_likely(chain, solution, name, shortest, max(LONGEST * duration, shortest))
    if known - least >= CLEAR:
        known = min(
            [known, *(_solved(_with(chain, name, sd, np.inf), solution)[0] for sd in CONSTANT * TABLE[name].sd)]
        )
    sd, time_constant = wider.beliefs[name].sd, wider.beliefs[name].time_constant
    other_cause = name == "dvl_error" and time_constant > NO_GROUND * duration
    gain = -np.inf if other_cause or sd > IMPLAUSIBLE * TABLE[name].sd else known - least
    return LastingError(sensor, name, sd, time_constant, gain), wider, after


def _most_likely(
    chain: Chain, solution: Solution[State], name: str, shortest: float, longest: float
) -> tuple[float, Chain, Solution[State]]:
    """The least minus log likelihood with an error of a time constant within bounds [s], its chain and optimum."""
    low = np.log([TABLE[name].sd / LARGEST, shortest])
    high = np.log([TABLE[name].sd * LARGEST, longest])
    x, least, wider = np.clip(np.log([TABLE[name].sd, TABLE[name].time_constant]), low, high), np.inf, chain
    for spread in SPREADS:
        x = _search(chain, solution, name, x, spread, low, high)
        wider = _with(chain, name, *np.exp(x).tolist())
        least, solution = _solved(wider, solution)
    return least, wider, solution


def _solved(chain: Chain, near: Solution[State]) -> tuple[float, Solution[State]]:
    """Minus log likelihood of a dive, and its optimum, from that of one close by."""
    solution = minimise(chain, _begin(chain, near.point), tolerance=TOLERANCE)
    root = chain.eliminate(solution.point, solution.gates)
    return _minus_log_likelihood(chain, root, solution.cost), solution


def _search(
    chain: Chain, solution: Solution[State], name: str, x: Array, spread: float, low: Array, high: Array
) -> Array:
    """Logarithms of sd and time constant, shape (2,), that make the dive linearised at an optimum the most likely."""

    def value(x: Array) -> float:
        inside = np.clip(x, low, high)
        outside = float(np.sum((x - inside) ** 2))
        return outside + _linear(_with(chain, name, *np.exp(inside).tolist()), solution.point, solution.gates)

    simplex = x + spread * np.array([[0.0, 0.0], [-1.0, 0.0], [0.0, -0.7]])
    options = {"maxfev": EVALUATIONS, "xatol": 0.05, "fatol": 0.1, "initial_simplex": simplex}
    return np.asarray(np.clip(minimize(value, x, method="Nelder-Mead", options=options).x, low, high))


def _begin(chain: Chain, point: State) -> State:
    """A point of a chain, from one of a chain with other unknowns."""
    n, calibration = len(chain.intervals), dict(point.calibration)
    for name in chain.layout.walking:
        calibration[name] = np.array(np.broadcast_to(calibration[name], (n, TABLE[name].dim)))
    return replace(point, calibration=calibration)


def _with(chain: Chain, name: str, sd: float, time_constant: float) -> Chain:
    """The chain with an error that lasts among its unknowns; one of infinite time constant is constant."""
    walk = stationary_walk(sd, time_constant)
    believed = replace(chain.beliefs[name], estimate=True, sd=sd, walk=walk, time_constant=time_constant)
    return replace(chain, beliefs={**chain.beliefs, name: believed}, unknowns=chain.unknowns.with_lasting(believed))


def _linear(chain: Chain, point: State, gates: Gates) -> float:
    """Minus log likelihood of the dive linearised at a point, where that is least."""
    root = chain.eliminate(_begin(chain, point), gates)
    return _minus_log_likelihood(chain, root, 0.5 * root.left)


def _minus_log_likelihood(chain: Chain, root: SquareRoot, cost: float) -> float:
    """Of a dive that costs as much, up to what does not change with the errors that last."""
    diagonals = np.diagonal(root.conditionals, axis1=1, axis2=2), np.diagonal(root.border)
    freedom = sum(float(np.sum(np.log(np.abs(d)))) for d in diagonals)
    own = [name for name in LASTING.values() if name in chain.unknowns.estimated]
    priors = sum(TABLE[name].dim * np.log(chain.beliefs[name].sd) for name in own)
    return cost + freedom - float(np.sum(np.log(chain.walk[0]))) + float(priors)
