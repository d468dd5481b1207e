"""Where a dive begins, and what a configuration leaves to the log."""

import numpy as np
import pytest
from dives import altered, as_log, changed, falcon, without

from rovgraph.config import Config
from rovgraph.errors import InputError
from rovgraph.estimators.initialise import MOVING_TILT_SD, initialise, sample_density
from rovgraph.geometry import rpy_from_matrix, wrap_angle
from rovgraph.log import Log
from rovgraph.simulate import Style, Truth, scenario, simulate


def dive(config: Config, noise: bool = True, seed: int = 5, rest: float = 10.0, **truth: object):
    path = scenario("lawnmower", 60.0, style=Style(rest=rest))
    return simulate(path, Truth(config, noise=noise, **truth), np.random.default_rng(seed))  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def config() -> Config:
    return falcon()


@pytest.fixture(scope="module")
def perfect(config):
    return dive(config, noise=False, ahrs_rate=20.0)


@pytest.fixture(scope="module")
def log(perfect) -> Log:
    return as_log(perfect.log_frame)


def begin_rpy(log: Log, config: Config):
    return rpy_from_matrix(initialise(log, config).start.state.R_nb[0])


def test_a_vehicle_at_rest_is_levelled_by_gravity(perfect, log, config):
    rpy = begin_rpy(log, config)
    np.testing.assert_allclose(rpy[:2], perfect.truth.rpy[0, :2], atol=np.deg2rad(0.1))


@pytest.mark.parametrize("source", ["mag", "ahrs", "dvl"])
def test_heading_comes_from_any_source_alone(perfect, log, config, source):
    own = changed(config, heading={"sources": [source]})
    assert abs(wrap_angle(begin_rpy(log, own)[2] - perfect.truth.rpy[0, 2])) < np.deg2rad(0.2)


def test_an_explicit_start_goes_before_the_log(log, config):
    start = {"heading_deg": 123.0, "roll_deg": 2.0, "pitch_deg": -3.0, "north_m": 7.0, "down_m": 9.0}
    got = initialise(log, changed(config, start=start))
    np.testing.assert_allclose(np.rad2deg(rpy_from_matrix(got.start.state.R_nb[0])), [2.0, -3.0, 123.0], atol=1e-9)
    at_imu = got.start.state.R_nb[0] @ np.array(config.imu.lever_arm_m)
    np.testing.assert_allclose(got.start.state.p_n[0] - at_imu, [7.0, 0.0, 9.0], atol=1e-9)


def test_a_start_in_motion_is_levelled_with_a_larger_sd(config):
    moving = dive(config, rest=0.0)
    frame = moving.log_frame[moving.log_frame["time"] > moving.log_frame["time"].iloc[0] + 20.0].copy()
    rng = np.random.default_rng(0)
    shaken = as_log(frame)
    imu = shaken["imu"].data.copy()
    imu[:, :3] += 0.5 * np.sin(3.0 * shaken["imu"].time)[:, None] + 0.01 * rng.standard_normal((len(imu), 3))
    got = initialise(altered(shaken, "imu", imu), config)
    assert got.start.rpy_sd[0] == pytest.approx(MOVING_TILT_SD)
    assert any("in motion" in line for line in got.assumptions)
    k = int(np.searchsorted(moving.truth.time, shaken["imu"].time[0]))
    error = rpy_from_matrix(got.start.state.R_nb[0])[:2] - moving.truth.rpy[k, :2]
    assert np.abs(error).max() < MOVING_TILT_SD


def test_the_gyros_bias_is_taken_from_standing_still(config):
    bias = np.array([0.0, 0.0, 0.0, 4e-3, -3e-3, 5e-3])
    got = initialise(as_log(dive(config, bias=bias).log_frame), config)
    assert (np.abs(got.start.state.bias[0, 3:] - bias[3:]) < 3.0 * got.start.bias_sd[3:]).all()
    assert (got.start.bias_sd[3:] < np.deg2rad(config.imu.gyr_bias_sd_dps)).all()


def test_noise_is_raised_to_what_the_samples_scatter_and_only_then(config):
    honest = as_log(dive(config).log_frame)
    assert initialise(honest, config).config.imu.noise == config.imu.noise
    noisy = honest["imu"].data.copy()
    density = 4.0 * config.imu.noise.gyr
    noisy[:, 3:] += density * 10.0 * np.random.default_rng(1).standard_normal((len(noisy), 3))
    got = initialise(altered(honest, "imu", noisy), config)
    assert got.config.imu.noise.gyr == pytest.approx(np.hypot(density, config.imu.noise.gyr), rel=0.05)
    assert got.config.imu.noise.acc == config.imu.noise.acc
    assert any("imu.noise.gyr" in line for line in got.assumptions)


def test_the_scatter_of_white_noise_is_its_density():
    rng, rate = np.random.default_rng(2), 50.0
    samples = 0.3 * np.sqrt(rate) * rng.standard_normal((20_000, 3))
    assert sample_density(np.arange(20_000) / rate, samples) == pytest.approx(0.3, rel=0.02)


def test_field_and_dip_come_from_the_log_where_they_are_null(log, config):
    free = changed(config, environment={"field_norm": None, "dip_deg": None})
    environment = initialise(log, free).config.environment
    assert environment.field_norm == pytest.approx(config.environment.field_norm or 1.0, rel=0.01)
    assert environment.dip_deg == pytest.approx(config.environment.dip_deg, abs=0.5)


def test_the_start_is_at_the_first_fix_unless_it_is_given(config):
    fixed = dive(config, noise=False, fix_interval=1.0)
    frame = fixed.log_frame.copy()
    frame["fix_north"] += 50.0
    free = Config.model_validate({k: v for k, v in config.model_dump(exclude_unset=True).items() if k != "start"})
    p_n = initialise(as_log(frame), free).start.state.p_n[0]
    assert p_n[0] == pytest.approx(50.0, abs=1.0)
    given = changed(free, start={"north_m": 3.0, "east_m": 0.0})
    assert initialise(as_log(frame), given).start.state.p_n[0, 0] == pytest.approx(3.0, abs=1.0)


@pytest.mark.parametrize(
    ("missing", "says"),
    [(("imu",), "IMU"), (("dvl",), "DVL"), (("mag", "ahrs", "dvl_heading"), "start.heading_deg")],
)
def test_what_is_missing_is_named(log, config, missing, says):
    with pytest.raises(InputError, match=says):
        initialise(without(log, *missing), config)


def test_without_a_compass_a_given_heading_is_enough_and_said_to_drift(log, config):
    bare = without(log, "mag", "ahrs", "dvl_heading")
    got = initialise(bare, changed(config, start={"heading_deg": 10.0}))
    assert any("drift" in line for line in got.assumptions)


def test_earth_rotation_needs_a_latitude(log):
    with pytest.raises(InputError, match="latitude_deg"):
        initialise(log, Config.model_validate({"environment": {"earth_rotation": True}}))
