"""The Earth's field by place and date."""

import numpy as np
import pytest

from rovgraph.sensors.earth_field import decimal_year, earth_field


@pytest.mark.parametrize(
    ("place", "xyz", "declination"),
    [
        ((80.0, 0.0), (6521.6, 145.9, 54791.5), 1.28),
        ((0.0, 120.0), (39677.8, -109.6, -10580.2), -0.16),
        ((-80.0, 240.0), (6117.5, 15751.9, -52022.5), 68.78),
    ],
)
def test_the_field_has_the_published_values(
    place: tuple[float, float], xyz: tuple[float, float, float], declination: float
) -> None:
    """NOAA's test values of WMM2025 at the surface, 2025.0, to their printed digits."""
    field = earth_field(*place, 0.0, 2025.0)
    np.testing.assert_allclose([field.north_nt, field.east_nt, field.down_nt], xyz, atol=0.0501)
    assert field.declination_deg == pytest.approx(declination, abs=0.00501)
    assert not field.expired


def test_its_sd_has_a_floor_and_grows_towards_the_magnetic_pole() -> None:
    assert earth_field(0.0, 120.0, 0.0, 2025.0).declination_sd_deg == 0.5
    polar = earth_field(80.0, 0.0, 0.0, 2025.0)
    assert polar.declination_sd_deg == pytest.approx(np.hypot(0.26, 5417.0 / polar.horizontal_nt), rel=1e-6)


def test_a_date_beyond_the_model_is_marked() -> None:
    assert decimal_year(1735689600.0) == 2025.0  # 2025-01-01
    assert [earth_field(60.0, 10.0, 0.0, year).expired for year in (2024.9, 2025.0, 2030.0, 2030.1)] == [1, 0, 0, 1]
