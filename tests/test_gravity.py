"""Gravity by latitude and depth where the configuration states none."""

import numpy as np
import pytest
from dives import changed, falcon, simulated

from rovgraph.inference.initialise import initialise
from rovgraph.kernels.earth import GRAVITY_PER_DEPTH, normal_gravity
from rovgraph.model.config import Config
from rovgraph.simulate.dive import specific_force_and_rate
from rovgraph.simulate.path import Motion


def test_normal_gravity_has_the_published_values() -> None:
    """WGS 84 by latitude; 1000 dbar at 45 degrees as TEOS-10's gravity has it."""
    published = [9.7803253, 9.7932473, 9.8061978, 9.8191770, 9.8321849]
    np.testing.assert_allclose(normal_gravity(np.deg2rad([0, 30, 45, 60, 90])), published, atol=5e-8)
    assert normal_gravity(np.deg2rad(45.0)) + 992.1 * GRAVITY_PER_DEPTH == pytest.approx(9.8083928, abs=1e-5)


@pytest.mark.parametrize(
    ("environment", "expected", "said"),
    [
        ({}, 9.81, False),
        ({"latitude_deg": 60.0}, 9.8192, True),
        ({"latitude_deg": -60.0}, 9.8192, True),
        ({"origin_lat_deg": 0.0, "origin_lon_deg": 3.0}, 9.7803, True),
        ({"latitude_deg": 60.0, "gravity_mps2": 9.8}, 9.8, False),
    ],
)
def test_a_dive_has_the_gravity_of_its_place(environment: dict[str, float], expected: float, said: bool) -> None:
    case = simulated(falcon(), 40.0, 1, imu_rate=25.0, dvl_rate=2.0)
    config = changed(case.config, environment={"gravity_mps2": None, "latitude_deg": None, **environment})
    initial = initialise(case.log, config)
    assert initial.gravity == initial.config.environment.gravity_mps2 == pytest.approx(expected, abs=5e-5)
    lines = [line for line in initial.assumptions if "gravity_mps2" in line]
    assert len(lines) == said and all("latitude" in line and f"{expected:.4f}" in line for line in lines)


def test_simulated_accelerometers_feel_gravity_grow_with_depth() -> None:
    n, down = 2, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1000.0]])
    still = np.zeros((n, 3))
    motion = Motion(np.arange(2.0), np.tile(np.eye(3), (n, 1, 1)), down, still, still, still, still)
    config = Config().changed(environment={"latitude_deg": 45.0})
    np.testing.assert_allclose(specific_force_and_rate(motion, config)[:, 2], [-9.8061978, -9.8084138], atol=1e-6)
    stated = falcon(environment={"gravity_mps2": 9.81, "latitude_deg": 45.0})
    np.testing.assert_array_equal(specific_force_and_rate(motion, stated)[:, 2], [-9.81, -9.81])
