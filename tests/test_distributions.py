"""Quantiles and tails against those of scipy."""

import numpy as np
import pytest
from scipy.special import bdtrc, chdtri

from rovgraph.distributions import binomial_tail, chi_square_quantile


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 10, 51, 1000, 2691, 48_001, 360_000])
def test_quantiles_of_chi_square_are_those_of_scipy(count):
    chances = [0.95, 0.5, 0.05, 1e-6, 1e-6 / 48_000]
    assert [chi_square_quantile(count, p) for p in chances] == pytest.approx(chdtri(count, chances), rel=2e-10)


def test_of_no_number_the_sum_is_nothing():
    assert chi_square_quantile(0, 1e-6) == chdtri(0, 1e-6) == 0.0


@pytest.mark.parametrize("share", [0.01, 0.4, 0.97])
@pytest.mark.parametrize("trials", [1, 2, 5, 30, 601, 48_000])
def test_tails_of_the_binomial_are_those_of_scipy(trials, share):
    some = np.unique([-1, 0, 1, 2, trials // 10, trials // 3, trials // 2, trials - 1, trials])
    some = some[some <= trials]
    found = [binomial_tail(int(k), trials, share) for k in some]
    assert found == pytest.approx(bdtrc(some, np.int64(trials), share), rel=1e-9, abs=1e-300)


def test_more_successes_than_trials_have_no_chance():
    assert binomial_tail(3, 2, 0.1) == binomial_tail(0, 0, 0.1) == 0.0
