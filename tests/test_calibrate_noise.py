"""Noise of sensors at rest: densities, walks and lines that were put in are read again; motion is refused."""

import json
import sys

import numpy as np
import pandas as pd
import pytest
from folders import same_files

import rovgraph as rg
from rovgraph.cli import app
from rovgraph.errors import DataWarning, InputError
from rovgraph.lab.calibrate import calibrate_noise
from rovgraph.lab.calibrate.noise import allan, spectrum
from rovgraph.log import STREAMS, Log, Stream
from rovgraph.model.config import Config, load_config
from rovgraph.model.thesis import FAN_RAD_PER_SAMPLE, SAMPLE_S, WAVE_HZ

ACC, GYR, ACC_WALK, GYR_WALK = 8.0e-4, 6.9e-4, 3.0e-4, 1.0e-5
DVL, HEADING, MAG = np.array([0.004, 0.004, 0.002]), np.deg2rad(0.25), 1e-3
DIP = np.deg2rad(72.0)
FAN_HZ = FAN_RAD_PER_SAMPLE / (2.0 * np.pi * SAMPLE_S)


def stream(sensor, time, data):
    return Stream(sensor, STREAMS[sensor], time, data, np.arange(len(time)) + 2)


def walk(rng, n, sd, rate):
    return np.cumsum(rng.standard_normal((n, 3)), axis=0) * sd / np.sqrt(rate)


def at_rest(seconds, seed=0, rate=100.0, fan=0.0, waves=0.0, acc_walk=ACC_WALK, gyr_walk=GYR_WALK):
    """A log of IMU, magnetometer and DVL at rest.

    ``fan`` is the amplitude of a line in the acceleration [m/s^2], ``waves`` that of roll, pitch
    and yaw [rad] and of the velocity [m/s].
    """
    rng = np.random.default_rng(seed)
    t = np.arange(int(seconds * rate)) / rate
    n = len(t)
    acc = ACC * np.sqrt(rate) * rng.standard_normal((n, 3)) + walk(rng, n, acc_walk, rate) + [0.0, 0.0, -9.81]
    acc += fan * np.sin(2.0 * np.pi * FAN_HZ * t)[:, None]
    gyr = GYR * np.sqrt(rate) * rng.standard_normal((n, 3)) + walk(rng, n, gyr_walk, rate) + [0.003, -0.002, 0.01]
    gyr += waves * 2.0 * np.pi * WAVE_HZ * np.cos(2.0 * np.pi * WAVE_HZ * t)[:, None]
    mag = np.array([np.cos(DIP), 0.0, np.sin(DIP)]) + MAG * rng.standard_normal((n, 3))
    pings = np.cumsum(rng.uniform(0.9, 1.1, int(seconds * 5.4)) / 5.6)
    velocity = DVL * rng.standard_normal((len(pings), 3)) + waves * np.sin(2.0 * np.pi * WAVE_HZ * pings)[:, None]
    rest = np.column_stack([velocity, np.ones(len(pings)), np.full(len(pings), np.nan)])
    heading = 3.1 + HEADING * rng.standard_normal(len(pings))
    wrapped = (heading + np.pi) % (2.0 * np.pi) - np.pi
    return Log(
        "rest.csv",
        {
            "imu": stream("imu", t, np.hstack([acc, gyr])),
            "mag": stream("mag", t, mag),
            "dvl": stream("dvl", pings, rest),
            "dvl_heading": stream("dvl_heading", pings, wrapped[:, None]),
        },
    )


@pytest.fixture(scope="module")
def calm():
    return calibrate_noise(at_rest(600.0))


@pytest.fixture(scope="module")
def rough():
    return calibrate_noise(at_rest(600.0, 1, fan=0.02, waves=0.02))


@pytest.mark.parametrize("report", ["calm", "rough"])
def test_densities_are_read_within_a_tenth(report, request):
    found = request.getfixturevalue(report)
    for sensor, density in (("acc", ACC), ("gyr", GYR)):
        for axis in "xyz":
            assert found.channel(f"{sensor}_{axis}").allan.density == pytest.approx(density, rel=0.1)
        assert found.piece["imu"]["noise"][sensor] == pytest.approx(density, rel=0.05)


@pytest.mark.parametrize("report", ["calm", "rough"])
def test_sds_of_pings_and_headings_are_read_within_a_tenth(report, request):
    """A hundredth is what 3 200 pings allow; waves, taken out, cost the rest."""
    piece = request.getfixturevalue(report).piece
    assert piece["dvl"]["velocity_sd_mps"] == pytest.approx(DVL, rel=0.1)
    assert piece["heading"]["dvl_sd_deg"] == pytest.approx(0.25, rel=0.1)
    assert piece["heading"]["mag_sd_deg"] == pytest.approx(np.rad2deg(MAG / np.cos(DIP)), rel=0.1)


@pytest.mark.parametrize("report", ["calm", "rough"])
def test_a_walk_that_shows_is_read_within_a_factor_of_two(report, request):
    found = request.getfixturevalue(report)
    assert 0.5 < found.piece["imu"]["noise"]["acc_walk"] / ACC_WALK < 2.0


def test_a_walk_that_does_not_show_is_left_out_and_bounded(calm):
    assert "gyr_walk" not in calm.piece["imu"]["noise"]
    assert any("gyr_walk is left out" in line for line in calm.remarks)
    assert all(calm.channel(f"gyr_{axis}").allan.walk_limit > GYR_WALK for axis in "xyz")


def test_a_longer_log_shows_the_gyros_walk():
    found = calibrate_noise(at_rest(1800.0, rate=20.0, gyr_walk=3e-5))
    assert 0.5 < found.piece["imu"]["noise"]["gyr_walk"] / 3e-5 < 2.0


def flicker(n, rate, instability, rng):
    """Noise whose two-sided density is B^2 / (2 pi f), from white noise shaped by it."""
    frequency = np.fft.rfftfreq(2 * n, 1.0 / rate)
    frequency[0] = frequency[1]
    white = np.fft.rfft(rng.standard_normal(2 * n))
    return np.fft.irfft(white * instability * np.sqrt(rate / (2.0 * np.pi * frequency)))[:n]


def test_bias_instability_is_read_within_a_factor_of_two():
    rng = np.random.default_rng(4)
    n, rate, instability = 72_000, 20.0, 2e-4
    values = GYR * np.sqrt(rate) * rng.standard_normal(n) + flicker(n, rate, instability, rng)
    read = allan(values, rate)
    assert 0.5 < read.instability / instability < 2.0
    assert read.density == pytest.approx(GYR, rel=0.05)


def test_what_is_not_there_is_seldom_read():
    """White noise of ten minutes: walks and floors in at most 2 of 40, chance being 1 in 100."""
    rng = np.random.default_rng(9)
    read = [allan(rng.standard_normal(12_000), 20.0) for _ in range(20)]
    assert sum((r.walk is not None) + (r.instability is not None) for r in read) <= 2
    assert np.mean([(r.density - 1.0 / np.sqrt(20.0)) ** 2 / r.density_sd**2 for r in read]) < 2.5


def test_an_allan_deviation_agrees_with_its_definition():
    rng = np.random.default_rng(2)
    values = rng.standard_normal(2000)
    read = allan(values, 10.0)
    m = round(float(read.tau[6]) * 10.0)
    means = np.convolve(values, np.ones(m) / m, mode="valid")
    expected = np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2))
    assert read.deviation[6] == pytest.approx(expected)


def test_a_fan_is_named_as_in_the_thesis(rough):
    fan = next(p for p in rough.peaks if p.kind == "machine")
    assert fan.sensor == "imu"
    assert fan.rad_per_sample == pytest.approx(FAN_RAD_PER_SAMPLE, abs=0.005)
    assert fan.frequency == pytest.approx(FAN_HZ, abs=0.05)
    assert set(fan.rms) == {"acc_x", "acc_y", "acc_z"}
    assert list(fan.rms.values()) == pytest.approx([0.02 / np.sqrt(2.0)] * 3, rel=0.05)


@pytest.mark.parametrize(("sensor", "prefix"), [("imu", "gyr_"), ("dvl", "dvl_v")])
def test_waves_are_tolerated_and_named(rough, sensor, prefix):
    waves = next(p for p in rough.peaks if p.kind == "waves" and p.sensor == sensor)
    assert waves.frequency == pytest.approx(WAVE_HZ, abs=0.01)
    assert {f"{prefix}{axis}" for axis in "xyz"} <= set(waves.rms)
    amplitude = 0.02 * (2.0 * np.pi * WAVE_HZ if sensor == "imu" else 1.0)
    assert max(waves.rms.values()) == pytest.approx(amplitude / np.sqrt(2.0), rel=0.1)


def test_quiet_sensors_show_hardly_a_line(calm):
    """A false alarm is wanted once in 10 000 spectra; the median around a line costs some of that."""
    assert sum(len(c.spectrum.lines) for c in calm.channels) <= 1


@pytest.mark.parametrize("jitter", [0.0, 0.1], ids=["regular", "irregular"])
def test_the_spectrum_holds_the_variance(jitter):
    """Parseval's theorem, by Welch's method and by Lomb and Scargle's."""
    rng = np.random.default_rng(6)
    time = np.cumsum(1.0 + jitter * rng.uniform(-1.0, 1.0, 6000)) / 5.0
    values = 0.3 * rng.standard_normal(6000)
    found = spectrum(time, values)
    assert np.mean(found.density) * 2.5 == pytest.approx(values.var(), rel=0.02)
    assert np.median(found.background) * 2.5 == pytest.approx(values.var(), rel=0.1)


def test_the_covariance_is_that_of_the_samples(calm):
    names, R = calm.covariance["imu"]
    assert names == (*STREAMS["imu"], *STREAMS["mag"])
    assert np.diag(R)[3:6] == pytest.approx(GYR**2 * 100.0, rel=0.05)
    assert np.diag(R)[6:] == pytest.approx(MAG**2, rel=0.05)
    names, R = calm.covariance["dvl"]
    assert names == ("dvl_vx", "dvl_vy", "dvl_vz", "dvl_heading")
    assert np.sqrt(np.diag(R)) == pytest.approx([*DVL, HEADING], rel=0.1)  # the heading wraps


def moved(kind):
    log = at_rest(120.0)
    streams = dict(log.streams)
    imu, dvl = streams["imu"], streams["dvl"]
    moving = (imu.time > 60.0) & (imu.time < 64.0)
    data = imu.data.copy()
    if kind == "turned":
        data[moving, 5] += np.deg2rad(5.0)
    if kind == "tilted":
        data[imu.time > 65.0, 0] += 9.81 * np.sin(np.deg2rad(3.0))
    streams["imu"] = stream("imu", imu.time, data)
    if kind == "driven":
        rows = dvl.data.copy()
        rows[dvl.time > 65.0, 0] += 0.1
        streams["dvl"] = stream("dvl", dvl.time, rows)
    return Log(log.source, streams)


@pytest.mark.parametrize(
    ("kind", "said"),
    [("turned", "the gyro turns"), ("tilted", "the accelerometer tilts"), ("driven", "the DVL drives")],
)
def test_motion_is_refused_with_what_shows_it_and_when(kind, said):
    with pytest.raises(InputError, match=rf"rest\.csv: moves: {said}.* from about [56][0-9] s"):
        calibrate_noise(moved(kind))


def test_a_short_log_and_an_empty_one_are_refused():
    with pytest.raises(InputError, match="at least 60 s"):
        calibrate_noise(at_rest(40.0))
    with pytest.raises(InputError, match="no IMU, magnetometer, DVL or heading"):
        calibrate_noise(Log("rest.csv", {"depth": stream("depth", np.arange(1000.0), np.zeros((1000, 1)))}))


def test_a_sensor_that_never_changes_is_refused():
    log = at_rest(90.0)
    dead = log["mag"].data.copy()
    dead[:, 1] = 0.5
    broken = Log(log.source, {**log.streams, "mag": stream("mag", log["mag"].time, dead)})
    with pytest.raises(InputError, match="mag_y never changes"):
        calibrate_noise(broken)


def test_of_a_log_with_a_gap_the_longest_part_is_taken():
    log = at_rest(200.0)
    imu = log["imu"]
    keep = (imu.time < 50.0) | (imu.time > 70.0)
    gappy = Log("rest.csv", {"imu": stream("imu", imu.time[keep], imu.data[keep])})
    with pytest.warns(DataWarning, match="1 gaps, the first after 50 s; the longest part .* 130 s"):
        found = calibrate_noise(gappy)
    assert found.duration == pytest.approx(130.0, abs=0.1)


def test_without_lock_a_dvl_has_no_noise():
    log = at_rest(90.0)
    lost = log["dvl"].data.copy()
    lost[:, :3], lost[:, 3] = np.nan, 0.0
    found = calibrate_noise(Log(log.source, {**log.streams, "dvl": stream("dvl", log["dvl"].time, lost)}))
    assert "dvl" not in found.piece and "dvl" not in {c.sensor for c in found.channels}


def test_a_missing_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "allantools", None)
    with pytest.raises(InputError, match=r"pip install 'rovgraph\[calibrate\]'"):
        allan(np.arange(1000.0), 1.0)


@pytest.fixture
def run(monkeypatch, capsys):
    """Call the console script; returns exit code, stdout, stderr."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["rovgraph", "calibrate", "noise", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            app.main()
        out, err = capsys.readouterr()
        return stop.value.code or 0, out, err

    return call


def write(log, path):
    frames = [
        pd.DataFrame(s.data, columns=list(s.columns)).assign(time=s.time).dropna(axis=1) for s in log.streams.values()
    ]
    pd.concat(frames).sort_values("time", kind="stable").to_csv(path, index=False)
    return path


@pytest.mark.slow
def test_the_command_writes_what_smooth_takes(run, tmp_path):
    path, out = write(at_rest(90.0), tmp_path / "log.csv"), tmp_path / "out"
    (tmp_path / "vehicle.yaml").write_text("name: mine\nimu: {noise: {gyr_walk: 2.0e-5}}\n")
    code, text, err = run(path, "-c", tmp_path / "vehicle.yaml", "--out", out)
    assert (code, err) == (0, "")
    assert "gyr_z" in text
    names = {
        "allan.csv",
        "allan.png",
        "config.yaml",
        "noise.yaml",
        "report.html",
        "spectra.csv",
        "spectra.png",
        "summary.json",
    }
    assert {p.name for p in out.iterdir()} == names
    assert json.loads((out / "summary.json").read_text())["program"] == "rovgraph"
    piece, whole = load_config(out / "noise.yaml"), load_config(out / "config.yaml")
    assert piece.imu.noise.gyr == whole.imu.noise.gyr == pytest.approx(GYR, rel=0.1)
    assert (whole.name, whole.imu.noise.gyr_walk) == ("mine", 2e-5)  # the log is too short to know better
    assert piece.imu.noise.gyr_walk == Config().imu.noise.gyr_walk


@pytest.mark.slow
def test_the_library_writes_what_the_command_writes(run, tmp_path):
    path = write(at_rest(90.0), tmp_path / "log.csv")
    assert run(path, "--out", tmp_path / "command")[0] == 0
    rg.calibrate_noise(rg.read_log(path)).save(tmp_path / "twin")
    same_files(tmp_path / "command", tmp_path / "twin")


def test_a_log_that_moves_is_one_line_and_code_2(run, tmp_path):
    code, out, err = run(write(moved("turned"), tmp_path / "log.csv"), "--out", tmp_path / "out")
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert "log.csv: moves: the gyro turns" in err
    assert not (tmp_path / "out").exists()
