"""Quantiles of chi-square and tails of binomial distributions, for limits that chance alone seldom exceeds.

`scipy.special` has them too (``chdtri``, ``bdtrc``) and takes a tenth of a second to load, in each command. Both are
sums whose terms fall from the first on, so that they keep all digits.
"""

import math
from functools import cache
from statistics import NormalDist

import numpy as np


@cache
def chi_square_quantile(count: int, chance: float) -> float:
    """What the sum of squares of ``count`` standard normal numbers exceeds by a chance, 0 < chance < 1; 0 of none.

    Newton's method for ln Q, from the approximation of Wilson and Hilferty. With y half the sum, a = count / 2 - 1 and
    p = y^a e^-y / Gamma(a + 1),

        Q = p (1 + a / y + a (a - 1) / y^2 + ...) + (erfc(sqrt(y)) if count is odd),  Q' = -p
    """
    if count < 1:
        return 0.0
    a, spread = count / 2.0 - 1.0, 2.0 / (9.0 * count)
    falling = a - np.arange(min(count // 2 - 1, 200 + int(60.0 * math.sqrt(count))))  # later terms are nothing
    y = 0.5 * count * max(1.0 - spread - NormalDist().inv_cdf(chance) * math.sqrt(spread), 0.1) ** 3
    for _ in range(50):
        density = math.exp(a * math.log(y) - y - math.lgamma(a + 1.0))
        tail = density * (1.0 + float(np.cumprod(falling / y).sum())) if count > 1 else 0.0
        tail += math.erfc(math.sqrt(y)) if count % 2 else 0.0
        step = tail / density * math.log(tail / chance)
        y = max(y + step, 0.1 * y)
        if abs(step) < 1e-13 * y:
            break
    return 2.0 * y


@cache
def binomial_tail(most: int, trials: int, share: float) -> float:
    """Chance of more than ``most`` successes in ``trials``, each of chance ``share``, 0 <= share <= 1."""
    if not (0 <= most < trials and 0.0 < share < 1.0):
        return float(most < 0 or (most < trials and share > 0.0))
    odds, above = share / (1.0 - share), most + 1.0 > trials * share
    k = most + 1 if above else most
    more = np.arange(k, trials) if above else np.arange(k, 0, -1)
    ratios = (trials - more) / (more + 1.0) * odds if above else more / (trials - more + 1.0) / odds
    ways = math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials - k + 1)
    chance = math.exp(ways + k * math.log(share) + (trials - k) * math.log1p(-share))
    beyond = chance * (1.0 + float(np.cumprod(ratios).sum()))
    return beyond if above else 1.0 - beyond
