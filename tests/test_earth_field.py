"""The Earth's field by place and date."""

from dataclasses import replace

import numpy as np
import pytest
from dives import changed, falcon, simulated, without

from rovgraph.inference.initialise import initialise
from rovgraph.log import Log
from rovgraph.model.config import Config
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


def shifted(log: Log, seconds: float) -> Log:
    streams = {name: replace(stream, time=stream.time + seconds) for name, stream in log.streams.items()}
    return replace(log, streams=streams, origin=(60.0, 10.0))


def unstated(config: Config, **environment: float) -> Config:
    """The configuration without its declination."""
    keys = config.model_dump(exclude_unset=True)
    del keys["environment"]["declination_deg"]
    keys["environment"] |= environment
    return Config.model_validate(keys)


def test_a_magnetometer_alone_has_the_declination_of_place_and_date() -> None:
    case = simulated(falcon(heading={"sources": ["mag"]}), 40.0, 1, imu_rate=25.0, dvl_rate=2.0)
    log = without(case.log, "ahrs", "dvl_heading", "vehicle_heading")
    there, config = shifted(log, 1_800_000_000.0), unstated(case.config)
    initial = initialise(there, config)
    expected = earth_field(60.0, 10.0, 0.0, decimal_year(1_800_000_000.0)).declination_deg
    assert initial.config.environment.declination_deg == pytest.approx(expected, abs=0.01)
    assert any("declination_deg" in line and "WMM2025" in line for line in initial.assumptions)
    undated = initialise(shifted(log, 0.0), config)  # the log's times count from its start
    stated = initialise(there, unstated(case.config, declination_deg=7.0))
    other = initialise(there, changed(config, heading={"sources": None}))
    found = [one.config.environment.declination_deg for one in (undated, stated)]
    assert found == [0.0, 7.0] and other.config.environment.declination_deg == pytest.approx(expected, abs=0.01)
