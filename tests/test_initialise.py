"""Where a dive begins: from the log where the configuration is silent, else from the configuration."""

from dataclasses import replace

import numpy as np
import pytest
from dives import (
    LIVELY,
    Simulated,
    altered,
    attitude_errors,
    batch,
    changed,
    falcon,
    kept,
    level_log,
    simulated,
    true_at,
    without,
)

from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, rpy_from_matrix, wrap_angle
from rovgraph.inference.initialise import UNKNOWN_HEADING_SD, by_accuracy, initialise
from rovgraph.inference.resolve import sample_density
from rovgraph.inference.trajectory import Trajectory
from rovgraph.log import Log
from rovgraph.model.config import Config, parse_config
from rovgraph.model.state import State
from rovgraph.problem.initial_conditions import StatePrior
from rovgraph.simulate import Path, Style, scenario
from rovgraph.simulate.scenario import SCENARIOS

DEG = np.deg2rad(1.0)
G = 9.81


def still(rpy_deg, heading_deg=30.0, noise=0.0, seconds=10.0, gyr=(0.0, 0.0, 0.0), seed=0, **sensors):
    """A log at rest at some attitude, with pings and a compass that stay still too."""
    rng = np.random.default_rng(seed)
    R = matrix_from_rpy(np.deg2rad(rpy_deg))
    acc = -R.T @ [0.0, 0.0, G]
    at = np.arange(0.1, seconds, 0.2)
    pings = np.tile([0.0, 0.0, 0.0, 1.0, np.nan], (len(at), 1))
    heading = np.full((len(at), 1), np.deg2rad(heading_deg))
    log = level_log(seconds, acc, np.asarray(gyr, float), dvl=(at, pings), dvl_heading=(at, heading), **sensors)
    return altered(log, "imu", log["imu"].data + noise * rng.standard_normal(log["imu"].data.shape))


def start_of(log, config=None):
    """Roll, pitch, yaw of the start [deg] and the whole initial conditions."""
    b = initialise(log, config or Config())
    return np.rad2deg(rpy_from_matrix(b.prior.state.R_nb[0])), b


@pytest.mark.parametrize("roll", [-25.0, 0.0, 40.0])
@pytest.mark.parametrize("pitch", [-35.0, 0.0, 20.0])
def test_a_tilted_start_is_levelled_by_gravity(roll, pitch):
    rpy, b = start_of(still((roll, pitch, 0.0)))
    np.testing.assert_allclose(rpy[:2], [roll, pitch], atol=0.01)
    np.testing.assert_allclose(b.prior.rpy_sd[:2], Config().start.tilt_sd_deg * DEG)
    assert not any("in motion" in line for line in b.assumptions)


def test_gravity_is_read_through_the_mounting_of_the_imu():
    config = parse_config("imu: {mount_rpy_deg: [180, 0, 0]}")
    turned = still((0.0, 0.0, 0.0))
    data = turned["imu"].data * [1, -1, -1, 1, -1, -1]
    np.testing.assert_allclose(start_of(altered(turned, "imu", data), config)[0][:2], 0.0, atol=0.01)
    assert abs(start_of(turned, config)[0][0]) > 170.0  # the wrong mounting is upside down


@pytest.mark.parametrize(("bias_sd_dps", "shown"), [(0.2, True), (3e-4, False), (1.4e-5, False)])
def test_a_gyro_at_rest_reads_the_earths_rate_and_a_good_one_no_bias(bias_sd_dps, shown):
    """At latitude 60, heading east; what a good gyro reads in five seconds is the Earth, and no motion."""
    earth = 7.292115e-5 * np.array([0.0, -0.5, -np.sqrt(0.75)])
    config = parse_config(f"""
        environment: {{latitude_deg: 60, earth_rotation: true}}
        imu: {{gyr_bias_sd_dps: {bias_sd_dps}, noise: {{gyr: 3.5e-6}}}}""")
    rpy, b = start_of(still((0.0, 0.0, 0.0), heading_deg=90.0, gyr=earth), config)
    assert rpy[2] == pytest.approx(90.0, abs=0.1)
    assert not any("in motion" in line for line in b.assumptions)
    np.testing.assert_allclose(b.prior.rpy_sd[:2], Config().start.tilt_sd_deg * DEG)
    np.testing.assert_allclose(b.prior.state.bias[0, 3:], 0.0, atol=1e-9)
    assert any("gyro bias from the first" in line for line in b.assumptions) == shown


def in_motion(seed=4):
    """A dive that is cut out of another: under way from its first second."""
    case = simulated(falcon(), 120.0, seed=seed, style=LIVELY)
    log = case.log
    for sensor in log.streams:
        log = kept(log, sensor, log[sensor].time > 40.0)
    return case, log


def test_a_start_in_motion_is_less_sure_of_its_level():
    _, log = in_motion()
    b = initialise(log, falcon())
    assert (b.prior.rpy_sd[:2] > 2.0 * falcon().start.tilt_sd_deg * DEG).all()
    assert any("begins in motion" in line for line in b.assumptions)
    assert not any("assumed to be at rest" in line for line in b.assumptions)


def test_a_prior_about_the_axes_of_n_is_turned_into_the_bodys():
    """Errors drawn about n's axes are those of the right-hand perturbation R exp(theta), p + R rho."""
    rng = np.random.default_rng(1)
    R, rpy_sd, p_sd = (
        matrix_from_rpy(np.array([0.1, -0.2, 2.0])),
        np.array([0.01, 0.02, 0.3]),
        np.array([1.0, 3.0, 0.2]),
    )
    zero = np.zeros((1, 3))
    prior = StatePrior(State(R[None], zero, zero, np.zeros((1, 6)), {}), rpy_sd, p_sd, np.ones(3), np.ones(6))
    theta, rho = (rng.standard_normal((20_000, 3)) * sd @ R for sd in (rpy_sd, p_sd))  # R' times each
    P = prior.covariance()
    for part, drawn in ((P[:3, :3], theta), (P[3:6, 3:6], rho)):
        sd = np.sqrt(np.diag(part))
        np.testing.assert_allclose(np.cov(drawn.T) / np.outer(sd, sd), part / np.outer(sd, sd), atol=0.03)


def test_a_start_in_motion_settles_in_the_graph():
    case, log = in_motion()
    smoother = batch(log, case.config)
    trajectory = smoother.solve().trajectory
    tilt = np.linalg.norm(attitude_errors(trajectory, case)[:, :2], axis=1)
    assert tilt.max() < 0.5 * DEG
    started = rpy_from_matrix(smoother.initial.prior.state.R_nb[0])
    true = case.dive.path.motion([trajectory.time[0]])
    assert np.abs(started - rpy_from_matrix(true.R_nb[0]))[:2].max() < 15.0 * DEG


def test_an_explicit_start_goes_before_the_log():
    start = {"roll_deg": 3, "pitch_deg": -4, "heading_deg": 200, "heading_sd_deg": 1, "north_m": 7, "east_m": 8}
    config = Config.model_validate({"start": {**start, "down_m": 9, "position_sd_m": 0.3}})
    rpy, b = start_of(still((20.0, 10.0, 0.0)), config)
    np.testing.assert_allclose(np.mod(rpy, 360.0), [3, 356, 200], atol=1e-6)
    np.testing.assert_allclose(b.prior.state.p_n[0], [7, 8, 9])
    np.testing.assert_allclose(b.prior.p_sd, 0.3)
    assert b.prior.rpy_sd[2] == pytest.approx(1 * DEG)


def test_the_state_begins_at_the_imu():
    config = parse_config("imu: {lever_arm_m: [1, 2, 3]}\nstart: {heading_deg: 90, down_m: 5}")
    _, b = start_of(still((0.0, 0.0, 0.0)), config)
    np.testing.assert_allclose(b.prior.state.p_n[0], [-2, 1, 8], atol=1e-6)


def test_what_was_null_is_filled_in_and_said():
    rpy, b = start_of(still((5.0, -3.0, 0.0), heading_deg=77.0))
    start = b.config.start
    np.testing.assert_allclose([start.roll_deg, start.pitch_deg, start.heading_deg], [5, -3, 77], atol=0.01)
    assert any(line.startswith("start.heading_deg 77.0, from dvl_heading") for line in b.assumptions)
    assert rpy[2] == pytest.approx(77.0, abs=0.01)


def rests_on(log, yaml=""):
    """What the lines on unchecked heading, depth and scale say; "" where there is none."""
    lines = initialise(log, parse_config(yaml)).assumptions
    unchecked = "heading", "depth", "DVL's scale"
    found = [[line for line in lines if f"constant error of the {what}" in line] for what in unchecked]
    assert max(map(len, found)) <= 1, lines
    return ["".join(some).partition("rests on ")[2] for some in found]


LEVEL, AT = (0.0, 0.0, 0.0), np.arange(0.0, 10.0, 0.5)
DEPTH = {"depth": (AT, np.full((20, 1), 3.0))}
FIXES = {"fix": (AT, np.tile([0.0, 0.0, 1.0], (20, 1)))}


def test_what_heading_depth_and_scale_rest_on_is_said_where_nothing_checks_them():
    yaml = "calibration: {dvl_compass_offset: {sd_deg: 2}}"
    scale = "dvl_scale, sd 0.02"
    assert rests_on(still(LEVEL), yaml) == ["dvl_compass_offset, sd 2 deg", "", scale]
    assert rests_on(still(LEVEL, **DEPTH), yaml) == ["dvl_compass_offset, sd 2 deg", "depth_offset, sd 0.2 m", scale]
    held = ("dvl_compass_offset", "depth_offset", "dvl_scale")
    exact = "calibration: {" + ", ".join(f"{name}: {{estimate: false}}" for name in held) + "}"
    assert rests_on(still(LEVEL, **DEPTH), exact) == [
        "dvl_compass_offset, taken as exact",
        "depth_offset, taken as exact",
        "dvl_scale, taken as exact",
    ]
    stated = "start: {heading_deg: 20, heading_sd_deg: 3}"
    assert rests_on(still(LEVEL), stated)[0] == "dvl_compass_offset, sd 5 deg; start.heading_deg, sd 3 deg"


def test_nothing_is_said_of_what_a_fix_or_a_stated_start_checks():
    assert rests_on(still(LEVEL, **FIXES, **DEPTH), "start: {down_m: 3}") == ["", "", ""]


# heading


@pytest.fixture(scope="module")
def every_source():
    return simulated(falcon(heading={"sources": ["mag", "dvl", "ahrs"]}), 40.0, noise=False, ahrs_rate=10.0, seed=2)


@pytest.mark.parametrize(("source", "stream"), [("mag", "mag"), ("dvl", "dvl_heading"), ("ahrs", "ahrs")])
@pytest.mark.parametrize("path", ["falcon", "south"])
def test_heading_comes_from_each_source_alone(source, stream, path):
    route = SCENARIOS["falcon"](40.0, None, Style()) if path == "falcon" else turned(np.deg2rad(190.0))
    case = simulated(falcon(heading={"sources": [source]}), 40.0, path=route, noise=False, ahrs_rate=10.0, seed=2)
    b = initialise(case.log, case.config)
    assert {"mag", "dvl_heading", "ahrs"} & set(b.instruments) == {stream}
    yaw = rpy_from_matrix(b.prior.state.R_nb[0])[2]
    assert abs(wrap_angle(yaw - case.truth.rpy[0, 2])) < 0.1 * DEG
    assert b.prior.rpy_sd[2] == pytest.approx(UNKNOWN_HEADING_SD)


def turned(yaw: float) -> Path:
    """A path at rest with another heading."""
    time = np.linspace(0.0, 40.0, 50)
    return Path.through(time, np.zeros((50, 3)), np.tile([0.05, -0.03, yaw], (50, 1)))


def test_without_sources_in_the_configuration_the_magnetometer_goes_before_the_imus_heading(every_source):
    free = changed(every_source.config, heading={"sources": None})
    assert {"mag", "dvl_heading"} <= set(initialise(every_source.log, free).instruments)
    assert "ahrs" not in initialise(every_source.log, free).instruments
    no_mag = initialise(without(every_source.log, "mag"), free).instruments
    assert "ahrs" in no_mag and "mag" not in no_mag


def test_the_source_that_is_known_best_is_asked_first():
    config = falcon(calibration={"mag_offset": {"estimate": True, "sd_deg": 9}, "ahrs_offset": {"estimate": False}})
    assert by_accuracy(config, ["mag", "ahrs", "dvl_heading"]) == ["ahrs", "dvl_heading", "mag"]


def test_without_any_heading_it_says_what_to_give(every_source):
    bare = without(every_source.log, "mag", "ahrs", "dvl_heading")
    with pytest.raises(InputError, match=r"dive\.csv: no heading .* give start\.heading_deg"):
        initialise(bare, every_source.config)
    b = initialise(bare, changed(every_source.config, start={"heading_deg": 10.0}))
    assert any("start.heading_deg alone: it will drift" in line for line in b.assumptions)


def test_without_imu_it_says_so(every_source):
    with pytest.raises(InputError, match=r"dive\.csv: no IMU, columns acc_x\.\.acc_z"):
        initialise(without(every_source.log, "imu"), every_source.config)


def test_with_neither_dvl_nor_fixes_it_says_so(every_source):
    with pytest.raises(InputError, match=r"dive\.csv: neither DVL .* nor position fixes"):
        initialise(without(every_source.log, "dvl"), every_source.config)


def test_fixes_alone_will_do():
    case = simulated(falcon(), 40.0, fix_interval=1.0, seed=2)
    b = initialise(without(case.log, "dvl"), case.config)
    assert "fix" in b.instruments and "dvl" not in b.instruments


# gyro bias


def test_the_gyros_bias_is_read_while_it_stands_still():
    bias = np.array([3e-3, -2e-3, 4e-3])
    _, b = start_of(still((2.0, 1.0, 0.0), noise=0.005, gyr=bias))
    np.testing.assert_allclose(b.prior.state.bias[0, 3:], bias, atol=1e-3)
    assert (b.prior.bias_sd[3:] < 0.5 * np.deg2rad(Config().imu.gyr_bias_sd_dps)).all()
    assert any("gyro bias from the first 5 s" in line for line in b.assumptions)
    np.testing.assert_array_equal(b.prior.bias_sd[:3], Config().imu.acc_bias_sd_mps2)


def test_a_steady_turn_is_not_taken_for_a_bias():
    _, b = start_of(still((0.0, 0.0, 0.0), gyr=(0.0, 0.0, 0.1)))
    np.testing.assert_array_equal(b.prior.state.bias[0, 3:], 0.0)
    np.testing.assert_allclose(b.prior.bias_sd[3:], np.deg2rad(Config().imu.gyr_bias_sd_dps))


# noise


@pytest.mark.parametrize(("scatter", "raised"), [(1.0, False), (3.0, True)])
def test_noise_is_raised_to_what_the_samples_scatter(scatter, raised):
    config, rng = Config(), np.random.default_rng(1)
    log = still((0.0, 0.0, 0.0))
    n = len(log["imu"])
    sd = np.repeat([config.imu.noise.acc, config.imu.noise.gyr], 3) * np.sqrt(100.0)
    b = initialise(altered(log, "imu", log["imu"].data + scatter * sd * rng.standard_normal((n, 6))), config)
    assert any("imu.noise" in line for line in b.assumptions) == raised
    expected = scatter if raised else 1.0
    assert b.config.imu.noise.acc == pytest.approx(expected * config.imu.noise.acc, rel=0.1)
    assert b.config.imu.noise.gyr == pytest.approx(expected * config.imu.noise.gyr, rel=0.1)


def test_a_samples_own_scatter_is_a_density_and_motion_is_not_scatter():
    rng = np.random.default_rng(0)
    for rate in (50.0, 200.0):
        time = np.arange(0.0, 60.0, 1.0 / rate)
        white = 0.01 * np.sqrt(rate) * rng.standard_normal((len(time), 3))
        motion = np.sin(2 * np.pi * 0.3 * time)[:, None] * [0.3, 0.2, 0.1]
        assert sample_density(time, white) == pytest.approx(0.01, rel=0.05)
        assert sample_density(time, white + motion) == pytest.approx(0.01, rel=0.05)
        knocked = white.copy()
        knocked[:: int(rate)] += 5.0
        assert sample_density(time, knocked) == pytest.approx(0.01, rel=0.1)


# the field and the place


@pytest.fixture(scope="module")
def field_from_log():
    config = falcon(environment={"dip_deg": 65.0, "field_norm": 48.0}, imu={"mount_rpy_deg": [176.6, 1.2, 30]})
    case = simulated(config, 60.0, noise=False, path=scenario("figure8", 60.0), seed=1)
    unknown = config.environment.model_copy(update={"dip_deg": None, "field_norm": None})
    return initialise(case.log, config.model_copy(update={"environment": unknown}))


def test_magnitude_and_dip_of_the_field_come_from_the_log(field_from_log):
    env = field_from_log.config.environment
    assert env.field_norm == pytest.approx(48.0, rel=1e-3)
    assert env.dip_deg == pytest.approx(65.0, abs=0.3)
    assert sum("from the log" in line or "of the log" in line for line in field_from_log.assumptions) >= 2


@pytest.mark.parametrize("estimate", [True, False])
def test_a_dip_from_the_log_that_is_held_is_pointed_out(every_source, estimate):
    config = changed(
        every_source.config, environment={"dip_deg": None}, calibration={"field_dip": {"estimate": estimate}}
    )
    said = [line for line in initialise(every_source.log, config).assumptions if "dip" in line]
    assert len(said) == 1
    assert ("and held, with" in said[0]) is not estimate


def test_what_the_configuration_says_of_the_field_stands(every_source):
    env = initialise(every_source.log, every_source.config).config.environment
    assert (env.field_norm, env.dip_deg) == (1.0, 72.0)


def test_the_start_is_the_first_fix_unless_it_is_given():
    case = simulated(falcon(), 40.0, fix_interval=1.0, seed=2)
    free = case.config.model_copy(update={"start": Config().start})
    first = case.log["fix"].data[0, :2]
    b = initialise(case.log, free)
    np.testing.assert_allclose([b.config.start.north_m, b.config.start.east_m], first)
    assert (b.prior.p_sd[:2] >= free.fix.sd_m).all()
    assert b.prior.p_sd[2] < 0.3  # of the depth sensor
    assert any("start position from the first fix" in line for line in b.assumptions)
    given = initialise(case.log, changed(case.config, start={"north_m": 3.0}))
    assert given.config.start.north_m == 3.0


def test_depth_of_the_start_is_the_first_sample_less_the_lever_arm():
    case = simulated(falcon(depth={"lever_arm_m": [0.0, 0.0, -0.4]}), 40.0, noise=False, seed=2)
    b = initialise(case.log, case.config)
    assert b.config.start.down_m == pytest.approx(case.truth.p_n[0, 2], abs=0.01)


@pytest.mark.parametrize(
    ("depth", "yaml", "sd"),
    [
        (0.0, "{}", 0.6),  # three times 0.2 m
        (300.0, "{}", 3.0 * np.hypot(4.5, 0.2)),  # 1.5 % by default
        (300.0, "calibration: {depth_scale: {sd: 0.003}, depth_offset: {estimate: false}}", 2.7),
        (300.0, "calibration: {depth_scale: {estimate: false}, depth_offset: {estimate: false}}", 0.1),
        (300.0, "start: {down_sd_m: 0.3}", 0.3),
    ],
)
def test_a_start_by_the_depth_sensor_adds_nothing_to_what_it_measures(depth, yaml, sd):
    log = still(LEVEL, depth=(AT, np.full((20, 1), depth)))
    assert initialise(log, parse_config(yaml)).prior.p_sd[2] == pytest.approx(sd)


def test_earths_rotation_needs_a_latitude(every_source):
    config = changed(every_source.config, environment={"earth_rotation": True, "latitude_deg": None})
    with pytest.raises(InputError, match=r"environment\.earth_rotation needs environment\.latitude_deg"):
        initialise(every_source.log, config)


def test_noise_of_one_sensor_is_raised_alone_and_that_of_an_honest_dive_is_not():
    case = simulated(falcon(), 40.0, seed=5)
    assert initialise(case.log, case.config).config.imu.noise == case.config.imu.noise
    data, density = case.log["imu"].data.copy(), 4.0 * case.config.imu.noise.gyr
    data[:, 3:] += density * 10.0 * np.random.default_rng(1).standard_normal((len(data), 3))
    noise = initialise(altered(case.log, "imu", data), case.config).config.imu.noise
    assert noise.gyr == pytest.approx(np.hypot(density, case.config.imu.noise.gyr), rel=0.05)
    assert noise.acc == case.config.imu.noise.acc


# samples that are wrong, or late


def spoilt(case: Simulated, sensor: str, rows: slice, column: int, value: float) -> Log:
    data = case.log[sensor].data.copy()
    data[rows, column] = value
    return altered(case.log, sensor, data)


UNDER_WAY = 40.0  # from when on a dive moves


@pytest.fixture(scope="module")
def lively() -> Simulated:
    """Turning and moving from its first second."""
    config = falcon(heading={"sources": ["ahrs"]})
    whole = simulated(config, 120.0, seed=4, style=LIVELY, ahrs_rate=10.0, fix_interval=2.0)
    log = whole.log
    for sensor, stream in whole.log.streams.items():
        log = kept(log, sensor, stream.time >= UNDER_WAY)
    return replace(whole, log=log)


def begun(case: Simulated) -> Trajectory:
    """The truth where the log begins."""
    return true_at(case, np.array([UNDER_WAY]))


def free(case: Simulated) -> Config:
    """Its configuration, the start left to the log."""
    return case.config.model_copy(update={"start": Config().start})


def start_heading_deg(case: Simulated, log: Log) -> float:
    return float(initialise(log, free(case)).config.start.heading_deg)


def apart_deg(a: float, b: float) -> float:
    return abs(float(np.rad2deg(wrap_angle(np.deg2rad(a - b)))))


def test_a_heading_that_begins_late_is_brought_back_to_the_start_by_the_gyro(lively):
    late_from = UNDER_WAY + 15.0
    yaw = rpy_from_matrix(true_at(lively, np.array([UNDER_WAY, late_from])).R_nb)[:, 2]
    assert apart_deg(*np.rad2deg(yaw)) > 20.0
    late = kept(lively.log, "ahrs", lively.log["ahrs"].time > late_from)
    assert apart_deg(start_heading_deg(lively, late), start_heading_deg(lively, lively.log)) < 10.0


@pytest.mark.parametrize("wrong", [1, 15])
def test_wrong_first_headings_are_outvoted(lively, wrong):
    log = spoilt(lively, "ahrs", slice(0, wrong), 0, lively.log["ahrs"].data[0, 0] + 1.5)
    assert apart_deg(start_heading_deg(lively, log), start_heading_deg(lively, lively.log)) < 3.0


@pytest.mark.parametrize("value", [0.0, -9999.0])
def test_wrong_first_depths_are_outvoted(lively, value):
    count = int(0.4 * np.sum(lively.log["depth"].time < UNDER_WAY + 5.0))
    assert count > 1
    b = initialise(spoilt(lively, "depth", slice(0, count), 0, value), free(lively))
    assert b.config.start.down_m == pytest.approx(begun(lively).p_n[0, 2], abs=0.5)


def test_a_wrong_first_fix_is_outvoted(lively):
    far = lively.log["fix"].data[0, 0] + 60.0
    b = initialise(spoilt(lively, "fix", slice(0, 1), 0, far), free(lively))
    assert b.config.start.north_m == pytest.approx(begun(lively).p_n[0, 0], abs=15.0)


def test_a_late_first_fix_or_depth_leaves_the_start_as_unknown_as_the_way_since(lively):
    log = lively.log
    for sensor in ("fix", "depth"):
        log = kept(log, sensor, log[sensor].time > UNDER_WAY + 18.0)
    assert (initialise(log, free(lively)).prior.p_sd > 15.0).all()


def test_the_antennas_lever_arm_is_taken_off_the_first_fix():
    case = simulated(falcon(fix={"lever_arm_m": [4.0, 0.0, 0.0]}), 40.0, noise=False, fix_interval=1.0, seed=2)
    start = initialise(case.log, free(case)).config.start
    assert np.linalg.norm(np.array([start.north_m, start.east_m]) - case.truth.p_n[0, :2]) < 1.0


@pytest.mark.parametrize("shown_by", [None, "dvl", "dvl_heading"])
def test_a_steady_turn_that_dvl_or_compass_show_is_not_taken_for_standing_still(shown_by):
    log = still([0, 0, 0], gyr=(0.0, 0.0, 1.0 * DEG))
    data = log[shown_by or "dvl"].data.copy()
    if shown_by == "dvl":
        data[:, 0] = 0.5
    if shown_by == "dvl_heading":
        data[:, 0] += DEG * log["dvl_heading"].time
    _, b = start_of(altered(log, shown_by or "dvl", data))
    assert any("is assumed to be at rest" in line for line in b.assumptions) == (shown_by is None)


def test_what_was_written_of_the_start_gives_the_same_start_again(lively):
    b = initialise(lively.log, free(lively))
    again = initialise(lively.log, Config.model_validate(b.config.model_dump()))
    np.testing.assert_allclose(again.prior.rpy_sd, b.prior.rpy_sd)
    np.testing.assert_allclose(again.prior.p_sd, b.prior.p_sd)
    np.testing.assert_allclose(again.prior.state.p_n, b.prior.state.p_n)


def test_a_log_without_depth_says_that_it_begins_at_the_surface(lively):
    assert (
        "start.down_m 0.0 within 100 m, as the log has no depth"
        in initialise(without(lively.log, "depth"), free(lively)).assumptions
    )


@pytest.mark.parametrize("row", [0, 40])
def test_a_magnetometer_that_reads_zero_once_is_not_believed_then(row):
    case = simulated(falcon(), 40.0, seed=2)
    data = case.log["mag"].data.copy()
    data[row] = 0.0
    smoother = batch(altered(case.log, "mag", data), free(case))
    assert smoother.left_out["mag", "exactly zero"] == 1
    assert np.isfinite(smoother.solve().trajectory.p_sd).all()


def test_fixes_that_begin_late_say_where_the_dive_began_as_far_as_it_can_have_gone():
    at = np.array([120.0, 121.0, 122.0])
    there = np.column_stack([300.0 + 0.3 * np.arange(3), np.full(3, -200.0), np.full(3, np.nan)])
    log = level_log(
        125.0, np.array([0, 0, -9.81]), np.zeros(3), 10.0, fix=(at, there), ahrs=(at - 119.0, np.zeros((3, 3)))
    )
    prior = initialise(log, Config()).prior
    assert np.abs(prior.state.p_n[0, :2] - [300.0, -200.0]).max() < 1.0
    assert prior.p_sd[0] >= 120.0
