"""Simulated acoustic dives obey geometry that is worked out here, their configuration and their noise."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import rovgraph as rg
from rovgraph.cli.app import main
from rovgraph.errors import InputError
from rovgraph.geometry import matrix_from_rpy, rotate, rpy_from_matrix, transpose, wrap_angle
from rovgraph.lab.choices import goals
from rovgraph.lab.plan import Manoeuvre, SensorRates, manoeuvres, plan, usual
from rovgraph.model.config import mount_matrix, parse_config
from rovgraph.simulate import Choices, Truth, scenario, simulate, simulated
from rovgraph.simulate.acoustic import BEACON_AWAY_M, middle, ship_path
from rovgraph.simulate.scenario import MANOEUVRE_RADIUS_M, MANOEUVRES

ROOT = Path(__file__).parents[1]
SPEED = 1500.0
USBL = """
ship: {antenna_m: [-5, 1, -12], sd_m: 0.5, heading_sd_deg: 0.3}
usbl:
  lever_arm_m: [8, -2, 3]
  beacon_arm_m: [0.1, 0, -0.3]
  mount_rpy_deg: [1, -2, 30]
  turn_around_s: 0.3
  beacon: 2
  frame: FRAME
calibration:
  usbl_roll: {estimate: false}
  usbl_pitch: {estimate: false}
  usbl_yaw: {estimate: false, mean_deg: 32}
  usbl_arm: {estimate: false}
  usbl_range_offset: {estimate: false, mean: 1.5}
  sound_speed_scale: {estimate: false, mean: 0.01}
"""
BEACONS = """
range: {lever_arm_m: [0.5, 0, 0.1]}
beacons: [{name: b1}, {name: b2, north_m: 20, east_m: -10, down_m: 55, sd_m: 0.5}]
"""
RECEIVERS = """
ship: {north_m: 3, east_m: 4, heading_deg: 90, receivers: {a: [1, 0, 2], b: [-1, 0, 2]}}
range: {one_way: true}
calibration: {range_clock: {mean: 0.7}}
"""


def dive_of(text, noise=False, seconds=60.0):
    """A dive 45 m below a ship, the ship, and the configuration."""
    config = parse_config(text)
    path = scenario("lawnmower", seconds).shifted([0.0, 0.0, 37.0])
    ship = ship_path(None, path, np.random.default_rng(5))
    return simulate(path, Truth(config, noise=noise, ship=ship), np.random.default_rng(1)), ship


def replies(dive):
    log = dive.log_frame.dropna(subset=["usbl_range"])
    return log["time"].to_numpy(), log[["usbl_range", "usbl_bearing", "usbl_elevation"]].to_numpy(float)


def directions(seen):
    level = np.cos(seen[:, 2])
    return np.column_stack([level * np.cos(seen[:, 1]), level * np.sin(seen[:, 1]), np.sin(seen[:, 2])])


def angle_between(u, w):
    return np.arctan2(np.linalg.norm(np.cross(u, w), axis=1), np.sum(u * w, axis=1))


def point(path, arm):
    """Where a point of a ship or vehicle is."""

    def at(time):
        motion = path.motion(np.clip(time, 0.0, path.duration))
        return motion.p_n + rotate(motion.R_nb, np.broadcast_to(np.array(arm, float), motion.p_n.shape))

    return at


@pytest.mark.parametrize("frame", ["transducer", "ship", "north"])
def test_replies_are_those_of_sound_between_a_ship_and_a_vehicle_that_move(frame):
    dive, ship = dive_of(USBL.replace("FRAME", frame))
    heard, seen = replies(dive)
    head, transponder = point(ship, (8, -2, 3)), point(dive.path, (0.1, 0, -0.3))
    answered = heard.copy()
    for _ in range(10):  # retarded times
        answered = heard - np.linalg.norm(head(heard) - transponder(answered), axis=1) / SPEED
    asked = answered - 0.3
    for _ in range(10):
        asked = answered - 0.3 - np.linalg.norm(head(asked) - transponder(answered - 0.3), axis=1) / SPEED
    assert np.median(np.diff(heard)) == pytest.approx(1.0)
    np.testing.assert_allclose(seen[:, 0], 1.01 * 0.5 * SPEED * (heard - asked - 0.3) + 1.5, atol=0.01)
    R_ns = ship.motion(heard).R_nb
    level = np.column_stack([np.zeros((len(heard), 2)), rpy_from_matrix(R_ns)[:, 2]])
    R_nf = {"transducer": R_ns, "ship": matrix_from_rpy(level), "north": np.tile(np.eye(3), (len(heard), 1, 1))}[frame]
    u = rotate(transpose(R_nf @ mount_matrix((1, -2, 32))), transponder(answered) - head(heard))
    assert np.rad2deg(angle_between(u, directions(seen))).max() < 0.02
    assert set(dive.log_frame["usbl_beacon"].dropna()) == {2}


def test_late_stamps_are_late():
    text = USBL.replace("FRAME", "north")
    late = text + "  usbl_time_offset: {estimate: false, mean: 2.0}\n"
    (time, seen), (stamp, again) = (replies(dive_of(one)[0]) for one in (text, late))
    there = np.column_stack([np.interp(stamp - 2.0, time, column) for column in (seen[:, :1] * directions(seen)).T])
    inside = (stamp > time[0] + 2.0) & (stamp < time[-1])
    np.testing.assert_allclose(there[inside], (again[:, :1] * directions(again))[inside], atol=0.15)
    assert np.abs(seen[:, 0] - again[:, 0]).max() > 0.3


def test_noise_of_replies_and_of_the_ship_is_as_stated():
    text = USBL.replace("FRAME", "transducer")
    (exact, ship), (noisy, _) = (dive_of(text, noise, 400.0) for noise in (False, True))
    said, logged = noisy.log_frame.dropna(subset=["ship_north"]), noisy.log_frame.dropna(subset=["ship_heading"])
    antenna = point(ship, (-5, 1, -12))(said["time"].to_numpy())[:, :2]
    assert np.std(said[["ship_north", "ship_east"]].to_numpy() - antenna) == pytest.approx(0.5, rel=0.15)
    heading = rpy_from_matrix(ship.motion(logged["time"].to_numpy()).R_nb)[:, 2]
    error = np.rad2deg(wrap_angle(logged["ship_heading"].to_numpy() - heading))
    assert np.std(error) == pytest.approx(0.3, rel=0.15)
    (time, seen), (other, again) = replies(exact), replies(noisy)
    ranges = again[:, 0] - np.interp(other, time, seen[:, 0])
    assert np.std(ranges) == pytest.approx(0.3, rel=0.15)
    smooth = np.column_stack([np.interp(other, time, column) for column in directions(seen).T])
    assert 0.9 < np.rad2deg(np.sqrt(np.mean(angle_between(smooth, directions(again)) ** 2) / 2.0)) < 1.5


def test_a_beacon_without_a_place_lies_near_the_dive_and_the_truth_has_it():
    dive, _ = dive_of(BEACONS, noise=True)
    place = dive.hidden["calibration"]["beacon_1"]
    assert BEACON_AWAY_M[0] < np.linalg.norm(place - middle(dive.path)[:2]) < BEACON_AWAY_M[1]
    assert dive.hidden["calibration"]["beacon_1_down"] > 45.0
    np.testing.assert_allclose(dive.hidden["calibration"]["beacon_2"], [20, -10], atol=2.0)
    assert "beacon_3" not in dive.hidden["calibration"]
    again, _ = dive_of(BEACONS, noise=True)
    np.testing.assert_array_equal(again.hidden["calibration"]["beacon_1"], place)


def test_ranges_to_beacons_are_distances_every_five_seconds():
    dive, _ = dive_of(BEACONS)
    log = dive.log_frame.dropna(subset=["range"])
    mine = log[log["range_beacon"] == "b2"]
    time = mine["time"].to_numpy()
    assert set(log["range_beacon"]) == {"b1", "b2"} and np.diff(time) == pytest.approx(5.0)
    away = point(dive.path, (0.5, 0, 0.1))(time) - [20, -10, 55]
    np.testing.assert_allclose(mine["range"], np.linalg.norm(away, axis=1), atol=0.03)  # it moves while sound travels


def test_receivers_on_a_quay_hear_one_clock_and_their_ship_needs_no_log():
    dive, _ = dive_of(RECEIVERS)
    log = dive.log_frame.dropna(subset=["range"])
    assert set(log["range_receiver"]) == {"a", "b"} and "ship_heading" not in log
    for name, place in (("a", [3, 5, 2]), ("b", [3, 3, 2])):
        mine = log[log["range_receiver"] == name]
        away = point(dive.path, (0, 0, 0))(mine["time"].to_numpy()) - place
        np.testing.assert_allclose(mine["range"], np.linalg.norm(away, axis=1) + 0.7, atol=0.03)


def test_a_dive_without_an_acoustic_system_has_none():
    assert not [c for c in dive_of("{}")[0].log_frame if re.match("ship|usbl|range", c)]


def test_names_survive_the_file(tmp_path):
    for text, column, names in (
        (USBL.replace("FRAME", "ship"), "usbl_beacon", {2}),
        (BEACONS, "range_beacon", {"b1", "b2"}),
    ):
        rg.simulate("circle", parse_config(text), 1, Choices(duration=60.0, depth=40.0)).save(tmp_path / column)
        assert set(pd.read_csv(tmp_path / column / "log.csv")[column].dropna()) == names
        log = rg.read_log(tmp_path / column / "log.csv", rg.load_config(tmp_path / column / "config.yaml"))
        assert len(log[column.split("_")[0]]) > 10


@pytest.mark.parametrize(
    ("name", "keys", "text", "told"),
    [
        ("circle", {"ship": "spin"}, "{}", "no acoustic system"),
        ("circle", {"ship": "circle"}, BEACONS, "expected one of spin, cardinal"),
        ("circle", {"depth": -1.0}, BEACONS, "depth of -1"),
        ("vattern", {"depth": 20.0}, BEACONS, "no choice of depth"),
    ],
)
def test_choices_that_cannot_be_are_refused(name, keys, text, told):
    with pytest.raises(InputError, match=told):
        simulated(name, 1, parse_config(text), Choices(duration=60.0, **keys))


def test_depth_and_ship_are_as_chosen():
    dive, _ = simulated("round", 1, parse_config(BEACONS), Choices(duration=400.0, depth=40.0, ship="spin"))
    assert dive.truth.p_n[0, 2] == pytest.approx(40.0, abs=0.05)
    log = dive.log_frame.dropna(subset=["ship_heading"])
    turned = np.unwrap(log["ship_heading"].to_numpy())
    assert np.ptp(turned) == pytest.approx(2 * np.pi, abs=0.1) and abs(turned[-1] - turned[0]) < 0.1


@pytest.mark.parametrize("name", MANOEUVRES)
def test_manoeuvres_of_survey_crews_end_above_the_beacon_and_stay_within_their_radius(name):
    motion = scenario(name, 900.0).motion(np.linspace(0.0, 900.0, 2000))
    np.testing.assert_allclose(motion.p_n[[0, -1], :2], 0.0, atol=1e-6)
    reach = np.abs(motion.p_n[:, :2]).max()
    assert reach == pytest.approx(0.0 if name == "spin" else MANOEUVRE_RADIUS_M, abs=0.5)
    assert np.linalg.norm(motion.v_n, axis=1).max() < 0.6
    if name != "round":
        headings = np.unique(np.round(np.rad2deg(rpy_from_matrix(motion.R_nb)[:, 2]) / 45.0) % 8)
        assert {0, 2, 4, 6} <= set(headings.tolist())  # all cardinal headings, so each with its reciprocal


# plan


def test_acoustic_goals_are_read_in_the_units_people_use():
    assert goals(["usbl_yaw=0.3deg"]) == {"usbl_yaw": np.deg2rad(0.3)}
    assert goals(["beacon=1m"]) == {"beacon_1_north": 1.0, "beacon_1_east": 1.0}
    assert goals(["usbl_arm=0.1m"]) == dict.fromkeys(("usbl_arm_x", "usbl_arm_y", "usbl_arm_z"), 0.1)
    for wrong in ("beacon=1deg", "usbl_yaw=1m", "beacon=m"):
        with pytest.raises(InputError, match="goal"):
            goals([wrong])


def test_acoustic_goals_are_served_by_what_survey_crews_do():
    usbl, beacon = parse_config(USBL.replace("FRAME", "ship")), parse_config(BEACONS)
    assert usual(beacon, ["beacon_1_north"]) == MANOEUVRES
    assert usual(usbl, ["usbl_yaw"]) == (*MANOEUVRES, *(f"ship-{name}" for name in MANOEUVRES))
    assert usual(usbl, ["dvl_yaw"])[0] == "straight"
    assert manoeuvres(["ship-spin", "round@0.4"], 900.0) == [Manoeuvre("ship-spin", None), Manoeuvre("round", 0.4)]
    for wrong in ("ship-circle", "ship-", "box@0.1"):
        with pytest.raises(InputError):
            manoeuvres([wrong], 900.0)


@pytest.mark.slow
def test_a_path_about_an_unknown_beacon_shows_more_of_it_than_a_turn_above_it():
    config = rg.load_config(ROOT / "configs" / "auv_single_beacon.yaml")
    wanted, sensors = goals(["beacon=1m"]), SensorRates(25.0, 2.0)
    seen = plan(config, manoeuvres(["spin", "round"], 400.0), 400.0, goals=wanted, sensors=sensors)
    assert [p.manoeuvre.name for p in seen.ranked] == ["round", "spin"]
    assert seen.before[seen.selected] == pytest.approx(1000.0)
    assert seen.scores[0] < 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("name", "most_m"), [("rov_usbl", 0.6), ("rov_ugps", 0.5), ("auv_single_beacon", 1.5)])
def test_commands_of_the_manual_reach_a_track(name, most_m, tmp_path, monkeypatch, capsys):
    """`rovgraph simulate` and `rovgraph smooth`, as docs/acoustics.md has them."""
    page = (ROOT / "docs" / "acoustics.md").read_text(encoding="utf-8")
    section = page[page.index("## Try it") :]
    first = re.search(rf"^    rovgraph (simulate .*--config configs/{name}\.yaml.*)$", section, re.MULTILINE)
    assert first is not None
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    folder = re.search(r"--out (\S+)", first[1])[1]
    then = re.search(rf"^    rovgraph (smooth {folder}/.*)$", section, re.MULTILINE)
    for command in (first[1], then[1]):
        monkeypatch.setattr(sys, "argv", ["rovgraph", *command.split()])
        with pytest.raises(SystemExit) as stop:
            main()
        assert not stop.value.code
    results = Path(re.search(r"--out (\S+)", then[1])[1])
    track = rg.read_trajectory(results / "trajectory_smoothed.csv")
    metrics = rg.evaluate(track, rg.read_reference(tmp_path / folder / "truth.csv"))
    assert metrics.rms_m < most_m and metrics.nees < 6.0
    assert json.loads((results / "summary.json").read_text())["verdict"] == "trusted"
