"""What all comparisons of motions share: correlations over lags, their peak, and how sure a fit is."""

import numpy as np
import pytest

from rovgraph.diagnosis.check.lags import ORIENTATIONS, PARTS, correlate, normal_equations, peak, spread


@pytest.mark.parametrize(("n", "m"), [(50, 80), (80, 50), (7, 7)])
@pytest.mark.parametrize("reach", [3, None])
def test_correlations_are_sums_of_products_at_every_lag(n, m, reach):
    rng = np.random.default_rng(n)
    a, b = rng.normal(size=(n, 2)), rng.normal(size=(m, 3))
    first, last = (1 - n, m - 1) if reach is None else (-reach, reach)
    found = correlate(a, b, first, last)
    assert found.shape == (2, 3, last - first + 1)
    for lag in range(first, last + 1):
        t = np.arange(max(0, -lag), min(n, m - lag))
        np.testing.assert_allclose(found[..., lag - first], a[t].T @ b[t + lag], atol=1e-12)


def test_a_peak_lies_between_even_lags_and_not_at_their_ends():
    lags = np.arange(-1.0, 1.05, 0.1)
    assert peak(lags, 1.0 - (lags - 0.237) ** 2) == pytest.approx(0.237)
    assert np.isnan(peak(lags, lags)) and np.isnan(peak(lags, -lags))


def test_the_spread_of_a_mean_by_leaving_out_parts_is_its_standard_deviation():
    rng = np.random.default_rng(1)
    left = 2.0 + rng.normal(size=(5000, 1))
    H, g = normal_equations(np.ones((5000, 1, 1)), left, 1.0)
    assert H.sum() == pytest.approx(5000.0) and g.sum() == pytest.approx(left.sum())
    without = ((g.sum(axis=0) - g) / (H.sum(axis=0) - H)[:, 0])[:, 0]
    assert without.shape == (PARTS,)
    assert float(spread(without)) == pytest.approx(1.0 / np.sqrt(5000.0), rel=0.5)


def test_the_first_way_to_name_axes_is_as_they_are():
    assert ORIENTATIONS.shape == (48, 3, 3)
    np.testing.assert_array_equal(ORIENTATIONS[0], np.eye(3))
