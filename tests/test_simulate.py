"""The simulated dive obeys its path, its models and its noise."""

import json
import sys
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from dives import exact as exactly

from rovgraph.cli.app import main
from rovgraph.errors import InputError
from rovgraph.geometry import earth_rate_n, exp_rotation, log_rotation, rotate, transpose, wrap_angle
from rovgraph.model.config import Config, beliefs, parse_config
from rovgraph.model.state import State
from rovgraph.sensors.instruments import instruments
from rovgraph.simulate import CALM, SCENARIOS, Path, Style, Truth, Waves, scenario, simulate
from rovgraph.simulate.dive import specific_force_and_rate
from rovgraph.simulate.path import Route, courses

ROUGH = Style(waves=Waves(heave=0.1, roll=0.3, pitch=0.2))
MOUNTED = """
imu: {mount_rpy_deg: [176.6, 1.2, 30], lever_arm_m: [-0.11, 0.22, -0.10]}
dvl: {mount_rpy_deg: [180, 0, 45], lever_arm_m: [0.24, 0.0, 0.33], velocity_sd_mps: [0.004, 0.003, 0.002]}
depth: {lever_arm_m: [0.3, 0.1, -0.2]}
fix: {lever_arm_m: [0.3, 0.1, -0.5]}
environment: {declination_deg: 4.5, dip_deg: 72, field_norm: 0.5}
"""


@pytest.fixture(scope="module")
def config() -> Config:
    return parse_config(MOUNTED)


@pytest.fixture(scope="module")
def rough() -> Path:
    """Turning in all three axes."""
    return scenario("falcon", 100.0, 0.4, ROUGH)


def dive_of(config: Config, seed: int = 3, path: Path | None = None, **keys):
    path = path or scenario("falcon", 100.0, 0.4, ROUGH)
    return simulate(path, Truth(config, **keys), np.random.default_rng(seed))


def rows(log: pd.DataFrame, *columns: str) -> tuple[np.ndarray, np.ndarray]:
    known = log.dropna(subset=list(columns))
    return known["time"].to_numpy(), known[list(columns)].to_numpy(float)


ACC, GYR = ("acc_x", "acc_y", "acc_z"), ("gyr_x", "gyr_y", "gyr_z")
MAG, DVL = ("mag_x", "mag_y", "mag_z"), ("dvl_vx", "dvl_vy", "dvl_vz")


def test_motion_is_consistent_with_its_finite_differences(rough):
    t, h = np.linspace(15.0, 90.0, 400), 1e-4
    before, now, after = rough.motion(t - h), rough.motion(t), rough.motion(t + h)
    assert np.abs(now.w_b).max(axis=0).min() > 0.2  # it does turn about every axis
    np.testing.assert_allclose((after.p_n - before.p_n) / (2 * h), now.v_n, atol=1e-7)
    np.testing.assert_allclose((after.v_n - before.v_n) / (2 * h), now.a_n, atol=1e-6)
    w = log_rotation(transpose(before.R_nb) @ after.R_nb) / (2 * h)
    np.testing.assert_allclose(w, now.w_b, atol=1e-6)
    np.testing.assert_allclose((after.w_b - before.w_b) / (2 * h), now.alpha_b, atol=1e-5)


@pytest.mark.parametrize("name", sorted(SCENARIOS))
def test_scenarios_begin_and_end_at_rest_and_keep_their_speed(name):
    path = scenario(name)
    motion = path.motion(np.arange(0.0, path.duration, 0.05))
    resting = motion.time < 10.0
    assert np.abs(motion.v_n[resting]).max() < 1e-6 and np.abs(motion.w_b[resting]).max() < 1e-6
    assert np.linalg.norm(path.motion([path.duration]).v_n) < 1e-9
    np.testing.assert_allclose(motion.p_n[0, :2], 0.0, atol=1e-9)
    fastest = np.linalg.norm(motion.v_n, axis=1).max()
    assert fastest < 0.1 if name in ("hold", "spin") else 0.25 < fastest < 0.5
    assert np.linalg.norm(motion.a_n, axis=1).max() < 0.5


def test_vattern_ends_where_the_thesis_does():
    np.testing.assert_allclose(scenario("vattern", 300.0).motion([300.0]).p_n[0, :2], [39.9, -33.7], atol=1e-6)


def test_body_follows_its_course_with_the_crab_angle():
    path = scenario("straight", 100.0, style=Style(waves=CALM))
    np.testing.assert_allclose(path.motion([50.0]).R_nb[0], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(path.motion([50.0]).v_n[0], [0.4, 0, 0], atol=1e-9)
    east_then_south = courses(np.array([(0, 0, 0), (0, 1, 0), (0, 1, 5), (-1, 1, 5)], float))
    np.testing.assert_allclose(np.rad2deg(east_then_south), [90, 90, 180])


def test_route_repeats_and_pauses():
    route = Route.of([(0, 0, 0), (4, 0, 0), (0, 0, 0)], pace=[1, 2], pause=[0, 3, 1])
    assert route.time(0.5) == pytest.approx(8 + 4 + 3 + 1)
    assert route.repeated(3).time(0.5) == pytest.approx(3 * route.time(0.5))


def test_imu_integrates_back_to_the_path(rough, config):
    """Strapdown integration of the noise-free samples, lever arm and mounting taken out again."""
    config = config.model_copy(update={"imu": config.imu.model_copy(update={"lever_arm_m": (0.0, 0.0, 0.0)})})
    dive = dive_of(config, path=rough, noise=False, imu_rate=1000.0)
    time, f_s = rows(dive.log_frame, *ACC)
    w_s = rows(dive.log_frame, *GYR)[1]
    R_bs = np.asarray(exp_rotation([0, 0, np.deg2rad(30)])) @ exp_rotation([0, np.deg2rad(1.2), 0])
    R_bs = R_bs @ exp_rotation([np.deg2rad(176.6), 0, 0])
    f_b, w_b, dt = f_s @ R_bs.T, w_s @ R_bs.T, 1e-3
    R, v, p = dive.truth.R_nb[0], dive.truth.v_n[0], dive.truth.p_n[0]
    turns = exp_rotation(dt * 0.5 * (w_b[1:] + w_b[:-1]))
    for k, turn in enumerate(turns):
        R_next = R @ turn
        a = 0.5 * (R @ f_b[k] + R_next @ f_b[k + 1]) + [0, 0, 9.81]
        p, v, R = p + dt * v + 0.5 * dt**2 * a, v + dt * a, R_next
    assert time[-1] == pytest.approx(100.0)
    np.testing.assert_allclose(R, dive.truth.R_nb[-1], atol=1e-5)
    np.testing.assert_allclose(v, dive.truth.v_n[-1], atol=1e-3)
    np.testing.assert_allclose(p, dive.truth.p_n[-1], atol=2e-2)


def test_imu_at_a_lever_arm_senses_the_acceleration_of_its_own_place(rough):
    """Against the second difference of the place of the IMU."""
    arm = np.array([0.5, -0.7, 0.3])
    config = parse_config("imu: {lever_arm_m: [0.5, -0.7, 0.3]}")
    t, h = np.linspace(15.0, 90.0, 200), 1e-3
    before, now, after = (rough.motion(t + d) for d in (-h, 0.0, h))
    place = [m.p_n + rotate(m.R_nb, arm) for m in (before, now, after)]
    a_n = (place[0] - 2 * place[1] + place[2]) / h**2
    f_b = rotate(transpose(now.R_nb), a_n - [0, 0, 9.81])
    np.testing.assert_allclose(specific_force_and_rate(now, config)[:, :3], f_b, atol=1e-5)


def test_imu_at_rest_reads_gravity_upwards_and_the_earth_rate():
    text = "environment: {earth_rotation: true, latitude_deg: 58.3, gravity_mps2: 9.82}"
    still = scenario("straight", 60.0).motion([1.0])
    values = specific_force_and_rate(still, parse_config(text))[0]
    np.testing.assert_allclose(values[:3], [0, 0, -9.82], atol=1e-12)
    latitude = np.deg2rad(58.3)
    np.testing.assert_allclose(values[3:], earth_rate_n(latitude), atol=1e-15)
    with pytest.raises(InputError, match="latitude"):
        specific_force_and_rate(still, parse_config("environment: {earth_rotation: true}"))


def test_moving_east_over_a_turning_earth_lightens_the_vehicle():
    config = parse_config("environment: {earth_rotation: true, latitude_deg: 0}")
    motion = scenario("straight", 100.0, style=Style(waves=CALM)).motion([50.0])
    east = replace(motion, v_n=np.array([[0.0, 100.0, 0.0]]), a_n=np.zeros((1, 3)))
    force = specific_force_and_rate(east, config)[0, 2]
    assert force == pytest.approx(
        -config.environment.gravity_at(motion.p_n[0, 2]) + 2 * earth_rate_n(0.0)[0] * 100.0
    )  # Eotvos


@pytest.mark.parametrize(
    ("sensor", "columns"),
    [
        ("dvl", DVL),
        ("dvl_heading", ("dvl_heading",)),
        ("mag", MAG),
        ("depth", ("depth",)),
        ("ahrs", ("ahrs_yaw",)),
        ("fix", ("fix_north", "fix_east")),
    ],
)
def test_noise_free_measurement_is_the_models(config, rough, sensor, columns):
    given = {"dvl_yaw": np.array([0.9]), "dvl_scale": np.array([0.02]), "hard_iron": np.array([0.1, 0.2, -0.1])}
    dive = dive_of(config, path=rough, noise=False, calibration=given, ahrs_rate=20.0, fix_interval=3.0)
    time, z = rows(dive.log_frame, *columns)
    motion = rough.motion(time)
    calibration = {name: belief.mean for name, belief in beliefs(config).items()} | given
    state = State(motion.R_nb, motion.p_n, motion.v_n, np.zeros((len(time), 6)), calibration)
    model = instruments(config)[sensor].model
    expected = model.predict(state, motion.w_b)[0]
    difference = wrap_angle(z - expected) if model.angular else z - expected
    assert len(time) > 30 and np.abs(difference).max() < 1e-12


def test_dvl_sees_the_velocity_of_its_own_place_in_its_own_axes(config, rough):
    time, z = rows(dive_of(config, path=rough, noise=False).log_frame, *DVL)
    arm, h = np.array([0.24, 0.0, 0.33]), 1e-4
    ahead, behind = rough.motion(time[5:-5] + h), rough.motion(time[5:-5] - h)
    v_n = (ahead.p_n + rotate(ahead.R_nb, arm) - behind.p_n - rotate(behind.R_nb, arm)) / (2 * h)
    v_b = rotate(transpose(rough.motion(time[5:-5]).R_nb), v_n)
    c = np.sqrt(0.5)  # x axis 45 degrees to starboard, y axis to port of that, z up
    R_sb = np.array([[c, c, 0], [c, -c, 0], [0, 0, -1]])
    np.testing.assert_allclose(z[5:-5], v_b @ R_sb.T, atol=1e-6)


def test_same_seed_same_dive_other_seed_other_dive(config):
    one, two, other = (dive_of(config, seed).log_frame for seed in (5, 5, 6))
    pd.testing.assert_frame_equal(one, two)
    assert not np.allclose(one["acc_x"].dropna(), other["acc_x"].dropna())


def test_imu_noise_has_the_configured_density(config):
    walkless = config.imu.noise.model_copy(update={"acc_walk": 1e-12, "gyr_walk": 1e-12})
    config = exactly(config.model_copy(update={"imu": config.imu.model_copy(update={"noise": walkless})}))
    for rate in (50.0, 200.0):
        noisy = dive_of(config, imu_rate=rate, bias=np.zeros(6)).log_frame
        exact = dive_of(config, imu_rate=rate, noise=False).log_frame
        acc = rows(noisy, *ACC)[1] - rows(exact, *ACC)[1]
        gyr = rows(noisy, *GYR)[1] - rows(exact, *GYR)[1]
        assert acc.std() / np.sqrt(rate) == pytest.approx(8.0e-4, rel=0.03)
        assert gyr.std() / np.sqrt(rate) == pytest.approx(6.9e-4, rel=0.03)


@pytest.mark.parametrize(("sensor", "columns"), [("dvl", DVL), ("mag", MAG), ("depth", ("depth",))])
def test_sensor_noise_has_the_configured_sd(config, rough, sensor, columns):
    dive = dive_of(config, path=rough, depth_rate=20.0, dvl_rate=20.0)
    time, z = rows(dive.log_frame, *columns)
    motion, n = rough.motion(time), len(time)
    state = State(motion.R_nb, motion.p_n, motion.v_n, np.zeros((n, 6)), dive.hidden["calibration"])
    instrument = instruments(config)[sensor]
    error = (z - instrument.model.predict(state, motion.w_b)[0]) / instrument.sd
    np.testing.assert_allclose(error.std(axis=0), 1.0, atol=5.0 / np.sqrt(2 * n))
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=5.0 / np.sqrt(n))


@pytest.mark.slow
def test_bias_walks_with_the_configured_variance():
    text = "imu: {noise: {acc_walk: 1.0e-3, gyr_walk: 1.0e-5}}"
    path = scenario("straight", 36.0)
    ends = []
    for seed in range(150):
        dive = simulate(path, Truth(parse_config(text), imu_rate=20.0, bias=np.zeros(6)), np.random.default_rng(seed))
        ends.append(dive.hidden["bias"][-1] / np.repeat([1e-3, 1e-5], 3) / np.sqrt(36.0))
    assert np.std(ends) == pytest.approx(1.0, abs=5.0 / np.sqrt(2 * 900))


def test_bias_is_in_body_axes_and_in_the_samples(config):
    bias = np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    still = scenario("straight", 40.0, style=Style(waves=CALM))
    dive = dive_of(config, path=still, bias=bias)
    free = dive_of(config, path=still, noise=False)
    np.testing.assert_allclose(dive.hidden["bias"][0], bias)
    assert np.all(free.hidden["bias"] == 0.0)
    shift = (rows(dive.log_frame, *ACC)[1] - rows(free.log_frame, *ACC)[1])[:500].mean(axis=0)
    R_bs = exp_rotation([0, 0, np.deg2rad(30)]) @ exp_rotation([0, np.deg2rad(1.2), 0])
    R_bs = R_bs @ exp_rotation([np.deg2rad(176.6), 0, 0])
    np.testing.assert_allclose(shift, R_bs.T @ bias[:3], atol=5e-3)


def test_only_calibration_that_is_uncertain_is_drawn_and_from_its_prior():
    text = (
        "calibration: {dvl_yaw: {estimate: true, mean_deg: 20, sd_deg: 4}, dvl_scale: {estimate: considered}, "
        "dvl_pitch: {estimate: false, mean_deg: 1}}"
    )
    truth = Truth(parse_config(text))
    draws = [truth.draw_calibration(np.random.default_rng(seed)) for seed in range(400)]
    yaw = np.rad2deg([d["dvl_yaw"][0] for d in draws])
    assert yaw.mean() == pytest.approx(20, abs=1.0) and yaw.std() == pytest.approx(4, rel=0.15)
    assert np.std([d["dvl_scale"][0] for d in draws]) == pytest.approx(0.02, rel=0.15)
    np.testing.assert_allclose([d["dvl_pitch"][0] for d in draws], np.deg2rad(1.0))


@pytest.mark.slow
def test_start_error_is_drawn_from_the_starts_sd():
    config = parse_config("start: {position_sd_m: 2.0}")
    path = scenario("straight", 36.0)
    starts = []
    for seed in range(200):
        dive = simulate(path, Truth(config, imu_rate=10.0, start_error=True), np.random.default_rng(seed))
        starts.append(dive.truth.p_n[0] - path.motion([0.0]).p_n[0])
        np.testing.assert_allclose(starts[-1], dive.hidden["start_offset"])
    assert np.std(starts) == pytest.approx(2.0, rel=0.15)


def test_outliers_and_dropouts_are_where_they_were_asked_for(config):
    dive = dive_of(config, outlier_share=0.2, outlier_size=1.0, dropouts=((30.0, 40.0),))
    log = dive.log_frame[dive.log_frame["dvl_valid"].notna()]
    lost = log["dvl_valid"] == 0
    assert lost.sum() == ((log["time"] >= 30) & (log["time"] <= 40)).sum() > 40
    assert log.loc[lost, list(DVL)].isna().all(axis=None) and log.loc[~lost, list(DVL)].notna().all(axis=None)
    assert log["dvl_heading"].notna().all()
    time, z = rows(dive.log_frame, *DVL)
    v_b = rotate(transpose(dive.path.motion(time).R_nb), dive.path.motion(time).v_n)
    wrong = np.abs(np.linalg.norm(z, axis=1) - np.linalg.norm(v_b, axis=1)) > 0.3
    assert 0.08 < wrong.mean() < 0.25


def test_pings_are_irregular_about_their_rate(config):
    time, _ = rows(dive_of(config).log_frame, "dvl_heading")
    gaps = np.diff(time)
    assert gaps.mean() == pytest.approx(1 / 5.6, rel=0.02)
    assert gaps.min() < 0.17 < 0.19 < gaps.max()


def test_log_is_sorted_sparse_and_complete(config):
    log = dive_of(config, ahrs_rate=10.0, fix_interval=5.0).log_frame
    assert log["time"].is_monotonic_increasing and log["time"].iloc[-1] <= 100.0
    counts = log.notna().sum()
    assert counts["acc_x"] == counts["mag_z"] == 10001
    assert counts["ahrs_yaw"] == pytest.approx(1000, abs=2) and counts["fix_north"] == pytest.approx(20, abs=1)


@pytest.mark.parametrize(
    ("name", "duration", "speed", "words"),
    [
        ("falco", None, None, "did you mean falcon"),
        ("falcon", 5.0, None, "duration of 5.0"),
        ("falcon", float("nan"), None, "duration"),
        ("falcon", None, -1.0, "speed"),
        ("falcon", None, float("nan"), "speed"),
        ("straight", None, 0.0, "speed"),
        ("vattern", 100.0, 0.3, "too short"),
        ("vattern", None, 0.0, "speed"),
    ],
)
def test_impossible_dives_are_refused(name, duration, speed, words):
    with pytest.raises(InputError, match=words):
        scenario(name, duration, speed)


def run(monkeypatch, capsys, *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["rovgraph", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    captured = capsys.readouterr()
    return int(stop.value.code or 0), captured.out, captured.err


def test_command_writes_a_folder_that_repeats_itself(tmp_path, monkeypatch, capsys):
    for name in ("a", "b"):
        out = str(tmp_path / name)
        code, shown, _ = run(monkeypatch, capsys, "simulate", "square", "--duration", "40", "--seed", "4", "--out", out)
        assert code == 0 and "40.0 s" in shown
    files = sorted(p.name for p in (tmp_path / "a").iterdir())
    assert files == ["config.yaml", "log.csv", "summary.json", "truth.csv", "truth.json"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a", "b"]
    for file in files:
        assert (tmp_path / "a" / file).read_bytes() == (tmp_path / "b" / file).read_bytes()
    secrets = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert len(secrets["bias_first"]) == 6 and secrets["calibration"]["dvl_compass_deviation"] != [0.0, 0.0]


def test_command_keeps_an_older_folder_unless_forced(tmp_path, monkeypatch, capsys):
    arguments = ["simulate", "square", "--duration", "40", "--no-noise", "--out", str(tmp_path / "a")]
    assert run(monkeypatch, capsys, *arguments)[0] == 0
    (tmp_path / "a" / "note.txt").write_text("mine")
    assert run(monkeypatch, capsys, *arguments)[0] == 2
    assert (tmp_path / "a" / "note.txt").exists()
    assert run(monkeypatch, capsys, *arguments, "--force")[0] == 0
    assert not (tmp_path / "a" / "note.txt").exists()


@pytest.mark.parametrize(
    "arguments",
    [
        ["nowhere"],
        ["square", "--duration", "3"],
        ["square", "--duration", "1e9"],
        ["square", "--duration", "nan"],
        ["square", "--speed", "-1"],
        ["square", "--speed", "1e12"],
        ["square", "--speed", "inf"],
        ["square", "--outliers", "1.5"],
        ["square", "--outliers", "nan"],
        ["square", "--config", "missing.yaml"],
    ],
)
def test_command_refuses_bad_input_in_one_line(tmp_path, monkeypatch, capsys, arguments):
    code, _, err = run(monkeypatch, capsys, "simulate", *arguments, "--out", str(tmp_path / "out"))
    assert code == 2
    assert err.startswith("error: ") and err.count("\n") == 1 and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []
