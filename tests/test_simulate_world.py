"""The thesis's sensors in the simulator: their noise, what is magnetic, at rest and in the tank."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import periodogram

from rovgraph.cli.app import main
from rovgraph.geometry import rotate, transpose, wrap_angle
from rovgraph.log import Log, read_log
from rovgraph.model.config import beliefs, load_config, with_priors_stated
from rovgraph.model.state import State
from rovgraph.model.thesis import R_DVL, R_MTI, WAVE_HZ
from rovgraph.sensors import field_direction
from rovgraph.sensors.instruments import instruments
from rovgraph.simulate import NAMES, Choices, Truth, falcon, lake, scenario, simulate, simulated
from rovgraph.simulate.dive import specific_force_and_rate, to_imu_axes
from rovgraph.simulate.environment import EARTH_FIELD_T, Iron, compass_turn
from rovgraph.simulate.files import write_log
from rovgraph.simulate.truth import THESIS, remembered

CONFIG = falcon()
ACC, GYR = ["acc_x", "acc_y", "acc_z"], ["gyr_x", "gyr_y", "gyr_z"]
MAG, DVL = ["mag_x", "mag_y", "mag_z"], ["dvl_vx", "dvl_vy", "dvl_vz"]


def rows(dive, columns) -> tuple[np.ndarray, np.ndarray]:
    known = dive.log_frame.dropna(subset=columns)
    return known["time"].to_numpy(), known[columns].to_numpy(float)


def exact(dive, sensor: str, time: np.ndarray) -> np.ndarray:
    """What a sensor says without noise and without iron."""
    motion = dive.path.motion(time)
    state = State(motion.R_nb, motion.p_n, motion.v_n, np.zeros((len(time), 6)), dive.hidden["calibration"])
    return instruments(CONFIG)[sensor].model.predict(state, motion.w_b)[0]


def assert_covariance(errors: np.ndarray, expected: np.ndarray) -> None:
    """Whitened by what is expected, every element within five of its own sd."""
    whitened = np.linalg.solve(np.linalg.cholesky(expected), errors.T)
    n = errors.shape[0]
    sd = np.sqrt((1.0 + np.eye(len(expected))) / n)
    np.testing.assert_array_less(np.abs(whitened @ whitened.T / n - np.eye(len(expected))), 5.0 * sd)


@pytest.fixture(scope="module")
def afloat():
    return simulated("stationary", 1, choices=Choices(variant="water"))[0]


@pytest.fixture(scope="module")
def ashore():
    return simulated("stationary", 1, choices=Choices(duration=300.0))[0]


@pytest.fixture(scope="module")
def lakes():
    """With iron and without, all else the same."""
    return [simulated("docking", 2, choices=Choices(disturbances=on))[0] for on in (True, False)]


def test_imu_and_magnetometer_have_the_thesiss_covariance_in_their_own_axes(afloat):
    time, inertial = rows(afloat, ACC + GYR)
    ideal = specific_force_and_rate(afloat.path.motion(time), CONFIG) + afloat.hidden["bias"]
    errors = np.hstack([inertial - to_imu_axes(ideal, CONFIG), rows(afloat, MAG)[1] - exact(afloat, "mag", time)])
    assert_covariance(errors, R_MTI)


def test_dvl_and_its_compass_have_the_thesiss_covariance_in_its_own_axes(afloat):
    time, velocity = rows(afloat, DVL)
    heading = wrap_angle(rows(afloat, ["dvl_heading"])[1] - exact(afloat, "dvl_heading", time))
    assert_covariance(np.hstack([velocity - exact(afloat, "dvl", time), heading]), R_DVL)


def test_another_rate_has_the_same_density():
    """Noise of a sample grows with the root of the rate."""
    path = scenario("straight", 60.0)
    truth = Truth(CONFIG, covariances=THESIS, imu_rate=400.0, bias=np.zeros(6))
    dive = simulate(path, truth, np.random.default_rng(0))
    time, inertial = rows(dive, ACC + GYR)
    ideal = specific_force_and_rate(path.motion(time), CONFIG) + dive.hidden["bias"]
    assert_covariance((inertial - to_imu_axes(ideal, CONFIG))[:, 3:], 4.0 * R_MTI[3:6, 3:6])


def strongest(values: np.ndarray, rate: float, above: float) -> float:
    frequency, power = periodogram(values, rate, axis=0)
    power = power.sum(axis=1) * (frequency > above)
    return float(frequency[np.argmax(power)])


def test_on_land_the_fans_line_stands_in_the_accelerometer(ashore):
    line = strongest(rows(ashore, ACC)[1], 100.0, 5.0)
    assert line * 2 * np.pi / 100.0 == pytest.approx(1.45, abs=2 * np.pi / 100.0 / 300.0)
    assert strongest(rows(ashore, GYR)[1], 100.0, 5.0) != pytest.approx(line, abs=0.01)


def test_on_land_the_dvl_has_no_bottom_and_there_is_no_depth(ashore):
    log = Log.from_frame(ashore.log_frame)
    assert np.all(log["dvl"]["dvl_valid"] == 0) and "depth" not in log
    assert np.ptp(ashore.truth.p_n, axis=0).max() < 1e-9


def test_afloat_the_waves_line_stands_in_the_dvl(afloat):
    time, velocity = rows(afloat, DVL)
    even = np.arange(0.2, 599.8, 0.18)
    line = strongest(np.column_stack([np.interp(even, time, v) for v in velocity.T]), 1 / 0.18, 0.05)
    assert line == pytest.approx(WAVE_HZ, abs=0.06)
    assert np.ptp(afloat.truth.p_n, axis=0).max() < 0.05


def test_tank_turns_more_than_once_about_z_and_about_x_and_ends_where_it_began():
    dive, _ = simulated("tank", 3)
    rpy = dive.path.spline(np.arange(0.0, dive.path.duration, 0.1))[:, 3:]
    assert np.ptp(rpy[:, 2]) > 2 * np.pi and np.ptp(rpy[:, 0]) > 2 * np.pi
    assert np.linalg.norm(dive.truth.p_n[-1] - dive.truth.p_n[0]) < 0.1
    assert np.ptp(dive.truth.p_n, axis=0).max() > 3.0
    roll = np.interp(dive.log_frame["time"], np.arange(0.0, dive.path.duration, 0.1), rpy[:, 0])
    capsized = np.cos(roll) < 0.0
    assert capsized.any() and not (dive.log_frame.loc[capsized, "dvl_valid"] == 1).any()
    acceleration = np.linalg.norm(dive.path.motion(np.arange(0.0, dive.path.duration, 0.01)).a_n, axis=1)
    assert acceleration.max() < 0.5  # the crane's motion and the lap join smoothly


def test_raw_magnetometer_of_the_tank_is_the_inverse_of_the_thesiss_calibration():
    """H = gamma y + kappa (3.2) has one length wherever the vehicle turns."""
    raw, _ = simulated("tank", 3)
    gamma, kappa = raw.hidden["world"]["mag_scale"], raw.hidden["world"]["mag_offset"]
    _, y = rows(raw, MAG)
    iron = raw.hidden["calibration"]["hard_iron"]
    lengths = np.linalg.norm(gamma * y + kappa - iron, axis=1)
    assert lengths.std() < 3e-3  # (3.2)'s noise
    assert np.linalg.norm(y, axis=1).std() > 0.03
    calm = simulated("tank", 3, choices=Choices(variant="calibrated"))[0]
    assert "mag_scale" not in calm.hidden["world"]
    np.testing.assert_allclose(rows(calm, MAG)[1].mean(axis=0), (gamma * y + kappa).mean(axis=0), atol=1e-3)


def test_iron_is_felt_by_the_rule_of_thumb():
    """1000 kg, magnetised by the Earth alone, are 1 nT at 30 m."""
    iron = Iron(np.zeros((1, 3)), np.array([[0.0, 0.0, 0.135 * 1000.0]]))
    nanotesla = 1e9 * EARTH_FIELD_T * iron.field(np.array([[0.0, 0.0, 30.0], [30.0, 0.0, 0.0]]))
    np.testing.assert_allclose(nanotesla, [[0, 0, 1.0], [0, 0, -0.5]], atol=1e-12)


def test_field_of_iron_has_no_source_and_no_curl():
    rng = np.random.default_rng(2)
    iron, p, h = Iron(rng.uniform(-1, 1, (4, 3)), rng.standard_normal((4, 3))), rng.uniform(2, 4, (30, 3)), 1e-4
    slope = np.stack([(iron.field(p + s) - iron.field(p - s)) / (2 * h) for s in h * np.eye(3)], axis=-1)
    size = np.abs(slope).max()
    np.testing.assert_allclose(np.trace(slope, axis1=1, axis2=2), 0.0, atol=1e-6 * size)
    np.testing.assert_allclose(slope, transpose(slope), atol=1e-6 * size)


def test_compass_turns_to_the_horizontal_part_of_the_whole_field():
    earth = np.array([0.3, 0.0, 0.9])
    turned = compass_turn(earth, np.array([[0.0, 0.3, 5.0], [0.0, 0.0, -2.0], [0.0, -0.3, 0.0]]))
    np.testing.assert_allclose(np.rad2deg(turned), [45.0, 0.0, -45.0])
    declined = field_direction(0.5, 1.2)
    np.testing.assert_allclose(compass_turn(declined, np.array([0.2 * declined])), 0.0, atol=1e-12)


def test_each_compass_feels_iron_where_it_is(lakes):
    """The difference that iron makes to two dives with the same noise."""
    among, clear = lakes
    world, calibration = among.hidden["world"], among.hidden["calibration"]
    iron = Iron(world["iron_p_n"], world["iron_moment_n"])
    assert "iron_p_n" not in clear.hidden["world"]

    time, mag = rows(among, MAG)
    motion = among.path.motion(time)
    felt_n = iron.field(motion.p_n + rotate(motion.R_nb, CONFIG.imu.lever_arm_m))
    difference = np.linalg.norm(mag - rows(clear, MAG)[1], axis=1)
    np.testing.assert_allclose(difference, np.linalg.norm(felt_n, axis=1), atol=1e-12)
    assert difference.max() > 3e-3  # more than noise

    time, heading = rows(among, ["dvl_heading"])
    motion = among.path.motion(time)
    felt_n = iron.field(motion.p_n + rotate(motion.R_nb, CONFIG.dvl.lever_arm_m))
    dip = np.deg2rad(CONFIG.environment.dip_deg) + calibration["field_dip"][0]
    earth = (1 + calibration["field_scale"][0]) * field_direction(np.deg2rad(CONFIG.environment.declination_deg), dip)
    whole = earth + felt_n
    north = np.arctan2(whole[:, 1], whole[:, 0]) - np.arctan2(earth[1], earth[0])
    np.testing.assert_allclose(wrap_angle(heading - rows(clear, ["dvl_heading"])[1])[:, 0], -north, atol=1e-9)
    assert np.abs(north).max() > np.deg2rad(0.25)

    for columns in (ACC, GYR, DVL, ["depth"], ["thruster_1"]):
        np.testing.assert_array_equal(rows(among, columns)[1], rows(clear, columns)[1])


def test_iron_lies_below_the_whole_track(lakes):
    among, _ = lakes
    clearance = among.hidden["world"]["iron_p_n"][:, 2] - among.truth.p_n[:, 2].max()
    assert clearance.min() > 1.0 and clearance.max() < 3.5


@pytest.mark.slow
def test_iron_is_there_by_default_in_the_lake_only():
    assert "iron_p_n" in simulated("vattern", 0)[0].hidden["world"]
    assert "iron_p_n" not in simulated("tank", 0)[0].hidden["world"]
    assert "iron_p_n" not in simulated("square", 0)[0].hidden["world"]
    assert "iron_p_n" in simulated("square", 0, choices=Choices(disturbances=True))[0].hidden["world"]


@pytest.mark.slow
def test_field_of_the_lake_is_another_than_the_tanks_whatever_is_estimated():
    fixed = CONFIG.model_dump(exclude_unset=True)
    fixed["calibration"] |= {"field_dip": {"estimate": False}, "field_scale": {"estimate": False}}
    config = type(CONFIG).model_validate(fixed)
    one, other = (simulated("docking", 2, c)[0].hidden["calibration"] for c in (CONFIG, config))
    assert one["field_scale"] == other["field_scale"] != 0.0 and one["field_dip"] == other["field_dip"] != 0.0
    tank = simulated("tank", 2)[0].hidden["calibration"]
    assert tank["field_scale"] == tank["field_dip"] == 0.0


def test_misalignment_is_exactly_what_is_believed(lakes):
    among, _ = lakes
    for name in ("dvl_roll", "dvl_pitch", "dvl_yaw"):
        np.testing.assert_array_equal(among.hidden["calibration"][name], beliefs(CONFIG)[name].mean)


def test_units_own_attitude_errs_slowly_and_by_its_sd():
    white = np.random.default_rng(0).standard_normal((200_000, 2))
    slow = remembered(white, 50.0)
    assert slow.std() == pytest.approx(1.0, abs=0.05)  # 4000 independent values
    lagged = [float(np.mean(slow[k:] * slow[: len(slow) - k])) for k in (25, 50)]
    np.testing.assert_allclose(lagged, np.exp([-0.5, -1.0]), atol=0.08)
    np.testing.assert_array_equal(remembered(white, 0.0), white)


def test_frame_in_memory_is_the_log_that_is_written(lakes, tmp_path):
    write_log(lakes[0].log_frame, tmp_path / "log.csv")
    memory, file = Log.from_frame(lakes[0].log_frame), read_log(tmp_path / "log.csv")
    assert memory.sensors == file.sensors and "thruster" in file
    for sensor in memory.sensors:
        np.testing.assert_allclose(memory[sensor].time, file[sensor].time, atol=1e-9)
        np.testing.assert_allclose(memory[sensor].data, file[sensor].data, atol=5.1e-4)


def run(monkeypatch, capsys, *arguments: str) -> tuple[int, str, str]:
    monkeypatch.setattr(sys, "argv", ["rovgraph", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    captured = capsys.readouterr()
    return int(stop.value.code or 0), captured.out, captured.err


def test_command_writes_a_driven_dive_with_everything_chosen(tmp_path, monkeypatch, capsys):
    arguments = ["simulate", "docking", "--seed", "3", "--current", "0.05", "-0.02", "--no-disturbances"]
    arguments += ["--dropout", "50:60", "--dropout", "80:90", "--outliers", "0.1", "--out", str(tmp_path / "a")]
    code, shown, _ = run(monkeypatch, capsys, *arguments)
    assert code == 0 and "thruster" in shown
    log = read_log(tmp_path / "a" / "log.csv")
    dvl = log["dvl"]
    lost = ((dvl.time >= 50) & (dvl.time <= 60)) | ((dvl.time >= 80) & (dvl.time <= 90))
    np.testing.assert_array_equal(dvl["dvl_valid"] == 0, lost)
    secret = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert secret["calibration"]["current"] == [0.05, -0.02] and "iron_p_n" not in secret
    told = json.loads((tmp_path / "a" / "summary.json").read_text())
    assert told["current"] == [0.05, -0.02] and told["outlier_share"] == 0.1 and told["disturbances"] is False
    believed = load_config(tmp_path / "a" / "config.yaml")
    assert believed.model_dump(exclude={"start"}) == with_priors_stated(lake()).model_dump(exclude={"start"})
    assert abs(believed.start.north_m) < 1e-9  # planned; the dive began beside it
    assert np.linalg.norm(secret["start_offset_m"]) > 0.01


def test_secrets_of_a_lake_are_in_truth_json(tmp_path, monkeypatch, capsys):
    assert run(monkeypatch, capsys, "simulate", "docking", "--out", str(tmp_path / "a"))[0] == 0
    secret = json.loads((tmp_path / "a" / "truth.json").read_text())
    assert len(secret["iron_p_n"]) == len(secret["iron_moment_n"]) > 0
    assert secret["calibration"]["drag_linear"] != [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["vatern"], "circle, docking, excited"),
        (["vattern", "--variant", "9"], "it has 1, 2, 3"),
        (["vattern", "--dropout", "9"], "two times"),
        (["vattern", "--dropout", "9:3"], "two times"),
        (["vattern", "--dropout", "nan:3"], "two times"),
        (["vattern", "--duration", "nan"], "duration"),
        (["vattern", "--current", "nan", "0"], "current"),
        (["vattern", "--current", "9", "0"], "current"),
        (["square", "--current", "0.1", "0"], "no choice of current"),
        (["tank", "--speed", "nan"], "speed"),
    ],
)
def test_command_refuses_in_one_line(tmp_path, monkeypatch, capsys, arguments, words):
    code, _, err = run(monkeypatch, capsys, "simulate", *arguments, "--out", str(tmp_path / "out"))
    assert code == 2 and words in err and err.startswith("error: ") and err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_help_and_manual_name_every_scenario(monkeypatch, capsys):
    manual = (Path(__file__).parents[1] / "docs" / "simulation.md").read_text(encoding="utf-8")
    shown = run(monkeypatch, capsys, "simulate", "--help")[1]
    for name in NAMES:
        assert f"`{name}`" in manual and name in shown
