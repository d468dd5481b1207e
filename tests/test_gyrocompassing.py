"""Headings by the Earth's rate, where no compass shows them: coarse alignment, sd, turns, plan, refusals."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path as FilePath

import numpy as np
import pandas as pd
import pytest
from dives import altered, campaign_log, changed, kept, simulated, smoothed, without
from live import flown
from scipy.stats import chi2
from test_cli_smooth import run

from rovgraph.diagnosis.check import examine
from rovgraph.dive import smooth
from rovgraph.errors import InputError
from rovgraph.geometry import EARTH_RATE, rpy_from_matrix, wrap_angle
from rovgraph.inference.gyrocompassing import ALIGN_S, coarse_attitude, heading_sd
from rovgraph.inference.initialise import initialise
from rovgraph.lab.choices import goals
from rovgraph.lab.observability import START_HEADING, observe
from rovgraph.lab.plan import KnownComponents, SensorRates, manoeuvres, plan
from rovgraph.model.config import Config
from rovgraph.simulate import Path

sys.path.insert(0, str(FilePath(__file__).parents[1] / "benchmarks"))

DEG = np.deg2rad(1.0)
PER_HOUR = DEG / 3600.0
FOG = Config().changed(
    environment={"latitude_deg": 60.0},
    imu={
        "noise": {"acc": 5e-4, "gyr": 0.015 * DEG / 60.0, "acc_walk": 2e-6, "gyr_walk": 1e-10},
        "acc_bias_sd_mps2": 1e-3,
        "gyr_bias_sd_dps": 0.05 / 3600.0,
        "lever_arm_m": [0.2, 0.1, -0.1],
        "mount_rpy_deg": [180.0, 0.0, 90.0],
    },
    dvl={"lever_arm_m": [-0.3, 0.0, 0.4], "mount_rpy_deg": [0.0, 0.0, 45.0]},
    heading={"sources": []},
    calibration={"gyr_scale": {"sd": 1e-4}},
)
TACTICAL = changed(FOG, imu={"gyr_bias_sd_dps": 1.0 / 3600.0})
RATES = {"imu_rate": 25.0, "dvl_rate": 2.0, "depth_rate": 1.0}


def dock(heading_deg=40.0, seconds=ALIGN_S + 5.0, turn_at=None, speed=0.0, sway=1.0):
    """A vehicle at a moving dock, or under way; with ``turn_at`` it turns by 180 deg within 20 s."""
    t = np.arange(0.0, seconds + 0.05, 0.1)
    yaw = heading_deg * DEG + sway * DEG * np.sin(t / 1.8)
    if turn_at is not None:
        x = np.clip((t - turn_at) / 20.0, 0.0, 1.0)
        yaw = yaw + np.pi * x**3 * (10.0 - 15.0 * x + 6.0 * x**2)
    roll, pitch = 3.0 * sway * DEG * np.sin(t / 1.1), 2.0 * sway * DEG * np.sin(t / 1.3 + 1.0)
    p_n = 0.2 * sway * np.column_stack([np.sin(t / 1.5), np.sin(t / 1.4 + 1.0), np.sin(t / 1.2)])
    p_n += speed * t[:, None] * [np.cos(heading_deg * DEG), np.sin(heading_deg * DEG), 0.0] + [0.0, 0.0, 2.0]
    return Path.through(t, p_n, np.column_stack([roll, pitch, yaw]), rest=False)


def dive(config=FOG, noise=False, seed=1, **motion):
    """A simulated dive whose log has no compass."""
    case = simulated(config, path=dock(**motion), noise=noise, seed=seed, **RATES)
    return case, without(case.log, "mag", "dvl_heading")


def off_deg(trajectory, case):
    """Error of the heading and its sd at the end [deg]."""
    off = wrap_angle(trajectory.rpy[-1, 2] - case.truth.at(trajectory.time[-1:]).rpy[0, 2])
    return np.rad2deg(off), np.rad2deg(trajectory.rpy_sd[-1, 2])


@pytest.mark.parametrize("latitude", [0.0, 60.0, -75.0])
@pytest.mark.parametrize(("heading", "speed"), [(20.0, 0.0), (130.0, 0.0), (-100.0, 1.5)])
def test_coarse_alignment_finds_any_attitude_at_a_moving_dock_and_under_way(latitude, heading, speed):
    config = changed(FOG, environment={"latitude_deg": latitude})
    case, log = dive(config, heading_deg=heading, speed=speed)
    found = rpy_from_matrix(coarse_attitude(log, config))
    np.testing.assert_allclose(np.rad2deg(wrap_angle(found - case.truth.rpy[0])), 0.0, atol=0.5)
    assert np.abs(np.rad2deg(found - case.truth.rpy[0])[:2]).max() < 0.02


def test_coarse_alignment_needs_neither_a_dvl_nor_every_ping():
    case, log = dive()
    blind = coarse_attitude(without(log, "dvl"), FOG)
    assert abs(wrap_angle(rpy_from_matrix(blind)[2] - case.truth.rpy[0, 2])) < 3.0 * DEG
    pings = log["dvl"].data.copy()
    pings[::7, :2] += 2.0  # less than dvl.max_speed_mps
    struck = coarse_attitude(altered(log, "dvl", pings), FOG)
    assert abs(wrap_angle(rpy_from_matrix(struck)[2] - case.truth.rpy[0, 2])) < 0.5 * DEG


def test_the_estimate_finds_the_heading_without_noise():
    case, log = dive(seconds=200.0)
    initial = initialise(log, FOG)
    assert initial.config.environment.earth_rotation
    assert any("heading from the Earth's rate by the gyro, to 0.38 deg at best" in line for line in initial.assumptions)
    assert any("rests on the gyro's bias, sd 1.4e-05 deg/s" in line for line in initial.assumptions)
    off, _ = off_deg(smoothed(log, FOG).trajectory, case)
    assert abs(off) < 0.05


def test_the_sd_is_what_a_bias_of_one_sd_does():
    """A gyro without noise, at rest towards north; its bias to the east turns the heading by its sd."""
    quiet = {"noise": {"gyr": 1e-8, "acc": 1e-4, "acc_walk": 1e-7}, "mount_rpy_deg": [0.0, 0.0, 0.0]}
    config = changed(FOG, imu=quiet, dvl={"velocity_sd_mps": [1e-3, 1e-3, 1e-3]})
    case, log = dive(config, heading_deg=0.0, seconds=200.0, sway=0.0)
    bias = 0.05 * PER_HOUR
    wrong = altered(log, "imu", log["imu"].data + np.array([0.0, 0.0, 0.0, 0.0, bias, 0.0]))
    off, sd = off_deg(smoothed(wrong, config).trajectory, case)
    expected = np.rad2deg(bias / (EARTH_RATE * 0.5))
    assert abs(off) == pytest.approx(expected, rel=0.05)
    assert sd == pytest.approx(expected, rel=0.05)
    assert np.rad2deg(heading_sd(config, 60.0, np.inf)) == pytest.approx(expected)


def test_half_a_turn_separates_bias_and_heading():
    one_way, turned = (smoothed(dive(TACTICAL, seconds=300.0, turn_at=at)[1], TACTICAL) for at in (None, 140.0))
    sd = [np.rad2deg(estimate.trajectory.rpy_sd[-1, 2]) for estimate in (one_way, turned)]
    assert sd[0] == pytest.approx(7.6, rel=0.05)
    assert sd[1] < 1.0


def test_plan_knows_that_turns_separate_bias_and_heading():
    rates, wanted = SensorRates(imu_rate=25.0, dvl_rate=1.0), goals(["heading=2deg"])
    assert wanted == {"start_heading": pytest.approx(2.0 * DEG)}
    known = KnownComponents(("start_heading",), np.array([[1e-8]]), np.array([0.3]))  # of another dive
    sd = {}
    for name in ("hold@0.5", "lawnmower@0.5"):
        one = plan(TACTICAL, manoeuvres([name], 300.0), 300.0, known=known, goals=wanted, sensors=rates)
        sd[name] = np.rad2deg(one.ranked[0].sd[one.labels.index("start_heading")])
    assert sd["hold@0.5"] == pytest.approx(7.6, rel=0.05)
    assert sd["lawnmower@0.5"] < 4.0


def test_observe_has_the_heading_as_a_component():
    _, log = dive(TACTICAL, noise=True, seconds=200.0)
    seen = observe(log, TACTICAL)
    i = seen.labels.index(START_HEADING.name)
    estimate = smoothed(log, TACTICAL).trajectory
    assert seen.sd[i] == pytest.approx(estimate.rpy_sd[0, 2], rel=0.05)
    assert seen.relative[0, i] > seen.relative[-1, i]
    assert not any(pair[:2] == ("start_heading", "start_heading") for pair in seen.correlated())


def test_a_goal_for_the_heading_needs_a_gyro_that_shows_it():
    with pytest.raises(InputError, match="goal start_heading: it is not estimated"):
        mems = changed(FOG, imu={"gyr_bias_sd_dps": 0.5})
        plan(mems, manoeuvres(["hold@0.5"], 300.0), 300.0, goals={"start_heading": 0.1})


@pytest.mark.parametrize(
    ("sections", "said"),
    [
        ({"environment": {"latitude_deg": None}}, "state environment.latitude_deg, and it may"),
        ({"imu": {"gyr_bias_sd_dps": 0.2}}, "its bias (imu.gyr_bias_sd_dps 0.2) hides the Earth's rate"),
        ({"environment": {"earth_rotation": False}}, "environment.earth_rotation: false leaves out the rate"),
        ({"environment": {"latitude_deg": 89.9}}, "it errs by 90 deg at latitude 89.9"),
        ({"imu": {"gyr_bias_sd_dps": 1.0 / 3600}, "environment": {"latitude_deg": 80}}, "it errs by 22 deg"),
    ],
)
def test_a_gyro_that_cannot_is_refused_in_one_line(sections, said):
    _, log = dive()
    with pytest.raises(InputError, match=re.escape(said)) as refused:
        initialise(log, changed(FOG, **sections))
    assert "\n" not in str(refused.value) and "give start.heading_deg" in str(refused.value)


def test_a_latitude_that_the_fixes_contradict_is_refused_and_one_that_nothing_checks_is_named():
    _, log = dive()
    south = changed(FOG, environment={"latitude_deg": -60.0})
    with pytest.raises(InputError, match=r"environment\.latitude_deg -60 contradicts the log's 60\.0"):
        initialise(replace(log, origin=(60.0, 5.0)), south)
    assert any("at latitude -60, which nothing checks" in line for line in initialise(log, south).assumptions)
    known = initialise(replace(log, origin=(60.0, 5.0)), FOG)
    assert not any("its sign neither" in line for line in known.assumptions)


def test_a_compass_that_is_left_out_is_named_and_a_short_log_refused():
    case, log = dive(seconds=60.0)
    with pytest.raises(InputError, match="the gyro shows it in 120 s without a gap, and the IMU has 60 s"):
        initialise(log, FOG)
    _, long = dive()
    broken = kept(long, "imu", np.abs(long["imu"].time - 50.0) > 1.0)
    with pytest.raises(InputError, match="without a gap, and the IMU has 49 s"):
        initialise(broken, FOG)
    with pytest.raises(InputError, match=r"heading\.sources leaves out mag, dvl_heading"):
        initialise(case.log, FOG)
    by_mag = initialise(case.log, changed(FOG, heading={"sources": ["mag"]}))
    assert "heading from mag" in by_mag.assumptions


def test_the_check_says_who_shows_the_heading():
    _, log = dive()
    texts = {f.level: f.text for f in examine(log, FOG).findings if "no heading source" in f.text}
    assert "by the Earth's rate, to 0.38 deg at best at latitude 60" in texts["ok"]
    texts = {f.level: f.text for f in examine(log, Config()).findings if "no heading source" in f.text}
    assert "the gyro does not show it: its bias" in texts["warning"]


def test_online_waits_for_the_alignment_and_says_so():
    case, log = dive(seconds=ALIGN_S + 15.0, noise=True)
    flight = flown(replace(case, log=log))
    assert flight.time[0] == pytest.approx(log["imu"].time[0] + ALIGN_S, abs=2.0)
    first = flight.solutions[0]
    off = wrap_angle(first.rpy[2] - case.truth.at(np.array([first.time])).rpy[0, 2])
    assert abs(off) < 3.0 * first.rpy_sd[2] < 15.0 * DEG


def test_smooth_takes_a_log_without_heading_or_refuses_it_in_one_line(tmp_path, monkeypatch, capsys):
    case, _ = dive(seconds=ALIGN_S + 10.0)
    frame = case.dive.log_frame.drop(columns=["mag_x", "mag_y", "mag_z", "dvl_heading"])
    frame.to_csv(tmp_path / "log.csv", index=False)
    (tmp_path / "fog.yaml").write_text(FOG.to_yaml(), encoding="utf-8")
    (tmp_path / "mems.yaml").write_text("environment: {latitude_deg: 60}", encoding="utf-8")
    command = "smooth", tmp_path / "log.csv", "--no-figures"
    assert run(monkeypatch, *command, "--config", tmp_path / "fog.yaml", "--out", tmp_path / "out") == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))
    assert any("start.heading_deg 4" in line and "by the Earth's rate" in line for line in summary["assumptions"])
    track = pd.read_csv(tmp_path / "out" / "trajectory_smoothed.csv")
    off = wrap_angle(track["yaw"].to_numpy() - case.truth.at(track["time"].to_numpy()).rpy[:, 2])
    assert np.abs(off).max() < 0.1 * DEG

    capsys.readouterr()
    assert run(monkeypatch, *command, "--config", tmp_path / "mems.yaml", "--out", tmp_path / "none") == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error")]
    assert len(errors) == 1 and "the gyro does not show it: its bias" in errors[0]
    assert not (tmp_path / "none").exists()


@pytest.mark.slow
def test_headings_are_as_honest_as_their_sds_at_a_moving_dock():
    """By the independent simulator; the tightest and the widest of a hundred campaigns are outside the band."""
    from fault_campaign.judge import Result
    from geodesy import MOMENTS, Alignment, honest_headings, nees_at, without_compass

    results = []
    for seed in range(12):
        made = without_compass(Alignment("FOG, quartz accelerometers"), seed)
        found = {}
        for estimate in smooth(*campaign_log(made)).estimates[:2]:
            track = estimate.trajectory
            for moment in MOMENTS:
                k = min(int(track.time.searchsorted(moment)), len(track.time) - 1)
                off = wrap_angle(track.rpy[k, 2] - made.motion.heading(track.time[k : k + 1])[0])
                found[f"{estimate.kind} {moment:g}"] = float(np.rad2deg(off))
                found[f"{estimate.kind} {moment:g} sd"] = float(np.rad2deg(track.rpy_sd[k, 2]))
        results.append(Result(found=found))
    low, high = chi2.ppf([0.005, 0.995], 12) / 12
    assert low < nees_at(results, "smoothed", MOMENTS[-1]) < high
    assert honest_headings(0.7, results)[1]
