"""Allan deviation and what is read off it.

    sigma^2(tau) = N^2 / tau + (2 ln 2 / pi) B^2 + K^2 tau / 3

N is the noise density (angle or velocity random walk), B the bias instability, K the random walk of the
bias (IEEE Std 952, annex C). The three are fitted at once, none below zero, each point weighted by
how well a log of that length determines it. `allantools` computes the deviation.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import nnls  # type: ignore[attr-defined]
from scipy.stats import chi2  # type: ignore[attr-defined]

from rovgraph.errors import InputError
from rovgraph.geometry import Array

PER_DECADE = 8  # averaging times
LONGEST = 0.2  # averaging time, of the log
FLAT = 2.0 * np.log(2.0) / np.pi  # square of the height of the flat floor over B^2
VISIBLE = {1: 40.0, 2: 10.0}  # fall of the misfit that shows B, K; chance alone reaches it once in a hundred logs


@dataclass(frozen=True)
class Allan:
    """Allan deviation of a channel and its readings.

    Attributes
    ----------
    tau : ndarray, shape (m,), averaging times [s]
    deviation, sd : ndarray, shape (m,) [unit]
    density : N [unit/rtHz]
    density_sd : its standard deviation by the length of the log
    instability : B [unit], None where no flat floor shows
    walk : K [unit/rts], None where the log is too short to show it
    walk_limit : K is not above it (95 %) [unit/rts]
    """

    tau: Array
    deviation: Array
    sd: Array
    density: float
    density_sd: float
    instability: float | None
    walk: float | None
    walk_limit: float

    def model(self, tau: Array) -> Array:
        """The fitted deviation, shape (m,)."""
        B, K = self.instability or 0.0, self.walk or 0.0
        return np.asarray(np.sqrt(self.density**2 / tau + FLAT * B**2 + K**2 * tau / 3.0))


def allan(values: Array, rate: float) -> Allan:
    """Overlapping Allan deviation of a regular channel.

    Parameters
    ----------
    values : ndarray, shape (n,)
    rate : [Hz]

    Raises
    ------
    InputError : allantools is not installed
    """
    try:
        from allantools import oadev
    except ImportError:
        raise InputError(
            "calibrate noise needs allantools; install it with: pip install 'rovgraph[calibrate]'"
        ) from None
    n = len(values)
    most = max(int(LONGEST * n), 2)
    steps = np.unique(np.geomspace(1, most, int(PER_DECADE * np.log10(most)) + 2).round().astype(int))
    tau, deviation, *_ = oadev(values, rate=rate, data_type="freq", taus=steps / rate)
    # degrees of freedom of overlapping estimates of white noise, IEEE Std 1139
    m = np.round(tau * rate)
    freedom = np.maximum((1.5 * (n - 1) / m - 2.0 * (n - 2) / n) * 4.0 * m**2 / (4.0 * m**2 + 5.0), 1.0)
    return _read(tau, deviation, freedom, n)


def _read(tau: Array, deviation: Array, freedom: Array, n: int) -> Allan:
    variance = deviation**2
    terms = np.column_stack([1.0 / tau, np.full(len(tau), FLAT), tau / 3.0])
    squares, cost = _fit(terms, variance, freedom)
    seen: list[float | None] = []
    for i in (1, 2):
        kept = [k for k in range(3) if k != i]
        explained = _fit(terms[:, kept], variance, freedom)[1] - cost
        seen.append(float(np.sqrt(squares[i])) if explained > VISIBLE[i] else None)
    limit = np.sqrt(3.0 * variance[-1] * freedom[-1] / chi2.ppf(0.05, freedom[-1]) / tau[-1])
    return Allan(
        tau=tau,
        deviation=deviation,
        sd=deviation / np.sqrt(2.0 * freedom),
        density=float(np.sqrt(squares[0])),
        density_sd=float(np.sqrt(squares[0]) / np.sqrt(2.0 * n / 1.5)),
        instability=seen[0],
        walk=seen[1],
        walk_limit=float(limit),
    )


def _fit(terms: Array, variance: Array, freedom: Array) -> tuple[Array, float]:
    """Terms that are not negative, and twice the negative log-likelihood, each variance as a scaled chi-square.

    Weights are by the model's variance, not the measured: low points would weigh most.
    """
    expected = variance
    for _ in range(6):
        weight = np.sqrt(freedom / 2.0) / expected
        scale = np.linalg.norm(terms * weight[:, None], axis=0)
        squares = nnls(terms * weight[:, None] / scale, variance * weight)[0] / scale
        expected = np.maximum(terms @ squares, 1e-300)
    ratio = variance / expected
    return squares, float(np.sum(freedom * (ratio - np.log(ratio) - 1.0)))
