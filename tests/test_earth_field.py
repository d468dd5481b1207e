"""The Earth's field by place and date."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from dives import Simulated, altered, changed, falcon, simulated, without

from rovgraph.diagnosis.check.compasses import field_of_place
from rovgraph.errors import InputError
from rovgraph.inference.initialise import initialise
from rovgraph.log import Log
from rovgraph.model.calibration import TABLE
from rovgraph.model.config import Config, mount_matrix, parse_config
from rovgraph.model.state import State
from rovgraph.sensors.compass import declination
from rovgraph.sensors.earth_field import decimal_year, declination_per_km, earth_field


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


UNIX = 1_800_000_000.0


def shifted(log: Log, seconds: float) -> Log:
    streams = {name: replace(stream, time=stream.time + seconds) for name, stream in log.streams.items()}
    return replace(log, streams=streams, origin=(60.0, 10.0))


def unstated(config: Config, **environment: float | None) -> Config:
    """The configuration without its declination."""
    keys = config.model_dump(exclude_unset=True)
    del keys["environment"]["declination_deg"]
    keys["environment"] |= environment
    return Config.model_validate(keys)


@pytest.fixture(scope="module")
def case() -> Simulated:
    return simulated(falcon(heading={"sources": ["mag"]}), 40.0, 1, imu_rate=25.0, dvl_rate=2.0, ahrs_rate=5.0)


def test_a_magnetometer_has_the_declination_and_dip_of_place_and_date(case: Simulated) -> None:
    log = without(case.log, "ahrs", "dvl_heading", "vehicle_heading")
    there, config = shifted(log, UNIX), unstated(case.config)
    initial = initialise(there, config)
    expected = earth_field(60.0, 10.0, 0.0, decimal_year(UNIX))
    assert initial.config.environment.declination_deg == pytest.approx(expected.declination_deg, abs=0.01)
    assert any("declination_deg" in line and "WMM2025" in line for line in initial.assumptions)
    assert initial.config.calibration.mag_offset.sd_deg == pytest.approx(expected.declination_sd_deg)  # was exact
    silent = initialise(there, unstated(case.config, dip_deg=None))
    assert silent.config.environment.dip_deg == pytest.approx(expected.dip_deg, abs=0.01)
    undated = initialise(shifted(log, 0.0), config)  # the log's times count from its start
    stated = initialise(there, unstated(case.config, declination_deg=7.0))
    assert [one.config.environment.declination_deg for one in (undated, stated)] == [0.0, 7.0]
    assert stated.config.calibration.mag_offset.estimate is False


@pytest.mark.parametrize(
    ("reference", "taken", "turned"), [(None, False, 0.0), ("magnetic", True, 1.0), ("true", False, 0.0)]
)
def test_other_compasses_have_it_where_they_are_magnetic(
    case: Simulated, reference: str | None, taken: bool, turned: float
) -> None:
    config = changed(unstated(case.config), heading={"sources": ["ahrs"], "ahrs_reference": reference})
    initial = initialise(shifted(without(case.log, "mag", "dvl_heading"), UNIX), config)
    expected = earth_field(60.0, 10.0, 0.0, decimal_year(UNIX)).declination_deg
    assert initial.config.environment.declination_deg == pytest.approx(expected if taken else 0.0, abs=0.01)
    model: Any = initial.instruments["ahrs"].model
    assert np.rad2deg(model.declination) == pytest.approx(turned * expected, abs=0.01)


def test_a_declination_is_of_magnetic_headings_alone(case: Simulated) -> None:
    for heading, expected in (("magnetic", 7.0), ("true", 0.0), ("grid", -2.0), (None, 7.0)):
        config = changed(case.config, heading={"ahrs_reference": heading},
                         environment={"declination_deg": 7.0, "convergence_deg": -2.0})  # fmt: skip
        assert np.rad2deg(declination(config, "ahrs")) == pytest.approx(expected)
        assert np.rad2deg(declination(config, "mag")) == pytest.approx(7.0)


def test_true_is_a_word_in_yaml_too() -> None:
    assert parse_config("heading: {ahrs_reference: true}").heading.ahrs_reference == "true"


def test_grid_headings_have_the_convergence_of_the_grid_at_the_origin(case: Simulated) -> None:
    log = shifted(without(case.log, "mag", "dvl_heading"), UNIX)
    config = changed(unstated(case.config), heading={"sources": ["ahrs"], "ahrs_reference": "grid"})
    with pytest.raises(InputError, match=r"ahrs is relative to a grid's north, which needs environment\.grid"):
        initialise(log, config)
    pytest.importorskip("pyproj")
    spherical = np.rad2deg(np.arctan(np.tan(np.deg2rad(1.0)) * np.sin(np.pi / 3.0)))
    found = initialise(log, changed(config, environment={"grid": "EPSG:32632"})).config.environment
    assert found.convergence_deg == pytest.approx(spherical, abs=2e-4)
    with pytest.raises(InputError, match=r"EPSG:4326.*is in degrees, no grid"):
        initialise(log, changed(config, environment={"grid": "EPSG:4326"}))


def test_no_compass_is_used_in_the_blackout_zone_and_little_of_it_is_told(case: Simulated) -> None:
    log = shifted(without(case.log, "ahrs", "dvl_heading"), UNIX)
    config = changed(unstated(case.config), heading={"sources": None}, start={"heading_deg": 30.0})
    pole = initialise(replace(log, origin=(85.5, 135.0)), config)
    assert earth_field(85.5, 135.0, 0.0, decimal_year(UNIX)).horizontal_nt < 2000.0
    assert "mag" not in pole.instruments and "no heading from mag" in pole.assumptions[0]
    near = initialise(replace(log, origin=(75.0, -90.0)), config)
    assert "mag" in near.instruments and any("compasses show little here" in line for line in near.assumptions)


def test_an_expired_model_says_so(case: Simulated) -> None:
    log = shifted(without(case.log, "ahrs", "dvl_heading"), 1_950_000_000.0)  # 2031
    said = initialise(log, unstated(case.config)).assumptions
    assert any("WMM2025" in line and "ends before that date" in line for line in said)


@pytest.mark.parametrize(
    ("factor", "down", "said"),
    [
        (50.0, 0.0, ""),
        (32.0, 0.0, r"magnitude 31\.9 uT where the field is 5\d"),
        (50.0, 0.6, "dip .* where the field's is 7"),
    ],
)
def test_the_magnitude_and_the_dip_check_iron(case: Simulated, factor: float, down: float, said: str) -> None:
    log = shifted(case.log, UNIX)
    down_s = np.array([0.0, 0.0, down]) @ mount_matrix(case.config.imu.mount_rpy_deg)
    field = factor * (log["mag"].data - down_s)
    found = [*field_of_place(altered(log, "mag", field), changed(case.config, units={"mag": "uT"}))]
    assert [finding.level for finding in found] == ["warning" if said else "ok"]
    assert re.search(said, found[0].text)


def test_the_declination_changes_along_the_way(case: Simulated) -> None:
    """At 60 to 70 degrees by some hundredths of a degree a kilometre east, as the model has it 100 km away."""
    year = decimal_year(UNIX)
    for latitude in (60.0, 70.0):
        north, east = declination_per_km(latitude, 10.0, year)
        here = earth_field(latitude, 10.0, 0.0, year).declination_deg
        there = earth_field(latitude, 10.0 + 100.0 / 111.2 / np.cos(np.deg2rad(latitude)), 0.0, year).declination_deg
        assert east == pytest.approx((there - here) / 100.0, abs=5e-4) and 0.006 < east < 0.016
        assert abs(north) < 0.01
    log = shifted(without(case.log, "ahrs", "dvl_heading"), UNIX)
    initial = initialise(log, unstated(case.config))
    model: Any = initial.instruments["mag"].model
    exact = {name: np.zeros(TABLE[name].dim) for name in model.calibration}
    away = State(np.eye(3)[None], np.array([[0.0, 1e5, 0.0]]), np.zeros((1, 3)), np.zeros((1, 6)), exact)
    field, _ = model.predict(away, np.zeros((1, 3)))
    seen = model.R_bs @ field[0]
    expected = declination_per_km(60.0, 10.0, year)[1] * 100.0 + earth_field(60.0, 10.0, 0.0, year).declination_deg
    assert np.rad2deg(np.arctan2(seen[1], seen[0])) == pytest.approx(expected, abs=0.01)
