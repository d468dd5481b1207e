"""Calibration of a magnetometer: known iron is found again, attached magnets are dated, poor logs are refused."""

import json
import sys
import warnings
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import scipy.io
from folders import same_files

import rovgraph as rg
from rovgraph.cli import app
from rovgraph.errors import InputError
from rovgraph.geometry import exp_rotation, rotate, rpy_from_matrix, transpose
from rovgraph.lab.calibrate import calibrate_magnetometer
from rovgraph.lab.calibrate.magnetometer import calibrate_turns
from rovgraph.log import STREAMS, Log, Stream, read_log
from rovgraph.model.config import Config, Mag, load_config, parse_config
from rovgraph.report.pages.reporting import write_page
from rovgraph.sensors import field_direction

DATA = Path(__file__).parents[2] / "shared" / "data"
RATE = 25.0
FIELD_N = 50.0 * field_direction(np.deg2rad(4.0), np.deg2rad(70.0))
CENTRE = np.array([12.0, -25.0, 7.0])
SOFT = np.array([[1.08, 0.05, -0.03], [0.05, 0.95, 0.02], [-0.03, 0.02, 1.01]])
NOISE = 0.2
MAGNET = np.array([3.0, -2.0, 9.0])


def tumbling(seconds, rng):
    """Angular rate of a vehicle that a crew turns all ways, with a rest at the beginning; shape (n, 3)."""
    t = np.arange(int(seconds * RATE)) / RATE
    phase = rng.uniform(0.0, 2.0 * np.pi, (3, 3))
    rate = sum(0.35 * np.sin(2 * np.pi * f * t[:, None] + phase[i]) for i, f in enumerate((0.011, 0.023, 0.041)))
    return t, np.where(t[:, None] < 10.0, 0.0, rate)


def steady(axis, seconds, turns=1.2):
    """A slow turn about one axis of the IMU, then a rest."""
    rate = np.zeros((int(seconds * RATE), 3))
    rate[: len(rate) * 9 // 10, axis] = 2.0 * np.pi * turns / (0.9 * seconds)
    return rate


def make_log(rate, rng, distort=lambda field: field, gyro=True, noise=NOISE):
    """A log of an IMU that turns at ``rate``, samples ``distort(field)`` with noise."""
    t = np.arange(len(rate)) / RATE
    R = np.empty((len(t), 3, 3))
    R[0] = exp_rotation(np.array([0.2, -0.3, 1.0]))
    for k in range(1, len(t)):
        R[k] = R[k - 1] @ exp_rotation(0.5 * (rate[k] + rate[k - 1]) / RATE)
    field = distort(rotate(transpose(R), FIELD_N)) + noise * rng.standard_normal((len(t), 3))
    force = rotate(transpose(R), [0.0, 0.0, -9.81]) + 0.02 * rng.standard_normal((len(t), 3))
    sensed = rate + 0.004 + 0.003 * rng.standard_normal((len(t), 3))
    streams = {"mag": Stream("mag", STREAMS["mag"], t, field, np.arange(len(t)) + 2)}
    if gyro:
        streams["imu"] = Stream("imu", STREAMS["imu"], t, np.hstack([force, sensed]), np.arange(len(t)) + 2)
    return Log("turned.csv", streams)


def iron(field):
    return field @ SOFT.T + CENTRE


@pytest.fixture(scope="module")
def turned():
    rng = np.random.default_rng(3)
    return make_log(tumbling(240.0, rng)[1], rng, iron)


def write(log, path):
    """A log as a CSV file."""
    frames = [pd.DataFrame(s.data, columns=list(s.columns)) for s in log.streams.values()]
    table = pd.concat([pd.DataFrame({"time": log["mag"].time}), *frames], axis=1)
    table.to_csv(path, index=False, float_format="%.6g")
    return path


def test_hard_and_soft_iron_are_found_again(turned):
    found = calibrate_magnetometer(turned)
    assert (np.abs(found.centre - CENTRE) < 4.0 * found.centre_sd).all()
    assert found.centre_sd.max() < 0.1
    # the shape is known but for a rotation, which a symmetric matrix has none of
    shape = found.matrix @ SOFT
    assert shape / np.cbrt(np.linalg.det(shape)) == pytest.approx(np.eye(3), abs=0.005)
    assert found.radii == pytest.approx(50.0 * np.linalg.svd(SOFT, compute_uv=False), rel=0.005)
    assert found.disturbances == []


def test_after_it_length_and_dip_scatter_as_the_samples_noise_does(turned):
    found = calibrate_magnetometer(turned)
    noise = NOISE / 50.0
    assert found.before.length_rms > 20.0 * noise
    assert found.after.length_rms < 1.3 * noise
    assert found.before.dip_rms > 10.0 * found.after.dip_rms
    assert found.after.dip_rms < 1.3 * np.hypot(noise, 0.02 / 9.81)
    assert np.rad2deg(found.dip) == pytest.approx(70.0, abs=0.3)


def test_the_unit_stays_and_a_known_length_sets_the_scale(turned):
    found = calibrate_magnetometer(turned)
    assert np.linalg.det(found.matrix) == pytest.approx(1.0)
    known = calibrate_magnetometer(turned, Config.model_validate({"environment": {"field_norm": 1.0}}))
    assert known.length == pytest.approx(1.0)
    assert known.centre == pytest.approx(found.centre)


def test_the_piece_is_a_configuration_that_calibrates_the_log_as_it_is_read(turned, tmp_path):
    found = calibrate_magnetometer(turned)
    settings = Config.model_validate(found.piece)
    path = write(turned, tmp_path / "log.csv")
    field = read_log(path, settings)["mag"].data
    assert field == pytest.approx(found.field, abs=1e-3)
    assert np.ptp(np.linalg.norm(field, axis=1)) < 10.0 * NOISE
    assert read_log(path, Config())["mag"].data == pytest.approx(turned["mag"].data, abs=1e-3)


def test_a_singular_matrix_is_refused_in_the_configuration():
    with pytest.raises(InputError, match=r"imu\.mag\.matrix: .*singular"):
        parse_config("imu: {mag: {matrix: [[1, 0, 0], [0, 1, 0], [0, 1, 0]]}}")


def test_a_simulated_log_comes_with_no_calibration_to_be_applied():
    from dives import FALCON, changed, simulated

    from rovgraph.simulate.files import known

    config = changed(load_config(FALCON), imu={"mag": {"centre": [1.0, 2.0, 3.0]}})
    assert known(simulated(config, 40.0).dive, config).imu.mag == Mag()


@pytest.mark.parametrize("gyro", [True, False], ids=["by the gyro", "by the field"])
def test_two_turns_give_gains_and_offsets_of_the_axes(gyro):
    """(3.3)-(3.9), with noise: the middle of extremes of n samples is within a noise's sd of the truth."""
    rng = np.random.default_rng(5)
    pause = np.zeros((200, 3))
    tip = steady(1, 10.0, 0.12)  # between the turns the vehicle is tipped a little
    rate = np.vstack([pause, steady(2, 60.0), pause, tip, steady(0, 60.0), pause])
    log = make_log(rate, rng, lambda f: f / np.array([1.0, 1.1, 1.2]) + CENTRE, gyro)
    found = calibrate_magnetometer(log, None, "turns")
    assert [t.axis for t in found.turns] == ["z", "x"]
    assert 6.0 < found.turns[0].start < 14.0 and 60.0 < found.turns[0].end < 72.0
    gain = np.diag(found.matrix) / found.matrix[0, 0]
    assert gain == pytest.approx([1.0, 1.1, 1.2], rel=0.02)
    assert found.centre == pytest.approx(CENTRE, abs=3.0 * NOISE)
    assert found.after.length_rms < 0.02 < found.before.length_rms


def test_turns_are_the_vehicles_whatever_the_imus_mounting():
    """A mounting a few degrees askew would put the dip into the centre otherwise."""
    rng = np.random.default_rng(5)
    R_bs = exp_rotation(np.array([0.06, -0.02, 0.0]))
    rate = np.vstack([np.zeros((200, 3)), steady(2, 60.0), steady(0, 60.0)])
    body = make_log(rate, rng)
    centre = np.array([4.0, -8.0, 6.0])
    turned_axes = {
        s: stream.data.reshape(-1, stream.data.shape[1] // 3, 3) @ R_bs for s, stream in body.streams.items()
    }
    streams = {
        s: Stream(
            s, STREAMS[s], body[s].time, data.reshape(len(data), -1) + (centre if s == "mag" else 0.0), body[s].row
        )
        for s, data in turned_axes.items()
    }
    log = Log("turned.csv", streams)
    mount = {"imu": {"mount_rpy_deg": np.rad2deg(rpy_from_matrix(R_bs)).tolist()}}
    assert np.abs(calibrate_magnetometer(log, Config.model_validate(mount), "turns").centre - centre).max() < 1.0
    assert np.abs(calibrate_magnetometer(log, None, "turns").centre - centre).max() > 2.0


def test_the_method_of_turns_is_exact_on_exact_turns():
    angle = np.linspace(0.0, 2.0 * np.pi, 721)
    about_z = np.column_stack([30.0 * np.cos(angle), -30.0 * np.sin(angle), np.full(721, 40.0)])
    about_x = np.column_stack([np.full(721, 30.0), 40.0 * np.sin(angle), 40.0 * np.cos(angle)])
    gamma, kappa = np.array([1.25, 1.0, 1.4]), np.array([3.0, -2.0, 5.0])  # H = gamma y + kappa
    centre, gain = calibrate_turns(*((turn - kappa) / gamma for turn in (about_z, about_x)))
    assert gain == pytest.approx(gamma)
    assert -gain * centre == pytest.approx(kappa, abs=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_a_magnet_that_is_attached_is_found_and_dated(seed):
    rng = np.random.default_rng(seed)
    t, rate = tumbling(240.0, rng)
    start, end = rng.uniform(50.0, 90.0), rng.uniform(130.0, 160.0)
    log = make_log(rate, rng, lambda f: iron(f) + MAGNET * ((t > start) & (t < end))[:, None])
    found = calibrate_magnetometer(log)
    assert len(found.disturbances) == 1
    magnet = found.disturbances[0]
    assert magnet.start == pytest.approx(start, abs=0.75)
    assert magnet.end == pytest.approx(end, abs=0.75)
    # the field is what the calibration says of it, in its unit
    assert magnet.vector == pytest.approx(found.matrix @ MAGNET, abs=1.0)
    assert (np.abs(found.centre - CENTRE) < 4.0 * found.centre_sd).all()
    assert not found.used[(t > start) & (t < end)].any()


@pytest.mark.parametrize("seed", range(4))
def test_nothing_is_found_where_nothing_is_attached(seed):
    rng = np.random.default_rng(100 + seed)
    assert calibrate_magnetometer(make_log(tumbling(240.0, rng)[1], rng, iron)).disturbances == []


def test_without_a_gyro_disturbances_are_not_looked_for():
    rng = np.random.default_rng(8)
    found = calibrate_magnetometer(make_log(tumbling(240.0, rng)[1], rng, iron, gyro=False))
    assert found.disturbances is None
    assert found.dip is None
    assert (np.abs(found.centre - CENTRE) < 4.0 * found.centre_sd).all()


def poor(kind):
    rng = np.random.default_rng(0)
    rest = make_log(np.zeros((1000, 3)), rng, iron)
    if kind == "no magnetometer":
        return Log("turned.csv", {"imu": rest["imu"]})
    if kind == "few":
        return make_log(np.zeros((50, 3)), rng, iron)
    if kind == "at rest":
        return rest
    if kind == "rocking":
        wave = 0.2 * np.sin(2 * np.pi * 0.3 * np.arange(3000) / RATE)
        return make_log(np.column_stack([wave, 0.7 * wave, np.full(3000, 0.1)]), rng, iron)
    return make_log(steady("xyz".index(kind[-1]), 60.0), rng, iron)


POOR = {
    "no magnetometer": "no magnetometer in it; columns mag_x",
    "few": "50 samples of the magnetometer, at least 200",
    "at rest": "does not turn",
    "about x": "about the IMU's x axis only.*turn it about y or z",
    "about y": "about the IMU's y axis only.*turn it about x or z",
    "about z": "about the IMU's z axis only.*turn it about x or y",
    "rocking": "about the IMU's z axis only|does not turn far enough to determine an ellipsoid",
}


@pytest.mark.parametrize("kind", POOR)
def test_a_log_that_cannot_calibrate_says_what_it_lacks(kind):
    with pytest.raises(InputError, match=POOR[kind]):
        calibrate_magnetometer(poor(kind))


def test_the_method_of_turns_names_the_turn_it_misses():
    rng = np.random.default_rng(1)
    rate = np.vstack([steady(2, 60.0), steady(1, 60.0)])
    with pytest.raises(InputError, match="no full turn about the vehicle's x axis in it, by the gyro"):
        calibrate_magnetometer(make_log(rate, rng, iron), None, "turns")


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the console script; returns exit code, stdout, stderr."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["rovgraph", "calibrate", "magnetometer", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            app.main()
        out, err = capsys.readouterr()
        return stop.value.code or 0, out, err

    return call


def test_the_command_writes_what_smooth_takes(run, turned, tmp_path):
    path, out = write(turned, tmp_path / "log.csv"), tmp_path / "out"
    (tmp_path / "vehicle.yaml").write_text("name: mine\nimu: {lever_arm_m: [0.1, 0.2, 0.3]}\n")
    code, text, err = run(path, "--config", tmp_path / "vehicle.yaml", "--out", out)
    assert (code, err) == (0, "")
    assert "centre (hard iron)" in text
    names = {"config.yaml", "magnetometer.png", "magnetometer.yaml", "report.html", "summary.json"}
    assert {p.name for p in out.iterdir()} == names
    summary = json.loads((out / "summary.json").read_text())
    assert summary["program"] == "rovgraph" and summary["disturbances"] == []
    whole = load_config(out / "config.yaml")
    assert (whole.name, whole.imu.lever_arm_m) == ("mine", (0.1, 0.2, 0.3))
    assert whole.imu.mag == load_config(out / "magnetometer.yaml").imu.mag
    page = (out / "report.html").read_text(encoding="utf-8")
    after = 100 * summary["length_rms_after"]
    assert f"and by {after:.3g} % with the calibration" in page
    assert "do not use it" not in page
    (out / "summary.json").write_text(json.dumps(summary | {"length_rms_before": summary["length_rms_after"]}))
    write_page(out)
    assert "do not use it" in (out / "report.html").read_text(encoding="utf-8")
    assert whole.imu.mag.centre == pytest.approx(summary["centre"], rel=1e-4)


def test_the_library_writes_what_the_command_writes_and_wants_samples_as_measured(run, turned, tmp_path):
    path, settings = write(turned, tmp_path / "log.csv"), tmp_path / "vehicle.yaml"
    settings.write_text("imu: {mag: {centre: [1, 2, 3]}}\n")
    assert run(path, "--config", settings, "--out", tmp_path / "command")[0] == 0
    config = load_config(settings)
    found = rg.calibrate_magnetometer(rg.read_log(path, config.with_raw_magnetometer()), config)
    found.save(tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")
    with pytest.raises(rg.InputError, match="calibrated as it was read; read it with"):
        rg.calibrate_magnetometer(rg.read_log(path, config), config)


def test_results_are_not_overwritten_silently(run, turned, tmp_path):
    path, out = write(turned, tmp_path / "log.csv"), tmp_path / "out"
    assert run(path, "--out", out)[0] == 0
    code, _, err = run(path, "--out", out)
    assert (code, err.count("\n")) == (2, 1)
    assert "exists" in err
    assert run(path, "--out", out, "--force")[0] == 0


@pytest.mark.parametrize("kind", ["at rest", "about z"])
def test_bad_input_is_one_line_and_code_2(run, tmp_path, kind):
    code, out, err = run(write(poor(kind), tmp_path / "log.csv"), "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert err.startswith(f"error: {tmp_path / 'log.csv'}: ")
    assert not (tmp_path / "out").exists()


def sphere_log():
    path = DATA / "mag_sphere" / "ck_acc_mag_log.csv.gz"
    if not path.exists():
        pytest.skip(f"{path} is absent")
    raw = pd.read_csv(path)[["mx", "my", "mz"]].to_numpy()
    time = np.arange(len(raw)) / 50.0
    return Log(path.name, {"mag": Stream("mag", STREAMS["mag"], time, raw, np.arange(len(raw)) + 2)})


def test_a_recorded_sphere_has_the_centre_and_radii_that_are_known_of_it():
    found = calibrate_magnetometer(sphere_log())
    assert found.centre == pytest.approx([0.148, 0.389, -0.059], rel=0.01)
    assert found.radii == pytest.approx([0.325, 0.304, 0.298], rel=0.01)
    assert found.after.length_rms < 0.013 < 0.3 < found.before.length_rms


def test_the_recorded_sphere_agrees_with_another_library():
    pytest.importorskip("navlib")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of its own optional parts
        from navlib.cal import cal_mag_ellipsoid_fit_fang
    log = sphere_log()
    centre, soft, _ = cal_mag_ellipsoid_fit_fang(log["mag"].data)
    found = calibrate_magnetometer(log)
    assert found.centre == pytest.approx(centre, abs=0.001)
    theirs = np.linalg.inv(soft)
    assert found.matrix == pytest.approx(theirs / np.cbrt(np.linalg.det(theirs)), abs=0.01)


def recorded(name):
    """A recorded trial as a log; every second sample, 143 Hz."""
    path = DATA / "broad_mag" / name
    if not path.exists():
        pytest.skip(f"{path} is absent")
    trial = scipy.io.loadmat(path)
    data = np.hstack([trial["imu_acc"], trial["imu_gyr"], trial["imu_mag"]])
    time = np.arange(len(data)) / trial["sampling_rate"].item()
    time, data, row = time[::2], data[::2], np.arange(len(data))[::2] + 2
    streams = {"imu": Stream("imu", STREAMS["imu"], time, data[:, :6], row)}
    return Log(name, streams | {"mag": Stream("mag", STREAMS["mag"], time, data[:, 6:], row)})


def test_a_recorded_magnet_is_found_and_dated():
    """Brought near from 40.25 s on, away by 98.75 s, by the samples themselves (at rest, and the length's jump)."""
    log = recorded("33_disturbed_attached_magnet_2cm.mat")
    found = calibrate_magnetometer(log)
    assert len(found.disturbances) == 1
    magnet = found.disturbances[0]
    assert magnet.start == pytest.approx(40.25, abs=0.75)
    assert magnet.end == pytest.approx(98.75, abs=0.75)
    assert magnet.vector[2] == pytest.approx(27.0, abs=1.0)
    assert np.linalg.norm(magnet.vector[:2]) < 4.0
    assert abs(found.centre[2]) < 0.7  # what is left on z while it is away


def test_a_recorded_trial_without_a_magnet_is_silent():
    found = calibrate_magnetometer(recorded("02_undisturbed_slow_rotation_B.mat"))
    assert found.disturbances == []
    assert np.linalg.norm(found.centre) < 0.7
